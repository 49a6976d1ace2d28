"""The camera's movement where sheets on one side of the axis only are in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.deformation.creep import Creep
from vision.deformation.drift import TELLING, Drift
from vision.deformation.frames import Doubles, Ints, StickFrames

_NEAR = 8  # sticks before and after
_LEAST_SHEETS = 5


@dataclass(frozen=True)
class OneSide:
    """What is needed of the sheets to tell the camera's movement from their creep.

    In each stick every sheet creeps about as much as in the sticks before and after; what they do beyond, in
    equal measure, is the camera's.  What the camera does in all sticks alike is in the slow movement of the
    sheets' mean positions, carried on to the axis, where sheets move with the camera alone.

    profile_px: slopes as in the neighbouring sticks, (stick, sheet).  slow_px: slope of the camera's slow
    movement, (stick,).  near: weights of the neighbouring sticks, (stick, stick).  unknown_px: error of a
    slope from which nothing can be taken off, (stick,).
    """

    profile_px: Doubles
    slow_px: Doubles
    near: Doubles
    unknown_px: Doubles

    @classmethod
    def of(cls, line: Creep, n: Ints, frames: StickFrames, shake_px: Doubles) -> OneSide:
        """From the lines fitted to all sheets; shake_px, the vibration beyond their creep, (F,).

        What of the vibration looks like creep is taken to be as much as if it were white, if unknown.
        """
        stick = np.arange(frames.sticks)
        away = np.abs(stick[:, None] - stick)
        near = np.maximum(1 - away / (_NEAR + 1.0), 0.0)
        middle_px, slope_px = line.coefficient[..., 0], line.coefficient[..., 1]
        profile_px = _mean(near * (away > 0), slope_px)
        slow_px_s = _at_axis(_rate(near, frames.middle_s, middle_px), n, profile_px)
        shaken_px2 = float((shake_px**2).sum()) / max(shake_px.size, 1)
        white_px = np.sqrt(3 * shaken_px2 / np.maximum(frames.counts, 1))
        return cls(profile_px, slow_px_s * frames.length_s / 2, near, white_px)

    @property
    def movement(self) -> str:
        """What is taken off."""
        return "vibration taken off, and drift as far as one side tells"

    def drift(self, value: Doubles, error: Doubles, *, slow: bool) -> Drift:
        """Movement of the camera in one coefficient; 0 where sheets creep too much alike, or are too few.

        slow: whether slow movement has a part in it.
        """
        known = np.isfinite(value) & np.isfinite(self.profile_px) & np.isfinite(error)
        weight = np.where(known, 1 / np.where(known, error, 1.0) ** 2, 0.0)
        value, profile = np.where(known, value, 0.0), np.where(known, self.profile_px, 0.0)
        total = np.maximum(weight.sum(axis=1), 1e-300)
        creep, moved = ((weight * part).sum(axis=1) / total for part in (profile, value))
        away = profile - creep[:, None]
        spread = (weight * away**2).sum(axis=1)
        told = (known.sum(axis=1) >= _LEAST_SHEETS) & (spread > TELLING * known.sum(axis=1))
        spread = np.maximum(spread, 1e-300)
        beyond = np.where(told, moved - (weight * away * value).sum(axis=1) / spread * creep, 0.0)
        # In all these sticks alike it would pass for creep: as much as chance leaves in their mean.
        shared = (self.near**2 @ beyond**2) / np.maximum(self.near @ told, 1.0) ** 2
        error = np.sqrt(1 / total + creep**2 / spread + shared)
        found = beyond + (self.slow_px if slow else 0.0)
        return Drift(
            np.where(told, found, 0.0), np.where(told, error, self.unknown_px), np.zeros_like(weight)
        )


def _mean(near: Doubles, value: Doubles) -> Doubles:
    known = np.isfinite(value)
    count = near @ known
    return np.where(count > 0, near @ np.where(known, value, 0.0) / np.maximum(count, 1e-300), np.nan)


def _rate(near: Doubles, time_s: Doubles, value: Doubles) -> Doubles:
    """Slope of value (stick, sheet) against time, px/s, over the neighbouring sticks."""
    time = np.broadcast_to(time_s[:, None], value.shape)
    time = np.where(np.isfinite(value), time, np.nan)
    product, square = (
        _mean(near, time * part) - _mean(near, time) * _mean(near, part) for part in (value, time)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return product / square


def _at_axis(rate: Doubles, n: Ints, profile: Doubles) -> Doubles:
    """rate (stick, sheet) carried on to a sheet on the axis that does not creep, (stick,)."""
    known = np.isfinite(rate) & np.isfinite(profile)
    design = np.stack(
        [np.ones(rate.shape), np.broadcast_to(n - 0.5, rate.shape), np.nan_to_num(profile)], axis=-1
    )
    design = design * known[..., None]
    matrix = np.einsum("esa,esb->eab", design, design) + 1e-9 * np.eye(3)
    right = np.einsum("esa,es->ea", design, np.where(known, rate, 0.0))
    return np.linalg.solve(matrix, right[..., None])[:, 0, 0]
