"""The rows to average: where ridges are straightest and clearest, and how far they lean."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.numeric import Bools, Floats, Floats32, Ints, Pixels
from vision.video.settings import DEFAULTS, VideoSettings
from vision.video.strip_rows import NO_ERRORS, StripErrors, best_rows, row_shifts, strip_errors
from vision.video.video import Video, cut


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
    band_rows: rows in a band. along_z, along_x: mean square steps of the grey level over 2 px, of every
    second row. picture: the mean of the frames, every second row and column.
    """

    mean: Floats32
    difference: Floats32
    band_rows: int
    along_z: Floats
    along_x: Floats
    picture: Floats32

    def part(self, first: int, last: int) -> _Slopes:
        """Those of some bands."""
        bands = np.s_[:, first:last]
        return replace(self, mean=self.mean[bands], difference=self.difference[bands])


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
    (`best_rows`): rows that see the ridges elsewhere, bowed, shaded or at the frame's edge, are
    left out where the bias they bring is larger than the noise they save. So are rows with a label, such as
    the time of day that cameras write into the picture.
    """
    height, width = video.shape
    x = cut(columns, width, what=f"{video.path}: `columns`")
    band_rows = max(2, round(height / settings.bands))
    if height < 2 * band_rows:
        return Strip(slice(0, height), "all rows")
    slopes = _measure_slopes(video, slice(0, height), x, band_rows, settings)
    best = _best_run(slopes, settings)
    if best is not None:
        best = _rather_moving(slopes, best, settings)
    if best is None:
        whole = slice(0, height)
        return _told_level(Strip(whole, "all rows"), slopes, whole, video, settings)
    lean = lean_px(slopes.mean[:, best[0] : best[1]])
    first, last = _beside_labels(slopes, *_agreeing(slopes, *best, lean, settings), settings)
    bottom = height if last == slopes.mean.shape[1] else last * band_rows
    rows = slice(first * band_rows, bottom)
    bands = slopes.mean[:, first:last]
    if strip_errors(row_shifts(bands, lean, settings), settings).bow_px > settings.edge_bow_px:
        rows = _off_edges(rows, height, settings)
    first, last = -(-rows.start // band_rows), max(rows.stop // band_rows, first + 1)
    strip = _described(slopes, min(first, last - 1), last, Strip(rows, "found"), settings, lean=lean)
    return _told_level(strip, slopes, slice(best[0] * band_rows, best[1] * band_rows), video, settings)


def _told_level(strip: Strip, slopes: _Slopes, rows: slice, video: Video, settings: VideoSettings) -> Strip:
    """The strip, with a warning where these rows change along z rather than along x, from pixel to pixel and
    as a whole: the texture of wide sheets and dead rows make no level ridges."""
    rows = slice(rows.start // 2, rows.stop // 2)
    along_z, along_x = float(slopes.along_z[rows].mean()), float(slopes.along_x[rows].mean())
    level, upright = (np.ptp(np.quantile(slopes.picture.mean(axis=axis), (0.1, 0.9))) for axis in (1, 0))
    if along_z <= settings.max_level * along_x or not along_x or 2 * level < upright:
        return strip
    warning = (
        f"grey levels change {math.sqrt(along_z / along_x):.1f} times as much from row to row as along the "
        "rows: the ridges may lie level, one above the other; if they do, give `rotate` "
        f"{(video.rotate + 90) % 360}"
    )
    return replace(strip, warnings=(*strip.warnings, warning))


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


def _beside_labels(slopes: _Slopes, first: int, last: int, settings: VideoSettings) -> tuple[int, int]:
    """The longest part of a run of bands in which nothing is written over the picture; all of it where that
    is short. What is written is far steeper than ridges, in a few bands and in several segments along x."""
    bands = slopes.mean[:, first:last]
    starts = _segment_starts(bands.shape[-1], settings)
    usual = np.median(bands, axis=1, keepdims=True)
    ridges = np.median(np.add.reduceat(usual[:, 0] ** 2, starts, axis=-1), axis=0)
    strange = np.median(np.add.reduceat((bands - usual) ** 2, starts, axis=-1), axis=0)
    power = np.quantile(ridges[_shows_ridges(slopes, starts, settings)], settings.segment_cap)
    segments = (strange - np.median(strange, axis=0) > settings.label_power * power).sum(axis=1)
    written = (segments >= 2) & (segments <= starts.size / 2)
    written[1:] |= written[:-1]  # letters end within a band
    written[:-1] |= written[1:]
    ends = np.concatenate([[-1], np.flatnonzero(written), [last - first]])
    longest = int(np.argmax(np.diff(ends)))
    begin, end = int(ends[longest]) + 1, int(ends[longest + 1])
    kept = end - begin >= settings.label_least_rows * (last - first)
    return (first + begin, first + end) if kept else (first, last)


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
    thinned = [_known(frame[rows, columns][::2, ::2]) for frame in frames]
    along_z, along_x = np.mean([_steps(pixels) for pixels in thinned], axis=0)
    picture = np.mean(thinned, axis=0)
    return _Slopes((odd + even) * half, (odd - even) * half, band_rows, along_z, along_x, picture)


def _steps(pixels: Floats32) -> Floats:
    """Mean square steps from pixel to pixel of every second row and column along z and along x, (2, row):
    over 2 px, since interlaced rows of both fields stand apart where sheets move."""
    along_z, along_x = np.diff(pixels, axis=0, append=pixels[-1:]), np.diff(pixels, axis=1)
    return np.stack([np.einsum("zx,zx->z", steps, steps) / steps.shape[1] for steps in (along_z, along_x)])


def _odd_even(frame: Pixels, band_rows: int) -> Floats32:
    """Means of each band's odd and even rows, (2, band, x); rows that fill no band are left out."""
    bands = frame.shape[0] // band_rows
    pixels = _known(frame[: bands * band_rows]).reshape(bands, band_rows, -1)
    return np.stack([pixels[:, 0::2].mean(axis=1), pixels[:, 1::2].mean(axis=1)])


