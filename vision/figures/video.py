"""Figures that need only the video: the frame, space-time diagrams, x(n,t), noise and pixel locking."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import xarray as xr

from vision.data import StripMetadata, TrackMetadata
from vision.figures.decimate import grey_levels, minmax_decimate, time_rows
from vision.figures.displacement import origin_px, outer_less_inner_px
from vision.figures.figure import Band, Figure, Image, Ink, Panel, Range, Series
from vision.figures.labels import UM_PER_MM, displacement_unit, position_unit, time_axis
from vision.figures.style import DATA, LEFT_ON_GREY, MODEL, PEAK, RIGHT_ON_GREY, VALLEY, sheet_inks
from vision.numeric import Floats, Floats32, Ints, Pixels, nan_median

MOST_ROWS = 1200  # of an image
MOST_POINTS = 1600  # of one sheet
MOST_POSITIONS = 150_000  # of all sheets together
KYMOGRAPH_CAPTION = (
    "Intensity I(x,t) averaged over the strip's rows, one frame below the other, time downwards. "
    "Pale blue: not recorded."
)
FEW_FRAMES = 60  # of which every position is shown as a dot
ROWS_PER_INCH = 75  # of the window around a sheet
BINS = 20  # of a pixel
NOT_SHOWN = ("lost", "blank", "corrupt")  # frames that hold no picture
FLATTEST = 0.03  # height over width of a frame below which it is stretched, or nothing could be seen
SAMPLED = 500  # rows and columns from which the grey scale is taken


def frame_figure(frame: Pixels, tracks: xr.Dataset) -> Figure:
    """One whole frame with the averaged rows outlined, the sheets' numbers n and the symmetry axis.

    A pixel is drawn square; only a frame too flat to show anything is stretched, and its title says so.

    Parameters
    ----------
    frame
        (rows, columns), any depth.
    tracks
        From `track_sheets`.
    """
    rows, columns = frame.shape
    step = max(1, -(-rows // MOST_ROWS), -(-columns // (2 * MOST_ROWS)))
    grey = np.asarray(frame, np.float32)[::step, ::step]
    low, high = np.percentile(grey, (0.5, 99.8))
    strip = StripMetadata.of(tracks)
    z0, z1 = float(strip.strip_z0), float(strip.strip_z1)
    axis_px = TrackMetadata.of(tracks).axis_px
    shown = (
        min(-0.5, z0 - max(0.15 * rows, 0.02 * columns)),
        rows - 0.5,
    )  # the numbers stand above the strip
    aspect = (shown[1] - shown[0]) / columns
    low, high = float(low), float(max(high, low + 1))
    which = _which_frame(tracks)
    stretched = f"; z stretched {FLATTEST / aspect:.2g} times" if aspect < FLATTEST else ""
    panel = Panel(
        title=f"{which}: averaged rows (outlined), sheet numbers n, symmetry axis (dashed){stretched}",
        x_label="x (px)",
        y_label="z (px)",
        series=_numbered_strokes(tracks, z0, z1),
        image=Image(
            pixels=grey_levels(grey, low, high),
            left=-0.5,
            right=columns - 0.5,
            top=-0.5,
            bottom=rows - 0.5,
            black=low,
            white=high,
        ),
        bands=(Band(low=z0 - 0.5, high=z1 - 0.5, label="strip", outline=True),),
        x_lines=(axis_px,) if np.isfinite(axis_px) else (),
        x_range=(-0.5, columns - 0.5),
        y_range=shown,
        downwards=True,
        aspect=float(np.clip(aspect, FLATTEST, 1)),
        square_pixels=aspect >= FLATTEST,
    )
    return Figure(
        name="frame",
        title="The frame, the strip and the numbered sheets",
        caption=(
            f"{which} of the recording. The outlined rows {z0:.0f} to {z1:.0f} (half-open) are averaged "
            "to the profile I(x); vertical strokes mark the sheets that were found, with their number n "
            "counted outwards from the symmetry axis (dashed)."
        ),
        panels=(panel,),
    )


def _which_frame(tracks: xr.Dataset) -> str:
    """Number and time of the frame that is shown, the first that is neither lost nor blank."""
    shown = ~np.isin(tracks["flag"].values[:, :1], NOT_SHOWN) if "flag" in tracks else np.ones((1, 1), bool)
    place = int(shown[:, 0].argmax()) if shown.size else 0
    number = int(tracks["frame"].values[place]) if "frame" in tracks.coords else place
    time = float(tracks["time_s"].values[place])
    return f"Frame {number}" + (f" (t = {time:.4g} s)" if np.isfinite(time) else "")


def _numbered_strokes(tracks: xr.Dataset, z0: float, z1: float) -> tuple[Series, ...]:
    """Vertical strokes from row z0 to z1 at every sheet seen, with n as text; one series a side."""
    x_px = tracks["x_px"].values
    seen = np.isfinite(x_px).any(axis=1)
    x = np.asarray(
        x_px[int(np.argmax(seen))], np.float64
    )  # as in the frame that is shown: the first with any
    known = np.flatnonzero(np.isfinite(x))
    inks = sheet_inks(tracks)
    side, n = tracks["side"].values, tracks["n"].values
    return tuple(
        Series(
            label=f"sheets {name} of the axis",
            x=x[mine],
            y=np.full(len(mine), (z0 + z1) / 2 - 0.5),
            low=np.full(len(mine), z0 - 0.5),
            high=np.full(len(mine), z1 - 0.5),
            text=tuple(str(k) for k in n[mine]),
            ink=inks[mine[-1 if which > 0 else 0]],
            look="ticks",
        )
        for which, name in ((-1, "left"), (1, "right"))
        if len(mine := known[side[known] == which])
    )


# --- space-time diagrams ------------------------------------------------------------------------------------


def space_time_figure(
    strip: xr.DataArray,
    tracks: xr.Dataset,
    *,
    pixel_size_um: float | None = None,
    slips_s: Floats | None = None,
    slips_from: str = "the force",
) -> Figure:
    """I(x, t), time downwards, with the tracks on it.

    Parameters
    ----------
    strip
        I(x, t) from `strip_profile`.
    tracks
        From `track_sheets`.
    pixel_size_um
        Gives lengths in mm (µm below 1 mm); px without it.
    slips_s, slips_from
        Times to mark, on the recording's clock, s, and where they are from: in a long recording an image row
        stands for many frames, and a slip cannot be seen otherwise.

    Notes
    -----
    Rows of the image are means of the frames that they stand for; the tracks keep the minimum and maximum
    position of each interval.
    """
    scale, _ = position_unit(pixel_size_um, strip.sizes["x"])
    at, x_px = decimated_tracks(tracks)
    inks: list[Ink] = [LEFT_ON_GREY if side < 0 else RIGHT_ON_GREY for side in tracks["side"].values]
    panel = _diagram_panel(
        strip,
        pixel_size_um=pixel_size_um,
        limits=grey_limits([strip]),
        series=tuple(
            replace(series, dashed=False)  # dashes are lost in a narrow line with a dark edge
            for series in sheet_series(tracks, at, x_px * scale, inks=inks, width=1.0)
        ),
        title="Space-time diagram with the tracks",
        marks=slips_s,
        marks_label=f"orange: slips, from {slips_from}",
    )
    panel = replace(panel, y_range=_comb_range(tracks, panel, scale))
    rows = 1 if panel.image is None else len(panel.image.pixels)
    averaged = strip.sizes["frame"] / rows
    means = f" Each row is the mean of about {averaged:.0f} frames." if averaged > 1.5 else ""
    marked = (
        f" Orange ticks: {panel.marks.size} slips, from {slips_from}."
        if panel.marks is not None and panel.marks.size
        else ""
    )
    return Figure(
        name="space_time",
        title="Space-time diagram with the tracks",
        caption=(
            "Intensity I(x,t) averaged over the strip's rows, one frame below the other, time downwards; "
            "the lines are the positions x(n,t), left of the symmetry axis blue, right orange."
            f"{means}{marked} kymograph.tif holds every frame."
        ),
        panels=(panel,),
    )


def _comb_range(tracks: xr.Dataset, panel: Panel, scale: float) -> Range | None:
    """The sheets and two pitches beside them, within the image."""
    x = tracks["x_px"].values
    if panel.image is None or not np.isfinite(x).any():
        return panel.y_range
    margin = 2 * TrackMetadata.of(tracks).pitch_px
    margin = margin if np.isfinite(margin) else x.size
    low, high = (np.nanmin(x) - margin) * scale, (np.nanmax(x) + margin) * scale
    return max(panel.image.left, float(low)), min(panel.image.right, float(high))


def kymograph_figure(
    diagrams: Sequence[xr.DataArray],
    *,
    pixel_size_um: float | None = None,
    slips_s: Floats | None = None,
    slips_from: str = "the force",
) -> Figure:
    """Space-time diagrams side by side, with one time axis and one grey scale for all.

    Parameters
    ----------
    diagrams
        From `space_time`: the whole strip, or windows around sheets. The pixel size in their attributes is
        used where they have one.
    pixel_size_um
        For diagrams without it.
    slips_s
        Times to mark, on the recording's clock, s.
    slips_from
        What the times were taken from, for the label.
    """
    limits = grey_limits(diagrams)
    windows = "sheet" in diagrams[0].attrs
    rows = max(len(diagram) for diagram in diagrams)
    height = float(np.clip(rows / ROWS_PER_INCH, 3, 8)) if windows else 6.5
    width = 13.0 if not windows else 1.1 + 2.3 * len(diagrams)
    panels = []
    for k, diagram in enumerate(diagrams):
        panel = _diagram_panel(
            diagram,
            pixel_size_um=diagram.attrs.get("pixel_size_um", pixel_size_um),
            limits=limits,
            title=_window_title(diagram, pixel_size_um),
            marks=slips_s,
            marks_label=f"orange: slips, from {slips_from}",
            with_time=k == 0,
            aspect=height / (2.1 if windows else 12),
        )
        panels.append(panel)
    return Figure(
        name="kymograph",
        title="Space-time diagrams",
        caption=KYMOGRAPH_CAPTION,
        panels=tuple(panels),
        columns=len(panels),
        width_in=width,
    )


def _diagram_panel(
    diagram: xr.DataArray,
    *,
    pixel_size_um: float | None,
    limits: Range,
    series: tuple[Series, ...] = (),
    title: str = "",
    marks: Floats | None = None,
    marks_label: str = "",
    with_time: bool = True,
    aspect: float = 0.5,
) -> Panel:
    """I(x, t) with time downwards; gaps in the frames' times stay gaps."""
    time, time_label = time_axis(diagram)
    edges_x, x_label = _columns(diagram, pixel_size_um)
    thin = max(1, -(-diagram.shape[1] // (2 * MOST_ROWS)))
    rows, edges = time_rows(np.asarray(diagram.values)[:, ::thin], time, most=MOST_ROWS)
    missing = ~np.isfinite(rows)
    if marks is not None and time_label != "frame":
        marks = marks[(marks >= edges[0]) & (marks <= edges[-1])]
    else:
        marks = None
    return Panel(
        title=title,
        x_label=time_label if with_time else "",
        y_label=x_label,
        series=series,
        image=Image(
            pixels=grey_levels(rows, *limits),
            left=float(edges_x[0]),
            right=float(edges_x[-1]),
            top=float(edges[0]),
            bottom=float(edges[-1]),
            missing=missing if missing.any() else None,
            black=limits[0],
            white=limits[1],
        ),
        marks=marks,
        marks_label=marks_label if marks is not None and marks.size else "",
        x_range=(float(edges[0]), float(edges[-1])),
        y_range=(float(edges_x[0]), float(edges_x[-1])),
        time_down=True,
        aspect=aspect,
    )


def grey_limits(diagrams: Sequence[xr.DataArray]) -> Range:
    """Grey levels shown as black and white, the same for all: all but the outermost half per cent."""
    known = [d.values[:: max(1, len(d) // SAMPLED), :: max(1, d.shape[1] // SAMPLED)] for d in diagrams]
    grey: Floats32 = np.concatenate([values[np.isfinite(values)] for values in known])
    if not grey.size:
        return 0.0, 1.0
    low, high = np.percentile(grey, (0.5, 99.5))
    return float(low), max(float(high), float(low) + 1e-6)


def _columns(diagram: xr.DataArray, size: float | None) -> tuple[Floats, str]:
    """Edges of the columns and their label: mm, or µm below 1 mm and in a window; px without a pixel size."""
    x = np.asarray(diagram["x"].values, np.float64)
    edges = np.append(x - 0.5, x[-1] + 0.5)
    if "sheet" not in diagram.attrs:
        scale, unit = position_unit(size, x.size)
        return edges * scale, f"x ({unit})"
    name = "x − x(n,t)"
    if not diagram.attrs["follow"]:
        edges, name = edges - diagram.attrs["centre_px"], "x − x₀"
    scale, unit = displacement_unit(size)
    return edges * scale, f"{name} ({unit})"


def _window_title(diagram: xr.DataArray, pixel_size_um: float | None) -> str:
    if "sheet" not in diagram.attrs:
        return "Space-time diagram of the strip"
    side, n = diagram.attrs["sheet"].split(":")
    size, centre = diagram.attrs.get("pixel_size_um", pixel_size_um), diagram.attrs["centre_px"]
    place = f"{centre:.1f} px" if size is None else f"{centre * size / UM_PER_MM:.2f} mm"
    return f"{side}, n = {n}" + ("" if diagram.attrs["follow"] else f"\nx₀ = {place}")


# --- positions ----------------------------------------------------------------------------------------------


def tracks_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure:
    """x(n, t) less each sheet's first position, in µm where the pixel size is known, else px.

    The origin is that of `vision.figures.displacement.origin_px`.
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
    return Figure(
        name="tracks",
        title="x(n,t): displacement of every sheet",
        caption=(
            "Position of each sheet less its median over the first frames in which most sheets were "
            "measured, so that a gap later on shifts no curve. Left sheets are dashed and blue, "
            f"right ones solid and orange; the tone changes steadily from the centre outwards.{decimated}"
        ),
        panels=(panel,),
    )


def outer_inner_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure | None:
    """Deformation alone: the outer third of a side's sheets less the inner third; None for few sheets."""
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
        for which, column in zip(curves, y.T, strict=True)
    )
    panel = Panel(
        title="Outer less inner sheets",
        x_label=time_axis(tracks)[1],
        y_label=f"outer − inner ({unit})",
        series=series,
        placeholder="no frame with all of these sheets",
        aspect=0.25,
    )
    return Figure(
        name="outer_inner",
        title="Outer less inner sheets",
        caption=(
            "Mean outward displacement of the outer third of the sheets of a side less that of its inner "
            "third: motion of the camera and of the sample as a whole drops out, deformation is left. Empty "
            "where a sheet that is otherwise there has no position."
        ),
        panels=(panel,),
    )


def noise_figure(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Figure:
    """Noise of every sheet's position in time and between sheets, and the error that is stated."""
    scale, unit = displacement_unit(pixel_size_um)
    numbers, order = signed_number(tracks)
    measured = tracks["x_noise_px"].values[order] * scale
    scatter = (tracks["x_scatter_px"].values if "x_scatter_px" in tracks else np.full(order.size, np.nan))[
        order
    ] * scale
    stated = nan_median(tracks["x_err_px"].values)[order] * scale
    panel = Panel(
        x_label="side · n (left negative)",
        y_label=f"noise of x ({unit})",
        series=(
            Series(label="from frame to frame", x=numbers, y=measured, ink=DATA, look="points"),
            Series(label="between sheets", x=numbers, y=scatter, ink=VALLEY, look="points"),
            Series(label="stated error", x=numbers, y=stated, ink=PEAK, look="points", hollow=True),
        ),
        y_range=(0.0, _top(measured, scatter, stated)),
        whole_numbers=True,
        aspect=0.4,
    )
    return Figure(
        name="noise",
        title="Noise of the positions",
        caption=(
            "Filled: scatter of each sheet's position from frame to frame, from second differences in "
            "time, so that creep and common motion do not count, and against its neighbours, from fourth "
            "differences along n. Hollow: the error stated for a position (median over the frames), from "
            "the noise of the profile, or with a lossy codec from the scatter between sheets. Scatter from "
            "frame to frame that is larger than the error is motion, or something that the error lacks."
        ),
        panels=(panel,),
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
        y_range=(0.0, _top(density, np.array([1 + 2 * error]))),
        aspect=0.4,
    )
    return Figure(
        name="pixel_locking",
        title="Position modulo one pixel (locking check)",
        caption=(
            f"Density of x modulo one pixel over {np.isfinite(x).sum()} positions; 1 is an even spread. A "
            "fit that locks to whole pixels piles up near 0 and 1 and empties the middle, in all sheets "
            "alike. Band: two standard errors about 1, from the scatter between sheets; it is wide where "
            "the sheets move by less than a pixel."
        ),
        panels=(panel,),
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
    each = min(MOST_POINTS, max(200, MOST_POSITIONS // max(1, tracks.sizes["sheet"])))
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
    look: Literal["both", "line"] = "both" if len(at) <= FEW_FRAMES else "line"
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


def _top(*values: Floats) -> float:
    """A little above the largest value."""
    return 1.15 * float(max((np.nanmax(v) for v in values if np.isfinite(v).any()), default=1.0))
