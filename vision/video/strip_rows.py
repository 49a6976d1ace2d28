"""How ridges are displaced from row to row, tilted, bowed or shaded, and what that does to positions.

Slopes are those along x of bands of rows in some frames, (frame, band, x), as `strip_find` measures them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.numeric import Floats, Ints, peak_offset, sigma_about_zero
from vision.video.settings import VideoSettings


class StripErrors(NamedTuple):
    """Dependence of positions on the choice of rows, px, without tilt and noise; 0 if not significant.

    halves_px, bow_px: RMS difference of positions from the upper and the lower half, and from the outer and
    the inner half. error_px: RMS displacement of the mean if a tenth of the rows were left out at both ends,
    which is an equally good choice; as it does not vary with time, it is a systematic error.
    """

    halves_px: float = 0.0
    bow_px: float = 0.0
    error_px: float = 0.0


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


# --- agreement of the rows on the positions of the ridges, which bows, shadows and edges spoil --------------


@dataclass(frozen=True)
class RowShifts:
    """Displacement of the ridges in each band of rows against the bands in the middle.

    shift_px: along x, without the common tilt and the tilt of the segment, (band, segment), mean over
    `frames` frames. strength: of the ridges in each band, 1 in the middle, (band,). noise_px: standard
    deviation of one band's displacement in one segment and frame, at strength 1.
    """

    shift_px: Floats
    strength: Floats
    noise_px: float
    frames: int


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
