"""From where a sheet is to where the camera sees it: tilt, bowed sheets, lens distortion. Fixed in time.

A point at x on the middle row is seen on row z at x + s(x, z), with
s = tan(tilt) zeta + bow(x) (zeta / half height)^2 + distortion; zeta is the row counted from the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vision.experiment.motion import Comb
    from vision.experiment.settings import Experiment

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """The fixed map from sheet coordinates to pixels."""

    width: int
    height: int
    tilt: float
    bow_px: float
    axis_px: float
    half_comb_px: float
    distortion: float

    @property
    def straight(self) -> bool:
        """True where every row shows the same."""
        return self.tilt == 0 and self.bow_px == 0 and self.distortion == 0

    def shift_px(self, x_px: Array, zeta_px: Array, zeta2_px2: Array | None = None) -> Array:
        """s(x, z) in px. Polynomial in zeta, so means of zeta and zeta^2 over rows give the mean shift."""
        z2 = zeta_px**2 if zeta2_px2 is None else zeta2_px2
        out = np.clip((x_px - self.axis_px) / self.half_comb_px, -1.5, 1.5)
        bowed = -self.bow_px * out * np.abs(out) * z2 / (self.height / 2) ** 2
        off = x_px - (self.width - 1) / 2
        corner2 = (self.width / 2) ** 2 + (self.height / 2) ** 2
        lens = self.distortion * off * (off**2 + z2) / corner2
        return np.asarray(self.tilt * zeta_px + bowed + lens)

    def source_px(self, x_px: Array, zeta_px: Array) -> Array:
        """The inverse: which x is seen at pixel coordinate x_px of a row."""
        source = np.broadcast_to(x_px, np.broadcast_shapes(x_px.shape, zeta_px.shape)).astype(float)
        for _ in range(12):  # contracts by the local stretch, a few per cent at most
            source = x_px - self.shift_px(source, zeta_px)
        return source


def camera_geometry(experiment: Experiment, comb: Comb) -> Geometry:
    """Geometry of an experiment; the bow is that of the outermost sheet over the frame's height."""
    optics, camera = experiment.optics, experiment.camera
    return Geometry(
        width=camera.width,
        height=camera.height,
        tilt=float(np.tan(np.radians(optics.tilt_deg))),
        bow_px=experiment.sheets.bow_px,
        axis_px=comb.axis_px,
        half_comb_px=float(np.max(np.abs(comb.rest_px - comb.axis_px))) or 1.0,
        distortion=optics.distortion,
    )


def strip_slice(experiment: Experiment) -> slice:
    """The default strip: the middle `strip_rows` rows, or every row of a lower frame."""
    rows = min(experiment.camera.strip_rows, experiment.camera.height)
    first = (experiment.camera.height - rows) // 2
    return slice(first, first + rows)


def rows_from_middle(height: int) -> Array:
    """zeta of every row."""
    return np.arange(height, dtype=float) - (height - 1) / 2


def row_light(experiment: Experiment) -> Array:
    """Relative light of every row: half the gradient that runs along x."""
    camera, gradient = experiment.camera, experiment.optics.gradient
    return 1 + gradient / 2 * rows_from_middle(camera.height) / camera.height


def column_light(experiment: Experiment) -> Array:
    """Relative light of every column."""
    width = experiment.camera.width
    return 1 + experiment.optics.gradient * (np.arange(width, dtype=float) - (width - 1) / 2) / width


def seen_px(x_px: Array, geometry: Geometry, experiment: Experiment) -> Array:
    """Where the strip's mean sees a sheet: its shift averaged over the strip's rows, weighted with their
    light."""
    rows = strip_slice(experiment)
    zeta, weight = rows_from_middle(geometry.height)[rows], row_light(experiment)[rows]
    first, second = np.average(zeta, weights=weight), np.average(zeta**2, weights=weight)
    return np.asarray(x_px + geometry.shift_px(x_px, np.asarray(first), np.asarray(second)))
