"""The rows to average: where ridges are straightest and clearest, and how far they lean."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.numeric import Bools, Floats32, Ints, Pixels
from vision.video.settings import DEFAULTS, VideoSettings
from vision.video.strip_rows import NO_ERRORS, StripErrors, best_rows, row_shifts, strip_errors
from vision.video.video import Video, cut

_LARGEST = 1e15  # grey levels: beyond it single precision has no room for squares and their sums


@dataclass(frozen=True)
class Strip:
    """The rows to average, and what their ridges look like.

    Parameters
    ----------
    rows
        Half-open, after rotation.
    how
        "given", "found" or "all rows" (nothing stood out).
    tilt_deg
        Lean of the ridges in degrees, positive where x grows downwards; NaN where no ridges can be seen.
    clarity
        Correlation of odd and even rows' mean slopes, 0 (noise) to 1.
    warnings
        What may spoil the results.
    errors
        How much positions depend on which of the rows are averaged.
    """

    rows: slice
    how: Literal["given", "found", "all rows"]
    tilt_deg: float = math.nan
    clarity: float = 0.0
    warnings: tuple[str, ...] = ()
    errors: StripErrors = NO_ERRORS


@dataclass(frozen=True)
class _Slopes:
    """Slopes along x of bands of rows in some frames.

    mean: (frame, band, x). difference: half the difference of odd and even rows, the same shape, noise alone.
    band_rows: rows in a band.
    """

    mean: Floats32
    difference: Floats32
    band_rows: int


def choose_strip(
    video: Video, rows: slice | None, *, columns: slice | None = None, settings: VideoSettings = DEFAULTS
) -> Strip:
    """The strip of these rows, or the one that `find_strip` finds where there are none."""
    if rows is None:
        return find_strip(video, columns=columns, settings=settings)
    return measure_strip(video, rows, columns=columns, settings=settings)


def find_strip(video: Video, *, columns: slice | None = None, settings: VideoSettings = DEFAULTS) -> Strip:
    r"""Rows whose mean profile has the steepest ridges for the most rows.

    Parameters
    ----------
    video
        As `open_video` gives it; `settings.sample_frames` of its frames are looked at.
    columns
        Half-open, px, after rotation; all by default.
    settings
        See `VideoSettings`.

    Returns
    -------
    Strip
        The whole height, with how = "all rows", where no rows agree on any ridges.

    Raises
    ------
    InputError
        For columns outside the frame.

    Notes
    -----
    Slopes along x are averaged over the odd rows (:math:`o_b`) and the even rows (:math:`e_b`) of each band
    :math:`b`. For every run of :math:`h` bands the power of the mean slope, free of white noise, is taken in
    each segment :math:`s` along x,

    .. math::
        P_s = \frac{1}{h^2} \sum_{t,\, x \in s} \left[ \left(\sum_b \frac{o_b + e_b}{2}\right)^2
              - \sum_b \left(\frac{o_b - e_b}{2}\right)^2 \right]

    and the run with the largest :math:`\sqrt h \, \langle \min(P_s, P_{65\%}) \rangle_s` is taken. It is
    largest where ridges are clear, straight and upright: leaning or bowed ridges blur the mean, clamps and
    black rows dilute it. No segment counts for more than segments with ridges usually do, so labels and marks
    gain nothing by their strong edges. Brightness, pitch and polarity do not matter.

    Of that run those bands are kept whose mean gives positions with the smallest error
    (`strip_rows.best_rows`): rows that see the ridges elsewhere, bowed, shaded or at the frame's edge, are
    left out where the bias they bring is larger than the noise they save.
    """
    height, width = video.shape
    x = cut(columns, width, what=f"{video.path}: `columns`")
    band_rows = max(2, round(height / settings.bands))
    if height < 2 * band_rows:
        return Strip(slice(0, height), "all rows")
    slopes = _measure_slopes(video, slice(0, height), x, band_rows, settings)
    best = _best_run(slopes, settings)
    if best is None:
        return Strip(slice(0, height), "all rows")
    lean = lean_px(slopes.mean[:, best[0] : best[1]])
    first, last = _agreeing(slopes, *best, lean, settings)
    bottom = height if last == slopes.mean.shape[1] else last * band_rows
    rows = slice(first * band_rows, bottom)
    bands = slopes.mean[:, first:last]
    if strip_errors(row_shifts(bands, lean, settings), settings).bow_px > settings.edge_bow_px:
        rows = _off_edges(rows, height, settings)
    first, last = -(-rows.start // band_rows), max(rows.stop // band_rows, first + 1)
    return _described(slopes, min(first, last - 1), last, Strip(rows, "found"), settings, lean=lean)


def _off_edges(rows: slice, height: int, settings: VideoSettings) -> slice:
    """Rows without those next to the frame's upper and lower edge; all of a low frame."""
    if height < settings.edge_height:
        return rows
    margin = round(settings.edge_share * height)
    kept = slice(max(rows.start, margin), min(rows.stop, height - margin))
    return kept if kept.stop - kept.start >= (rows.stop - rows.start) / 2 else rows


