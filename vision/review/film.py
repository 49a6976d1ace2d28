"""Single frames of the film, in any order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from threading import Lock

import numpy as np

from vision.numeric import Pixels
from vision.video import Video
from vision.video.encoded import EncodedReader

AHEAD_S = 1.0
"""Up to so far ahead frames are decoded one after the other; further away the file is entered anew. Twice as
much makes jumps slower, half as much enters the file again at each longer step."""


class Film:
    """Random access to a recording.

    Parameters
    ----------
    video
        As the run read it, with its rotation.

    Notes
    -----
    Uncompressed films, stacks and single images are read in place. In a compressed one the frame is found by
    its time from the key frame before it, and playing forward goes on from the frame shown last.
    """

    def __init__(self, video: Video) -> None:
        self._video = video
        self._lock = Lock()
        self._frames: Iterator[tuple[float, Pixels]] = iter(())
        self._shown_s = np.inf
        self._ahead: tuple[float, Pixels] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) after rotation."""
        return self._video.shape

    def picture(self, number: int, time_s: float) -> Pixels | None:
        """One frame, turned as the run's were; None where it cannot be read.

        Parameters
        ----------
        number
            In the film.
        time_s
            By the camera's clock; only what the file itself stamped is used.
        """
        with self._lock:
            reader = self._video.reader
            if isinstance(reader, EncodedReader):
                rate = reader.facts.playback_fps
                stamped = reader.facts.times_in_blocks and self._video.clock.kind == "file"
                at = (
                    time_s
                    if stamped
                    else number / rate
                    if rate and not reader.facts.times_in_blocks
                    else np.nan
                )
                found = self._near(reader, at, 0.5 / (rate or 1.0)) if np.isfinite(at) else None
                if found is not None:
                    turns = -(self._video.turned_deg // 90)
                    return np.rot90(found, k=turns) if turns else found
            return self._sequential(number)

    def _sequential(self, number: int) -> Pixels | None:
        """By its number: at once in a film that is read in place, else decoded from the beginning."""
        blocks = replace(self._video, first=number, stop=number + 1).blocks()
        block = next(blocks, None)
        return None if block is None or not block.status or block.status[0] != "ok" else block.pixels[0]

    def _near(self, reader: EncodedReader, time_s: float, reach_s: float) -> Pixels | None:
        """The frame within half an interval of this time."""
        if not self._shown_s < time_s <= self._shown_s + AHEAD_S:
            self._frames, self._ahead = reader.from_key_frame(time_s), None
        while True:
            entry = self._ahead or next(self._frames, None)
            self._ahead = None
            if entry is None:
                self._shown_s = np.inf
                return None
            self._shown_s = entry[0]
            if entry[0] > time_s + reach_s:
                self._ahead = entry
                return None
            if entry[0] >= time_s - reach_s:
                return entry[1]
