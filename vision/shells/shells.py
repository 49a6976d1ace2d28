"""Which sheets are stiff, and the size of the stiff inner shell of each side in each stick phase."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pandas as pd
import scipy
import xarray as xr

from vision.data import MOTION, ShellMetadata, record
from vision.errors import InputError
from vision.numeric import Bools, Floats, Floats32, Ints


@dataclass(frozen=True, kw_only=True)
class ShellSettings:
    """Everything in the statistics of shells that can be tuned; measured on the scenes of
    `tests/shells/test_shells.py`."""

    sheet_scatters: tuple[float, ...] = (0.03, 0.08, 0.15, 0.25)
    """Relative scatter of the sheets about a smooth profile, of which the likeliest is taken. One value of
    0.08 in its place widens the intervals by 7 %, 0.25 by 18 %."""
    profile_error: float = 0.2
    """By how much of their distance from the threshold real profiles differ from those tried. Smaller →
    intervals too narrow for shapes not tried (72 % hold the truth at 0); larger → they widen."""
    profile_error_growth: float = 0.5
    """By how much more they differ, per threshold of distance. 0 lets sheets far from the threshold decide,
    and costs 1 % of the intervals."""
    outlier_sigma: float = 4.0
    """Standard deviations from all profiles beyond which a sheet is counted by its own measurement. Smaller →
    single sheets count where noise is large; larger → one odd sheet moves the shell
    (`test_single_sheets_do_not_decide`)."""
    misread_share: float = 0.2
    """Share of such sheets that are taken to be misread. 0 makes intervals too narrow where sheets are
    misread: 80 % hold the truth in place of 97 %."""
    draws: int = 256
    """Random profiles per event. More → smoother intervals, slower."""
    significance: float = 1e-3
    """Probability of chance below which a fall of the ratio with n, or a rise, is accepted."""
    fit_sigma: float = 2.0
    """Standard errors by which M_eff of the fit must lie outside a shell's interval to contradict it. At 1
    chance decides where Λ̂ is known badly; at 3 a d0 wrong by 3.6 mm passes (`fixtures/late` read with 13)."""
    contradicted_share: float = 0.5
    """Share of stick phases and sides that must contradict the fit for a warning. Intervals miss the truth in
    a tenth: at 0.2 chance warns in short recordings; at 1 one phase that agrees keeps it quiet."""


def classify_sheets(motion: xr.Dataset, *, threshold: float = 0.1, certainty: float = 0.9) -> xr.Dataset:
    """Probability that each sheet is stiff, taken on its own.

    Parameters
    ----------
    motion
        From `horizontal_deformation`.
    threshold
        σ_x/Λ_st below which a sheet is stiff.
    certainty
        Probability from which on a sheet is called stiff or mobile.

    Returns
    -------
    `motion` with two more variables (event, sheet): p_stiff, the probability that the true ratio lies below
    the threshold given `ratio_signed` and its normal error (NaN where there is no ratio), and shell: "stiff",
    "mobile" or "undetermined".

    Raises
    ------
    InputError
        For a threshold that is not above 0 or a certainty not between 0.5 and 1.
    """
    MOTION.check(motion)
    _check(threshold, certainty)
    value, error = motion["ratio_signed"].to_numpy(), np.maximum(motion["ratio_err"].to_numpy(), LEAST_ERROR)
    p = scipy.special.ndtr((threshold - value) / error) - scipy.special.ndtr((-threshold - value) / error)
    shell = np.select([p >= certainty, p <= 1 - certainty], ["stiff", "mobile"], default="undetermined")
    about = {"units": "1", "long_name": f"probability that the true ratio is below {threshold:g}"}
    judged = motion.assign(
        p_stiff=(("event", "sheet"), p, about),
        shell=(("event", "sheet"), shell, {"long_name": f"at a certainty of {certainty:g}"}),
    )
    judged = judged.assign_attrs(ShellMetadata(threshold=threshold, certainty=certainty).attrs())
    return record(judged, "classify_sheets", threshold=threshold, certainty=certainty)


def deformation_table(motion: xr.Dataset, *, threshold: float = 0.1, certainty: float = 0.9) -> pd.DataFrame:
    """The table of `deformation.csv`: one row per event and sheet, event after event.

    Parameters are those of `classify_sheets`.
    """
    judged = classify_sheets(motion, threshold=threshold, certainty=certainty)
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
    rest = ["ratio", "ratio_err", "p_stiff", "shell", "frames", "flag"]
    return pd.DataFrame(columns | {name: judged[name].to_numpy().ravel() for name in rest})


def classify_shells(
    motion: xr.Dataset,
    *,
    threshold: float = 0.1,
    certainty: float = 0.9,
    effective_sheets: Callable[[Floats], Floats] | None = None,
    settings: ShellSettings = ShellSettings(),
) -> pd.DataFrame:
    """Size of the stiff inner shell of each side in each stick phase, one row per event and side.

    The ratio should not fall with n. Some thousand rising profiles, from power laws to steps, are each
    weighted by how well they fit all sheets of that side, and true ratios are drawn about them, near each
    sheet's own measurement as far as its error is small; the number below the threshold is counted in each
    draw. The size is the median, the interval holds `certainty` of the draws. Sheets far off every profile
    are counted by their own measurement. Errors of the stick length and of the camera's movement are shared
    by all sheets of an event.

    Parameters
    ----------
    motion
        From `horizontal_deformation`.
    threshold
        σ_x/Λ_st below which a sheet is stiff.
    certainty
        Probability that the interval holds the true size.
    effective_sheets
        The force's M_eff at d in mm, for example `ModelFits.effective_sheets`.
    settings
        See `ShellSettings`.

    Returns
    -------
    A table with the columns

    - event, d_v_mm, side;
    - stiff_sheets, stiff_low, stiff_high: missing (<NA>) with fewer than three ratios on that side; unknown
      sheets inside a shell count as part of it;
    - M_eff_model: NaN without a model;
    - stiff_breakpoint, which needs no threshold: the n at which a flat inner part with a rising straight line
      after it fits best; NaN where the rise is not significant or fewer than five ratios are known;
    - monotone: False where the ratio falls with n by more than chance (isotonic regression);
    - sheets_known: number of sheets with a ratio.

    Raises
    ------
    InputError
        For a threshold that is not above 0 or a certainty not between 0.5 and 1.

    Notes
    -----
    Source: paper, shaded region of the deformation figure.
    """
    MOTION.check(motion)
    _check(threshold, certainty)
    sides = [Side.of(motion, side) for side in np.unique(motion["side"].to_numpy())]
    table = pd.concat([_side_table(side, motion, threshold, certainty, settings) for side in sides])
    table = table.sort_values(["event", "side"], ignore_index=True)
    table.attrs |= ShellMetadata(threshold=threshold, certainty=certainty).attrs()
    table = record(table, "classify_shells", threshold=threshold, certainty=certainty)
    return table if effective_sheets is None else with_model(table, effective_sheets)


def with_model(shells: pd.DataFrame, effective_sheets: Callable[[Floats], Floats]) -> pd.DataFrame:
    """The same table with M_eff_model filled in: the force's M_eff per side at d_v, mm."""
    d_mm = shells["d_v_mm"].to_numpy(float)
    return shells.assign(M_eff_model=np.asarray(effective_sheets(d_mm), float))


