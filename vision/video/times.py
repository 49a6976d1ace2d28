"""Times of frames: read from a file, and frames that are lost in gaps between them."""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pandas as pd

from vision.errors import InputError
from vision.files import check_regular, decode_text, groups_thousands, reading, some_lines
from vision.numeric import CLOCK, CLOCK_PARTS, DATE, Floats, Ints, clock_seconds
from vision.video.reader import SECONDS
from vision.video.settings import VideoSettings

_UNIT = re.compile(r"(?:^|[\s_(\[.,;/-])(s|sec|seconds|ms|us|µs|μs|ns)(?:$|[\s)\],;])", re.IGNORECASE)
_CLOCK = re.compile(rf"(?<![0-9:.])(?:{DATE}[ T,;\t]+)?({CLOCK})(?:[+-][0-9]{{2}}:?[0-9]{{2}})?(?![0-9:])")
_TIMECODE = re.compile(r"(?<![0-9:.])([0-9]{1,2}):([0-9]{2}):([0-9]{2})[:;]([0-9]{2,3})(?![0-9:;.])")
_TIMECODE_RATES = (24, 25, 30, 48, 50, 60, 100, 120)  # frames/s that timecode counts
_CLOCK_FORM = re.compile(r"[(\[][^)\]]*:[^)\]]*[)\]]")  # in a header: "(hh:mm:ss.ms)"
_TIME_NAME = re.compile(r"time|stamp|zeit|temps", re.IGNORECASE)
_NEAR = 9  # frames before and after a step between times that are compared with it


def read_timestamps(path: Path) -> tuple[Floats, tuple[str, ...]]:
    """Read the camera's times of all frames, s, from a text or CSV file, and warnings about them.

    One time per line, or columns divided by comma, semicolon, tab or space; a header names the column
    ("time", "timestamp") and its unit: `time_ms`, `Timestamp (us)`, `t [ns]`. Lines starting with # belong
    to the header. Without a name for each column the last that does not count the frames is used. Without a
    unit it is s. Times of the day, with a date or without, become seconds since midnight. Decimal commas are
    recognised where no commas separate columns, also in lines such as 0,016667, and points or commas between
    the thousands of whole numbers, as in 983, 1.000, 1.017. Timecode, hh:mm:ss:ff, counts the frames of each
    second. Times that are too coarse for the frames are spread evenly (`_spread`).

    Raises: InputError for a missing or empty file, text in place of a number, or commas of unknown meaning.
    """
    wanted = "a readable file of time stamps"
    if check_regular(path, wanted).st_size > 1 << 28:  # ten million frames
        raise InputError(path, wanted, "a far larger file", "check its name")
    with reading(path, wanted):
        data = path.read_bytes()
    lines = decode_text(path, data, wanted)[0].replace('"', "").splitlines()
    lines, warnings = _without_timecode(path, lines)
    lines = _without_thousands(_without_clocks(lines))
    end = "".join(lines[-2:])  # the last line may be cut before its separator
    separator = next((mark for mark in ";\t," if mark in end), None)
    cells = [[cell.strip() for cell in line.split(separator) if cell.strip()] for line in lines]
    decimal_comma = separator in (";", "\t")
    if separator == "," and _has_decimal_commas(path, cells):
        separator, decimal_comma, cells = None, True, [[line.strip()] for line in lines]
    rows = [_numbers(line, decimal_comma=decimal_comma) for line in cells]
    first = next((n for n, row in enumerate(rows) if row), None)
    if first is None:
        raise InputError(path, "one time per line", "no numbers", "give one time per frame, in s")
    broken = next((line for line, row in zip(lines[first:], rows[first:], strict=True) if not row), None)
    if broken is not None:
        raise InputError(path, "a number in every line", repr(broken.strip()[:40]))
    widths = {len(row) for row in rows[first:]}
    if len(widths) > 1:
        raise InputError(path, "the same number of columns in every line", f"{min(widths)} to {max(widths)}")
    values = np.array(rows[first:])
    column, unit_s = _time_column(lines[first - 1].lstrip("# ") if first else "", separator, values)
    times_s = values[:, column] * unit_s
    if not np.isfinite(times_s).all():
        raise InputError(path, "a time for every frame", "NaN or infinity")
    if (np.diff(times_s) > 0).all():
        return times_s, warnings
    if (spread_s := _spread(times_s)) is not None:
        step = float(np.diff(np.unique(times_s)).min())
        evenly = f"spread evenly, {1 / (spread_s[1] - spread_s[0]):.5g} frames/s; frames lost within a step"
        return spread_s, (*warnings, f"{path.name}: times in steps of {step:.3g} s are {evenly} are not seen")
    return times_s, (*warnings, _not_increasing(times_s, path.name))


