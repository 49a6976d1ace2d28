"""Classification of sheets as stiff or mobile, and the size of the stiff shell in each stick phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pandas as pd
import scipy
import xarray as xr

from vision.data import MOTION, STIFF_BELOW, Tunable, changed_settings, check_threshold, record
from vision.errors import check_kind
from vision.memory import row_parts
from vision.numeric import Bools, Floats, Floats32, Ints


@dataclass(frozen=True, kw_only=True, repr=False)
class ShellSettings(Tunable):
    """Tunable constants of the statistics of shells, measured on the scenes of `tests/test_shells.py`."""

    sheet_scatters: tuple[float, ...] = (0.03, 0.08, 0.15, 0.25)
    """Possible relative scatters of the sheets about a smooth profile, of which the likeliest is used. The
    single value 0.08 widens the intervals by 7 %, 0.25 by 18 %."""
    profile_error: float = 0.2
    """Difference of real profiles from the model profiles, as a fraction of their distance from the
    threshold. Smaller → intervals too narrow for other shapes (at 0, 72 % contain the truth)."""
    profile_error_growth: float = 0.5
    """Relative growth of that difference per threshold of distance. At 0 sheets far from the threshold have
    too much weight, and 1 % fewer of the intervals contain the truth."""
    draws: int = 256
    """Number of random profiles per event. More → smoother intervals, slower."""
    certainty: float = 0.9
    """Probability that an interval contains the true size, and the least at which a sheet is called stiff or
    mobile. Smaller → shorter intervals that miss more often."""
    significance: float = 1e-3
    """Probability of chance below which a decrease of the ratio with n, or an increase, is significant."""
    fit_sigma: float = 2.0
    """Standard errors by which M_eff of the fit must lie outside a shell's interval to contradict it. At 1
    contradictions arise by chance where Λ̂ is uncertain; at 3 a d0 wrong by 3.6 mm passes."""
    contradicted_share: float = 0.5
    """Share of stick phases and sides that must contradict the fit, or each other, for a warning. 0.2 gives
    false warnings in short recordings; at 1 a single agreement suppresses it."""


def classify_sheets(
    motion: xr.Dataset, *, threshold: float = STIFF_BELOW, settings: ShellSettings = ShellSettings()
) -> xr.Dataset:
    """Classify each sheet as stiff or mobile from its own ratio alone.

    Parameters
    ----------
    motion
        From `horizontal_deformation`.
    threshold
        σ_x/Λ_st below which a sheet is stiff.
    settings
        See `ShellSettings`.

    Returns
    -------
    `motion` with two more variables (event, sheet): p_stiff, the probability that the true ratio is below the
    threshold, given `ratio_signed` and its normal error (NaN where there is no ratio); and shell: "stiff",
    "mobile" or "undetermined".

    Raises
    ------
    InputError
        If the threshold is not above 0, or above 1.
    """
    MOTION.check(motion)
    check_threshold(threshold)
    certainty = settings.certainty
    value, error = motion["ratio_signed"].to_numpy(), np.maximum(motion["ratio_err"].to_numpy(), LEAST_ERROR)
    p = scipy.special.ndtr((threshold - value) / error) - scipy.special.ndtr((-threshold - value) / error)
    shell = np.select([p >= certainty, p <= 1 - certainty], ["stiff", "mobile"], default="undetermined")
    about = {"units": "1", "long_name": f"probability that the true ratio is below {threshold:g}"}
    classified = motion.assign(
        p_stiff=(("event", "sheet"), p, about),
        shell=(("event", "sheet"), shell, {"long_name": f"at a certainty of {certainty:g}"}),
    )
    return record(classified, "classify_sheets", threshold=threshold, settings=changed_settings(settings))


def deformation_table(
    motion: xr.Dataset, *, threshold: float = STIFF_BELOW, settings: ShellSettings = ShellSettings()
) -> pd.DataFrame:
    """Return the table of `deformation.csv`: one row per event and sheet, in this order."""
    classified = classify_sheets(motion, threshold=threshold, settings=settings).rename(sheet="index")
    names = ["side", "n", "sigma_x_um", "sigma_x_corrected_um", "sweep_um", "stick_length_um"]
    names += ["ratio", "ratio_err", "p_stiff", "shell", "frames", "flag"]
    table = classified.reset_coords()[names].to_dataframe(dim_order=["event", "index"])
    return table.reset_index()[["event", "index", *names]]


def classify_shells(
    motion: xr.Dataset,
    *,
    threshold: float = STIFF_BELOW,
    effective_sheets: Callable[[Floats], Floats] | None = None,
    settings: ShellSettings = ShellSettings(),
) -> pd.DataFrame:
    """Estimate the size of the stiff inner shell of each side in each stick phase.

    The ratio is expected not to decrease with n. Some thousand increasing profiles, from power laws to steps,
    are weighted by how well they fit all sheets on one side. True ratios are drawn about them, and those
    below the threshold are counted in each draw. The size is the median; the interval contains the share
    `certainty` of the draws. The errors of the stick length and of the camera movement are common to all
    sheets of an event.

    Parameters
    ----------
    motion, threshold, settings
        As in `classify_sheets`.
    effective_sheets
        M_eff according to the force as a function of d in mm, for example `ModelFits.effective_sheets`.

    Returns
    -------
    A table with one row per event and side, and the columns event, d_v_mm, side; stiff_sheets, stiff_low,
    stiff_high (missing (<NA>) with fewer than three ratios on that side; unknown sheets inside a shell count
    as part of it); M_eff_model (NaN without a model); monotone (False if the ratio decreases significantly
    with n, by isotonic regression); and sheets_known (number of sheets with a ratio).

    Raises
    ------
    InputError
        If the threshold is not above 0, or above 1.

    Notes
    -----
    Source: paper, shaded region of the deformation figure.
    """
    MOTION.check(motion)
    check_threshold(threshold)
    check_kind(
        Callable | None, "a function, such as that of `vision.fit_models`", effective_sheets=effective_sheets
    )
    sides = [Side.of(motion, side) for side in np.unique(motion["side"].to_numpy())]
    table = pd.concat([_side_table(side, motion, threshold, settings) for side in sides])
    table = table.sort_values(["event", "side"], ignore_index=True)
    if effective_sheets is not None:
        d_mm = table["d_v_mm"].to_numpy(float)
        table["M_eff_model"] = np.asarray(effective_sheets(d_mm), float)
    return record(table, "classify_shells", threshold=threshold, settings=changed_settings(settings))


def _side_table(side: Side, motion: xr.Dataset, threshold: float, settings: ShellSettings) -> pd.DataFrame:
    """The rows of one side in the table of `classify_shells`."""
    known = side.known.sum(axis=1)
    names = ("stiff_sheets", "stiff_low", "stiff_high")
    sizes = shell_sizes(side, threshold=threshold, settings=settings)
    d_v = motion["d_v_mm"].to_numpy() if "d_v_mm" in motion.coords else np.full(known.size, np.nan)
    return pd.DataFrame(
        {"event": motion["event"].to_numpy(), "d_v_mm": d_v, "side": side.side}
        | {
            name: pd.Series(count).astype("Int64").where(known >= 3)  # fewer are no profile
            for name, count in zip(names, sizes, strict=True)
        }
        | {"M_eff_model": np.nan, "monotone": isotonic(side, settings.significance)[1], "sheets_known": known}
    )


# --- the sheets of one side ---------------------------------------------------------------------------------

LEAST_ERROR = 1e-9  # of a ratio
EVENTS_AT_ONCE = 32  # whose tables of likelihoods are in memory together


@dataclass(frozen=True)
class Side:
    """Ratios of the N sheets of one side, from the centre outwards; NaN where unknown."""

    side: int  # -1 or +1
    n: Floats  # (N,)
    value: Floats  # ratio; negative where outward movement is not significant, (event, N)
    error: Floats  # (event, N)
    length_err: Floats  # relative error from the ends of the stick, common to all sheets, (event,)
    shared_err: Floats  # error of the ratio from camera movement, common to all sheets, (event,)

    @classmethod
    def of(cls, motion: xr.Dataset, side: int) -> Side:
        """The sheets of one side, -1 or +1, of a Dataset from `horizontal_deformation`."""
        number = motion["n"].to_numpy()
        index = np.flatnonzero(motion["side"].to_numpy() == side)
        index = index[np.argsort(number[index])]
        signed, ratio, error = (
            motion[name].to_numpy()[:, index] for name in ("ratio_signed", "ratio", "ratio_err")
        )
        value = np.where(motion["flag"].to_numpy()[:, index] == "outward", ratio, signed)
        length_err, shared = np.zeros((2, len(value)))
        if "drift_err_um" in motion:
            drift_err = motion["drift_err_um"] / motion["stick_length_um"] / np.sqrt(12)
            length_err, shared = np.nan_to_num((motion["length_err"].to_numpy(), drift_err.to_numpy()))
        error = np.maximum(error, LEAST_ERROR)
        return cls(int(side), number[index].astype(float), value, error, length_err, shared)

    @property
    def known(self) -> Bools:
        """Whether there is a ratio with an error, (event, N)."""
        return np.isfinite(self.value) & np.isfinite(self.error)


def isotonic(side: Side, significance: float) -> tuple[Floats, Bools]:
    """Fit the ratio by an increasing function of n, (event, N); also return its acceptance, (event,).

    The steps of the isotonic regression (weights 1/error²) are joined by straight lines between their
    middles; NaN without known sheets. An increasing function is rejected if χ² is less probable than
    `significance`.
    """
    increasing = np.full(side.value.shape, np.nan)
    misfit = np.zeros(len(increasing))
    for event, known in enumerate(side.known):
        if not known.any():
            continue
        value, weight, n = side.value[event, known], side.error[event, known] ** -2, side.n[known]
        fit = scipy.optimize.isotonic_regression(value, weights=weight)
        first = fit.blocks[:-1]
        middle = np.add.reduceat(n, first) / np.diff(fit.blocks)
        increasing[event] = np.interp(side.n, middle, fit.x[first])
        misfit[event] = np.sum(weight * (value - fit.x) ** 2)
    limit = scipy.special.chdtri(np.maximum(side.known.sum(axis=1), 1), significance)
    return increasing, misfit <= limit


# --- sizes --------------------------------------------------------------------------------------------------


def shell_sizes(
    side: Side, *, threshold: float, settings: ShellSettings = ShellSettings()
) -> tuple[Ints, Ints, Ints]:
    r"""Number of stiff sheets of one side, (event,): median and ends of the shortest interval.

    Profile :math:`j` has the weight :math:`\exp(-\tfrac12 \sum_n (r_n - p_j(n))^2 / s_n^2)`, where
    :math:`s_n` combines the error of the ratio :math:`r_n` and the scatter of sheets about a profile. Stick
    lengths and camera movement are varied by their errors, for all sheets together. If the ratio decreases
    significantly with n, all sheets of the event are counted by their own measurement.
    """
    profiles = _Profiles.crossing(tuple(side.n), threshold)
    sheets = _Ratios.of(side, threshold, settings)
    relative = _likeliest_scatter(sheets, profiles.thinned())
    alone = ~isotonic(side, settings.significance)[1]
    sizes = []
    for block in row_parts(alone.size, EVENTS_AT_ONCE):
        share, _ = _profile_weights(profiles, sheets.at(block), relative)
        ratio = _draw_ratios(profiles, share, sheets.at(block), relative, alone[block])
        count = _count_below(ratio, threshold, side.length_err[block], side.shared_err[block])
        sizes.append(_median_and_interval(count, settings.certainty))
    size, low, high = np.concatenate(sizes, axis=1)
    return size, low, high


# --- profiles -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Profiles:
    """Profiles: ratios that never decrease with n, sorted by the number of sheets below the threshold.

    In single precision, because likelihoods of thousands of profiles take time.
    """

    ratio: Floats32  # (profile, sheet)
    half_square: Floats32  # half the square of the ratio, (profile, sheet)

    @classmethod
    @lru_cache(maxsize=4)  # for the next sticks of the same sheets; 4 MB each
    def crossing(cls, sheets: tuple[float, ...], threshold: float) -> _Profiles:
        """Profiles at the sheets' numbers n, from the centre outwards, that cross the threshold t at n = b.

        They are t (c + (C - c) h/(1 + h)) with h ∝ max(1 + (n - b)/a, 0)^q: constant up to b - a, then a
        power law that saturates at a ceiling C. They include power laws through the centre (a = b, c = 0),
        constant cores with a linear increase (q = 1), steps (small a, low ceiling) and sigmoids. All b from
        inside the innermost to beyond the outermost sheet are equally frequent.
        """
        n = np.array(sheets)
        step = max(0.5, (n[-1] - n[0]) / 120)
        crossing = np.arange(n[0] - 3, n[-1] + 6, step) + step / 2
        onset, exponent = np.geomspace(0.6, 30, 7), (0.6, 1.4, 4.0)
        floor, ceiling = (0.0, 0.3, 0.7), (1.5, 2.5, 5.0, 1e4)
        grid = np.meshgrid(crossing, onset, exponent, floor, ceiling, indexing="ij")
        b, a, q, c, top = (part.reshape(-1, 1) for part in grid)
        rise = (1 - c) / (top - 1) * np.maximum(1 + (n - b) / a, 0) ** q
        ratio = threshold * np.minimum(c + (top - c) * rise / (1 + rise), 30)
        ratio = ratio[np.argsort((ratio < threshold).sum(axis=1), kind="stable")]
        return cls(ratio.astype(np.float32), (ratio**2 / 2).astype(np.float32))

    def thinned(self) -> _Profiles:
        """Every fifth profile, for a coarse answer; all shapes remain, as 5 divides no grid dimension."""
        return _Profiles(self.ratio[::5].copy(), self.half_square[::5].copy())


@dataclass(frozen=True)
class _Ratios:
    """Measured ratios of the sheets in some events, (event, N)."""

    value: Floats  # 0 where unknown
    variance: Floats  # inf where unknown
    smooth: Floats  # ratio by the isotonic regression, for which the scatter is calculated
    threshold: float
    settings: ShellSettings

    @classmethod
    def of(cls, side: Side, threshold: float, settings: ShellSettings) -> _Ratios:
        """The ratios of one side; all sheets follow the profile."""
        known = side.known
        return cls(
            np.where(known, side.value, 0.0),
            np.where(known, side.error**2, np.inf),
            np.maximum(np.nan_to_num(isotonic(side, settings.significance)[0]), 0.0),
            threshold,
            settings,
        )

    def at(self, events: slice | Ints) -> _Ratios:
        """The ratios in these events."""
        names = ("value", "variance", "smooth")
        return replace(self, **{name: getattr(self, name)[events] for name in names})

    def scatter(self, ratio: Floats, relative: float) -> Floats:
        """Variance of true ratios about profiles of this ratio, plus that of real about model profiles."""
        distance = np.abs(ratio / self.threshold - 1)
        growth = 1 + self.settings.profile_error_growth * distance
        model_err = self.settings.profile_error * distance * growth * self.threshold
        return np.asarray((relative * ratio) ** 2 + model_err**2)


def _profile_weights(profiles: _Profiles, sheets: _Ratios, relative: float) -> tuple[Floats32, Floats]:
    """Weight of each profile in each event, (event, profile), with sum 1, and the log evidence, (event,)."""
    variance = sheets.variance + sheets.scatter(sheets.smooth, relative)  # inf where unknown
    weight = 1 / variance
    log_likelihood = (weight * sheets.value).astype(np.float32) @ profiles.ratio.T
    log_likelihood -= weight.astype(np.float32) @ profiles.half_square.T
    largest = log_likelihood.max(axis=1, keepdims=True)
    share = np.exp(log_likelihood - largest)
    total = share.sum(axis=1, keepdims=True)
    constant = np.log(np.where(weight > 0, weight, 1.0)) - weight * sheets.value**2
    return share / total, (largest + np.log(total))[:, 0] + constant.sum(axis=1) / 2


def _likeliest_scatter(sheets: _Ratios, profiles: _Profiles) -> float:
    """Relative scatter of sheets about their profile with the largest evidence, from about 40 events."""
    some = sheets.at(slice(None, None, max(1, len(sheets.value) // 40)))
    scatters = sheets.settings.sheet_scatters
    evidence = [_profile_weights(profiles, some, relative)[1].sum() for relative in scatters]
    return scatters[int(np.argmax(evidence))]


# --- draws --------------------------------------------------------------------------------------------------


def _draw_ratios(
    profiles: _Profiles, share: Floats32, sheets: _Ratios, relative: float, alone: Bools
) -> Floats:
    """Draw true ratios given the data, (event, draw, N): profiles by their share, and sheets about them.

    In the events `alone` the measurements count alone. The random numbers are the same in each call, so that
    results are reproducible.
    """
    draws = sheets.settings.draws
    rng = np.random.default_rng(0)
    profile = profiles.ratio[_draw_profiles(share, draws)].astype(float)
    scatter = sheets.scatter(profile, relative)
    # The mean of profile and measurement weighted by inverse variances; either may have no weight.
    without_profile = alone[:, None] & np.isfinite(sheets.variance)
    precision = np.where(without_profile[:, None], 0.0, 1 / scatter) + 1 / sheets.variance[:, None]
    own_weight = 1 / sheets.variance[:, None] / precision
    ratio = profile + own_weight * (sheets.value[:, None] - profile)
    return np.asarray(ratio + rng.standard_normal((draws, profile.shape[2])) / np.sqrt(precision))


def _draw_profiles(share: Floats32, draws: int) -> Ints:
    """Indices of profiles drawn in proportion to their share, at regular quantiles, (event, draw)."""
    events, count = share.shape
    row = 2 * np.arange(events)[:, None]  # separates the events, so that one search serves all
    cumulative = np.cumsum(share, axis=1, dtype=float)
    quantile = (np.arange(draws) + 0.5) / draws * cumulative[:, -1:]
    index = np.searchsorted((cumulative + row).ravel(), (quantile + row).ravel()) % count
    return np.asarray(index.reshape(events, draws))


def _count_below(ratio: Floats, threshold: float, length_err: Floats, shared_err: Floats) -> Ints:
    """Number of ratios below the threshold in each draw, also of the errors of all sheets, (event, draw)."""
    length, shift = np.random.default_rng(1).standard_normal((2, ratio.shape[1]))
    limit = threshold * (1 + length_err[:, None] * length) + shared_err[:, None] * shift
    return np.asarray((np.abs(ratio) < limit[..., None]).sum(axis=2))


def _median_and_interval(sizes: Ints, certainty: float) -> Ints:
    """Median, and ends of the shortest interval with the share `certainty` of the draws, (3, event)."""
    draws = sizes.shape[1]
    ordered = np.sort(sizes, axis=1)
    inside = int(np.ceil(certainty * draws))
    first = np.arange(draws - inside + 1)
    length = ordered[:, inside - 1 :] - ordered[:, first]
    # Of equally short intervals, the most central one.
    best = (length + np.abs(first - first.mean()) / draws).argmin(axis=1)
    event = np.arange(len(ordered))
    return np.stack([ordered[:, draws // 2], ordered[event, best], ordered[event, best + inside - 1]])
