"""Films encoded again as the recording was: its codec, its quantiser, as much noise as fills its bits.

A codec that carries content from frame to frame shifts ridges in ways that its own residuals do not show: it
holds a sheet still while it creeps. A film with known truth that goes through the same codec shows it.
"""

from __future__ import annotations

import re
import struct
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
import scipy
from av.video.frame import PictureType

from vision.errors import InputError
from vision.numeric import Floats, Floats32, Pixels
from vision.video import open_video
from vision.video.encoded import open_container
from vision.video.strip import row_means

ENCODERS = {
    "h264": "libx264",
    "hevc": "libx265",
    "mpeg4": "mpeg4",
    "mpeg2video": "mpeg2video",
    "vp9": "libvpx-vp9",
    "av1": "libsvtav1",
}
"""Codecs that carry content from frame to frame, and what FFmpeg writes them with."""
QUANTISERS = {"hevc": (12, 16, 20, 24, 28, 32), "av1": (12, 20, 28, 36, 44)}
"""What is tried where a decoder does not tell the quantiser."""
PRESETS = {
    0: "ultrafast",
    1: "superfast",
    2: "veryfast",
    4: "faster",
    6: "fast",
    7: "medium",
    8: "slow",
    9: "slower",
    10: "veryslow",
}
"""x264's presets by the effort of its motion search (subme), which it writes into its films."""
TRIED_FRAMES = 60
NOISE_GREY, NOISE_ERROR = 12.0, 0.03
"""Most noise of pixels that is tried, more than ridges that can be tracked have, and how well it is found."""


