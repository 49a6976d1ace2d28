"""Writing the frames of a synthetic test to a video file of any container the program reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.experiment.raw_avi import RawAviWriter

if TYPE_CHECKING:
    from vision.experiment.clocks import FrameTimes
    from vision.experiment.settings import Camera

Blocks = Iterator[NDArray[Any]]
Writer = Callable[[Path, Blocks, "Camera", "FrameTimes"], None]


def write_video(folder: Path, blocks: Blocks, camera: Camera, times: FrameTimes, *, container: str) -> Path:
    """Write every frame to folder/video.* and return its path.

    container: raw (Y800 AVI), mjpeg (AVI), h264 (MP4), ffv1 (Matroska, 8 to 16 bit), tiff (BigTIFF where
    large), png (numbered files, lost frames leave gaps). Only ffv1 keeps the times of lost frames; the
    others run on. The h264 encoder gives the same bytes again only where both sides are multiples of 16:
    elsewhere its padding is not defined and decoded pixels differ by a level or so.
    Raises: InputError as `check_container`.
    """
    check_container(container, camera)
    name, write, _ = _CONTAINERS[container]
    path = folder / name
    write(path, blocks, camera, times)
    return path


def check_container(container: str, camera: Camera) -> None:
    """InputError for an unknown container, one too shallow for the camera's bits, or odd sides in h264."""
    if container not in _CONTAINERS:
        raise InputError("setting container", ", ".join(_CONTAINERS), container)
    bits = _CONTAINERS[container][2]
    if camera.bits > bits:
        advice = "use ffv1, tiff or png"
        raise InputError(
            "setting container", f"at most {bits} bits in {container}", f"{camera.bits} bits", advice
        )
    if container == "h264" and (camera.width % 2 or camera.height % 2):
        raise InputError(
            "setting container", "even width and height in h264", f"{camera.width} x {camera.height}"
        )


def _raw(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    with RawAviWriter(path, width=camera.width, height=camera.height, fps=camera.fps) as writer:
        for block in blocks:
            for frame in block:
                writer.write(frame)


def _encoded(
    path: Path, blocks: Blocks, camera: Camera, times: FrameTimes, *, codec: str, layout: str
) -> None:
    """Any PyAV codec; `layout` is the pixel format of the stream."""
    import av

    options = {"libx264": {"crf": "12", "preset": "fast"}, "ffv1": {"level": "3", "slices": "4"}}.get(
        codec, {}
    )
    rate = Fraction(camera.fps).limit_denominator(1000)
    with av.open(str(path), "w") as file:
        stream: Any = file.add_stream(codec, rate=rate, options=options)
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, layout
        if codec == "libx264":
            stream.codec_context.thread_count = 1  # more threads, another stream each time
        if codec == "mjpeg":
            stream.codec_context.qmin = stream.codec_context.qmax = 2
            stream.codec_context.color_range = 2
        stream.codec_context.time_base = 1 / rate
        numbers = iter(times.exposed if codec == "ffv1" else range(len(times.exposed)))
        for block in blocks:
            for pixels in block:
                frame = _av_frame(pixels, layout)
                frame.pts, frame.time_base = int(next(numbers)), 1 / rate
                file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


def _av_frame(pixels: NDArray[Any], layout: str) -> Any:
    """The grey values as a PyAV frame: exactly in grey layouts and in full-range YUV, scaled in h264's
    range."""
    from av import VideoFrame

    if layout == "yuv420p":
        pixels = np.rint(16 + pixels * (219 / 255)).astype(np.uint8)
    if layout in ("gray", "gray16le"):
        return VideoFrame.from_ndarray(pixels, layout)
    frame = VideoFrame(pixels.shape[1], pixels.shape[0], layout)
    _fill(frame.planes[0], pixels)
    for colour in frame.planes[1:]:
        colour.update(bytes([128]) * colour.buffer_size)
    return frame


def _fill(plane: Any, pixels: NDArray[Any]) -> None:
    """Copy grey values into a plane whose rows may be longer than the picture's."""
    rows, columns = pixels.shape
    values = np.zeros((rows, plane.line_size // pixels.itemsize), pixels.dtype)
    values[:, :columns] = pixels
    plane.update(values.tobytes())


def _mjpeg(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    _encoded(path, blocks, camera, times, codec="mjpeg", layout="yuvj420p")


def _h264(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    _encoded(path, blocks, camera, times, codec="libx264", layout="yuv420p")


def _ffv1(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    layout = {8: "gray", 10: "gray10le", 12: "gray12le"}.get(camera.bits, "gray16le")
    _encoded(path, blocks, camera, times, codec="ffv1", layout=layout)


def _tiff(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    import tifffile

    size = camera.width * camera.height * (1 if camera.bits == 8 else 2) * len(times.exposed)
    with tifffile.TiffWriter(path, bigtiff=size > 3 << 30) as file:
        for block in blocks:
            for frame in block:
                file.write(frame, photometric="minisblack", contiguous=True)


def _png(path: Path, blocks: Blocks, camera: Camera, times: FrameTimes) -> None:
    import cv2

    path.mkdir()
    numbers = iter(times.exposed)
    for block in blocks:
        for frame in block:
            done, data = cv2.imencode(".png", frame)
            if not done:
                raise OSError(f"{path}: a frame could not be encoded as PNG")
            (path / f"frame_{next(numbers):06d}.png").write_bytes(data.tobytes())


_CONTAINERS: dict[str, tuple[str, Writer, int]] = {
    "raw": ("video.avi", _raw, 8),
    "mjpeg": ("video.avi", _mjpeg, 8),
    "h264": ("video.mp4", _h264, 8),
    "ffv1": ("video.mkv", _ffv1, 16),
    "tiff": ("video.tif", _tiff, 16),
    "png": ("video", _png, 16),
}
