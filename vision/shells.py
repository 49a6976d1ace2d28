"""Which sheets are stiff: the inner shell of each side in each stick phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Doubles = NDArray[np.float64]

_LEAST_SHEETS = 3  # with a ratio, on one side: with fewer there is no shell to speak of
_LEAST_CHANCE = 1e-4  # of a sheet being misjudged for a reason that its error does not know
_NOT_BY_CHANCE = 1e-3  # probability below which a rise and fall of the ratio with n is believed
_LEAST_ERROR = 1e-9


def judge_sheets(motion: xr.Dataset, *, threshold: float = 0.1, certainty: float = 0.9) -> xr.Dataset:
    """`motion` with what can be said of each sheet on its own.

    Args: motion, of `horizontal_deformation`.  threshold, σ_x/Λ_st below which a sheet is stiff.  certainty,
    the probability from which a sheet is called stiff or mobile.

    Returns: a Dataset with two more variables (event, sheet): p_stiff, the probability that the true ratio
    lies below the threshold given `ratio_signed` and its normal error (NaN where there is no ratio), and
    shell: "stiff", "mobile" or "undetermined".
    Raises: InputError for a threshold that is not above 0 or a certainty not between 0.5 and 1.
    """
    from scipy.special import ndtr

    _check(threshold, certainty)
    value, error = motion["ratio_signed"].to_numpy(), np.maximum(motion["ratio_err"].to_numpy(), _LEAST_ERROR)
    p = ndtr((threshold - value) / error) - ndtr((-threshold - value) / error)
    shell = np.select([p >= certainty, p <= 1 - certainty], ["stiff", "mobile"], default="undetermined")
    about = {"units": "1", "long_name": f"probability that the true ratio is below {threshold:g}"}
    judged = motion.assign(
        p_stiff=(("event", "sheet"), p, about),
        shell=(("event", "sheet"), shell, {"long_name": f"at a certainty of {certainty:g}"}),
    )
    return judged.assign_attrs(threshold=threshold, certainty=certainty)


def classify_shells(
    motion: xr.Dataset,
    *,
    threshold: float = 0.1,
    certainty: float = 0.9,
    effective_sheets: Callable[[Doubles], Doubles] | None = None,
) -> pd.DataFrame:
    """Size of the stiff inner shell, one row per event and side.

    The ratio should not fall with n, so it is fitted by isotonic regression (weights 1/error²), joined by
    straight lines between the middles of its steps; the shell is the sheets below the threshold.  The
    interval takes each possible size for as likely as the sheets' p_stiff make it: stiff up to there, mobile
    beyond.  Where the ratio falls with n by more than chance (`monotone` is False), sheets below the
    threshold are counted one by one instead, and the interval is that of a count.

    Args: as `judge_sheets`; certainty is also that of the interval.  effective_sheets, the force's M_eff
    at d in mm, for example `ModelFits.effective_sheets`.

    Returns: event, d_v_mm, side, stiff_sheets, stiff_low, stiff_high (missing, <NA>, with fewer than three
    ratios on that side), M_eff_model (NaN without a model), and as additions stiff_breakpoint, monotone and
    sheets_known.  stiff_breakpoint needs no threshold: the n at which a flat inner part with a rising
    straight line after it fits best; NaN where the ratio does not rise or fewer than five ratios are known.
    Unknown sheets inside a shell count as part of it.
    Raises: InputError as `judge_sheets`.  Source: paper, shaded region of the deformation figure.
    """
    import pandas as pd

    judged = judge_sheets(motion, threshold=threshold, certainty=certainty)
    sides = [_Side.of(judged, side) for side in np.unique(judged["side"].to_numpy())]
    table = pd.concat([_side_table(side, judged, threshold, certainty) for side in sides])
    table = table.sort_values(["event", "side"], ignore_index=True)
    table.attrs |= {"threshold": threshold, "certainty": certainty}
    return table if effective_sheets is None else with_model(table, effective_sheets)


def with_model(shells: pd.DataFrame, effective_sheets: Callable[[Doubles], Doubles]) -> pd.DataFrame:
    """The same table with M_eff_model filled in: the force's M_eff a side at d_v, mm."""
    d_mm = shells["d_v_mm"].to_numpy(float)
    return shells.assign(M_eff_model=np.asarray(effective_sheets(d_mm), float))


