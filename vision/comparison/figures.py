"""Figures of several tests: overlays by velocity, collapse, irregular stick-slip and trends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from vision.comparison.runs import FilmResults, TractionTest
from vision.comparison.trends import PER, PREDICTORS, Trend
from vision.data import with_word
from vision.errors import InputError
from vision.figures.figure import Figure, Panel, Series, load_figures
from vision.figures.force import amplitude_curve, stiffness_curves
from vision.figures.positions import ratio_curve, ratio_panel, shell_panel
from vision.figures.style import (
    DATA,
    MODEL,
    OTHER_MODEL,
    PEAK,
    QUIET,
    VALLEY,
    VALLEY_SEPARATION,
    from_zero,
    ordered_inks,
    ordered_looks,
)
from vision.models import Estimate, both_errors, equations, plus_minus
from vision.models.single_fits import SYMBOLS
from vision.numeric import Floats, with_minus
from vision.sample import Sample

if TYPE_CHECKING:
    from vision.comparison.comparison import Comparison
    from vision.comparison.joint import JointFriction

LEAST_STICKS = 3
"""Number of stick phases that each film must have within the separations common to all, for their means to be
of these alone. Of fewer, the scatter between stick phases is hardly known."""
MOST_COLOURS = 12  # filled and hollow in turn; of more, neighbours cannot be told apart


def compare_figures(found: Comparison) -> dict[str, list[Figure]]:
    """Return headings with all figures for which there are data, in reading order."""
    events = found.events()
    figures: dict[str, Sequence[Figure | None]] = {
        "All tests": [make(found, events) for make in (peaks_figure, drops_figure, stiffnesses_figure)],
        "Single stick-slip events": sticks_figures(found),
        "The collapse": [collapse_figure(found, events)],
        "Deformation and the stiff shell": [ratios_figure(found), shells_figure(found)],
        "Where stick-slip becomes irregular": [irregular_figure(found)],
        "Trends": trends_figures(found),
    }
    return {heading: [one for one in part if one is not None] for heading, part in figures.items()}


_OF_SAMPLES = (PEAK, MODEL, DATA, OTHER_MODEL, VALLEY)  # inks of the curves of several samples


# --- overlays by velocity -----------------------------------------------------------------------------------


def velocity(speed_mm_min: float) -> float:
    """Return the nominal velocity, two digits of the measured one."""
    return float(f"{speed_mm_min:.2g}") if np.isfinite(speed_mm_min) else float("nan")


@dataclass(frozen=True, kw_only=True)
class _SampleFit:
    """What was fitted to one sample: the joint values if it has several tests, else those of its test."""

    name: str  # of the sample
    joint: JointFriction | None
    mu: Estimate
    amplitude: Estimate
    geometry: Sample
    fits: bool  # whether one μ fits its tests


def _fits_by_sample(found: Comparison) -> list[_SampleFit]:
    """Return what was fitted to each sample, in the order of the tests."""
    fitted: list[_SampleFit] = []
    for test, fit in zip(found.tests, found.fits, strict=True):
        name = test.sample_name
        if name in (one.name for one in fitted):
            continue
        joint = next((one for one in found.joint if one.sample == name), None)
        mu, amplitude = (joint.mu, joint.amplitude) if joint else (fit.mu, fit.values["A"])
        fits, geometry = joint is None or joint.fits, test.sample
        of_sample = _SampleFit(
            name=name, joint=joint, mu=mu, amplitude=amplitude, geometry=geometry, fits=fits
        )
        fitted.append(of_sample)
    return fitted


def _named(found: Comparison, one: _SampleFit, *curves: Series) -> list[Series]:
    """Return curves of a sample, of one of several with its name and in its own colour."""
    names = list(dict.fromkeys(test.sample_name for test in found.tests))
    if len(names) == 1:
        return list(curves)
    ink = _OF_SAMPLES[names.index(one.name) % len(_OF_SAMPLES)]
    name = one.name or "sample not named"
    return [replace(curve, label=f"{curve.label}, {name}", ink=ink) for curve in curves]


def peaks_figure(found: Comparison, events: pd.DataFrame) -> Figure:
    """Return F_p − 𝒯0 against d of all tests, with Eq. 1 for each sample whose tests one μ fits.

    events: those of all tests, as from `Comparison.events`.
    """
    offset = found.table.set_index("run")["T0_N"]
    events = events.assign(y=events["F_p_N"] - events["run"].map(offset))
    texts, without, curves = [], "", list[Series]()
    for one in _fits_by_sample(found):
        if one.joint and not one.fits:
            which = f"the tests of {one.name}" if one.name else "these tests"
            chi2 = f"χ²/dof of their individual μ {one.joint.disagreement:.3g}"
            without += f" No curve: no single μ fits {which} ({chi2})."
            continue
        d = _span(events, one.name, "d_p_mm")
        force = equations.traction(d, mu=one.mu.value, sample=one.geometry)
        curves += _named(found, one, Series.model("Eq. 1", d, force, MODEL))
        whose = f"fitted jointly to {one.joint.name}" if one.joint else f"of {one.name or 'the test'}"
        value = both_errors(one.mu, one.joint.error_contains if one.joint else "stat.")
        texts.append(f"μ = {value}, {whose}, T* = {1000 * one.geometry.t_star_N:g} mN")
    model = (f" Dashed: Eq. 1 with {'; '.join(texts)}." if texts else "") + without
    series = (*_points(found, events, "d_p_mm", "y"), *curves)
    return Panel(x_label="d_p (mm)", y_label="F_p − 𝒯_0 (N)", series=series).figure(
        "peaks",
        f"Peak force of every event less its test's offset 𝒯_0.{model}",
        title="Peak forces of all tests",
    )


def drops_figure(found: Comparison, events: pd.DataFrame) -> Figure:
    """Return ΔF against d_v of all tests, with A times the normal force of each sample."""
    samples = [one for one in _fits_by_sample(found) if one.fits and np.isfinite(one.amplitude.value)]
    curves: list[Series] = []
    for one in samples:
        d = _span(events, one.name, "d_v_mm")
        curves += _named(found, one, amplitude_curve(d, one.mu, one.amplitude, one.geometry))
    whose = [f"slow tests of {one.name}" if one.name else "slow tests" for one in samples]
    texts = [f"{both_errors(one.amplitude)} ({of})" for one, of in zip(samples, whose, strict=True)]
    model = f" Dashed: A times the total normal force, A = {', '.join(texts)}." if texts else ""
    return Panel(
        x_label=VALLEY_SEPARATION,
        y_label="ΔF (N)",
        y_range=_range_of(events, "dF_N"),
        series=(*_points(found, events, "d_v_mm", "dF_N"), *curves),
    ).figure(
        "drops",
        f"ΔF = F_p − F_v of every event against the separation at its valley.{model}",
        title="Stick-slip amplitudes of all tests",
    )


def stiffnesses_figure(found: Comparison, events: pd.DataFrame) -> Figure:
    """Return K against d_v of all tests, with M_eff K_eff and (L + d)⁻¹ of each sample."""
    samples, curves = _fits_by_sample(found), list[Series]()
    for one in samples:
        scale = float(found.table.loc[found.table["sample"] == one.name, "Lambda_hat_mm"].median())
        if np.isfinite(scale):
            d = _span(events, one.name, "d_v_mm")
            sheet = equations.sheet_stiffness(modulus_GPa=found.modulus.value, sample=one.geometry)
            k = np.asarray(equations.effective_sheets(d / scale, sample=one.geometry) * sheet)
            curves += _named(found, one, *stiffness_curves("M_eff K_eff, median Λ̂", d, k, one.geometry))
    series = (*_points(found, events, "d_v_mm", "K_N_per_mm"), *curves)
    of_each = " of each sample" if len(samples) > 1 else ""
    y_range = _range_of(events, "K_N_per_mm")
    return Panel(x_label=VALLEY_SEPARATION, y_label="K (N/mm)", y_range=y_range, series=series).figure(
        "stiffnesses",
        "K of every event, the slope of the central part of its stick phase, or after the knee if there are "
        f"knees. Dashed: M_eff K_eff with the median Λ̂ of the tests{of_each} and Y_eff = "
        f"{found.modulus_text}. Solid: lengthening alone.",
        title="Stiffness of all tests",
    )


def _range_of(events: pd.DataFrame, column: str) -> tuple[float, float] | None:
    """Return the range of an axis from 0 that shows every test, without its outliers; None without values."""
    ranges = [from_zero(part.to_numpy(float), share=0.98) for _, part in events.groupby("run")[column]]
    return max(filter(None, ranges), default=None)


def _span(events: pd.DataFrame, sample: str, column: str) -> Floats:
    """Return values over the range of the used events of a sample, for a curve."""
    used = events.loc[events["used"] & (events["sample"] == sample), column]
    return np.linspace(float(used.min()), float(used.max()), 300)


def _velocity_name(speed_mm_min: float) -> str:
    return "V unknown" if np.isnan(speed_mm_min) else f"V = {velocity(speed_mm_min):g} mm/min"


def _points(found: Comparison, events: pd.DataFrame, x: str, y: str) -> tuple[Series, ...]:
    """Return used events by sample, of a single one by velocity, or by test if velocities are alike or no
    single μ fits the tests; unused ones hollow and grey."""
    used, rest = events[events["used"]], events[~events["used"]].sort_values(x)
    fits = all(one.fits for one in _fits_by_sample(found))
    kinds = ("sample", "V_mm_min", "run") if fits else ("sample", "run", "V_mm_min")
    series = _by_name(used, x, y, kinds)
    if len(rest):
        series = (*series, Series.points("not used", rest[x], rest[y], QUIET, hollow=True))
    return series


def _by_name(
    events: pd.DataFrame, x: str, y: str, kinds: Sequence[str] = ("run", "sample", "V_mm_min")
) -> tuple[Series, ...]:
    """Return one series per test, sample or velocity: of the first kind that has from 2 to `MOST_COLOURS`."""
    names = {kind: events[kind] for kind in kinds}
    names["V_mm_min"] = events.sort_values("V_mm_min")["V_mm_min"].map(_velocity_name)
    names["sample"] = events["sample"].replace("", "sample not named")
    usable = [kind for kind in kinds if 1 < names[kind].nunique() <= MOST_COLOURS]
    key = names[usable[0] if usable else min(kinds, key=lambda kind: names[kind].nunique())]
    labels = list(dict.fromkeys(key))
    parts = [events.loc[key.index[key == label]].sort_values(x) for label in labels]
    return tuple(
        Series.points(label, part[x], part[y], **look)
        for label, part, look in zip(labels, parts, ordered_looks(len(labels)), strict=True)
    )


# --- single events ------------------------------------------------------------------------------------------


def sticks_figures(found: Comparison) -> list[Figure]:
    """Return F − F_v against d − d_v: one figure per velocity, and one with all of them."""
    panels = _stick_panels(found.tests)
    caption = (
        "Force above the valley against separation beyond it as recorded, for events from the beginning to "
        "the end of the test with most events at this velocity. Dots: the central part, whose slope is K. "
        "Arrows: ΔF and Λ_st of the first event."
    )
    figures = []
    for v, panel in panels.items():
        name, title = f"sticks_V{v:g}".replace(".", "p"), f"Stick-slip events at V = {v:g} mm/min"
        figures.append(panel.figure(name, f"{panel.title}. {caption}", title=title))
    if len(panels) > 1:
        parts = tuple(panels.values())
        title = "Single stick-slip events at several velocities"
        figures.append(Figure.grid("sticks", title, caption, parts, columns=2))
    return figures


def _stick_panels(tests: Sequence[TractionTest]) -> dict[float, Panel]:
    """Return the panel of single stick phases of one test per velocity, if its run has it."""
    chosen: dict[float, Panel] = {}
    for test in sorted(tests, key=lambda t: -len(t.events)):
        path = test.folder / "figures.npz"
        speed = velocity(test.speed_mm_min)  # measured ones differ in their last digits
        if speed in chosen or not np.isfinite(speed) or not path.is_file():
            continue
        try:
            named = {figure.name: figure for figure in load_figures(path)}
        except (InputError, OSError):
            continue  # only this figure is missing, no result
        if "sticks" in named:
            chosen[speed] = replace(named["sticks"].panel, title=f"{_velocity_name(speed)}, {test.run}")
    return dict(sorted(chosen.items()))


# --- the collapse -------------------------------------------------------------------------------------------


def collapse_figure(found: Comparison, events: pd.DataFrame) -> Figure | None:
    """Return K/K_eff against d̂ with M√(1 − d̂), and K(d_v) in the inset."""
    if (c := found.collapse) is None:
        return None
    named = c.table.merge(events[["run", "sample", "V_mm_min"]].drop_duplicates("run"), on="run", how="left")
    stiffness = events.loc[events["used"], ["run", "sample", "V_mm_min", "d_v_mm", "K_N_per_mm"]]
    d_hat = np.linspace(min(0.999, float(named["d_hat"].min())), 1.0, 300)
    blocks = sorted(named["sheets_per_block"].unique())
    masters = []
    for m in blocks:
        label = f"M √(1 − d̂), M = {m:g}" if len(blocks) > 1 else "M √(1 − d̂)"
        masters.append(Series.model(label, d_hat, m * np.sqrt(1 - d_hat), MODEL))
    inset = Panel(
        x_label=VALLEY_SEPARATION, y_label="K (N/mm)", series=_by_name(stiffness, "d_v_mm", "K_N_per_mm")
    )
    top = 1.05 * float(np.nanquantile(named["sheets"], 0.999))
    return Panel(
        x_label="d̂ = d_v / Λ̂",
        y_label="K / stiffness of one sheet",
        series=(*_by_name(named, "d_hat", "sheets"), *masters),
        y_range=(0.0, top),
        inset=inset,
        aspect=0.75,
    ).figure(
        "collapse",
        "K/K_eff of every event against d̂ = d_v/Λ̂, with the Λ̂ of each test at fixed Y_eff = "
        f"{found.modulus_text}. Dashed: the master curve. Root mean square distance from it: "
        f"{c.rms_before:.3g} sheets with one Λ̂ for all tests, {c.rms_after:.3g} with individual Λ̂; "
        f"neighbouring events scatter by {c.rms_noise:.3g}.",
        title="Stiffness in units of one sheet against the reduced separation",
    )


# --- deformation and shells ---------------------------------------------------------------------------------


def ratios_figure(found: Comparison) -> Figure | None:
    """Return σ_x/Λ_st of each run against the sheet's number, mean over its stick phases, at the separations
    that all films have in common if there are enough stick phases."""
    films = {name: film for name, film in _films(found).items() if len(film.sheets)}
    if not films:
        return None
    spans = {name: film.separations_mm() for name, film in films.items()}
    low, high = max(d[0] for d in spans.values()), min(d[-1] for d in spans.values())
    common = all(((d >= low) & (d <= high)).sum() >= LEAST_STICKS for d in spans.values())
    low, high = (low, high) if common else (-np.inf, np.inf)
    looks, series = _looks(found), []
    for name, film in films.items():
        means, d_mm = film.mean_ratios(low, high), spans[name][(spans[name] >= low) & (spans[name] <= high)]
        columns = (means[column].to_numpy(float) for column in ("number", "ratio", "error"))
        label = f"{name}, d_v = {d_mm.mean():.2f} mm, mean of {len(d_mm)}"
        series.append(ratio_curve(label, *columns, look="both", **looks[name]))
    which = f"from d_v = {low:.2f} to {high:.2f} mm, which all films show" if common else "in the film"
    apart = "" if common or len(films) == 1 else " The films show different separations, which matter, too."
    thresholds = sorted({film.threshold for film in films.values()})
    return ratio_panel(series, *thresholds).figure(
        "ratios",
        f"σ_x/Λ_st of every sheet: mean over the stick phases {which}, with its error.{apart} "
        f"Shaded: below {' or '.join(f'{one:g}' for one in thresholds)}, where a sheet counts as stiff.",
        title="Horizontal deformation of all tests",
    )


def shells_figure(found: Comparison) -> Figure | None:
    """Return the number of stiff sheets per side of each run against d."""
    looks, series = _looks(found), []
    for name, film in _films(found).items():
        sizes = film.shells.groupby("event").mean().sort_values("d_v_mm")
        look: dict[str, Any] = {end: sizes[f"stiff_{end}"].to_numpy(float) for end in ("low", "high")}
        if len(sizes):
            look |= looks[name]
            series.append(Series.points(name, sizes["d_v_mm"], sizes["stiff_sheets"], **look))
    if not series:
        return None
    return shell_panel(series).figure(
        "shells",
        "Number of sheets per side, from the centre, whose σ_x/Λ_st is below the threshold: mean of both "
        "sides of every stick phase in the film, with the interval that the errors allow.",
        title="Size of the stiff shell of all tests",
    )


def _films(found: Comparison) -> dict[str, FilmResults]:
    """Return what the films show, by run."""
    return {test.run: test.film for test in found.tests if test.film is not None}


def _looks(found: Comparison) -> dict[str, dict[str, Any]]:
    """Return the colour of each run, and whether its points are hollow, as in the other figures."""
    return dict(zip((test.run for test in found.tests), ordered_looks(len(found.tests)), strict=True))


# --- irregular stick-slip -----------------------------------------------------------------------------------


def irregular_figure(found: Comparison) -> Figure | None:
    """Return the running coefficient of variation of ΔF against d_v with the change points."""
    irregular = [one for one in found.irregular if np.isfinite(one.variation).any()]
    if not irregular:
        return None
    # Tests of one velocity keep their order, and with it the colours of other figures.
    irregular.sort(key=lambda one: (np.isnan(one.speed_mm_min), velocity(one.speed_mm_min)))
    names = [_velocity_name(one.speed_mm_min) for one in irregular]
    if len(names) <= MOST_COLOURS:
        names = [f"{one.run}, {name}" for one, name in zip(irregular, names, strict=True)]
    labels = list(dict.fromkeys(names))
    inks = ordered_inks(len(labels))
    series = []
    for k, (name, one) in enumerate(zip(names, irregular, strict=True)):
        rank, label = labels.index(name), name if names.index(name) == k else ""
        dashed = rank % 2 == 1
        series.append(Series(label=label, x=one.d_mm, y=one.variation, ink=inks[rank], dashed=dashed))
    changed = [one for one in irregular if np.isfinite(one.change_mm)]
    changes = [f"{one.run}: {one.change_text}" for one in changed]
    rises = f"Vertical: where it rises permanently ({'; '.join(changes[:6])})."
    where = rises if changes else "No test has a change."
    return Panel(
        x_label=VALLEY_SEPARATION,
        y_label="coefficient of variation of ΔF",
        series=tuple(series),
        x_lines=tuple(one.change_mm for one in changed),
        y_range=from_zero(*(one.variation for one in irregular)),
    ).figure(
        "irregular",
        f"Coefficient of variation of ΔF about its smooth course, over a running window of events. {where}",
        title="Regularity of stick-slip",
    )


# --- trends -------------------------------------------------------------------------------------------------


def trends_figures(found: Comparison) -> list[Figure]:
    """Return μ and N̂, and Λ̂, against previous tests and humidity: one figure each, and one with all."""
    figures = []
    shown = (("fits", ("N_hat_N", "mu"), "N̂ and μ"), ("scale", ("Lambda_hat_mm",), "Λ̂"))
    for name, quantities, title in shown:
        for predictor, what in PREDICTORS.items():
            panel = _trend_panel(found, quantities, predictor, what)
            if panel is not None:
                trends = [_trend_of(found, quantity, predictor) for quantity in quantities]
                caption = (
                    "Values of every test with standard errors, without systematic ones (columns _systematic "
                    f"of tests.csv).{_lines_of(found, trends)} {' '.join(map(_trend_text, trends))}"
                ).strip()
                file = f"trend_{name}_{predictor.partition('_')[0]}"
                figures.append(panel.figure(file, caption, title=f"{title} against {what}"))
    if len(figures) > 1:
        parts = tuple(replace(figure.panel, title=figure.title) for figure in figures)
        caption = " ".join(f"({figure.title}) {figure.caption}" for figure in figures)
        figures.append(Figure.grid("trends", "Trends", caption, parts, columns=2))
    return figures


def _trend_panel(found: Comparison, quantities: Sequence[str], predictor: str, what: str) -> Panel | None:
    """Return quantities against a predictor, with one colour per sample if there are several, and the line of
    each trend that is claimed. The second quantity has the right axis, hollow points and a dashed line."""
    series: list[Series] = []
    samples = list(dict.fromkeys(test.sample_name for test in found.tests))
    by_sample = 1 < len(samples) <= MOST_COLOURS
    inks = dict(zip(samples, ordered_inks(len(samples)), strict=True))
    for k, quantity in enumerate(quantities):
        symbol, of_quantity = SYMBOLS[quantity][0], (DATA, PEAK)[k] if len(quantities) > 1 else VALLEY
        known = found.table.dropna(subset=[quantity, predictor]).sort_values(predictor)
        if known.empty or known[predictor].nunique() < 2:
            continue
        look: dict[str, Any] = {"axis": "right" if k else "left"}
        for name in samples if by_sample else [None]:
            part = known if name is None else known[known["sample"] == name]
            columns = predictor, quantity, with_word(quantity, "err")
            x, y, error = (part[column].to_numpy(float) for column in columns)
            label = ", ".join([symbol] + ([name or "sample not named"] if by_sample else []))
            ink = of_quantity if name is None else inks[name]
            if len(part):
                series.append(Series.points(label, x, y, ink, error, hollow=k == 1, **look))
        trend = _trend_of(found, quantity, predictor)
        if trend.claimed:
            ends = known[predictor].to_numpy(float)[[0, -1]]
            line, ink = trend.intercept + trend.slope * ends, MODEL if by_sample else of_quantity
            label = f"{symbol}, trend" if by_sample else ""
            series.append(Series(label=label, x=ends, y=line, ink=ink, dashed=k == 1, **look))
    if not series or (len(quantities) > 1 and not any(s.axis == "right" for s in series)):
        return None
    first, second = [*map(label_of, quantities), ""][:2]
    return Panel(
        x_label=what,
        y_label=first,
        y2_label=second,
        series=tuple(series),
        aspect=0.6,
        whole_numbers=predictor == "n_test",
    )


def _lines_of(found: Comparison, trends: Sequence[Trend]) -> str:
    """Return what the lines of these trends are fitted to, as a sentence; "" without a line."""
    if not (drawn := [trend for trend in trends if trend.claimed]):
        return ""
    several = len({test.sample_name for test in found.tests}) > 1
    tests = "of all samples together" if several else "shown"
    both = any(np.isfinite(trend.partial_slope) for trend in drawn)
    return f" Line: weighted fit to the tests {tests}{', with the other predictor free' if both else ''}."


def _trend_of(found: Comparison, quantity: str, predictor: str) -> Trend:
    return next(one for one in found.trends if (one.quantity, one.predictor) == (quantity, predictor))


def _trend_text(trend: Trend) -> str:
    """Return slope, correlation and significance of a trend as a sentence."""
    if not np.isfinite(trend.slope):
        return ""
    rank = f"Spearman ρ = {trend.spearman:.2f} (p = {trend.p:.2g})"
    text = f"{SYMBOLS[trend.quantity][0]}: slope {slope_text(trend, partial=False)}, {rank}"
    if np.isfinite(trend.partial_slope):
        text += (
            f", with the other predictor fixed {slope_text(trend, partial=True)} (p = {trend.partial_p:.2g})"
        )
    claim = "a trend (line)" if trend.claimed else "no trend"
    return with_minus(f"{text}; {claim}, p = {trend.p_adjusted:.2g} adjusted for the number of trends.")


def label_of(quantity: str) -> str:
    """Return the symbol and unit of a column of tests.csv, for axes and tables."""
    symbol, unit = SYMBOLS[quantity]
    return f"{symbol} ({unit})" if unit else symbol


def slope_text(trend: Trend, *, partial: bool) -> str:
    """Return the slope of a trend, or the partial one, with its standard error and unit."""
    slope = Estimate(
        *((trend.partial_slope, trend.partial_slope_err) if partial else (trend.slope, trend.slope_err))
    )
    return " ".join(filter(None, (plus_minus(slope), SYMBOLS[trend.quantity][1], PER[trend.predictor])))