def _without_timecode(path: Path, lines: list[str]) -> tuple[list[str], tuple[str, ...]]:
    """Return the lines with seconds in place of timecode, if most lines have it, and a warning of its rate.

    The rate is the smallest usual one above the largest number of a frame.  Raises: InputError for a film
    that is shorter than a second of the timecode, and does not show it.
    """
    found = _in_most_lines(_TIMECODE, lines)
    if found is None:
        return lines, ()
    parts = np.array([[int(part) for part in match.groups()] for match in found if match])
    rate = next((rate for rate in _TIMECODE_RATES if rate > parts[:, 3].max()), None)
    if rate is None or np.ptp(parts[:, 2]) == 0:
        raise InputError(
            path, "timecode of a second or more", "one that does not show its rate", "give `fps`"
        )
    times = _with_seconds(lines, found, parts @ np.array([3600, 60, 1, 1 / rate]))
    why = f"timecode is read at {rate} frames/s, though 30 may mean 29.97 and cameras may run faster"
    return times, (f"{path.name}: {why}: check it, or give the rate of the camera (`fps`)",)


def _spread(times_s: Floats) -> Floats | None:
    """Return even times for frames of which half or more have the time of the one before; None where that is
    not what the times show.

    The first frame of each new time is at most one frame after it, which gives the rate. All frames then have
    to be within one step of their times, as no camera's clock that lost frames for longer is.
    """
    steps = np.diff(times_s)
    first = np.flatnonzero(steps > 0) + 1
    if first.size < 3 or (steps < 0).any() or 2 * first.size > times_s.size:
        return None
    frame = np.arange(times_s.size)
    interval_s = float(np.polynomial.Polynomial.fit(first, times_s[first], 1).convert().coef[1])
    late_s = interval_s * frame - times_s
    step_s = float(steps[first - 1].min())
    if np.ptp(late_s) > step_s + 2 * interval_s:
        return None
    return np.asarray(interval_s * frame + step_s / 2 - np.median((late_s.min(), late_s.max())), np.float64)


def _without_clocks(lines: list[str]) -> list[str]:
    """Return the lines with seconds in place of times of the day, if most lines have one."""
    found = _in_most_lines(_CLOCK, lines)
    if found is None:
        return lines
    parts = pd.Series([match[1] for match in found if match]).str.extract(CLOCK_PARTS)
    others = [line if match else _CLOCK_FORM.sub("", line) for line, match in zip(lines, found, strict=True)]
    return _with_seconds(others, found, clock_seconds(parts))


def _in_most_lines(pattern: re.Pattern[str], lines: list[str]) -> list[re.Match[str] | None] | None:
    """Return where a pattern with a colon is in each line; None if it is not in most of them."""
    found = [pattern.search(line) if ":" in line else None for line in lines]
    return found if 2 * sum(map(bool, found)) > sum(bool(line.strip()) for line in lines) else None


def _with_seconds(lines: list[str], found: list[re.Match[str] | None], seconds: Floats) -> list[str]:
    """Return the lines with seconds, one for each match, in its place."""
    following = iter(seconds.tolist())
    return [
        f"{line[: match.start()]}{next(following):.6f}{line[match.end() :]}" if match else line
        for line, match in zip(lines, found, strict=True)
    ]


def _without_thousands(lines: list[str]) -> list[str]:
    """Return the lines that are not empty, whole numbers without marks between their thousands."""
    lines = [line for line in lines if line.strip()] or [""]
    cells = (re.split(r"[;\s]+", line.strip()) for line in some_lines(lines))
    columns = [*itertools.zip_longest(*cells, fillvalue="")]
    for mark in ".,":
        if any(groups_thousands(column, mark) for column in columns):
            return [re.sub(rf"(?<=[0-9])[{mark}](?=[0-9]{{3}}(?![0-9]))", "", line) for line in lines]
    return lines


