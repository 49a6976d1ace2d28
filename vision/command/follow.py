"""`track VIDEO --follow`: what is shown while a camera still writes, and how it ends."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vision.command.console import complain

if TYPE_CHECKING:
    import xarray as xr

    from vision.pipeline import Settings
    from vision.video import Follow

SHOWN_EVERY_S = 5.0
FEWEST = 20
"""Frames from which on something is shown, where more are in the file: fewer tell no noise."""
RECENT = 100
"""Frames that are tracked for the line: enough to know the noise to a tenth, few enough to be quick."""


@contextmanager
def following(settings: Settings, *, quiet: bool) -> Iterator[Follow]:
    """Follow a growing recording with a line of its state now and then; Ctrl-C ends the following.

    A second Ctrl-C, or one while the results are made, ends the run as always.
    """
    from vision.video import Follow

    follow = Follow(
        seen=None if quiet else _Shown(settings),
        waiting=None if quiet else lambda reason: complain(f"waiting: {reason}"),
    )
    earlier = signal.getsignal(signal.SIGINT)

    def end(number: int, frame: Any) -> None:
        if callable(earlier) and (follow.stop.is_set() or follow.closed.is_set()):
            earlier(number, frame)
        follow.stop.set()

    signal.signal(signal.SIGINT, end)
    try:
        yield follow
    finally:
        signal.signal(signal.SIGINT, earlier)


class _Shown:
    """Writes the state of the recording to standard error, at most every few seconds."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._next = time.monotonic()

    def __call__(self, last: Callable[[int], xr.DataArray], behind: int | None) -> None:
        if sys.stderr is None or time.monotonic() < self._next:
            return
        strip = last(RECENT)
        if behind and strip.sizes["frame"] < FEWEST:
            return
        line = state(strip, behind, self._settings)
        tty = sys.stderr.isatty()
        sys.stderr.write(f"\r\x1b[K{line}" if tty else f"{line}\n")
        sys.stderr.flush()
        self._next = time.monotonic() + SHOWN_EVERY_S


def state(strip: xr.DataArray, behind: int | None, settings: Settings) -> str:
    """How far the recording is read, and what its last frames show."""
    from vision.errors import InputError
    from vision.pipeline import track_strip
    from vision.summary import flag_counts, noise_figures

    frame, time_s = int(strip["frame"].values[-1]), float(strip["time_s"].values[-1])
    where = f"frame {frame}" + (f", {time_s:.1f} s" if time_s == time_s else "")
    late = "" if behind is None else f"; {behind} more in the file"
    try:
        # Decisions by hand are about the whole film.
        tracks = track_strip(strip, replace(settings, corrections=()))
    except InputError as error:
        return f"{where}{late}; {error}"
    flags = flag_counts(tracks)
    lost = sum(count for name, count in flags.items() if name != "ok")
    noise_px = noise_figures(tracks, None)["measured_px"]
    share = 100 * lost / max(1, sum(flags.values()))
    return (
        f"{where}{late}; {tracks.sizes['sheet']} sheets, noise {noise_px:.4f} px, {share:.1f} % not measured"
    )
