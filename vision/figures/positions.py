"""Figures of x(n, t): displacement from one origin, noise, pixel locking, deformation, the stiff shell."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock
from vision.deformation import stick_displacement
from vision.figures.decimate import minmax_decimate
from vision.figures.figure import Band, Figure, Ink, Panel, Series
from vision.figures.labels import displacement_unit, from_zero, time_axis
from vision.figures.style import DATA, MODEL, PEAK, VALLEY, ordered_inks, sheet_inks
from vision.models import ModelFits
from vision.numeric import Bools, Floats, Ints, nan_median

MOST_POINTS = 1600  # of one sheet
BINS = 20  # of a pixel
ORIGIN_FRAMES = 20
"""Frames whose median is the origin: the noise of an origin is a quarter of that of a position. More would
reach into the motion of the first stick."""
LEAST_SHARE = 0.9
"""Share of the sheets that the stretch for the origin must show. More would wait for sheets that come into
view late, while the others already move; fewer would place many sheets by their neighbours."""
LEAST_FOUND = 0.95
"""Share of the frames in which a sheet must have a position to count in a mean over sheets: a sheet that
comes and goes would shift the mean, a mean over too few sheets is noisier."""


def tracks_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure:
    """x(n, t) less each sheet's first position, in µm where the pixel size is known, else px.

    The origin is that of `origin_px`.
    """
    at, x_px = decimated_tracks(tracks)
    scale, unit = displacement_unit(pixel_size_um)
    displacement = (x_px - origin_px(tracks)) * scale
    frames = tracks.sizes["frame"]
    decimated = (
        f" The lines show the minimum and maximum position in each of {len(at) // 2} intervals of the "
        f"{frames} frames, so that no slip is lost; tracks.csv holds every frame."
        if len(at) < frames
        else ""
    )
    panel = Panel(
        title="Displacement of every sheet",
        x_label=time_axis(tracks)[1],
        y_label=f"x − x(start) ({unit})",
        series=sheet_series(tracks, at, displacement, inks=sheet_inks(tracks)),
        placeholder="no positions",
        aspect=0.4,
    )
    return Figure.of(
        "tracks",
        panel,
        "Position of each sheet less its median over the first frames in which most sheets were measured, so "
        "that a gap later on shifts no curve. Left sheets are dashed and blue, right ones solid and orange; "
        f"the tone changes steadily from the centre outwards.{decimated}",
        title="x(n,t): displacement of every sheet",
    )


def outer_inner_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure | None:
    """Deformation alone: the outer third of each side's sheets less the inner third; None for few."""
    scale, unit = displacement_unit(pixel_size_um)
    curves = outer_less_inner_px(tracks)
    if not curves:
        return None
    at, y = minmax_decimate(
        time_axis(tracks)[0], np.stack(list(curves.values()), axis=1) * scale, most=MOST_POINTS
    )
    series = tuple(
        Series(
            label="left side" if which < 0 else "right side",
            x=at,
            y=column,
            ink=DATA if which < 0 else PEAK,
            dashed=which < 0,
            width=1.0,
        )
        # the right one first: the left one is dashed and lies on it
        for which, column in sorted(zip(curves, y.T, strict=True), key=lambda curve: -curve[0])
    )
    panel = Panel(
        title="Outer less inner sheets",
        x_label=time_axis(tracks)[1],
        y_label=f"outer − inner ({unit})",
        series=series,
        placeholder="no frame with all of these sheets",
        aspect=0.25,
    )
    return Figure.of(
        "outer_inner",
        panel,
        "Mean outward displacement of the outer third of each side's sheets less that of its inner third: "
        "motion of the camera and of the sample as a whole drops out, deformation is left. Empty where a "
        "sheet that is otherwise there has no position.",
    )


def noise_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure:
    """Noise of every sheet's position in time and between sheets, and the error that is stated."""
    scale, unit = displacement_unit(pixel_size_um)
    numbers, order = signed_number(tracks)
    measured = tracks["x_noise_px"].values[order] * scale
    unknown = np.full(order.size, np.nan)
    scatter = (tracks["x_scatter_px"].values[order] if "x_scatter_px" in tracks else unknown) * scale
    stated = nan_median(tracks["x_err_px"].values)[order] * scale
    panel = Panel(
        x_label="side · n (left negative)",
        y_label=f"noise of x ({unit})",
        series=(
            Series.points("from frame to frame", numbers, measured, DATA),
            Series.points("between sheets", numbers, scatter, VALLEY),
            Series.points("stated error", numbers, stated, PEAK, hollow=True),
        ),
        y_range=from_zero(measured, scatter, stated),
        whole_numbers=True,
        aspect=0.4,
    )
    return Figure.of(
        "noise",
        panel,
        "Filled: scatter of each sheet's position from frame to frame, from second differences in time, so "
        "that creep and common motion do not count, and against its neighbours, from fourth differences "
        "along n. Hollow: the error stated for a position (median over the frames), from the noise of the "
        "profile, or with a lossy codec from the scatter between sheets. Scatter from frame to frame that is "
        "larger than the error is motion, or something that the error lacks.",
        title="Noise of the positions",
    )


