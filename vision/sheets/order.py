"""Frames that do not show one moment in its turn: missing ones and those in the wrong order, before which the
sheets advance further than they creep, frames shown before, and mixtures of two, which have less noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vision.memory import in_two_threads, row_parts, some_rows
from vision.numeric import Bools, Floats, Floats32, Ints, nan_median, sigma_about_zero, spread_indices
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.signals import running_median
from vision.video.times import usual_step_s

FEWEST = 3  # sheets, less the motion that they share; and mixed frames, that scatter
SUCCESSIVE = 64  # frames of a stretch that shows mixed frames
STRETCHES = 32  # spread over a film
LONGEST = 8  # group of frames in the wrong order
AROUND = 9  # frames whose median change is usual
SWING = 4  # frames after a slip in which sheets may swing back
NOISE_ORDER = 6  # of the differences along x, which hardly contain ridges


class Advances(NamedTuple):
    """Rows of frames before which the sheets advance too far, and by how many frames' creep each."""

    rows: Ints
    frames: Floats


def out_of_turn(
    x_px: Floats, err_px: Floats, time_s: Floats, settings: TrackingSettings = DEFAULT
) -> Advances:
    r"""Return the frames before which the sheets advance further than they creep in the time between.

    x_px, err_px: positions and their errors (frame, N), NaN where missing.  time_s: (frame,), NaN where
    unknown.

    From one frame to the next the sheets move against each other by :math:`s_n`; their usual creep is the
    median :math:`v_n`. With :math:`w_n` from the errors, they advance by

    .. math:: \tau = \frac{\sum w_n v_n s_n}{\sum w_n v_n^2}

    usual frames: 1 in creep, less than 0 in a slip, and more only where frames are missing or in another
    order. A step is reported if :math:`\tau` exceeds the time between the frames, and the creep before and
    after, by `advance_least` and `advance_sigmas` standard errors, with displacements of the pattern of the
    creep. None is reported where sheets do not creep evenly (`advance_scatter`), as under vibration, and in
    the `SWING` frames after a slip, from which sheets swing back.
    """
    none = Advances(np.zeros(0, np.int64), np.zeros(0))
    rows = np.flatnonzero(np.isfinite(x_px).sum(axis=1) >= FEWEST)
    if len(rows) < AROUND:
        return none
    usual_s = usual_step_s(time_s[np.isfinite(time_s)])
    elapsed = np.fmax(np.diff(rows), np.diff(time_s[rows]) / (usual_s if usual_s > 0 else np.nan))
    some = spread_indices(len(rows) - 1, SUCCESSIVE * STRETCHES)
    step, weight = _against_each_other(x_px, err_px, rows[some], rows[some + 1])
    creep = np.nan_to_num(nan_median(np.where(weight > 0, step, np.nan) / elapsed[some, None]))
    advance, sigma, alike = np.zeros((3, len(elapsed)))

    def measure(part: slice) -> None:
        step, weight = _against_each_other(x_px, err_px, rows[:-1][part], rows[1:][part])
        usual = _less_shared(np.broadcast_to(creep, step.shape), weight)
        power = np.maximum((weight * usual**2).sum(axis=1), 1e-12)
        along = (weight * usual * step).sum(axis=1)
        advance[part], sigma[part] = along / power, power**-0.5
        alike[part] = along / np.sqrt(power * np.maximum((weight * step**2).sum(axis=1), 1e-12))

    in_two_threads(measure, row_parts(len(elapsed)))
    pace = np.pad(advance / elapsed, 1, constant_values=1.0)
    excess = advance - elapsed * np.maximum(1.0, np.maximum(pace[:-2], pace[2:]))
    scatter = float(sigma_about_zero(advance - elapsed))
    typical = float(np.median(sigma))
    if not (typical < settings.advance_clear and scatter < max(settings.advance_scatter, 1.5 * typical)):
        return none
    least = np.maximum(settings.advance_least, settings.advance_sigmas * np.maximum(sigma, scatter))
    too_far = (excess > least) & (alike > settings.advance_alike)
    found = np.flatnonzero(too_far & ~_swings_back(advance - elapsed, least))
    return Advances(rows[found + 1], advance[found])


def _swings_back(excess: Floats, least: Floats) -> Bools:
    """Return which steps follow one outwards so closely that sheets may swing back after a slip, (step,).

    A frame that shows an earlier moment also begins with a step outwards, but the next one makes up for it.
    """
    swings, total = np.zeros(len(excess), bool), np.concatenate([[0.0], np.cumsum(excess)])
    for lag in range(1, min(SWING, len(excess)) + 1):
        made_up = np.abs(total[lag + 1 :] - total[: -lag - 1]) < least[lag:]
        swings[lag:] |= (excess[:-lag] < -least[lag:]) & ~made_up
    return swings


def _against_each_other(x_px: Floats, err_px: Floats, before: Ints, after: Ints) -> tuple[Floats, Floats]:
    """Return displacements between rows less what all sheets share, 0 where unknown, and their weights."""
    step, err = x_px[after] - x_px[before], np.maximum(err_px[after], err_px[before])
    known = np.isfinite(step) & (err > 0)
    weight = np.where(known, 0.5 / np.where(known, err, 1.0) ** 2, 0.0)
    return _less_shared(np.where(known, step, 0.0), weight), weight


def _less_shared(step: Floats, weight: Floats) -> Floats:
    """Return displacements (step, N) less their weighted mean; 0 where they have no weight."""
    shared = (weight * step).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-12)
    return np.where(weight > 0, step - shared[:, None], 0.0)


