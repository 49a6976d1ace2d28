"""How long the force chain (load cell, amplifier, filter) takes to follow, as seen in the slips' tails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.force.lines import Floats, Ints, lagged_hinge
from vision.force.slips import Slips

_STICKS, _SAMPLES = 100, 120  # at most, and about: enough for a time constant known to a few per cent
_LEAST_STICKS, _LEAST_SAMPLES = 3, 8
_LONG = 8  # times that: what comes later in a stick says nothing of its tail
_SHORTEST, _LONGEST = 0.15, 0.6  # time constants tried, in samples and in sticks
_KNEES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)  # in sticks; 1 is no knee
_LATEST = 0.9  # knee, in sticks
_GRID = 15
_TRIED, _BELIEVED = 2.5, 5.0
_HEIGHTS, _LARGEST_SPREAD, _STEADY = (0.25, 5.0), 0.6, 0.25
_SHARE = 20.0  # half a smoothing width: at most this part of a period
_CLEAR = 40.0  # the usual drop over the noise from which on nothing is smoothed


@dataclass(frozen=True)
class Tails:
    """What follows each slip, in samples: clear of slips from `start` to `stop`.

    middle: of the slip.  valley: its end as recorded.  peak: where the next begins.  drop: the slip's height.
    """

    start: Ints
    stop: Ints
    middle: Floats
    valley: Floats
    peak: Floats
    drop: Floats


@dataclass(frozen=True)
class Constant:
    """A time constant in samples, and what speaks for it.

    gain: by how much it lowers the squares, over what chance does with one more free number a stick.
    height: the tails carried back to the middle of their slips, over the drops, at the median; spread: its
    interquartile range over that.  A low-pass leaves tails of one and the same height, half of the drop or
    more.
    """

    samples: float
    gain: float
    height: float
    spread: float

    @property
    def worth_trying(self) -> bool:
        """Whether corners freed of such a low-pass are worth looking at."""
        return self.gain > _TRIED

    def confirms(self, before: Constant) -> bool:
        """Whether this, from corners freed of the low-pass found before, shows the same one."""
        steady = abs(np.log(self.samples / before.samples)) < _STEADY
        high = _HEIGHTS[0] < self.height < _HEIGHTS[1]
        return self.gain > _BELIEVED and high and self.spread < _LARGEST_SPREAD and steady


def time_constant(y: Floats, tails: Tails, undone: float = 0.0) -> Constant | None:
    """Time constant of a first-order low-pass in the recording; None with too few samples after slips.

    After each slip the load is the sample's own rise (a parabola, with a knee for fast pulls) plus what the
    chain still has to catch up with: an exponential, of the same time constant in all sticks and of free
    height in each.  The time constant is that of the least squares.

    undone: the time constant, samples, whose delay `tails` are already free of.
    """
    blocks = _Blocks.of(y, tails, undone)
    if blocks is None:
        return None
    without = min(blocks.fit(0.0, knee).squares for knee in _KNEES)
    tau, knee = blocks.best()
    best = blocks.fit(tau, knee)
    # Squares are differences of sums: no smaller than what rounding leaves.
    rounding = np.finfo(float).eps * float(np.sum(blocks.load**2))
    chance = blocks.drop.size * max(best.squares, rounding, np.finfo(float).tiny) / blocks.freedom
    with np.errstate(over="ignore"):
        height = best.tail * np.exp(np.minimum(-blocks.middle / tau, 50.0)) / blocks.drop
    # Of the larger drops: noise hides what small ones leave.
    low, median, high = np.percentile(height[blocks.drop >= np.median(blocks.drop)], [25, 50, 75])
    return Constant(
        samples=tau * blocks.size,
        gain=(without - best.squares) / chance,
        height=float(median),
        spread=float((high - low) / median) if median > 0 else float("inf"),
    )


@dataclass(frozen=True)
class _Fit:
    squares: float
    tail: Floats


@dataclass(frozen=True)
class _Blocks:
    """Some sticks, as rows of means over `size` samples: lines stay lines, exponentials exponentials.

    load, known: (stick, block), over the first sample's, 0 where not known.  middle, valley, peak: as in
    `Tails`, in blocks from the first.  undone: samples.
    """

    load: Floats
    known: NDArray[np.bool_]
    middle: Floats
    valley: Floats
    peak: Floats
    drop: Floats
    size: int
    undone: float

    @classmethod
    def of(cls, y: Floats, tails: Tails, undone: float) -> _Blocks | None:
        count = tails.stop - tails.start
        usable = np.flatnonzero((count >= _LEAST_SAMPLES) & (tails.drop > 0))
        if usable.size < _LEAST_STICKS:
            return None
        pick = usable[np.unique(np.linspace(0, usable.size - 1, _STICKS).astype(np.int64))]
        start, count = tails.start[pick], count[pick]
        size = max(int(np.median(count)) // _SAMPLES, 1)
        blocks = np.minimum(count // size, _LONG * _SAMPLES)
        index = start[:, None] + np.arange(size * int(blocks.max()))
        load = y[np.minimum(index, y.size - 1)] - y[start][:, None]
        load = load.reshape(pick.size, -1, size).mean(axis=2)
        known = np.arange(load.shape[1]) < blocks[:, None]
        first = start + 0.5 * (size - 1)
        middle, valley, peak = ((at[pick] - first) / size for at in (tails.middle, tails.valley, tails.peak))
        return cls(np.where(known, load, 0.0), known, middle, valley, peak, tails.drop[pick], size, undone)

    @property
    def freedom(self) -> int:
        return max(int(self.known.sum()) - 5 * self.drop.size, 1)

    def best(self) -> tuple[float, float]:
        """(time constant, knee) of the least squares: the best of a grid, then downhill from there."""
        from scipy.optimize import minimize

        high = max(_LONGEST * float(np.median(self.peak)), 2 * _SHORTEST)
        grid = [(tau, knee) for tau in np.geomspace(_SHORTEST, high, _GRID) for knee in _KNEES]
        first = min(grid, key=lambda pair: self.fit(*pair).squares)

        def squares(pair: Floats) -> float:
            return self.fit(float(np.exp(pair[0])), float(pair[1])).squares

        start = np.array([np.log(first[0]), min(first[1], _LATEST)])
        steps = np.array([start, (start[0] + 0.2, start[1]), (start[0], start[1] - 0.05)])
        bounds = [(float(np.log(_SHORTEST)), float(np.log(high))), (_KNEES[0], _LATEST)]
        found = minimize(
            squares,
            start,
            method="Nelder-Mead",
            bounds=bounds,
            options={"initial_simplex": steps, "xatol": 1e-3, "fatol": 1e-3},
        )
        return float(np.exp(found.x[0])), float(found.x[1])

    def fit(self, tau: float, knee: float) -> _Fit:
        """Least squares of all rows at once; tau in blocks (0: no tail), knee in sticks."""
        t = np.arange(self.load.shape[1]) + np.zeros((self.drop.size, 1))
        # The chain delays the end of the slip by its time constant.
        begin = self.valley - (tau - self.undone / self.size)
        u = (t - begin[:, None]) / (self.peak - begin)[:, None]
        columns = [np.ones_like(u), u, u**2]
        if knee < 1:
            columns.append(lagged_hinge(t - (begin + knee * (self.peak - begin))[:, None], tau))
        if tau:
            columns.append(np.exp(-t / tau))
        q, r = np.linalg.qr(np.stack(columns, axis=-1) * self.known[..., None])
        found = np.einsum("swk,sw->sk", q, self.load)
        squares = float(np.sum(self.load**2) - np.sum(found**2))
        with np.errstate(divide="ignore", invalid="ignore"):
            return _Fit(squares, found[:, -1] / r[:, -1, -1])


@dataclass(frozen=True)
class Undelayed:
    """A recording without its force chain's low-pass, `late` samples behind its own clock.

    edge: the first sample after the steepest drop of each slip.  Each value is a mean over `width` samples:
    undoing the low-pass alone would drown it in noise.
    """

    load: Floats
    edge: Ints
    late: float
    width: int
    sigma: float


def undelayed(y: Floats, sigma: float, slips: Slips, tau: float) -> Undelayed:
    """y before a first-order low-pass of time constant tau samples; unchanged for tau 0.

    y[k] + c (y[k] - y[k-1]) with c = 1 / (exp(1/tau) - 1) has no tail left after a step, and on a rise it
    lags by tau - c samples.  Smoothed only as far as the usual drop needs to stand out.  sigma: noise of y.
    """
    from scipy.ndimage import uniform_filter1d

    if not tau:
        return Undelayed(y, slips.edge, 0.0, 1, sigma)
    gain = 1 / np.expm1(1 / tau)
    widths = 1 + 2 * np.arange(int(slips.period / _SHARE) + 1)
    # A mean of differences is a difference of ends: its noise falls with the width itself.
    noise = sigma * np.sqrt((1 + 2 * gain * (1 + gain) / widths) / widths)
    chosen = min(int(np.sum(noise > np.median(slips.drop) / _CLEAR)), widths.size - 1)
    width = int(widths[chosen])
    load = uniform_filter1d(y + gain * np.diff(y, prepend=y[:1]), width, mode="nearest")
    edge = _steepest(load, slips.edge, 2 * tau, width)
    return Undelayed(load, edge, tau - gain, width, float(noise[chosen]))


def _steepest(y: Floats, edge: Ints, back: float, width: int) -> Ints:
    """The middle of the largest drop over 2 `width` samples, at most `back` or 0.4 sticks before an edge."""
    earlier = np.minimum(0.4 * np.diff(edge, prepend=0), back)
    away = np.arange(-int(earlier.max()), 2)
    place = np.clip(edge[:, None] + away, width, y.size - 1 - width)
    drop = np.where(away >= -earlier[:, None], y[place - width] - y[place - 1 + width], -np.inf)
    return np.asarray(place[np.arange(edge.size), drop.argmax(axis=1)])
