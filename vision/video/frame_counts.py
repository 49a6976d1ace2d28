"""Frames promised, delivered and lost: by number, by the file's stated length, and by gaps in its times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.video.source import Video

OK, CORRUPT, LOST, BLANK = range(4)
STATUS = np.array(["ok", "corrupt", "lost", "blank"])  # names of the codes
GAP_STEPS = 1.5  # usual steps: a longer one may hide a lost frame
_LATE_STEPS = 0.6  # the frames after a gap stay this late; jitter and rounding are made up for
_AROUND = 9  # frames on either side by which lateness is judged
_LAG = 20  # frames over which the usual step is measured: rounded times have few distinct steps
_WHOLE = 0.1  # quantile of these runs of frames that stands for one in which nothing is lost
_EARLY_STEPS = 3.5  # usual steps between the last frame and the stated end that are no cause for alarm


@dataclass(frozen=True)
class Counts:
    """Frames `expected` = `read` + `lost`; `blank` ones are among the read, `corrupt` ones among the lost.

    warnings: one line for each kind of frame that is not there.
    """

    expected: int
    read: int
    lost: int
    blank: int
    corrupt: int
    warnings: tuple[str, ...]


def count_frames(video: Video, codes: NDArray[np.int8], times_s: NDArray[np.float64]) -> Counts:
    """What was promised against what was delivered.

    Frames lost between time stamps, or before the end the file states, have no row, yet are counted.

    Args: codes, places in `STATUS` (frame); times_s, s (frame).
    """
    read = int(np.isin(codes, (OK, BLANK)).sum())
    stamped = video.clock.kind == "file" or (video.clock.kind == "given" and _uneven(times_s))
    between, first = lost_between(times_s) if stamped else (0, 0)
    beyond, late = _after_the_end(video, times_s)
    expected = max(codes.size, video.expected or 0) + between + beyond
    gaps = (
        f"{video.path.name}: {between} frame(s) lost where its times leap, the first after place {first}",
    ) * (between > 0)
    return Counts(
        expected=expected,
        read=read,
        lost=expected - read,
        blank=int((codes == BLANK).sum()),
        corrupt=int((codes == CORRUPT).sum()),
        warnings=(*_missing(video, codes), *gaps, *late),
    )


def lost_between(times_s: NDArray[np.float64]) -> tuple[int, int]:
    """Frames lost between time stamps, and the place of the frame before the first of them.

    A step over `GAP_STEPS` usual ones counts if the frames after it stay late against the usual rate: a
    frame that only came late is followed by short steps. Fails where the rate itself changes: the slower part
    then counts as if frames were lost; and counts too few where more than a fifth is lost.

    Args: times_s, s; NaN where unknown.  Returns: (0, 0) for none, or fewer than three known times.
    """
    places = np.flatnonzero(np.isfinite(times_s))
    known = times_s[places]
    usual_s = usual_step_s(known)
    if not usual_s > 0:
        return 0, 0
    steps = np.diff(known) / usual_s - (np.diff(places) - 1)  # frames without a time took theirs
    late = np.cumsum(np.concatenate([[0.0], steps - 1]))
    gaps = np.flatnonzero(steps > GAP_STEPS)
    gaps = gaps[_shift(late, gaps) > _LATE_STEPS]
    lost = int(np.round(steps[gaps] - 1).sum())
    return (lost, int(places[gaps[0]])) if lost else (0, 0)


def usual_step_s(times_s: NDArray[np.float64]) -> float:
    """Time from one frame to the next, s, where nothing is lost; NaN for fewer than three times."""
    if times_s.size < 3:
        return float("nan")
    lag = min(_LAG, max(1, times_s.size // 4))
    return float(np.quantile(times_s[lag:] - times_s[:-lag], _WHOLE)) / lag


def _shift(late: NDArray[np.float64], gaps: NDArray[np.int64]) -> NDArray[np.float64]:
    """Median lateness of the frames after each gap less that of those before it, in usual steps."""
    reach = np.arange(_AROUND)
    before = np.where(reach <= gaps[:, np.newaxis], late[np.maximum(gaps[:, np.newaxis] - reach, 0)], np.nan)
    after = gaps[:, np.newaxis] + 1 + reach
    behind = np.where(after < late.size, late[np.minimum(after, late.size - 1)], np.nan)
    return np.asarray(np.nanmedian(behind, axis=1) - np.nanmedian(before, axis=1), np.float64)


def _uneven(times_s: NDArray[np.float64]) -> bool:
    """True for times that were measured rather than counted from a rate."""
    steps = np.diff(times_s[np.isfinite(times_s)])
    return bool(steps.size and np.ptp(steps) > 1e-6 * abs(float(steps.max())))


def _missing(video: Video, codes: NDArray[np.int8]) -> list[str]:
    """One line for each kind of frame that is not there."""
    name, warnings = video.path.name, []
    if video.expected is not None and codes.size < video.expected:
        missing = video.expected - codes.size
        warnings.append(
            f"{name}: {codes.size} of {video.expected} promised frames are in the file; {missing} are missing"
        )
    for code, what in (
        (CORRUPT, "corrupt and left out"),
        (LOST, "lost by the camera"),
        (BLANK, "blank and left out"),
    ):
        which = np.flatnonzero(codes == code)
        if which.size:
            warnings.append(f"{name}: {which.size} frame(s) {what}, the first at place {which[0]}")
    return warnings


def _after_the_end(video: Video, times_s: NDArray[np.float64]) -> tuple[int, tuple[str, ...]]:
    """Frames missing, and a warning, where they stop well before the file says it ends."""
    known = times_s[np.isfinite(times_s)]
    usual_s = usual_step_s(known)
    if video.duration_s is None or not usual_s > 0:
        return 0, ()
    missing_s = video.duration_s - float(known[-1])
    if not missing_s > _EARLY_STEPS * usual_s:
        return 0, ()
    count = round(missing_s / usual_s) - 1  # the last frame itself lasts one step
    name = video.path.name
    text = f"{name}: the file should last {video.duration_s:.3f} s; its last {missing_s:.3f} s are missing"
    return count, (f"{text}, about {count} frames",)
