"""What kind of comb this is: polarity, width, pitch and contrast of the ridges, from a few frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Polarity = Literal["bright", "dark"]

SAMPLE_FRAMES = 48
NOISE_FACTOR = 7.0  # least prominence of a ridge, in standard deviations of the smoothed noise
# And in the typical ridge's prominence: a fifth of the others' contrast passes with room to spare
FAINT_SHARE = 0.08
SMOOTHING_SHARE = 0.2  # smoothing before the search, in FWHM: hardly widens the ridge, quells the noise
# Ridges are dark where the dark stripes are narrower than the bright ones by this factor
DARK_WIDTH_RATIO = 0.9
# Surroundings a ridge must stand out from, in FWHM on either side: a Gaussian is over by then
REACH_SHARE = 1.7
WIDTH_SPREAD = 1.6  # widths within this factor of each other are one kind of ridge
ENDS_IN_VIEW = 1.3  # pitches of background beyond the outermost ridge
FWHM = 2.3548  # of a Gaussian, in standard deviations


@dataclass(frozen=True)
class Comb:
    """Facts about the ridges, found once per recording.

    polarity: bright or dark ridges.  fwhm_px, pitch_px: typical width and spacing.  contrast: typical
    prominence, grey levels.  noise: standard deviation of the profile, grey levels.  count: main ridges in a
    frame.  ends_px: room between the outermost of them and the picture's edges, the smaller of the two.
    """

    polarity: Polarity
    fwhm_px: float
    pitch_px: float
    contrast: float
    noise: float
    count: float
    ends_px: float

    @property
    def sign(self) -> int:
        """+1 for bright ridges, −1 for dark ones."""
        return 1 if self.polarity == "bright" else -1

    @property
    def smoothing_px(self) -> float:
        """Standard deviation of the Gaussian that the profile is smoothed with before ridges are searched."""
        return max(0.5, SMOOTHING_SHARE * self.fwhm_px)

    @property
    def threshold(self) -> float:
        """Least prominence of a ridge, grey levels."""
        return max(noise_floor(self.noise, self.smoothing_px), FAINT_SHARE * self.contrast)

    @property
    def reach_px(self) -> int:
        """Half-width of the surroundings a ridge must stand out from."""
        return max(4, round(REACH_SHARE * self.fwhm_px))


def noise_floor(noise: float, smoothing_px: float) -> float:
    """Prominence that noise of standard deviation `noise` does not reach after Gaussian smoothing, grey
    levels."""
    return max(1e-6, float(NOISE_FACTOR * noise / np.sqrt(2 * np.sqrt(np.pi) * max(smoothing_px, 0.3))))


def profile_noise(profile: Floats) -> float:
    """Standard deviation of the pixel noise of profiles (frame, x), grey levels.

    From sixth differences along x, which a smooth ridge hardly has: median absolute value over all
    pixels. 0 for a noise-free profile; too small where compression has smoothed the noise.
    """
    kernel = np.array([1, -6, 15, -20, 15, -6, 1], np.float64)[None, :]
    spread = cv2.filter2D(np.ascontiguousarray(profile, np.float32), cv2.CV_32F, kernel)[:, 3:-3]
    return float(np.median(np.abs(spread)) / 0.6745 / np.sqrt(924.0))


def smoothed(profile: Floats, sigma_px: float) -> Floats:
    """Profiles (frame, x) smoothed along x with a Gaussian; NaN taken as 0."""
    clean = np.nan_to_num(np.ascontiguousarray(profile, np.float32), nan=0.0)
    half = max(1, int(np.ceil(4 * sigma_px)))
    kernel = cv2.getGaussianKernel(2 * half + 1, sigma_px).reshape(1, -1)
    return np.asarray(cv2.filter2D(clean, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE), np.float32)


def describe_comb(
    profile: Floats,
    *,
    polarity: Literal["bright", "dark", "auto"] = "auto",
    sheets: int | None = None,
    source: str = "the strip",
) -> Comb:
    """Polarity, width, pitch and contrast of the ridges.

    Local extrema of lightly smoothed profiles are ranked by prominence; the strongest (`sheets` per frame
    where that number is known) are the main ridges, and their medians describe the comb. Left to itself
    the polarity is that with more ridges where both ends of the comb are in view, else that of the
    narrower stripes.

    Args: profile (frame, x), grey levels, at least one frame without NaN.  Returns: Comb.
    Raises: InputError where no structure rises above the noise.
    """
    sample = _sample(profile)
    noise = profile_noise(sample)
    names: tuple[Polarity, ...] = ("bright", "dark") if polarity == "auto" else (polarity,)
    found = [comb for name in names if (comb := _measure(sample, name, noise, sheets)) is not None]
    if not found:
        raise InputError(
            source, "upright ridges", "no ridge above the noise", "check --strip, --rotate and --ridges"
        )
    return _likelier(*found) if len(found) == 2 else found[0]


def _likelier(bright: Comb, dark: Comb) -> Comb:
    """Of two readings of the same stripes the likelier one; ties are bright.

    Where both ends of the comb are in view, that with more ridges (between N ridges there are N − 1 gaps), as
    long as dark ones are also narrower; else the one with the narrower ridges.
    """
    in_view = all(comb.ends_px > ENDS_IN_VIEW * comb.pitch_px for comb in (bright, dark))
    if in_view and bright.count != dark.count:
        return dark if dark.count > bright.count and dark.fwhm_px < bright.fwhm_px else bright
    return dark if dark.fwhm_px < DARK_WIDTH_RATIO * bright.fwhm_px else bright


def _sample(profile: Floats) -> Floats:
    """Frames spread over the recording, those with NaN left out."""
    good = np.flatnonzero(np.isfinite(profile[:, :1]).all(axis=1))
    picked = good[np.unique(np.linspace(0, len(good) - 1, SAMPLE_FRAMES).astype(int))]
    return np.ascontiguousarray(profile[picked], np.float32)


def _measure(sample: Floats, polarity: Polarity, noise: float, sheets: int | None) -> Comb | None:
    """Medians over the main ridges of this polarity; None where there are none."""
    from scipy.signal import find_peaks

    sigma = 1.0
    line = smoothed(sample if polarity == "bright" else -sample, sigma)
    walled = np.pad(line, ((0, 0), (1, 1)), constant_values=line.min())
    at, facts = find_peaks(walled.ravel(), prominence=noise_floor(noise, sigma), width=0.0, rel_height=0.5)
    prominence, frame = facts["prominences"], at // walled.shape[1]
    strong = prominence >= 0.3 * _upper(prominence)
    width, main = _commonest_width(facts["widths"], np.where(strong, prominence, 0.0), frame, sheets)
    if not main.any():
        return None
    fwhm = float(np.sqrt(max(width**2 - (FWHM * sigma) ** 2, 1.0)))
    gaps = np.diff(at[main])[np.diff(frame[main]) == 0]
    pitch = float(np.median(gaps)) if len(gaps) else float(sample.shape[1])
    x, width = at[main] % walled.shape[1], walled.shape[1]
    count = float(np.median(np.bincount(frame[main], minlength=len(sample))))
    ends = float(min(np.quantile(x, 0.01), width - 1 - np.quantile(x, 0.99)))
    return Comb(polarity, fwhm, pitch, float(np.median(prominence[main])), noise, count, ends)


def _commonest_width(
    widths: Doubles, strength: Doubles, frame: NDArray[np.int64], sheets: int | None
) -> tuple[float, NDArray[np.bool_]]:
    """Width of the kind of ridge with the most prominence in all, and which entries are of that kind.

    Narrow ones win ties (the sum is divided by the root of the width): the gap between two ridges is not a
    ridge.
    """
    tried = np.geomspace(1.5, max(2.0, float(widths.max(initial=2.0))), 40)
    kinds = (strength > 0) & (np.abs(np.log(np.maximum(widths, 0.1) / tried[:, None])) < np.log(WIDTH_SPREAD))
    if sheets:
        kinds = np.array([kind & _strongest(np.where(kind, strength, -1.0), frame, sheets) for kind in kinds])
    best = kinds[int(np.argmax((kinds * strength).sum(axis=1) / np.sqrt(tried)))]
    return (float(np.median(widths[best])) if best.any() else 0.0), best


def _upper(values: Doubles) -> float:
    return float(np.quantile(values, 0.9)) if len(values) else np.inf


def _strongest(strength: Doubles, frame: NDArray[np.int64], most: int) -> NDArray[np.bool_]:
    """Which entries are among the `most` strongest of their frame (entries are ordered by frame)."""
    order = np.lexsort((-strength, frame))
    first = np.searchsorted(frame, frame)
    kept = np.zeros(len(frame), bool)
    kept[order] = np.arange(len(frame)) - first < most
    return kept
