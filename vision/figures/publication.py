"""Figures of the publication that one run can give and that no other figure of the run shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import xarray as xr

from vision.errors import InputError
from vision.figures.decimate import minmax_decimate
from vision.figures.deformation import ratio_panel
from vision.figures.figure import Figure, Panel, Series
from vision.figures.force import force_figure, measurable
from vision.figures.labels import load_label, load_unit, time_axis
from vision.figures.style import DATA, MODEL, PEAK, QUIET, VALLEY, ordered_inks
from vision.figures.video import kymograph_figure, signed_number
from vision.models import ModelFits
from vision.numeric import Floats
from vision.spacetime import space_time

INSET_STICKS = 5  # shown of the early and of the late part of the test
INSET_POINTS = 4000
SHOWN_SLIPS = 4  # of the space-time diagrams of single sheets, as in the publication
OUTER_N, INNER_N = 23, 10  # the publication's two sheets; the nearest there are, of other samples
WINDOW_UM = 200.0
GROUPS, STICKS_EACH = 5, 12  # curves of the averaged deformation, and sticks in each
EARLY, LATE = 0.1, 0.85  # of the events: where the insets of F(d) are taken
RIDGE_PITCHES = 0.9  # half width of the window around one ridge


def force_insets_figure(force: xr.Dataset, sticks: pd.DataFrame, fits: ModelFits | None = None) -> Figure:
    """F(d) of the whole test, its initial elastic rise, and some early and late stick-slip events."""
    whole = force_figure(force, sticks, fits).panel
    usable = sticks[sticks["d_v_mm"].notna()]
    first = int(EARLY * len(usable))
    last = max(0, int(LATE * len(usable)))
    panels = [replace(whole, title="Whole test", aspect=0.6), _initial_rise(force, usable)]
    for start, title in ((first, "Early stick-slip events"), (last, "Late stick-slip events")):
        panels.append(_some_events(force, usable.iloc[start : start + INSET_STICKS], title))
    return Figure(
        name="force_insets",
        title="Traction force and stages of the test",
        caption=(
            "Traction force against separation with the fit of Eq. 1 to the peaks; the first rise of the "
            "force, events of an early and of a late stage of the test (peaks filled, valleys hollow)."
        ),
        panels=tuple(panels),
        columns=2,
        width_in=13.0,
    )


def _initial_rise(force: xr.Dataset, sticks: pd.DataFrame) -> Panel:
    """From the first sample to a little beyond the first slip."""
    good = measurable(force)
    time = good["time_s"].to_numpy()
    end = float(sticks["t_p_s"].iloc[0]) if len(sticks) else float(time[-1])
    return _part(force, time <= end, (), "Initial response")


def _some_events(force: xr.Dataset, some: pd.DataFrame, title: str) -> Panel:
    good = measurable(force)
    time = good["time_s"].to_numpy()
    if some.empty:
        return _part(force, np.zeros(time.size, bool), (), title)
    margin = 0.1 * float(some["t_p_s"].iloc[-1] - some["t_v_s"].iloc[0])
    near = (time >= some["t_v_s"].iloc[0] - margin) & (time <= some["t_p_s"].iloc[-1] + margin)
    marked = (("d_p_mm", "F_p_N", "peaks", PEAK, False), ("d_v_mm", "F_v_N", "valleys", VALLEY, True))
    series = tuple(
        Series(
            label=label,
            x=some[x].to_numpy(float),
            y=some[y].to_numpy(float),
            ink=ink,
            look="points",
            hollow=hollow,
        )
        for x, y, label, ink, hollow in marked
    )
    return _part(force, near, series, title)


def _part(force: xr.Dataset, keep: np.ndarray, series: tuple[Series, ...], title: str) -> Panel:
    good = measurable(force)
    d = np.maximum.accumulate(good["d_mm"].to_numpy()[keep])  # recorded in steps, which may fall back by one
    load = good["load_N"].to_numpy()[keep]
    at, load2 = minmax_decimate(d, load[:, None], most=INSET_POINTS) if d.size else (d, load[:, None])
    curve = Series(label="F", x=at, y=load2[:, 0], ink=QUIET, width=0.9)
    return Panel(
        title=title,
        x_label="d (mm)",
        y_label=load_label("F", load_unit(force)),
        series=(curve, *series),
        placeholder="no events",
        aspect=0.6,
    )


# --- single sheets ------------------------------------------------------------------------------------------


def single_sheets_figure(
    strip: xr.DataArray,
    tracks: xr.Dataset,
    slips_s: Floats,
    *,
    pixel_size_um: float | None = None,
    slips_from: str = "the force",
) -> Figure | None:
    """Space-time diagrams around an outer and an inner sheet over a few slips; None where there are none.

    Parameters
    ----------
    strip, tracks
        From `strip_profile` and `track_sheets`.
    slips_s
        Times of the slips on the camera's clock, s, rising.
    pixel_size_um
        For a window of 0.2 mm, as in the publication; one pitch wide without it.
    slips_from
        What the times were taken from.
    """
    time = time_axis(tracks)[0]
    slips = slips_s[(slips_s >= time[0]) & (slips_s <= time[-1])]
    names = _two_sheets(tracks)
    if slips.size < 2 or not names:
        return None
    some = slips[:SHOWN_SLIPS]
    half = 0.5 * float(np.median(np.diff(some)))
    width: dict[str, float] = (
        {"width_px": float(tracks.attrs["pitch_px"])} if pixel_size_um is None else {"width_um": WINDOW_UM}
    )
    try:
        diagrams = [
            space_time(
                strip,
                around=tracks,
                sheet=name,
                pixel_size_um=pixel_size_um,
                time_s=(some[0] - half, some[-1] + half),
                **width,  # type: ignore[arg-type]
            )
            for name in names
        ]
    except InputError:  # a sheet that is not seen in these frames
        return None
    who = " and ".join(f"n = {n} ({side})" for side, n in names)
    made = kymograph_figure(diagrams, pixel_size_um=pixel_size_um, slips_s=some, slips_from=slips_from)
    return replace(
        made,
        name="single_sheets",
        title="Space-time diagrams of single sheets",
        caption=(
            f"Intensity in a window around {who}, one frame below the other, over {some.size} slips (orange, "
            f"from {slips_from}). Outer sheets move more."
        ),
    )


def _two_sheets(tracks: xr.Dataset) -> list[tuple[str, int]]:
    """An outer and an inner sheet of the right side (of the left where that has none)."""
    side, n = np.asarray(tracks["side"].values), np.asarray(tracks["n"].values)
    which = 1 if (side > 0).any() else -1
    seen = np.isfinite(tracks["x_px"].values).any(axis=0) & (side == which)
    there = n[seen]
    if not there.size:
        return []
    outer, inner = OUTER_N, INNER_N
    if there.max() < OUTER_N:  # another sample: its last sheet but one in ten, and the middle one
        outer, inner = round(0.92 * there.max()), round(0.4 * there.max())
    nearest = {int(there[np.abs(there - wanted).argmin()]) for wanted in (outer, inner)}
    return [("right" if which > 0 else "left", k) for k in sorted(nearest, reverse=True)]


# --- averaged deformation -----------------------------------------------------------------------------------


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
        series.append(
            Series(
                label=f"d_v = {d_v[places].mean():.2f} mm",
                x=numbers,
                y=value,
                low=np.maximum(value - spread, 0),
                high=value + spread,
                ink=ink,
                width=1.4,
            )
        )
    panel = ratio_panel(tuple(series), threshold)
    return Figure(
        name="mean_deformation",
        title="Horizontal deformation, means over sticks",
        caption=(
            f"σ_x/Λ_st of every sheet: mean over {each} stick phases around each separation d_v (the mean of "
            "theirs), shaded by the standard deviation from stick to stick. Shaded range: below "
            f"{threshold:g}, where a sheet counts as stiff."
        ),
        panels=(panel,),
        width_in=8.0,
    )


def _mean_and_spread(values: Floats) -> tuple[Floats, Floats]:
    """Mean and standard deviation of the known values of each column; NaN without any, 0 spread for one."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    mean = np.where(known, values, 0).sum(axis=0) / np.maximum(count, 1)
    square = np.where(known, (values - mean) ** 2, 0).sum(axis=0) / np.maximum(count - 1, 1)
    return np.where(count > 0, mean, np.nan), np.sqrt(square)


