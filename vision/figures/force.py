"""Figures of the force recording: F(d), single events, their amplitude and stiffness, the two clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock, force_slips, video_slips
from vision.data import ForceMetadata, StickMetadata, load_unit, load_unit_text, only_flags
from vision.errors import InputError
from vision.figures.figure import Arrow, Figure, Ink, Panel, Range, Series
from vision.figures.positions import outward_px
from vision.figures.style import (
    DATA,
    FORCE_CLOCK,
    MODEL,
    OTHER_MODEL,
    PEAK,
    QUIET,
    VALLEY,
    VALLEY_SEPARATION,
    displacement_unit,
    drift_text,
    from_zero,
    matches_text,
    offset_text,
    ordered_inks,
    time_axis,
)
from vision.force import good_samples
from vision.models import Estimate, ModelFits, both_errors, equations
from vision.models.single_fits import has_knees, with_fitted_stiffness
from vision.numeric import Floats, nearest_sorted
from vision.sample import Sample
from vision.signals import minmax_decimate

FIRST_SLIPS = 10  # in the first view of the clocks, of a film with more than twice as many
SHOWN_STICKS = 5  # events from first to last, or of the early or late part of a test
CURVE_POINTS = 300
FORCE_TIME = f"t (s{FORCE_CLOCK})"  # label of axes
SAME_SLIP = 0.25  # largest distance of the same slip on both clocks, over the time between slips
# flags of completely measured events
SHOWN_FLAGS = frozenset({"ok", "slow", "negative", "oscillation", "cycles", "noise"})


def force_figure(
    force: xr.Dataset, sticks: pd.DataFrame | None = None, fits: ModelFits | None = None
) -> Figure:
    """Return F(d) with the peaks and valleys of the stick phases and the fitted Eq. 1.

    If the separation is not known, F is drawn against time.
    """
    known = bool(np.isfinite(good_samples(force)["d_mm"]).any())
    series = [_force_curve(force, against_d=known)]
    if sticks is not None and len(sticks):
        at_p, at_v = ("d_p_mm", "d_v_mm") if known else ("t_p_s", "t_v_s")
        series.append(_points(sticks, at_p, "F_p_N", "peaks", PEAK))
        series.append(_points(sticks, at_v, "F_v_N", "valleys", VALLEY, hollow=True))
    model = ""
    if fits is not None and known:
        d_model = np.linspace(*fits.d_mm, CURVE_POINTS)
        series.append(Series.model("Eq. 1 + 𝒯_0", d_model, fits.peak_force_N(d_model), MODEL))
        model = (
            f" Dashed: Eq. 1 fitted to the peaks, μ = {both_errors(fits.mu)} with T* "
            f"= {1000 * fits.t_star_N.value:g} mN and an offset 𝒯_0 = {both_errors(fits.t0_N)} N."
        )
    title = "Force against separation" if known else "Force against time"
    panel = _force_panel(force, title, tuple(series), against_d=known)
    return panel.figure(
        "force",
        "Traction force as recorded (minimum and maximum of each small step), with the peaks (filled) and "
        "valleys (hollow) of the stick phases, from a line fitted to each and extended to its ends."
        f"{model}",
    )


# --- the two clocks -----------------------------------------------------------------------------------------


def clocks_figure(
    force: xr.Dataset,
    tracks: xr.Dataset,
    clock: Clock,
    sticks: pd.DataFrame | None = None,
    *,
    pixel_size_um: float | None = None,
) -> Figure:
    """Return force and mean outward displacement of the sheets on the force clock: slips must coincide.

    With `sticks`, a few slips in the middle of a long video are shown first.
    """
    time = clock.to_force_s(time_axis(tracks)[0])
    scale, unit = displacement_unit(pixel_size_um)
    most = 30_000  # of force or motion
    t_video, opened = minmax_decimate(time, outward_px(tracks) * scale, most=most)
    good = good_samples(force)
    t_force, load = good["time_s"].to_numpy(), good["load_N"].to_numpy()
    margin = 0.1 * float(time[-1] - time[0])
    near = (t_force > time[0] - margin) & (t_force < time[-1] + margin)
    if not near.any():  # the whole force, which shows that they do not overlap
        near[:] = True
    t_force, load = minmax_decimate(t_force[near], load[near], most=most)
    first_view = _some_sticks(t_video, sticks)
    shown = "" if first_view is None else f" First shown: {FIRST_SLIPS} slips in the middle of the video."
    panel = Panel(
        x_label=FORCE_TIME,
        first_view=first_view,
        y_label=load_label("F", load_unit(force)),
        y2_label=f"outward motion ({unit})",
        series=(
            Series(label="force", x=t_force, y=load, ink=QUIET),
            Series(label="sheets", x=t_video, y=opened, ink=DATA, dashed=True, axis="right"),
        ),
    )
    doubt = ""
    if clock.status == "ambiguous":
        doubt = " The clocks are ambiguous: this alignment is only the likeliest."
    at, *_ = clock.offsets_at_slips()
    line = f"t(force) = t(video) + t_0 + r (t(video) − {at} s)" if at else "t(force) = t_0 + (1 + r) t(video)"
    return panel.figure(
        "clocks",
        "Force (solid, left axis, above) and mean outward displacement of all sheets (dashed, right axis, "
        f"below) on the force clock, {line} with t_0 = {offset_text(clock)} and "
        f"r = {drift_text(clock)}. Zoom in to one slip: the steps must coincide. {_agreement(clock)}"
        f"{shown}{doubt}",
        title="Clock check: force and sheets on one time axis",
    )


def clock_residuals_figure(
    force: xr.Dataset, tracks: xr.Dataset, clock: Clock, sticks: pd.DataFrame
) -> Figure | None:
    """Return the times of slips in the video less those of the nearest in the force, ms, or None."""
    try:
        steps, drops = video_slips(tracks), force_slips(force, sticks)
    except InputError:  # frames without times, or too few
        return None
    if not len(steps) or len(drops) < 2:
        return None
    camera, machine = clock.to_force_s(steps["time_s"].to_numpy()), drops["time_s"].to_numpy()
    residual = camera - machine[nearest_sorted(machine, camera)]
    same = np.abs(residual) < SAME_SLIP * float(np.median(np.diff(machine)))
    error = 1000 * steps["error_s"].to_numpy()[same]
    at, residual = camera[same], 1000 * residual[same]
    if not at.size:
        return None
    reach = 1.1 * float(np.max(np.abs(residual) + error))
    return Panel(
        x_label=FORCE_TIME,
        y_label="video − force (ms)",
        series=(
            Series(label="", x=at, y=np.zeros(at.size), ink=QUIET, width=0.8),
            Series.points("slips", at, residual, DATA, error),
        ),
        y_range=(-reach, reach),
        aspect=0.25,
    ).figure(
        "clock_residuals",
        "Time of each slip in the video on the force clock less that of the nearest slip in the force, with "
        f"the standard error of the former; {at.size} of {camera.size} slips of the video are within "
        f"{SAME_SLIP:g} of a stick time from one in the force. A trend means an uncorrected drift, a "
        "constant difference a wrong offset.",
        title="Residuals of the clocks",
    )


def _agreement(clock: Clock) -> str:
    """Return how well the clocks agree, and how certain this is, as text."""
    certainty = {
        "ok": f" The next best alignment is {clock.margin:.0f} lower in log-likelihood.",
        "given": f" The offset was not found from the slips ({clock.how}).",
        "ambiguous": "",
    }
    return f"{matches_text(clock)}.{certainty[clock.status]}"


def _some_sticks(t_video: Floats, sticks: pd.DataFrame | None) -> Range | None:
    """Return the times of `FIRST_SLIPS` slips in the middle of the video; None if it has not many more.

    The ends are in the middle of stick phases, so that no slip is cut.
    """
    if sticks is None:
        return None
    slips = np.sort(sticks["t_p_s"].to_numpy(float))
    slips = slips[(slips > t_video[0]) & (slips < t_video[-1])]
    if slips.size <= 2 * FIRST_SLIPS:
        return None
    between = (slips[1:] + slips[:-1]) / 2
    start = (slips.size - FIRST_SLIPS) // 2
    return float(between[start - 1]), float(between[start + FIRST_SLIPS - 1])


# --- stick phases -------------------------------------------------------------------------------------------


def sticks_figure(force: xr.Dataset, sticks: pd.DataFrame) -> Figure:
    """Return F − F_v against d − d_v for a few stick-slip events from first to last."""
    chosen = _spread(sticks)
    good = good_samples(force)
    time, d, load = (good[name].to_numpy().astype(float) for name in ("time_s", "d_mm", "load_N"))
    t_v, t_p, slip, d_v, f_v = (
        chosen[name].to_numpy(float) for name in ("t_v_s", "t_p_s", "slip_time_s", "d_v_mm", "F_v_N")
    )
    first = np.searchsorted(time, t_v)
    last = np.searchsorted(time, t_p + slip, side="right") + 2  # includes the end of the slip
    series = tuple(
        Series(
            label=f"d_v = {d_v[k]:.2f} mm",
            # The displacement is recorded in steps, and may go back by one.
            x=np.maximum.accumulate(1000 * (d[first[k] : last[k]] - d_v[k])),
            y=load[first[k] : last[k]] - f_v[k],
            ink=ink,
            dashed=k % 2 == 1,
        )
        for k, ink in enumerate(ordered_inks(len(chosen)))
    )
    part = StickMetadata.of(sticks).central_part
    panel = Panel(
        x_label="d − d_v (µm)",
        y_label=load_label("F − F_v", load_unit(force)),
        series=series + _central_parts(chosen, series, part),
    )
    return _with_arrows(panel, chosen).figure(
        "sticks",
        "Force above the valley against separation beyond the valley as recorded, for events from the "
        "beginning to the end of the test; later ones are brighter. Dots: the central "
        f"{100 * part:.0f} %, whose slope is K; arrows: the height ΔF and the length Λ_st of the first "
        "event. A drop at the very start is the end of the slip before.",
        title="Single stick-slip events",
    )


def _with_arrows(panel: Panel, events: pd.DataFrame) -> Panel:
    """Return the panel with the height and the length of the first event, beside and above all curves."""
    length, drop = (
        float(events[name].iloc[0]) if len(events) else np.nan for name in ("stick_length_um", "dF_N")
    )
    if not np.isfinite(length):
        return panel
    x, y = (np.concatenate([getattr(curve, axis) for curve in panel.series]) for axis in "xy")
    right, top = max(float(x.max()), length), max(float(y.max()), drop)
    return replace(
        panel,
        arrows=(
            Arrow(x=(1.04 * right, 1.04 * right), y=(0.0, drop), label="ΔF"),
            Arrow(x=(0.0, length), y=(1.05 * top, 1.05 * top), label="Λ_st"),
        ),
        x_range=(float(x.min()) - 0.02 * right, 1.14 * right),
        y_range=(min(float(y.min()), 0.0) - 0.03 * top, 1.16 * top),
    )


def _central_parts(chosen: pd.DataFrame, curves: tuple[Series, ...], part: float) -> tuple[Series, ...]:
    """Return the samples from which K is measured, thinned to about a dozen per event."""
    dots: list[Series] = []
    for length, curve in zip(chosen["stick_length_um"].to_numpy(float), curves, strict=True):
        inside = np.flatnonzero(np.abs(curve.x - length / 2) <= part * length / 2)
        inside = inside[:: max(1, inside.size // 12)]
        if inside.size:
            x, y = curve.x[inside], curve.y[inside]
            if not dots:  # for the legend, under the first dot: that of one event would have its colour
                dots.append(Series.points("K is measured here", x[:1], y[:1], QUIET))
            dots.append(Series.points("", x, y, curve.ink))
    return tuple(dots)


def force_drop_figure(sticks: pd.DataFrame, fits: ModelFits | None = None, *, unit: str = "N") -> Figure:
    """Return the stick-slip amplitude ΔF(d_v) with A times the total normal force, or ΔF(t_v) without d.

    unit: of the load, "1" for a force over a weight.
    """
    known = bool(sticks["d_v_mm"].notna().any())
    series, model = [_points(sticks, "d_v_mm" if known else "t_v_s", "dF_N", "ΔF", DATA)], ""
    if fits is not None and known:
        d = np.linspace(*fits.d_mm, CURVE_POINTS)
        sample = replace(fits.sample, t_star_N=fits.t_star_N.value)
        series.append(amplitude_curve(d, fits.mu, fits.amplitude, sample))
        amplitude = both_errors(fits.amplitude)
        model = f" Dashed: A times the normal force summed over the sheets (Eq. 2), A = {amplitude}."
    panel = Panel(
        title="Stick-slip amplitude",
        x_label=VALLEY_SEPARATION if known else f"t_v (s{FORCE_CLOCK})",
        y_label=load_label("ΔF", unit),
        y_range=from_zero(sticks["dF_N"].to_numpy(float), share=0.98),
        series=tuple(series),
        placeholder="no events",
    )
    against = "separation" if known else "time"
    caption = f"ΔF = F_p − F_v of every event against the {against} at its valley.{model}"
    return panel.figure("force_drop", caption)


def stiffness_figure(sticks: pd.DataFrame, fits: ModelFits | None = None, *, unit: str = "N") -> Figure:
    """Return K(d_v) with M_eff K_eff, and with the decay (L + d)⁻¹ of a sample that only lengthens.

    K is the one that the models are fitted to, `with_fitted_stiffness`.
    unit: of the load, "1" for a force over a weight.
    """
    part = f"the central {100 * StickMetadata.of(sticks).central_part:.0f} % of every stick phase"
    slope = "every stick phase after its knee" if has_knees(sticks) else part
    sticks = with_fitted_stiffness(sticks)
    measured = _points(sticks, "d_v_mm", "K_N_per_mm", "K", DATA, error="K_err_N_per_mm")
    series, model = [measured], ""
    if fits is not None:
        d = np.linspace(*fits.d_mm, CURVE_POINTS)
        series += stiffness_curves("M_eff K_eff", d, fits.stiffness_N_per_mm(d), fits.sample)
        model = (
            f" Dashed: M_eff K_eff with N̂: {fits.text('N_hat_N', 'N')} and "
            f"Y_eff: {fits.text('Y_eff_GPa', 'GPa')}. Solid: (L + d)⁻¹ "
            "from the same start, the effect of lengthening alone."
        )
    panel = Panel(
        title="Stiffness of the sample",
        x_label=VALLEY_SEPARATION,
        y_label=_stiffness_label("K", unit),
        y_range=from_zero(sticks["K_N_per_mm"].to_numpy(float), share=0.98),
        series=tuple(series),
        placeholder="d is not known",
    )
    caption = f"K, the slope of {slope}, with its standard error.{model}"
    return panel.figure("stiffness", caption)


def _stiffness_label(name: str, unit: str) -> str:
    return f"{load_label(name, unit)} (1/mm)" if unit == "1" else f"{name} ({unit}/mm)"


def stiffness_residuals_figure(sticks: pd.DataFrame, fits: ModelFits, *, unit: str = "N") -> Figure | None:
    """Return K less M_eff K_eff against d, with the errors of K; None without events.

    unit: of the load, "1" for a force over a weight.
    """
    names = ["d_v_mm", "K_N_per_mm", "K_err_N_per_mm"]
    events = _complete(with_fitted_stiffness(sticks)).dropna(subset=names[:2]).sort_values(names[0])
    if events.empty:
        return None
    d, k, error = (events[name].to_numpy(float) for name in names)
    residual = k - fits.stiffness_N_per_mm(d)
    points = Series.points("K − M_eff K_eff", d, residual, DATA, error)
    line = Series(label="", x=d, y=np.zeros(d.size), ink=MODEL, dashed=True)
    reach = 1.05 * float(np.nanquantile(np.abs(residual) + error, 0.98)) or 1.0  # the ends of error bars
    return Panel(
        x_label=VALLEY_SEPARATION,
        y_label=_stiffness_label("K − model", unit),
        y_range=(-reach, reach),
        series=(line, points),
        aspect=0.25,
    ).figure(
        "stiffness_residuals",
        "K of every stick phase less M_eff K_eff at its d_v, with the standard error of K. If the points are "
        "not scattered evenly about zero, the model does not describe them.",
        title="Residuals of the stiffness",
    )


def force_overview_figure(force: xr.Dataset, sticks: pd.DataFrame, fits: ModelFits | None = None) -> Figure:
    """Return the whole recording, a few events with their lines, amplitude and stiffness as one figure."""
    unit, facts = load_unit(force), StickMetadata.of(sticks)
    whole = force_figure(force, sticks, fits).panel
    drops, stiffness = (make(sticks, fits, unit=unit) for make in (force_drop_figure, stiffness_figure))
    kind = "" if facts.regime == "stick-slip" else f" ({facts.regime})"
    found = f"{len(sticks)} events{kind}, drops between fitted lines above {facts.threshold_N:.3g} "
    found += load_unit_text(force)
    start = max(len(sticks) // 2 - 3, 0)
    title = "A few events, with the lines from valley to peak"
    if facts.average_s:
        title += f"\n(of the load averaged twice over {1e3 * facts.average_s:.3g} ms; F as recorded)"
    elif facts.lowpass_s:
        lowpass = f"{1e3 * facts.lowpass_s:.2g} ms"
        title += f"\n(corrected for the load cell's low-pass of {lowpass}; F as recorded)"
    lines = "stick phases" if facts.regime == "stick-slip" else "rises"
    some = _events_panel(force, sticks.iloc[start : start + 6], title, against_d=False, lines=lines)
    shown = [panel for panel in (some, drops.panel, stiffness.panel) if not panel.empty]
    panels = [replace(whole, title=found), *shown]
    return Figure.grid(
        "force_overview",
        "The force recording and its stick-slip events",
        "The whole recording, a few events in its middle, and the amplitude and stiffness of every event, as "
        "far as they are known.",
        [replace(panel, x_label=panel.x_label.replace(FORCE_CLOCK, "")) for panel in panels],
        aspect=0.6,
    )


def force_insets_figure(force: xr.Dataset, sticks: pd.DataFrame, fits: ModelFits | None = None) -> Figure:
    """Return F(d) of the whole test, its initial elastic rise, and some early and late events."""
    whole = force_figure(force, sticks, fits).panel
    usable = sticks[sticks["d_v_mm"].notna()]
    rise = float(usable["t_p_s"].iloc[0]) if len(usable) else np.inf  # to the first slip
    marks = _event_marks(usable.iloc[:1], against_d=True) if len(usable) else ()
    first = (_force_curve(force, (-np.inf, rise), against_d=True), *marks)
    panels = [
        replace(whole, title="Whole test"),
        _force_panel(force, "Initial response", first, against_d=True),
    ]
    for share, title in ((0.1, "Early stick-slip events"), (0.85, "Late stick-slip events")):
        start = int(share * len(usable))
        some = usable.iloc[start : start + SHOWN_STICKS]
        panels.append(_events_panel(force, some, title, against_d=True))
    return Figure.grid(
        "force_insets",
        "Traction force and stages of the test",
        "Traction force against separation with the fit of Eq. 1 to the peaks; the first rise of the force, "
        "to the peak of the first event; and events of an early and a late stage of the test (peaks filled, "
        "valleys hollow).",
        panels,
        aspect=0.6,
        width_in=8.0,
    )


def _events_panel(
    force: xr.Dataset, events: pd.DataFrame, title: str, *, against_d: bool, lines: str = "stick phases"
) -> Panel:
    """Return F from the first valley to the last peak of these events, with their marks.

    lines: what the lines from valley to peak are.
    """
    series: tuple[Series, ...] = ()
    if len(events):
        ends = float(events["t_v_s"].iloc[0]), float(events["t_p_s"].iloc[-1])
        marks = _event_marks(events, against_d=against_d, lines=lines)
        series = (_force_curve(force, ends, against_d=against_d), *marks)
    return _force_panel(force, title, series, against_d=against_d)


def _event_marks(events: pd.DataFrame, *, against_d: bool, lines: str = "stick phases") -> tuple[Series, ...]:
    """Return peaks, valleys and the lines between them."""
    names = ("d_v_mm", "d_p_mm") if against_d else ("t_v_s", "t_p_s")
    x_v, x_p, f_v, f_p = (events[name].to_numpy(float) for name in (*names, "F_v_N", "F_p_N"))
    gap = np.full(len(events), np.nan)
    lines_x, lines_f = (np.stack(parts, axis=1).ravel() for parts in ((x_v, x_p, x_p), (f_v, f_p, gap)))
    return (
        Series(label=lines, x=lines_x, y=lines_f, ink=MODEL),
        Series.points("peaks", x_p, f_p, PEAK),
        Series.points("valleys", x_v, f_v, VALLEY, hollow=True),
    )


def _force_curve(force: xr.Dataset, time_s: Range = (-np.inf, np.inf), *, against_d: bool) -> Series:
    """Return F against d or time, as the minimum and maximum of up to 4000 intervals, to show every slip."""
    good = good_samples(force)
    time = good["time_s"].to_numpy()
    x, load = good["d_mm"].to_numpy() if against_d else time, good["load_N"].to_numpy()
    part = np.flatnonzero((time >= time_s[0]) & (time <= time_s[1]) & np.isfinite(x))
    part = part[np.argsort(x[part], kind="stable")]  # d is recorded in steps, and may go back
    at, extremes = minmax_decimate(x[part], load[part], most=8000)
    return Series(label="F", x=at, y=extremes, ink=QUIET, width=0.8)


def load_label(name: str, unit: str) -> str:
    """Return the label of an axis of force."""
    return f"{name} / weight" if unit == "1" else f"{name} ({unit})"


def _force_panel(force: xr.Dataset, title: str, series: tuple[Series, ...], *, against_d: bool) -> Panel:
    separation = "distance the machine moved (mm)" if ForceMetadata.of(force).lacks_d0 else "d (mm)"
    return Panel(
        title=title,
        x_label=separation if against_d else FORCE_TIME,
        y_label=load_label("F", load_unit(force)),
        series=series,
        placeholder="no events",
    )


# --- series -------------------------------------------------------------------------------------------------


def amplitude_curve(d_mm: Floats, mu: Estimate, amplitude: Estimate, sample: Sample) -> Series:
    """Return the curve of ΔF by Eq. 2."""
    drop = equations.stick_slip_amplitude(d_mm, mu=mu.value, prefactor=amplitude.value, sample=sample)
    return Series.model("A × normal force", d_mm, drop, MODEL)


def stiffness_curves(label: str, d_mm: Floats, stiffness: Floats, sample: Sample) -> list[Series]:
    """Return the curve of K, and the decay (L + d)⁻¹ from its start."""
    longer = stiffness[0] * (sample.length_mm + d_mm[0]) / (sample.length_mm + d_mm)
    return [
        Series.model(label, d_mm, stiffness, MODEL),
        Series(label="∝ (L + d)⁻¹", x=d_mm, y=longer, ink=OTHER_MODEL, width=2.0),
    ]


def _points(
    sticks: pd.DataFrame,
    x: str,
    y: str,
    label: str,
    ink: Ink,
    *,
    error: str | None = None,
    hollow: bool = False,
) -> Series:
    """Return the completely measured events as points, in order of x."""
    usable = _complete(sticks).dropna(subset=[x, y]).sort_values(x)
    return Series.points(label, usable[x], usable[y], ink, error and usable[error], hollow=hollow)


def _complete(sticks: pd.DataFrame) -> pd.DataFrame:
    """Return the events that have only flags of `SHOWN_FLAGS`."""
    return sticks[only_flags(sticks["flag"], SHOWN_FLAGS)]


def _spread(sticks: pd.DataFrame) -> pd.DataFrame:
    """Return a few events evenly spread over d, from the largest peaks (after the build-up) to the last."""
    usable = _complete(sticks).dropna(subset="d_v_mm")
    if usable.empty:
        return usable
    top = int(usable["F_p_N"].rolling(7, center=True, min_periods=1).median().to_numpy(float).argmax())
    usable = usable.iloc[min(top, max(len(usable) - SHOWN_STICKS, 0)) :]
    d = np.maximum.accumulate(usable["d_v_mm"].to_numpy(float))
    chosen = np.searchsorted(d, np.linspace(d[0], d[-1], SHOWN_STICKS))
    return usable.iloc[np.unique(chosen)]
