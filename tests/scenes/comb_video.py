"""A small video of a comb with known motion, for tests of what happens around the tracking."""

import numpy as np
import tifffile
from scipy.special import erf

SIGMA_PX = 3.0


def positions(frames=60, sheets=8, pitch_px=20.0, jump_px=4.0):
    """x (frame, sheet): inward creep and outward jump every 20 frames, mirrored about the middle."""
    n = np.arange(sheets) - (sheets - 1) / 2
    phase = (np.arange(frames) / 20) % 1
    return 20 + pitch_px * (sheets - 1) / 2 + n * pitch_px - (phase[:, None] - 0.5) * jump_px * n / n.max()


def frames_of(x_px, width_px=180, rows=12, noise=0.6, seed=0):
    """8-bit frames (frame, row, column) of Gaussian ridges integrated over the pixels."""
    edge = np.arange(width_px + 1) - 0.5
    share = erf((edge - x_px[:, :, None]) / (SIGMA_PX * np.sqrt(2)))
    profile = 40 + 120 * np.diff(share, axis=2).sum(axis=1) / 2 * SIGMA_PX * np.sqrt(2 * np.pi)
    pixels = profile[:, None, :] + np.random.default_rng(seed).normal(0, noise, (len(x_px), rows, width_px))
    return np.clip(np.rint(pixels), 0, 255).astype(np.uint8)


def write_video(path, pixels=None):
    """A TIFF stack of the default comb, or of the given frames."""
    tifffile.imwrite(path, frames_of(positions()) if pixels is None else pixels, photometric="minisblack")
    return path
