"""Figures that need only the video: the frame, the space-time diagram, x(n,t), noise and locking."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.report.axes import displacement_unit, position_unit, time_axis
from vision.report.chart import Band, Chart, Doubles, Ink, Picture, Series
from vision.report.decimate import grey_levels, outline, time_rows
from vision.report.style import DATA, LEFT_ON_GREY, MODEL, PEAK, RIGHT_ON_GREY, sheet_inks
from vision.sheets.medians import nan_median

if TYPE_CHECKING:
    import xarray as xr

MOST_ROWS = 1200  # of a picture in the report
MOST_POINTS = 1600  # of one sheet in the report
MOST_POSITIONS = 150_000  # of all sheets together
_BINS = 20


def frame_chart(frame: NDArray[np.generic], tracks: xr.Dataset) -> Chart:
    """One whole frame with the averaged rows outlined, the sheets' numbers n and the symmetry axis.

    Args: frame (rows, columns), any depth.  tracks, from `track_sheets`, with strip_z0 and strip_z1 in attrs.
    """
    rows, columns = frame.shape
    step = max(1, -(-rows // MOST_ROWS), -(-columns // (2 * MOST_ROWS)))
    grey = np.asarray(frame, np.float32)[::step, ::step]
    low, high = np.percentile(grey, (0.5, 99.8))
    edges = {"left": -0.5, "right": columns - 0.5, "top": -0.5, "bottom": rows - 0.5}
    z0, z1 = float(tracks.attrs["strip_z0"]), float(tracks.attrs["strip_z1"])
    return Chart(
        name="frame",
        title="The frame, the strip and the numbered sheets",
        caption=(
            f"One frame of the recording. The outlined rows {z0:.0f} to {z1:.0f} (half-open) are averaged "
            "to the profile I(x); upright strokes mark the sheets found, with their number n counted "
            "from the symmetry axis (dashed) outwards."
        ),
        x_label="x (px)",
        y_label="z (px)",
        series=_numbered_strokes(tracks, z0, z1),
        picture=Picture(pixels=grey_levels(grey, float(low), float(max(high, low + 1))), **edges),
        bands=(Band(low=z0 - 0.5, high=z1 - 0.5, label="strip", outline=True),),
        x_lines=tuple(x for x in (float(tracks.attrs["axis_px"]),) if np.isfinite(x)),
        x_range=(-0.5, columns - 0.5),
        y_range=(min(-0.5, z0 - 0.15 * rows), rows - 0.5),  # room for the numbers
        downwards=True,
        aspect=float(np.clip(rows / columns, 0.12, 0.75)),
    )


def _numbered_strokes(tracks: xr.Dataset, z0: float, z1: float) -> tuple[Series, ...]:
    """Upright strokes from row z0 to z1 at every sheet seen, with n as text; one series a side."""
    x = _first_positions(tracks)
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


def space_time_chart(strip: xr.DataArray, tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Chart:
    """I(x, t), time downwards, with the tracks on it.

    Lengths in mm (µm for less than 1 mm) where the pixel size is known, else px. Rows of the picture are
    means of the frames they stand for; the tracks keep the lowest and highest position of each stretch.
    """
    time, time_label = time_axis(strip)
    values, x = np.asarray(strip.values, np.float32), strip["x"].values
    thin = max(1, -(-values.shape[1] // (2 * MOST_ROWS)))
    rows, edges = time_rows(values[:, ::thin], time, most=MOST_ROWS)
    low, high = np.nanpercentile(rows, (0.5, 99.5))
    scale, unit = position_unit(pixel_size_um, x.size)
    left, right = float(x[0] - 0.5) * scale, float(x[-1] + 0.5) * scale
    at, shown = decimated_tracks(tracks)
    per_row = len(values) / len(rows)
    averaged = f" Each row is the mean of about {per_row:.0f} frames." if per_row > 1.5 else ""
    return Chart(
        name="space_time",
        title="Space-time diagram with the tracks",
        caption=(
            "Intensity I(x,t) averaged over the strip's rows, one frame below the other, time downwards; "
            f"the lines are the positions x(n,t).{averaged} kymograph.tif holds every frame."
        ),
        x_label=time_label,
        y_label=f"x ({unit})",
        series=sheet_series(tracks, at, shown * scale, inks=_on_grey(tracks), width=1.1),
        picture=Picture(
            pixels=grey_levels(rows, float(low), float(max(high, low + 1e-6))),
            left=left,
            right=right,
            top=float(edges[0]),
            bottom=float(edges[-1]),
        ),
        x_range=(float(edges[0]), float(edges[-1])),
        y_range=_comb_range(tracks, left, right, scale),
        upright_time=True,
        aspect=0.75,
    )


def displacement_chart(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Chart:
    """x(n, t) less each sheet's median position; in um where the pixel size is known, else px."""
    at, shown = decimated_tracks(tracks)
    scale, unit = displacement_unit(pixel_size_um)
    away = (shown - nan_median(tracks["x_px"].values)) * scale
    frames = tracks.sizes["frame"]
    fewer = (
        f" Drawn are the lowest and highest position in each of {len(at) // 2} stretches of the {frames} "
        "frames, so that no slip is lost; tracks.csv holds every frame."
        if len(at) < frames
        else ""
    )
    return Chart(
        name="displacement",
        title="x(n,t): displacement of every sheet",
        caption=(
            "Position of each sheet less its median over the recording. Left sheets are dashed and blue, "
            f"right ones solid and orange; the tone changes steadily from the centre outwards.{fewer}"
        ),
        x_label=time_axis(tracks)[1],
        y_label=f"x − median ({unit})",
        series=sheet_series(tracks, at, away, inks=sheet_inks(tracks)),
    )