def _side_table(
    side: Side, motion: xr.Dataset, threshold: float, certainty: float, settings: ShellSettings
) -> pd.DataFrame:
    known = side.known.sum(axis=1)
    names = ("stiff_sheets", "stiff_low", "stiff_high")
    sizes = shell_sizes(side, threshold=threshold, certainty=certainty, settings=settings)
    d_v = motion["d_v_mm"].to_numpy() if "d_v_mm" in motion.coords else np.full(known.size, np.nan)
    return pd.DataFrame(
        {"event": motion["event"].to_numpy(), "d_v_mm": d_v, "side": side.side}
        | {
            name: pd.Series(count).astype("Int64").where(known >= 3)  # fewer are no profile
            for name, count in zip(names, sizes, strict=True)
        }
        | {
            "M_eff_model": np.nan,
            "stiff_breakpoint": breakpoint_n(side, settings.significance),
            "monotone": isotonic(side, settings.significance)[1],
            "sheets_known": known,
        }
    )


def _check(threshold: float, certainty: float) -> None:
    """Raises InputError for a threshold or certainty that cannot be meant."""
    if not (np.isfinite(threshold) and threshold > 0):
        raise InputError("`threshold`", "a number above 0", f"{threshold:g}", "0.1 is the publication's")
    if not 0.5 < certainty < 1:
        raise InputError("`certainty`", "a probability above 0.5 and below 1", f"{certainty:g}")


