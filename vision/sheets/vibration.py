"""Vibration of single sheets, each at a frequency of its own: motion, and no error of positions."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vision.numeric import NORMAL_MEDIAN, Bools, Floats, median_size, nan_median, row_parts
from vision.sheets.settings import DEFAULT, TrackingSettings

BLOCK = 256  # frames over which a vibration keeps its frequency and phase
LEAST_BLOCK = 48  # frames that show a line in a spectrum
LINES = 4  # removed from one sheet in a round at most
PADDED = 4  # frequencies per independent one
BESIDE = 15  # independent frequencies on either side that show the level of the spectrum
ROUNDS = 3  # each knows the common motion of vibrating sheets better than the one before
TINY = np.finfo(float).tiny
JUMP = 5.0  # robust standard deviations of a sheet's steps above which a step is left out as a slip


def own_vibration(x_px: Floats, settings: TrackingSettings = DEFAULT) -> Floats:
    r"""Return how far each sheet is displaced by vibration of its own, px, (frame, N); 0 where there is none.

    x_px: positions (frame, N), NaN where missing.

    Steps from frame to frame, without the median of all sheets, are searched for spectral lines in blocks of
    some `BLOCK` frames. A line is vibration of the sheet if its power exceeds that of the frequencies beside
    and a share of all, and if sheets do not share it in phase: with :math:`C_m` the amplitudes of all sheets
    at that frequency, :math:`|\sum_m C_m^2| / \max_m |C_m|^2` counts sheets that move in phase or in
    antiphase, as lamps that flicker and cameras that nod move sheets that lean. A line in the steps at the
    angular frequency :math:`\omega` with amplitude C is one in the positions with
    :math:`C / (e^{i\omega} - 1)`. The strongest line is fitted and subtracted, up to `LINES` times; all of it
    is done in `ROUNDS` rounds.
    """
    frames, sheets = x_px.shape
    found = np.zeros_like(x_px)
    if sheets < 3 or frames < LEAST_BLOCK:
        return found
    blocks = np.array_split(np.arange(frames), max(1, round(frames / BLOCK)))
    for _ in range(ROUNDS):
        step = np.empty((frames - 1, sheets))
        for some in row_parts(frames - 1):
            around = slice(some.start, some.stop + 1)
            step[some] = np.diff(x_px[around] - found[around], axis=0)
        step -= nan_median(step, axis=1)[:, None]
        step -= nan_median(step)
        for moved, usual in zip(step.T, median_size(step), strict=True):
            moved[np.abs(moved) > JUMP * usual / NORMAL_MEDIAN] = np.nan
        more = [
            _of_block(step[rows[0] : rows[-1]], (found[rows] != 0).any(axis=0), settings) for rows in blocks
        ]
        for rows, part in zip(blocks, more, strict=True):
            found[rows] += part
        blocks = [rows for rows, part in zip(blocks, more, strict=True) if part.any()]
    return found


def _of_block(step: Floats, vibrates: Bools, settings: TrackingSettings) -> Floats:
    """Return the same for the frames of one block, from the steps between them, (frame − 1, N).

    vibrates: sheets that are known to, (N,). Of these, further lines may be of any share.
    """
    known = np.isfinite(step)
    rest = np.where(known, step, 0.0)
    frames, sheets = rest.shape
    found, time = np.zeros((frames + 1, sheets)), np.arange(frames + 1)[:, None]
    searched = known.sum(axis=0) >= LEAST_BLOCK / 2
    for _ in range(LINES):
        sheet = np.flatnonzero(searched)
        if not len(sheet):
            break
        frequency, ratio = _strongest_line(rest[:, sheet])
        turning = np.exp(-2j * np.pi * frequency * time)
        line = rest.T @ turning[:-1]  # (N, lines)
        in_phase = np.abs((line**2).sum(axis=0)) / np.maximum((np.abs(line) ** 2).max(axis=0), TINY)
        strength = 2 * np.abs(line[sheet, np.arange(len(sheet))]) ** 2 / known[:, sheet].sum(axis=0)
        own = (ratio > settings.vibration_ratio) & (in_phase < settings.vibration_in_phase)
        own &= vibrates[sheet] | (strength > settings.vibration_share * (rest[:, sheet] ** 2).sum(axis=0))
        vibrates[sheet[own]] = True
        searched[sheet[~own]] = False
        sheet, turning = sheet[own], turning[:, own]
        # the complex amplitude of which the real wave leaves the least squares
        wave = np.where(known[:, sheet], turning[:-1], 0.0)
        power, square = (np.abs(wave) ** 2).sum(axis=0), (wave**2).sum(axis=0)
        shared = (rest[:, sheet] * wave).sum(axis=0)
        amplitude = 2 * (power * shared.conj() - square.conj() * shared) / (power**2 - np.abs(square) ** 2)
        rest[:, sheet] -= np.where(known[:, sheet], (amplitude * turning[:-1]).real, 0.0)
        found[:, sheet] += (amplitude * turning / (turning[1] - 1)).real
    return found


def _strongest_line(values: Floats) -> tuple[Floats, Floats]:
    """Return the frequency per frame of the strongest line of each sheet, and its power over the median of
    those beside, (N,)."""
    frames = len(values)
    tapered = values * np.hanning(frames)[:, None]
    power = np.abs(np.fft.rfft(tapered, PADDED * frames, axis=0)) ** 2
    independent = np.pad(power[::PADDED], ((BESIDE, BESIDE), (0, 0)), mode="reflect")
    level = nan_median(sliding_window_view(independent, 2 * BESIDE + 1, axis=0), axis=-1)
    level = np.repeat(level, PADDED, axis=0)[: len(power)]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(power[: len(level)] / level)
    ratio[:PADDED] = ratio[-PADDED:] = 0.0  # no sine and cosine can be told apart there
    best, sheet = np.argmax(ratio, axis=0), np.arange(values.shape[1])
    near = np.clip(best + np.array([[-1], [0], [1]]), 1, len(power) - 1)
    low, middle, high = np.log(np.maximum(power[near, sheet], TINY))
    bend = low - 2 * middle + high
    shift = np.where(bend < 0, 0.5 * (low - high) / np.where(bend < 0, bend, -1.0), 0.0)
    return (best + np.clip(shift, -0.5, 0.5)) / (PADDED * frames), ratio[best, sheet]
