"""Figures of the deformation: one stick phase, σ_x over the stick length, and the stiff shell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock
from vision.deformation import stick_displacement
from vision.figures.figure import Band, Figure, Panel, Series
from vision.figures.positions import sheet_series, signed_number
from vision.figures.style import DATA, MODEL, PEAK, ordered_inks, sheet_inks
from vision.models import ModelFits
from vision.numeric import Floats

GROUPS, STICKS_EACH = 5, 12  # curves of the averaged deformation, and sticks in each
_SHOWN_STICKS = 5
_CURVE = 300
_BESIDE = 0.12  # of the step from stick to stick: how far the two sides' points stand apart from d, each way


def stick_figure(tracks: xr.Dataset, motion: xr.Dataset, clock: Clock, *, event: int | None = None) -> Figure:
    """Displacement of all sheets over one stick phase.

    Parameters
    ----------
    tracks, clock
        As given to `horizontal_deformation`.
    motion
        What it returned.
    event
        Number of the stick phase; None for the one with most frames.

    Raises
    ------
    InputError
        For an event that is not in `motion`.
    """
    if event is None:
        event = int(motion["event"].values[int(np.argmax(motion["frames"].to_numpy().sum(axis=1)))])
    moved = stick_displacement(tracks, motion, clock, event=event)
    stick = motion.sel(event=event)
    series = sheet_series(tracks, moved["since_s"].to_numpy(), moved.to_numpy(), inks=sheet_inks(tracks))
    panel = Panel(x_label="t − t_v (s)", y_label="δx (µm)", series=series)
    return Figure.of(
        "stick",
        panel,
        "Displacement δx = x − x̂ of every sheet while the force rises from valley to peak, x̂ its mean over "
        f"the stick; positive to the right. Stick length Λ_st = {float(stick['stick_length_um']):.1f} µm. As "
        "measured: noise and camera movement are in it. Left sheets dashed; the tone changes steadily "
        "outwards.",
        title=f"One stick phase: event {event}, d = {float(stick['d_v_mm']):.2f} mm",
    )


def deformation_figure(motion: xr.Dataset, *, threshold: float = 0.1) -> Figure:
    """σ_x over stick length against the sheet's number for a few separations, with standard errors."""
    return Figure.of(
        "deformation",
        _ratio_panel(_ratios(motion), threshold),
        "σ_x/Λ_st: RMS displacement over a stick, without camera noise and common-mode motion, over the "
        "length of the stick, with standard errors; sticks spread over the video, later ones brighter, every "
        f"other one hollow. Shaded: below {threshold:g}, where a sheet counts as stiff.",
        title="Horizontal deformation against sheet number",
    )


def _ratio_panel(series: tuple[Series, ...], threshold: float) -> Panel:
    """Axes of σ_x/Λ_st against the sheet's number, with the range of stiff sheets."""
    return Panel(
        x_label="side · n (left negative)",
        y_label="σ_x / Λ_st",
        series=series,
        bands=(Band(low=0.0, high=threshold, label=f"stiff (below {threshold:g})"),),
        whole_numbers=True,
    )


def _ratios(motion: xr.Dataset) -> tuple[Series, ...]:
    """The ratio of a few sticks from first to last, with standard errors."""
    chosen = np.flatnonzero(np.isfinite(motion["ratio"].to_numpy()).any(axis=1))
    if chosen.size:
        chosen = chosen[np.unique(np.linspace(0, chosen.size - 1, _SHOWN_STICKS).astype(int))]
    numbers, order = signed_number(motion)
    series = []
    for k, (ink, place) in enumerate(zip(ordered_inks(chosen.size), chosen, strict=True)):
        stick = motion.isel(event=place, sheet=order)
        value, error = stick["ratio"].to_numpy(), stick["ratio_err"].to_numpy()
        look: dict[str, Any] = {"look": "both", "hollow": k % 2 == 1, "width": 1.0}
        look |= {"low": np.maximum(value - error, 0), "high": value + error}
        label = f"d_v = {float(stick['d_v_mm']):.2f} mm"
        series.append(Series(label=label, x=numbers, y=value, ink=ink, **look))
    return tuple(series)