# --- the sheets of one side ---------------------------------------------------------------------------------

LEAST_ERROR = 1e-9  # of a ratio


@dataclass(frozen=True)
class Side:
    """One side of the assembly from the centre outwards, NaN where unknown."""

    side: int  # -1 or +1
    n: Floats  # (N,)
    value: Floats  # the ratio, negative where movement outwards is not significant, (event, N)
    error: Floats  # (event, N)
    length_err: Floats  # relative error of the stick length, which all sheets share, (event,)
    shared_err: Floats  # error of the ratio that all sheets share, of the camera's movement, (event,)

    @classmethod
    def of(cls, motion: xr.Dataset, side: int) -> Side:
        """The sheets of one side, -1 or +1, of a Dataset of `horizontal_deformation`."""
        number = motion["n"].to_numpy()
        place = np.flatnonzero(motion["side"].to_numpy() == side)
        place = place[np.argsort(number[place])]
        signed, ratio, error = (
            motion[name].to_numpy()[:, place] for name in ("ratio_signed", "ratio", "ratio_err")
        )
        value = np.where(motion["flag"].to_numpy()[:, place] == "outward", ratio, signed)
        shared = np.zeros(len(value))
        if "drift_err_um" in motion:
            drift_err = motion["drift_err_um"] / motion["stick_length_um"] / np.sqrt(12)
            shared = np.nan_to_num(drift_err.to_numpy())
        error, length_err = np.maximum(error, LEAST_ERROR), _length_err(motion)
        return cls(int(side), number[place].astype(float), value, error, length_err, shared)

    @property
    def known(self) -> Bools:
        """Where there is a ratio with an error, (event, N)."""
        return np.isfinite(self.value) & np.isfinite(self.error)

    def without(self, sheets: Bools) -> Side:
        """The same with these sheets (event, N) unknown."""
        return replace(self, value=np.where(sheets, np.nan, self.value))


def isotonic(side: Side, significance: float) -> tuple[Floats, Bools]:
    """The ratio as a rising function of n at every sheet, (event, N), and whether the data allow one,
    (event,).

    Steps of the isotonic regression (weights 1/error²) joined by straight lines between their middles; NaN
    without any known sheet. A rising function is rejected where χ² is less probable than `significance`.
    """
    rising = np.full(side.value.shape, np.nan)
    misfit = np.zeros(len(rising))
    for event, known in enumerate(side.known):
        if not known.any():
            continue
        value, weight, n = side.value[event, known], side.error[event, known] ** -2, side.n[known]
        fit = scipy.optimize.isotonic_regression(value, weights=weight)
        first = fit.blocks[:-1]
        middle = np.add.reduceat(n, first) / np.diff(fit.blocks)
        rising[event] = np.interp(side.n, middle, fit.x[first])
        misfit[event] = np.sum(weight * (value - fit.x) ** 2)
    return rising, misfit <= scipy.special.chdtri(np.maximum(side.known.sum(axis=1), 1), significance)


def breakpoint_n(side: Side, significance: float) -> Floats:
    """Where a flat inner part and a straight rise meet best, in n, (event,): all knees tried at once.

    NaN where the rise is not significant, or with fewer than five known sheets.
    """
    knee = np.arange(side.n[0], side.n[-1] - 1, 0.5)
    if knee.size == 0:
        return np.full(len(side.value), np.nan)
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
    sure = gain.max(axis=1) > scipy.special.chdtri(2, significance)
    enough = side.known.sum(axis=1) >= 5
    return np.asarray(np.where(sure & enough, knee[gain.argmax(axis=1)], np.nan))


