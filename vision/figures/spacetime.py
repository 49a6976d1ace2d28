"""Space-time diagrams: the strip with the tracks on it, windows around sheets, slips marked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from vision.clock import video_slips
from vision.data import TrackMetadata
from vision.errors import InputError
from vision.figures.decimate import grey_levels, time_rows
from vision.figures.figure import Figure, Image, Ink, Panel, Range, Series
from vision.figures.labels import UM_PER_MM, displacement_unit, position_unit, time_axis
from vision.figures.positions import decimated_tracks, sheet_series
from vision.figures.style import (
    LEFT_ON_GREY,
    RIGHT_ON_GREY,
)
from vision.numeric import Floats, Floats32
from vision.spacetime import space_time

MOST_ROWS = 1200  # of an image
KYMOGRAPH_CAPTION = (
    "Intensity I(x,t) averaged over the strip's rows, one frame below the other, time downwards. "
    "Pale blue: not recorded."
)
ROWS_PER_INCH = 75  # of the window around a sheet
SAMPLED = 500  # rows and columns from which the grey scale is taken
SHOWN_SLIPS = 4  # of the space-time diagrams of single sheets, as in the publication
OUTER_N, INNER_N = 23, 10  # the publication's two sheets; the nearest there are, of other samples
WINDOW_UM = 200.0


def slip_times(tracks: xr.Dataset | None, force_s: Floats | None = None) -> tuple[Floats | None, str]:
    """Times of the slips on the camera's clock, s, and what they are from.

    Parameters
    ----------
    tracks
        From `track_sheets`; None where there are none.
    force_s
        Times of the force's slips on the camera's clock, where that is known for sure.

    Returns
    -------
    The times of the force, rising, else the common outward steps of the sheets; None where neither is known:
    with an axis that was only guessed from the sheets' places, outward is not known.
    """
    if force_s is not None:
        return np.sort(force_s), "the force"
    if tracks is None:
        return None, ""
    found = TrackMetadata.of(tracks)
    if found.axis_how == "geometry" and math.isnan(found.axis_low_px):
        return None, ""
    try:
        return video_slips(tracks)["time_s"].to_numpy(float), "the sheets' common steps"
    except InputError:  # too few frames, or none with a time: nothing to mark
        return None, ""


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
    count = 0 if panel.marks is None else panel.marks.size
    marked = f" Orange ticks: {count} slips, from {slips_from}." if count else ""
    return Figure.of(
        "space_time",
        panel,
        "Intensity I(x,t) averaged over the strip's rows, one frame below the other, time downwards; the "
        "lines are the positions x(n,t), left of the symmetry axis blue, right orange."
        f"{means}{marked} kymograph.tif holds every frame.",
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
    panels = tuple(
        _diagram_panel(
            diagram,
            pixel_size_um=diagram.attrs.get("pixel_size_um", pixel_size_um),
            limits=limits,
            title=_window_title(diagram, pixel_size_um),
            marks=slips_s,
            marks_label=f"orange: slips, from {slips_from}",
            with_time=k == 0,
            aspect=height / (2.1 if windows else 12),
        )
        for k, diagram in enumerate(diagrams)
    )
    return Figure(
        name="kymograph",
        title="Space-time diagrams",
        caption=KYMOGRAPH_CAPTION,
        panels=panels,
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
    if marks is not None:
        marks = None if time_label == "frame" else marks[(marks >= edges[0]) & (marks <= edges[-1])]
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