def deformation_table(motion: xr.Dataset, *, threshold: float = 0.1, certainty: float = 0.9) -> pd.DataFrame:
    """deformation.csv: one row per event and sheet, event after event; then frames used and the flag."""
    import pandas as pd

    judged = judge_sheets(motion, threshold=threshold, certainty=certainty)
    events, sheets = judged.sizes["event"], judged.sizes["sheet"]
    columns = {
        "event": np.repeat(judged["event"].to_numpy(), sheets),
        "index": np.tile(judged["sheet"].to_numpy(), events),
        "side": np.tile(judged["side"].to_numpy(), events),
        "n": np.tile(judged["n"].to_numpy(), events),
    }
    lengths = ["sigma_x_um", "sigma_x_corrected_um", "sweep_um"]
    columns |= {name: judged[name].to_numpy().ravel() for name in lengths}
    columns["stick_length_um"] = np.repeat(judged["stick_length_um"].to_numpy(), sheets)
    verdicts = ["ratio", "ratio_err", "p_stiff", "shell", "frames", "flag"]
    return pd.DataFrame(columns | {name: judged[name].to_numpy().ravel() for name in verdicts})


def _check(threshold: float, certainty: float) -> None:
    if not (np.isfinite(threshold) and threshold > 0):
        raise InputError("--threshold", "a number above 0", f"{threshold:g}", "0.1 is the publication's")
    if not 0.5 < certainty < 1:
        raise InputError("certainty", "a probability above 0.5 and below 1", f"{certainty:g}")


@dataclass(frozen=True)
class _Side:
    """One side of the comb from the centre outwards: n (N,), the rest (event, N), NaN where unknown.

    value: the ratio, negative where the sheet seems to move outwards, but not surely.
    """

    side: int
    n: Doubles
    value: Doubles
    error: Doubles
    p_stiff: Doubles

    @classmethod
    def of(cls, judged: xr.Dataset, side: int) -> _Side:
        number = judged["n"].to_numpy()
        place = np.flatnonzero(judged["side"].to_numpy() == side)
        place = place[np.argsort(number[place])]
        signed, ratio, error, p = (
            judged[name].to_numpy()[:, place] for name in ("ratio_signed", "ratio", "ratio_err", "p_stiff")
        )
        value = np.where(judged["flag"].to_numpy()[:, place] == "outward", ratio, signed)
        return cls(int(side), number[place].astype(float), value, np.maximum(error, _LEAST_ERROR), p)

    @property
    def known(self) -> NDArray[np.bool_]:
        return np.isfinite(self.value) & np.isfinite(self.error)


def _side_table(side: _Side, judged: xr.Dataset, threshold: float, certainty: float) -> pd.DataFrame:
    import pandas as pd

    rising, monotone = _isotonic(side)
    known = side.known.sum(axis=1)
    below = np.where(monotone[:, None], rising < threshold, side.value < threshold)
    size = below.sum(axis=1)
    by_boundary, by_count = _boundary_interval(side, certainty), _count_interval(side, size, certainty)
    low, high = (np.where(monotone, a, b) for a, b in zip(by_boundary, by_count, strict=True))
    enough = known >= _LEAST_SHEETS
    whole = {"stiff_sheets": size, "stiff_low": np.minimum(low, size), "stiff_high": np.maximum(high, size)}
    d_v = judged["d_v_mm"].to_numpy() if "d_v_mm" in judged.coords else np.full(size.size, np.nan)
    return pd.DataFrame(
        {"event": judged["event"].to_numpy(), "d_v_mm": d_v, "side": side.side}
        | {name: pd.Series(count).astype("Int64").where(enough) for name, count in whole.items()}
        | {
            "M_eff_model": np.nan,
            "stiff_breakpoint": _breakpoint(side),
            "monotone": monotone,
            "sheets_known": known,
        }
    )


