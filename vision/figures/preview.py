"""The picture of `track preview`: the frame, the profile with its ridges, the noise of each."""

from __future__ import annotations

import numpy as np
import xarray as xr

from vision.data import StripMetadata
from vision.figures.figure import Figure, Panel, Series
from vision.figures.labels import displacement_unit
from vision.figures.style import DATA, MODEL, PEAK, VALLEY
from vision.figures.video import frame_figure
from vision.numeric import Floats, Pixels, nan_median

SMALLEST_SHARE = 1e-3  # of the largest noise, for the axis where nothing was measured


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
    height = np.interp(at, x, profile)
    whole = frame_figure(frame, tracks).panel
    curve = Panel(
        title=f"Profile I(x): mean of rows {facts.strip_z0} to {facts.strip_z1} of this frame",
        x_label="x (px)",
        y_label="grey level",
        series=(
            Series(label="I(x)", x=x, y=profile, ink=MODEL, width=0.8),
            Series(label="sheets found", x=at, y=height, ink=PEAK, look="points", hollow=True),
        ),
        x_range=(left, right),
        aspect=0.2,
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
        panels=(whole, curve, _noise_panel(tracks, (left, right), pixel_size_um)),
        width_in=13.0,
    )


def _noise_panel(tracks: xr.Dataset, x_range: tuple[float, float], pixel_size_um: float | None) -> Panel:
    scale, unit = displacement_unit(pixel_size_um)
    at = np.asarray(tracks["x_mean_px"].values, np.float64)
    predicted = nan_median(tracks["x_err_px"].values) * scale
    measured = np.asarray(tracks["x_noise_px"].values, np.float64) * scale
    return Panel(
        title="Noise of one position of every sheet",
        x_label="x (px)",
        y_label=f"noise of x ({unit})",
        series=(
            Series(label="scatter between frames", x=at, y=measured, ink=DATA, look="points"),
            Series(label="stated error", x=at, y=predicted, ink=VALLEY, look="points", hollow=True),
        ),
        x_range=x_range,
        y_range=(0.0, _top(measured, predicted)),
        aspect=0.2,
        placeholder="no positions",
    )


def _top(*values: Floats) -> float:
    known = np.concatenate([part[np.isfinite(part)] for part in values])
    return 1.1 * float(known.max()) if known.size and known.max() > 0 else SMALLEST_SHARE