def measure_strip(
    video: Video, rows: slice, *, columns: slice | None = None, settings: VideoSettings = DEFAULTS
) -> Strip:
    """The given rows with their tilt and clarity, both NaN for fewer than four rows.

    Raises
    ------
    InputError
        For rows or columns outside the frame.
    """
    height, width = video.shape
    z = cut(rows, height, what=f"{video.path}: `rows`")
    x = cut(columns, width, what=f"{video.path}: `columns`")
    count = z.stop - z.start
    if count < 4:
        return Strip(z, "given", clarity=math.nan)
    slopes = _measure_slopes(video, z, x, max(2, round(count / settings.bands)), settings)
    return _described(slopes, 0, slopes.mean.shape[1], Strip(z, "given"), settings)


def _described(
    slopes: _Slopes,
    first: int,
    last: int,
    strip: Strip,
    settings: VideoSettings,
    *,
    lean: float | None = None,
) -> Strip:
    """The strip with tilt, clarity, and warnings where ridges lean too far or positions depend on the rows.

    lean: shift from band to band, px, where more rows than the strip's tell it.
    """
    bands = slopes.mean[:, first:last]
    clarity = _clarity(slopes, first, last)
    if clarity < settings.min_clarity:
        return Strip(strip.rows, strip.how, clarity=clarity)
    height = strip.rows.stop - strip.rows.start
    per_band = lean_px(bands) if lean is None else lean
    per_row = per_band / slopes.band_rows
    smear, ridge = abs(per_row) * height, ridge_width_px(bands.mean(axis=1))
    tilt_deg = float(np.degrees(np.arctan(per_row)))
    errors = strip_errors(row_shifts(bands, per_band, settings), settings)
    warnings = []
    if smear > settings.max_smear * ridge:
        warnings.append(
            f"ridges lean by {tilt_deg:+.2f} deg, {smear:.1f} px over the {height} rows of the strip, and "
            f"are about {ridge:.0f} px wide: turn the camera, or choose fewer rows (`rows`)"
        )
    if errors.error_px > settings.strip_warning_px:
        warnings.append(
            f"positions depend on the rows averaged: {errors.error_px:.2f} px with a fifth of them left out, "
            f"{errors.halves_px:.2f} px between the strip's upper and lower half, {errors.bow_px:.2f} px "
            "between its outer and inner half; bowed ridges or a shadow: look at the frame, or choose fewer "
            "rows (`rows`)"
        )
    return Strip(strip.rows, strip.how, tilt_deg, clarity, tuple(warnings), errors)


def _agreeing(
    slopes: _Slopes, first: int, last: int, lean: float, settings: VideoSettings
) -> tuple[int, int]:
    """The part of a run of bands in which the ridges stand at the same place, as far as that is worth it."""
    bands = slopes.mean[:, first:last]
    width_px = ridge_width_px(bands.mean(axis=1))
    if not width_px > 0:
        return first, last
    ridges = max(1.0, 2 * settings.segment_px / (2.5 * width_px))
    begin, end = 0, last - first
    for _ in range(2):  # rows that stand apart spoil the lean, too: once more with that of the rest
        shifts = row_shifts(bands, lean, settings)
        if shifts is None:
            break
        begin, end = best_rows(shifts, ridges, settings)
        if (begin, end) == (0, last - first):
            break
        lean = lean_px(bands[:, begin:end])
    return first + begin, first + end


