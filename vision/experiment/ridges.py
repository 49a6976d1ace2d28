"""The light of ridges, integrated over cells of a line: never sampled at a point.

A ridge is known by the integral of its shape from minus infinity, so the light in any cell is a
difference of two values and is exact. Every shape has its centroid at zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vision.experiment.randomness import stream

if TYPE_CHECKING:
    from vision.experiment.settings import Experiment, Optics, RidgeShape

Array = NDArray[np.float64]

_FWHM_PER_SIGMA = 2.3548200450309493
_REACH_FWHM = 2.6
"""Half width of the window in which a ridge is drawn; a Gaussian has 5e-10 of its light outside."""
_SHOULDER = 0.22
"""Share of the light in the shoulder, and in units of the FWHM how far it stands from the main ridge."""
_SHOULDER_AT_FWHM = 0.85


@dataclass(frozen=True, kw_only=True)
class Looks:
    """What each sheet's ridge looks like: width, height (fraction of saturation, negative if dark),
    shoulder side."""

    shape: RidgeShape
    fwhm_px: Array
    height: Array
    psf_px: float
    shoulder_side: Array


def ridge_looks(experiment: Experiment) -> Looks:
    """Unequal neighbours: widths, heights and shoulder sides drawn sheet by sheet."""
    optics, count = experiment.optics, experiment.sheets.count
    rng = stream(experiment.seed, "looks")
    width = optics.fwhm_px * np.exp(optics.fwhm_spread * np.clip(rng.standard_normal(count), -2, 2))
    unequal = np.exp(optics.contrast_spread * np.clip(rng.standard_normal(count), -2, 2))
    shoulder = np.where(rng.uniform(size=count) < 0.5, -1.0, 1.0)
    height = ridge_height(optics) * unequal
    height[rng.permutation(count)[: optics.faint_sheets]] *= 0.2
    return Looks(
        shape=optics.shape, fwhm_px=width, height=height, psf_px=optics.psf_px, shoulder_side=shoulder
    )


def ridge_height(optics: Optics) -> float:
    """Height of a ridge of Michelson contrast c over a gap of brightness b.

    Bright 2 b c / (1 - c), dark -2 b c / (1 + c).
    """
    sign = 1 if optics.polarity == "bright" else -1
    return sign * 2 * optics.level * optics.contrast / (1 - sign * optics.contrast)


def reach_px(looks: Looks) -> float:
    """Distance from its centre beyond which a ridge has no light."""
    return float(_REACH_FWHM * np.max(looks.fwhm_px) + 6 * looks.psf_px + 2)


def light_up_to(u: Array, looks: Looks) -> Array:
    """Light of each ridge between minus infinity and u px from its centre, in height x px; u is (...,
    sheet, cell)."""
    fwhm, side = looks.fwhm_px[:, None], looks.shoulder_side[:, None]
    if looks.shape == "flat":
        return np.asarray(_flat(u, fwhm, looks.psf_px) * looks.height[:, None])
    sigma = np.hypot(fwhm / _FWHM_PER_SIGMA, looks.psf_px)
    area = (fwhm / _FWHM_PER_SIGMA * np.sqrt(2 * np.pi)) * looks.height[:, None]
    if looks.shape == "gaussian":
        return np.asarray(area * _normal(u / sigma))
    apart = _SHOULDER_AT_FWHM * fwhm * side
    main = _normal((u + _SHOULDER * apart) / sigma)
    bump = _normal((u - (1 - _SHOULDER) * apart) / (0.9 * sigma))
    return np.asarray(area * ((1 - _SHOULDER) * main + _SHOULDER * bump))


def _normal(v: Array) -> Array:
    from scipy.special import ndtr

    return np.asarray(ndtr(v))


def _flat(u: Array, fwhm: Array, psf_px: float) -> Array:
    """A box of the full width, its edges softened: the integral of a difference of two normal integrals."""
    soft = np.hypot(fwhm / 10, psf_px)

    def double_integral(v: Array) -> Array:
        return np.asarray(v * _normal(v) + np.exp(-(v**2) / 2) / np.sqrt(2 * np.pi))

    return np.asarray(
        soft * (double_integral((u + fwhm / 2) / soft) - double_integral((u - fwhm / 2) / soft))
    )


def light_per_cell(
    positions_px: Array, brightness: Array, looks: Looks, *, start_px: float, per_px: int, cells: int
) -> Array:
    """Light of all ridges in each cell of a line, (frame, cell), in height x px.

    Cells are 1/per_px wide; the first begins at start_px. brightness (frame, sheet) multiplies the heights.
    Ridges beyond the line are cut off at its ends.
    """
    frames = len(positions_px)
    half = int(np.ceil(reach_px(looks) * per_px))
    first = np.floor((positions_px - start_px) * per_px).astype(np.int64) - half
    edge = first[..., None] + np.arange(2 * half + 2)
    up_to = light_up_to(edge / per_px + start_px - positions_px[..., None], looks)
    light = np.diff(up_to, axis=-1) * brightness[..., None]
    cell = edge[..., :-1]
    outside = (cell < 0) | (cell >= cells)
    flat = cell + np.arange(frames)[:, None, None] * cells
    flat[outside] = frames * cells
    total = np.bincount(flat.ravel(), weights=light.ravel(), minlength=frames * cells + 1)
    return np.asarray(total[: frames * cells].reshape(frames, cells))