def noise_chart(tracks: xr.Dataset, *, pixel_size_um: float | None = None) -> Chart:
    """Noise of every sheet's position, as measured and as predicted from the noise of the profile."""
    scale, unit = displacement_unit(pixel_size_um)
    signed, order = signed_number(tracks)
    measured = tracks["x_noise_px"].values[order] * scale
    predicted = nan_median(tracks["x_err_px"].values)[order] * scale
    return Chart(
        name="noise",
        title="Noise of the positions",
        caption=(
            "Filled: scatter of each sheet's position from frame to frame, from second differences in "
            "time, so that creep and shared vibration do not count. Hollow: standard error expected from "
            "the noise of the profile (median over the frames). Where the two disagree, something other "
            "than camera noise moves or blurs that sheet."
        ),
        x_label="side · n (left negative)",
        y_label=f"noise of x ({unit})",
        series=(
            Series(label="measured", x=signed, y=measured, ink=DATA, look="points"),
            Series(label="predicted", x=signed, y=predicted, ink=PEAK, look="points", hollow=True),
        ),
        y_range=(0.0, _top(measured, predicted)),
        whole_numbers=True,
        aspect=0.4,
    )


def locking_chart(tracks: xr.Dataset) -> Chart:
    """Histogram of x modulo one pixel: flat unless the fit locks to whole pixels.

    The band is two standard errors about 1 from the scatter between sheets, each sheet counted as one
    observation however many frames it was seen in: positions of one sheet are not independent.
    """
    x = tracks["x_px"].values
    density, error = _density_modulo_one(x)
    centre = (np.arange(_BINS) + 0.5) / _BINS
    return Chart(
        name="locking",
        title="Position modulo one pixel (locking check)",
        caption=(
            f"Density of x modulo one pixel over {np.isfinite(x).sum()} positions; 1 is an even spread. A "
            "fit that locks to whole pixels piles up near 0 and 1 and empties the middle, in all sheets "
            "alike. Band: two standard errors about 1, from the scatter between sheets; it is wide where "
            "the sheets move by less than a pixel."
        ),
        x_label="x modulo 1 px",
        y_label="density over even spread",
        series=(
            Series(label="positions", x=centre, y=density, ink=DATA, look="steps"),
            Series(label="even spread", x=centre, y=np.ones(_BINS), ink=MODEL, dashed=True),
        ),
        bands=(Band(low=max(0.0, 1 - 2 * error), high=1 + 2 * error, label="± 2 standard errors"),),
        x_range=(0.0, 1.0),
        y_range=(0.0, _top(density, np.array([1 + 2 * error]))),
        aspect=0.4,
    )