def pixel_locking_figure(tracks: xr.Dataset) -> Figure:
    """Histogram of x modulo one pixel: flat unless the fit locks to whole pixels.

    The band is two standard errors about 1 from the scatter between sheets, each sheet counted as one
    observation however many frames it was seen in: positions of one sheet are not independent.
    """
    x = tracks["x_px"].values
    density, error = _density_modulo_one(x)
    centre = (np.arange(BINS) + 0.5) / BINS
    panel = Panel(
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
    )
    return Figure.of(
        "pixel_locking",
        panel,
        f"Density of x modulo one pixel over {np.isfinite(x).sum()} positions; 1 is an even spread. A fit "
        "that locks to whole pixels piles up near 0 and 1 and empties the middle, in every sheet. Band: "
        "two standard errors about 1, from the scatter between sheets; it is wide where the sheets move by "
        "less than a pixel.",
        title="Position modulo one pixel (locking check)",
    )


def _density_modulo_one(x_px: Floats) -> tuple[Floats, float]:
    """Density in each bin over an even one, and its standard error with sheets as the units.

    One error for all bins, the root mean square of theirs: without locking no bin differs from another. For
    a single sheet it is 1.
    """
    frame, sheet = np.nonzero(np.isfinite(x_px))
    place = np.minimum((x_px[frame, sheet] % 1.0 * BINS).astype(np.int64), BINS - 1)
    sheets = x_px.shape[1]
    counts = np.bincount(sheet * BINS + place, minlength=sheets * BINS).reshape(sheets, BINS)
    seen = counts.sum(axis=1, keepdims=True)
    total, known = max(1, int(seen.sum())), int((seen > 0).sum())
    share = counts.sum(axis=0) / total
    square = ((counts - seen * share) ** 2).sum(axis=0).mean() / total**2
    error = float(np.sqrt(square * known / (known - 1))) * BINS if known > 1 else 1.0
    return share * BINS, error


