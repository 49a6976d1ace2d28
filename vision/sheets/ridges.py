"""Where the ridges are: local extrema of I(x) that stand out from their surroundings."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.sheets.comb import FWHM, Comb, smoothed

Floats = NDArray[np.float32]

FRAMES_PER_BLOCK = 256
NARROWEST_SHARE = 0.25  # of the typical width: narrower is a hot pixel; half-merged ridges look narrow, too
WIDEST_SHARE = 2.5  # wider is the background between ridges


@dataclass(frozen=True)
class Ridges:
    """Candidate ridges of every frame, left to right, padded with NaN to the largest count K.

    x_px: whole-pixel position (frame, K), NaN where there is no further ridge.  contrast: prominence,
    grey levels (frame, K).  fwhm_px: width at half prominence, smoothing taken off (frame, K).
    """

    x_px: Floats
    contrast: Floats
    fwhm_px: Floats

    @property
    def count(self) -> NDArray[np.int64]:
        """Ridges in each frame (frame,)."""
        return np.asarray(np.isfinite(self.x_px).sum(axis=1), np.int64)


class _Found(NamedTuple):
    frame: NDArray[np.int64]
    x: NDArray[np.int64]
    contrast: NDArray[np.float64]
    fwhm: NDArray[np.float64]


def find_ridges(profile: Floats, comb: Comb) -> Ridges:
    """Candidate ridges of every frame.

    A ridge is a local maximum of the lightly smoothed profile (a minimum where ridges are dark) whose
    prominence within its surroundings passes `comb.threshold`; shoulders have none, and what is much
    narrower than a ridge is dust. Faint sheets pass: whether a candidate is a sheet is decided by
    linking, from all frames together.

    Args: profile, grey levels (frame, x); frames of NaN hold no ridge.  comb: width, polarity and threshold.
    Source: paper, appendix B (local maxima of I(x)).
    """
    starts = range(0, len(profile), FRAMES_PER_BLOCK)
    with ThreadPoolExecutor(2) as pool:
        parts = list(pool.map(lambda i: _find_block(profile[i : i + FRAMES_PER_BLOCK], i, comb), starts))
    return _padded(parts, len(profile))


def _find_block(profile: Floats, start: int, comb: Comb) -> _Found:
    """Ridges of a block of frames, searched as one long line with walls between the frames."""
    from scipy.signal import find_peaks

    walled = np.pad(smoothed(profile * comb.sign, comb.smoothing_px), ((0, 0), (1, 1)), mode="edge")
    walled[:, [0, -1]] += 1  # a wall is no ridge, and what slopes up to it is none either
    at, facts = find_peaks(
        walled.ravel(),
        plateau_size=(1, comb.reach_px),  # wider is a flat background, of which no prominence can be told
        prominence=comb.threshold,
        width=0.0,
        rel_height=0.5,
        wlen=2 * comb.reach_px + 1,
    )
    frame, x = np.divmod(at, walled.shape[1])
    fwhm = np.sqrt(np.maximum(facts["widths"] ** 2 - (FWHM * comb.smoothing_px) ** 2, 0.25))
    keep = (fwhm >= NARROWEST_SHARE * comb.fwhm_px) & (fwhm <= WIDEST_SHARE * comb.fwhm_px)
    keep &= (x > 0) & (x < walled.shape[1] - 1)
    flattened = np.hypot(
        1, FWHM * comb.smoothing_px / comb.fwhm_px
    )  # what smoothing takes off a Gaussian's height
    return _Found(frame[keep] + start, x[keep] - 1, facts["prominences"][keep] * flattened, fwhm[keep])


def _padded(parts: list[_Found], frames: int) -> Ridges:
    frame, x, contrast, fwhm = (np.concatenate(column) for column in zip(*parts, strict=True))
    counts = np.bincount(frame, minlength=frames)
    rank = np.arange(len(frame)) - np.repeat(np.cumsum(counts) - counts, counts)
    shape = (frames, max(1, int(counts.max(initial=0))))

    def spread(values: NDArray[np.generic]) -> Floats:
        table = np.full(shape, np.nan, np.float32)
        table[frame, rank] = values
        return table

    return Ridges(spread(x), spread(contrast), spread(fwhm))
