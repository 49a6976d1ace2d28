"""The recordings that a run was made from: single frames of the film, in any order, and the force."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import xarray as xr

from vision.errors import InputError
from vision.figures.decimate import grey_levels, grey_limits, minmax_decimate
from vision.numeric import Floats, Pixels
from vision.pipeline import Settings, open_force, open_recording
from vision.review.diagram import Grey
from vision.review.stored import Found
from vision.run.reading import input_of
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
                found = self._near(reader, self._time_in_file(reader, number, time_s))
                if found is not None:
                    return np.rot90(found, k=-(self._video.turned_deg // 90))
            # by its number: at once in a film that is read in place, else decoded from the beginning
            block = next(replace(self._video, first=number, stop=number + 1).blocks(), None)
            return None if block is None or not block.status or block.status[0] != "ok" else block.pixels[0]

    def _time_in_file(self, reader: EncodedReader, number: int, time_s: float) -> float:
        """By the file's own stamps, or its rate; NaN where neither tells the frame's place."""
        if reader.facts.times_in_blocks:
            return time_s if self._video.clock.kind == "file" else np.nan
        return number / reader.facts.playback_fps if reader.facts.playback_fps else np.nan

    def _near(self, reader: EncodedReader, time_s: float) -> Pixels | None:
        """The frame within half an interval of this time; None for a time that is not known."""
        if np.isnan(time_s):
            return None
        reach_s = 0.5 / (reader.facts.playback_fps or 1.0)
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


class Recordings:
    """Film and force of a run, each opened at the first need.

    Parameters
    ----------
    found
        The run.
    settings
        As it was made with.
    moved
        Where the film lies now, if not where it was when it was tracked.
    """

    def __init__(self, found: Found, settings: Settings, moved: Path | None) -> None:
        self.found, self.settings, self.moved = found, settings, moved
        self._lock = Lock()
        self._film: Film | InputError | None = None
        self._force: xr.Dataset | None = None
        self._grey: tuple[float, float] | None = None

    def film(self) -> Film:
        """Raises: InputError where it is gone or another one."""
        with self._lock:
            if self._film is None:
                try:
                    path = input_of(self.found.folder, self._input(0), self.moved)
                    self._film = Film(open_recording(path, self.settings))
                except InputError as error:
                    self._film = error
            if isinstance(self._film, InputError):
                raise InputError("the film", "the one that was tracked", str(self._film))
            return self._film

    def _input(self, place: int) -> Mapping[str, Any]:
        """The film's entry among run.json's inputs (0), or the force recording's (-1)."""
        inputs = self.found.facts.get("inputs") or []
        force = self.found.parameters.get("force")
        if not inputs or (place and (force is None or not force.value)):
            raise InputError(self.found.folder, "a film and a force recording", "none in its run.json")
        return dict(inputs[place])

    def picture(self, frame: int, time_s: float) -> Grey:
        """One frame in 8 bits, by the same black and white throughout."""
        pixels = self.film().picture(frame, time_s)
        if pixels is None:
            raise InputError("the frame", "one that can be read", f"{frame}, which cannot")
        values = np.asarray(pixels, np.float32)
        if self._grey is None:
            self._grey = grey_limits(values)
        return grey_levels(values, *self._grey)

    def force(self, first_s: float, stop_s: float, points: int) -> Floats:
        """(rows, 3): seconds of the force clock, load, separation; extremes where there are more rows than
        points.  Raises: InputError where there is none."""
        with self._lock:
            if self._force is None:
                path = input_of(self.found.folder, self._input(-1))
                self._force = open_force(path, self.settings)[["load_N", "d_mm"]]
        time_s = self._force["time_s"].to_numpy()
        a, b = np.searchsorted(time_s, [first_s, stop_s])
        values = np.column_stack([self._force[name].to_numpy()[a:b] for name in ("load_N", "d_mm")])
        at, low_high = minmax_decimate(time_s[a:b], values, most=points)
        return np.column_stack([at, low_high])
