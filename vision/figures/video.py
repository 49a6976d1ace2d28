"""The frame, its profile I(x), and what `track preview` shows."""

from __future__ import annotations

import numpy as np
import xarray as xr

from vision.data import StripMetadata, TrackMetadata
from vision.figures.decimate import grey_levels
from vision.figures.figure import Band, Figure, Image, Panel, Series
from vision.figures.labels import displacement_unit, from_zero, time_axis
from vision.figures.style import (
    DATA,
    MODEL,
    PEAK,
    QUIET,
    VALLEY,
    sheet_inks,
)
from vision.numeric import Floats, Pixels, nan_median

MOST_ROWS = 1200  # of an image
NOT_SHOWN = ("lost", "blank", "corrupt")  # frames that hold no picture
FLATTEST = 0.03  # height over width of a frame below which it is stretched, or nothing could be seen
SHOWN_SLIPS = 4  # of the space-time diagrams of single sheets, as in the publication
RIDGE_PITCHES = 0.9  # half width of the window around one ridge


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
    # The numbers stand above the strip.
    shown = min(-0.5, z0 - max(0.15 * rows, 0.02 * columns)), rows - 0.5
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
    return Figure.of(
        "frame",
        panel,
        f"{which} of the recording. The outlined rows {z0:.0f} to {z1:.0f} (half-open) are averaged to the "
        "profile I(x); vertical strokes mark the sheets that were found, with their number n counted "
        "outwards from the symmetry axis (dashed).",
        title="The frame, the strip and the numbered sheets",
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
    x = np.asarray(x_px[int(np.argmax(seen))], np.float64)  # as in the frame shown: the first with any
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


# --- profiles -----------------------------------------------------------------------------------------------


def preview_figure(
    frame: Pixels, strip: xr.DataArray, tracks: xr.Dataset, *, pixel_size_um: float | None = None
) -> Figure:
    """One frame with strip and sheets, its profile I(x) with the positions, and the noise of every position.

    Parameters
    ----------
    frame
        (rows, columns), the frame of the strip's first usable row.
    strip
        I(x, t) of a few consecutive frames, from `strip_profile`.
    tracks
        Their sheets, from `track_sheets`.
    pixel_size_um
        Gives the noise in µm; px without it.
    """
    facts = StripMetadata.of(strip)
    x = np.asarray(strip["x"].values, np.float64)
    left, right = -0.5, frame.shape[1] - 0.5
    first = int(np.argmax(np.isfinite(tracks["x_px"].values).any(axis=1)))
    profile = np.asarray(strip.values[first], np.float64)
    at = tracks["x_px"].values[first]
    curve = Panel(
        title=f"Profile I(x): mean of rows {facts.strip_z0} to {facts.strip_z1} of this frame",
        x_label="x (px)",
        y_label="grey level",
        series=(
            Series(label="I(x)", x=x, y=profile, ink=MODEL, width=0.8),
            Series.points("sheets found", at, np.interp(at, x, profile), PEAK, hollow=True),
        ),
        x_range=(left, right),
        aspect=0.2,
    )
    scale, unit = displacement_unit(pixel_size_um)
    middle = np.asarray(tracks["x_mean_px"].values, np.float64)
    predicted = nan_median(tracks["x_err_px"].values) * scale
    measured = np.asarray(tracks["x_noise_px"].values, np.float64) * scale
    noise = Panel(
        title="Noise of one position of every sheet",
        x_label="x (px)",
        y_label=f"noise of x ({unit})",
        series=(
            Series.points("scatter between frames", middle, measured, DATA),
            Series.points("stated error", middle, predicted, VALLEY, hollow=True),
        ),
        x_range=(left, right),
        y_range=from_zero(predicted, measured),
        aspect=0.2,
        placeholder="no positions",
    )
    return Figure(
        name="preview",
        title="What would be measured",
        caption=(
            f"Above: frame {int(tracks['frame'].values[first])} with the averaged rows (outlined) and the "
            "sheets' numbers. Middle: the mean of these rows with the positions found. Below: the standard "
            "error stated for one position (hollow) and the scatter from frame to frame over "
            f"{tracks.sizes['frame']} consecutive frames (filled)."
        ),
        panels=(frame_figure(frame, tracks).panel, curve, noise),
        width_in=13.0,
    )


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
    seen = np.flatnonzero(np.isfinite(x_px).any(axis=1))
    if not seen.size:
        return None
    start = frames[0] if frames and frames[0] in seen else int(seen[0])
    columns = np.asarray(strip["x"].values, np.float64)
    values = np.asarray(strip.values[start], np.float64)
    at = np.sort(x_px[start][np.isfinite(x_px[start])])
    time, label = time_axis(tracks)
    place = f"frame {time[start]:.4g}" if label == "frame" else f"t = {time[start]:.4g} s"
    panels = [
        Panel(
            title=f"Profile at {place}",
            x_label="x (px)",
            y_label="I (grey levels)",
            series=(
                Series(label="I(x)", x=columns, y=values, ink=QUIET, width=0.9),
                Series.points("x(n)", at, np.interp(at, columns, values), PEAK),
            ),
            aspect=0.35,
        )
    ]
    sheet = _ridge_sheet(tracks, frames)
    ridge = ""
    if frames and sheet is not None:
        panels.append(_ridge_panel(strip, tracks, frames, sheet))
        ridge = (
            " Right: one ridge at the beginning and at the end of a stick and after the slip; vertical lines "
            "are its positions. It moves inwards during the stick and back in the slip."
        )
    return Figure(
        name="intensity",
        title="Intensity profile and one ridge in three frames",
        caption="Intensity averaged over the strip's rows against the column, with the positions that were "
        f"found.{ridge}",
        panels=tuple(panels),
        columns=len(panels),
        width_in=13.0 if ridge else 8.0,
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
