"""How noisy the positions are, from what the creep leaves over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.deformation.creep import Creep
from vision.deformation.frames import Bools, Doubles, Ints, StickFrames
from vision.deformation.memory import Memory, Products, find_memory
from vision.sheets.medians import nan_median

_PRIOR_DOF = 5.0  # weight of the predicted noise of a sheet against its own residuals
_LEAST_VARIANCE_PX2 = 1e-12  # of positions without noise: rounding is not to be taken for it
_ODD = 1e-6  # probability at which a stick's residuals are too large for the sheet's noise


@dataclass(frozen=True)
class Noise:
    """noise_px: standard deviation per sheet, (sheet,).  memory: its autocorrelation.  excess: factor, 1 or
    more, by which a stick's own residuals exceed it beyond chance, (stick, sheet).
    """

    noise_px: Doubles
    memory: Memory
    excess: Doubles


def measure_noise(residual: Doubles, creep: Creep, frames: StickFrames, predicted_px: Doubles) -> Noise:
    """Noise of every sheet and its memory, from the residuals to a parabola or cubic in each stick.

    The curve takes up part of slow noise; what is expected to be left under each correlation is computed
    from the frames' own pattern, so that short sticks do not make the noise look white.  Sticks that stand
    out (a sheet that slipped by itself) do not count towards the noise; their excess says how much.

    Args: residual (F, sheet), NaN where no position.  creep, the curves.  predicted_px (sheet,), the
    positions' own errors, NaN where unknown; they steady the noise of sheets seen in few frames.
    """
    terms = creep.coefficient.shape[2]
    square = frames.sums(np.where(np.isfinite(residual), residual, 0.0) ** 2)
    dof = np.where(creep.good, creep.count - terms, 0)
    typical = _typical(square, dof)
    usual = (dof > 0) & ~_odd(square, dof, typical)
    products = Products(frames, terms)
    complete = usual & (dof == products.dof[:, None])
    memory = find_memory(residual / np.sqrt(typical), complete, products)
    expected = dof * (products.left(memory) / np.maximum(products.dof, 1))[:, None]
    variance = _variance(square * usual, expected * usual, dof * usual, predicted_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where(dof > 0, square / expected / variance, 1.0)
    odd = _odd(own * dof, dof, np.ones(variance.size))
    excess = np.where(odd, np.sqrt(np.maximum(own, 1)), 1.0)
    return Noise(np.sqrt(variance), memory, excess)


def _typical(square: Doubles, dof: Ints) -> Doubles:
    """Median noise variance per sheet, as if it were white, (sheet,); the sheets' median for the rest."""
    from scipy.stats import chi2

    each = nan_median(np.where(dof > 0, square / chi2.median(np.maximum(dof, 1)), np.nan))
    overall = float(nan_median(each[None], axis=1)[0])
    return np.maximum(np.where(np.isfinite(each), each, np.nan_to_num(overall)), _LEAST_VARIANCE_PX2)


def _odd(square: Doubles, dof: Ints, variance: Doubles) -> Bools:
    """Residuals larger than chance allows, with half the degrees of freedom: memory scatters more."""
    from scipy.stats import chi2

    fewer = np.maximum(dof / 2, 1)
    return np.asarray(square / variance * fewer / np.maximum(dof, 1) > chi2.isf(_ODD, fewer))


def _variance(square: Doubles, expected: Doubles, dof: Ints, predicted_px: Doubles) -> Doubles:
    """Noise variance per sheet: its residuals, steadied by the predicted error times the common ratio."""
    measured, per_unit, weight = square.sum(axis=0), expected.sum(axis=0), dof.sum(axis=0)
    predicted = predicted_px**2
    middle = float(nan_median(predicted[None], axis=1)[0])
    shape = np.where(np.isfinite(predicted), predicted, middle if middle > 0 else 1.0)
    prior = shape * measured.sum() / max(float((per_unit * shape).sum()), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where(per_unit > 0, measured / per_unit, prior)
    steadied = (weight * own + _PRIOR_DOF * prior) / (weight + _PRIOR_DOF)
    return np.asarray(np.maximum(steadied, _LEAST_VARIANCE_PX2))
