"""Choice of the rows to average: where ridges are straightest and clearest, and how far they are tilted.

A ruler in the picture can be mistaken for a comb of sheets. No single stage can exclude it, so three do:
above or below the comb it is avoided here, by the choice of rows (`_prefer_moving`). Beside the comb it is in
the same rows, and only tracks show that it has another pitch and does not move (`_ruler_beside_comb`,
`vision.sheets.reference`). Marks or ridges one above the other suit no rows: `_level_warnings`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.numeric import (
    Bools,
    Floats,
    Floats32,
    Ints,
    Pixels,
    peak_offset,
    sigma_about_zero,
    with_minus,
)
from vision.video.settings import VideoSettings
from vision.video.video import Video, cut


class StripErrors(NamedTuple):
    """Dependence of positions on the choice of rows, px, without tilt and noise; 0 if not significant."""

    halves_px: float = 0.0  # RMS difference of positions from the upper and the lower half
    bow_px: float = 0.0  # and from the outer and the inner half
    # RMS displacement of the mean if a tenth of the rows were left out at both ends, which is an equally good
    # choice; as it does not vary with time, it is a systematic error
    error_px: float = 0.0


@dataclass(frozen=True)
class Strip:
    """The rows to average, and properties of their ridges."""

    rows: slice  # half-open, after rotation
    how: Literal["given", "found", "all rows"]  # "all rows": no ridges were found
    # tilt of the ridges in degrees, positive if x grows downwards; NaN if no ridges are visible
    tilt_deg: float = math.nan
    clarity: float = 0.0  # correlation of the mean slopes of odd and even rows, 0 (noise) to 1
    warnings: tuple[str, ...] = ()  # conditions that may spoil the results
    # how much positions depend on the choice of rows
    errors: StripErrors = field(default_factory=StripErrors)


@dataclass(frozen=True)
class _Slopes:
    """Slopes along x of bands of rows in some frames, and the settings with which they are judged."""

    mean: Floats32  # of odd and even rows, (frame, band, x)
    difference: Floats32  # half that of odd and even rows, which is noise
    band_rows: int
    along_z: Floats  # mean square steps of the grey level over 2 px, of every second row
    along_x: Floats
    picture: Floats32  # mean of the frames, every second row and column
    settings: VideoSettings

    @property
    def starts(self) -> Ints:
        """First column of each segment along x."""
        return segment_starts(self.mean.shape[-1], self.settings.segment_px)

    @cached_property
    def power(self) -> Floats32:
        """Power of the slopes in each segment along x, without white noise, (band, segment)."""
        return np.add.reduceat((self.mean**2 - self.difference**2).sum(axis=0), self.starts, axis=-1)

    def part(self, first: int, last: int) -> _Slopes:
        """Return the slopes of some bands."""
        bands = np.s_[:, first:last]
        return replace(self, mean=self.mean[bands], difference=self.difference[bands])


def find_strip(
    video: Video, *, columns: slice | None = None, settings: VideoSettings = VideoSettings()
) -> Strip:
    r"""Find the strip: as many rows as possible whose mean profile has steep ridges.

    Parameters
    ----------
    video
        From `open_video`; `settings.sample_frames` of its frames are examined.
    columns
        Half-open, px, after rotation; all by default.
    settings
        See `VideoSettings`.

    Returns
    -------
    Strip
        The whole height, with how = "all rows", if no rows agree on any ridges.

    Raises
    ------
    InputError
        For columns outside the frame.

    Notes
    -----
    Slopes along x are averaged over the odd rows (:math:`o_b`) and the even rows (:math:`e_b`) of each band
    :math:`b`. For every run of :math:`h` bands the power of the mean slope, without white noise, is computed
    in each segment :math:`s` along x,

    .. math::
        P_s = \frac{1}{h^2} \sum_{t,\, x \in s} \left[ \left(\sum_b \frac{o_b + e_b}{2}\right)^2
              - \sum_b \left(\frac{o_b - e_b}{2}\right)^2 \right]

    and the run with the largest :math:`\sqrt h \, \langle \min(P_s, P_{65\%}) \rangle_s` is chosen. It is
    largest where ridges are clear, straight and upright: tilted or bowed ridges blur the mean, clamps and
    black rows dilute it. The contribution of a segment is limited to that of usual segments with ridges, so
    that labels and marks gain nothing by their strong edges. Brightness, pitch and polarity do not matter.

    Of that run the bands are retained whose mean gives positions with the smallest error (`best_rows`). Rows
    in which the ridges are displaced (bowed, shaded, at the frame's edge) are left out if their bias is
    larger than the noise that they save. Bands with text, such as the time of day that cameras write into
    the picture, are left out before (`_text_bands`), if others show ridges.
    """
    height, width = video.shape
    x = cut(columns, width, what=f"{video.path}: `columns`")
    band_rows = max(2, round(height / settings.bands))
    if height < 2 * band_rows:
        return Strip(slice(0, height), "all rows")
    slopes = _slopes_of(video, slice(0, height), x, band_rows, settings)
    text = _text_bands(slopes)
    best = _best_run(slopes, text) or _best_run(slopes)
    if best is None:
        whole = slice(0, height)
        return Strip(whole, "all rows", warnings=_level_warnings(slopes, whole, video))
    best = _prefer_moving(slopes, best)
    tilt = tilt_px(slopes.mean[:, best[0] : best[1]])
    first, last = _agreeing(slopes, *best, tilt)
    bottom = height if last == slopes.mean.shape[1] else last * band_rows
    rows = slice(first * band_rows, bottom)
    bands = slopes.mean[:, first:last]
    if strip_errors(row_shifts(bands, tilt, settings), settings).bow_px > settings.least_bias_px:
        rows = _without_edges(rows, height, settings)
    first, last = -(-rows.start // band_rows), max(rows.stop // band_rows, first + 1)
    first = min(first, last - 1)
    strip = _described(slopes, first, last, Strip(rows, "found"), tilt)
    level = _level_warnings(slopes, slice(best[0] * band_rows, best[1] * band_rows), video)
    return replace(strip, warnings=(*strip.warnings, *_text_warnings(rows, text[first:last]), *level))


def _level_warnings(slopes: _Slopes, rows: slice, video: Video) -> tuple[str, ...]:
    """Return a warning if grey levels in these rows change along z rather than along x.

    They must do so both from pixel to pixel and over the whole height: the texture of wide sheets does only
    the former, dead rows only the latter. The outer bands do not count: a comb may end there before a dark
    background.
    """
    rows, edge = slice(rows.start // 2, rows.stop // 2), max(1, slopes.band_rows // 2)
    if rows.stop - rows.start > 2 * edge:
        rows = slice(rows.start + edge, rows.stop - edge)
    along_z, along_x = float(slopes.along_z[rows].mean()), float(slopes.along_x[rows].mean())
    level, upright = (np.ptp(np.quantile(slopes.picture.mean(axis=axis), (0.1, 0.9))) for axis in (1, 0))
    if along_z <= slopes.settings.max_level * along_x or not along_x or 2 * level < upright:
        return ()
    return (
        f"grey levels change {math.sqrt(along_z / along_x):.1f} times as much from row to row as along the "
        "rows: the ridges may be horizontal, one above the other; if so, give `rotate` "
        f"{(video.rotate + 90) % 180}",
    )


def _text_warnings(rows: slice, text: Bools) -> tuple[str, ...]:
    """Return a warning if some bands of these rows show text, (band,)."""
    if not text.any():
        return ()
    band_rows = (rows.stop - rows.start) / text.size
    first, last = np.flatnonzero(text)[[0, -1]]
    top, bottom = rows.start + int(first * band_rows), rows.start + math.ceil((last + 1) * band_rows)
    return (f"text or marks cover ridges in rows {top}:{bottom}: choose `rows` without them",)


def _without_edges(rows: slice, height: int, settings: VideoSettings) -> slice:
    """Return the rows without those near the frame's upper and lower edge, but all rows of a low frame."""
    if height < settings.edge_height:
        return rows
    margin = round(settings.edge_share * height)
    kept = slice(max(rows.start, margin), min(rows.stop, height - margin))
    return kept if kept.stop - kept.start >= (rows.stop - rows.start) / 2 else rows


def measure_strip(
    video: Video, rows: slice, *, columns: slice | None = None, settings: VideoSettings = VideoSettings()
) -> Strip:
    """Return the strip of the given rows with its tilt and clarity, both NaN for fewer than four rows.

    Raises: InputError for rows or columns outside the frame.
    """
    height, width = video.shape
    z = cut(rows, height, what=f"{video.path}: `rows`")
    x = cut(columns, width, what=f"{video.path}: `columns`")
    count = z.stop - z.start
    if count < 4:
        return Strip(z, "given", clarity=math.nan)
    slopes = _slopes_of(video, z, x, max(2, round(count / settings.bands)), settings)
    strip = _described(slopes, 0, slopes.mean.shape[1], Strip(z, "given"))
    return replace(strip, warnings=(*strip.warnings, *_text_warnings(z, _text_bands(slopes))))


def _described(slopes: _Slopes, first: int, last: int, strip: Strip, tilt: float | None = None) -> Strip:
    """Return the strip with tilt, clarity, and warnings of strongly tilted ridges and unequal rows.

    tilt: shift from band to band, px, if it is known from more rows than those of the strip.
    """
    bands = slopes.mean[:, first:last]
    clarity = _clarity(slopes, first, last)
    if clarity < slopes.settings.min_clarity:
        return replace(strip, clarity=clarity)
    height = strip.rows.stop - strip.rows.start
    per_band = tilt_px(bands) if tilt is None else tilt
    per_row = per_band / slopes.band_rows
    smear, ridge = abs(per_row) * height, ridge_width_px(bands.mean(axis=1))
    tilt_deg = float(np.degrees(np.arctan(per_row)))
    errors = strip_errors(row_shifts(bands, per_band, slopes.settings), slopes.settings)
    warnings = []
    if smear > slopes.settings.max_smear * ridge:
        tilted = with_minus(f"{tilt_deg:+.2f}")
        warnings.append(
            f"ridges are tilted by {tilted}°, {smear:.1f} px over the {height} rows of the strip, and "
            f"are about {ridge:.0f} px wide: turn the camera, or choose fewer rows (`rows`)"
        )
    if errors.error_px > slopes.settings.strip_warning_px:
        warnings.append(
            f"positions depend on the rows averaged: {errors.error_px:.2f} px with a fifth of them left out, "
            f"{errors.halves_px:.2f} px between the strip's upper and lower half, {errors.bow_px:.2f} px "
            "between its outer and inner half; bowed ridges or a shadow: look at the frame, or choose fewer "
            "rows (`rows`)"
        )
    return Strip(strip.rows, strip.how, tilt_deg, clarity, tuple(warnings), errors)


def _agreeing(slopes: _Slopes, first: int, last: int, tilt: float) -> tuple[int, int]:
    """Return the part of a run of bands in which ridges agree in position, if that reduces the error."""
    bands = slopes.mean[:, first:last]
    width_px = ridge_width_px(bands.mean(axis=1))
    if not width_px > 0:
        return first, last
    ridges, whole = max(1.0, 2 * slopes.settings.segment_px / (2.5 * width_px)), (0, last - first)
    for _ in range(2):  # displaced rows also spoil the tilt: repeat with that of the other rows
        shifts = row_shifts(bands, tilt, slopes.settings)
        begin, end = whole if shifts is None else best_rows(shifts, ridges, slopes.settings)
        if (begin, end) == whole:
            break
        tilt = tilt_px(bands[:, begin:end])
    return first + begin, first + end


def _text_bands(slopes: _Slopes) -> Bools:
    """Return which bands show text over the picture, such as the time of day, (band,).

    Ridges run through many bands, text through few. What a band shows beyond the pattern that all bands share
    is text if its power is several times the pattern's usual power, and larger than the pattern's own power
    in this band (where ridges are in sharp focus, both are large), in two segments or more; and in the bands
    beside, where it is in one. In a narrow picture one segment is enough. Ridges at another place, because
    they are tilted or bowed, are not stronger than usual. Nothing is text where the bands of most segments
    share no pattern.
    """
    power, shown = np.maximum(slopes.power.T.astype(np.float64), 1e-12), _shows_ridges(slopes)
    along, edges = np.zeros(power.shape), [*slopes.starts.tolist(), slopes.mean.shape[-1]]
    for k, (first, last) in enumerate(itertools.pairwise(edges)):
        if shown[k]:
            along[k] = _power_of_shared_pattern(slopes.mean[..., first:last])
    shared = np.median(along[shown] / power[shown], axis=1)
    if not shown.any() or np.median(shared) <= slopes.settings.shared_pattern:
        return np.zeros(power.shape[1], bool)
    usual = np.quantile(np.median(along[shown], axis=1), slopes.settings.segment_cap)
    beyond = power - along
    steep = (beyond > slopes.settings.label_power * usual) & (beyond > along)
    faint = steep.any(axis=0)
    certain = steep.sum(axis=0) >= (2 if shown.size > slopes.settings.few_segments else 1)
    run = np.cumsum(~faint)
    text = faint & np.isin(run, run[certain])
    near = text.copy()  # it may begin or end within the next band
    near[1:] |= text[:-1]
    near[:-1] |= text[1:]
    return np.asarray(near, bool)


def _power_of_shared_pattern(bands: Floats32) -> Floats:
    """Return the power in each band of what all bands (frame, band, x) share, (band,).

    It is the first eigenvector of the matrix of their scalar products, each band at most as strong as the
    median one, so that text, which is far steeper than ridges, does not decide.
    """
    part = bands.swapaxes(0, 1).reshape(bands.shape[1], -1).astype(np.float64)
    size = np.linalg.norm(part, axis=1)
    alike = part * (np.minimum(size, np.median(size)) / np.maximum(size, 1e-6))[:, None]
    products, weight = alike @ alike.T, np.ones(len(part))
    for _ in range(20):  # they converge to the first eigenvector, faster than all are computed
        weight = products @ weight
        weight /= max(float(np.linalg.norm(weight)), 1e-12)
    pattern = weight @ alike
    return np.asarray((part @ pattern) ** 2 / max(float(pattern @ pattern), 1e-12), np.float64)


def _slopes_of(video: Video, rows: slice, columns: slice, band_rows: int, settings: VideoSettings) -> _Slopes:
    """Measure the slopes of the bands in sampled frames, or in the first ones if a file cannot be sampled."""
    count = settings.sample_frames
    frames = list(video.sample(count)) or list(itertools.islice(video.frames(), count))
    if not frames:
        found = "none: they cannot be decoded"
        raise InputError(video.path, "at least one frame that shows something", found, "copy the file again")
    bands = (_odd_even(frame[rows, columns], band_rows) for frame in frames)
    odd, even = np.stack([_slope(halves, settings.slope_sigma_px) for halves in bands], axis=1)
    half = np.float32(0.5)
    thinned = [_known(frame[rows, columns][::2, ::2]) for frame in frames]
    along_z, along_x = np.mean([_steps(pixels) for pixels in thinned], axis=0)
    picture = np.mean(thinned, axis=0)
    return _Slopes((odd + even) * half, (odd - even) * half, band_rows, along_z, along_x, picture, settings)


def _steps(pixels: Floats32) -> Floats:
    """Return mean square steps along z and x of every second pixel, unlike interlaced fields, (2, row)."""
    along_z, along_x = np.diff(pixels, axis=0, append=pixels[-1:]), np.diff(pixels, axis=1)
    return np.stack([np.einsum("zx,zx->z", steps, steps) / steps.shape[1] for steps in (along_z, along_x)])


def _odd_even(frame: Pixels, band_rows: int) -> Floats32:
    """Return means of each band's odd and even rows, (2, band, x), without rows that do not fill a band."""
    bands = frame.shape[0] // band_rows
    pixels = _known(frame[: bands * band_rows]).reshape(bands, band_rows, -1)
    return np.stack([pixels[:, 0::2].mean(axis=1), pixels[:, 1::2].mean(axis=1)])


def _known(frame: Pixels) -> Floats32:
    """Return grey levels in single precision, 0 where unknown."""
    pixels = np.asarray(frame, np.float32)
    if frame.dtype.kind == "f":  # NaN would spoil the means; single precision cannot square 1e20
        pixels = np.where(np.abs(pixels) < 1e15, pixels, np.float32(0))
    return pixels


def _slope(bands: Floats32, sigma_px: float) -> Floats32:
    """Return the Gaussian-smoothed derivative along x of means (2, band, x), with edge pixels repeated."""
    reach = int(4 * sigma_px + 0.5)
    offsets = np.arange(1, reach + 1, dtype=np.float64)
    gaussian = np.exp(-(offsets**2) / (2 * sigma_px**2))
    weights = gaussian / (1 + 2 * gaussian.sum()) * offsets / sigma_px**2
    width = bands.shape[-1]
    padded = np.pad(bands.astype(np.float64), ((0, 0), (0, 0), (reach, reach)), mode="edge")
    slope, step = np.zeros(bands.shape), np.empty(bands.shape)
    for k in range(reach, 0, -1):  # differences, so that a constant has exactly no slope
        right, left = padded[..., reach + k : reach + k + width], padded[..., reach - k : reach - k + width]
        np.subtract(right, left, out=step)
        step *= weights[k - 1]
        slope += step
    return slope.astype(np.float32)


def _best_run(slopes: _Slopes, without: Bools | None = None) -> tuple[int, int] | None:
    """Return the half-open run of bands with the highest score, none of which is in `without` (band,).

    None if no score is above zero.
    """
    bands, starts = slopes.mean.shape[1], slopes.starts
    sums = np.concatenate([np.zeros_like(slopes.mean[:, :1]), np.cumsum(slopes.mean, axis=1)], axis=1)
    noise = np.add.reduceat((slopes.difference**2).sum(axis=0), starts, axis=-1)
    noise_sums = np.concatenate([np.zeros_like(noise[:1]), np.cumsum(noise, axis=0)])
    with_ridges = _shows_ridges(slopes)
    best, score = None, 0.0
    if not with_ridges.any():
        return None
    barred = np.flatnonzero(np.zeros(bands) if without is None else without)
    stops = np.append(barred, bands)[np.searchsorted(barred, np.arange(bands))]
    for first, stop in enumerate(stops):
        if stop == first:
            continue
        count, ends = np.arange(1, stop - first + 1)[:, np.newaxis], slice(first + 1, stop + 1)  # all at once
        total = ((sums[:, ends] - sums[:, first : first + 1]) ** 2).sum(axis=0)
        power = np.add.reduceat(total, starts, axis=-1) - (noise_sums[ends] - noise_sums[first])
        each = np.maximum(power / count**2, 0.0)
        cap = np.quantile(each[:, with_ridges], slopes.settings.segment_cap, axis=1, keepdims=True)
        scores = np.minimum(each, cap).mean(axis=1) * count[:, 0] ** slopes.settings.height_power
        last = first + int(np.argmax(scores)) + 1
        highest = float(scores[last - first - 1])
        if highest > score and _clarity(slopes, first, last) >= slopes.settings.min_clarity:
            best, score = (first, last), highest
    return best


def _prefer_moving(slopes: _Slopes, best: tuple[int, int]) -> tuple[int, int]:
    """Return the best run above or below this one if it moves and this one is stationary, like a ruler.

    A run with ridges in far fewer segments along x, such as text that changes, is no comb.
    """
    bands = slopes.mean.shape[1]
    own, wide = _change(slopes, *best), _shows_ridges(slopes.part(*best)).sum()
    moves, chosen = max(slopes.settings.moving_change, slopes.settings.moving_ratio * own), best
    for first, last in ((0, best[0]), (best[1], bands)):
        part = slopes.part(first, last)
        run = _best_run(part) if last > first else None
        if run is None or _shows_ridges(part.part(*run)).sum() < wide / 2:
            continue
        if (change := _change(part, *run)) > moves:
            moves, chosen = change, (first + run[0], first + run[1])
    return chosen


def _change(slopes: _Slopes, first: int, last: int) -> float:
    """Return the power of changes between frames over that of the slope, without noise and brightness."""
    mean, noise = (part[:, first:last].mean(axis=1) for part in (slopes.mean, slopes.difference))
    size = np.linalg.norm(mean, axis=1, keepdims=True)
    mean, noise = (part / np.maximum(size, 1e-9) for part in (mean, noise))
    return max(0.0, float(mean.var(axis=0, ddof=min(1, len(mean) - 1)).sum() - (noise**2).sum(axis=1).mean()))


def _shows_ridges(slopes: _Slopes) -> Bools:
    """Return which segments show ridges in many rows."""
    usual = np.quantile(slopes.power, slopes.settings.ridge_rows, axis=0)
    return np.asarray(usual >= slopes.settings.ridge_share * np.sort(usual)[-min(3, usual.size)], bool)


def _clarity(slopes: _Slopes, first: int, last: int) -> float:
    """Return the correlation of the mean slopes of odd and even rows; 0 without any slope."""
    signal = float((slopes.mean[:, first:last].mean(axis=1) ** 2).sum())
    noise = float((slopes.difference[:, first:last].mean(axis=1) ** 2).sum())
    return max(0.0, (signal - noise) / (signal + noise)) if signal > 0 else 0.0


# --- displacement of the ridges from row to row: tilt, bows, shadows ----------------------------------------


def tilt_px(bands: NDArray[np.floating]) -> float:
    """Return the shift of the ridges along x from one band to the next, px, positive to the right downwards.

    It is the median over segments along x, so that labels and ridges bowed apart do not count. In each, bands
    (frame, band, x) are shifted in proportion to their height until their sum is strongest. Of several
    maxima, a pitch apart, the smallest tilt is used. Tilts beyond 12 px over all bands are not found.
    """
    count, width = bands.shape[1:]
    if count < 2:
        return 0.0
    parts = np.array_split(bands, max(1, width // 256), axis=-1)  # each wider than the widest pitch
    return float(np.median([_tilt_of_segment(part) for part in parts]) / (count - 1))


def _tilt_of_segment(bands: NDArray[np.floating]) -> float:
    """Return the shift from the first band to the last: the best trial, refined by a parabola."""
    frequency, height = np.fft.rfftfreq(bands.shape[-1]), np.linspace(-0.5, 0.5, bands.shape[1])
    step = 0.5
    trials = np.arange(-12, 12 + step / 2, step)
    turn = 2j * np.pi * np.outer(height, frequency)
    moved = np.fft.rfft(bands - bands.mean(axis=-1, keepdims=True), axis=-1) * np.exp(trials[0] * turn)
    one_step = np.exp(step * turn)
    power = np.empty(trials.size)
    for trial in range(trials.size):  # each moves the bands back by one more step
        power[trial] = (np.abs(moved.sum(axis=1)) ** 2).sum()
        moved *= one_step
    inner = power[1:-1]
    peaks = np.flatnonzero((inner >= power[:-2]) & (inner > power[2:])) + 1
    if not peaks.size:
        return float(trials[np.argmax(power)])
    best = int(peaks[np.argmin(np.abs(trials[peaks]))])
    return float(trials[best] + step * peak_offset(*power[best - 1 : best + 2]))


def ridge_width_px(slopes: NDArray[np.floating]) -> float:
    """Return the full width of a typical ridge at half height, px, from slopes along x (frame, x).

    The autocorrelation of slopes has its first minimum where one flank of a ridge meets the other, for a
    Gaussian at sqrt(6)/2.355 = 1.04 of the width, which includes the smoothing. NaN if there is no minimum.
    """
    power = np.abs(np.fft.rfft(slopes, n=2 * slopes.shape[-1], axis=-1)) ** 2
    correlation = np.fft.irfft(power.sum(axis=0))[: slopes.shape[-1] // 2]
    rising = np.flatnonzero(np.diff(correlation) > 0)
    return float(rising[0]) / 1.04 if rising.size else math.nan


@dataclass(frozen=True)
class RowShifts:
    """Displacement of the ridges in each band of rows against the bands in the middle."""

    shift_px: Floats  # along x, without the common tilt and that of the segment, (band, segment)
    strength: Floats  # of the ridges in each band, 1 in the middle, (band,)
    noise_px: float  # standard deviation of one band's displacement in one segment and frame, at strength 1
    frames: int  # over which the mean is taken


def row_shifts(bands: NDArray[np.floating], tilt: float, settings: VideoSettings) -> RowShifts | None:
    r"""Measure the displacement of the ridges in each band of rows against the mean of the middle half.

    Return None for fewer bands (frame, band, x) than `settings.least_bands`, or no ridges. The tilt, px from
    one band to the next, is subtracted. With the mean slope :math:`m(x)` of the middle bands of a frame, a
    band whose ridges are displaced by :math:`d` and :math:`a` times as strong shows :math:`a\, m(x - d)`, so

    .. math:: a = \frac{\sum_x b\, m}{\sum_x m^2}, \qquad d = -\frac{\sum_x (b - a m)\, m'}{a \sum_x m'^2}

    in each segment along x. d is linear up to about a third of a ridge's width and too small beyond.
    """
    frames, count, width = bands.shape
    if count < settings.least_bands:
        return None
    height = np.arange(count) - (count - 1) / 2
    spectrum = np.fft.rfft(bands, axis=-1)
    back = np.exp(2j * np.pi * np.outer(tilt * height, np.fft.rfftfreq(width)))
    upright = np.fft.irfft(spectrum * back, n=width, axis=-1)
    middle = slice(count // 4, count - count // 4)
    mean = upright[:, middle].mean(axis=1)
    rise = np.gradient(mean, axis=-1)
    starts = segment_starts(width, 2 * settings.segment_px)
    power, steep = _sums(mean**2, starts), _sums(rise**2, starts)  # (frame, segment)
    shows = np.median(power, axis=0) >= settings.ridge_share * np.sort(np.median(power, axis=0))[-1]
    if not shows.any() or not (power[:, shows] > 0).all() or not (steep[:, shows] > 0).all():
        return None
    power, steep = power[:, None, shows], steep[:, None, shows]
    strength = _sums(upright * mean[:, None], starts)[..., shows] / power
    across = _sums(upright * rise[:, None], starts)[..., shows]
    even = _sums(mean * rise, starts)[:, None, shows]
    weak = np.maximum(strength, settings.least_strength)
    shift = -(across - strength * even) / (weak * steep)
    usual = np.clip(np.median(strength, axis=(0, 2)), 0.0, None)
    spread = shift[:, middle].std(axis=0, ddof=1) if frames > 1 else np.zeros_like(shift[0, middle])
    noise = float(np.median(spread * usual[middle, None]))
    mean_shift, inner = shift.mean(axis=0), height[middle]
    slope = (inner @ mean_shift[middle]) / (inner @ inner)  # of each segment's straight line
    upright_px = mean_shift - mean_shift[middle].mean(axis=0) - height[:, None] * slope
    return RowShifts(np.asarray(upright_px, np.float64), usual, noise, frames)


def segment_starts(width: int, segment_px: int) -> Ints:
    """Return the first column of each of the segments of about this width along x."""
    return np.linspace(0, width, max(1, width // segment_px) + 1).astype(np.int64)[:-1]


def _sums(values: NDArray[np.floating], starts: Ints) -> Floats:
    return np.asarray(np.add.reduceat(values, starts, axis=-1), np.float64)


def best_rows(shifts: RowShifts, ridges_in_segment: float, settings: VideoSettings) -> tuple[int, int]:
    r"""Return the half-open run of bands whose mean has the smallest error, noise and bias together.

    Rows of ridges with a smooth bow are retained: their mean position is well defined. Rows that depart from
    a smooth bow (a shadow, a clamp, a damaged edge) may be left out. For n bands of strengths :math:`a_b`,
    noise :math:`\sigma` and displacements :math:`d_{bs}` from the parabola that most bands of a segment lie
    on, and about k ridges in a segment,

    .. math::
        E^2 = \frac{k\, n\, \sigma^2}{(\sum_b a_b)^2}
            + \left\langle \left(\frac{\sum_b a_b d_{bs}}{\sum_b a_b}\right)^2 \right\rangle_s

    less what the noise of d adds to the second term. The whole run is retained unless another run has a
    clearly smaller :math:`E`, and the whole run's bias exceeds `settings.least_bias_px` and the noise.
    """
    a, d = shifts.strength, _beside_parabola(shifts)
    count = len(a)
    weight = np.concatenate([[0.0], np.cumsum(a)])
    moved = np.concatenate([np.zeros((1, d.shape[1])), np.cumsum(a[:, None] * d, axis=0)])
    bands = np.maximum(0, np.arange(count + 1) - np.arange(count + 1)[:, None])  # by first band and end
    light = weight - weight[:, None]
    possible = (bands >= max(2, count // 4)) & (light > 0)
    light = np.where(possible, light, 1.0)
    noise = bands * (shifts.noise_px / light) ** 2
    bias = (((moved - moved[:, None]) / light[..., None]) ** 2).mean(axis=-1)
    error = np.sqrt(ridges_in_segment * noise + np.maximum(0.0, bias - noise / shifts.frames))
    first, last = np.unravel_index(np.argmin(np.where(possible, error, np.inf)), error.shape)
    all_noise, all_bias = noise[0, count], bias[0, count]
    harmless = max(settings.least_bias_px**2, settings.significant_rows**2 * all_noise / shifts.frames)
    whole = math.sqrt(ridges_in_segment * all_noise + all_bias)
    if all_bias < harmless or error[first, last] >= settings.worth_trimming * whole:
        return 0, count
    return int(first), int(last)


def _beside_parabola(shifts: RowShifts) -> Floats:
    """Return displacements (band, segment) from each segment's parabola, fitted without outliers."""
    height = np.linspace(-1, 1, len(shifts.strength))
    basis = np.stack([np.ones_like(height), height, height**2], axis=1)
    residual = np.empty_like(shifts.shift_px)
    for segment, d in enumerate(shifts.shift_px.T):
        weight = (np.abs(height) <= 0.6).astype(np.float64)  # the ends have most leverage and most outliers
        for _ in range(10):
            fit = np.linalg.lstsq(basis * weight[:, None], d * weight, rcond=None)[0]
            residual[:, segment] = off = d - basis @ fit
            usual = max(float(sigma_about_zero(off)), 1e-9)
            weight = np.clip(1 - (off / (4 * usual)) ** 2, 0.0, None)  # Tukey's biweight
    return residual


def strip_errors(shifts: RowShifts | None, settings: VideoSettings) -> StripErrors:
    """Return how much positions depend on the choice of rows; 0 where this is within the noise."""
    if shifts is None:
        return StripErrors()
    count = len(shifts.strength)
    upper, distance = np.arange(count) < count // 2, np.abs(np.arange(count) - (count - 1) / 2)
    outer, ends = distance >= count / 4, distance >= 0.4 * count
    halves, bow, end = (_beyond_noise(shifts, part, settings) for part in (upper, outer, ends))
    return StripErrors(halves, bow, float(shifts.strength[ends].sum() / shifts.strength.sum()) * end)


def _beyond_noise(shifts: RowShifts, part: NDArray[np.bool_], settings: VideoSettings) -> float:
    """Return the RMS difference over the segments between two parts of the bands, without noise.

    The tenth of the segments that differ most (a label, a mark) is left out.
    """
    sides = part, ~part
    light = [shifts.strength[side].sum() for side in sides]
    if min(light) <= 0:
        return 0.0
    one, other = (shifts.strength[s] @ shifts.shift_px[s] / a for s, a in zip(sides, light, strict=True))
    noise = shifts.noise_px**2 * sum(s.sum() / a**2 for s, a in zip(sides, light, strict=True))
    squares = np.sort((one - other) ** 2)
    mean = float(squares[: max(1, math.ceil(0.9 * squares.size))].mean())
    expected = noise / shifts.frames
    return math.sqrt(mean - expected) if mean > settings.significant_rows**2 * expected else 0.0
