"""Figures of the deformation: one stick phase, σ_x over the stick length, and the stiff shell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock
from vision.deformation import stick_displacement
from vision.figures.figure import Band, Figure, Panel, Series
from vision.figures.style import DATA, MODEL, PEAK, ordered_inks, sheet_inks
from vision.figures.video import sheet_series, signed_number
from vision.models import ModelFits

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
    return Figure(
        name="stick",
        title=f"One stick phase: event {event}, d = {float(stick['d_v_mm']):.2f} mm",
        caption=(
            "Displacement δx = x − x̂ of every sheet while the force rises from valley to peak, x̂ its "
            "mean over the stick; positive to the right. Stick length Λ_st = "
            f"{float(stick['stick_length_um']):.1f} µm. As measured: noise and camera movement are in it. "
            "Left sheets dashed; the tone changes steadily outwards."
        ),
        panels=(panel,),
    )


def deformation_figure(motion: xr.Dataset, *, threshold: float = 0.1) -> Figure:
    """σ_x over stick length against the sheet's number for a few separations, with standard errors."""
    panel = ratio_panel(_ratios(motion), threshold)
    return Figure(
        name="deformation",
        title="Horizontal deformation against sheet number",
        caption=(
            "σ_x/Λ_st: RMS displacement over a stick, without camera noise and common-mode motion, over "
            "the length of the stick, with standard errors; sticks spread over the video, later ones "
            f"brighter, every other one hollow. Shaded: below {threshold:g}, where a sheet counts as "
            "stiff."
        ),
        panels=(panel,),
    )


def ratio_panel(series: tuple[Series, ...], threshold: float) -> Panel:
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
    known = np.isfinite(motion["ratio"].to_numpy()).any(axis=1)
    places = np.flatnonzero(known)
    chosen = (
        places[np.unique(np.linspace(0, len(places) - 1, _SHOWN_STICKS).astype(int))]
        if len(places)
        else places
    )
    numbers, order = signed_number(motion)
    inks = ordered_inks(len(chosen))
    d_v = motion["d_v_mm"].to_numpy()
    series = []
    for k, (ink, place) in enumerate(zip(inks, chosen, strict=True)):
        value, error = (motion[name].to_numpy()[place, order] for name in ("ratio", "ratio_err"))
        series.append(
            Series(
                label=f"d_v = {d_v[place]:.2f} mm",
                x=numbers,
                y=value,
                low=np.maximum(value - error, 0),
                high=value + error,
                ink=ink,
                look="both",
                hollow=k % 2 == 1,
                width=1.0,
            )
        )
    return tuple(series)


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
        size, low, high = (
            mine[column].to_numpy(float) for column in ("stiff_sheets", "stiff_low", "stiff_high")
        )
        x = mine["d_v_mm"].to_numpy(float)
        look: dict[str, Any] = {"look": "points", "hollow": side < 0, "shift": side * beside}
        series.append(Series(label=f"{name} side", x=x, y=size, ink=ink, low=low, high=high, **look))
    model = ""
    if fits is not None and not known.empty:
        d = np.linspace(float(known["d_v_mm"].min()), float(known["d_v_mm"].max()), _CURVE)
        series.append(
            Series(label="M_eff (force)", x=d, y=fits.effective_sheets(d), ink=MODEL, dashed=True, width=2.0)
        )
        model = " Dashed: M_eff = M √(1 − d̂), which the stiffness of the force recording implies on its own."
    panel = Panel(
        x_label="d_v (mm)",
        y_label="stiff sheets per side",
        y_range=(0.0, 1.15 * float(known["stiff_high"].max()) + 1) if len(known) else None,
        series=tuple(series),
    )
    return Figure(
        name="shells",
        title="Size of the stiff shell",
        caption=(
            "Sheets per side, from the centre, whose σ_x/Λ_st is below the threshold, one point a stick "
            "and side (left hollow and drawn a little to the left, right filled and to the right), with "
            f"the interval that the errors allow.{model}"
        ),
        panels=(panel,),
    )