# --- intensity profiles -------------------------------------------------------------------------------------


def intensity_figure(strip: xr.DataArray, tracks: xr.Dataset, slips_s: Floats | None = None) -> Figure | None:
    """I(x) of one frame with the positions, and one ridge at the start and end of a stick and after the slip.

    Parameters
    ----------
    strip, tracks
        From `strip_profile` and `track_sheets`.
    slips_s
        Times of the slips on the camera's clock, s, rising; without two of them only I(x) is shown.
    """
    x_px = np.asarray(tracks["x_px"].values, np.float64)
    frames = _stick_frames(tracks, slips_s)
    seen = np.isfinite(x_px).any(axis=1)
    if not seen.any():
        return None
    start = frames[0] if frames and np.isfinite(x_px[frames[0]]).any() else int(seen.argmax())
    columns = np.asarray(strip["x"].values, np.float64)
    values = np.asarray(strip.values[start], np.float64)
    at = np.sort(x_px[start][np.isfinite(x_px[start])])
    time = time_axis(tracks)
    label = f"{'frame' if time[1] == 'frame' else 't ='} {time[0][start]:.4g}" + (
        "" if time[1] == "frame" else " s"
    )
    panels = [
        Panel(
            title=f"Profile at {label}",
            x_label="x (px)",
            y_label="I (grey levels)",
            series=(
                Series(label="I(x)", x=columns, y=values, ink=QUIET, width=0.9),
                Series(label="x(n)", x=at, y=np.interp(at, columns, values), ink=PEAK, look="points"),
            ),
            aspect=0.35,
        )
    ]
    sheet = _ridge_sheet(tracks, frames)
    if frames and sheet is not None:
        panels.append(_ridge_panel(strip, tracks, frames, sheet))
    return Figure(
        name="intensity",
        title="Intensity profile and one ridge in three frames",
        caption=(
            "Intensity averaged over the strip's rows against the column, with the positions that were found."
            + (
                " Right: one ridge at the beginning and at the end of a stick and after the slip; vertical "
                "lines are its positions. It moves inwards during the stick and back in the slip."
                if len(panels) > 1
                else ""
            )
        ),
        panels=tuple(panels),
        columns=len(panels),
        width_in=13.0 if len(panels) > 1 else 8.0,
    )


