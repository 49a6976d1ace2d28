"""Noise that is not white: its spectrum, from the sticks, and how it moves a line through a stick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from vision.force.settings import ForceSettings
from vision.numeric import Floats, Ints, nan_median

# Share of normally distributed values within one standard deviation.
_WITHIN = 0.683


@dataclass(frozen=True)
class SlowNoise:
    """Noise that is white noise plus slow noise."""

    white: float  # variance of the white part
    f: Floats  # frequencies, per sample
    slow: Floats  # variance of the slow part at each of them

    def of_line(self, length: int) -> tuple[float, float]:
        """Return the variances of the level and of half the rise of a line through so many samples."""
        mean, rise, _ = self._responses(length)
        white = self.white / length
        return white + float(mean**2 @ self.slow), 3 * white + float(rise**2 @ self.slow)

    def of_drop(self, length: float, reach: float) -> float:
        """Return the variance of the difference between two such lines, each extended towards the other.

        They meet at `reach` half lengths from the middle of either.
        """
        mean, rise, phase = self._responses(length)
        drop = 2 * (mean * np.sin(reach * phase) - reach * rise * np.cos(reach * phase))
        return (2 + 6 * reach**2) * self.white / length + float(drop**2 @ self.slow)

    def _responses(self, length: float) -> tuple[Floats, Floats, Floats]:
        """Return how level and half the rise respond to each frequency, and the phase at the line's end."""
        phase = np.pi * self.f * length
        mean = np.sin(phase) / (length * np.sin(np.pi * self.f))
        return mean, 3 * (np.sin(phase) / phase - np.cos(phase)) / phase, phase


def fit_slow_noise(
    y: Floats, start: Ints, stop: Ints, rise_N: Floats, white_N: float, settings: ForceSettings
) -> SlowNoise | None:
    """Return the noise within the sticks [start, stop) if it is not white; None if it is.

    `rise_N` is how far each stick rises, `white_N` the noise if it is white.

    White noise and one kind of slow noise are fitted to the variance of a contrast at time scales of m = 1,
    2, 4 … samples: of four neighbouring means of m samples the outer two minus the inner two, which is 0 on a
    line. What all sticks have in common there, in proportion to their rises, is their curvature, and is no
    noise; nor is a curvature of each stick's own, where white noise and the m⁴ by which that grows fit best.
    Slow noise has the spectrum of a time constant (autoregressive noise) or a power law between the frequency
    to the power -0.5 and -2 (pink noise, random walk). The best fit counts. Power laws continue to a sixth of
    the lowest frequency of the recording: between random walks about their mean, and those that begin at 0
    with the recording.
    """
    if white_N == 0:  # a load without any noise: calculated or heavily smoothed
        return None
    length = int(np.median(stop - start))
    scales = 2 ** np.arange(int(np.log2(length // 4)) + 1)
    total, bend = np.r_[0.0, np.cumsum(y - y.mean())], rise_N / (stop - start) ** 2
    found = [_contrasts(total, start, stop, bend, int(m), length) for m in scales]
    variance = np.array([np.quantile(np.abs(values), _WITHIN) ** 2 for values in found])
    variance = np.maximum(variance, 1e-3 * white_N**2 / scales)  # coarse loads do not change at short scales
    beyond = 1 + settings.alike_sigmas / np.sqrt(found[-1].size)
    if variance[-1] <= beyond * 4 * white_N**2 / scales[-1]:
        return None
    # The variance of the logarithm of such a quantile's square is 3.7 over the number of values.
    weight = np.minimum([values.size for values in found], settings.contrasts * start.size) / 3.7
    f = np.geomspace(1 / (6 * y.size), 0.5, 400)
    sine, width = np.sin(np.pi * f), 2 * np.gradient(f)
    phase = np.pi * f * scales[:, np.newaxis]
    contrast = (8 * np.sin(phase) ** 3 * np.cos(phase) / (scales[:, np.newaxis] * sine)) ** 2
    corners = 2 * np.pi * 0.5 ** np.arange(2, np.log2(y.size))
    kinds = [(power, 0.0) for power in np.arange(0.5, 2.01, 0.25)] + [(2.0, corner) for corner in corners]
    root = np.sqrt(weight)[:, np.newaxis]

    def fit(other: Floats) -> tuple[Floats, float]:
        """Return the shares of white noise and of the other part, and the misfit."""
        parts = np.stack([4 / scales, other], axis=1) / variance[:, np.newaxis]
        share, _ = scipy.optimize.nnls(parts * root, root[:, 0])
        return share, float(weight @ np.log(np.maximum(parts @ share, 1e-9)) ** 2)

    best, least = None, fit((scales / scales[-1]) ** 4.0)[1] + 4  # in doubt it is slow noise
    for power, corner in kinds:
        density = (4 * sine**2 + corner**2) ** (-power / 2)
        share, misfit = fit(contrast @ (density * width))
        misfit += 0.5 * (corner > 0)
        if misfit < least:
            least = misfit
            best = SlowNoise(float(share[0]), f, share[1] * density * width)
    return best


def _contrasts(total: Floats, start: Ints, stop: Ints, bend: Floats, m: int, length: int) -> Floats:
    """Return the contrasts of means of m samples at up to 64 places along each stick, less their medians.

    `total` holds the sums of the load up to each sample, `bend` what the contrast of a common curvature is
    proportional to.
    """
    places = np.linspace(0, 1, min(length // (4 * m), 64)) if length >= 8 * m else np.array([0.5])
    long = stop - start >= 4 * m
    first, room = start[long, np.newaxis], (stop - start)[long, np.newaxis] - 4 * m
    at = first + np.rint(places * room).astype(np.int64)
    ends = [total[at + k * m] for k in range(5)]
    values = (ends[4] - 2 * ends[3] + 2 * ends[1] - ends[0]) / m
    usual = bend[long, np.newaxis]
    return np.asarray(values - usual * nan_median(values / usual, axis=0), np.float64).ravel()