def _measure_slopes(
    video: Video, rows: slice, columns: slice, band_rows: int, settings: VideoSettings
) -> _Slopes:
    """Slopes of the bands in sampled frames; in the first frames of a file that cannot be sampled."""
    count = settings.sample_frames
    frames = list(video.sample(count)) or list(itertools.islice(video.frames(), count))
    if not frames:
        found = "none: they cannot be decoded"
        raise InputError(video.path, "at least one frame that shows something", found, "copy the file again")
    odd_even = np.stack([_odd_even(frame[rows, columns], band_rows) for frame in frames])
    slope = np.stack([_slope(halves, settings.slope_sigma_px) for halves in odd_even])
    odd, even = slope[:, 0], slope[:, 1]
    half = np.float32(0.5)
    return _Slopes((odd + even) * half, (odd - even) * half, band_rows)


def _odd_even(frame: Pixels, band_rows: int) -> Floats32:
    """Means of each band's odd and even rows, (2, band, x); rows that fill no band are left out."""
    bands = frame.shape[0] // band_rows
    pixels = np.asarray(frame[: bands * band_rows], np.float32).reshape(bands, band_rows, -1)
    if frame.dtype.kind == "f":  # a pixel without a value shows no ridge; as NaN it would hide all others
        pixels = np.where(np.abs(pixels) < _LARGEST, pixels, np.float32(0))
    return np.stack([pixels[:, 0::2].mean(axis=1), pixels[:, 1::2].mean(axis=1)])


def _slope(bands: Floats32, sigma_px: float) -> Floats32:
    """Derivative along x of means (2, band, x), Gaussian-smoothed; the outermost pixels are repeated."""
    reach = int(4 * sigma_px + 0.5)
    offsets = np.arange(1, reach + 1, dtype=np.float64)
    gaussian = np.exp(-(offsets**2) / (2 * sigma_px**2))
    weights = gaussian / (1 + 2 * gaussian.sum()) * offsets / sigma_px**2
    width = bands.shape[-1]
    padded = np.pad(bands.astype(np.float64), ((0, 0), (0, 0), (reach, reach)), mode="edge")
    slope, step = np.zeros(bands.shape), np.empty(bands.shape)
    for k in range(reach, 0, -1):  # differences, so that what is constant has no slope at all
        right, left = padded[..., reach + k : reach + k + width], padded[..., reach - k : reach - k + width]
        np.subtract(right, left, out=step)
        step *= weights[k - 1]
        slope += step
    return slope.astype(np.float32)


