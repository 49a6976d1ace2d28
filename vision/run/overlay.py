"""The film of a run with its tracks drawn on it, as MP4."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from vision.data import StripMetadata
from vision.errors import InputError
from vision.figures.decimate import grey_limits
from vision.figures.style import HIGHLIGHT, LEFT_ON_GREY, RIGHT_ON_GREY, rgb
from vision.files import Progress
from vision.numeric import Floats, Ints, Pixels
from vision.run.reading import RunFolder
from vision.video import Video, open_video

Colour = NDArray[np.uint8]

MARGIN = 22  # px above the picture for the numbers, and below it for frame and time
LETTER_WIDTH = 9.0  # px of a digit at the size in use
_WHITE = (235, 235, 235)


def write_overlay(
    run: RunFolder, film: Path, target: Path, *, frames: slice | None = None, progress: Progress | None = None
) -> tuple[int, tuple[int, int], float]:
    """Write a film with marks at every sheet: strokes at both ends of the strip, and the number n above.

    One frame is in memory at a time. The same grey levels are black and white in all frames. Sheets left of
    the axis are blue, right ones orange; positions with a flag other than "ok" are white. Frames without a
    picture are black and show their status.

    film: as `RunFolder.input` returns it.  frames: half-open range of frame numbers; all by default.
    progress: called with (frames done, total frames or None).
    Returns: number of frames written, their shape (rows, columns), and frames per second.
    Raises: InputError if the film cannot be read, or holds none of these frames.
    """
    import av  # 30 ms that no other export needs

    tracks = run.tracks
    video = open_video(film, rotate=StripMetadata.of(tracks).rotate, frames=_within(tracks, frames, run))
    canvas = _Canvas.of(video, tracks)
    row_of = {int(number): row for row, number in enumerate(tracks["frame"].values)}
    # A high-speed film is played in slow motion, a time lapse faster than it was recorded.
    shown = float(np.clip(np.nan_to_num(StripMetadata.of(tracks).fps, nan=25.0), 5.0, 50.0))
    fps = Fraction(shown).limit_denominator(1000)
    quality = {"crf": "23", "preset": "veryfast", "maxrate": "8M", "bufsize": "16M"}
    done = 0
    with av.open(str(target), "w", format="mp4") as file:
        stream: Any = file.add_stream("libx264", rate=fps, options=quality)
        stream.height, stream.width = canvas.shape
        stream.pix_fmt = "yuv420p"
        for block in video.blocks():
            for k, status in enumerate(block.status):
                row = row_of.get(block.start + k)
                if row is None:
                    continue
                picture = canvas.draw(block.pixels[k] if status == "ok" else None, row)
                file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
                done += 1
            if progress is not None:
                progress(done, video.estimated)
        if done:
            file.mux(stream.encode(None))
    if not done:
        raise InputError(film, "frames within `frames`", "none of the run's")
    return done, canvas.shape, float(fps)


def _within(tracks: xr.Dataset, frames: slice | None, run: RunFolder) -> slice:
    """Return the frames of the run that are to be drawn.  Raises: InputError if there are none."""
    numbers = tracks["frame"].values
    first, last = int(numbers[0]), int(numbers[-1]) + 1
    start, stop = (frames.start or first, frames.stop or last) if frames else (first, last)
    part = slice(max(start, first), min(stop, last))
    if part.start >= part.stop:
        raise InputError("`frames`", f"a part of {first}:{last}, those of {run.folder}", f"{start}:{stop}")
    return part


@dataclass(frozen=True)
class _Canvas:
    """Geometry and grey levels of the frames of an overlay."""

    tracks: xr.Dataset
    x_px: Floats  # (frame, sheet)
    scale: float  # pixels of the MP4 per pixel of the film
    picture: tuple[int, int]  # rows and columns of the film in the MP4
    low: float  # grey levels that are drawn black and white
    high: float

    @classmethod
    def of(cls, video: Video, tracks: xr.Dataset) -> _Canvas:
        rows, columns = video.shape
        scale = min(1.0, 1920 / columns, 1080 / rows)  # players show no more pixels
        if max(rows, columns) < 480:  # enlarge by a whole factor, or the numbers cover the picture
            scale = float(-(-480 // max(rows, columns)))
        low, high = grey_limits(*(np.asarray(frame, np.float32) for frame in video.sample(8)))
        picture = (max(2, round(rows * scale)), max(2, round(columns * scale)))
        x_px = np.asarray(tracks["x_px"].values, np.float64)
        return cls(tracks, x_px, scale, picture, low, high)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the MP4, both even as libx264 demands."""
        height, width = self.picture
        height, width = height + 2 * MARGIN, max(width, 240)  # room for the line of text below
        return height + height % 2, width + width % 2

    def draw(self, pixels: Pixels | None, row: int) -> Colour:
        """Return a frame with all marks, RGB; `row` is its row in the tracks."""
        canvas = np.zeros((*self.shape, 3), np.uint8)
        height, width = self.picture
        flag = np.asarray(self.tracks["flag"].values[row])
        state = ""
        if pixels is None:
            state = f" {flag[0]}"
        else:
            grey = (np.asarray(pixels, np.float32) - self.low) * (255 / (self.high - self.low))
            grey = np.clip(np.nan_to_num(grey), 0, 255).astype(np.uint8)
            how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_NEAREST
            shown = cv2.resize(grey, (width, height), interpolation=how)
            canvas[MARGIN : MARGIN + height, :width] = shown[..., None]
            self._mark(canvas, row, flag)
        time_s = float(self.tracks["time_s"].values[row])
        when = f"{time_s:.4g} s  " if np.isfinite(time_s) else ""
        found = f"{(flag == 'ok').sum()} of {flag.size} sheets{state}"
        _write(canvas, f"frame {self.tracks['frame'].values[row]}  {when}{found}", 4, canvas.shape[0] - 6)
        return canvas

    def _mark(self, canvas: Colour, row: int, flag: NDArray[np.str_]) -> None:
        """Draw the edges of the strip, strokes at them, and the numbers above the picture."""
        strip = StripMetadata.of(self.tracks)
        top, bottom = self._y(strip.strip_z0 - 0.5), self._y(strip.strip_z1 - 0.5)
        for edge in (top, bottom):
            self._line(canvas, (0.0, edge), (self.picture[1] - 1.0, edge), rgb(HIGHLIGHT))
        stroke = max(3.0, (bottom - top) / 4)  # leaves the middle of the ridge visible
        side, n = self.tracks["side"].values, self.tracks["n"].values
        seen, numbered = np.flatnonzero(np.isfinite(self.x_px[row])), set(self._numbered(n))
        for k in seen:
            x = self._x(self.x_px[row, k])
            own = rgb((LEFT_ON_GREY if side[k] < 0 else RIGHT_ON_GREY)[0])
            ink = own if flag[k] == "ok" else _WHITE
            self._line(canvas, (x, top), (x, top + stroke), ink)
            self._line(canvas, (x, bottom), (x, bottom - stroke), ink)
            if k in numbered:
                text = str(n[k])
                _write(canvas, text, x - LETTER_WIDTH * len(text) / 2, MARGIN - 7, own)

    def _numbered(self, n: Ints) -> Ints:
        """Return the sheets that get a number: all, or every second, fifth, …, so that none overlap."""
        middle = np.nanmedian(self.x_px, axis=0) if self.x_px.size else np.empty(0)
        gaps = np.diff(middle[np.isfinite(middle)]) * self.scale
        room = float(np.percentile(gaps, 10)) if gaps.size else np.inf
        needed = LETTER_WIDTH * (len(str(int(n.max(initial=1)))) + 0.6)
        every = next((step for step in (1, 2, 5, 10, 20, 50) if step * room >= needed), 100)
        return np.flatnonzero(n % every == 0) if every > 1 else np.arange(n.size)

    def _x(self, x_px: float) -> float:
        """Return the column in the MP4; pixel centres are at integers in both."""
        return float((x_px + 0.5) * self.scale - 0.5)

    def _y(self, z_px: float) -> float:
        return float((z_px + 0.5) * self.scale - 0.5 + MARGIN)

    @staticmethod
    def _line(canvas: Colour, start: tuple[float, float], end: tuple[float, float], ink: Any) -> None:
        bits = 4  # fractional bits of OpenCV's coordinates: strokes are positioned to 1/16 px
        fixed = [tuple(round(v * (1 << bits)) for v in point) for point in (start, end)]
        cv2.line(canvas, fixed[0], fixed[1], ink, 1, cv2.LINE_AA, bits)


def _write(canvas: Colour, text: str, x: float, y: float, ink: tuple[int, int, int] = _WHITE) -> None:
    cv2.putText(canvas, text, (round(x), round(y)), cv2.FONT_HERSHEY_SIMPLEX, 0.42, ink, 1, cv2.LINE_AA)