@dataclass(frozen=True)
class Encoder:
    """How a recording was encoded, and the picture on which films like it are drawn.

    Parameters
    ----------
    codec
        As FFmpeg names it.
    quantiser
        Median of the frames' quantisers, or, for HEVC and AV1, the rate factor.
    keyframes
        Frames from keyframe to keyframe; 0 where there is one only.
    bits_per_pixel
        Mean over the recording.
    picture
        One frame (rows, columns), grey levels, turned as the run turned it.
    rows, columns
        Of the strip in it, half-open.
    told
        Whether the film tells its quantiser.
    both_ways
        Whether there are B frames.
    preset
        Of x264, medium where the film does not tell it.
    noise_grey
        Standard deviation of the pixels' noise before encoding.
    shot_noise
        Whether it grows with the root of the brightness, and this is that at the mean brightness.
    """

    codec: str
    quantiser: int
    keyframes: int
    bits_per_pixel: float
    picture: Floats
    rows: tuple[int, int]
    columns: tuple[int, int]
    told: bool = True
    both_ways: bool = True
    preset: str = "medium"
    noise_grey: float = 0.0
    shot_noise: bool = False

    @property
    def described(self) -> str:
        """In words, for the certificate."""
        known = "the quantiser" if self.told else "a rate factor of"
        more = " (more where it is bright)" if self.shot_noise else ""
        return (
            f"{self.codec} at {known} {self.quantiser}, with pixel "
            f"noise of {self.noise_grey:g} grey levels{more}, for which a film takes the recording's "
            f"{self.bits_per_pixel:.2g} bits per pixel"
            + ("" if self.told else " and changes from frame to frame as much")
        )

    @property
    def width(self) -> int:
        """Columns of the strip: one less than the run's where that is odd at the picture's edge."""
        return self.columns[1] - self.columns[0]

    def again(self, profile: Floats32, shown: Floats, *, seed: int) -> Floats32:
        """I(x, t) (frame, x) drawn on all rows, encoded, decoded, and averaged over the strip's rows.

        What tells rows apart is that of the picture's columns `shown` (frame, x): it moves with the sheets.
        """
        return self._again(profile, shown, seed)[0]

    def _again(self, profile: Floats32, shown: Floats, seed: int) -> tuple[Floats32, float]:
        """The same, and the bits per pixel that it took."""
        with tempfile.TemporaryDirectory(prefix="sheetvision-") as folder:
            path = Path(folder) / "again.mkv"
            size = self._write(path, profile, shown, seed)
            film = open_video(path)
            rows, columns = slice(*self.rows), slice(*self.columns)
            values = np.concatenate([row_means(block.pixels) for block in film.blocks(rows, columns)])
            return values, 8 * size / (len(profile) * self.picture.size)

    def fitted(self, profile: Floats32, shown: Floats, recorded: Floats32) -> Encoder:
        """With the noise for which a part of this film takes as many bits as the recording did.

        Where the quantiser is not known, it is the one, too, for which I(x, t) then changes from frame to
        frame by as much as was recorded. Noise is alike everywhere, as a gamma of 0.45 makes it, or grows
        with the root of the brightness, as a linear camera has it: whichever lets bright columns change from
        frame to frame, against dark ones, more nearly as they do in the recording.
        """
        part, recorded = profile[:TRIED_FRAMES], recorded[:TRIED_FRAMES, : self.width]
        best, chosen, values = np.inf, self, recorded
        for quantiser in (self.quantiser,) if self.told else QUANTISERS[self.codec]:
            tried, found, off = replace(self, quantiser=quantiser)._with_noise(part, shown)
            off += abs(float(np.log(_change(found) / _change(recorded))))
            if off < best:
                best, chosen, values = off, tried, found
        growing, found, _ = replace(chosen, shot_noise=True)._with_noise(part, shown)
        even, shot = (abs(np.log(_contrast(v) / _contrast(recorded))) for v in (values, found))
        return growing if shot < even else chosen

    def _with_noise(self, part: Floats32, shown: Floats) -> tuple[Encoder, Floats32, float]:
        """With the noise for which this takes the recording's bits; I(x, t) then; how far bits are off."""
        tried: dict[float, tuple[Floats32, float]] = {}

        def too_many(noise: float) -> float:
            values, bits = replace(self, noise_grey=noise)._again(part, shown, seed=0)
            tried[noise] = values, float(np.log(bits / self.bits_per_pixel))
            return tried[noise][1]

        if too_many(0.0) < 0 < too_many(NOISE_GREY):
            scipy.optimize.brentq(too_many, 0.0, NOISE_GREY, xtol=NOISE_ERROR)
        noise = min(tried, key=lambda noise: abs(tried[noise][1]))
        return replace(self, noise_grey=round(noise, 2)), tried[noise][0], abs(tried[noise][1])

    def _frames(self, profile: Floats32, shown: Floats, seed: int) -> Iterator[Pixels]:
        rng = np.random.default_rng(seed)
        (top, bottom), (left, right) = self.rows, self.columns
        inside = self.picture[:, left:right]
        detail = inside - inside[top:bottom].mean(axis=0)
        for line, column in zip(profile, shown, strict=False):
            frame = np.array(self.picture)
            first = np.clip(column.astype(int), 0, self.width - 2)
            share = np.clip(column - first, 0, 1)
            frame[:, left:right] = line + (1 - share) * detail[:, first] + share * detail[:, first + 1]
            light = np.sqrt(np.maximum(frame, 0.0) / self.picture.mean()) if self.shot_noise else 1.0
            frame += self.noise_grey * light * rng.standard_normal(frame.shape)
            yield np.clip(np.rint(frame), 0, 255).astype(np.uint8)

    def _options(self) -> dict[str, str]:
        """What makes the encoder write like the recording."""
        q = str(self.quantiser)
        options = {
            # x264's assembly reads beyond its buffers: with it, the same film takes other bits each time
            "h264": {"crf": q, "preset": self.preset, "threads": "1", "x264-params": "asm=0"},
            "hevc": {"crf": q, "x265-params": "log-level=none:pools=1:frame-threads=1"},
            "vp9": {"crf": q, "b": "0", "cpu-used": "4"},
            "av1": {"crf": q, "preset": "8"},
        }.get(self.codec, {"qmin": q, "qmax": q})
        if self.keyframes:
            options["g"] = str(self.keyframes)
        if not self.both_ways and self.codec in ("h264", "hevc"):
            options["bf"] = "0"
        return options

    def _write(self, path: Path, profile: Floats32, shown: Floats, seed: int) -> int:
        """Bytes of the film's packets."""
        # libx264 looks beyond sides that are no multiples of 16, at what memory happens to hold.
        multiple = 16 if self.codec == "h264" else 1
        beyond = [(0, -length % multiple) for length in self.picture.shape]
        height, width = np.pad(self.picture, beyond).shape
        size = 0
        with av.open(str(path), "w") as out:
            stream = out.add_stream(ENCODERS[self.codec], rate=25, options=self._options())
            assert isinstance(stream, av.VideoStream)
            stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
            stream.codec_context.time_base = Fraction(1, 25)
            # both planes of colour, one after the other
            colourless = np.full((height // 2, width), 128, np.uint8)
            for n, grey in enumerate(self._frames(profile, shown, seed)):
                # the plane of brightness as it is: no change of range
                planes = np.concatenate([np.pad(grey, beyond, mode="edge"), colourless])
                frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
                frame.pts, frame.time_base = n, Fraction(1, 25)
                packets = stream.encode(frame)
                size += sum(packet.size for packet in packets)
                out.mux(packets)
            packets = stream.encode(None)
            out.mux(packets)
            return size + sum(packet.size for packet in packets)


def _change(values: Floats32) -> float:
    """Mean change from frame to frame, grey levels, without that of slips."""
    change = np.abs(np.diff(values, axis=0)).mean(axis=1)
    return max(float(np.median(change)), 1e-3)


def _contrast(values: Floats32) -> float:
    """Mean change from frame to frame of the brightest quarter of the columns over that of the darkest, in
    the nine tenths of the frames that change least."""
    usual = np.median(values, axis=0)
    dark, bright = np.quantile(usual, (0.25, 0.75))
    change = np.abs(np.diff(values, axis=0))
    mean = change.mean(axis=1)
    change = change[mean <= np.quantile(mean, 0.9)]
    of_dark, of_bright = (float(change[:, which].mean()) for which in (usual <= dark, usual >= bright))
    return max(of_bright, 1e-3) / max(of_dark, 1e-3)


def read_encoder(
    path: Path,
    rows: tuple[int, int],
    columns: tuple[int, int],
    *,
    rotate: int = 0,
    first: int = 0,
    frames: int = 600,
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
    first
        Number of the run's first frame, the picture.
    frames
        Frames of it that are looked at.
    """
    try:
        with open_container(path) as film:
            stream = film.streams.video[0]
            codec = stream.codec_context.codec.canonical_name
            if ENCODERS.get(codec) not in av.codecs_available:
                return None
            told = bytes(stream.codec_context.extradata or b"")
            stream.codec_context.options = {"export_side_data": "venc_params"}
            stream.thread_type = "NONE"
            quantisers, keys, size, seen, both_ways = [], [], 0, 0, False
            for n, packet in enumerate(film.demux(stream)):
                if n >= frames:
                    break
                size += packet.size
                told += bytes(packet)[:4096] if n == 0 else b""  # where x264 and x265 write their settings
                keys += [n] if packet.is_keyframe and packet.size else []
                for frame in packet.decode():
                    seen += 1
                    both_ways |= int(frame.pict_type) == int(PictureType.B)
                    quantisers += _quantiser(frame, codec)
            pixels = stream.codec_context.width * stream.codec_context.height
        shown = open_video(path, rotate=rotate, frames=slice(first, first + 1))
        picture = next(iter(shown.frames()))
    except (OSError, av.FFmpegError, InputError, IndexError, StopIteration):
        return None
    if codec == "hevc" and (crf := _told(told, b"x265", b"crf")) is not None:
        quantisers = [crf]
    effort = _told(told, b"x264", b"subme")
    if not (quantisers or codec in QUANTISERS) or not seen or picture.ndim != 2 or picture.dtype != np.uint8:
        return None
    even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2].astype(np.float64)
    # Of large frames fewer rows, so that a film made to find the noise has at most 60 million pixels.
    most = 60_000_000 // (TRIED_FRAMES * even.shape[1])
    top = max(0, min(rows[0], (rows[0] + rows[1] - most) // 2)) // 2 * 2 if len(even) > most else 0
    even = even[top : top + max(most, rows[1] - top)] if len(even) > most else even
    even = even[: len(even) // 2 * 2]
    return Encoder(
        codec=codec,
        quantiser=round(float(np.median(quantisers))) if quantisers else QUANTISERS[codec][0],
        keyframes=int(np.median(np.diff(keys))) if len(keys) > 1 else 0,
        bits_per_pixel=8 * size / (seen * pixels),
        both_ways=both_ways,
        told=bool(quantisers),
        preset=PRESETS.get(int(effort), "medium") if effort is not None else "medium",
        picture=even,
        rows=(rows[0] - top, min(rows[1] - top, len(even))),
        columns=(columns[0], min(columns[1], even.shape[1])),
    )


def _told(text: bytes, encoder: bytes, name: bytes) -> float | None:
    """A setting that this encoder wrote into its film; None where it did not."""
    found = re.search(rb"\b" + name + rb"=(\d+(?:\.\d+)?)", text) if encoder in text else None
    return None if found is None else float(found[1])


def _quantiser(frame: av.VideoFrame, codec: str) -> list[float]:
    """The quantiser of a frame, as FFmpeg's AVVideoEncParams hands it on; none where it does not.

    In the units of the encoder's options: that of H.264 as it is, the index of VP9 over 4, and for MPEG-2 and
    MPEG-4 half of what each block is given.
    """
    for part in cast("Iterable[Any]", frame.side_data):
        if "VIDEO_ENC_PARAMS" in str(part.type):
            # unsigned nb_blocks; size_t blocks_offset, block_size; enum type; int32 qp
            blocks, first, step, _, base = struct.unpack_from("@IQQii", bytes(part))
            if codec in ("h264", "vp9"):
                return [base if codec == "h264" else base / 4]
            # of a block: int src_x, src_y, w, h; int32 delta_qp
            given = [
                struct.unpack_from("@i", bytes(part), first + k * step + 16)[0]
                for k in range(min(blocks, 64))
            ]
            return [float(np.median(given)) / 2] if given else []
    return []