def _length_err(motion: xr.Dataset) -> Floats:
    """Relative error of the stick length, (event,): the part of ratio_err beyond the error of σ_x.

    Read from the sheet with the largest ratio, where it shows best.
    """
    ratio = np.nan_to_num(motion["ratio"].to_numpy())
    own = motion["sigma_x_err_um"].to_numpy() / motion["stick_length_um"].to_numpy()[:, None]
    beyond = np.sqrt(np.maximum(motion["ratio_err"].to_numpy() ** 2 - own**2, 0))
    most = ratio.argmax(axis=1, keepdims=True)
    ratio, beyond = (np.take_along_axis(part, most, axis=1)[:, 0] for part in (ratio, beyond))
    share = np.divide(beyond, ratio, out=np.zeros_like(ratio), where=ratio > 0)
    return np.asarray(np.nan_to_num(share))


# --- sizes --------------------------------------------------------------------------------------------------


def shell_sizes(
    side: Side, *, threshold: float, certainty: float, settings: ShellSettings = ShellSettings()
) -> tuple[Ints, Ints, Ints]:
    r"""Stiff sheets of one side, (event,): the median, and the ends of the shortest interval at `certainty`.

    Profile :math:`j` has the weight :math:`\exp(-\tfrac12 \sum_n (r_n - p_j(n))^2 / s_n^2)`, where
    :math:`s_n` is the error of the ratio :math:`r_n` with the scatter of sheets about a profile. Profiles are
    drawn by their weights, true ratios are drawn about them given the measurements, and those below the
    threshold are counted. Stick lengths and the camera's movement are varied by their errors, for all sheets
    at once.

    Outliers from every profile are counted by their own measurement, except in the share of draws in which
    they are taken to be misread. So are all sheets of an event where the ratio falls with n beyond chance
    even without the outliers.
    """
    profiles = _Profiles.crossing(tuple(side.n), threshold)
    sheets = _Ratios.of(side, threshold, settings)
    sheets = replace(sheets, alone=_outliers(sheets, profiles.thinned()))
    relative = _likeliest_scatter(sheets, profiles.thinned())
    falls = ~isotonic(side.without(sheets.alone), settings.significance)[1]
    single = replace(sheets, alone=sheets.alone | (falls[:, None] & side.known))
    found = []
    for block in _blocks(len(falls)):
        share, _ = _weigh(profiles, sheets.at(block), relative)
        ratio = _draw_ratios(profiles, share, single.at(block), relative, outliers=sheets.alone[block])
        count = _count(ratio, threshold, side.length_err[block], side.shared_err[block])
        found.append(_summary(count, certainty))
    size, low, high = np.concatenate(found, axis=1)
    return size, low, high


# --- profiles -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Profiles:
    """Curves that never fall with n, ratio (curve, sheet), ordered by how many sheets are below threshold.

    half_square: half the ratio's square.  Single precision, as likelihoods of thousands of curves need speed.
    """

    ratio: Floats32
    half_square: Floats32

    @classmethod
    @lru_cache(maxsize=4)  # for the next sticks of the same sheets; 4 MB each
    def crossing(cls, sheets: tuple[float, ...], threshold: float) -> _Profiles:
        """Curves at the sheets' numbers n, from the centre outwards, that cross the threshold t at a place b.

        t (c + (C - c) h/(1 + h)) with h ∝ max(1 + (n - b)/a, 0)^q: nothing moves up to b - a, then a power
        law, levelling off towards a ceiling C. Power laws through the centre (a = b, c = 0), flat cores with
        a straight rise (q = 1), steps (small a, low ceiling) and sigmoids are among them or near. All b,
        from inside the innermost to beyond the outermost sheet, are equally frequent, half a sheet apart
        where sheets are not very many.
        """
        n = np.array(sheets)
        apart = max(0.5, (n[-1] - n[0]) / 120)
        place = np.arange(n[0] - 3, n[-1] + 6, apart) + apart / 2
        foot, bend = np.geomspace(0.6, 30, 7), (0.6, 1.4, 4.0)
        floor, ceiling = (0.0, 0.3, 0.7), (1.5, 2.5, 5.0, 1e4)
        every = np.meshgrid(place, foot, bend, floor, ceiling, indexing="ij")
        b, a, q, c, top = (part.reshape(-1, 1) for part in every)
        rise = (1 - c) / (top - 1) * np.maximum(1 + (n - b) / a, 0) ** q
        ratio = threshold * np.minimum(c + (top - c) * rise / (1 + rise), 30)
        ratio = ratio[np.argsort((ratio < threshold).sum(axis=1), kind="stable")]
        return cls(ratio.astype(np.float32), (ratio**2 / 2).astype(np.float32))

    def thinned(self) -> _Profiles:
        """A fifth of the curves, of all kinds as 5 divides none of their numbers, for a coarse answer."""
        return _Profiles(self.ratio[::5].copy(), self.half_square[::5].copy())


