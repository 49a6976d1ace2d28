"""Figures of the film: one frame, its profile I(x), and space-time diagrams with tracks and slips."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import xarray as xr

from vision.clock import video_slips
from vision.data import SIDES, DiagramMetadata, StripMetadata, TrackMetadata
from vision.errors import InputError
from vision.figures.figure import Band, Figure, Image, Panel, Range, Series
from vision.figures.positions import decimated_tracks, sheet_series
from vision.figures.style import (
    DATA,
    MODEL,
    ON_GREY,
    PEAK,
    QUIET,
    UM_PER_MM,
    VALLEY,
    displacement_unit,
    from_zero,
    position_unit,
    time_axis,
)
from vision.numeric import Floats, Floats32, Pixels, nan_median
from vision.spacetime import grey_levels, grey_limits, space_time, time_rows
from vision.words import is_word

MOST_ROWS = 1200  # of an image
X_PX, GREY_LEVELS = "x (px)", "I (grey levels)"  # labels of axes
SHOWN_SLIPS = 4  # of single sheets, as in the publication
KYMOGRAPH_CAPTION = (
    "Intensity I(x,t) averaged over the strip's rows, one frame below the other, time downwards. "
    "Pale blue: not recorded."
)
INTERPOLATED = " Interpolated between pixels along x; the TIFF files hold the pixels."


class SlipTimes(NamedTuple):
    """Rising times of slips on the camera's clock, s, None if unknown, and what they were found from."""

    time_s: Floats | None = None
    source: str = "the force"

    def within(self, start_s: float, stop_s: float) -> Floats:
        """Return the times from start to stop; none if they are unknown."""
        known = np.empty(0) if self.time_s is None else self.time_s
        return known[(known >= start_s) & (known <= stop_s)]


NO_SLIPS = SlipTimes()


def sides_known(tracks: xr.Dataset) -> bool:
    """Tell whether the sides and n are meaningful: the axis was given, or the motion limits it.

    In few frames the sheets hardly move. The axis may then be anywhere in half of the comb, or lie beside it.
    """
    found, side, mean = TrackMetadata.of(tracks), tracks["side"].values, tracks["x_mean_px"]
    limited = found.axis_high_px - found.axis_low_px < 0.5 * float(mean.max() - mean.min())
    return found.axis_how == "given" or bool(limited and (side < 0).any() and (side > 0).any())


def _axis_is_middle(tracks: xr.Dataset) -> bool:
    """Tell whether the axis is only the middle of the sheets in view, as the motion does not show it."""
    found = TrackMetadata.of(tracks)
    return found.axis_how == "geometry" and math.isnan(found.axis_low_px)


