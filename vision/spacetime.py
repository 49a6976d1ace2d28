"""space_time(): I(x, t) of the strip or of a window that is fixed or follows a sheet, and its pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vision.data import SIDES, TRACKS, DiagramMetadata, check_strip, record
from vision.errors import InputError, shown
from vision.memory import give_back, in_two_threads, row_parts, some_rows
from vision.numeric import Bools, Floats, Floats32, Ints

Sheet = tuple[str, int] | int  # ("right", 23), or the index counted from the left

_ROWS_AT_ONCE = 16  # of a picture: the frames of more do not fit into a core's cache


def space_time(
    strip: xr.DataArray,
    *,
    around: xr.Dataset | None = None,
    sheet: Sheet | None = None,
    width_um: float | None = None,
    width_px: float | None = None,
    pixel_size_um: float | None = None,
    follow: bool = False,
    frames: slice | None = None,
    time_s: tuple[float | None, float | None] | None = None,
) -> xr.DataArray:
    """Return a space-time diagram: one row per frame, one column per pixel, no resampling in time.

    A fixed window contains the original grey values. It is centred, to the nearest pixel, on the sheet's
    median position over the frames shown (as in the publication's figure). A window that follows the sheet
    has it at x = 0 in every row: rows are shifted by fractions of a pixel with the Catmull-Rom cubic. If the
    sheet is not found in some frames, its position is interpolated linearly between the others.

    Parameters
    ----------
    strip
        I(x, t) from `vision.strip_profile`.
    around, sheet
        Tracks from `vision.track_sheets`, and the sheet in the centre of the window: ("right", 23) or the
        index from the left. Without both, the whole strip is returned.
    width_um, width_px
        Width of the window; give one of them. It is rounded to whole pixels.
    pixel_size_um
        µm per pixel; needed for `width_um`.
    follow
        Whether the window follows the sheet.
    frames
        Half-open range of frame numbers.
    time_s
        Half-open range of seconds, None for an open end.

    Returns
    -------
    xarray.DataArray
        float32 "intensity" (frame, x) in grey levels with the strip's coordinates; a view for the whole
        strip. x is the column number or, if the window follows the sheet, the distance from it in px. Values
        are NaN outside the picture and in lost frames. x_sheet_px (frame) is the measured position of the
        sheet, NaN if unknown. `vision.data.DiagramMetadata` describes the window.

    Raises
    ------
    InputError
        For a sheet, a time or a width that the recording does not have.
    """
    check_strip(strip)
    part = _part(strip, frames, time_s)
    facts = DiagramMetadata(pixel_size_um=math.nan if pixel_size_um is None else pixel_size_um)
    given: dict[str, Any] = {
        "sheet": sheet,
        "width_um": width_um,
        "width_px": width_px,
        "pixel_size_um": pixel_size_um,
        "follow": follow,
        "frames": None if frames is None else [frames.start, frames.stop],
        "time_s": time_s,
    }
    if around is None or sheet is None:
        # An incomplete description of a window is an error, not a request for the whole strip.
        if sheet is not None:
            raise InputError("`sheet`", "tracks to find the sheet in", "none", "give `around`")
        if around is not None or width_um is not None or width_px is not None or follow:
            advice = 'give `sheet`, such as ("right", 1)'
            raise InputError("the window", "a sheet to centre it on", "none", advice)
        return record(part.assign_attrs(facts.attrs()), "space_time", **given)
    TRACKS.check(around)
    index, name, x_px = _find(around, sheet, part)
    width = _width(width_um, width_px, pixel_size_um, part)
    centre = float(np.nanmedian(x_px))
    values, x = _following(part, x_px, width) if follow else _fixed(part, centre, width)
    diagram = part.isel(x=slice(0, 1)).drop_vars("x").squeeze("x")  # only the coordinates along time
    facts = replace(facts, sheet=name, sheet_index=index, centre_px=centre, follow=follow)
    diagram = (
        diagram.expand_dims(x=x, axis=1)
        .copy(data=values)
        .assign_coords(x_sheet_px=("frame", x_px, {"units": "px", "long_name": "the sheet"}))
        .assign_attrs(facts.attrs())
    )
    return record(diagram, "space_time", **given)


def _part(
    strip: xr.DataArray, frames: slice | None, time_s: tuple[float | None, float | None] | None
) -> xr.DataArray:
    """Return the requested frames as a view."""
    numbers, times = np.asarray(strip["frame"].values), np.asarray(strip["time_s"].values, np.float64)
    keep, asked, clock = np.ones(numbers.size, bool), [], bool(np.isfinite(times).any())
    if frames is not None:
        keep &= _within(numbers, frames.start, frames.stop)
        asked.append(f"frames {frames.start}:{frames.stop}")
    if time_s is not None:
        if not clock:
            raise InputError("`time_s`", "frames with times", "a recording without a clock", "give `fps`")
        keep &= _within(times, *time_s)
        asked.append(f"time {time_s[0]}:{time_s[1]} s")
    found = np.flatnonzero(keep)
    if not found.size:
        there = f"frames {numbers[0]} to {numbers[-1]}"
        there += f" ({np.nanmin(times):.6g} to {np.nanmax(times):.6g} s)" if clock else ""
        raise InputError("space-time diagram", f"a part of {there}", " and ".join(asked))
    return strip.isel(frame=slice(int(found[0]), int(found[-1]) + 1))


def _within(values: NDArray[Any], start: float | None, stop: float | None) -> Bools:
    low, high = -np.inf if start is None else start, np.inf if stop is None else stop
    return np.asarray((values >= low) & (values < high))


def _find(tracks: xr.Dataset, sheet: Sheet, part: xr.DataArray) -> tuple[int, str, Floats]:
    """Return index and name of the requested sheet, and its positions in the frames of the part, px."""
    side, n = np.asarray(tracks["side"].values), np.asarray(tracks["n"].values)
    names = [f"{SIDES[which]}:{number}" for which, number in zip(side.tolist(), n.tolist(), strict=True)]
    known = names if isinstance(sheet, tuple) else [f"index {k}" for k in range(n.size)]
    asked = f"{sheet[0]}:{sheet[1]}" if isinstance(sheet, tuple) else f"index {sheet}"
    if isinstance(sheet, str):
        raise InputError("`sheet`", "a side and a number such as ('right', 23), or an index", shown(sheet))
    if asked not in known:
        raise InputError("`sheet`", f"one of {_sheets_there(side, n)}", asked)
    index = known.index(asked)
    if not np.isin(part["frame"].values, tracks["frame"].values).all():
        raise InputError("the tracks", "positions for every frame of the strip", "fewer frames")
    x = np.asarray(tracks["x_px"].isel(sheet=index).sel(frame=part["frame"].values).values, np.float64)
    if not np.isfinite(x).any():
        raise InputError(f"sheet {names[index]}", "a position in at least one frame shown", "none")
    return index, names[index], x


def _sheets_there(side: NDArray[Any], n: NDArray[Any]) -> str:
    parts = [
        f"{name}:{n[side == sign].min()} to {name}:{n[side == sign].max()}"
        for sign, name in SIDES.items()
        if (side == sign).any()
    ]
    return ", ".join([*parts, f"index 0 to {n.size - 1}"])


def _width(
    width_um: float | None, width_px: float | None, pixel_size_um: float | None, part: xr.DataArray
) -> int:
    """Return the width in whole pixels, from 1 to the width of the strip."""
    if (width_um is None) == (width_px is None):
        found = "neither" if width_um is None else "both"
        raise InputError("the width", "one of `width_um` and `width_px`", found)
    if width_um is not None:
        if pixel_size_um is None:
            raise InputError("`width_um`", "a pixel size to turn µm into px", "none", "give `pixel_size_um`")
        width_px = width_um / pixel_size_um
    most = part.sizes["x"]
    if not (width_px is not None and 0.5 <= width_px <= most):
        raise InputError("the width", f"1 to {most} px, the strip's width", f"{width_px:.6g} px")
    return round(width_px)


def _fixed(part: xr.DataArray, centre_px: float, width: int) -> tuple[Floats32, Ints]:
    """Return a window of whole columns and their numbers; NaN beyond the picture's edge."""
    first = round(centre_px - (width - 1) / 2)
    origin, columns = int(part["x"].values[0]), part.sizes["x"]
    low, high = max(first, origin), min(first + width, origin + columns)
    values = np.full((part.sizes["frame"], width), np.nan, np.float32)
    values[:, low - first : high - first] = part.values[:, low - origin : high - origin]
    return values, np.arange(first, first + width)


def _following(part: xr.DataArray, x_px: Floats, width: int) -> tuple[Floats32, Floats]:
    """Return rows shifted so that the sheet is at x = 0, and the distances x from it."""
    known = np.flatnonzero(np.isfinite(x_px))
    centre = np.interp(np.arange(x_px.size), known, x_px[known]) - float(part["x"].values[0])
    offset = np.arange(width, dtype=np.float64) - (width - 1) / 2
    return _cubic(part.values, centre[:, None] + offset), offset


def _cubic(rows: Floats32, at: Floats) -> Floats32:
    """Interpolate rows (k, columns) at positions between their pixels (k, w) with the Catmull-Rom cubic.

    Values are NaN beyond the outermost pixel centres; the outermost pixels are repeated for the cubic.
    Source: Keys 1981, with a = −1/2.
    """
    last = rows.shape[1] - 1
    left = np.floor(at).astype(np.int64)
    f = at - left
    weights = (
        ((2 - f) * f - 1) * f / 2,
        ((3 * f - 5) * f * f + 2) / 2,
        ((4 - 3 * f) * f + 1) * f / 2,
        (f - 1) * f * f / 2,
    )
    taps = (np.take_along_axis(rows, np.clip(left + k, 0, last), axis=1) for k in (-1, 0, 1, 2))
    total = sum((weight * tap for weight, tap in zip(weights, taps, strict=True)), np.zeros(at.shape))
    return np.asarray(np.where((at >= 0) & (at <= last), total, np.nan), np.float32)


# --- pictures -----------------------------------------------------------------------------------------------


def time_rows(values: NDArray[np.floating], time: Floats, *, most: int) -> tuple[Floats32, Floats]:
    """Return rows of an image at equal steps of time, each the mean of its frames.

    values: (frames, columns), NaN in lost frames, read in parts.  time: (frames,), rising.  most: largest
    number of rows; there are no more than frames in the recording's duration.

    Returns the rows (k, columns) and their k + 1 edges in time. A single row without a frame, as frame times
    may jitter, repeats the row before; rows in longer gaps are NaN.
    """
    steps = np.diff(time)
    step = float(np.median(steps)) if steps.size else 0.0
    span = float(time[-1] - time[0])
    count = min(most, 1 + round(span / step)) if step > 0 else min(most, len(time))
    half = step / 2 or 0.5
    edges = np.linspace(time[0] - half, time[-1] + half, count + 1)
    ends = np.searchsorted(time, edges)
    has_frame = np.diff(ends) > 0
    rows = np.full((count, values.shape[1]), np.nan, np.float32)

    def average(some: slice) -> None:
        part = ends[some.start : some.stop + 1]
        filled = np.flatnonzero(np.diff(part) > 0)
        if filled.size:
            rows[some.start + filled] = _means(values[part[0] : part[-1]], part[filled] - part[0])
            give_back(values[part[0] : part[-1]])

    in_two_threads(average, row_parts(count, _ROWS_AT_ONCE))
    single = np.flatnonzero(~has_frame[1:-1] & has_frame[:-2] & has_frame[2:]) + 1
    rows[single] = rows[single - 1]
    return rows, edges


def _means(values: NDArray[np.floating], starts: NDArray[np.integer[Any]]) -> Floats:
    """Return means of the known values from each start to the next start or the end."""
    total = np.add.reduceat(values, starts, axis=0, dtype=np.float64)
    if np.isfinite(total).all():  # as in most films
        return np.asarray(total / np.diff(np.append(starts, len(values)))[:, None])
    known = np.isfinite(values)
    total = np.add.reduceat(np.where(known, values, 0), starts, axis=0, dtype=np.float64)
    count = np.add.reduceat(known, starts, axis=0, dtype=np.int32)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def grey_limits(*pictures: NDArray[np.floating]) -> tuple[float, float]:
    """Return the grey levels that are drawn black and white in every picture (rows, columns).

    These are the quantiles at 0.2 and 99.8 %. The extremes would be those of a few dead pixels or
    reflections; with 0.5 and 99.5 % narrow ridges, bright or dark, would be cut off. About 500 rows and
    columns are used; NaN is ignored.
    """
    steps = [[max(1, size // 500) for size in picture.shape] for picture in pictures]
    samples = [
        some_rows(picture, np.arange(0, len(picture), down))[:, ::across]
        for picture, (down, across) in zip(pictures, steps, strict=True)
    ]
    known = np.concatenate([np.empty(0), *(part[np.isfinite(part)] for part in samples)])
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (0.2, 99.8))
    return float(low), float(max(high, low + 1e-6))


def grey_levels(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint8]:
    """Convert values to 8-bit grey, black at `low` and white at `high`; NaN becomes mid-grey."""
    grey = np.subtract(values, low, dtype=np.float32)
    grey *= 255 / max(high - low, 1e-9)
    grey[np.isnan(grey)] = 127.5
    np.clip(grey, 0, 255, out=grey)  # in place, in a seventh of the time
    return np.asarray(np.rint(grey, out=grey), np.uint8)