@dataclass(frozen=True)
class _Ratios:
    """What is known of the sheets of some events, (event, N): value 0 and variance inf where nothing is.

    usual: ratio from which the scatter is reckoned.  alone: sheets that do not follow the profile.
    """

    value: Floats
    variance: Floats
    usual: Floats
    alone: Bools
    threshold: float
    settings: ShellSettings

    @classmethod
    def of(cls, side: Side, threshold: float, settings: ShellSettings) -> _Ratios:
        known = side.known
        return cls(
            np.where(known, side.value, 0.0),
            np.where(known, side.error**2, np.inf),
            np.maximum(np.nan_to_num(isotonic(side, settings.significance)[0]), 0.0),
            np.zeros_like(known),
            threshold,
            settings,
        )

    def at(self, events: slice | Ints) -> _Ratios:
        """Some of the events."""
        names = ("value", "variance", "usual", "alone")
        return replace(self, **{name: getattr(self, name)[events] for name in names})

    def scatter(self, ratio: Floats, relative: float) -> Floats:
        """Variance of true ratios about profiles of this ratio, and of real profiles about those tried."""
        away = np.abs(ratio / self.threshold - 1)
        growth = 1 + self.settings.profile_error_growth * away
        unlike = self.settings.profile_error * away * growth * self.threshold
        return np.asarray((relative * ratio) ** 2 + unlike**2)

    def about_profile(self, relative: float) -> Floats:
        """Variance of the measurements about the profile; inf for those that do not follow it."""
        return np.where(self.alone, np.inf, self.variance + self.scatter(self.usual, relative))


def _blocks(events: int) -> Iterator[slice]:
    """32 events at a time, which keeps the tables of likelihoods small."""
    return (slice(first, first + 32) for first in range(0, events, 32))


def _weigh(profiles: _Profiles, sheets: _Ratios, relative: float) -> tuple[Floats32, Floats]:
    """Share of each profile in each event, (event, curve), summing to 1, and the log evidence, (event,)."""
    weight = 1 / sheets.about_profile(relative)
    likely = (weight * sheets.value).astype(np.float32) @ profiles.ratio.T
    likely -= weight.astype(np.float32) @ profiles.half_square.T
    most = likely.max(axis=1, keepdims=True)
    share = np.exp(likely - most)
    total = share.sum(axis=1, keepdims=True)
    own = np.log(np.where(weight > 0, weight, 1.0)) - weight * sheets.value**2
    return share / total, (most + np.log(total))[:, 0] + own.sum(axis=1) / 2


def _outliers(sheets: _Ratios, profiles: _Profiles) -> Bools:
    """Sheets far from what the others say, (event, N), found one after the other, the farthest first."""
    alone = sheets.alone.copy()
    events = np.arange(len(alone))
    for _ in range(4):
        rest = replace(sheets, alone=alone)
        off = np.concatenate([_off(profiles, rest.at(events[block])) for block in _blocks(events.size)])
        far = off.max(axis=1) > sheets.settings.outlier_sigma
        events, worst = events[far], off.argmax(axis=1)[far]
        alone[events, worst] = True
        if events.size == 0:
            break
    return alone


