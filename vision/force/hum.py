"""Mains hum over a load: narrow lines of its spectrum, which are no stick-slip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vision.force.lines import fit_lines
from vision.force.settings import ForceSettings
from vision.force.slips import Slips, stick_middles
from vision.numeric import Floats, peak_offset
from vision.signals import running_mean, running_median

_LONGEST_PART = 1 << 14  # samples of one spectrum: finer lines than mains keep to within minutes
_LEAST_SPECTRA = 8
_LEAST_PART = 256
_AROUND = 24  # frequencies on either side of a line that it is compared with
_LEAST_PERIODS = 30  # in one spectrum: below, a line is not told from the slope of the spectrum
_MOST_PERIODS = 6  # of which one amplitude is measured
_MOST_LINES = 4  # mains and three of its harmonics
_TOGETHER = 10  # slips within which hum and slips keep their phase, if they do
_FEWEST = 8  # slips whose phases tell hum from harmonics
_IN_PHASE = 0.7  # mean resultant length of ten phases: 0.28 by chance, near 1 for harmonics of regular slips


class Hum(NamedTuple):
    """One narrow line of a load's spectrum."""

    frequency: float  # per sample
    wave: Floats  # its course, at every sample

    @property
    def rms(self) -> float:
        """Root mean square of the wave."""
        return float(np.std(self.wave))


def rms_of(hum: Sequence[Hum]) -> float:
    """Return the root mean square of all waves together; 0 for none."""
    return float(np.linalg.norm([line.rms for line in hum]))


def find_hum(y: Floats, settings: ForceSettings) -> list[Hum]:
    """Return the narrow lines of a load's spectrum, the strongest first; regular stick-slip also has some.

    The spectra of the load's steps over overlapping parts of the recording are averaged. A line exceeds the
    median of the frequencies around it by `hum_ratio`. Its amplitude and phase may change within 30 periods.
    """
    part = min(1 << int(np.log2(max(y.size / _LEAST_SPECTRA, 2))), _LONGEST_PART)
    if part < _LEAST_PART:
        return []
    parts = sliding_window_view(np.diff(y), part)[:: part // 2]
    power, taper = np.zeros(part // 2 + 1), np.hanning(part)
    for values in parts:  # one at a time: all would take as much memory as the recording, several times
        power += np.abs(np.fft.rfft(taper * values)) ** 2
    around = np.median(sliding_window_view(np.pad(power, _AROUND, "reflect"), 2 * _AROUND + 1), axis=1)
    excess = power / np.maximum(around, np.finfo(float).tiny)
    excess[:_LEAST_PERIODS] = excess[-4:] = 0
    found: list[Hum] = []
    while len(found) < _MOST_LINES and excess.max() > settings.hum_ratio:
        k = int(np.argmax(excess))
        frequency = float(k + peak_offset(*np.log(power[k - 1 : k + 2]))) / part
        found.append(Hum(frequency, _wave(y - sum(hum.wave for hum in found), frequency)))
        excess[k - 4 : k + 5] = 0
    return found


def _wave(y: Floats, frequency: float) -> Floats:
    """Return the part of a signal that oscillates at a frequency (per sample).

    Its amplitudes over single periods, or a few that are nearly a whole number of samples, are known; those
    at slips are wrong, and a running median over 30 periods leaves them out.
    """
    samples = np.arange(1, _MOST_PERIODS + 1) / frequency  # in one period, in two …
    off = np.abs(np.rint(samples) / samples - 1)
    together = 1 + int(np.argmax(off <= max(0.02, off.min())))
    size = round(together / frequency)
    turn = np.exp(-2j * np.pi * frequency * np.arange(y.size))
    seen = (y - running_mean(y, size)) * turn
    count = y.size // size
    amplitude = seen[: count * size].reshape(count, size).mean(axis=1)
    several = min(2 * (_LEAST_PERIODS // (2 * together)) + 1, count)
    middle = (np.arange(count) + 0.5) * size - 0.5
    real, imaginary = (
        np.interp(np.arange(y.size), middle, running_median(part, several, ends="symmetric"))
        for part in (amplitude.real, amplitude.imag)
    )
    return np.asarray(2 * np.real((real + 1j * imaginary) * turn.conj()), np.float64)


def is_hum(hum: Hum, y: Floats, slips: Slips, settings: ForceSettings) -> bool:
    """Tell hum from regular stick-slip, whose harmonics are narrow lines too.

    Hum is faster than the slips, which come at any phase of it, and the load within the sticks is straighter
    without it. `slips` are those of the load without the hum; three of its periods must lie between them.
    The phases of fewer than `_FEWEST` tell nothing: regular stick-slip without its harmonic retains a few.
    """
    if slips.edge.size < _FEWEST or slips.period * hum.frequency < 3:
        return False
    turn = np.exp(-2j * np.pi * hum.frequency * slips.edge)
    groups = np.array_split(turn, turn.size // _TOGETHER + 1)
    if np.mean([abs(group.mean()) for group in groups]) > _IN_PHASE:
        return False
    x, sticks = np.arange(y.size, dtype=float), stick_middles(slips.edge, y.size, settings)
    with_it, without = (np.nansum(fit_lines(x, load, *sticks).squares) for load in (y, y - hum.wave))
    return bool(with_it - without > 0.5 * hum.rms**2 * np.sum(sticks[1] - sticks[0]))