def wrong_period(x_px: Floats, err_px: Floats, settings: TrackingSettings = DEFAULT) -> int:
    r"""Return in groups of how many frames a film is in the wrong order throughout; 0 if it is not.

    x_px, err_px: as for `out_of_turn`.

    Fields in the wrong order exchange all pairs of frames, and a decoder that returns pictures as they are
    stored puts each before those predicted from it. The median displacements at each place in the group are
    then whole multiples of the creep, some of them negative, whose sums reach every place once. Films are not
    seen in which a frame is lost: from there on the places are others.
    """
    for period in range(2, LONGEST + 1):
        groups = (len(x_px) - 1) // period
        if groups < FEWEST:
            break
        first = period * spread_indices(groups, SUCCESSIVE * STRETCHES)
        steps = np.stack([nan_median(x_px[first + k + 1] - x_px[first + k]) for k in range(period)])
        variance = np.pi * nan_median(err_px[first]) ** 2 / len(first)  # of such a median
        known = np.isfinite(steps).all(axis=0) & (variance > 0)
        weight = np.where(known, 1 / np.where(known, variance, 1.0), 0.0)
        steps = _less_shared(np.where(known, steps, 0.0), np.broadcast_to(weight, steps.shape))
        creep = steps[(steps**2 @ weight).argmin()]  # one step, forward or back
        creep = creep * np.sign(steps.sum(axis=0) @ (weight * creep))
        power = float(creep**2 @ weight)
        if known.sum() < FEWEST or power <= max(settings.order_clear, 8 * known.sum()):
            continue
        whole = np.rint(steps @ (weight * creep) / power)
        off = ((steps - whole[:, None] * creep) ** 2 @ weight).sum()
        if (
            whole.min() < 0
            and np.abs(whole).max() < 2 * period
            and whole.sum() == period == len(np.unique(np.cumsum(whole) % period))
            and off < settings.order_whole**2 * (steps**2 @ weight).sum()
        ):
            return period
    return 0


class Repeats(NamedTuple):
    """Rows of frames that repeat an earlier one, and which."""

    rows: Ints
    earlier: Ints


def shown_before(x_px: Floats) -> Repeats:
    """Return the frames whose positions (frame, N) all equal those of an earlier frame, but not of the last.

    Noise never repeats: the film shows that picture again.
    """
    rows = np.flatnonzero(np.isfinite(x_px).sum(axis=1) >= FEWEST)
    total = np.nansum(x_px[rows], axis=1)
    order = np.argsort(total, kind="stable")
    alike = np.flatnonzero(np.diff(total[order]) == 0)
    before, after = order[alike], order[alike + 1]
    same = after != before + 1
    same[same] = (np.nan_to_num(x_px[rows[before[same]]]) == np.nan_to_num(x_px[rows[after[same]]])).all(
        axis=1
    )
    place = np.argsort(after[same])
    return Repeats(rows[after[same]][place], rows[before[same]][place])


def mixed_frames(profile: Floats32, frozen: Bools, settings: TrackingSettings = DEFAULT) -> float:
    """Return the share of frames that are mixed from two, as a change of the frame rate may do; 0 if none.

    profile: I(x,t), (frame, x).  frozen: frames that repeat the one before, (frame,).

    The mean of two frames has half of their noise, and shares noise with the frame before: it differs from
    it by a quarter of the usual square, and its own sixth differences along x are smaller as well. Frames
    that hardly moved also differ less, but have the noise of the frames beside them. A film has mixed frames
    if the noise of those that differ less than `mixed_change` of the usual is, in the mean, smaller by
    `mixed_noise` and by `mixed_sigmas` standard errors.
    """
    rows = np.arange(len(profile))
    if len(rows) > SUCCESSIVE * STRETCHES:
        start = SUCCESSIVE * spread_indices(len(rows) // SUCCESSIVE, STRETCHES)
        rows = (start[:, None] + np.arange(SUCCESSIVE)).ravel()
    some = some_rows(profile, rows)
    some = some[np.isfinite(some[:, some.shape[1] // 2]) & ~frozen[rows]]
    if len(some) <= AROUND or some.shape[1] <= NOISE_ORDER:
        return 0.0
    power, change = np.empty(len(some)), np.empty(len(some) - 1)

    def measure(part: slice) -> None:
        before = max(0, part.start - 1)
        noise = np.diff(some[before : part.stop], NOISE_ORDER, axis=1)
        power[before : part.stop] = np.square(noise).mean(axis=1, dtype=np.float64)
        change[before : part.stop - 1] = np.square(np.diff(noise, axis=0)).mean(axis=1, dtype=np.float64)

    in_two_threads(measure, row_parts(len(some), SUCCESSIVE))
    usual = running_median(change, AROUND, ends="symmetric")
    suspect = 1 + np.flatnonzero(change[:-1] < settings.mixed_change * usual[:-1])
    if len(suspect) < FEWEST:
        return 0.0
    beside = (power[suspect - 1] + power[suspect + 1]) / 2
    less = 2 * (beside - power[suspect]) / np.maximum(usual[suspect - 1], 1e-12)
    least = settings.mixed_sigmas * less.std(ddof=1) / np.sqrt(len(less))
    mixed = less.mean() > max(settings.mixed_noise, least)
    return len(suspect) / len(some) if mixed else 0.0
