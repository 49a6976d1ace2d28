"""Ratios σ_x/Λ_st with known shells, measured on made tracks or given perfectly, for tests of shells."""

import numpy as np

from tests.scenes.creeping import PIXEL_UM, Clock, make, profile
from vision.deformation import horizontal_deformation


def scores(shells, truth):
    """Shares of the sizes within one sheet, and of the intervals that hold the truth."""
    inside = (shells["stiff_low"] <= truth) & (truth <= shells["stiff_high"])
    return np.mean(np.abs(shells["stiff_sheets"].astype(float) - truth) <= 1), inside.mean()


def measured(ratio, **options):
    made = make(ratio, **options)
    return made, horizontal_deformation(made.tracks, made.sticks, Clock(), pixel_size_um=PIXEL_UM)


def stage(stick_um, frames, m_eff, *, noise_px, rho=0.0, events=60):
    between = np.random.default_rng(1).uniform(*m_eff, events)
    return measured(profile(between), stick_um=stick_um, frames=frames, noise_px=noise_px, rho=rho, seed=3)


def true_sizes(made):
    """Stiff sheets, one figure per event and side, in the table's order."""
    return np.repeat((made.ratio < 0.1).sum(axis=1) // 2, 2)


def ideal(ratio, error):
    """What `horizontal_deformation` would return for ratios (event, n) on the right, measured perfectly."""
    made = make(np.full(ratio.shape, 0.2), frames=8, noise_px=0.02)
    right = made.tracks.isel(sheet=slice(ratio.shape[1], None))
    motion = horizontal_deformation(right, made.sticks, Clock(), pixel_size_um=PIXEL_UM)
    where, error = ("event", "sheet"), np.broadcast_to(error, ratio.shape)
    sigma_um = error * motion["stick_length_um"].to_numpy()[:, None]
    return motion.assign(
        ratio=(where, ratio),
        ratio_signed=(where, ratio),
        ratio_err=(where, error),
        sigma_x_err_um=(where, sigma_um),
    )
