"""Where stick-slip turns irregular: the running scatter of ΔF against d, and the place where it changes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy

from vision.comparison.joint import CompareSettings
from vision.comparison.tests import TractionTest
from vision.numeric import Floats, Ints

LEAST_RATIO = 1.5  # of the scatter after over that before: a smaller change is no other kind of motion
MOST_DRAWS = 500  # random orders: enough to tell 1 % from 2 %
LEAST_SIDE = 10  # events on either side of a change


@dataclass(frozen=True, kw_only=True)
class Irregularity:
    """Running coefficient of variation of ΔF, and where it changes.

    Parameters
    ----------
    run, speed_mm_min
        Of the test.
    d_mm, variation
        Separation of each event and the running coefficient of variation there.
    change_mm, change_err_mm
        Where it rises, and its standard error; NaN where there is no change.
    before, after
        Coefficient of variation on either side; the same where there is no change.
    p
        How often a test without a change looks as changed as this one.
    reason
        Why there is no change point; "" where there is one.
    """

    run: str
    speed_mm_min: float
    d_mm: Floats = field(repr=False)
    variation: Floats = field(repr=False)
    change_mm: float
    change_err_mm: float
    before: float
    after: float
    p: float
    reason: str


def find_irregular(test: TractionTest, settings: CompareSettings | None = None) -> Irregularity:
    r"""Where the scatter of ΔF changes for good.

    Parameters
    ----------
    test
        Of `read_tests`.
    settings
        Tunable constants.

    Notes
    -----
    The relative deviation r of ΔF from its own smooth course has the running coefficient of variation
    √⟨r²⟩. The change point is the split that best divides log|r| into two levels, which single large events
    cannot mimic. It is claimed where fewer than 1 % of random orders of r divide as well, the scatter rises
    by half or more, and two levels describe it better (BIC) than a smooth rise, as that of noise over a
    falling ΔF. Its error is the spread of the place over 200 bootstrap draws within the two parts.
    """
    tuning = settings or CompareSettings()
    d, drop = test.column("d_v_mm"), test.column("dF_N")
    nan = float("nan")
    whole: dict[str, Any] = {"run": test.run, "speed_mm_min": test.speed_mm_min, "d_mm": d}
    window = tuning.smooth_events | 1
    if d.size < max(2 * window, 2 * LEAST_SIDE + 1):
        return Irregularity(
            **whole, variation=np.full(d.size, nan), change_mm=nan, change_err_mm=nan, before=nan, after=nan,
            p=nan, reason=f"{d.size} events, at least {2 * window} needed",
        )  # fmt: skip
    r = drop / np.maximum(scipy.signal.savgol_filter(drop, window, 2), 1e-3 * float(drop.max())) - 1
    r *= 1 / np.sqrt(1 - _leverage(window))  # a smooth course takes part of the scatter with it
    square = np.convolve(r**2, np.ones(window), "same") / np.convolve(
        np.ones(d.size), np.ones(window), "same"
    )
    level = np.log(np.abs(r) + 0.05 * float(np.median(np.abs(r))) + 1e-12)
    at = int(_splits(level[np.newaxis])[0])
    rng = np.random.default_rng(tuning.seed)
    draws = min(tuning.draws, MOST_DRAWS)
    shuffled = rng.permuted(np.tile(level, (draws, 1)), axis=1)
    best = _gains(level[np.newaxis])[0].max()
    p = float((1 + np.sum(_gains(shuffled).max(axis=1) >= best)) / (draws + 1))
    before, after = (float(np.sqrt(np.mean(part**2))) for part in (r[:at], r[at:]))
    both = float(np.sqrt(np.mean(r**2)))
    reason = _why_not(p, before, after, _steady_rise_is_better(level, d, at))
    error = nan
    if not reason:
        parts = [rng.choice(part, (200, part.size)) for part in (level[:at], level[at:])]
        places = _splits(np.concatenate(parts, axis=1))
        error = float(np.hypot(np.std(d[places]), np.median(np.diff(d))))
    return Irregularity(
        **whole,
        variation=np.sqrt(square),
        change_mm=nan if reason else float((d[at - 1] + d[at]) / 2),
        change_err_mm=error,
        before=both if reason else before,
        after=both if reason else after,
        p=p,
        reason=reason,
    )


def _leverage(window: int) -> float:
    """Share of its own value in the smoothed one."""
    unit = np.zeros(2 * window + 1)
    unit[window] = 1
    return float(scipy.signal.savgol_filter(unit, window, 2)[window])


def _gains(level: Floats) -> Floats:
    """How much each split of each row lowers the sum of squares, (row, split); splits from LEAST_SIDE on."""
    n = level.shape[1]
    centred = level - level.mean(axis=1, keepdims=True)
    left = np.cumsum(centred, axis=1)[:, LEAST_SIDE - 1 : n - LEAST_SIDE]
    count = np.arange(LEAST_SIDE, n - LEAST_SIDE + 1)
    return np.asarray(left**2 * (1 / count + 1 / (n - count)))


def _splits(level: Floats) -> Ints:
    """First event after the best split of each row."""
    return np.asarray(_gains(level).argmax(axis=1) + LEAST_SIDE)


def _steady_rise_is_better(level: Floats, d: Floats, at: int) -> bool:
    """Whether a line or a parabola in d describes the level as well as two levels do, by BIC.

    The parabola is there for measuring noise over a falling ΔF, whose logarithm bends. The place of the
    change counts as three parameters, since it is the best of many (Hall, Osborn & Sakkas 2013).
    """
    n = level.size
    steps = float(
        np.sum((level[:at] - level[:at].mean()) ** 2) + np.sum((level[at:] - level[at:].mean()) ** 2)
    )
    smooth = []
    for degree in (1, 2):
        curve = np.polynomial.Polynomial.fit(d, level, degree)
        smooth.append(n * np.log(np.sum((level - curve(d)) ** 2) / n) + (degree + 1) * np.log(n))
    return bool(min(smooth) <= n * np.log(steps / n) + 5 * np.log(n))


def _why_not(p: float, before: float, after: float, steady: bool) -> str:
    if p >= 0.01:
        return f"random orders of the events look as changed (p = {p:.2g})"
    if after < LEAST_RATIO * before:
        return f"the scatter goes from {before:.2g} to {after:.2g}"
    return "the scatter rises steadily, at no one place" if steady else ""
