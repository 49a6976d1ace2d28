r"""Angles and bending of single sheets on their way from the clamp to the interleaved part.

Vectorised over sheet number n (1 at the centre, M outermost) and separation d. Source: Plati, Restagno &
Poulard, appendix "Sheet bending".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from vision.numeric import Floats
from vision.sample import PUBLISHED, Sample


def sheet_angle_rad(n: ArrayLike, d_mm: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    r"""Angle in rad between sheet n and the pull.

    .. math:: \theta(n, d) = \arctan(n\epsilon/d)

    10.89° at n = 25, d = 13 mm; 7.91° at 18 mm.
    """
    return np.asarray(np.arctan(largest_inward_displacement_mm(n, sample=sample) / np.asarray(d_mm, float)))


def largest_inward_displacement_mm(n: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    """Bound in mm on how far sheet n can move towards the axis, n ε."""
    return np.asarray(np.asarray(n, float) * sample.thickness_mm)


def excess_length_mm(n: ArrayLike, d_mm: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    r"""How much longer the oblique path of sheet n is than the separation, in mm.

    .. math:: \sqrt{d^2 + (n\epsilon)^2} - d

    Its mean over n = 1 … 25 at d = 13 mm is 0.085 mm: sheets of one length are not equally taut.
    """
    d = np.asarray(d_mm, float)
    return np.asarray(np.hypot(d, largest_inward_displacement_mm(n, sample=sample)) - d)


def mean_excess_length_mm(d_mm: ArrayLike, *, sample: Sample = PUBLISHED) -> Floats:
    """Mean of `excess_length_mm` over the sheets of one side, in mm; the shape of `d_mm`."""
    n = np.arange(1, int(sample.sheets_per_block) + 1)
    d = np.asarray(d_mm, float)[..., np.newaxis]
    return np.asarray(excess_length_mm(n, d, sample=sample).mean(axis=-1))


def second_moment_mm4(*, sample: Sample = PUBLISHED) -> float:
    """Second moment of area of one sheet, I = ε³ W / 12, in mm⁴."""
    return sample.thickness_mm**3 * sample.width_mm / 12


def bending_force_N(
    n: ArrayLike,
    d_mm: ArrayLike,
    *,
    lever_mm: ArrayLike,
    modulus_GPa: ArrayLike,
    sample: Sample = PUBLISHED,
) -> Floats:
    r"""Force in N that bends sheet n back to the pull, applied at a distance λ (`lever_mm`) from the clamp
    end.

    .. math:: \hat N = \frac{3\,\delta\,I\,Y_p}{\lambda^3}, \qquad \delta = \lambda\,n\epsilon/d

    A cantilever fixed at the interleaving point.
    """
    lever = np.asarray(lever_mm, float)
    deflection = lever * largest_inward_displacement_mm(n, sample=sample) / np.asarray(d_mm, float)
    rigidity = 1000 * np.asarray(modulus_GPa, float) * second_moment_mm4(sample=sample)
    return np.asarray(3 * deflection * rigidity / lever**3)


def bending_length_mm(
    n: ArrayLike,
    d_mm: ArrayLike,
    *,
    n_hat_N: ArrayLike,
    modulus_GPa: ArrayLike,
    sample: Sample = PUBLISHED,
) -> Floats:
    r"""Distance λ in mm at which N̂ bends sheet n back to the pull: `bending_force_N` solved for λ.

    .. math:: \lambda = \sqrt{\frac{n W Y_p \epsilon^4}{4 d \hat N}}

    It is a number of one n and one d: always give them with it.
    """
    rigidity = 1000 * np.asarray(modulus_GPa, float) * sample.width_mm * sample.thickness_mm**4
    lever = 4 * np.asarray(d_mm, float) * np.asarray(n_hat_N, float)
    return np.asarray(np.sqrt(np.asarray(n, float) * rigidity / lever))


def bending_lengths(
    *,
    n: Sequence[float] = (15, 25),
    d_mm: Sequence[float] = (13, 18),
    modulus_GPa: Sequence[float] = (2.0, 3.8),
    n_hat_N: Sequence[float] = (0.48, 0.57, 0.77),
    sample: Sample = PUBLISHED,
) -> pd.DataFrame:
    """λ for every combination, one row each, shortest first.

    Parameters
    ----------
    n, d_mm, modulus_GPa, n_hat_N
        Values to combine; the publication's ranges by default.
    sample
        Thickness and width.

    Returns
    -------
    pandas.DataFrame
        ``n``, ``d_mm``, ``modulus_GPa``, ``n_hat_N``, ``bending_length_mm``: λ always stands beside its n and
        d.
    """
    axes = np.meshgrid(n, d_mm, modulus_GPa, n_hat_N, indexing="ij")
    sheet, d, modulus, force = (axis.ravel() for axis in axes)
    length = bending_length_mm(sheet, d, n_hat_N=force, modulus_GPa=modulus, sample=sample)
    columns = {"n": sheet, "d_mm": d, "modulus_GPa": modulus, "n_hat_N": force, "bending_length_mm": length}
    return pd.DataFrame(columns).sort_values("bending_length_mm", ignore_index=True)