def frame_figure(
    frame: Pixels,
    tracks: xr.Dataset,
    *,
    strip: xr.DataArray | None = None,
    axis: bool = True,
    pixel_size_um: float | None = None,
) -> Figure:
    """Return one whole frame with the averaged rows outlined, the sheets' numbers n and the symmetry axis.

    With the strip, the outline encloses only its columns. Without an axis the numbers are the index from the
    left. Pixels are square, unless the frame is so flat or narrow that it must be stretched, as title and
    caption then say.
    """
    rows, columns = frame.shape
    step = max(1, -(-rows // MOST_ROWS), -(-columns // (2 * MOST_ROWS)))
    grey = frame[::step, ::step].astype(np.float32)
    low, high = grey_limits(grey)
    facts = StripMetadata.of(tracks)
    z0, z1 = float(facts.strip_z0), float(facts.strip_z1)
    across = None if strip is None else (float(strip["x"][0]) - 0.5, float(strip["x"][-1]) + 0.5)
    axis_px = TrackMetadata.of(tracks).axis_px if axis else math.nan
    numbers, explained = "index from the left (axis not known)", "index from the left"
    if axis:
        how = "dashed; the motion does not show it" if _axis_is_middle(tracks) else "dashed"
        numbers = f"sheet numbers n, symmetry axis ({how})"
        explained = f"number n counted outwards from the symmetry axis ({how})"
    aspect = rows / columns
    shown = float(np.clip(aspect, 0.09, 1.5))
    z_scale = shown / aspect  # over that of x
    stretched = ""
    if z_scale > 1:
        stretched = f"; z stretched {z_scale:.2g} times"
    elif z_scale < 1:
        stretched = f"; x stretched {1 / z_scale:.2g} times"
    number_height = 0.03 * columns / z_scale
    # Numbers that do not fit between the picture's edge and the strip are above the picture.
    numbers_z = z0 - 0.5 if z0 > number_height else -0.5
    z_range = min(-0.5, numbers_z - number_height), rows - 0.5
    first = 0  # the frame shown is the first that is not lost, blank or corrupt
    if "flag" in tracks:
        first = int((~is_word(tracks["flag"], "lost", "blank", "corrupt")).all(axis=1).argmax())
    time_s = float(tracks["time_s"].values[first])
    which = f"Frame {int(tracks['frame'].values[first])}"
    which += f" (t = {time_s:.4g} s)" if np.isfinite(time_s) else ""
    return Panel(
        title=f"{which}: averaged rows (outlined), {numbers}{stretched}",
        x_label=X_PX if pixel_size_um is None else f"x (px of {pixel_size_um:.4g} µm)",
        y_label="z (px)",
        series=_strokes(tracks, z0, z1, numbers_z, axis=axis),
        image=Image(
            pixels=grey_levels(grey, low, high),
            left=-0.5,
            right=columns - 0.5,
            top=-0.5,
            bottom=rows - 0.5,
            black=low,
            white=high,
        ),
        bands=(Band(low=z0 - 0.5, high=z1 - 0.5, label="strip", outline=True, across=across),),
        x_lines=(axis_px,) if np.isfinite(axis_px) else (),
        x_range=(-0.5, columns - 0.5),
        y_range=z_range,
        downwards=True,
        aspect=z_scale * (z_range[1] - z_range[0]) / columns,
        square_pixels=shown == aspect,
    ).figure(
        "frame",
        f"{which} of the recording. The outlined rows {z0:.0f} to {z1:.0f} (half-open) are averaged to the "
        f"profile I(x); vertical strokes mark the sheets that were found, with their {explained}{stretched}.",
        title="The frame, the strip and the numbered sheets",
    )


def _strokes(tracks: xr.Dataset, z0: float, z1: float, numbers_z: float, *, axis: bool) -> tuple[Series, ...]:
    """Return vertical strokes from row z0 to z1 at every sheet that the first tracked frame shows.

    Their text, at numbers_z, is n, in one series per side, or without an axis the index from the left.
    """
    x_px = tracks["x_px"].values
    x = np.asarray(x_px[int(np.argmax(np.isfinite(x_px).any(axis=1)))], np.float64)
    known, side = np.flatnonzero(np.isfinite(x)), tracks["side"].values
    groups = [("sheets", known, tracks["sheet"].values, PEAK)]
    if axis:
        groups = [
            (f"sheets {name} of the axis", mine, tracks["n"].values, ON_GREY[which])
            for which, name in SIDES.items()
            if len(mine := known[side[known] == which])
        ]
    return tuple(
        Series(
            label=label,
            x=x[mine],
            y=np.full(len(mine), (z0 + z1) / 2 - 0.5),
            low=np.full(len(mine), z0 - 0.5),
            high=np.full(len(mine), z1 - 0.5),
            text=tuple(str(number) for number in numbers[mine]),
            text_y=numbers_z,
            ink=ink,
            look="ticks",
        )
        for label, mine, numbers, ink in groups
    )


# --- profiles -----------------------------------------------------------------------------------------------


def preview_figure(
    frame: Pixels, strip: xr.DataArray, tracks: xr.Dataset, *, pixel_size_um: float | None = None
) -> Figure:
    """Return a frame with strip and sheets, its profile I(x) with positions, and the noise of each sheet.

    Strip and tracks are those of a few consecutive frames, and the frame is the first usable one of them.
    """
    facts = StripMetadata.of(strip)
    left, right = -0.5, frame.shape[1] - 0.5
    first = int(np.argmax(np.isfinite(tracks["x_px"].values).any(axis=1)))
    title = f"Profile I(x): mean of rows {facts.strip_z0}:{facts.strip_z1} of this frame"
    curve = replace(_profile_panel(strip, tracks, first, title), x_range=(left, right), aspect=0.2)
    scale, unit = displacement_unit(pixel_size_um)
    mean = np.asarray(tracks["x_mean_px"].values, np.float64)
    stated = nan_median(tracks["x_err_px"].values) * scale
    measured = np.asarray(tracks["x_noise_px"].values, np.float64) * scale
    noise = Panel(
        title="Noise of one position of every sheet",
        x_label=X_PX,
        y_label=f"noise of x ({unit})",
        series=(
            Series.points("scatter between frames", mean, measured, DATA),
            Series.points("stated error", mean, stated, VALLEY, hollow=True),
        ),
        x_range=(left, right),
        y_range=from_zero(stated, measured),
        aspect=0.2,
        placeholder="no positions",
    )
    picture = frame_figure(
        frame, tracks, strip=strip, axis=sides_known(tracks), pixel_size_um=pixel_size_um
    ).panel
    return Figure(
        name="preview",
        title="Preview",
        caption=(
            f"Top: frame {int(tracks['frame'].values[first])} with the averaged rows (outlined) and the "
            "sheets' numbers. Middle: the mean of these rows with the positions. Bottom: the stated standard "
            "error of one position (hollow) and the scatter from frame to frame over "
            f"{tracks.sizes['frame']} consecutive frames (filled)."
        ),
        panels=(picture, curve, noise),
        width_in=page_width_in(picture),
    )


def page_width_in(frame: Panel) -> float:
    """Return the width in inches of a figure with this frame: less than usual if the frame is high."""
    return min(13.0, 1.1 + 7.0 / frame.aspect)


def intensity_figure(strip: xr.DataArray, tracks: xr.Dataset, slips: SlipTimes = NO_SLIPS) -> Figure | None:
    """Return I(x) of one frame, and one ridge at the start and end of a stick phase and after the slip.

    With fewer than two slips only I(x) is shown.
    """
    x_px = np.asarray(tracks["x_px"].values, np.float64)
    frames = _stick_frames(tracks, slips)
    measured = np.flatnonzero(np.isfinite(x_px).any(axis=1))
    if not measured.size:
        return None
    start = frames[0] if frames and frames[0] in measured else int(measured[0])
    time, label = time_axis(tracks)
    when = f"frame {time[start]:.4g}" if label == "frame" else f"t = {time[start]:.4g} s"
    profile = _profile_panel(strip, tracks, start, f"Profile at {when}")
    ridge = _ridge_panel(strip, tracks, frames) if frames else None
    caption = "Intensity averaged over the strip's rows against the column, with the positions."
    if ridge is not None:
        caption += (
            " Below: one ridge at the beginning and at the end of a stick phase and after the slip; vertical "
            "lines are its positions. In the publication sheets move inwards during a stick phase and back "
            "in the slip."
        )
    return Figure(
        name="intensity",
        title="Intensity profile and one ridge in three frames",
        caption=caption,
        panels=(profile,) if ridge is None else (profile, ridge),
    )


def _profile_panel(strip: xr.DataArray, tracks: xr.Dataset, row: int, title: str) -> Panel:
    """Return the profile of one frame with its positions."""
    columns, values = (np.asarray(part, np.float64) for part in (strip["x"].values, strip.values[row]))
    at = tracks["x_px"].values[row]
    at = np.sort(at[np.isfinite(at)])
    return Panel(
        title=title,
        x_label=X_PX,
        y_label=GREY_LEVELS,
        series=(
            Series(label="I(x)", x=columns, y=values, ink=QUIET, width=0.9),
            Series.points("x(n)", at, np.interp(at, columns, values), PEAK),
        ),
        aspect=0.35,
    )


def _stick_frames(tracks: xr.Dataset, slips: SlipTimes) -> tuple[int, int, int] | None:
    """Return first and last frame of the longest early stick phase, and the first frame after its slip."""
    time, label = time_axis(tracks)
    if label == "frame" or time.size < 4:
        return None
    step = float(np.median(np.diff(time)))
    slips_s = slips.within(time[0], time[-1] - 2 * step)
    if slips_s.size < 2:
        return None
    which = int(np.diff(slips_s[: SHOWN_SLIPS + 1]).argmax())
    # One frame is left out on each side of a slip, as the slip may be in its exposure.
    start = int(np.searchsorted(time, slips_s[which] + step))
    end = int(np.searchsorted(time, slips_s[which + 1] - step)) - 1
    after = int(np.searchsorted(time, slips_s[which + 1] + step))
    return (start, end, after) if start < end < after < time.size else None


def _ridge_panel(strip: xr.DataArray, tracks: xr.Dataset, frames: tuple[int, int, int]) -> Panel | None:
    """Return profiles and positions, in three frames, of the rightmost sheet that all of them show."""
    x_px = tracks["x_px"].values[list(frames)]
    measured = np.isfinite(x_px).all(axis=0)
    if not measured.any():
        return None
    sheet = int(np.where(measured, tracks["side"].values * tracks["n"].values, -np.inf).argmax())
    columns, positions = np.asarray(strip["x"].values, np.float64), x_px[:, sheet]
    pitch = TrackMetadata.of(tracks).pitch_px
    reach = 0.9 * pitch if math.isfinite(pitch) else 20.0
    near = np.flatnonzero(np.abs(columns - positions.mean()) <= reach)
    series: list[Series] = []
    named = (("stick begins", DATA, False), ("stick ends", PEAK, False), ("after the slip", MODEL, True))
    for (name, ink, hollow), frame, at in zip(named, frames, positions, strict=True):
        values = np.asarray(strip.values[frame, near], np.float64)
        series.append(Series(label=name, x=columns[near], y=values, ink=ink, look="both", hollow=hollow))
        ends = np.array([values.min(), values.max()])
        series.append(Series(label="", x=np.array([at, at]), y=ends, ink=ink, dashed=True, width=1.0))
    return Panel(
        title=f"Sheet n = {int(tracks['n'].values[sheet])}, {SIDES[int(tracks['side'].values[sheet])]}",
        x_label=X_PX,
        y_label=GREY_LEVELS,
        series=tuple(series),
        aspect=0.35,
    )


# --- space-time diagrams ------------------------------------------------------------------------------------


def common_steps_s(tracks: xr.Dataset | None) -> Floats | None:
    """Return the times at which all sheets step outwards, s on the camera's clock; None if not known.

    They are not known if the axis is only the middle of the sheets in view, as the outward direction is then
    not known.
    """
    if tracks is None or _axis_is_middle(tracks):
        return None
    try:
        return video_slips(tracks)["time_s"].to_numpy(float)
    except InputError:  # too few frames, or none with a time
        return None


def space_time_figure(
    strip: xr.DataArray,
    tracks: xr.Dataset,
    *,
    pixel_size_um: float | None = None,
    slips: SlipTimes = NO_SLIPS,
) -> Figure:
    """Return I(x, t), time downwards, with the tracks and marks at the times of the slips.

    A row of the image is the mean of several frames of a long film, and does not show single slips. The
    tracks show the minimum and maximum position of each interval.
    """
    scale, _ = position_unit(pixel_size_um, strip.sizes["x"])
    at, x_px = decimated_tracks(tracks)
    inks = [ON_GREY[side] for side in tracks["side"].values.tolist()]
    panel = _diagram_panel(
        strip,
        pixel_size_um=pixel_size_um,
        limits=grey_limits(strip.values),
        series=tuple(
            replace(series, dashed=False)  # dashes are invisible in a narrow line with a dark edge
            # narrower for many sheets, which would otherwise hide the image
            for series in sheet_series(tracks, at, x_px * scale, inks=inks, width=min(1.0, 50 / len(inks)))
        ),
        title="Space-time diagram with the tracks",
        slips=slips,
    )
    image, marks = panel.image, panel.marks
    assert image is not None and marks is not None
    x, pitch = tracks["x_px"].values, TrackMetadata.of(tracks).pitch_px
    if np.isfinite(pitch) and np.isfinite(x).any():  # the sheets and two pitches beside them
        low, high = (np.nanmin(x) - 2 * pitch) * scale, (np.nanmax(x) + 2 * pitch) * scale
        panel = replace(panel, y_range=(max(image.left, float(low)), min(image.right, float(high))))
    averaged = strip.sizes["frame"] / len(image.pixels)
    means = f" Each row is the mean of about {averaged:.0f} frames." if averaged > 1.5 else ""
    marked = f" Magenta ticks: {marks.size} slips, from {slips.source}." if marks.size else ""
    return panel.figure(
        "space_time",
        "Intensity I(x,t) averaged over the strip's rows, one frame below the other, time downwards; the "
        "lines are the positions x(n,t), left of the symmetry axis blue, right orange, interrupted at jumps."
        f"{means}{marked} kymograph.tif holds every frame.",
    )


def kymograph_figure(diagrams: Sequence[xr.DataArray], *, slips: SlipTimes = NO_SLIPS) -> Figure:
    """Return space-time diagrams, as `space_time` returns them, with one time axis and one grey scale.

    slips: those to mark.
    """
    limits = grey_limits(*(diagram.values for diagram in diagrams))
    windows = bool(DiagramMetadata.of(diagrams[0]).sheet)
    height = float(np.clip(max(map(len, diagrams)) / 75, 3, 8)) if windows else 6.5
    panels = tuple(
        _diagram_panel(
            diagram,
            pixel_size_um=DiagramMetadata.of(diagram).size_um,
            limits=limits,
            title=_window_title(diagram),
            slips=slips,
            with_time=k == 0,
            aspect=height / (2.1 if windows else 12),
        )
        for k, diagram in enumerate(diagrams)
    )
    if windows and len({diagram.sizes["x"] for diagram in diagrams}) == 1:  # one range, so the same ticks
        lows, highs = zip(*(panel.y_range for panel in panels if panel.y_range), strict=True)
        panels = tuple(replace(panel, y_range=(max(lows), min(highs))) for panel in panels)
    interpolated = any(panel.image is not None and panel.image.interpolated for panel in panels)
    return Figure(
        name="kymograph",
        title="Space-time diagrams",
        caption=KYMOGRAPH_CAPTION + (INTERPOLATED if interpolated else ""),
        panels=panels,
        columns=len(panels),
        width_in=1.1 + 2.3 * len(diagrams) if windows else 13.0,
        panel_titles=True,
    )


def _diagram_panel(
    diagram: xr.DataArray,
    *,
    pixel_size_um: float | None,
    limits: Range,
    title: str,
    series: tuple[Series, ...] = (),
    slips: SlipTimes,
    with_time: bool = True,
    aspect: float = 0.5,
) -> Panel:
    """Return I(x, t) with time downwards; gaps in the frames' times are gaps in the image."""
    time, time_label = time_axis(diagram)
    edges_x, x_label = _columns(diagram, pixel_size_um)
    thin = max(1, -(-diagram.shape[1] // (2 * MOST_ROWS)))
    rows, edges = time_rows(np.asarray(diagram.values)[:, ::thin], time, most=MOST_ROWS)
    drawn = _finer(rows) if DiagramMetadata.of(diagram).sheet else rows
    missing = ~np.isfinite(drawn)
    marks = np.empty(0) if time_label == "frame" else slips.within(edges[0], edges[-1])
    return Panel(
        title=title,
        x_label=time_label if with_time else "",
        y_label=x_label,
        series=series,
        image=Image(
            pixels=grey_levels(drawn, *limits),
            left=float(edges_x[0]),
            right=float(edges_x[-1]),
            top=float(edges[0]),
            bottom=float(edges[-1]),
            missing=missing if missing.any() else None,
            black=limits[0],
            white=limits[1],
            interpolated=drawn.shape != rows.shape,
        ),
        marks=marks,
        marks_label=f"arrowheads: slips, from {slips.source}" if marks.size else "",
        x_range=(float(edges[0]), float(edges[-1])),
        y_range=(float(edges_x[0]), float(edges_x[-1])),
        time_down=True,
        aspect=aspect,
    )


def _finer(rows: Floats32) -> Floats32:
    """Interpolate rows of an image between its pixels along x, with cubic curves, (rows, k · columns).

    Drawn as squares, the pixels of a narrow window hide motion of less than a pixel.
    """
    columns = rows.shape[1]
    finer = -(-240 // columns)  # so that a window has at least 240 columns
    known = np.isfinite(rows)
    if finer == 1 or columns < 2 or not known.any():
        return rows
    size = finer * columns, len(rows)
    fine = cv2.resize(np.where(known, rows, 0.0).astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    return np.where(known.repeat(finer, axis=1), fine, np.float32(np.nan))


def _columns(diagram: xr.DataArray, size: float | None) -> tuple[Floats, str]:
    """Return the edges of the columns and the label of their axis.

    The unit is mm, µm in a window or below 1 mm, or px without a pixel size.
    """
    x = np.asarray(diagram["x"].values, np.float64)
    edges = np.append(x - 0.5, x[-1] + 0.5)
    facts = DiagramMetadata.of(diagram)
    if not facts.sheet:
        scale, unit = position_unit(size, x.size)
        return edges * scale, f"x ({unit})"
    name = "x − x(n,t)"
    if not facts.follow:
        edges, name = edges - facts.centre_px, "x − x₀"
    scale, unit = displacement_unit(size)
    return edges * scale, f"{name} ({unit})"


def _window_title(diagram: xr.DataArray) -> str:
    facts = DiagramMetadata.of(diagram)
    if not facts.sheet:
        return "Space-time diagram of the strip"
    side, n = facts.sheet.split(":")
    size, centre = facts.size_um, facts.centre_px
    x_0 = f"{centre:.1f} px" if size is None else f"{centre * size / UM_PER_MM:.2f} mm"
    return f"{side}, n = {n}" + ("" if facts.follow else f"\nx₀ = {x_0}")


# --- single sheets ------------------------------------------------------------------------------------------


def single_sheets_figure(
    strip: xr.DataArray,
    tracks: xr.Dataset,
    slips: SlipTimes = NO_SLIPS,
    *,
    pixel_size_um: float | None = None,
) -> Figure | None:
    """Return space-time diagrams around an outer and an inner sheet over a few slips; None without slips.

    The windows are 0.2 mm wide, as in the publication, or one pitch without a pixel size.
    """
    time = time_axis(tracks)[0]
    shown = slips.within(time[0], time[-1])[:SHOWN_SLIPS]
    names = _two_sheets(tracks)
    if shown.size < 2 or not names:
        return None
    half = 0.5 * float(np.median(np.diff(shown)))  # of a stick phase
    try:
        diagrams = [
            space_time(
                strip,
                around=tracks,
                sheet=name,
                pixel_size_um=pixel_size_um,
                time_s=(shown[0] - half, shown[-1] + half),
                width_um=None if pixel_size_um is None else 200.0,
                width_px=TrackMetadata.of(tracks).pitch_px if pixel_size_um is None else None,
            )
            for name in names
        ]
    except InputError:  # a sheet without positions in these frames
        return None
    sheets = " and ".join(f"n = {n} ({side})" for side, n in names)
    return replace(
        kymograph_figure(diagrams, slips=SlipTimes(shown, slips.source)),
        name="single_sheets",
        title="Space-time diagrams of single sheets",
        caption=(
            f"Intensity in a window around {sheets}, one frame below the other, over {shown.size} slips "
            f"(arrowheads at the edges, from {slips.source}). In the publication, outer sheets move more."
        ),
    )


def _two_sheets(tracks: xr.Dataset) -> list[tuple[str, int]]:
    """Return an outer and an inner sheet of the right side, or of the left if the right has none."""
    side, n = np.asarray(tracks["side"].values), np.asarray(tracks["n"].values)
    which = 1 if (side > 0).any() else -1
    found = n[np.isfinite(tracks["x_px"].values).any(axis=0) & (side == which)]
    if not found.size:
        return []
    wanted = round(0.92 * found.max()), round(0.4 * found.max())  # the publication's 23 and 10 of 25
    nearest = {int(found[np.abs(found - one).argmin()]) for one in wanted}
    return [(SIDES[which], k) for k in sorted(nearest, reverse=True)]