def mean_deformation_figure(motion: xr.Dataset, *, threshold: float = 0.1) -> Figure | None:
    """σ_x/Λ_st against the sheet's number, each curve the mean of about a dozen sticks; None without any."""
    ratio = motion["ratio"].to_numpy()
    known = np.flatnonzero(np.isfinite(ratio).any(axis=1))
    if not known.size:
        return None
    groups = int(np.clip(known.size // STICKS_EACH, 1, GROUPS))
    each = min(STICKS_EACH, known.size)
    starts = np.unique(np.linspace(0, known.size - each, groups).astype(int))
    numbers, order = signed_number(motion)
    d_v = motion["d_v_mm"].to_numpy()
    series = []
    for ink, start in zip(ordered_inks(len(starts)), starts, strict=True):
        places = known[start : start + each]
        value, spread = _mean_and_spread(ratio[places][:, order])
        label, low, high = f"d_v = {d_v[places].mean():.2f} mm", np.maximum(value - spread, 0), value + spread
        series.append(Series(label=label, x=numbers, y=value, low=low, high=high, ink=ink, width=1.4))
    return Figure.of(
        "mean_deformation",
        _ratio_panel(tuple(series), threshold),
        f"σ_x/Λ_st of every sheet: mean over {each} stick phases around each separation d_v (the mean of "
        "theirs), shaded by the standard deviation from stick to stick. Shaded range: below "
        f"{threshold:g}, where a sheet counts as stiff.",
        title="Horizontal deformation, means over sticks",
        width_in=8.0,
    )


def _mean_and_spread(values: Floats) -> tuple[Floats, Floats]:
    """Mean and standard deviation of the known values of each column; NaN without any, 0 spread for one."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    mean = np.where(known, values, 0).sum(axis=0) / np.maximum(count, 1)
    square = np.where(known, (values - mean) ** 2, 0).sum(axis=0) / np.maximum(count - 1, 1)
    return np.where(count > 0, mean, np.nan), np.sqrt(square)


def shells_figure(shells: pd.DataFrame, fits: ModelFits | None = None) -> Figure:
    """Number of stiff sheets per side against d, with its interval, and M_eff of the force."""
    known = shells[shells["stiff_sheets"].notna()].sort_values("d_v_mm")
    steps = np.diff(np.unique(known["d_v_mm"].to_numpy(float)))
    beside = _BESIDE * float(np.median(steps)) if steps.size else 0.0
    series = []
    for side, name, ink in ((-1, "left", DATA), (1, "right", PEAK)):
        mine = known[known["side"] == side]
        if mine.empty:
            continue
        look: dict[str, Any] = {"hollow": side < 0, "shift": side * beside}
        look |= {end: mine[f"stiff_{end}"].to_numpy(float) for end in ("low", "high")}
        series.append(Series.points(f"{name} side", mine["d_v_mm"], mine["stiff_sheets"], ink, **look))
    model = ""
    if fits is not None and not known.empty:
        d = np.linspace(float(known["d_v_mm"].min()), float(known["d_v_mm"].max()), _CURVE)
        series.append(Series.model("M_eff (force)", d, fits.effective_sheets(d), MODEL))
        model = " Dashed: M_eff = M √(1 − d̂), which the stiffness of the force recording implies on its own."
    panel = Panel(
        x_label="d_v (mm)",
        y_label="stiff sheets per side",
        y_range=(0.0, 1.15 * float(known["stiff_high"].max()) + 1) if len(known) else None,
        series=tuple(series),
    )
    return Figure.of(
        "shells",
        panel,
        "Sheets per side, from the centre, whose σ_x/Λ_st is below the threshold, one point a stick and side "
        "(left hollow and drawn a little to the left, right filled and to the right), with the interval that "
        f"the errors allow.{model}",
        title="Size of the stiff shell",
    )
