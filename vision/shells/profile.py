"""The profile of the ratio on one side: isotonic regression, and its breakpoint."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
import xarray as xr

from vision.numeric import Bools, Floats

LEAST_ERROR = 1e-9

_LEAST_FOR_KNEE = 5  # known sheets


@dataclass(frozen=True)
class Side:
    """One side of the assembly from the centre outwards: n (N,), the rest (event, N), NaN where unknown.

    value: the ratio, negative where the sheet seems to move outwards, but not significantly.  length_err:
    relative error of the stick length, (event,), which all sheets share.
    """

    side: int
    n: Floats
    value: Floats
    error: Floats
    length_err: Floats

    @classmethod
    def of(cls, motion: xr.Dataset, side: int) -> Side:
        """The sheets of one side, -1 or +1, of a Dataset of `horizontal_deformation`."""
        number = motion["n"].to_numpy()
        place = np.flatnonzero(motion["side"].to_numpy() == side)
        place = place[np.argsort(number[place])]
        signed, ratio, error = (
            motion[name].to_numpy()[:, place] for name in ("ratio_signed", "ratio", "ratio_err")
        )
        value = np.where(motion["flag"].to_numpy()[:, place] == "outward", ratio, signed)
        return cls(
            int(side), number[place].astype(float), value, np.maximum(error, LEAST_ERROR), _length_err(motion)
        )

    @property
    def known(self) -> Bools:
        """Where there is a ratio with an error, (event, N)."""
        return np.isfinite(self.value) & np.isfinite(self.error)

    def without(self, sheets: Bools) -> Side:
        """The same with these sheets (event, N) unknown."""
        return replace(self, value=np.where(sheets, np.nan, self.value))


def isotonic(side: Side, significance: float) -> tuple[Floats, Bools]:
    """The ratio as a rising function of n at every sheet, (event, N), and whether the data allow one,
    (event,).

    Steps of the isotonic regression (weights 1/error²) joined by straight lines between their middles; NaN
    without any known sheet. A rising function is rejected where χ² is less probable than `significance`.
    """
    rising = np.full(side.value.shape, np.nan)
    misfit = np.zeros(len(rising))
    for event, known in enumerate(side.known):
        if not known.any():
            continue
        value, weight, n = side.value[event, known], side.error[event, known] ** -2, side.n[known]
        fit = scipy.optimize.isotonic_regression(value, weights=weight)
        first = fit.blocks[:-1]
        middle = np.add.reduceat(n, first) / np.diff(fit.blocks)
        rising[event] = np.interp(side.n, middle, fit.x[first])
        misfit[event] = np.sum(weight * (value - fit.x) ** 2)
    return rising, misfit <= scipy.special.chdtri(np.maximum(side.known.sum(axis=1), 1), significance)


def breakpoint_n(side: Side, significance: float) -> Floats:
    """Where a flat inner part and a straight rise meet best, in n, (event,): all knees tried at once.

    NaN where the rise is not significant, or with fewer than five known sheets.
    """
    knee = np.arange(side.n[0], side.n[-1] - 1, 0.5)
    if knee.size == 0:
        return np.full(len(side.value), np.nan)
    weight = np.where(side.known, side.error**-2.0, 0.0)
    value = np.where(side.known, side.value, 0.0)
    ramp = np.maximum(side.n - knee[:, None], 0.0)
    total = weight.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = value - (weight * value).sum(axis=1, keepdims=True) / total
        middle = weight @ ramp.T / total
        along = (weight * value) @ ramp.T
        slope = along / (weight @ (ramp**2).T - total * middle**2)
    gain = np.nan_to_num(np.where(slope > 0, slope * along, 0.0))
    sure = gain.max(axis=1) > scipy.special.chdtri(2, significance)
    enough = side.known.sum(axis=1) >= _LEAST_FOR_KNEE
    return np.asarray(np.where(sure & enough, knee[gain.argmax(axis=1)], np.nan))


def _length_err(motion: xr.Dataset) -> Floats:
    """Relative error of the stick length, (event,): the part of ratio_err beyond the error of σ_x.

    Read from the sheet with the largest ratio, where it shows best.
    """
    ratio = np.nan_to_num(motion["ratio"].to_numpy())
    own = motion["sigma_x_err_um"].to_numpy() / motion["stick_length_um"].to_numpy()[:, None]
    beyond = np.sqrt(np.maximum(motion["ratio_err"].to_numpy() ** 2 - own**2, 0))
    most = ratio.argmax(axis=1, keepdims=True)
    ratio, beyond = (np.take_along_axis(part, most, axis=1)[:, 0] for part in (ratio, beyond))
    share = np.divide(beyond, ratio, out=np.zeros_like(ratio), where=ratio > 0)
    return np.asarray(np.nan_to_num(share))