def _stick_frames(tracks: xr.Dataset, slips_s: Floats | None) -> tuple[int, int, int] | None:
    """First and last whole frame of the longest stick of the first ones, and the first after its slip."""
    time, label = time_axis(tracks)
    if slips_s is None or label == "frame" or time.size < 4:
        return None
    step = float(np.median(np.diff(time)))
    slips = slips_s[(slips_s > time[0]) & (slips_s < time[-1] - 2 * step)]
    if slips.size < 2:
        return None
    which = int(np.diff(slips[: SHOWN_SLIPS + 1]).argmax())
    # a frame beside a slip may have it in its exposure
    start = int(np.searchsorted(time, slips[which] + step))
    end = int(np.searchsorted(time, slips[which + 1] - step)) - 1
    after = int(np.searchsorted(time, slips[which + 1] + step))
    return (start, end, after) if start < end < after < time.size else None


def _ridge_sheet(tracks: xr.Dataset, frames: tuple[int, int, int] | None) -> int | None:
    """The outermost sheet of the right side that has a position in all three frames."""
    if frames is None:
        return None
    there = np.isfinite(tracks["x_px"].values[list(frames)]).all(axis=0)
    rank = np.where(there, tracks["side"].values * tracks["n"].values, -np.inf)
    return int(rank.argmax()) if there.any() else None


def _ridge_panel(strip: xr.DataArray, tracks: xr.Dataset, frames: tuple[int, int, int], sheet: int) -> Panel:
    columns = np.asarray(strip["x"].values, np.float64)
    place = tracks["x_px"].values[list(frames), sheet]
    reach = RIDGE_PITCHES * float(tracks.attrs.get("pitch_px", 20.0))
    reach = reach if np.isfinite(reach) else 20.0
    near = np.flatnonzero(np.abs(columns - place.mean()) <= reach)
    series: list[Series] = []
    names = ("start of the stick", "end of the stick", "after the slip")
    for name, ink, frame, at in zip(names, (DATA, PEAK, MODEL), frames, place, strict=True):
        values = np.asarray(strip.values[frame, near], np.float64)
        hollow = name == names[2]
        series.append(Series(label=name, x=columns[near], y=values, ink=ink, look="both", hollow=hollow))
        ends = np.array([values.min(), values.max()])
        series.append(Series(label="", x=np.array([at, at]), y=ends, ink=ink, dashed=True, width=1.0))
    side = "right" if int(tracks["side"].values[sheet]) > 0 else "left"
    return Panel(
        title=f"Sheet n = {int(tracks['n'].values[sheet])}, {side}",
        x_label="x (px)",
        y_label="I (grey levels)",
        series=tuple(series),
        aspect=0.35,
    )