def _best_run(slopes: _Slopes, settings: VideoSettings) -> tuple[int, int] | None:
    """Half-open run of bands with the highest score; None where none is above zero."""
    bands, width = slopes.mean.shape[1:]
    starts = np.linspace(0, width, max(1, width // settings.segment_px) + 1).astype(np.int64)[:-1]
    sums = np.concatenate([np.zeros_like(slopes.mean[:, :1]), np.cumsum(slopes.mean, axis=1)], axis=1)
    noise = np.add.reduceat((slopes.difference**2).sum(axis=0), starts, axis=-1)
    noise_sums = np.concatenate([np.zeros_like(noise[:1]), np.cumsum(noise, axis=0)])
    with_ridges = _shows_ridges(slopes, starts, settings)
    best, score = None, 0.0
    if not with_ridges.any():
        return None
    for first in range(bands):  # over starting bands, not frames; every end at once
        count = np.arange(1, bands - first + 1)[:, np.newaxis]
        total = ((sums[:, first + 1 :] - sums[:, first : first + 1]) ** 2).sum(axis=0)
        power = np.add.reduceat(total, starts, axis=-1) - (noise_sums[first + 1 :] - noise_sums[first])
        each = np.maximum(power / count**2, 0.0)
        cap = np.quantile(each[:, with_ridges], settings.segment_cap, axis=1, keepdims=True)
        scores = np.minimum(each, cap).mean(axis=1) * count[:, 0] ** settings.height_power
        last = first + int(np.argmax(scores)) + 1
        highest = float(scores[last - first - 1])
        if highest > score and _clarity(slopes, first, last) >= settings.min_clarity:
            best, score = (first, last), highest
    return best


def _shows_ridges(slopes: _Slopes, starts: Ints, settings: VideoSettings) -> Bools:
    """Which segments show ridges in many rows."""
    power = np.add.reduceat((slopes.mean**2 - slopes.difference**2).sum(axis=0), starts, axis=-1)
    usual = np.quantile(power, settings.ridge_rows, axis=0)
    return np.asarray(usual >= settings.ridge_share * np.sort(usual)[-min(3, usual.size)], bool)


def _clarity(slopes: _Slopes, first: int, last: int) -> float:
    """Correlation of the odd and even rows' mean slopes; 0 where there is no slope at all."""
    signal = float((slopes.mean[:, first:last].mean(axis=1) ** 2).sum())
    noise = float((slopes.difference[:, first:last].mean(axis=1) ** 2).sum())
    return max(0.0, (signal - noise) / (signal + noise)) if signal > 0 else 0.0


def lean_px(bands: NDArray[np.floating]) -> float:
    """Shift along x from one band to the next, px, positive to the right downwards.

    The median over segments along x, so that a label or ridges bowed apart do not count as a lean. In each,
    bands (frame, band, x) are shifted in proportion to their place until their sum is strongest. Of several
    maxima, a pitch apart, the one nearest to upright is taken. Leans beyond 12 px over the stack are not
    found. 0 for a single band.
    """
    count, width = bands.shape[1:]
    if count < 2:
        return 0.0
    parts = np.array_split(bands, max(1, width // 256), axis=-1)  # each wider than the widest pitch
    return float(np.median([_lean_of_stack(part) for part in parts]) / (count - 1))


def _lean_of_stack(bands: NDArray[np.floating]) -> float:
    """Lean from the first band to the last: the best trial, refined by a parabola through its neighbours."""
    spectrum = np.fft.rfft(bands - bands.mean(axis=-1, keepdims=True), axis=-1)
    frequency = np.fft.rfftfreq(bands.shape[-1])
    place = np.linspace(-0.5, 0.5, bands.shape[1])
    step = 0.5
    trials = np.arange(-12, 12 + step / 2, step)
    power = np.array([_coherent_power(spectrum, frequency, place * lean) for lean in trials])
    inner = power[1:-1]
    peaks = np.flatnonzero((inner >= power[:-2]) & (inner > power[2:])) + 1
    if not peaks.size:
        return float(trials[np.argmax(power)])
    best = int(peaks[np.argmin(np.abs(trials[peaks]))])
    before, here, after = power[best - 1 : best + 2]
    return float(trials[best] + step * 0.5 * (before - after) / (before - 2 * here + after))


def _coherent_power(
    spectrum: NDArray[np.complexfloating], frequency: NDArray[np.floating], shifts_px: NDArray[np.floating]
) -> float:
    """Power of the sum of bands after moving each back by its shift."""
    phase = np.exp(2j * np.pi * np.outer(shifts_px, frequency)).astype(np.complex64)
    return float((np.abs(np.einsum("fbk,bk->fk", spectrum, phase)) ** 2).sum())


def ridge_width_px(slopes: NDArray[np.floating]) -> float:
    """Full width of a typical ridge at half height, px, from slopes along x (frame, x); NaN for none.

    A ridge's slope changes sign at its top: the slope's autocorrelation has its first minimum where one
    flank meets the other, for a Gaussian at sqrt(6)/2.355 = 1.04 of the width; the smoothing of the slopes
    is included.
    """
    power = np.abs(np.fft.rfft(slopes, n=2 * slopes.shape[-1], axis=-1)) ** 2
    correlation = np.fft.irfft(power.sum(axis=0))[: slopes.shape[-1] // 2]
    rising = np.flatnonzero(np.diff(correlation) > 0)
    return float(rising[0]) / 1.04 if rising.size else math.nan
