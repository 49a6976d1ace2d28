"""find_strip(): the rows where ridges are straightest and clearest, and how far they lean."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from vision.video.recording import cut
from vision.video.tilt import lean_px, ridge_width_px

if TYPE_CHECKING:
    from vision.video.source import Video

SAMPLE_FRAMES = 8
SMEAR = 0.3  # of a ridge's width: leaning further than this over the strip costs precision
_BANDS = 96  # the height is judged in this many bands at most
_SEGMENT_PX = 64  # judged apart along x, so that what one place adds can be limited
_CAP = 0.65  # quantile of the segments with ridges above which slope does not count
_LIVE = 0.02  # of the third-strongest segment: the comb need not fill the picture's width
_OFTEN = 0.75  # quantile over the bands: what a segment shows in many rows, not in a label's few
_HEIGHT_POWER = 0.5  # a row is worth adding if it brings 3/4 of the strip's own slope
_SLOPE_SIGMA_PX = 1.5  # smoothing of the slope: below the narrowest ridge, above pixel noise
_HALF = np.float32(0.5)
_MIN_CLARITY = 0.3  # odd and even rows that agree less than this show no ridges


@dataclass(frozen=True)
class Strip:
    """The rows to average, and what their ridges look like.

    rows: half-open, after rotation.  how: "given", "found" or "all rows" (nothing stood out).
    tilt_deg: lean of the ridges, positive where x grows downwards, NaN if nothing can be seen.
    clarity: correlation of odd and even rows' mean slopes, 0 (noise) to 1.
    warnings: what the user must be told.
    """

    rows: slice
    how: Literal["given", "found", "all rows"]
    tilt_deg: float
    clarity: float
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Slopes:
    """Slopes along x of bands of rows in some frames.

    mean: (frame, band, x).  difference: half the difference of odd and even rows, the same shape, noise
    alone. band_rows: rows in a band.
    """

    mean: NDArray[np.float32]
    difference: NDArray[np.float32]
    band_rows: int


def find_strip(video: Video, *, columns: slice | None = None) -> Strip:
    """Rows whose mean profile has the steepest ridges for the most rows.

    For every run of bands the slope power of its mean profile is measured, free of noise (odd against even
    rows), and times sqrt(height) it is largest where ridges are clear, straight and upright: leaning or
    bowed ridges blur the mean, clamps and black rows dilute it. No place along x counts for more than ridges
    usually do, so labels and marks gain nothing by their strong edges.  Brightness and pitch do not matter,
    nor does polarity.

    Looks at `SAMPLE_FRAMES` frames.  Returns: the whole height, how="all rows", where nothing is coherent.
    """
    height, width = video.shape
    x = cut(columns, width, what=f"{video.path}: columns")
    band_rows = max(2, round(height / _BANDS))
    if height < 2 * band_rows:
        return Strip(slice(0, height), "all rows", float("nan"), 0.0)
    slopes = _slopes(video, slice(0, height), x, band_rows)
    best = _best_run(slopes)
    if best is None:
        return Strip(slice(0, height), "all rows", float("nan"), 0.0)
    first, last = best
    bottom = height if last == slopes.mean.shape[1] else last * band_rows
    return _described(slopes, first, last, slice(first * band_rows, bottom), "found")


def measure_strip(video: Video, rows: slice, *, columns: slice | None = None) -> Strip:
    """The given rows with their tilt and clarity. InputError for rows outside the frame."""
    height, width = video.shape
    z = cut(rows, height, what=f"{video.path}: strip rows")
    x = cut(columns, width, what=f"{video.path}: columns")
    count = z.stop - z.start
    if count < 4:
        return Strip(z, "given", float("nan"), float("nan"))
    slopes = _slopes(video, z, x, max(2, round(count / _BANDS)))
    return _described(slopes, 0, slopes.mean.shape[1], z, "given")


def _described(slopes: _Slopes, first: int, last: int, rows: slice, how: Literal["given", "found"]) -> Strip:
    """Tilt, clarity and the warning that goes with a lean."""
    bands = slopes.mean[:, first:last]
    clarity = _clarity(slopes, first, last)
    if clarity < _MIN_CLARITY:
        return Strip(rows, how, float("nan"), clarity)
    height = rows.stop - rows.start
    per_row = lean_px(bands) / slopes.band_rows
    smear, ridge = abs(per_row) * height, ridge_width_px(bands.mean(axis=1))
    warnings: tuple[str, ...] = ()
    tilt_deg = float(np.degrees(np.arctan(per_row)))
    if smear > SMEAR * ridge:
        text = f"ridges lean by {tilt_deg:+.2f} deg, {smear:.1f} px over the {height} rows of the strip"
        warnings = (
            f"{text}, and are about {ridge:.0f} px wide: turn the camera or take fewer rows (--strip)",
        )
    return Strip(rows, how, tilt_deg, clarity, warnings)


def _slopes(video: Video, rows: slice, columns: slice, band_rows: int) -> _Slopes:
    """Slopes of the bands in sampled frames; in the first frames of a file that cannot be sampled."""
    from scipy.ndimage import gaussian_filter1d

    found = list(video.sample(SAMPLE_FRAMES)) or list(itertools.islice(video.frames(), SAMPLE_FRAMES))
    odd_even = np.stack([_odd_even(frame[rows, columns], band_rows) for frame in found])
    slope = np.empty_like(odd_even)
    gaussian_filter1d(odd_even, _SLOPE_SIGMA_PX, axis=-1, order=1, mode="nearest", output=slope)
    odd, even = slope[:, 0], slope[:, 1]
    return _Slopes((odd + even) * _HALF, (odd - even) * _HALF, band_rows)


def _odd_even(frame: NDArray[np.generic], band_rows: int) -> NDArray[np.float32]:
    """Means of each band's odd and even rows, (2, band, x); rows that fill no band are left out."""
    bands = frame.shape[0] // band_rows
    pixels = np.asarray(frame[: bands * band_rows], np.float32).reshape(bands, band_rows, -1)
    if frame.dtype.kind == "f":  # a pixel without a value shows no ridge; as NaN it would hide all others
        pixels = np.nan_to_num(pixels, nan=0.0, posinf=0.0, neginf=0.0)
    return np.stack([pixels[:, 0::2].mean(axis=1), pixels[:, 1::2].mean(axis=1)])