def _known(frame: Pixels) -> Floats32:
    """Grey levels in single precision, 0 where there is none."""
    pixels = np.asarray(frame, np.float32)
    if frame.dtype.kind == "f":  # NaN would hide all other pixels; single precision cannot square 1e20
        pixels = np.where(np.abs(pixels) < 1e15, pixels, np.float32(0))
    return pixels


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
    starts = _segment_starts(width, settings)
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


def _rather_moving(slopes: _Slopes, best: tuple[int, int], settings: VideoSettings) -> tuple[int, int]:
    """The best run above or below this one if it moves and this one stands still, as a ruler does; else this
    one. What moves in few segments (the time of day) is no comb."""
    bands = slopes.mean.shape[1]
    starts = _segment_starts(slopes.mean.shape[-1], settings)
    own, wide = _change(slopes, *best), _shows_ridges(slopes.part(*best), starts, settings).sum()
    moves, chosen = max(settings.moving_change, settings.moving_ratio * own), best
    for first, last in ((0, best[0]), (best[1], bands)):
        part = slopes.part(first, last)
        run = _best_run(part, settings) if last > first else None
        if run is None or _shows_ridges(part.part(*run), starts, settings).sum() < wide / 2:
            continue
        if (change := _change(part, *run)) > moves:
            moves, chosen = change, (first + run[0], first + run[1])
    return chosen


def _change(slopes: _Slopes, first: int, last: int) -> float:
    """Power of what differs between the frames beyond noise, over that of the slope; brightness aside."""
    mean, noise = (part[:, first:last].mean(axis=1) for part in (slopes.mean, slopes.difference))
    size = np.linalg.norm(mean, axis=1, keepdims=True)
    mean, noise = (part / np.maximum(size, 1e-9) for part in (mean, noise))
    return max(0.0, float(mean.var(axis=0, ddof=min(1, len(mean) - 1)).sum() - (noise**2).sum(axis=1).mean()))


def _segment_starts(width: int, settings: VideoSettings) -> Ints:
    return np.linspace(0, width, max(1, width // settings.segment_px) + 1).astype(np.int64)[:-1]


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
    frequency, place = np.fft.rfftfreq(bands.shape[-1]), np.linspace(-0.5, 0.5, bands.shape[1])
    step = 0.5
    trials = np.arange(-12, 12 + step / 2, step)
    turn = 2j * np.pi * np.outer(place, frequency)
    moved = np.fft.rfft(bands - bands.mean(axis=-1, keepdims=True), axis=-1) * np.exp(trials[0] * turn)
    one_step = np.exp(step * turn)
    power = np.empty(trials.size)
    for trial in range(trials.size):  # each moves the bands back by one step more
        power[trial] = (np.abs(moved.sum(axis=1)) ** 2).sum()
        moved *= one_step
    inner = power[1:-1]
    peaks = np.flatnonzero((inner >= power[:-2]) & (inner > power[2:])) + 1
    if not peaks.size:
        return float(trials[np.argmax(power)])
    best = int(peaks[np.argmin(np.abs(trials[peaks]))])
    before, here, after = power[best - 1 : best + 2]
    return float(trials[best] + step * 0.5 * (before - after) / (before - 2 * here + after))


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
