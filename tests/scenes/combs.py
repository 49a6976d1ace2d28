"""Strips I(x, t) drawn from known positions, by formulas of their own (nothing from vision.experiment)."""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy.special import erf

from vision.numeric import Floats, Floats32, Strings

FWHM = 2.3548  # of a Gaussian, in standard deviations
CONTRAST = 60.0  # grey levels
BACKGROUND = 40.0


def bound_px(fwhm_px: float, snr: float) -> float:
    """Cramér–Rao bound for the position of a Gaussian ridge: (1/SNR) √(2 σ_r/√π)."""
    return float(np.sqrt(2 * fwhm_px / FWHM / np.sqrt(np.pi)) / snr)


def comb(
    frames: int,
    *,
    per_side: int = 25,
    pitch_px: float = 20.0,
    axis_px: float = 600.0,
    period: float = 25.0,
    slip: float = 0.3,
    uneven: float = 0.0,
    seed: int = 1,
) -> Floats:
    """Positions (frame, 2·per_side): inwards in every stick, back in one frame.

    The outermost sheets slip by `slip` pitches, those inside by a power law that gives the stiff centre (half
    of the sheets) a fifth of it.
    """
    number = np.r_[-np.arange(per_side, 0, -1), np.arange(1, per_side + 1)]
    side, n = np.sign(number), np.abs(number)
    rng = np.random.default_rng(seed)
    rest = axis_px + side * (n - 0.5) * pitch_px + rng.uniform(-uneven, uneven, len(n)) * pitch_px
    power = np.log(5) / np.log(2)
    phase = ((np.arange(frames) / period) % 1 - 0.5) / (1 - 1 / period)  # falls by 1 in a slip
    return np.asarray(rest - side * slip * pitch_px * (n / per_side) ** power * phase[:, None])


def ridges(
    x_px: Floats,
    *,
    width: int = 1200,
    fwhm_px: float | Floats = 7.0,
    contrast: float | Floats = 1.0,
    flat_px: float = 0.0,
) -> Floats:
    """Sum of ridges of height `contrast` at x_px (frame, N), each averaged over every pixel it covers.

    A ridge is a Gaussian; with `flat_px` a box of that width with edges as soft as the Gaussian. NaN: none.
    """
    frames, sheets = x_px.shape
    sigma = np.broadcast_to(np.asarray(fwhm_px) / FWHM, (sheets,))
    height = np.broadcast_to(contrast, (frames, sheets))
    picture = np.zeros((frames, width))
    reach = int(np.ceil(5 * sigma.max() + flat_px / 2)) + 2
    for k in range(sheets):
        column = np.rint(np.nan_to_num(x_px[:, k], nan=-1e6)).astype(int)[:, None] + np.arange(
            -reach, reach + 1
        )
        light = height[:, k, None] * _ridge(column - x_px[:, k, None], sigma[k], flat_px)
        inside = (column >= 0) & (column < width) & np.isfinite(light)
        frame = np.broadcast_to(np.arange(frames)[:, None], column.shape)
        picture[frame[inside], column[inside]] += light[inside]
    return picture


def blurred(sigma: float, *, sheets: int = 20, unlike: float = 0.25, seed: int = 1) -> xr.DataArray:
    """A comb of 17 px pitch and unlike brightness on a dark background, blurred by a standard deviation of
    sigma pitches."""
    pitch_px, width = 17.0, 40 + 17 * sheets
    x = comb(30, per_side=sheets // 2, pitch_px=pitch_px, axis_px=width / 2, uneven=0.06, seed=seed)
    rng = np.random.default_rng(seed)
    height = np.clip(1 + unlike * rng.normal(size=sheets), 0.5, 1.6)
    fwhm_px = FWHM * np.hypot(sigma, 0.13) * pitch_px
    return strip(ridges(x, width=width, fwhm_px=fwhm_px, contrast=height), snr=100)


def _ridge(away: Floats, sigma: float, flat_px: float) -> Floats:
    if not flat_px:
        return (
            np.asarray(_step_up(away + 0.5, sigma) - _step_up(away - 0.5, sigma)) * sigma * np.sqrt(2 * np.pi)
        )
    # with soft edges of more than a pixel the mean over a pixel is the value at its centre
    return np.asarray(_step_up(away + flat_px / 2, sigma) - _step_up(away - flat_px / 2, sigma))


def _step_up(at: Floats, sigma: float) -> Floats:
    return np.asarray((1 + erf(at / sigma / np.sqrt(2))) / 2)


def strip(
    light: Floats,
    *,
    snr: float = 100.0,
    sign: int = 1,
    seed: int = 0,
    origin: int = 0,
    status: Strings | None = None,
) -> xr.DataArray:
    """The light as `vision.strip_profile` hands it on: grey levels (frame, x), noise CONTRAST/snr."""
    noise = np.random.default_rng(seed).normal(0, CONTRAST / snr, light.shape)
    grey = (BACKGROUND + 100.0 * (sign < 0) + sign * CONTRAST * light + noise).astype(np.float32)
    return as_strip(grey, origin=origin, status=status)


def as_strip(grey: Floats32, *, origin: int = 0, status: Strings | None = None) -> xr.DataArray:
    """Grey levels (frame, x) with the coordinates of a strip; 25 frames per second."""
    frames, width = grey.shape
    coords = {
        "frame": np.arange(frames),
        "x": np.arange(origin, origin + width),
        "time_s": ("frame", np.arange(frames) / 25.0),
        "status": ("frame", np.full(frames, "ok") if status is None else status),
    }
    return xr.DataArray(
        grey, dims=("frame", "x"), coords=coords, name="intensity", attrs={"source": "scene.avi"}
    )


def creeping(frames=120, snr=100):
    """Truth and strip of sixteen sheets that creep by 3 px."""
    x = comb(frames, per_side=8, axis_px=200) + np.linspace(0, 3, frames)[:, None]
    return x, strip(ridges(x, width=400), snr=snr)


def shaken_comb(seed: int = 5, shake: float = 0.05) -> tuple[Floats, Floats]:
    """Creeping sheets and a shaking camera, and the noise of pixels, (frame, sheet)."""
    rng = np.random.default_rng(seed)
    place = np.linspace(-1, 1, 50)
    moving = 525 + 500 * place + np.linspace(0, 3, 400)[:, None] * place**3 + rng.normal(0, shake, (400, 1))
    return moving, rng.normal(0, 0.02, moving.shape)
