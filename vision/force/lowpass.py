"""The low-pass of the load cell: its time constant, from transients after slips, and whether it is proven."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from vision.data import LowpassDoubt
from vision.force.corners import BETWEEN_SAMPLES, Corners, SlipTransients, find_corners
from vision.force.lines import lagged_hinge
from vision.force.settings import ForceSettings
from vision.force.signal import Signal
from vision.force.slips import Slips
from vision.numeric import Bools, Floats, nan_median, spread_indices


@dataclass(frozen=True)
class Lowpass:
    """The low-pass that the transients after slips suggest."""

    samples: float = 0.0  # time constant; 0 for none
    corners: Corners | None = None  # of the slips once corrected for it; None for none
    # Why it is not proven: "differs" (among large and small slips, or those after long and short sticks) or
    # "shape" (slips without it still have a tail); "" where it is.
    doubt: LowpassDoubt = ""

    @property
    def proven(self) -> bool:
        """Return whether there is a low-pass without doubt."""
        return self.samples > 0 and not self.doubt


def find_lowpass(signal: Signal, slips: Slips, plain: Corners, settings: ForceSettings) -> Lowpass:
    """Find the low-pass of the load cell from the transients after slips; `plain`: uncorrected corners."""
    y = signal.clean
    found = estimate_lowpass(y, plain.transients())
    # No sign of a transient: slow noise wanders like one after some of the slips.
    if found is None or found.gain <= 2.5 * signal.alike:
        return Lowpass()

    def corrected(samples: float) -> Corners:
        return find_corners(signal, slips, lowpass=samples, two_slopes=plain.two_slopes, settings=settings)

    # Corrected corners show the transients from their begin, so a low-pass must be found there again.
    for _ in range(3):
        transients = corrected(found.samples).transients()
        again = estimate_lowpass(y, transients, found.samples)
        if again is None:
            break
        if again.confirms(found, settings):
            corners = corrected(again.samples)
            if not _same_everywhere(y, transients, again.samples, settings):
                return Lowpass(again.samples, corners, "differs")
            # Corrected slips have no tail, but behind a filter of higher order, which falls off gradually.
            least = (1 - settings.lowpass_tail) * nan_median(corners.end) - BETWEEN_SAMPLES
            return Lowpass(again.samples, corners, "shape" if nan_median(corners.onset) < least else "")
        found = again
    return Lowpass()


def _same_everywhere(y: Floats, transients: SlipTransients, tau: float, settings: ForceSettings) -> bool:
    """Return whether large and small slips, and those after long and short sticks, show the same constant.

    An amplifier has one time constant; relaxation of the sample changes with the slip.
    """
    stick = transients.peak - transients.valley
    if not tau < 0.5 * float(np.median(stick)):
        return False
    for quantity in (transients.drop, stick):
        large = quantity > np.median(quantity)
        for part in (large, ~large):
            found = estimate_lowpass(y, transients.take(part), tau)
            if found is None or abs(np.log(found.samples / tau)) > settings.lowpass_same:
                return False
    return True


@dataclass(frozen=True)
class LowpassEstimate:
    """A time constant and the evidence for it."""

    samples: float  # the time constant
    # Decrease of the squared residuals over that which one more parameter a stick gives by chance.
    gain: float
    # Transients extrapolated to the middle of their slips, over the drops: the median, and the interquartile
    # range over the median. A low-pass leaves transients of equal height, half of the drop or more.
    height: float
    scatter: float

    def confirms(self, before: LowpassEstimate, settings: ForceSettings) -> bool:
        """Return whether this estimate, from corners corrected for the one before, agrees with it."""
        steady = abs(np.log(self.samples / before.samples)) < 0.15
        enough = self.gain > settings.lowpass_accepted and 0.25 < self.height < 5.0
        return enough and self.scatter < 0.6 and steady


def estimate_lowpass(y: Floats, transients: SlipTransients, corrected: float = 0.0) -> LowpassEstimate | None:
    """Estimate the time constant of a first-order low-pass by least squares.

    After each slip the load, without spikes, is modelled as the rise of the sample (a parabola, with a knee
    for fast pulls) plus an exponential transient, whose time constant is common to all sticks and whose
    height is free in each. None with fewer than three sticks of eight samples or more.  corrected: time
    constant, in samples, for whose delay the corners in `transients` are already corrected.
    """
    blocks = _Blocks.of(y, transients, corrected)
    if blocks is None:
        return None
    without = min(blocks.over_knees(0.0))
    tau, knee = blocks.best()
    squares, transient = blocks.fit(tau, knee)
    # The residuals are differences of sums and so no smaller than their rounding error.
    rounding = np.finfo(float).eps * float(np.sum(blocks.load**2))
    freedom = max(int(blocks.known.sum()) - 5 * blocks.drop.size, 1)
    chance = blocks.drop.size * max(squares, rounding, np.finfo(float).tiny) / freedom
    with np.errstate(over="ignore"):
        height = transient * np.exp(np.minimum(-blocks.middle / tau, 50.0)) / blocks.drop
    # Only the larger drops: noise hides the transients of small ones.
    low, median, high = np.percentile(height[blocks.drop >= np.median(blocks.drop)], [25, 50, 75])
    return LowpassEstimate(
        samples=tau * blocks.size,
        gain=(without - squares) / chance,
        height=float(median),
        scatter=float((high - low) / median) if median > 0 else float("inf"),
    )


@dataclass(frozen=True)
class _Blocks:
    """Selected sticks as rows of block means, which keep lines linear and exponentials exponential."""

    load: Floats  # (stick, block), relative to the stick's first sample; 0 where unknown
    known: Bools  # (stick, block)
    middle: Floats  # this and the next two as in `SlipTransients`, in blocks from the first
    valley: Floats
    peak: Floats
    drop: Floats
    size: int  # samples a block
    corrected: float  # as for `estimate_lowpass`
    knees = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)  # positions tried, as shares of the stick; 1 is no knee

    @classmethod
    def of(cls, y: Floats, transients: SlipTransients, corrected: float) -> _Blocks | None:
        """Select at most 100 sticks of about 120 blocks, which give the time constant to a few per cent."""
        count = transients.stop - transients.start
        inside = (transients.start >= 0) & (transients.stop <= y.size)  # NaN positions become negative
        usable = np.flatnonzero((count >= 8) & (transients.drop > 0) & inside)
        if usable.size < 3:
            return None
        chosen_rows = usable[spread_indices(usable.size, 100)]
        start, count = transients.start[chosen_rows], count[chosen_rows]
        size = max(int(np.median(count)) // 120, 1)
        blocks = np.minimum(count // size, 8 * 120)  # the transient ends before a long stick does
        index = start[:, None] + np.arange(size * int(blocks.max()))
        load = y[np.minimum(index, y.size - 1)] - y[start][:, None]
        load = load.reshape(chosen_rows.size, -1, size).mean(axis=2)
        known = np.arange(load.shape[1]) < blocks[:, None]
        first = start + 0.5 * (size - 1)
        places = (transients.middle, transients.valley, transients.peak)
        middle, valley, peak = ((at[chosen_rows] - first) / size for at in places)
        load = np.where(known, load, 0.0)
        return cls(load, known, middle, valley, peak, transients.drop[chosen_rows], size, corrected)

    def best(self) -> tuple[float, float]:
        """Return the least-squares time constant and knee: the best of a grid, then a simplex search."""
        shortest = 0.15  # blocks; a shorter one leaves no transient
        high = max(0.6 * float(np.median(self.peak)), 2 * shortest)
        grid = np.geomspace(shortest, high, 15)
        left = np.array([self.over_knees(tau) for tau in grid])
        first, knee = np.unravel_index(int(left.argmin()), left.shape)
        start = np.array([np.log(grid[first]), min(self.knees[knee], 0.9)])
        steps = np.array([start, (start[0] + 0.2, start[1]), (start[0], start[1] - 0.05)])

        def squares(pair: Floats) -> float:
            return self.fit(float(np.exp(pair[0])), float(pair[1]))[0]

        found = scipy.optimize.minimize(
            squares,
            start,
            method="Nelder-Mead",
            bounds=[(float(np.log(shortest)), float(np.log(high))), (self.knees[0], 0.9)],
            options={"initial_simplex": steps, "xatol": 1e-3, "fatol": 1e-3},
        )
        return float(np.exp(found.x[0])), float(found.x[1])

    def fit(self, tau: float, knee: float) -> tuple[float, Floats]:
        """Return the squared residuals of all rows and the heights of the transients.

        tau in blocks, 0 for no transient; knee as a share of the stick, 1 for none. As each stick has a
        parabola of its own, the others are fitted to what it leaves, by normal equations.
        """
        block = np.arange(float(self.load.shape[1]))
        begin = self.valley - (tau - self.corrected / self.size)  # the low-pass delays the end of the slip
        at_knee = begin + knee * (self.peak - begin)
        columns: Floats = np.zeros((len(self.load), 2, len(block)))
        if knee < 1:
            columns[:, 0] = lagged_hinge(block - at_knee[:, None], tau) * self.known
        if tau:
            columns[:, 1] = np.exp(-block / tau) * self.known
        squares = np.square(columns).sum(axis=2)
        columns -= (columns @ self._parabola) @ self._parabola.swapaxes(1, 2)
        products = columns @ columns.swapaxes(1, 2)
        # Columns may be 0, or depend on each other or on the parabola.
        products[:, [0, 1], [0, 1]] += np.maximum(1e-12 * squares, np.finfo(float).tiny)
        along = (columns @ self._beyond_parabola[..., None])[..., 0]
        solution = np.linalg.solve(products, along[..., None])[..., 0]
        residual = self._beyond_parabola - (solution[:, None] @ columns)[:, 0]
        return float(np.sum(residual**2)), np.asarray(solution[:, 1], np.float64)

    def over_knees(self, tau: float) -> list[float]:
        """Return the squared residuals for each of the knees; tau in blocks, 0 for no transient."""
        return [self.fit(tau, knee)[0] for knee in self.knees]

    @cached_property
    def _parabola(self) -> Floats:
        """Orthonormal parabolas of the time in the stick, (stick, block, 3)."""
        u = (np.arange(float(self.load.shape[1])) - self.valley[:, None]) / (self.peak - self.valley)[:, None]
        powers = u[..., None] ** np.arange(3.0) * self.known[..., None]
        return np.asarray(np.linalg.qr(powers)[0], np.float64)

    @cached_property
    def _beyond_parabola(self) -> Floats:
        """The load less a parabola fitted to each stick, (stick, block)."""
        along = self._parabola.swapaxes(1, 2) @ self.load[..., None]
        return self.load - (self._parabola @ along)[..., 0]