def _not_increasing(times_s: Floats, name: str) -> str:
    """Return a warning about times that do not increase, and from which frame on they restart."""
    latest = np.maximum.accumulate(np.r_[-np.inf, times_s[:-1]])
    stale = np.flatnonzero(times_s <= latest)
    line = f"{name}: {stale.size} of {times_s.size} times do not increase, the first at frame {stale[0]}"
    step = np.diff(times_s)
    back = np.flatnonzero(step < -10 * np.median(np.abs(step)))
    if back.size:
        k = int(back[0]) + 1
        line += f"; they restart from frame {k} on ({times_s[k - 1]:.6g} s, then {times_s[k]:.6g} s)"
        line += f": give `frames` 0:{k} or {k}:{times_s.size}, or times that continue"
    return f"{line}; such frames are not used for the clocks and stick phases"


def _has_decimal_commas(path: Path, cells: list[list[str]]) -> bool:
    """Return whether commas in these lines are decimal marks; InputError where this cannot be told.

    They are if a whole number, as of seconds, is followed by digits with a leading zero. They separate
    columns if the header names as many, a number has a decimal point, or the first column counts the frames.
    """
    data = [line for line in cells if _numbers(line, decimal_comma=False)]
    header = next(iter(cells), []) if len(data) < len(cells) else []
    if not data or len(header) == len(data[0]) > 1:
        return False
    if not all(re.fullmatch(r"[+-]?[0-9]+", cell) for line in data for cell in line):
        return False
    zeros = any(len(cell) > 1 and cell.startswith("0") for line in data for cell in line[1:])
    if zeros and all(len(line) <= 2 for line in data):
        return True
    counted = all(int(b[0]) == int(a[0]) + 1 for a, b in itertools.pairwise(data))
    if not counted or zeros:
        advice = "write decimal points, or semicolons or tabs between the columns"
        found = f"'{','.join(data[-1])[:40]}', which may be either"
        raise InputError(path, "commas either between columns or in numbers", found, advice)
    return False


def _time_column(header: str, separator: str | None, values: Floats) -> tuple[int, float]:
    """Return which column the header names as the time, and its unit in s.

    Without a name for each column it is the last that does not count the frames.
    """
    width = values.shape[1]
    mark = next((mark for mark in (separator, *";\t,") if mark and mark in header), None)
    header = header if mark else re.sub(r"\s+(?=[(\[])", "_", header)  # "time (ms)" is one name
    names = [name.strip() for name in header.split(mark)] if width > 1 else [header]
    others = np.flatnonzero((np.diff(values, axis=0) != 1).any(axis=0))
    column = int(others[-1]) if others.size else width - 1
    if len(names) == width:
        column = next((n for n, name in enumerate(names) if _TIME_NAME.search(name)), width - 1)
    unit = _UNIT.search(names[column] if len(names) == width else header)
    return column, SECONDS[unit.group(1).lower()] if unit else 1.0


def _numbers(cells: list[str], *, decimal_comma: bool) -> list[float]:
    """Return the numbers of a line, none if a cell is no number."""
    try:
        return [float(cell.replace(",", ".") if decimal_comma else cell) for cell in cells]
    except ValueError:
        return []


def unit_warning(times_s: Floats, playback_fps: float | None, name: str) -> list[str]:
    """Warn of times that are 10³, 10⁶ or 10⁹ times as far apart as in the played film: hardly in s."""
    # The playback rate may be a little off; a wider range would doubt more time-lapse films.
    slower = float(np.median(np.diff(times_s))) * (playback_fps or 0.0) if times_s.size > 1 else 0.0
    for unit in ("ms", "us", "ns"):
        if 0.8 < slower * SECONDS[unit] < 1.25:
            return [
                f"{name}: the times, read in s, are {slower:.0f} times as far apart as when the film is "
                f"played: if they are in {unit}, name the unit in a first line (time_{unit})"
            ]
    return []


def usual_rate(times_s: Floats) -> float | None:
    """Return frames per second from the usual interval; None for fewer than two times or equal times.

    It is the mean of the intervals within a half of their median: rounded times have few distinct intervals,
    of which the median is one. Those beside lost frames are longer.
    """
    if times_s.size < 2:
        return None
    steps = np.diff(times_s)
    step = float(np.nanquantile(steps, 0.5, method="lower"))
    return 1.0 / float(steps[np.abs(steps - step) < step / 2].mean()) if step > 0 else None


# --- lost frames --------------------------------------------------------------------------------------------


