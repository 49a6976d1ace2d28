"""Figures of the pull: F(d), single sticks, their amplitude and stiffness, and the clocks on one axis."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vision.force.recording import good_samples
from vision.models import equations
from vision.report.axes import displacement_unit, time_axis
from vision.report.chart import Chart, Doubles, Series
from vision.report.decimate import outline, outline_by_x
from vision.report.numbers import plus_minus, signed
from vision.report.style import DATA, MODEL, OTHER_MODEL, PEAK, QUIET, VALLEY, ordered_inks
from vision.sheets.medians import nan_median

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from vision.clock import Clock
    from vision.models.fits_result import ModelFits

BINS = 4000  # of F(d)
MOST_SAMPLES = 30_000  # of force or opening on the clocks' axis
_SHOWN_STICKS = 5
_FIRST_STICKS = 10
_CURVE = 300
_AMBIGUOUS = "The clocks are ambiguous: this alignment is only the likeliest."
_AFTER_SLIP = 2  # samples of the next stick, so that the slip is seen to its end


def pull_chart(force: xr.Dataset, sticks: pd.DataFrame | None = None, fits: ModelFits | None = None) -> Chart:
    """F(d) with the peaks and valleys of the stick phases and the fitted Eq. 1.

    Against time where the separation is not known. Drawn are the lowest and highest force in each of some
    thousand steps of d, so that every slip is there.
    """
    good = good_samples(force) if "flag" in force else force
    d, time = good["d_mm"].to_numpy(), good["time_s"].to_numpy()
    known = bool(np.isfinite(d).any())
    x, y = outline_by_x(d if known else time, good["load_N"].to_numpy(), bins=BINS)
    series = [Series(label="F", x=x, y=y, ink=QUIET, width=0.8)]
    if sticks is not None and len(sticks):
        at_p, at_v = ("d_p_mm", "d_v_mm") if known else ("t_p_s", "t_v_s")
        series += [
            _points(sticks, at_p, "F_p_N", "peaks", PEAK),
            _points(sticks, at_v, "F_v_N", "valleys", VALLEY),
        ]
    told = ""
    if fits is not None and known:
        d_model = np.linspace(*fits.d_mm, _CURVE)
        series.append(_curve("Eq. 1 + T_0", d_model, fits.peak_force_N(d_model), MODEL))
        told = (
            f" Dashed: Eq. 1 fitted to the peaks, μ = {plus_minus(fits.mu)} with T* "
            f"= {1000 * fits.t_star_N.value:g} mN and an offset T_0 = "
            f"{plus_minus(fits.t0_N)} N."
        )
    return Chart(
        name="force",
        title="Force against separation" if known else "Force against time",
        caption=(
            "Traction force as recorded (lowest and highest of each small step), with the peaks (filled) "
            "and valleys (hollow) of the stick phases, from lines fitted to each stick and extended to "
            f"its ends.{told}"
        ),
        x_label="d (mm)" if known else "t (s, force clock)",
        y_label=load_label("F", load_unit(force)),
        series=tuple(series),
    )


def clock_chart(
    force: xr.Dataset,
    tracks: xr.Dataset,
    clock: Clock,
    sticks: pd.DataFrame | None = None,
    *,
    pixel_size_um: float | None = None,
) -> Chart:
    """Force and the sheets' mean outward position on the force clock: slips must fall together.

    With `sticks`, a few of them in the middle of the video are shown at first.
    """
    time = clock.to_force_s(time_axis(tracks)[0])
    scale, unit = displacement_unit(pixel_size_um)
    t_video, opened = outline(time, opening_px(tracks)[:, None] * scale, most=MOST_SAMPLES)
    good = good_samples(force) if "flag" in force else force
    margin = 0.1 * float(time[-1] - time[0])
    near = (good["time_s"] > time[0] - margin) & (good["time_s"] < time[-1] + margin)
    part = good.isel(time_s=np.flatnonzero(near.to_numpy())) if near.any() else good
    t_force, load = outline(part["time_s"].to_numpy(), part["load_N"].to_numpy()[:, None], most=MOST_SAMPLES)
    return Chart(
        name="clocks",
        title="Clock check: force and sheets on one time axis",
        caption=(
            "Force (solid, left, above) and mean outward displacement of all sheets (dashed, right, below) "
            f"on the force clock, t(force) = {clock.offset_s:.4f} s + (1 {signed(clock.drift_ppm)} ppm) "
            f"t(video). Zoom in to one slip: the steps must fall together. {_matches(clock)}"
        ),
        x_label="t (s, force clock)",
        first_view=_some_sticks(t_video, sticks),
        y_label=load_label("F", load_unit(force)),
        y2_label=f"outward motion ({unit})",
        series=(
            Series(label="force", x=t_force, y=load[:, 0], ink=QUIET),
            Series(label="sheets", x=t_video, y=opened[:, 0], ink=DATA, dashed=True, axis="right"),
        ),
        notes=(_AMBIGUOUS,) if clock.status == "ambiguous" else (),
    )


def _matches(clock: Clock) -> str:
    """How well the clocks agree, and how sure that is."""
    told = (
        f"{clock.matched} slips matched, median residual {clock.residual_ms:.2g} ms, {clock.unmatched_video} "
        f"seen only in the video and {clock.unmatched_force} only in the force."
        if np.isfinite(clock.residual_ms)
        else "No slip was matched."
    )
    sure = {
        "ok": f" The two agree in one way only (by {clock.margin:.0f} in log-likelihood over the next).",
        "given": f" The offset was not found from the slips ({clock.how}).",
        "ambiguous": "",
    }
    return told + sure[clock.status]


def _some_sticks(t_video: Doubles, sticks: pd.DataFrame | None) -> tuple[float, float] | None:
    """A stretch of a few sticks in the middle of the video; None where it is no longer than that."""
    if sticks is None or len(sticks) < 2:
        return None
    middle, period = float(np.median(t_video)), float(np.median(np.diff(sticks["t_p_s"])))
    start, stop = middle - _FIRST_STICKS / 2 * period, middle + _FIRST_STICKS / 2 * period
    return (start, stop) if start > t_video[0] and stop < t_video[-1] else None


def sticks_chart(force: xr.Dataset, sticks: pd.DataFrame) -> Chart:
    """F − F_v against d − d_v for a few stick-slip events from first to last."""
    chosen = _spread_over(sticks)
    good = good_samples(force)
    time, d, load = (good[name].to_numpy().astype(float) for name in ("time_s", "d_mm", "load_N"))
    t_v, t_p, slip, d_v, f_v = (
        chosen[name].to_numpy(float) for name in ("t_v_s", "t_p_s", "slip_time_s", "d_v_mm", "F_v_N")
    )
    first, last = np.searchsorted(time, t_v), np.searchsorted(time, t_p + slip, side="right") + _AFTER_SLIP
    series = [
        Series(
            label=f"d_v = {d_v[k]:.2f} mm",
            # the crosshead is written in steps, which may fall back by one
            x=np.maximum.accumulate(1000 * (d[first[k] : last[k]] - d_v[k])),
            y=load[first[k] : last[k]] - f_v[k],
            ink=ink,
            dashed=k % 2 == 1,
        )
        for k, ink in enumerate(ordered_inks(len(chosen)))
    ]
    return Chart(
        name="sticks",
        title="Single stick-slip events",
        caption=(
            "Force above the valley against separation beyond the valley, samples as recorded, for "
            "events spread over the test; later ones brighter. The slope of the central half is K, the "
            "height ΔF, the length Λ_st. A drop at the very start is the end of the slip before."
        ),
        x_label="d − d_v (µm)",
        y_label=load_label("F − F_v", load_unit(force)),
        series=tuple(series),
    )


def drops_chart(sticks: pd.DataFrame, fits: ModelFits | None = None, *, unit: str = "N") -> Chart:
    """Stick-slip amplitude ΔF(d_v) with A times the total normal force.  unit: of the load (`load_unit`)."""
    series, told = [_points(sticks, "d_v_mm", "dF_N", "ΔF", DATA)], ""
    if fits is not None:
        d = np.linspace(*fits.d_mm, _CURVE)
        drop = equations.stick_slip_amplitude(
            d,
            mu=fits.mu.value,
            prefactor=fits.amplitude.value,
            t_star_N=fits.t_star_N.value,
            assembly=fits.assembly,
        )
        series.append(_curve("A × normal force", d, drop, MODEL))
        told = (
            " Dashed: A times the normal force summed over the sheets (Eq. 2), A = "
            f"{plus_minus(fits.amplitude)}."
        )
    return Chart(
        name="drops",
        title="Stick-slip amplitude",
        caption=f"ΔF = F_p − F_v of every event against the separation at its valley.{told}",
        x_label="d_v (mm)",
        y_label=load_label("ΔF", unit),
        y_range=_from_zero(sticks["dF_N"]),
        series=tuple(series),
    )


def stiffness_chart(sticks: pd.DataFrame, fits: ModelFits | None = None, *, unit: str = "N") -> Chart:
    """K(d_v) with M_eff K_eff and with the decay (L + d)⁻¹ of an assembly that only gets longer.

    unit: of the load (`load_unit`).
    """
    series, told = [_points(sticks, "d_v_mm", "K_N_per_mm", "K", DATA, error="K_err_N_per_mm")], ""
    if fits is not None:
        d = np.linspace(*fits.d_mm, _CURVE)
        model = fits.stiffness_N_per_mm(d)
        length = fits.assembly.length_mm
        longer = model[0] * (length + d[0]) / (length + d)
        series.append(_curve("M_eff K_eff", d, model, MODEL))
        series.append(Series(label="∝ (L + d)⁻¹", x=d, y=longer, ink=OTHER_MODEL, width=2.0))
        told = (
            f" Dashed: M_eff K_eff with N̂ = {plus_minus(fits.n_hat_N)} N and "
            f"Y_eff = {plus_minus(fits.modulus_GPa)} GPa. Solid: (L + d)⁻¹ "
            "from the same start, which is what lengthening alone would do."
        )
    return Chart(
        name="stiffness",
        title="Stiffness of the assembly",
        caption=f"K from the slope of the central half of every stick, with its standard error.{told}",
        x_label="d_v (mm)",
        y_label=f"{load_label('K', unit)} (1/mm)" if unit == "1" else f"K ({unit}/mm)",
        y_range=_from_zero(sticks["K_N_per_mm"]),
        series=tuple(series),
    )


def opening_px(tracks: xr.Dataset) -> Doubles:
    """Mean displacement of all sheets away from the axis, px, (frame,); NaN in frames without any."""
    away = (tracks["x_px"].values - nan_median(tracks["x_px"].values)) * tracks["side"].values
    known = np.isfinite(away)
    count = known.sum(axis=1)
    total = np.where(known, away, 0).sum(axis=1)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan), np.float64)


def _points(
    sticks: pd.DataFrame, x: str, y: str, label: str, ink: tuple[str, str], *, error: str | None = None
) -> Series:
    """The events that carry no flag, in order of x."""
    usable = sticks[(sticks["flag"] == "ok") & sticks[x].notna() & sticks[y].notna()].sort_values(x)
    place, value = usable[x].to_numpy(float), usable[y].to_numpy(float)
    spread = None if error is None else usable[error].to_numpy(float)
    low, high = (None, None) if spread is None else (value - spread, value + spread)
    hollow = label == "valleys"
    return Series(label=label, x=place, y=value, ink=ink, look="points", low=low, high=high, hollow=hollow)


def _curve(label: str, x: Doubles, y: Doubles, ink: tuple[str, str]) -> Series:
    return Series(label=label, x=x, y=y, ink=ink, dashed=True, width=2.0)


def _spread_over(sticks: pd.DataFrame) -> pd.DataFrame:
    usable = sticks[(sticks["flag"] == "ok") & sticks["d_v_mm"].notna()]
    if usable.empty:
        return usable
    d = np.maximum.accumulate(usable["d_v_mm"].to_numpy(float))
    places = np.searchsorted(d, np.linspace(d[0], d[-1], _SHOWN_STICKS))
    return usable.iloc[np.unique(places)]


def _from_zero(values: pd.Series) -> tuple[float, float] | None:
    """From 0 to above the largest value, a few wild ones aside; None without values."""
    known = values.to_numpy(float)
    known = known[np.isfinite(known)]
    return (0.0, 1.25 * float(np.quantile(known, 0.98))) if known.size and known.max() > 0 else None


def load_unit(force: xr.Dataset) -> str:
    """ "N", or "1" for a force over a weight."""
    return str(force["load_N"].attrs.get("units", "N"))


def load_label(name: str, unit: str) -> str:
    """Label of an axis of force."""
    return f"{name} / weight" if unit == "1" else f"{name} ({unit})"
