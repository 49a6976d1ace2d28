"""Encode films as the recording was: with its codec and quantiser, and noise that takes as many bits.

A codec that predicts frames from others shifts ridges in ways that the recording's residuals do not show: a
creeping sheet stands still for some frames. A film with known truth that is encoded in the same way shows it.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import scipy
from av.video.frame import PictureType

from vision.certify.settings import CertifySettings
from vision.errors import InputError
from vision.numeric import Floats, Floats32, Pixels
from vision.video import open_video
from vision.video.encoded import EXPORT_QUANTISERS, block_quantisers, open_container
from vision.video.strip import row_means

ENCODERS = {
    "h264": "libx264",
    "hevc": "libx265",
    "mpeg4": "mpeg4",
    "mpeg2video": "mpeg2video",
    "vp9": "libvpx-vp9",
    "av1": "libsvtav1",
}
"""Codecs that predict frames from others, and FFmpeg's encoders."""
QUANTISERS = {"hevc": (12, 16, 20, 24, 28, 32), "av1": (12, 20, 28, 36, 44)}
"""Rate factors that are tried if the decoder does not report the quantiser."""
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
"""x264's presets by the effort of its motion search (subme), which x264 writes into its films."""


@dataclass(frozen=True)
class Encoder:
    """How a recording was encoded, and the picture on which films like it are drawn."""

    codec: str  # FFmpeg's name of the codec
    quantiser: int  # median of the frames' quantisers, or, for HEVC and AV1, the rate factor
    keyframes: int  # number of frames from keyframe to keyframe; 0 if there is only one
    bits_per_pixel: float  # mean over the recording
    picture: Floats  # one frame (rows, columns), grey levels, turned as in the run
    # rows, columns: the strip in the picture, half-open
    rows: tuple[int, int]
    columns: tuple[int, int]
    quantiser_known: bool = True  # whether the film states its quantiser
    b_frames: bool = True  # whether there are B frames, which are predicted from earlier and later ones
    preset: str = "medium"  # preset of x264; medium if the film does not state it
    noise_grey: float = 0.0  # standard deviation of the pixel noise before encoding
    settings: CertifySettings = CertifySettings()

    @property
    def described(self) -> str:
        """The encoding as text, for the certificate."""
        known = "the quantiser" if self.quantiser_known else "a rate factor of"
        return (
            f"{self.codec} at {known} {self.quantiser}, with pixel "
            f"noise of {self.noise_grey:g} grey levels, with which a film takes the recording's "
            f"{self.bits_per_pixel:.2g} bits per pixel"
            + ("" if self.quantiser_known else " and changes as much from frame to frame")
        )

    @property
    def width(self) -> int:
        """Columns of the strip: one less than in the run if an odd last column was cut off."""
        return self.columns[1] - self.columns[0]

    def encode(self, profile: Floats32, shown: Floats, *, seed: int) -> tuple[Floats32, float]:
        """Draw I(x, t) (frame, x) on all rows, encode and decode it, and average over the strip's rows.

        The differences between rows are those of the picture at columns `shown` (frame, x), and so move with
        the sheets.  Returns: I(x, t) after decoding, and the bits per pixel.
        """
        with tempfile.TemporaryDirectory(prefix="sheetvision-") as folder:
            path = Path(folder) / "again.mkv"
            size = self._write(path, profile, shown, seed)
            film = open_video(path)
            rows, columns = slice(*self.rows), slice(*self.columns)
            values = np.concatenate([row_means(block.pixels) for block in film.blocks(rows, columns)])
            return values, 8 * size / (len(profile) * self.picture.size)

    def fitted(self, profile: Floats32, shown: Floats, recorded: Floats32) -> Encoder:
        """Return this encoder with the noise for which a part of this film takes as many bits as recorded.

        If the quantiser is not known, it is chosen so that I(x, t) also changes as much from frame to frame
        as recorded.
        """
        tried_frames = self.settings.tried_frames
        part, recorded = profile[:tried_frames], recorded[:tried_frames, : self.width]
        best, chosen = np.inf, self
        for quantiser in (self.quantiser,) if self.quantiser_known else QUANTISERS[self.codec]:
            tried, found, off = replace(self, quantiser=quantiser)._with_noise(part, shown)
            off += abs(float(np.log(_change(found) / _change(recorded))))
            if off < best:
                best, chosen = off, tried
        return chosen

    def _with_noise(self, part: Floats32, shown: Floats) -> tuple[Encoder, Floats32, float]:
        """Return this encoder with the noise that takes the recorded bits, I(x, t), and |log(bits ratio)|."""
        tried: dict[float, tuple[Floats32, float]] = {}

        def too_many(noise: float) -> float:
            if noise not in tried:  # the search begins with both ends again
                values, bits = replace(self, noise_grey=noise).encode(part, shown, seed=0)
                tried[noise] = values, float(np.log(bits / self.bits_per_pixel))
            return tried[noise][1]

        most = self.settings.most_noise_grey
        if too_many(0.0) < 0 < too_many(most):
            scipy.optimize.brentq(too_many, 0.0, most, xtol=self.settings.noise_error_grey)
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
            frame += self.noise_grey * rng.standard_normal(frame.shape)
            yield np.clip(np.rint(frame), 0, 255).astype(np.uint8)

    def _options(self) -> dict[str, str]:
        """Return FFmpeg's options for an encoding like that of the recording."""
        q = str(self.quantiser)
        options = {
            # x264's assembly reads beyond its buffers, so that the bits would differ from call to call.
            "h264": {"crf": q, "preset": self.preset, "threads": "1", "x264-params": "asm=0"},
            "hevc": {"crf": q, "x265-params": "log-level=none:pools=1:frame-threads=1"},
            "vp9": {"crf": q, "b": "0", "cpu-used": "4"},
            "av1": {"crf": q, "preset": "8"},
        }.get(self.codec, {"qmin": q, "qmax": q})
        if self.keyframes:
            options["g"] = str(self.keyframes)
        if not self.b_frames and self.codec in ("h264", "hevc"):
            options["bf"] = "0"
        return options

    def _write(self, path: Path, profile: Floats32, shown: Floats, seed: int) -> int:
        """Write the film and return the bytes of its packets."""
        # libx264 reads undefined memory beyond sides that are not multiples of 16.
        multiple = 16 if self.codec == "h264" else 1
        beyond = [(0, -length % multiple) for length in self.picture.shape]
        height, width = np.pad(self.picture, beyond).shape
        size = 0
        with av.open(str(path), "w") as out:
            stream = out.add_stream(ENCODERS[self.codec], rate=25, options=self._options())
            assert isinstance(stream, av.VideoStream)
            stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
            stream.codec_context.time_base = Fraction(1, 25)
            # both colour planes, one after the other
            colourless = np.full((height // 2, width), 128, np.uint8)
            for n, grey in enumerate(self._frames(profile, shown, seed)):
                # the luma plane with unchanged range
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
    """Return the median over frames of the mean change from frame to frame, grey levels."""
    change = np.abs(np.diff(values, axis=0)).mean(axis=1)
    return max(float(np.median(change)), 1e-3)


def read_encoder(
    path: Path,
    rows: tuple[int, int],
    columns: tuple[int, int],
    *,
    rotate: int = 0,
    first: int = 0,
    settings: CertifySettings = CertifySettings(),
) -> Encoder | None:
    """Read how a recording was encoded; None if it cannot be read, or there is no such encoder.

    rows, columns: the strip, half-open.  rotate: degrees clockwise by which the run turned frames.  first:
    number of the run's first frame, which becomes the picture.
    """
    try:
        with open_container(path) as film:
            stream = film.streams.video[0]
            codec = stream.codec_context.codec.canonical_name
            if ENCODERS.get(codec) not in av.codecs_available:
                return None
            header = bytes(stream.codec_context.extradata or b"")
            stream.codec_context.options = EXPORT_QUANTISERS
            stream.thread_type = "NONE"
            quantisers, keys, size, decoded, b_frames = [], [], 0, 0, False
            for n, packet in enumerate(film.demux(stream)):
                if n >= settings.read_frames:
                    break
                size += packet.size
                header += bytes(packet)[:4096] if n == 0 else b""  # x264 and x265 write their settings here
                keys += [n] if packet.is_keyframe and packet.size else []
                for frame in packet.decode():
                    decoded += 1
                    b_frames |= int(frame.pict_type) == int(PictureType.B)
                    quantisers += _quantiser(frame, codec)
            pixels = stream.codec_context.width * stream.codec_context.height
        shown = open_video(path, rotate=rotate, frames=slice(first, first + 1))
        picture = next(iter(shown.frames()))
    except (OSError, av.FFmpegError, InputError, IndexError, StopIteration):
        return None
    if codec == "hevc" and (crf := _setting(header, b"x265", b"crf")) is not None:
        quantisers = [crf]
    is_grey = picture.ndim == 2 and picture.dtype == np.uint8
    if not (is_grey and decoded and (quantisers or codec in QUANTISERS)):
        return None
    effort = _setting(header, b"x264", b"subme")
    even, top = _part_to_encode(picture, rows, settings.tried_frames)
    return Encoder(
        codec=codec,
        quantiser=round(float(np.median(quantisers))) if quantisers else QUANTISERS[codec][0],
        keyframes=int(np.median(np.diff(keys))) if len(keys) > 1 else 0,
        bits_per_pixel=8 * size / (decoded * pixels),
        b_frames=b_frames,
        quantiser_known=bool(quantisers),
        preset=PRESETS.get(int(effort), "medium") if effort is not None else "medium",
        picture=even,
        rows=(rows[0] - top, min(rows[1] - top, len(even))),
        columns=(columns[0], min(columns[1], even.shape[1])),
        settings=settings,
    )


def _part_to_encode(picture: Pixels, rows: tuple[int, int], tried_frames: int) -> tuple[Floats, int]:
    """Return the part of a picture around the strip that films are encoded with, and its first row. Encoders
    demand even numbers. Large pictures are cropped to fewer rows, so that a film for finding the noise has at
    most 60 million pixels, unless the strip itself has more."""
    even = picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2].astype(np.float64)
    most = 60_000_000 // (tried_frames * even.shape[1])
    if len(even) <= most:
        return even, 0
    top = max(0, min(rows[0], (rows[0] + rows[1] - most) // 2)) // 2 * 2
    part = even[top : top + max(most, rows[1] - top)]
    return part[: len(part) // 2 * 2], top


def _setting(text: bytes, encoder: bytes, name: bytes) -> float | None:
    """Return a setting that this encoder wrote into its film; None if it is not there."""
    found = re.search(rb"\b" + name + rb"=(\d+(?:\.\d+)?)", text) if encoder in text else None
    return None if found is None else float(found[1])


def _quantiser(frame: av.VideoFrame, codec: str) -> list[float]:
    """Return the quantiser of a frame in the units of the encoder's options, as a list; empty if unknown.
    Those of MPEG-2 and MPEG-4 are the median of the blocks."""
    found = block_quantisers(frame)
    if found is None:
        return []
    base, of_blocks = found
    return [{"h264": base, "vp9": base / 4}.get(codec, float(np.median(of_blocks)) / 2)]
