"""Films encoded again as the recording was: its codec, its quantiser, as much noise as fills its bits.

A codec that carries content from frame to frame shifts ridges in ways that its own residuals do not show: it
holds a sheet still while it creeps. A film with known truth that goes through the same codec shows it.
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import numpy as np

from vision.errors import InputError
from vision.numeric import Floats, Floats32, Pixels
from vision.video import open_video
from vision.video.encoded import open_container
from vision.video.strip import row_means

ENCODERS = {"h264": "libx264"}
"""Codecs whose quantiser can be read, and what writes them."""
NOISES = (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0)
"""Standard deviations of the noise of pixels, grey levels, that are tried."""
TRIED_FRAMES = 60
MOST_PIXELS = 60_000_000  # of a film made to find the noise: larger frames are cut to fewer rows


@dataclass(frozen=True)
class Encoder:
    """How a recording was encoded, and the picture on which films like it are drawn.

    Parameters
    ----------
    codec
        As FFmpeg names what writes it.
    quantiser
        Median of the frames' quantisers.
    keyframes
        Frames from keyframe to keyframe; 0 where there is one only.
    bits_per_pixel
        Mean over the recording.
    picture
        One frame (rows, columns), grey levels, turned as the run turned it.
    rows, columns
        Of the strip in it, half-open.
    noise_grey
        Standard deviation of the pixels' noise before encoding.
    """

    codec: str
    quantiser: int
    keyframes: int
    bits_per_pixel: float
    picture: Floats
    rows: tuple[int, int]
    columns: tuple[int, int]
    noise_grey: float = 0.0

    @property
    def described(self) -> str:
        """In words, for the certificate."""
        return (
            f"{self.codec} at the recording's quantiser {self.quantiser}, with pixel noise of "
            f"{self.noise_grey:g} grey levels, for which a film takes the recording's "
            f"{self.bits_per_pixel:.2g} bits per pixel"
        )

    @property
    def width(self) -> int:
        """Columns of the strip: one less than the run's where that is odd at the picture's edge."""
        return self.columns[1] - self.columns[0]

    def again(self, profile: Floats32, *, seed: int) -> Floats32:
        """I(x, t) (frame, x) drawn on all rows, encoded, decoded, and averaged over the strip's rows."""
        with tempfile.TemporaryDirectory(prefix="sheetvision-") as folder:
            path = Path(folder) / "again.mp4"
            self._write(path, profile, seed)
            film = open_video(path)
            rows, columns = slice(*self.rows), slice(*self.columns)
            return np.concatenate([row_means(block.pixels) for block in film.blocks(rows, columns)])

    def with_noise(self, profile: Floats32) -> Encoder:
        """With the noise for which a part of this film takes as many bits as the recording did."""
        part, best = profile[:TRIED_FRAMES], (np.inf, 0.0)
        for noise in NOISES:
            tried = replace(self, noise_grey=noise)
            with tempfile.TemporaryDirectory(prefix="sheetvision-") as folder:
                path = Path(folder) / "again.mp4"
                tried._write(path, part, seed=0)
                bits = 8 * path.stat().st_size / (len(part) * self.picture.size)
            best = min(best, (abs(np.log(bits / self.bits_per_pixel)), noise))
            if bits > 1.5 * self.bits_per_pixel:
                break
        return replace(self, noise_grey=best[1])

    def _frames(self, profile: Floats32, seed: int) -> Iterator[Pixels]:
        rng = np.random.default_rng(seed)
        (top, bottom), (left, right) = self.rows, self.columns
        own = self.picture[top:bottom, left:right].mean(axis=0)
        for line in profile:
            frame = np.array(self.picture)
            frame[:, left:right] += line - own
            frame += self.noise_grey * rng.standard_normal(frame.shape)
            yield np.clip(np.rint(frame), 0, 255).astype(np.uint8)

    def _write(self, path: Path, profile: Floats32, seed: int) -> None:
        height, width = self.picture.shape
        options = {"crf": str(self.quantiser), "preset": "medium", "threads": "1"}
        if self.keyframes:
            options["g"] = str(self.keyframes)
        with av.open(str(path), "w") as out:
            stream = out.add_stream(self.codec, rate=25, options=options)
            assert isinstance(stream, av.VideoStream)
            stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
            stream.codec_context.time_base = Fraction(1, 25)
            colourless = np.full(
                (height // 2, width), 128, np.uint8
            )  # both planes of colour, one after the other
            for n, grey in enumerate(self._frames(profile, seed)):
                # the plane of brightness as it is: no change of range
                frame = av.VideoFrame.from_ndarray(np.concatenate([grey, colourless]), format="yuv420p")
                frame.pts, frame.time_base = n, Fraction(1, 25)
                out.mux(stream.encode(frame))
            out.mux(stream.encode(None))


def read_encoder(
    path: Path, rows: tuple[int, int], columns: tuple[int, int], *, rotate: int = 0, frames: int = 600
) -> Encoder | None:
    """How a recording was encoded; None where that cannot be read, or nothing here encodes like it.

    Parameters
    ----------
    path
        The recording.
    rows, columns
        Of the strip, half-open.
    rotate
        Degrees clockwise by which the run turned frames.
    frames
        Frames of it that are looked at.
    """
    try:
        with open_container(path) as film:
            stream = film.streams.video[0]
            codec = ENCODERS.get(stream.codec_context.name)
            if codec is None:
                return None
            stream.codec_context.options = {"export_side_data": "venc_params"}
            stream.thread_type = "NONE"
            quantisers, keys, size = [], [], 0
            for n, packet in enumerate(film.demux(stream)):
                if n >= frames:
                    break
                size += packet.size
                keys += [n] if packet.is_keyframe and packet.size else []
                quantisers += [q for frame in packet.decode() for q in _quantiser(frame)]
            pixels = stream.codec_context.width * stream.codec_context.height
        picture = next(iter(open_video(path, rotate=rotate).frames()))
    except (OSError, av.FFmpegError, InputError, IndexError, StopIteration):
        return None
    if not quantisers or picture.ndim != 2 or picture.dtype != np.uint8:
        return None
    even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2].astype(np.float64)
    most = MOST_PIXELS // (TRIED_FRAMES * even.shape[1])
    first = max(0, min(rows[0], (rows[0] + rows[1] - most) // 2)) // 2 * 2 if len(even) > most else 0
    even = even[first : first + max(most, rows[1] - first)] if len(even) > most else even
    even = even[: len(even) // 2 * 2]
    return Encoder(
        codec=codec,
        quantiser=int(np.median(quantisers)),
        keyframes=int(np.median(np.diff(keys))) if len(keys) > 1 else 0,
        bits_per_pixel=8 * size / (len(quantisers) * pixels),
        picture=even,
        rows=(rows[0] - first, min(rows[1] - first, len(even))),
        columns=(columns[0], min(columns[1], even.shape[1])),
    )


def _quantiser(frame: av.VideoFrame) -> list[int]:
    """The quantiser of a frame, as FFmpeg's AVVideoEncParams hands it on; none where it does not."""
    for part in cast("Iterable[Any]", frame.side_data):
        if "VIDEO_ENC_PARAMS" in str(part.type):
            # unsigned nb_blocks; size_t blocks_offset, block_size; enum type; int32 qp
            return [int(struct.unpack_from("@IQQii", bytes(part))[4])]
    return []
