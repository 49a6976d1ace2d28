"""Figures of x(n, t): displacement, noise, pixel locking, deformation, and the stiff shell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock
from vision.data import SIDES, STIFF_BELOW, MotionMetadata
from vision.errors import InputError
from vision.figures.figure import Band, Figure, Ink, Panel, Series
from vision.figures.style import (
    DATA,
    MODEL,
    PEAK,
    VALLEY,
    VALLEY_SEPARATION,
    displacement_unit,
    from_zero,
    ordered_looks,
    sheet_inks,
    time_axis,
)
from vision.models import ModelFits
from vision.numeric import Floats, Ints, nan_median, spread_indices, typical_median
from vision.signals import minmax_decimate

MOST_POINTS = 1600  # of one sheet
BINS = 20  # per pixel
SHEET_NUMBER = "side · n (left negative)"  # label of axes
ORIGIN_FRAMES = 20
"""Number of frames whose median is the origin of a displacement. The noise of the origin is then about a
quarter of that of a position. More frames would include motion of the first stick phase."""
LEAST_FOUND = 0.95
"""Share of the frames in which a sheet must have a position to be in a mean over sheets. With a smaller one,
sheets that are often missing would leave fewer frames; with a larger one, too few sheets remain."""


def tracks_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure:
    """Return x(n, t) less each sheet's origin (`origin_px`), in µm, or in px without a pixel size."""
    at, x_px = decimated_tracks(tracks)
    scale, unit = displacement_unit(pixel_size_um)
    frames = origin_frames(tracks)
    displacement = (x_px - origin_px(tracks, frames)) * scale
    count = tracks.sizes["frame"]
    decimated = (
        f" The lines show the minimum and maximum position in each of {len(at) // 2} intervals of the "
        f"{count} frames, so that all slips are visible; tracks.csv holds every frame."
        if len(at) < count
        else ""
    )
    origin = _origin_text(tracks, frames)
    return Panel(
        title=f"Displacement of every sheet from x₀, {origin}",
        x_label=time_axis(tracks)[1],
        y_label=f"x − x₀ ({unit})",
        series=sheet_series(tracks, at, displacement, inks=sheet_inks(tracks)),
        placeholder="no positions",
        aspect=0.4,
    ).figure(
        "tracks",
        f"Position of each sheet less x₀, {origin}, the first in which most sheets were measured. A sheet "
        "may move in these frames, and then does not start at 0. Left sheets are dashed and blue, right ones "
        f"solid and orange; the tone changes from the centre outwards.{decimated}",
        title="x(n,t): displacement of every sheet",
    )


def outer_inner_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure | None:
    """Return the mean motion of each side's outer third of sheets less the inner third; None for few."""
    scale, unit = displacement_unit(pixel_size_um)
    curves = outer_less_inner_px(tracks)
    if not curves:
        return None
    time, x_label = time_axis(tracks)
    at, y = minmax_decimate(time, np.stack(list(curves.values()), axis=1) * scale, most=MOST_POINTS)
    series = tuple(
        Series(
            label=f"{SIDES[which]} side",
            x=at,
            y=column,
            ink=DATA if which < 0 else PEAK,
            dashed=which < 0,
            width=1.0,
        )
        # The right one is drawn first: the left one is dashed, so that both are visible.
        for which, column in sorted(zip(curves, y.T, strict=True), key=lambda curve: -curve[0])
    )
    return Panel(
        title="Outer less inner sheets",
        x_label=x_label,
        y_label=f"outer − inner ({unit})",
        series=series,
        placeholder="no frame with all of these sheets",
        aspect=0.25,
    ).figure(
        "outer_inner",
        "Mean outward displacement of the outer third of each side's sheets less that of its inner third. "
        "Motion of the camera and of the whole sample cancels, and deformation remains. Frames in which one "
        "of the sheets has no position are left out.",
    )