def _density_modulo_one(x_px: Doubles) -> tuple[Doubles, float]:
    """Density in each bin over an even one, and its standard error with sheets as the units.

    One error for all bins, the root mean square of theirs: without locking no bin differs from another. For
    a single sheet it is 1.
    """
    frame, sheet = np.nonzero(np.isfinite(x_px))
    place = np.minimum((x_px[frame, sheet] % 1.0 * _BINS).astype(np.int64), _BINS - 1)
    sheets = x_px.shape[1]
    counts = np.bincount(sheet * _BINS + place, minlength=sheets * _BINS).reshape(sheets, _BINS)
    seen = counts.sum(axis=1, keepdims=True)
    total, known = max(1, int(seen.sum())), int((seen > 0).sum())
    share = counts.sum(axis=0) / total
    square = ((counts - seen * share) ** 2).sum(axis=0).mean() / total**2
    error = float(np.sqrt(square * known / (known - 1))) * _BINS if known > 1 else 1.0
    return share * _BINS, error


def decimated_tracks(tracks: xr.Dataset) -> tuple[Doubles, Doubles]:
    """Time and positions (points, sheet) in px, few enough for a page."""
    each = min(MOST_POINTS, max(200, MOST_POSITIONS // max(1, tracks.sizes["sheet"])))
    return outline(time_axis(tracks)[0], tracks["x_px"].values, most=each)


def signed_number(tracks: xr.Dataset) -> tuple[Doubles, NDArray[np.int64]]:
    """side · n in rising order, and the sheets in that order."""
    signed = np.asarray(tracks["side"].values * tracks["n"].values, np.float64)
    order = np.argsort(signed, kind="stable")
    return signed[order], order


def _on_grey(tracks: xr.Dataset) -> list[Ink]:
    """One strong colour a side, which stands out from any grey."""
    return [LEFT_ON_GREY if side < 0 else RIGHT_ON_GREY for side in tracks["side"].values]


def sheet_series(
    tracks: xr.Dataset, at: Doubles, y: Doubles, *, inks: list[Ink], width: float = 1.0
) -> tuple[Series, ...]:
    """One curve a sheet, left ones dashed. at (points,); y (points, sheet), in the order of the tracks."""
    sides, numbers = tracks["side"].values, tracks["n"].values
    return tuple(
        Series(
            label=f"{'left' if side < 0 else 'right'} {n}",
            x=at,
            y=column,
            ink=ink,
            dashed=bool(side < 0),
            width=width,
            sheet=(int(side), int(n)),
        )
        for side, n, ink, column in zip(sides, numbers, inks, y.T, strict=True)
    )


def _first_positions(tracks: xr.Dataset) -> Doubles:
    """Positions in the frame that is shown: the first with any sheet."""
    seen = np.isfinite(tracks["x_px"].values).any(axis=1)
    return np.asarray(tracks["x_px"].values[int(np.argmax(seen))], np.float64)


def _comb_range(tracks: xr.Dataset, left: float, right: float, scale: float) -> tuple[float, float]:
    """What to show at first: the comb and two pitches beside it, within the picture."""
    x = tracks["x_px"].values
    if not np.isfinite(x).any():
        return left, right
    margin = 2 * float(tracks.attrs["pitch_px"])
    low, high = (np.nanmin(x) - margin) * scale, (np.nanmax(x) + margin) * scale
    return max(left, float(low)), min(right, float(high))


def _top(*values: Doubles) -> float:
    """A little above the largest value."""
    return 1.15 * float(max((np.nanmax(v) for v in values if np.isfinite(v).any()), default=1.0))
