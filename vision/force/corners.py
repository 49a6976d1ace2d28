"""Where each slip begins and ends: corners between the stick lines, and the recorded extremes around it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.legendre import legvander

from vision.force.lines import fit_broken_lines, fit_polynomials
from vision.force.settings import ForceSettings
from vision.force.signal import Signal
from vision.force.slips import Slips, stick_lines, stick_middles
from vision.numeric import Bools, Floats, Ints, Rows, flat_ranges, mad_sigma, nan_median
from vision.signals import running_mean

# The 90 % and 10 % crossings lie at these shares of half the slip's length from its middle: 0.59 for half a
# cosine, the slip of a spring-block, and 0.8 for a straight fall.
_HALF_COSINE, _STRAIGHT = 0.59, 0.8
# Width of one mean after which the crossings of a sudden drop are as far apart as after two of width 1.
_TWICE = 1.38
# Error of a corner in samples: it may lie anywhere between two, in 68 % of the cases so close to the middle.
BETWEEN_SAMPLES = 0.34
# Error of a corner, as a share of the time over which the load is averaged: a slip of two fifths of it looks
# like a sudden one.
AVERAGE_ERROR = 0.2

# --- corners ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SlipTransients(Rows):
    """The stretch after each slip, in which a low-pass leaves a transient; all in samples."""

    start: Ints  # of half-open ranges clear of slips
    stop: Ints
    middle: Floats  # of the slip as recorded
    valley: Floats  # end of the slip
    peak: Floats  # where the next slip begins
    drop: Floats  # the slip's height


@dataclass(frozen=True)
class Corners:
    """Begin (peak) and end (valley) of each slip, in samples, fractions included; and how they were found."""

    peak: Floats
    valley: Floats
    middle: Floats  # where the load has fallen half-way
    drop: Floats  # difference of the stick lines before and after
    error: Floats  # standard error of the position of a corner
    knee: Floats  # position of the knee in each stick, one more than slips; NaN for none
    shape: Shape  # of the sticks without a knee
    # How many times further from the middle 90 and 10 % of the drop are than 75 and 25 %: the medians before
    # and after the middle, (2,). 1.77 for half a cosine, 1.6 for a straight fall, 1.9 for several means.
    tails: Floats
    lowpass: float  # time constant that is corrected for, in samples; 0 for none
    two_slopes: bool  # whether the lines of the sticks may have a knee

    @property
    def length(self) -> Floats:
        """Samples from the begin to the end of each slip."""
        return self.valley - self.peak

    @property
    def onset(self) -> Floats:
        """Samples from the begin to the middle of each slip."""
        return self.middle - self.peak

    @property
    def end(self) -> Floats:
        """Samples from the middle to the end of each slip."""
        return self.valley - self.middle

    def transients(self) -> SlipTransients:
        """Return the stretches between slips, clear of them, in which a low-pass leaves its transients."""
        # A low-pass delays the end of a slip but not its onset, so the onset gives the slip's length.
        half = np.maximum(1.2 * self.onset, 1.0)
        return SlipTransients(
            start=np.ceil(self.middle + half).astype(np.int64)[:-1],
            stop=np.floor(self.middle - half).astype(np.int64)[1:],
            middle=self.middle[:-1],
            valley=self.valley[:-1],
            peak=self.peak[1:],
            drop=self.drop[:-1],
        )


def find_corners(
    signal: Signal,
    slips: Slips,
    *,
    lowpass: float = 0.0,
    two_slopes: bool = False,
    settings: ForceSettings = ForceSettings(),
) -> Corners:
    """Return the begin (peak) and end (valley) of each slip, clipped to the recording.

    `lowpass` is the time constant, in samples, to correct for. The load falls from the stick line before the
    slip, 100 %, to the one after it, 0 %. The times at 90, 50 and 10 %, scaled as for half a cosine, give
    begin and end. With `two_slopes` the stick lines may have a knee.
    """
    seen = _deconvolve(signal, slips, lowpass)
    base = _Baselines.of(seen, two_slopes, settings)
    middle, halves, inner = _crossings(seen.load, seen.edge, base)
    stick = np.diff(seen.edge)
    length = 2 * nan_median(np.fmin(*halves))
    if stick.size and length < settings.shape_slip * np.median(stick):
        # Slow noise explains that the curvatures of the sticks scatter: they then count as bent alike.
        shape = Shape.of(seen.load, seen.edge, signal.slow is not None, settings)
        if shape.errors.any():
            base = _Baselines.of(seen, two_slopes, settings, shape)
            middle, halves, inner = _crossings(seen.load, seen.edge, base)
    clear = base.drop > 20 * seen.sigma
    with np.errstate(divide="ignore", invalid="ignore"):
        tails = nan_median(np.where(clear | ~clear.any(), halves / inner, np.nan), axis=1)
    interpolated = signal.is_missing[seen.edge] | signal.is_missing[seen.edge - 1]
    (before, after), usual, gradual = _half_lengths(seen, base, halves, interpolated, settings)
    # The position of a corner errs by the noise over the slip's slope, by the sampling, and by its shape.
    systematic = np.hypot(BETWEEN_SAMPLES, np.hypot(settings.shape_error, gradual) * usual)
    systematic = np.hypot(systematic, AVERAGE_ERROR * seen.averaged)
    steepest = np.pi / 2 * np.maximum(base.drop, seen.sigma) / max(usual, seen.width)
    middle = middle - seen.late
    last = seen.load.size - 1.0
    return Corners(
        peak=np.clip(middle - before, 0, last),
        valley=np.clip(middle + after, 0, last),
        middle=middle,
        drop=base.drop,
        knee=base.knee - seen.late,
        shape=base.shape,
        error=np.hypot(seen.sigma / steepest, systematic),
        tails=tails,
        lowpass=lowpass,
        two_slopes=two_slopes,
    )


def _half_lengths(
    seen: _DeconvolvedLoad, base: _Baselines, halves: Floats, interpolated: Bools, settings: ForceSettings
) -> tuple[Floats, float, float]:
    """Return how long each slip lasts before and after its middle, (2, slip); the usual whole length; and by
    which share of it the usual slip may begin earlier than half a cosine does, where friction falls gradually
    with the speed.

    `halves` are the samples from 90 to 50 % and from 50 to 10 % of the drop. The individual length of a slip
    is used where its drop exceeds 20 sigma and no sample beside it is `interpolated`, unless it is slow; else
    the median of the recording. Where the median is too short to be resolved, slips count as half as long as
    they appear on average, but slow ones keep their own length.
    """
    # Sampling and smoothing widen even a sudden drop: its 90 % and 50 % crossings are 0.4 samples apart, and
    # more where deconvolution leaves a sample part of the way down. This blur is subtracted in squares.
    blur = np.hypot(0.4 * seen.width, 0.5 if seen.late else 0.0)
    halves = np.sqrt(np.maximum(halves**2 - blur**2, 0.0))
    # A single slow slip among sudden ones has its own length. A drift lengthens one half of a sudden one.
    sticks = np.diff(np.r_[0, seen.edge, seen.load.size])
    slow = 2 * halves.min(axis=0) > _HALF_COSINE * settings.slow_slip * np.minimum(sticks[:-1], sticks[1:])
    halves = np.where(slow | ~interpolated, halves, np.nan)
    usual = np.nan_to_num(nan_median(halves, axis=1))[:, np.newaxis]
    clear = base.drop > 20 * seen.sigma  # noise scatters the lengths of smaller slips
    clear &= np.isfinite(halves).all(axis=0)
    # In averages, sticks that begin steeply look like slips of half the averaged time.
    if usual.sum() < max(1.0, 0.2 * seen.averaged):
        # Not resolved: few slips have a sample within, so that the mean tells the length, not the median.
        # Half of it may come from the sampling, or from a low-pass too short to detect.
        several = halves.sum(axis=0)[clear & ~slow]
        mean = np.minimum(several, 2.0).mean() if several.size else usual.sum()
        usual = np.full((2, 1), 0.25 * mean)
        halves = np.where(slow, halves, usual)
    halves[1] = np.where(slow, halves[1], np.minimum(halves[1], 2 * usual[1]))
    halves = np.where(clear, halves, usual)
    length = float(usual.sum()) / _HALF_COSINE
    gradual = float(np.log(np.maximum(usual[0], 1e-9) / np.maximum(usual[1], 1e-9))[0])
    return _half_from_crossing(halves, base.slope, base.drop), length, min(max(gradual, 0.0), 0.5)


@dataclass(frozen=True)
class _DeconvolvedLoad:
    """A load corrected for the low-pass of the load cell."""

    load: Floats  # running mean over `width` samples, since deconvolution amplifies the noise
    edge: Ints  # the first sample after the steepest drop of each slip
    late: float  # samples by which `load` lags behind the time
    width: float  # samples averaged
    sigma: float  # noise of `load`
    averaged: float = 0.0  # samples over which the recording itself was averaged


def without_lowpass(y: Floats, tau: float) -> tuple[Floats, float]:
    r"""Return the load z before a first-order low-pass of `tau` samples, and the gain c of the differences.

    .. math:: z_k = y_k + c\,(y_k - y_{k-1}), \qquad c = 1 / (e^{1/\tau} - 1)

    has no transient after a step, and on a rise it lags by :math:`\tau - c` samples.
    """
    gain = 1 / float(np.expm1(1 / tau))
    return y + gain * np.diff(y, prepend=y[:1]), gain


def mean_noise(gain: float, width: float | Ints) -> Floats:
    """Return the noise of a running mean of such a load, over that of a sample of the load as recorded.

    The mean of differences is the difference of the ends, so its noise falls with the width, not its root.
    """
    return np.asarray(np.sqrt((1 + 2 * gain * (1 + gain) / width) / width), np.float64)


def _deconvolve(signal: Signal, slips: Slips, tau: float) -> _DeconvolvedLoad:
    """Return the load before a first-order low-pass of `tau` samples, and the edges of the slips in it.

    The running mean is just wide enough for the median drop to be 6 times the noise, and a tenth of a period
    at most: in more noise, slips of several samples look shorter than they are.
    """
    y, sigma = signal.clean, signal.sigma
    if not tau:
        return _DeconvolvedLoad(
            y, slips.edge, 0.0, max(_TWICE * signal.averaged, 1.0), sigma, signal.averaged
        )
    load, gain = without_lowpass(y, tau)
    widths = 1 + 2 * np.arange(int(slips.period / 20) + 1)  # up to a tenth of a period
    noise = sigma * mean_noise(gain, widths)
    noisy = int(np.sum(noise > np.median(slips.drop) / 6))
    chosen = min(noisy, widths.size - 1)
    width = int(widths[chosen])
    load = running_mean(load, width)
    edge = _steepest(load, slips.edge, 2 * tau, width)
    return _DeconvolvedLoad(load, edge, tau - gain, width, float(noise[chosen]))


def _steepest(y: Floats, edge: Ints, back: float, width: int) -> Ints:
    """Return the middle of the largest drop over 2 `width` samples shortly before each edge.

    At most `back` samples, or 0.4 of the stick, before it.
    """
    earlier = np.minimum(0.4 * np.diff(edge, prepend=0), back)
    away = np.arange(-int(earlier.max()), 2)
    place = np.clip(edge[:, None] + away, width, y.size - 1 - width)
    drop = np.where(away >= -earlier[:, None], y[place - width] - y[place - 1 + width], -np.inf)
    return np.asarray(place[np.arange(edge.size), drop.argmax(axis=1)])


def _half_from_crossing(distance: Floats, slope: Floats, drop: Floats) -> Floats:
    """Return half the length of a slip from the distance between its middle and a crossing.

    The drop between the stick lines contains the lines' own rise during the slip, which is straight.
    """
    half = distance / _HALF_COSINE
    for _ in range(2):
        with np.errstate(over="ignore"):  # a drop near 0 is all straight
            straight = np.clip(2 * slope * half / np.maximum(drop, np.finfo(float).tiny), 0, 1)
        half = distance / (_HALF_COSINE + (_STRAIGHT - _HALF_COSINE) * np.nan_to_num(straight))
    return half


@dataclass(frozen=True)
class _Baselines:
    """The stick lines before and after each edge, (2, edge)."""

    level: Floats  # value half a sample before the edge
    slope: Floats
    knee: Floats  # position in each stick, (edge + 1,); NaN for none
    shape: Shape

    @property
    def drop(self) -> Floats:
        """Difference of the lines before and after each edge."""
        return np.asarray(self.level[0] - self.level[1], np.float64)

    @classmethod
    def of(
        cls, seen: _DeconvolvedLoad, two_slopes: bool, settings: ForceSettings, shape: Shape | None = None
    ) -> _Baselines:
        """Fit straight lines, lines with a knee where they fit clearly better, or lines of a common shape."""
        y, edge, shape = seen.load, seen.edge, shape or Shape()
        lines = stick_lines(y, edge, settings)
        # Edges at begin and end of each stick; the first stick has no begin, the last no end.
        begin, end = ends = np.stack([np.r_[np.nan, edge - 0.5], np.r_[edge - 0.5, np.nan]])
        level = lines.at(ends) + shape.ends * np.nan_to_num(lines.slope * (end - begin))
        slope = np.stack([lines.slope, lines.slope])
        knee = np.full(edge.size + 1, np.nan)
        if two_slopes:
            middles = stick_middles(edge, y.size, settings)
            broken = fit_broken_lines(np.arange(y.size, dtype=float), y, *middles)
            bent = (broken.gain > settings.knee_gain) & (broken.first > 0) & (broken.second > 0)
            knee = np.where(bent, broken.knee_x, np.nan)
            level = np.where(bent, [broken.first_at(begin), broken.second_at(end)], level)
            slope = np.where(bent, [broken.first, broken.second], slope)
        # The end of a stick lies before an edge, the begin of the next one after it.
        level, slope = (np.stack([part[1, :-1], part[0, 1:]]) for part in (level, slope))
        return cls(level, slope, knee, shape)


def _crossings(y: Floats, edge: Ints, base: _Baselines) -> tuple[Floats, Floats, Floats]:
    """Return where the load has fallen half-way between the stick lines, how far before and after that it
    falls through 90 and 10 % of the drop, (2, slip), and through 75 and 25 %."""
    reach = np.maximum((0.3 * np.diff(np.r_[0, edge, y.size])).astype(np.int64), 2)  # into either stick
    row, index = flat_ranges(np.maximum(edge - reach[:-1], 0), np.minimum(edge + reach[1:], y.size - 1))
    # Both stick lines end at the edge, so that lines of different slope do not cross.
    slope = base.slope[(index >= edge[row]).astype(np.int64), row]
    line = base.level[1, row] + slope * (index - edge[row] + 0.5)
    u = (y[index] - line) / base.drop[row]
    middle = _half_way(u, row, index, edge.size)
    # A slip interrupted by the next one may never reach 50 %: its middle is then the steepest drop.
    middle = np.where(np.isfinite(middle), middle, edge - 0.5)
    before, after = index[:-1] <= middle[row[:-1]], index[1:] >= middle[row[:-1]]

    def away(part: float) -> Floats:
        high = _passage(u, row, index, 0.5 + part, before, edge.size, 1)
        low = _passage(u, row, index, 0.5 - part, after, edge.size, -1)
        return np.stack([middle - high, low - middle])

    return middle, away(0.4), away(0.25)


def _half_way(u: Floats, row: Ints, index: Ints, rows: int) -> Floats:
    """Return the likeliest position of a step from 1 to 0: where the running sum of u - 0.5 is largest.

    NaN where that is the end of the window. At a few times the noise, the first crossing of 0.5 would
    depend on single outliers.
    """
    # A stick too short for a line has no level: it must not reach the sums of later slips.
    running_sum = np.cumsum(np.where(np.isfinite(u), u - 0.5, 0.0))
    largest = np.full(rows, -np.inf)
    np.maximum.at(largest, row, running_sum)
    best = np.flatnonzero((running_sum == largest[row]) & np.r_[row[1:] == row[:-1], False])
    first = np.full(rows, u.size, dtype=np.int64)
    np.minimum.at(first, row[best], best)
    return _interpolated(u, index, 0.5, np.where(first < u.size, first, -1))


def _passage(u: Floats, row: Ints, index: Ints, level: float, allowed: Bools, rows: int, sign: int) -> Floats:
    """Return the interpolated index at which u falls through a level; NaN for never.

    Of the allowed samples of each row it is the last fall (sign 1) or the first one (sign -1).
    """
    falling = np.flatnonzero((u[:-1] >= level) & (u[1:] < level) & (row[:-1] == row[1:]) & allowed)
    chosen = np.full(rows, -np.inf)
    np.maximum.at(chosen, row[falling], sign * falling)
    return _interpolated(u, index, level, np.where(np.isfinite(chosen), sign * chosen, -1).astype(np.int64))


def _interpolated(u: Floats, index: Ints, level: float, at: Ints) -> Floats:
    """Return the index at which u passes the level between samples `at` and `at` + 1; NaN where at is -1."""
    here = np.maximum(at, 0)
    part = (u[here] - level) / np.maximum(u[here] - u[np.minimum(here + 1, u.size - 1)], 1e-9)
    return np.where(at >= 0, index[here] + part, np.nan)


@dataclass(frozen=True)
class Shape:
    """Deviation of curved sticks from their lines at begin and end, (2, 1), as a share of the lines' rise.

    It is common to all sticks of a recording, and 0 where they are straight.
    """

    ends: Floats = field(default_factory=lambda: np.zeros((2, 1)))
    errors: Floats = field(default_factory=lambda: np.zeros((2, 1)))  # of a single stick, which may differ
    difference_error: float = 0.0  # of end minus begin: a bend moves both alike
    spread: float = 0.0  # root mean square of the deviations within `line_part`

    @classmethod
    def of(cls, y: Floats, edge: Ints, alike: bool, settings: ForceSettings) -> Shape:
        """Fit polynomials of degree 2 to 4 to the residuals of the lines of sticks between two slips.

        Fewer than eight sticks do not show what they have in common, and a bend may be small beside its own
        error: what they bend beyond chance is then part of the errors.
        """
        start, stop = (at[1:-1] for at in stick_middles(edge, y.size, settings))
        length = np.diff(edge)
        rise = stick_lines(y, edge, settings).slope[1:-1] * length
        long = max(2 * settings.few_samples, 0.5 * np.quantile(length, 0.9)) if length.size else 0
        some = np.flatnonzero((length > long) & (rise > 0))  # shorter ones may be oscillations
        if not some.size:
            return cls()
        some = some[:: some.size // 400 + 1]  # enough for medians
        found, residual, row = fit_polynomials(y, start[some], stop[some])
        share = found[:, 2:] / rise[some, np.newaxis]
        middle = np.median(share, axis=0)
        scatter = mad_sigma(share, axis=0)
        standard = 1.25 * scatter / np.sqrt(some.size)
        reach = float(np.median(length[some] / (stop - 1 - start)[some]))
        ends = legvander(np.array([-reach, reach]), 4)[:, 2:]
        count = np.bincount(row)
        noise = np.bincount(row, residual**2) / np.maximum(count - 5, 1) / count / rise[some] ** 2
        white = (2 * np.arange(2, 5) + 1) * np.median(noise)
        clear = np.abs(middle) > settings.shape_sigmas * standard
        if some.size < 8 or not clear.any():
            chance = float(np.sqrt(max(white[0] / some.size, standard[0] ** 2)))
            bend = float(np.abs(middle[0]))
            return cls(errors=min(bend, 1.0) * (bend > chance) * ends[:, :1])
        kept = np.where(clear, middle, 0.0)
        off = (ends * kept).sum(axis=1)
        if np.abs(off).max() > 1.0:  # no stick deviates that far
            return cls()
        # What the terms left out, and those beyond the last, may add: as much as the last one.
        # Where the terms hardly become smaller, as at a knee or a steep beginning, as much as the last two:
        # their ratio is 0.2 at most for powers of the time up to the third, 0.5 and more there.
        last = 4 - (abs(middle[1]) > abs(middle[0]) / 3)
        unknown = np.where(clear & (np.arange(2, 5) < last), standard, np.abs(middle))
        # Sticks may bend by different amounts: as far as their curvatures scatter more than noise explains.
        differ = (not alike) & (scatter**2 > white * (1 + settings.alike_sigmas / np.sqrt(some.size)))
        unknown = np.sqrt(unknown**2 + np.where(differ, scatter**2 - white, 0))
        difference = ends[1] - ends[0]
        difference[2] = np.hypot(*ends[:, 2])  # stands for all terms beyond
        errors = np.linalg.norm(np.vstack([ends, difference]) * unknown, axis=1)
        spread = float(np.sqrt(np.sum(kept**2 / (2 * np.arange(2, 5) + 1))))
        return cls(off[:, np.newaxis], errors[:2, np.newaxis], float(errors[2]), spread)


# --- recorded extremes --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Extremes:
    """Highest load before and lowest load after the middle of each slip, of a load without spikes."""

    peak: Floats  # position of the highest load, in samples
    valley: Floats  # position of the lowest load, in samples
    high: Floats  # load at the peak, averaged over a part of the usual slip
    low: Floats  # load at the valley, averaged likewise
    width: int  # samples averaged
    highest: Floats  # single largest sample
    lowest: Floats  # single smallest sample

    @property
    def furthest(self) -> Floats:
        """Smallest and largest sample at the ends of each stick, (2, stick)."""
        return np.stack([self.lowest[:-1], self.highest[1:]])

    @property
    def fall(self) -> Floats:
        """Samples from each peak to the next valley."""
        return self.valley - self.peak

    @property
    def rise(self) -> Floats:
        """Samples from each valley to the next peak; one fewer than slips."""
        return self.peak[1:] - self.valley[:-1]


def find_extremes(y: Floats, noise: float, middle: Floats, length: Floats, drop: Floats) -> Extremes:
    """Return the recorded extremes around each slip of a load without spikes.

    The peak lies between the middle of the previous stick and the middle of the slip, the valley between the
    latter and the middle of the next stick. `middle`, `length` (samples) and `drop` are those of each slip,
    `noise` is the standard deviation of the load's noise.

    A mean over w samples lowers the extreme of a half cosine of L samples and drop A by A (πw/L)²/48; the
    largest of several means exceeds it by about 1.5 σ/√w. Their sum is least at w = (1.8 L² σ/A)^0.4. At
    least a 24th of the slip is averaged, which changes next to nothing, and at most a third.
    """
    last = y.size - 1
    between = 0.5 * (middle[:-1] + middle[1:])
    # Before the first and after the last slip: half of the neighbouring stick.
    first = middle[0] - (between[0] - middle[0]) if between.size else 0.0
    final = middle[-1] + (middle[-1] - between[-1]) if between.size else last
    bounds = np.clip(np.r_[first, between, final], 0, last)
    here = np.clip(np.rint(middle), 0, last).astype(np.int64)
    # The middles of close slips may be in either order, so each range contains at least the slip's sample.
    start = np.minimum(np.floor(bounds[:-1]).astype(np.int64), here)
    stop = np.maximum(np.ceil(bounds[1:]).astype(np.int64), here)
    usual, height = (float(np.nan_to_num(nan_median(values))) for values in (length, drop))
    best = (1.8 * usual**2 * noise / max(height, noise)) ** 0.4 if noise else 0.0
    width = 2 * int(0.5 * np.clip(best, usual / 24, usual / 3)) + 1
    smooth = running_mean(y, width)
    peak, high, highest = _largest(y, smooth, start, here + 1, 1)
    valley, low, lowest = _largest(y, smooth, here, stop + 1, -1)
    return Extremes(peak, valley, high, low, width, highest, lowest)


def _largest(y: Floats, smooth: Floats, start: Ints, stop: Ints, sign: int) -> tuple[Floats, Floats, Floats]:
    """Return the position and value of the largest smoothed value of each range, and its largest sample."""
    row, index = flat_ranges(start, np.minimum(stop, y.size))
    single, best = np.full(start.size, -np.inf), np.full(start.size, -np.inf)
    np.maximum.at(single, row, sign * y[index])
    values = sign * smooth[index]
    np.maximum.at(best, row, values)
    hits = np.flatnonzero(values == best[row])
    position = np.full(start.size, np.nan)
    # Of equal samples the one next to the slip: the last for peaks, the first for valleys.
    order = hits if sign > 0 else hits[::-1]
    position[row[order]] = index[order]
    return position, sign * best, sign * single


def is_slow(corners: Corners, settings: ForceSettings) -> Bools:
    """Return which slips last a considerable part of a neighbouring stick: all, if half of them do."""
    fall, rise = corners.length, corners.peak[1:] - corners.valley[:-1]
    if not rise.size:
        return np.zeros(fall.shape, dtype=bool)
    shorter = np.minimum(np.r_[rise[:1], rise], np.r_[rise, rise[-1:]])
    slow = fall > settings.slow_slip * np.maximum(shorter, 1e-9)
    return np.asarray(slow | (slow.mean() >= 0.5), np.bool_)