def noise_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure:
    """Return the noise of every sheet's position in time and between sheets, and the stated error."""
    scale, unit = displacement_unit(pixel_size_um)
    numbers, order = signed_number(tracks)
    measured = tracks["x_noise_px"].values[order] * scale
    unknown = np.full(order.size, np.nan)
    scatter = (tracks["x_scatter_px"].values[order] if "x_scatter_px" in tracks else unknown) * scale
    stated = typical_median(tracks["x_err_px"].values)[order] * scale
    return Panel(
        x_label=SHEET_NUMBER,
        y_label=f"noise of x ({unit})",
        series=(
            Series.points("from frame to frame", numbers, measured, DATA),
            Series(label="between sheets", x=numbers, y=scatter, ink=VALLEY, width=0.8),
            Series.points("stated error", numbers, stated, PEAK, hollow=True),
        ),
        y_range=from_zero(measured, scatter, stated),
        whole_numbers=True,
        aspect=0.4,
    ).figure(
        "noise",
        "Filled: scatter of each sheet's position from frame to frame, from second differences in time, "
        "which exclude creep and common motion. Line: scatter against its neighbours, from fourth "
        "differences along n. Hollow: stated error of a position (median over the frames), from the noise of "
        "the profile, or with a lossy codec from the scatter between sheets. If the scatter from frame to "
        "frame exceeds the error, the sheet moves, or the error is too small.",
        title="Noise of the positions",
    )


def pixel_locking_figure(tracks: xr.Dataset) -> Figure:
    """Return a histogram of x modulo one pixel, which is flat unless the fit locks to whole pixels.

    The band is two standard errors about 1, from the scatter between sheets. Each sheet is one observation,
    as its positions in different frames are not independent.
    """
    x = tracks["x_px"].values
    density, error = _density_modulo_one(x)
    centre = (np.arange(BINS) + 0.5) / BINS
    return Panel(
        x_label="x modulo 1 px",
        y_label="density over even spread",
        series=(
            Series(label="positions", x=centre, y=density, ink=DATA, look="steps"),
            Series(label="even spread", x=centre, y=np.ones(BINS), ink=MODEL, dashed=True),
        ),
        bands=(Band(low=max(0.0, 1 - 2 * error), high=1 + 2 * error, label="± 2 standard errors"),),
        x_range=(0.0, 1.0),
        y_range=from_zero(density, np.array([1 + 2 * error])),
        aspect=0.4,
    ).figure(
        "pixel_locking",
        f"Density of x modulo one pixel of {np.isfinite(x).sum()} positions; 1 is an even spread. With a fit "
        "that locks to whole pixels, the density is high near 0 and 1 and low in the middle. Band: two "
        "standard errors about 1, from the scatter between sheets; it is wide if the sheets move by less "
        "than a pixel.",
        title="Position modulo one pixel (locking check)",
    )


def _density_modulo_one(x_px: Floats) -> tuple[Floats, float]:
    """Return the density in each bin over an even one, (bins,), and its standard error.

    Sheets are the independent observations. The error is the root mean square over the bins, which are alike
    without locking; for a single sheet it is 1.
    """
    known_px = (of_sheet[np.isfinite(of_sheet)] for of_sheet in x_px.T)
    bins = (np.minimum((x % 1.0 * BINS).astype(np.int64), BINS - 1) for x in known_px)
    counts = np.array([np.bincount(of_sheet, minlength=BINS) for of_sheet in bins])
    per_sheet = counts.sum(axis=1, keepdims=True)
    total, known = max(1, int(per_sheet.sum())), int((per_sheet > 0).sum())
    share = counts.sum(axis=0) / total
    variance = ((counts - per_sheet * share) ** 2).sum(axis=0).mean() / total**2
    error = float(np.sqrt(variance * known / (known - 1))) * BINS if known > 1 else 1.0
    return share * BINS, error


