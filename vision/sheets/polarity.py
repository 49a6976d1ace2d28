"""Which stripes of a comb are the sheets, the bright or the dark ones, and which the gaps between them."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from vision.numeric import Floats, Floats32, Ints
from vision.sheets.settings import TrackingSettings

_NEAREST = 3  # stripes whose levels stand for the comb's end


class Stripes(NamedTuple):
    """Bright or dark stripes in a sample of frames.

    Parameters
    ----------
    x
        Position of each stripe in whole pixels, in ascending order, for each frame.
    width
        Their widths, px.
    """

    x: list[Ints]
    width: list[Floats]

    @property
    def spacing(self) -> Ints:
        """All distances between neighbours."""
        return np.concatenate([np.diff(x) for x in self.x])


def choose_polarity(
    line: Floats32, bright: Stripes, dark: Stripes, settings: TrackingSettings
) -> Literal["bright", "dark"] | None:
    """Return the polarity of the sheets, None if nothing tells sheets from gaps.

    The background beside the comb is also what shows between the sheets. If no end of the comb is clearly in
    view, sheets and gaps of an even comb differ in two ways. Sheets keep their widths, while gaps change. And
    two sheets differ in brightness, while two gaps show the same background.

    Parameters
    ----------
    line
        Lightly smoothed profiles of the sample (frame, x).
    bright, dark
        The stripes between which to choose.
    settings
        Thresholds.
    """
    spacings = [stripes.spacing for stripes in (bright, dark)]
    if not all(len(spacing) for spacing in spacings):
        return None
    pitch = float(np.median(np.concatenate(spacings)))
    background = _background(line, bright, dark, pitch, settings.background_margin)
    if abs(background) > 1 / 3:
        return "bright" if background > 0 else "dark"
    quartiles = np.array([np.quantile(spacing, [0.25, 0.75]) for spacing in spacings])
    if (quartiles[:, 1] > settings.even_spacing * quartiles[:, 0]).any():
        return None
    changes = [_width_change(stripes, pitch) for stripes in (bright, dark)]
    differences = [_height_difference(line, stripes) for stripes in (bright, dark)]
    if not min(*changes, *differences) > 0:
        return None
    evidence = np.log(changes[1] / changes[0] * differences[0] / differences[1])
    if abs(evidence) < settings.polarity_evidence:
        return None
    return "bright" if evidence > 0 else "dark"


def _background(line: Floats32, bright: Stripes, dark: Stripes, pitch: float, margin: float) -> float:
    """Return +1 if the background beside the comb is as dark as the dark stripes near by, -1 if as bright as
    the bright ones.

    It is the mean over both ends and all frames in which more than a pitch is in view there: 0 where the
    background is neither, and 0 if these are less than a tenth of all.
    """
    sides = []
    for row, up, down in zip(line, bright.x, dark.x, strict=True):
        if min(len(up), len(down)) < _NEAREST:
            continue
        last = len(row) - 1
        for at, ups, downs in ((row, up, down), (row[::-1], last - up[::-1], last - down[::-1])):
            end = min(ups[0], downs[0])
            if end > 1.3 * pitch:
                beside = at[max(0, int(end - 2.3 * pitch)) : int(end - 0.7 * pitch) + 1]
                high, low = at[ups[:_NEAREST]].mean(), at[downs[:_NEAREST]].mean()
                level = (np.quantile(beside, [0.1, 0.9]) - low) / (high - low) - 0.5
                sides.append(float(level[1] < -margin) - float(level[0] > margin))
    return float(np.mean(sides)) if len(sides) > 0.1 * 2 * len(line) else 0.0


def _width_change(stripes: Stripes, pitch: float) -> float:
    """Return by how much the width of a stripe changes from one frame of the sample to the next, px."""
    changes = [np.zeros(0)]
    for x, width, later, width_later in zip(
        stripes.x, stripes.width, stripes.x[1:], stripes.width[1:], strict=False
    ):
        if len(x) and len(later):
            away = np.abs(later - x[:, None])
            next_ = away.argmin(axis=1)
            same = (away.argmin(axis=0)[next_] == np.arange(len(x))) & (away.min(axis=1) < 0.5 * pitch)
            changes.append(np.abs(width_later[next_] - width)[same])
    found = np.concatenate(changes)
    return float(found.mean()) if len(found) else 0.0


def _height_difference(line: Floats32, stripes: Stripes) -> float:
    """Return by how much the level of a stripe typically differs from the mean of both its neighbours."""
    bends = [np.abs(np.diff(row[x], 2)) for row, x in zip(line, stripes.x, strict=True)]
    found = np.concatenate(bends)
    return float(np.median(found)) / 2 if len(found) else 0.0