def decimated_tracks(tracks: xr.Dataset) -> tuple[Floats, Floats]:
    """Time and positions (points, sheet) in px, few enough for a page."""
    each = min(MOST_POINTS, max(200, 150_000 // max(1, tracks.sizes["sheet"])))
    return minmax_decimate(time_axis(tracks)[0], tracks["x_px"].values, most=each)


def signed_number(data: xr.Dataset) -> tuple[Floats, Ints]:
    """side · n in rising order, and the indices of the sheets in that order."""
    numbers = np.asarray(data["side"].values * data["n"].values, np.float64)
    order = np.argsort(numbers, kind="stable")
    return numbers[order], order


def sheet_series(
    tracks: xr.Dataset, at: Floats, y: Floats, *, inks: list[Ink], width: float = 1.0
) -> tuple[Series, ...]:
    """One curve a sheet, left ones dashed. at (points,); y (points, sheet), in the order of the tracks."""
    sides, numbers = tracks["side"].values, tracks["n"].values
    look: Literal["both", "line"] = "both" if len(at) <= 60 else "line"
    return tuple(
        Series(
            label=f"{'left' if side < 0 else 'right'} {n}",
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


def stick_figure(tracks: xr.Dataset, motion: xr.Dataset, clock: Clock, *, event: int | None = None) -> Figure:
    """Displacement of all sheets over one stick phase; by default over the one with most frames.

    Raises: InputError for an event that is not in `motion`, what `horizontal_deformation` returned.
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
    chosen = np.flatnonzero(np.isfinite(motion["ratio"].to_numpy()).any(axis=1))
    if chosen.size:
        chosen = chosen[np.unique(np.linspace(0, chosen.size - 1, 5).astype(int))]
    numbers, order = signed_number(motion)
    series = []
    for k, (ink, place) in enumerate(zip(ordered_inks(chosen.size), chosen, strict=True)):
        stick = motion.isel(event=place, sheet=order)
        value, error = stick["ratio"].to_numpy(), stick["ratio_err"].to_numpy()
        look: dict[str, Any] = {"look": "both", "hollow": k % 2 == 1, "width": 1.0}
        look |= {"low": np.maximum(value - error, 0), "high": value + error}
        label = f"d_v = {float(stick['d_v_mm']):.2f} mm"
        series.append(Series(label=label, x=numbers, y=value, ink=ink, **look))
    return Figure.of(
        "deformation",
        _ratio_panel(tuple(series), threshold),
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


def mean_deformation_figure(motion: xr.Dataset, *, threshold: float = 0.1) -> Figure | None:
    """σ_x/Λ_st against the sheet's number, each curve the mean of about a dozen sticks; None without any."""
    known = np.flatnonzero(np.isfinite(motion["ratio"].to_numpy()).any(axis=1))
    if not known.size:
        return None
    each = min(12, known.size)
    starts = np.unique(np.linspace(0, known.size - each, min(known.size // each, 5)).astype(int))
    numbers, order = signed_number(motion)
    d_v = motion["d_v_mm"].to_numpy()
    series = []
    for ink, start in zip(ordered_inks(len(starts)), starts, strict=True):
        places = known[start : start + each]
        part = motion["ratio"].isel(event=places, sheet=order)
        value, spread = part.mean("event").to_numpy(), part.std("event", ddof=1).fillna(0).to_numpy()
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


def shells_figure(shells: pd.DataFrame, fits: ModelFits | None = None) -> Figure:
    """Number of stiff sheets per side against d, with its interval, and M_eff of the force."""
    known = shells[shells["stiff_sheets"].notna()].sort_values("d_v_mm")
    steps = np.diff(np.unique(known["d_v_mm"].to_numpy(float)))
    beside = 0.12 * float(np.median(steps)) if steps.size else 0.0
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
        d = np.linspace(float(known["d_v_mm"].min()), float(known["d_v_mm"].max()), 300)
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


# --- displacement from one origin, the same in every figure ------------------------------------------------


def origin_px(tracks: xr.Dataset) -> Floats:
    """Position of every sheet in the first stretch in which most sheets were measured, (sheet,) in px.

    Medians over up to `ORIGIN_FRAMES` frames, the same frames for all sheets: the first run of frames in
    which nearly as many sheets as ever have a position. A sheet without one there starts, in its own first
    frames, at the displacement that its neighbours have in these frames (linear in n). NaN for a sheet that
    was never found.

    A mean or median over all frames depends on which of them have a position: a gap would shift the whole
    curve against its neighbours'.
    """
    x = np.asarray(tracks["x_px"].values, np.float64)
    known = np.isfinite(x)
    if not known.any():
        return np.full(x.shape[1], np.nan)
    first, last = _first_stretch(known)
    origin = nan_median(x[first:last])
    late = np.flatnonzero(~np.isfinite(origin) & known.any(axis=0))
    placed = np.flatnonzero(np.isfinite(origin))
    signed = np.asarray(tracks["side"].values * tracks["n"].values, np.float64)
    for sheet in late:
        frames = np.flatnonzero(known[:, sheet])[:ORIGIN_FRAMES]
        moved = nan_median(x[np.ix_(frames, placed)] - origin[placed])
        seen = np.flatnonzero(np.isfinite(moved))
        order = seen[np.argsort(signed[placed[seen]])]
        shift = np.interp(signed[sheet], signed[placed[order]], moved[order]) if order.size else 0.0
        origin[sheet] = np.median(x[frames, sheet]) - shift
    return origin


def _first_stretch(known: Bools) -> tuple[int, int]:
    """First and last + 1 of the frames for the origin."""
    frames, sheets = known.shape
    length = min(ORIGIN_FRAMES, frames)
    total = np.concatenate([np.zeros((1, sheets), np.int64), np.cumsum(known, axis=0)])
    whole = (total[length:] - total[:-length] == length).sum(axis=1)  # sheets with a position throughout
    if whole.max() == 0:
        start = int(known.any(axis=1).argmax())
        return start, min(start + length, frames)
    start = int((whole >= LEAST_SHARE * whole.max()).argmax())
    return start, start + length


def outward_px(tracks: xr.Dataset, sheets: Ints | None = None) -> Floats:
    """Mean displacement of sheets away from the axis since the origin, px, (frame,).

    sheets: indices of those that count; None for all. Only those with a position in most frames are used,
    or all of them where there is none.

    NaN in frames in which one of the sheets used has no position: without it the mean would jump. Where this
    leaves no frame, the mean over the sheets that have one.
    """
    chosen = np.arange(tracks.sizes["sheet"]) if sheets is None else sheets
    x = np.asarray(tracks["x_px"].values, np.float64)[:, chosen]
    found = np.isfinite(x).mean(axis=0)
    steady = found >= min(LEAST_FOUND, float(found.max(initial=0.0)))
    outward = (x - origin_px(tracks)[chosen]) * tracks["side"].values[chosen]
    whole = np.asarray(outward[:, steady].mean(axis=1)) if steady.any() else np.full(len(x), np.nan)
    if np.isfinite(whole).any():
        return whole
    known = np.isfinite(outward)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(known, outward, 0).sum(axis=1) / known.sum(axis=1))


def outer_less_inner_px(tracks: xr.Dataset) -> dict[int, Floats]:
    """Outward displacement of the outer third of the sheets less that of the inner third, by side, px.

    Motion of the camera and of the whole sample is in both thirds and drops out; what is left is deformation.
    Sides with fewer than three sheets are left out.
    """
    n, side = np.asarray(tracks["n"].values), np.asarray(tracks["side"].values)
    curves = {}
    for which in (-1, 1):
        mine = np.flatnonzero(side == which)
        third = mine.size // 3
        if third:
            ordered = mine[np.argsort(n[mine])]
            curves[which] = outward_px(tracks, ordered[-third:]) - outward_px(tracks, ordered[:third])
    return curves