def lost_between(times_s: Floats, *, settings: VideoSettings = VideoSettings()) -> tuple[int, int]:
    """Return the number of frames lost between time stamps, and the index of the frame before the first gap.

    A step of more than `settings.gap_steps` usual steps is a gap if the frames after it remain late against
    the usual rate: a frame that is merely late is followed by short steps. If the camera changes its rate,
    the usual step is that of the frames around (`_local_step_s`). If more than a fifth is lost, too few are
    counted. (0, 0) for none, or fewer than three known times (frame), NaN where unknown.
    """
    places = np.flatnonzero(np.isfinite(times_s))
    known = times_s[places]
    local_s = _local_step_s(known, places, settings)
    steps = np.diff(known) / local_s - (np.diff(places) - 1)  # frames without a time took one step each
    gaps = np.flatnonzero(steps > settings.gap_steps)
    gaps = gaps[_lasting_delay(known, places, local_s, gaps) > settings.late_steps]
    lost = int(np.round(steps[gaps] - 1).sum())
    return (lost, int(places[gaps[0]])) if lost else (0, 0)


def _local_step_s(known: Floats, places: Ints, settings: VideoSettings) -> Floats:
    """Return the usual time from one frame to the next, s, at each step between known times.

    It is that of the whole recording, or a longer time on which eight of the nine steps before or after
    agree, because a camera that changes its rate does so for many frames. NaN for fewer than three times.
    """
    usual_s = usual_step_s(known)
    step_s = np.diff(known) / np.diff(places)
    if not usual_s > 0 or not (step_s > settings.same_rate * usual_s).any():
        return np.full(step_s.shape, usual_s if usual_s > 0 else np.nan)
    padded = np.pad(step_s, _NEAR, constant_values=np.nan)
    runs = np.lib.stride_tricks.sliding_window_view(padded, _NEAR)
    middle = np.sort(runs, axis=1)[:, _NEAR // 2]  # NaN comes last
    ratio = runs / middle[:, np.newaxis]
    agree = (ratio < settings.same_rate) & (ratio > 1 / settings.same_rate)
    steady = np.where(agree.sum(axis=1) >= _NEAR - 1, middle, usual_s)
    before, after = steady[: step_s.size], steady[_NEAR + 1 :]
    return np.maximum(usual_s, np.maximum(before, after))


def thinned_from(times_s: Floats, *, settings: VideoSettings = VideoSettings()) -> int | None:
    """Return the first frame after which frames come at half or a third of the usual rate; None if none.

    Either the camera changed its rate or frames are lost evenly; their times do not show which.
    """
    places = np.flatnonzero(np.isfinite(times_s))
    known = times_s[places]
    step_s = np.minimum(_local_step_s(known, places, settings), np.diff(known) / np.diff(places))
    ratio = step_s / usual_step_s(known)
    whole = np.clip(np.round(ratio), 2, 3)
    thinned = np.flatnonzero(np.abs(ratio / whole - 1) < settings.whole_ratio)
    return int(places[thinned[0]]) if thinned.size else None


def usual_step_s(times_s: Floats) -> float:
    """Return the time from one frame to the next without losses, s; NaN for fewer than three times.

    It is the tenth percentile of the time that 20 frames take: rounded times have few distinct steps, and the
    shorter runs of 20 frames contain no lost frame.
    """
    if times_s.size < 3:
        return math.nan
    lag = min(20, max(1, times_s.size // 4))
    return float(np.quantile(times_s[lag:] - times_s[:-lag], 0.1)) / lag


def _lasting_delay(known: Floats, places: Ints, local_s: Floats, gaps: Ints) -> Floats:
    """Return the median delay of the nine frames after each gap less that of the nine before, usual steps."""

    def delay(frames: Ints) -> Floats:
        inside = np.clip(frames, 0, known.size - 1)
        here = gaps[:, np.newaxis]
        late = (known[inside] - known[here]) / local_s[here] - (places[inside] - places[here])
        return np.asarray(np.nanmedian(np.where(inside == frames, late, np.nan), axis=1), np.float64)

    reach = np.arange(_NEAR)
    return delay(gaps[:, np.newaxis] + 1 + reach) - delay(gaps[:, np.newaxis] - reach)


def are_uneven(times_s: Floats) -> bool:
    """Return whether times were measured, not computed from a rate."""
    steps = np.diff(times_s[np.isfinite(times_s)])
    return bool(steps.size and np.ptp(steps) > 1e-6 * abs(float(steps.max())))