def _segments(width: int) -> NDArray[np.int64]:
    """Where the segments along x start."""
    return np.linspace(0, width, max(1, width // _SEGMENT_PX) + 1).astype(np.int64)[:-1]


def _best_run(slopes: _Slopes) -> tuple[int, int] | None:
    """Half-open run of bands with the highest score; None where none is above nothing."""
    bands = slopes.mean.shape[1]
    sums = np.concatenate([np.zeros_like(slopes.mean[:, :1]), np.cumsum(slopes.mean, axis=1)], axis=1)
    starts = _segments(slopes.mean.shape[-1])
    noise = np.add.reduceat((slopes.difference**2).sum(axis=0), starts, axis=-1)
    noise_sums = np.concatenate([np.zeros_like(noise[:1]), np.cumsum(noise, axis=0)])
    live = _live(slopes, starts)
    best, score = None, 0.0
    for first in range(bands):  # over starting bands, not frames; every end at once
        count = np.arange(1, bands - first + 1)[:, np.newaxis]
        total = ((sums[:, first + 1 :] - sums[:, first : first + 1]) ** 2).sum(axis=0)
        power = np.add.reduceat(total, starts, axis=-1) - (noise_sums[first + 1 :] - noise_sums[first])
        each = np.maximum(power / count**2, 0.0)
        cap = np.quantile(each[:, live], _CAP, axis=1, keepdims=True)
        capped = np.minimum(each, cap).mean(axis=1)
        scores = capped * count[:, 0] ** _HEIGHT_POWER
        last = int(np.argmax(scores))
        if scores[last] > score and _clarity(slopes, first, first + last + 1) >= _MIN_CLARITY:
            best, score = (first, first + last + 1), float(scores[last])
    return best


def _live(slopes: _Slopes, starts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which segments show ridges in many rows."""
    power = np.add.reduceat((slopes.mean**2 - slopes.difference**2).sum(axis=0), starts, axis=-1)
    usual = np.quantile(power, _OFTEN, axis=0)
    return np.asarray(usual >= _LIVE * np.sort(usual)[-min(3, usual.size)], bool)


def _clarity(slopes: _Slopes, first: int, last: int) -> float:
    """Correlation of the odd and even rows' mean slopes; 0 where there is no slope at all."""
    signal = float((slopes.mean[:, first:last].mean(axis=1) ** 2).sum())
    noise = float((slopes.difference[:, first:last].mean(axis=1) ** 2).sum())
    return max(0.0, (signal - noise) / (signal + noise)) if signal > 0 else 0.0