def _isotonic(side: _Side) -> tuple[Doubles, NDArray[np.bool_]]:
    """The ratio as a rising function of n at every sheet, (event, N), and whether the data allow one."""
    from scipy.optimize import isotonic_regression
    from scipy.stats import chi2

    rising = np.full(side.value.shape, np.nan)
    misfit = np.zeros(len(rising))
    for event, known in enumerate(side.known):
        if not known.any():
            continue
        value, weight, n = side.value[event, known], side.error[event, known] ** -2, side.n[known]
        fit = isotonic_regression(value, weights=weight)
        first = fit.blocks[:-1]
        middle = np.add.reduceat(n, first) / np.diff(fit.blocks)
        rising[event] = np.interp(side.n, middle, fit.x[first])
        misfit[event] = np.sum(weight * (value - fit.x) ** 2)
    return rising, misfit <= chi2.isf(_NOT_BY_CHANCE, np.maximum(side.known.sum(axis=1), 1))


def _boundary_interval(side: _Side, certainty: float) -> tuple[Doubles, Doubles]:
    """Smallest and largest likely number of stiff sheets if all of them lie inside all mobile ones."""
    p = np.where(side.known, np.clip(side.p_stiff, _LEAST_CHANCE, 1 - _LEAST_CHANCE), 0.5)
    inside = np.pad(np.cumsum(np.log(p), axis=1), ((0, 0), (1, 0)))
    outside = np.pad(np.cumsum(np.log1p(-p)[:, ::-1], axis=1)[:, ::-1], ((0, 0), (0, 1)))
    likely = inside + outside
    likely = np.exp(likely - likely.max(axis=1, keepdims=True))
    reached = np.cumsum(likely, axis=1) / likely.sum(axis=1, keepdims=True)
    tail = (1 - certainty) / 2
    return (reached < tail).sum(axis=1).astype(float), (reached < 1 - tail).sum(axis=1).astype(float)


def _count_interval(side: _Side, size: NDArray[np.int64], certainty: float) -> tuple[Doubles, Doubles]:
    """The same for stiff sheets anywhere: a sum of independent chances about the sheets counted."""
    from scipy.special import ndtri

    p = np.where(side.known, side.p_stiff, 0.5)
    reach = ndtri((1 + certainty) / 2) * np.sqrt((p * (1 - p)).sum(axis=1))
    return np.maximum(np.floor(size - reach), 0), np.minimum(np.ceil(size + reach), side.n.size)


def _breakpoint(side: _Side) -> Doubles:
    """Where a flat inner part and a straight rise meet best, in n, (event,): all knees tried at once."""
    knee = np.arange(side.n[0], side.n[-1] - 1, 0.5)
    weight = np.where(side.known, side.error**-2.0, 0.0)
    value = np.where(side.known, side.value, 0.0)
    ramp = np.maximum(side.n - knee[:, None], 0.0)
    total = weight.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = value - (weight * value).sum(axis=1, keepdims=True) / total
        middle = weight @ ramp.T / total
        along = (weight * value) @ ramp.T
        slope = along / (weight @ (ramp**2).T - total * middle**2)
    gain = np.nan_to_num(np.where(slope > 0, slope * along, 0.0))
    if knee.size == 0:
        return np.full(len(value), np.nan)
    best = knee[gain.argmax(axis=1)]
    return np.where((gain.max(axis=1) > 0) & (side.known.sum(axis=1) >= _LEAST_SHEETS + 2), best, np.nan)