def _off(profiles: _Profiles, sheets: _Ratios) -> Floats:
    """Standard deviations by which each measurement is off the profile, 0 where none is compared."""
    largest = sheets.settings.sheet_scatters[-1]
    share, _ = _weigh(profiles, sheets, largest)
    mean = share @ profiles.ratio
    spread = np.maximum(2 * share @ profiles.half_square - mean**2, 0)
    return np.asarray(np.abs(sheets.value - mean) / np.sqrt(sheets.about_profile(largest) + spread))


def _likeliest_scatter(sheets: _Ratios, profiles: _Profiles) -> float:
    """The relative scatter of sheets about their profile under which all measurements are likeliest."""
    some = sheets.at(slice(None, None, max(1, len(sheets.value) // 40)))
    scatters = sheets.settings.sheet_scatters
    evidence = [_weigh(profiles, some, relative)[1].sum() for relative in scatters]
    return scatters[int(np.argmax(evidence))]


# --- draws --------------------------------------------------------------------------------------------------


def _draw_ratios(
    profiles: _Profiles, share: Floats32, sheets: _Ratios, relative: float, *, outliers: Bools
) -> Floats:
    """True ratios that the data allow, (event, draw, N): profiles by their share, and sheets about them.

    The random numbers are always the same, so that a table comes out the same twice.
    """
    draws = sheets.settings.draws
    rng = np.random.default_rng(0)
    curve = profiles.ratio[_drawn(share, draws)].astype(float)
    scatter = sheets.scatter(curve, relative)
    # Between the profile and the measurement, either of which may say nothing (variance inf).
    certain = np.where(sheets.alone[:, None], 0.0, 1 / scatter) + 1 / sheets.variance[:, None]
    own = 1 / sheets.variance[:, None] / certain
    ratio = curve + own * (sheets.value[:, None] - curve)
    ratio += rng.standard_normal((draws, curve.shape[2])) / np.sqrt(certain)
    misread = np.arange(draws) * sheets.settings.misread_share % 1 < sheets.settings.misread_share - 1e-9
    return np.asarray(np.where(outliers[:, None] & misread[:, None], curve, ratio))


def _drawn(share: Floats32, draws: int) -> Ints:
    """Curves drawn evenly by their share, (event, draw)."""
    events, curves = share.shape
    row = 2 * np.arange(events)[:, None]  # one search for all events: each has a stretch of its own
    reached = np.cumsum(share, axis=1, dtype=float)
    wanted = (np.arange(draws) + 0.5) / draws * reached[:, -1:]
    place = np.searchsorted((reached + row).ravel(), (wanted + row).ravel()) % curves
    return np.asarray(place.reshape(events, draws))


def _count(ratio: Floats, threshold: float, length_err: Floats, shared_err: Floats) -> Ints:
    """Ratios below the threshold in each draw, (event, draw); stick lengths and what the camera's movement
    adds to all sheets differ from draw to draw."""
    length, shift = np.random.default_rng(1).standard_normal((2, ratio.shape[1]))
    limit = threshold * (1 + length_err[:, None] * length) + shared_err[:, None] * shift
    return np.asarray((np.abs(ratio) < limit[..., None]).sum(axis=2))


def _summary(sizes: Ints, certainty: float) -> Ints:
    """Median, and the ends of the shortest interval that holds `certainty` of the draws, (3, event)."""
    draws = sizes.shape[1]
    ordered = np.sort(sizes, axis=1)
    holding = int(np.ceil(certainty * draws))
    first = np.arange(draws - holding + 1)
    length = ordered[:, holding - 1 :] - ordered[:, first]
    # Of equally short ones, the most central.
    best = (length + np.abs(first - first.mean()) / draws).argmin(axis=1)
    event = np.arange(len(ordered))
    return np.stack([ordered[:, draws // 2], ordered[event, best], ordered[event, best + holding - 1]])
