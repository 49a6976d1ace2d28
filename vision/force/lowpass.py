"""The load cell's low-pass: found in the transients after slips, and corrected by deconvolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import scipy

from vision.force.lines import lagged_hinge
from vision.force.settings import ForceSettings
from vision.force.slips import Slips
from vision.numeric import Bools, Floats, Ints
from vision.signals import running_mean

_SHORTEST = 0.15  # time constant looked for, samples: a shorter one leaves no transient
_KNEES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)  # tried, in sticks; 1 is no knee
_LEAST_OWN = 1e-9  # of a column's length: what is left of it beside those before is rounding


@dataclass(frozen=True)
class SlipTransients:
    """What follows each slip, in samples.

    Parameters
    ----------
    start, stop
        Half-open ranges clear of slips.
    middle, valley, peak
        Middle and end of the slip as recorded; where the next slip begins.
    drop
        The slip's height.
    """

    start: Ints
    stop: Ints
    middle: Floats
    valley: Floats
    peak: Floats
    drop: Floats

    def take(self, rows: Bools) -> SlipTransients:
        """Some of the transients."""
        return SlipTransients(*(getattr(self, part.name)[rows] for part in fields(self)))


@dataclass(frozen=True)
class LowpassEstimate:
    """A time constant and the evidence for it.

    Parameters
    ----------
    samples
        The time constant.
    gain
        By how much it lowers the sum of squares, over what chance does with one more free number per stick.
    height, scatter
        Transients extrapolated to the middle of their slips, over the drops: median, and interquartile range
        over the median. A low-pass leaves transients of one and the same height, half of the drop or more.
    """

    samples: float
    gain: float
    height: float
    scatter: float

    def confirms(self, before: LowpassEstimate, settings: ForceSettings) -> bool:
        """Whether this, from corners corrected for the low-pass found before, shows the same one."""
        steady = abs(np.log(self.samples / before.samples)) < 0.25
        enough = self.gain > settings.lowpass_accepted and 0.25 < self.height < 5.0
        return enough and self.scatter < 0.6 and steady


def estimate_lowpass(y: Floats, transients: SlipTransients, corrected: float = 0.0) -> LowpassEstimate | None:
    """Time constant of a first-order low-pass in a recording.

    Parameters
    ----------
    y
        Load without spikes.
    transients
        Stretches between slips.
    corrected
        Time constant, in samples, whose delay the corners in `transients` are already corrected for.

    Returns
    -------
    None with fewer than three sticks of eight samples or more.

    Notes
    -----
    After each slip the load is the sample's own rise (a parabola, with a knee for fast pulls) plus an
    exponential transient, of the same time constant in all sticks and of free height in each. The time
    constant is that of least squares.
    """
    blocks = _Blocks.of(y, transients, corrected)
    if blocks is None:
        return None
    without = min(blocks.fit(0.0, knee)[0] for knee in _KNEES)
    tau, knee = blocks.best()
    squares, transient = blocks.fit(tau, knee)
    # Squares are differences of sums: no smaller than what rounding leaves.
    rounding = np.finfo(float).eps * float(np.sum(blocks.load**2))
    chance = blocks.drop.size * max(squares, rounding, np.finfo(float).tiny) / blocks.freedom
    with np.errstate(over="ignore"):
        height = transient * np.exp(np.minimum(-blocks.middle / tau, 50.0)) / blocks.drop
    # Of the larger drops: noise hides what small ones leave.
    low, median, high = np.percentile(height[blocks.drop >= np.median(blocks.drop)], [25, 50, 75])
    return LowpassEstimate(
        samples=tau * blocks.size,
        gain=(without - squares) / chance,
        height=float(median),
        scatter=float((high - low) / median) if median > 0 else float("inf"),
    )


@dataclass(frozen=True)
class _Blocks:
    """Some sticks, as rows of means over `size` samples: lines stay lines, exponentials exponentials.

    load, known: (stick, block), less the first sample's, 0 where not known.  middle, valley, peak: as in
    `SlipTransients`, in blocks from the first.  corrected: samples.
    """

    load: Floats
    known: Bools
    middle: Floats
    valley: Floats
    peak: Floats
    drop: Floats
    size: int
    corrected: float

    @classmethod
    def of(cls, y: Floats, transients: SlipTransients, corrected: float) -> _Blocks | None:
        """At most 100 sticks of about 120 blocks: enough for a time constant known to a few per cent."""
        count = transients.stop - transients.start
        inside = (transients.start >= 0) & (transients.stop <= y.size)  # a slip without a place has none
        usable = np.flatnonzero((count >= 8) & (transients.drop > 0) & inside)
        if usable.size < 3:
            return None
        pick = usable[np.unique(np.linspace(0, usable.size - 1, 100).astype(np.int64))]
        start, count = transients.start[pick], count[pick]
        size = max(int(np.median(count)) // 120, 1)
        blocks = np.minimum(count // size, 8 * 120)  # later in a long stick there is no transient left
        index = start[:, None] + np.arange(size * int(blocks.max()))
        load = y[np.minimum(index, y.size - 1)] - y[start][:, None]
        load = load.reshape(pick.size, -1, size).mean(axis=2)
        known = np.arange(load.shape[1]) < blocks[:, None]
        first = start + 0.5 * (size - 1)
        places = (transients.middle, transients.valley, transients.peak)
        middle, valley, peak = ((at[pick] - first) / size for at in places)
        load = np.where(known, load, 0.0)
        return cls(load, known, middle, valley, peak, transients.drop[pick], size, corrected)

    @property
    def freedom(self) -> int:
        """Blocks less free numbers."""
        return max(int(self.known.sum()) - 5 * self.drop.size, 1)

    def best(self) -> tuple[float, float]:
        """(time constant, knee) of the least squares: the best of a grid, then downhill from there."""
        high = max(0.6 * float(np.median(self.peak)), 2 * _SHORTEST)
        grid = [(tau, knee) for tau in np.geomspace(_SHORTEST, high, 15) for knee in _KNEES]
        first = min(grid, key=lambda pair: self.fit(*pair)[0])
        start = np.array([np.log(first[0]), min(first[1], 0.9)])
        steps = np.array([start, (start[0] + 0.2, start[1]), (start[0], start[1] - 0.05)])

        def squares(pair: Floats) -> float:
            return self.fit(float(np.exp(pair[0])), float(pair[1]))[0]

        found = scipy.optimize.minimize(
            squares,
            start,
            method="Nelder-Mead",
            bounds=[(float(np.log(_SHORTEST)), float(np.log(high))), (_KNEES[0], 0.9)],
            options={"initial_simplex": steps, "xatol": 1e-3, "fatol": 1e-3},
        )
        return float(np.exp(found.x[0])), float(found.x[1])

    def fit(self, tau: float, knee: float) -> tuple[float, Floats]:
        """(squares left, heights of the transients) of all rows; tau in blocks (0: none), knee in sticks."""
        t = np.arange(float(self.load.shape[1]))
        # The low-pass delays the end of the slip by its time constant.
        begin = self.valley - (tau - self.corrected / self.size)
        u = (t - begin[:, None]) / (self.peak - begin)[:, None]
        columns = [np.ones_like(u), u, u**2]
        if knee < 1:
            columns.append(lagged_hinge(t - (begin + knee * (self.peak - begin))[:, None], tau))
        if tau:
            columns.append(np.broadcast_to(np.exp(-t / tau), u.shape))
        return _last_of_fit(self.load, [column * self.known for column in columns])


def _last_of_fit(rows: Floats, columns: Sequence[Floats]) -> tuple[float, Floats]:
    """(squares left in all rows, coefficient of the last column in each) of least squares within each row.

    Modified Gram-Schmidt for all rows at once: LAPACK's QR of each small matrix takes three times as long.
    """
    left, directions = float(np.sum(rows**2)), list[Floats]()
    found = length = np.zeros(len(rows))
    for column in columns:
        size = _dot(column, column)
        for direction in directions:
            column = column - _dot(direction, column)[:, None] * direction  # noqa: PLW2901
        length = np.sqrt(_dot(column, column))
        own = length > _LEAST_OWN * np.sqrt(size)
        direction = column * np.divide(1, length, out=np.zeros_like(length), where=own)[:, None]
        found = _dot(direction, rows)
        left -= float(np.sum(found**2))
        directions.append(direction)
    with np.errstate(divide="ignore", invalid="ignore"):
        return left, found / length


def _dot(one: Floats, other: Floats) -> Floats:
    return np.asarray(np.einsum("sw,sw->s", one, other), np.float64)


@dataclass(frozen=True)
class DeconvolvedLoad:
    """A recording corrected for the load cell's low-pass.

    Parameters
    ----------
    load
        Each value is a mean over `width` samples: deconvolution alone would drown the load in noise.
    edge
        The first sample after the steepest drop of each slip.
    late
        Samples by which `load` lags behind the clock.
    width
        Samples averaged.
    sigma
        Noise of `load`.
    """

    load: Floats
    edge: Ints
    late: float
    width: int
    sigma: float


def deconvolve_lowpass(y: Floats, sigma: float, slips: Slips, tau: float) -> DeconvolvedLoad:
    """The load before a first-order low-pass.

    Parameters
    ----------
    y, sigma
        Load without spikes, and its noise.
    slips
        As found in y.
    tau
        Time constant in samples; 0 leaves y unchanged.

    Returns
    -------
    The corrected load with the slips' places in it.

    Notes
    -----
    .. math:: z_k = y_k + c\\,(y_k - y_{k-1}), \\qquad c = 1 / (e^{1/\\tau} - 1)

    has no transient left after a step, and on a rise it lags by :math:`\\tau - c` samples. It is smoothed
    only as far as the usual drop needs to be 40 times the noise, by a tenth of a period at most.
    """
    if not tau:
        return DeconvolvedLoad(y, slips.edge, 0.0, 1, sigma)
    gain = 1 / np.expm1(1 / tau)
    widths = 1 + 2 * np.arange(int(slips.period / 20) + 1)  # up to a tenth of a period
    # A mean of differences is a difference of ends: its noise falls with the width itself.
    noise = sigma * np.sqrt((1 + 2 * gain * (1 + gain) / widths) / widths)
    noisy = int(np.sum(noise > np.median(slips.drop) / 40))
    chosen = min(noisy, widths.size - 1)
    width = int(widths[chosen])
    load = running_mean(y + gain * np.diff(y, prepend=y[:1]), width)
    edge = _steepest(load, slips.edge, 2 * tau, width)
    return DeconvolvedLoad(load, edge, tau - gain, width, float(noise[chosen]))


def _steepest(y: Floats, edge: Ints, back: float, width: int) -> Ints:
    """The middle of the largest drop over 2 `width` samples, at most `back` or 0.4 sticks before an edge."""
    earlier = np.minimum(0.4 * np.diff(edge, prepend=0), back)
    away = np.arange(-int(earlier.max()), 2)
    place = np.clip(edge[:, None] + away, width, y.size - 1 - width)
    drop = np.where(away >= -earlier[:, None], y[place - width] - y[place - 1 + width], -np.inf)
    return np.asarray(place[np.arange(edge.size), drop.argmax(axis=1)])
