"""The publication's figures that put several views of one run together."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock
from vision.data import ForceMetadata, TrackMetadata
from vision.figures import force as force_figures
from vision.figures import video
from vision.figures.figure import Band, Figure, Panel, Series
from vision.figures.style import DATA, PEAK, QUIET, VALLEY, ordered_inks
from vision.models import ModelFits
from vision.numeric import Floats
from vision.spacetime import Sheet, space_time

ZOOMED_EVENTS = 4  # of the insets and of single sheets' diagrams
OUTER, INNER = 23, 10  # sheets of the publication's diagrams
SHEET_WIDTH_UM = 200.0
STICKS = 12  # averaged about one separation
SEPARATIONS = 4
RIDGE_PITCHES = 0.5  # half width of the picture of one ridge


def force_insets_figure(
    force: xr.Dataset, sticks: pd.DataFrame, fits: ModelFits | None = None
) -> Figure | None:
    """F(d) of the whole test, and its first loading, early and late events; None for under ten events."""
    usable = sticks[(sticks["flag"] == "ok") & sticks["d_v_mm"].notna()]
    if len(usable) < 10:
        return None
    whole = force_figures.force_figure(force, sticks, fits).panel
    d, load = (force[name].to_numpy().astype(float) for name in ("d_mm", "load_N"))
    first = float(usable["d_p_mm"].iloc[0])
    count = len(usable)
    spans = {
        "first loading": (float(np.nanmin(d)), first + 0.1 * (first - float(np.nanmin(d)))),
        "early events": _span(usable, int(0.1 * count)),
        "late events": _span(usable, int(0.9 * count) - ZOOMED_EVENTS),
    }
    zooms = []
    for title, (low, high) in spans.items():
        near = (d >= low) & (d <= high) & np.isfinite(load)
        x, y = np.maximum.accumulate(d[near]), load[near]
        zooms.append(
            Panel(title=title, x_label="d (mm)", y_label="F (N)", aspect=0.6,
                  series=(Series(label="", x=x, y=y, ink=DATA),))
        )  # fmt: skip
    return Figure(
        name="force_insets",
        title="Force against separation, with its first loading, early and late events",
        caption=(
            "Whole test with peaks, valleys and Eq. 1; then samples as recorded of the first loading and "
            f"of {ZOOMED_EVENTS} events near the beginning and near the end."
        ),
        panels=(replace(whole, aspect=0.6), *zooms),
        columns=2,
        width_in=13.0,
    )


def _span(sticks: pd.DataFrame, start: int) -> tuple[float, float]:
    part = sticks.iloc[max(start, 0) : max(start, 0) + ZOOMED_EVENTS]
    low, high = float(part["d_v_mm"].min()), float(part["d_p_mm"].max())
    return low - 0.05 * (high - low), high + 0.1 * (high - low)


# --- single sheets ------------------------------------------------------------------------------------------


def single_sheets_figure(
    strip: xr.DataArray,
    tracks: xr.Dataset,
    *,
    pixel_size_um: float | None,
    slips_s: Floats | None = None,
) -> Figure | None:
    """Space-time diagrams of an outer and an inner sheet over about four events; None without two sheets.

    Parameters
    ----------
    strip, tracks
        I(x, t) and x(n, t).
    pixel_size_um
        µm per pixel; without it the windows are as wide as one pitch.
    slips_s
        Times of the slips on the camera's clock: four in the middle are shown, else all of the recording.
    """
    numbers = tracks["n"].values
    side = "right" if (tracks["side"].values > 0).any() else "left"
    mine = np.unique(numbers[tracks["side"].values == (1 if side == "right" else -1)])
    if mine.size < 2:
        return None
    chosen = [int(mine[np.argmin(np.abs(mine - n))]) for n in (OUTER, INNER)]
    if chosen[0] == chosen[1]:
        chosen = [int(mine[-1]), int(mine[0])]
    span = None
    if slips_s is not None and slips_s.size > ZOOMED_EVENTS:
        at = slips_s.size // 2
        part = np.sort(slips_s)[max(at - 2, 0) : at + 3]
        margin = 0.1 * float(part[-1] - part[0])
        span = (float(part[0]) - margin, float(part[-1]) + margin)
    width: dict[str, Any] = (
        {"width_um": SHEET_WIDTH_UM, "pixel_size_um": pixel_size_um}
        if pixel_size_um is not None
        else {"width_px": max(TrackMetadata.of(tracks).pitch_px, 5.0)}
    )
    sheets: list[Sheet] = [(side, n) for n in chosen]
    diagrams = [space_time(strip, around=tracks, sheet=s, time_s=span, **width) for s in sheets]
    figure = video.kymograph_figure(diagrams, pixel_size_um=pixel_size_um)
    return replace(
        figure,
        name="single_sheets",
        width_in=7.0,
        title="Space-time diagrams of an outer and an inner sheet",
        caption=(
            f"Intensity around the sheets n = {chosen[0]} and {chosen[1]} ({side} side), frame under frame, "
            "about their median position: inwards in the stick phases, outwards in the slips."
        ),
    )


def profile_figure(
    strip: xr.DataArray, tracks: xr.Dataset, *, clock: Clock | None, sticks: pd.DataFrame | None
) -> Figure | None:
    """I(x) of one frame with the positions, and one outer ridge at the start and end of a stick and after.

    The three frames are those of a stick phase in the middle of the video where the clocks are known, else
    those of the largest step of an outer sheet.
    """
    x, edge = tracks["x_px"].values, np.asarray(strip["x"].values, float)
    known = np.isfinite(x)
    if not known.any(axis=1).any():
        return None
    sheet = _outer_sheet(tracks)
    frames = _three_frames(tracks, sheet, clock, sticks)
    if frames is None:
        return None
    first = frames[0]
    row = np.asarray(strip.values[first], float)
    places = np.sort(x[first][known[first]])
    marks = Series(
        label="positions", x=places, y=np.interp(places, edge, row), ink=PEAK, look="points", hollow=True
    )
    whole = Panel(
        title=f"I(x) of frame {int(tracks['frame'].values[first])}", x_label="x (px)", aspect=0.35,
        y_label="I (grey levels)", series=(Series(label="I(x)", x=edge, y=row, ink=QUIET), marks),
    )  # fmt: skip
    return Figure(
        name="profile",
        title="Intensity profile with the positions, and one ridge in three frames",
        caption=(
            "Mean intensity of the strip against column, with the sheets' positions. One outer ridge "
            "at the start and at the end of a stick, and after the slip; rings: its positions."
        ),
        panels=(whole, _ridge_panel(strip, tracks, sheet, frames)),
        width_in=13.0,
    )


def _ridge_panel(strip: xr.DataArray, tracks: xr.Dataset, sheet: int, frames: list[int]) -> Panel:
    x, edge = tracks["x_px"].values, np.asarray(strip["x"].values, float)
    reach = max(RIDGE_PITCHES * TrackMetadata.of(tracks).pitch_px, 6.0)
    reach = reach if np.isfinite(reach) else 12.0
    near = np.abs(edge - np.nanmean(x[frames, sheet])) <= reach + 1
    series: list[Series] = []
    names = ("start of the stick", "end of the stick", "after the slip")
    for name, frame, ink, dashed in zip(
        names, frames, (DATA, PEAK, VALLEY), (False, True, False), strict=True
    ):
        grey = np.asarray(strip.values[frame], float)
        place = x[frame, sheet]
        series.append(Series(label=name, x=edge[near], y=grey[near], ink=ink, dashed=dashed))
        at = np.array([place])
        series.append(
            Series(label="", x=at, y=np.interp(at, edge, grey), ink=ink, look="points", hollow=True)
        )
    side = "right" if tracks["side"].values[sheet] > 0 else "left"
    title = f"{side}, n = {int(tracks['n'].values[sheet])}"
    return Panel(title=title, x_label="x (px)", y_label="I (grey levels)", series=tuple(series), aspect=0.35)


def _outer_sheet(tracks: xr.Dataset) -> int:
    """The outermost sheet that is nearly always found."""
    found = np.isfinite(tracks["x_px"].values).mean(axis=0)
    return int(np.argmax(tracks["n"].values + 1000.0 * (found > 0.9 * found.max())))


def _three_frames(
    tracks: xr.Dataset, sheet: int, clock: Clock | None, sticks: pd.DataFrame | None
) -> list[int] | None:
    """Frames at the start and the end of a stick, and after the slip; None where the sheet is not in all."""
    place = tracks["x_px"].values[:, sheet]
    seen = np.flatnonzero(np.isfinite(place))
    if seen.size < 3:
        return None
    time = np.asarray(tracks["time_s"].values, float)
    if clock is not None and clock.status != "ambiguous" and sticks is not None and np.isfinite(time).all():
        at = clock.to_force_s(time[seen])
        inside = sticks[(sticks["t_v_s"] > at[0]) & (sticks["t_p_s"] < at[-1])]
        if len(inside) > 1:
            stick = inside.iloc[len(inside) // 2]
            start, end = float(stick["t_v_s"]), float(stick["t_p_s"])
            share = 0.05 * (end - start)
            slip = float(stick.get("slip_time_s", 0.0) or 0.0)
            wanted = (start + share, end - share, end + (slip if np.isfinite(slip) else 0.0) + share)
            return [int(seen[np.argmin(np.abs(at - t))]) for t in wanted]
    step = int(np.argmax(np.abs(np.diff(place[seen]))))
    return [int(seen[max(step - max(seen.size // 20, 1), 0)]), int(seen[step]), int(seen[step + 1])]


# --- deformation, averaged ----------------------------------------------------------------------------------


def deformation_mean_figure(motion: xr.Dataset, *, threshold: float = 0.1) -> Figure | None:
    """σ_x/Λ_st against n, averaged over about a dozen sticks around a few separations, with the spread.

    Both sides count; of a short video all sticks are one average. None for fewer than two.
    """
    d, ratio = motion["d_v_mm"].to_numpy(), motion["ratio"].to_numpy()
    known = np.flatnonzero(np.isfinite(d) & np.isfinite(ratio).any(axis=1))
    if known.size < 2:
        return None
    known = known[np.argsort(d[known])]
    groups = np.array_split(known, max(1, min(SEPARATIONS, known.size // STICKS)))
    groups = [group[max((group.size - STICKS) // 2, 0) :][:STICKS] for group in groups]
    numbers = np.unique(motion["n"].values)
    series = []
    for k, (group, ink) in enumerate(zip(groups, ordered_inks(len(groups)), strict=True)):
        each = [ratio[np.ix_(group, np.flatnonzero(motion["n"].values == n))].ravel() for n in numbers]
        each = [part[np.isfinite(part)] for part in each]
        mean = np.array([part.mean() if part.size else np.nan for part in each])
        spread = np.array([part.std() if part.size > 1 else np.nan for part in each])
        series.append(
            Series(
                label=f"d_v = {d[group].mean():.2f} mm", x=numbers.astype(float), y=mean,
                low=mean - spread, high=mean + spread, ink=ink, look="both", hollow=k % 2 == 1,
                shift=0.08 * k,
            )
        )  # fmt: skip
    return Figure(
        name="deformation_mean",
        title="Horizontal deformation, averaged over sticks",
        caption=(
            f"σ_x/Λ_st of both sides, mean of {len(groups[0])} stick phases around each separation; bars: "
            f"standard deviation between sticks and sides. Shaded: below {threshold:g}, stiff sheets."
        ),
        panels=(
            Panel(
                x_label="n", y_label="σ_x / Λ_st", series=tuple(series), whole_numbers=True,
                bands=(Band(low=0.0, high=threshold, label=f"stiff (below {threshold:g})"),),
            ),
        ),
    )  # fmt: skip


def knows_separation(force: xr.Dataset) -> bool:
    """Whether d was recorded or told."""
    return ForceMetadata.of(force).separation_from != "none" and bool(np.isfinite(force["d_mm"]).any())