def decimated_tracks(tracks: xr.Dataset) -> tuple[Floats, Floats]:
    """Return times and positions (points, sheet) in px, reduced to at most 150 000 positions or so."""
    most = min(MOST_POINTS, max(200, 150_000 // max(1, tracks.sizes["sheet"])))
    return minmax_decimate(time_axis(tracks)[0], tracks["x_px"].values, most=most)


def signed_number(data: xr.Dataset) -> tuple[Floats, Ints]:
    """Return side · n in rising order, and the indices of the sheets in that order."""
    numbers = np.asarray(data["side"].values * data["n"].values, np.float64)
    order = np.argsort(numbers, kind="stable")
    return numbers[order], order


def sheet_series(
    tracks: xr.Dataset, at: Floats, y: Floats, *, inks: list[Ink], width: float = 1.0
) -> tuple[Series, ...]:
    """Return one curve per sheet, dashed on the left.  at: (points,).  y: (points, sheet)."""
    sides, numbers = tracks["side"].values, tracks["n"].values
    look: Literal["both", "line"] = "both" if len(at) <= 60 else "line"
    return tuple(
        Series(
            label=f"{SIDES[side]} {n}",
            x=at,
            y=column,
            ink=ink,
            look=look,
            dashed=bool(side < 0),
            width=width,
            sheet=(int(side), int(n)),
        )
        for side, n, ink, column in zip(sides, numbers, inks, y.T, strict=True)
    )


# --- deformation --------------------------------------------------------------------------------------------


def stick_figure(tracks: xr.Dataset, motion: xr.Dataset, clock: Clock, event: int | None = None) -> Figure:
    """Return the displacement of all sheets in one stick phase, by default that with most frames.

    motion: as returned by `horizontal_deformation`. The positions are as measured: noise, camera movement and
    the frames next to the slips are included.  Raises: InputError for an event without a stick phase.
    """
    if event is None:
        stick = motion.isel(event=int(np.argmax(motion["frames"].to_numpy().sum(axis=1))))
    else:
        stick = _events(motion, [event]).isel(event=0)
    since_s = clock.to_force_s(np.asarray(tracks["time_s"].values, float)) - float(stick["t_v_s"])
    inside = (since_s >= 0) & (since_s <= float(stick["t_p_s"] - stick["t_v_s"]))
    delta_px = tracks["x_px"].values[inside] - stick["x_hat_px"].values
    delta_um = delta_px * MotionMetadata.of(motion).pixel_size_um
    series = sheet_series(tracks, since_s[inside], delta_um, inks=sheet_inks(tracks))
    return Panel(x_label="t − t_v (s)", y_label="δx (µm)", series=series).figure(
        "stick",
        "Displacement δx = x − x̂ of every sheet while the force rises from valley to peak, where x̂ is its "
        "mean position in the stick phase; positive to the right. Stick length Λ_st = "
        f"{float(stick['stick_length_um']):.1f} µm. Noise and motion of the camera are not removed. Left "
        "sheets are dashed; the tone changes outwards.",
        title=f"One stick phase: event {int(stick['event'])}, d = {float(stick['d_v_mm']):.2f} mm",
    )


def deformation_figure(
    motion: xr.Dataset, *, threshold: float = STIFF_BELOW, events: Sequence[int] | None = None
) -> Figure:
    """Return σ_x/Λ_st against the sheet's number for a few stick phases, with standard errors.

    events: their numbers; by default up to five spread over the video.  Raises: InputError for an event
    without a stick phase.
    """
    known = motion.dropna("event", how="all", subset=["ratio"])
    which = "spread over the video" if events is None else "that were chosen"
    if events is None:
        count = known.sizes["event"]
        known = known.isel(event=spread_indices(count, min(count, 5)))
    else:
        known = _events(known, events)
    sticks = (known.isel(event=index) for index in range(known.sizes["event"]))
    curves = [(f"d_v = {float(one['d_v_mm']):.2f} mm", one["ratio"], one["ratio_err"]) for one in sticks]
    return ratio_panel(_ratio_series(motion, curves, look="both", width=1.0), threshold).figure(
        "deformation",
        f"σ_x/Λ_st, the RMS displacement in a stick phase, {MotionMetadata.of(motion).corrected_for}, over "
        f"the stick length, with standard errors; for stick phases {which}, later ones "
        f"brighter, every other one hollow. Shaded: below {threshold:g}, where a sheet counts as stiff.",
        title="Horizontal deformation against sheet number",
    )


def mean_deformation_figure(motion: xr.Dataset, *, threshold: float = STIFF_BELOW) -> Figure | None:
    """Return σ_x/Λ_st against the sheet's number, as means over up to a dozen stick phases, or None."""
    known = motion.dropna("event", how="all", subset=["ratio"])
    if not (count := known.sizes["event"]):
        return None
    each = min(12, count)
    starts = spread_indices(count - each + 1, min(count // each, 5))
    curves = []
    for part in (known.isel(event=slice(start, start + each)) for start in starts):
        label = f"d_v = {part['d_v_mm'].to_numpy().mean():.2f} mm, mean of {each}"
        mean = part["ratio"].mean("event")
        free = (part["ratio"].count("event") - 1).clip(min=1)  # 0 of one phase
        curves.append((label, mean, (((part["ratio"] - mean) ** 2).sum("event") / free) ** 0.5))
    return ratio_panel(_ratio_series(motion, curves, width=1.4), threshold).figure(
        "mean_deformation",
        f"σ_x/Λ_st of every sheet: means over {each} stick phases with mean separation d_v, and their "
        "standard deviation (shaded curves). Shaded range: below "
        f"{threshold:g}, where a sheet counts as stiff.",
        title="Horizontal deformation, means over stick phases",
    )


def _events(motion: xr.Dataset, events: Sequence[int]) -> xr.Dataset:
    """Return these stick phases.  Raises: InputError if one was not measured."""
    measured = motion["event"].values.tolist()
    if missing := [event for event in events if event not in measured]:
        few = len(measured) <= 6
        known = (
            ", ".join(map(str, measured)) if few else f"{len(measured)} from {measured[0]} to {measured[-1]}"
        )
        wanted = f"measured stick phases ({known})"
        raise InputError("`event`", wanted, ", ".join(map(str, missing)))
    return motion.sel(event=list(events))


def _ratio_series(
    motion: xr.Dataset, curves: Sequence[tuple[str, xr.DataArray, xr.DataArray]], **look: Any
) -> list[Series]:
    """Return σ_x/Λ_st against the sheet's number.

    curves: label, values and errors of the sheets; every other one is hollow.
    """
    numbers, order = signed_number(motion)
    return [
        ratio_curve(label, numbers, ratio.to_numpy()[order], spread.to_numpy()[order], **look, **own)
        for own, (label, ratio, spread) in zip(ordered_looks(len(curves)), curves, strict=True)
    ]


def ratio_curve(label: str, numbers: Floats, ratio: Floats, error: Floats, **look: Any) -> Series:
    """Return σ_x/Λ_st of sheets with its error bars, which end at 0."""
    low, high = np.maximum(ratio - error, 0), ratio + error
    return Series(label=label, x=numbers, y=ratio, low=low, high=high, **look)


def ratio_panel(series: Sequence[Series], *thresholds: float) -> Panel:
    """Return curves of σ_x/Λ_st against the sheet's number, and the ranges of stiff sheets."""
    return Panel(
        x_label=SHEET_NUMBER,
        y_label="σ_x / Λ_st",
        series=tuple(series),
        bands=tuple(Band(low=0.0, high=one, label=f"stiff (below {one:g})") for one in thresholds),
        whole_numbers=True,
    )


def shells_figure(shells: pd.DataFrame, fits: ModelFits | None = None) -> Figure:
    """Return the number of stiff sheets per side against d, with its interval, and M_eff of the force."""
    known = shells[shells["stiff_sheets"].notna()].sort_values("d_v_mm")
    steps = np.diff(np.unique(known["d_v_mm"].to_numpy(float)))
    shift = 0.12 * float(np.median(steps)) if steps.size else 0.0
    series = []
    for (side, name), ink in zip(SIDES.items(), (DATA, PEAK), strict=True):
        part = known[known["side"] == side]
        if part.empty:
            continue
        style: dict[str, Any] = {"hollow": side < 0, "shift": side * shift}
        style |= {end: part[f"stiff_{end}"].to_numpy(float) for end in ("low", "high")}
        series.append(Series.points(f"{name} side", part["d_v_mm"], part["stiff_sheets"], ink, **style))
    model = ""
    if fits is not None and not known.empty:
        d = np.linspace(float(known["d_v_mm"].min()), float(known["d_v_mm"].max()), 300)
        series.append(Series.model("M_eff (force)", d, fits.effective_sheets(d), MODEL))
        model = " Dashed: M_eff = M √(1 − d̂), from the stiffness of the force recording alone."
    return shell_panel(series).figure(
        "shells",
        "Number of sheets per side, from the centre, whose σ_x/Λ_st is below the threshold, with the "
        "interval that the errors allow; one point per stick phase and side (left hollow and shifted to the "
        f"left, right filled and shifted to the right).{model}",
        title="Size of the stiff shell",
    )


def shell_panel(series: Sequence[Series]) -> Panel:
    """Return numbers of stiff sheets with their intervals against d_v."""
    tops = [float(one.high.max()) for one in series if one.high is not None]
    return Panel(
        x_label=VALLEY_SEPARATION,
        y_label="stiff sheets per side",
        y_whole_numbers=True,
        y_range=(0.0, 1.15 * max(tops) + 1) if tops else None,
        series=tuple(series),
    )


# --- displacement from an origin ----------------------------------------------------------------------------


def origin_frames(tracks: xr.Dataset) -> Ints:
    """Return up to `ORIGIN_FRAMES` frames, the first in which nearly as many sheets as ever have a position.

    They follow one another but for frames in which no sheet has one (frozen, blank, lost). Nine tenths of the
    sheets must have one in each: more would wait for sheets that come into view late, while others already
    move; with less, more origins would be interpolated between neighbours. There are none if no sheet was
    ever found.
    """
    known = np.isfinite(tracks["x_px"].values)
    shown = np.flatnonzero(known.any(axis=1))
    length = min(ORIGIN_FRAMES, len(shown))
    count = np.zeros(len(shown) - length + 1, np.int64)  # sheets with positions in `length` frames
    for of_sheet in known.T:  # one at a time: their sums would take as much memory as all positions
        total = np.concatenate([[0], np.cumsum(of_sheet[shown])])
        count += total[length:] - total[: len(count)] == length
    start = int((count >= 0.9 * count.max()).argmax())
    return shown[start : start + length]


def origin_px(tracks: xr.Dataset, frames: Ints) -> Floats:
    """Return the origin from which every sheet's displacement is counted, (sheet,) in px.

    The origin is the median position over the frames of `origin_frames`, the same for all sheets. For a sheet
    that has none there, its own first frames are used, and the displacement that its neighbours have by then
    (linear in n) is subtracted. The origin is NaN for a sheet that was never found.

    A median over all frames would depend on which of them have a position, and a gap would shift the whole
    curve relative to its neighbours.
    """
    x = np.asarray(tracks["x_px"].values, np.float64)
    known = np.isfinite(x)
    if not known.any():
        return np.full(x.shape[1], np.nan)
    origin = nan_median(x[frames])
    late = np.flatnonzero(~np.isfinite(origin) & known.any(axis=0))
    early = np.flatnonzero(np.isfinite(origin))
    signed = np.asarray(tracks["side"].values * tracks["n"].values, np.float64)
    for sheet in late:
        own = np.flatnonzero(known[:, sheet])[:ORIGIN_FRAMES]
        displacement = nan_median(x[np.ix_(own, early)] - origin[early])
        measured = np.flatnonzero(np.isfinite(displacement))
        order = measured[np.argsort(signed[early[measured]])]
        shift = np.interp(signed[sheet], signed[early[order]], displacement[order]) if order.size else 0.0
        origin[sheet] = np.median(x[own, sheet]) - shift
    return origin


def _origin_text(tracks: xr.Dataset, frames: Ints) -> str:
    """Return which frames the origin is the median over."""
    numbers = tracks["frame"].values[frames]
    if not numbers.size:
        return "its median over the first frames"
    time, label = time_axis(tracks)
    first, last = time[frames][[0, -1]]
    span = "" if label == "frame" else f" (t = {first:.3g} to {last:.3g} s)"
    return f"its median over frames {numbers[0]} to {numbers[-1]}{span}"


def outward_px(tracks: xr.Dataset) -> Floats:
    """Return the mean outward displacement of all sheets from their origins, px, (frame,).

    The mean is over those with a position in at least `LEAST_FOUND` of the frames, or those with most
    positions. It is NaN in frames in which one of them has none, where the mean would jump. If no frame is
    left, the mean is over the sheets that have a position.
    """
    origin = origin_px(tracks, origin_frames(tracks))
    return _outward_px(tracks, origin, np.arange(tracks.sizes["sheet"]))


def _outward_px(tracks: xr.Dataset, origin: Floats, chosen: Ints) -> Floats:
    """Return the same of the sheets with these indices; origin: of every sheet, px."""
    x = np.asarray(tracks["x_px"].values, np.float64)[:, chosen]
    found = np.isfinite(x).mean(axis=0)
    often = found >= min(LEAST_FOUND, float(found.max(initial=0.0)))
    outward = (x - origin[chosen]) * tracks["side"].values[chosen]
    mean = np.asarray(outward[:, often].mean(axis=1)) if often.any() else np.full(len(x), np.nan)
    if np.isfinite(mean).any():
        return mean
    known = np.isfinite(outward)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, outward, 0).sum(axis=1) / known.sum(axis=1))


def outer_less_inner_px(tracks: xr.Dataset) -> dict[int, Floats]:
    """Return the outward displacement of the outer third of the sheets less that of the inner, by side, px.

    Motion of the camera and of the whole sample cancels, and deformation remains. Sides with fewer than three
    sheets are left out.
    """
    n, side = np.asarray(tracks["n"].values), np.asarray(tracks["side"].values)
    origin, curves = origin_px(tracks, origin_frames(tracks)), {}
    for which in (-1, 1):
        sheets = np.flatnonzero(side == which)
        third = sheets.size // 3
        if third:
            ordered = sheets[np.argsort(n[sheets])]
            outer, inner = (_outward_px(tracks, origin, part) for part in (ordered[-third:], ordered[:third]))
            curves[which] = outer - inner
    return curves
