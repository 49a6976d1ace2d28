"""The instruments: the camera's frames and I(x, t), the machine's recording, and the files of both.

A pixel that collects e electrons has the variance e + read² (photons and read-out); the mean of n rows has an
n-th of that. Grey level = e / gain, rounded and clipped.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pandas as pd
import scipy
import tifffile
import xarray as xr
from scipy.sparse import coo_array, csr_array

from vision.data import StripMetadata, record, strip_of
from vision.errors import InputError, known_as
from vision.experiment.mechanics import Pull, random_stream
from vision.experiment.scene import FrameTimes, Scene, camera_time, make_scene, strip_slice, truth_of
from vision.experiment.settings import Camera, Experiment, ForceFile
from vision.files import Progress, in_threads
from vision.folder import TRUTH, run_folder
from vision.memory import row_parts
from vision.numeric import Floats, Floats32, Ints, Pixels

# --- sensor -------------------------------------------------------------------------------------------------


def sensor_levels(light: Floats32, camera: Camera, rng: np.random.Generator) -> Pixels:
    """Convert light (fraction of saturation) to noisy, rounded and clipped grey levels."""
    electrons = light * np.float32(camera.full_well_e)
    if camera.noise:
        # With thousands of electrons per pixel, normal deviates agree with Poisson deviates to 1e-3.
        spread = np.sqrt(np.maximum(electrons, 0) + np.float32(camera.read_noise_e**2))
        electrons += spread * rng.standard_normal(light.shape, dtype=np.float32)
    np.minimum(electrons, np.float32(camera.full_well_e), out=electrons)
    electrons *= np.float32(1 / camera.electrons_per_level)
    electrons += np.float32(0.5)
    np.clip(electrons, 0, camera.saturation_level, out=electrons)
    return electrons.astype(np.uint8 if camera.bits == 8 else np.uint16)


def mean_of_rows(light: Floats, camera: Camera, rows: int, rng: np.random.Generator) -> Floats32:
    """Return the mean grey level of `rows` pixels, with the same mean and variance as if each were drawn."""
    electrons = light * camera.full_well_e
    gain = camera.electrons_per_level
    if camera.noise:
        one = np.maximum(electrons, 0) + camera.read_noise_e**2 + gain**2 / 12  # + rounding
        electrons = electrons + np.sqrt(one / rows) * rng.standard_normal(light.shape, dtype=np.float32)
    levels = np.minimum(electrons, camera.full_well_e) / gain
    return np.asarray(np.clip(levels, 0, camera.saturation_level), np.float32)


# --- frames -------------------------------------------------------------------------------------------------


def frame_blocks(scene: Scene) -> Iterator[Pixels]:
    """Yield all frames in order, in blocks (frame, row, column) of uint8 (8 bit) or uint16.

    A block has a few million pixels; at most four of them exist at a time. Every frame has its own stream of
    random numbers, so the data depend neither on the blocks nor on the threads.
    """
    experiment, camera, total = scene.experiment, scene.experiment.camera, len(scene.times.camera_s)
    column = np.arange(camera.width + 1.0)
    cell = _cell_of(scene, column - 0.5)
    edge_cell = np.floor(cell).astype(np.int32)
    edge_share = np.asarray(cell - edge_cell, np.float32)
    centre_cell = _cell_of(scene, column[:-1]).astype(np.int32)

    def seen(light: Floats) -> Floats32:
        """Return the light per pixel (row, column): cumulative light at its right minus left edge."""
        at_edges = np.concatenate([[0.0], np.cumsum(light)])[edge_cell]
        at_edges += edge_share * light.astype(np.float32)[edge_cell]
        return np.asarray(np.diff(at_edges, axis=1), np.float32)

    # Cached properties are computed before threads start, which is not thread-safe.
    base, response, _ = seen(scene.base), scene.response, scene.texture(slice(0, 1))

    def drawn(light: Floats, texture: Floats32, owner: Ints, flicker: float, number: int) -> Pixels:
        """Draw one frame from the ridges' light per cell, the texture (row, sheet) and each cell's sheet."""
        ridges = seen(light)
        factor = np.take_along_axis(texture, owner[centre_cell], axis=1)
        factor += 1
        ridges *= factor
        ridges += base
        ridges *= response
        ridges *= np.float32(flicker)
        return sensor_levels(ridges, camera, random_stream(experiment.seed, "sensor", number))

    def block(frames: slice) -> Pixels:
        textures = scene.texture(frames).astype(np.float32)
        parts = scene.ridge_light(frames), textures, _owners(scene, frames), scene.flicker(frames).tolist()
        each = zip(*parts, range(frames.start, frames.stop), strict=True)
        return np.stack([drawn(*one) for one in each])

    step = int(np.clip(4_000_000 // (camera.width * camera.height), 1, 32))
    return in_threads(block, row_parts(total, step), held=4)


def _cell_of(scene: Scene, x_px: Floats) -> Floats:
    """Return the position on the line of cells, (row, column), of pixel coordinates x_px in every row."""
    line = scene.line
    at = (scene.source_px(x_px, scene.zeta_px[:, None]) - line.start_px) * line.per_px
    return np.asarray(np.clip(at, 0, line.cells - 1e-9))


def _owners(scene: Scene, frames: slice) -> Ints:
    """Return the sheet visible in each cell, (frame, cell); borders lie half way between neighbours."""
    line = scene.line
    x = scene.positions_px(frames)[0]
    borders = np.ceil(((x[:, 1:] + x[:, :-1]) / 2 - line.start_px) * line.per_px - 0.5).astype(np.int64)
    steps = np.zeros((len(x), line.cells + 1), np.int32)
    row = np.arange(len(x))[:, None]
    np.add.at(steps, (row, np.clip(borders, 0, line.cells)), 1)
    return np.cumsum(steps[:, :-1], axis=1, dtype=np.int64)


# --- I(x, t) ------------------------------------------------------------------------------------------------


def profiles(experiment: Experiment) -> tuple[xr.DataArray, xr.Dataset]:
    """Draw I(x, t) of the default strip directly: a thousand frames in a second or two.

    Rows are averaged before noise is added, so the noise is that of the mean. Structure along the rows
    (shapes of dust, texture inside a bowed ridge) is averaged as well.

    Returns I(x, t) as `strip_profile` gives it for this experiment's video, and the truth (`truth_of`).
    """
    scene, rows, camera = make_scene(experiment), strip_slice(experiment), experiment.camera
    total, average = len(scene.times.camera_s), _row_average(scene)
    intensity = np.empty((total, camera.width), np.float32)
    for frames in row_parts(total, 32):
        texture = np.asarray(1 + scene.texture(frames)[:, rows].mean(axis=1))
        light = scene.base + scene.ridge_light(frames, texture)
        up_to = np.cumsum(light, axis=1)
        seen = (average @ np.pad(up_to, ((0, 0), (1, 0))).T).T
        seen *= scene.response[rows].mean(axis=0) * scene.flicker(frames)[:, None]
        rng = random_stream(experiment.seed, "profile noise", frames.start)
        intensity[frames] = mean_of_rows(seen, camera, rows.stop - rows.start, rng)
    return _as_strip(intensity, scene), truth_of(scene)


def _row_average(scene: Scene) -> csr_array:
    """Return the matrix (column, cell edge) that maps cumulative light at cell edges to the strip mean.

    The light of a pixel is the cumulative light at its right edge minus that at its left edge, interpolated
    between cell edges in each row. Rows are weighted with their light.
    """
    rows, edges = strip_slice(scene.experiment), np.arange(scene.experiment.camera.width + 1.0)
    weight = scene.row_light[rows]
    at = _cell_of(scene, edges - 0.5)[rows]
    cell = np.floor(at).astype(np.int64)
    share, w = at - cell, np.broadcast_to((weight / weight.sum())[:, None], at.shape)
    edge = np.broadcast_to(np.arange(edges.size), at.shape)
    values = np.concatenate([(w * (1 - share)).ravel(), (w * share).ravel()])
    where = np.tile(edge.ravel(), 2), np.concatenate([cell.ravel(), cell.ravel() + 1])
    reading = coo_array((values, where), shape=(edges.size, scene.line.cells + 1)).tocsr()
    return csr_array(reading[1:] - reading[:-1])


def _as_strip(intensity: Floats32, scene: Scene) -> xr.DataArray:
    """Return the strip with the coordinates and metadata that `strip_profile` gives it."""
    experiment, rows, kept = scene.experiment, strip_slice(scene.experiment), len(intensity)
    metadata = StripMetadata(
        source="synthetic",
        depth_bits=experiment.camera.bits,
        saturation_level=float(experiment.camera.saturation_level),
        strip_z0=rows.start,
        strip_z1=rows.stop,
        tilt_deg=experiment.optics.tilt_deg,
        clock_kind="given",
        fps=float(experiment.camera.fps),
        frames_expected=kept,
        frames_read=kept,
    )
    strip = strip_of(
        intensity,
        frame=np.arange(kept, dtype=np.int64),
        first_x=0,
        time_s=scene.times.stamp_s,
        status=np.full(kept, "ok"),
        attrs=metadata.attrs(),
    )
    return record(strip, "profiles", **asdict(experiment))


# --- a test and its files -----------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SimulatedTest:
    """The files of one synthetic test, and the frames written and lost."""

    video: Path
    force: Path
    truth: Path
    timestamps: Path
    frames: int
    frames_lost: int


def simulate(
    experiment: Experiment,
    out_dir: str | os.PathLike[str],
    *,
    container: str = "raw",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> SimulatedTest:
    """Write video.*, force.txt, truth.nc and timestamps.txt (the camera's stamps, s) to a folder.

    Frames are drawn and written in blocks, so memory does not grow with the length of the video. The folder
    appears only when it is complete.

    Parameters
    ----------
    container
        ``"raw"``, ``"mjpeg"``, ``"h264"``, ``"ffv1"``, ``"tiff"`` or ``"png"``, see
        `vision.experiment.simulate.write_video`.
    overwrite
        Whether to replace an earlier synthetic test.
    progress
        Called with (frames written, frames in total).

    Raises
    ------
    InputError
        For an unknown container, a folder that exists (unless `overwrite` is given and it holds an earlier
        synthetic test), or one that cannot be written.
    """
    folder = Path(out_dir)
    check_container(container, experiment.camera)
    with known_as(out="out_dir"), run_folder(folder, overwrite=overwrite, known_by=TRUTH) as part:
        scene = make_scene(experiment)
        made = _write(scene, part, container, progress)
    return SimulatedTest(
        video=folder / made.name,
        force=folder / "force.txt",
        truth=folder / TRUTH,
        timestamps=folder / "timestamps.txt",
        frames=len(scene.times.camera_s),
        frames_lost=scene.times.lost,
    )


def _write(scene: Scene, folder: Path, container: str, progress: Progress | None) -> Path:
    """Write every file and return the path of the video."""
    experiment, times = scene.experiment, scene.times
    write_force(folder / "force.txt", force_recording(experiment, scene.pull), experiment.force_file)
    (folder / "timestamps.txt").write_text("".join(f"{t:.6f}\n" for t in times.stamp_s), "utf-8")
    truth = truth_of(scene)
    packed = {name: {"zlib": True, "shuffle": True} for name in truth.data_vars}
    truth.to_netcdf(folder / TRUTH, engine="h5netcdf", encoding=packed)

    def blocks() -> Iterator[Pixels]:
        done = 0
        for block in frame_blocks(scene):
            yield block
            done += len(block)
            if progress is not None:
                progress(done, len(times.camera_s))

    return write_video(folder, blocks(), experiment.camera, times, container=container)


# --- force.txt ----------------------------------------------------------------------------------------------


def force_recording(experiment: Experiment, pull: Pull) -> pd.DataFrame:
    """Return the machine's recording of a pull: columns time_s, crosshead_mm, load_N and video_time_s.

    The exact force is filtered by a first-order low-pass and by the resonance of the load cell on a time grid
    fine enough for the slip and sampled; drift and white noise are added, and the sum is rounded to the
    quantum.
    """
    cell, rate = experiment.load_cell, experiment.clocks.force_rate_Hz
    ringing_s = 1 / cell.ringing_Hz if cell.ringing_Hz else np.inf
    finest = min(pull.settings.slip_s / 4, cell.lowpass_s / 5 or np.inf, ringing_s / 20)
    oversampling = max(int(np.ceil(1 / (rate * finest))), 1)
    samples = int(pull.stop_s * rate) + 1
    fine = np.arange((samples - 1) * oversampling + 1) / (rate * oversampling)
    force = pull.force_N(fine)
    if cell.lowpass_s:
        keep = np.exp(-1 / (rate * oversampling * cell.lowpass_s))
        force = scipy.signal.lfilter([1 - keep], [1, -keep], force)
    if cell.ringing_Hz:
        turn = 2 * np.pi * cell.ringing_Hz
        resonance = ([turn**2], [1, 2 * cell.ringing_damping * turn, turn**2])
        force = scipy.signal.lfilter(*scipy.signal.bilinear(*resonance, rate * oversampling), force)
    time = fine[::oversampling]
    rng = random_stream(experiment.seed, "load cell")
    drift = cell.drift_N * time / pull.stop_s
    load = force[::oversampling] + drift + cell.noise_N * rng.standard_normal(samples)
    crosshead = pull.separation_mm(time) - pull.settings.d0_mm
    video = camera_time(time, experiment)
    period = 1 / experiment.camera.fps
    return pd.DataFrame(
        {
            "time_s": time,
            "crosshead_mm": _rounded(crosshead, cell.displacement_quantum_mm),
            "load_N": _rounded(load, cell.quantum_N),
            "video_time_s": np.floor(video / period) * period,
        }
    )


def _rounded(values: Floats, step: float) -> Floats:
    """Round to multiples of step; do nothing for step 0."""
    return np.asarray(np.round(values / step) * step) if step else values


def write_force(path: Path, recording: pd.DataFrame, style: ForceFile) -> None:
    """Write a recording in the layout, units, decimal mark and encoding of `style`, with ten digits.

    "mts": an MTS TestSuite export, with tabs, names with trailing spaces and a trailing tab in the header.
    "instron": Instron Bluehill's quoted numbers or, with decimal commas, semicolons and no quotes.
    "zwick": a .TRA file with French names.  "csv": a plain table with units in brackets after the names.
    """
    comma, unit, quote = style.decimal == ",", style.unit, ""
    separator, order = ";" if comma else ",", ["time_s", "crosshead_mm", "load_N"]
    head: list[Sequence[str]] = [["time (s)", "displacement (mm)", f"force ({unit})"]]
    if style.layout == "mts":
        separator, order = "\t", ["crosshead_mm", "load_N", "time_s"]
        names, units = ["Crosshead ", "Load ", "Time "], ["mm", unit, "sec"]
        if style.video_time:
            order.append("video_time_s")
            names.append("Video Time ")
            units.append("sec")
        head = [*([line] for line in _MTS_HEAD), [*names, ""], units]
    elif style.layout == "instron":
        names = ["Time", "Displacement", "Force"] if comma else ["Time", "Extension", "Load"]
        head, quote = [names, ["(s)", "(mm)", f"({unit})"]], "" if comma else '"'
    elif style.layout == "zwick":
        names = ['"Temps"', '"Traverse absolue"', '"Force standard"']
        head = [['"Épaisseur éprouvette"', "1", '"mm"'], names, ['"s"', '"mm"', f'"{unit}"']]
    data = recording.assign(load_N=recording["load_N"] / (1000 if unit == "kN" else 1))
    columns = [
        [quote + f"{value:.10g}".replace(".", style.decimal) + quote for value in data[name]]
        for name in order
    ]
    text = "".join(separator.join(cells) + "\r\n" for cells in (*head, *zip(*columns, strict=True)))
    path.write_bytes(text.encode(style.encoding))


_MTS_HEAD = (
    r"File Path: C:\MTS\synthetic\DAQ- Crosshead, Load, Time - (Timed).txt",
    "Test: MTS EM Tension (Simplified)",
    "Test Run: synthetic",
    "Date: 1/10/2022 12:52:17 PM",
    "",
    "",
)


# --- video --------------------------------------------------------------------------------------------------

Frames = Iterator[Pixels]


def write_video(
    folder: Path, blocks: Iterator[Pixels], camera: Camera, times: FrameTimes, *, container: str
) -> Path:
    """Write every frame to folder/video.* and return its path.

    blocks: from `frame_blocks`.  container: raw (Y800 AVI), mjpeg (AVI), h264 (MP4), ffv1 (Matroska, 8 to 16
    bit), tiff (BigTIFF if large) or png (numbered files, with gaps for lost frames); `check_container` checks
    whether it suits the camera. In ffv1, too, lost frames leave gaps in time; the others are continuous.

    The h264 encoder is reproducible only if both sides of the picture are multiples of 16; otherwise its
    padding is undefined and decoded pixels differ by about one level.
    """
    name, write, _ = _CONTAINERS[container]
    path = folder / name
    write(path, (frame for block in blocks for frame in block), camera, times)
    return path


def check_container(container: str, camera: Camera) -> None:
    """Raise InputError for an unknown container, too few bits for the camera, or odd sides in h264."""
    if container not in _CONTAINERS:
        raise InputError("`container`", ", ".join(_CONTAINERS), container)
    bits = _CONTAINERS[container][2]
    if camera.bits > bits:
        advice = "use ffv1, tiff or png"
        raise InputError("`container`", f"at most {bits} bits in {container}", f"{camera.bits} bits", advice)
    if container == "h264" and (camera.width % 2 or camera.height % 2):
        raise InputError("`container`", "even width and height in h264", f"{camera.width} x {camera.height}")


def _encoded(codec: str, path: Path, frames: Frames, camera: Camera, times: FrameTimes) -> None:
    """Write a film with FFmpeg: Motion JPEG of the best quality, H.264 with a camera's limited range, or FFV1
    (lossless) with the smallest pixel format that holds the bits."""
    deep = {8: "gray", 10: "gray10le", 12: "gray12le"}.get(camera.bits, "gray16le")
    layout = {"mjpeg": "yuvj420p", "libx264": "yuv420p"}.get(codec, deep)
    options = {"libx264": {"crf": "12", "preset": "fast"}, "ffv1": {"level": "3", "slices": "4"}}
    rate = Fraction(camera.fps).limit_denominator(1000)
    with av.open(str(path), "w") as file:
        stream: Any = file.add_stream(codec, rate=rate, options=options.get(codec, {}))
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, layout
        if codec == "libx264":
            stream.codec_context.thread_count = 1  # with more threads the stream is not reproducible
        if codec == "mjpeg":
            stream.codec_context.qmin = stream.codec_context.qmax = 2
            stream.codec_context.color_range = 2
        stream.codec_context.time_base = 1 / rate
        for k, pixels in enumerate(frames):
            frame = _av_frame(pixels, layout)
            frame.pts = int(times.exposed[k]) if codec == "ffv1" else k
            frame.time_base = 1 / rate
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


def _av_frame(pixels: Pixels, layout: str) -> Any:
    """Return grey values as a PyAV frame, unchanged or, for H.264, scaled to the limited range."""
    if layout == "yuv420p":
        pixels = np.rint(16 + pixels * (219 / 255)).astype(np.uint8)
    if layout in ("gray", "gray16le"):
        return av.VideoFrame.from_ndarray(pixels, layout)
    rows, columns = pixels.shape
    frame = av.VideoFrame(columns, rows, layout)
    # A plane's rows may be longer than the picture's.
    grey = np.zeros((rows, frame.planes[0].line_size // pixels.itemsize), pixels.dtype)
    grey[:, :columns] = pixels
    frame.planes[0].update(grey.tobytes())
    for colour in frame.planes[1:]:
        colour.update(bytes([128]) * colour.buffer_size)
    return frame


def _tiff(path: Path, frames: Frames, camera: Camera, times: FrameTimes) -> None:
    """Write one multi-page TIFF."""
    size = camera.width * camera.height * (1 if camera.bits == 8 else 2) * len(times.exposed)
    with tifffile.TiffWriter(path, bigtiff=size > 3 << 30) as file:
        for frame in frames:
            file.write(frame, photometric="minisblack", contiguous=True)


def _png(path: Path, frames: Frames, camera: Camera, times: FrameTimes) -> None:
    """Write numbered files to a folder."""
    path.mkdir()
    for number, frame in zip(times.exposed, frames, strict=True):
        done, data = cv2.imencode(".png", frame)
        if not done:
            raise OSError(f"{path}: a frame could not be encoded as PNG")
        (path / f"frame_{number:06d}.png").write_bytes(data.tobytes())


_CONTAINERS: dict[str, tuple[str, Callable[[Path, Frames, Camera, FrameTimes], None], int]] = {
    "raw": ("video.avi", partial(_encoded, "rawvideo"), 8),
    "mjpeg": ("video.avi", partial(_encoded, "mjpeg"), 8),
    "h264": ("video.mp4", partial(_encoded, "libx264"), 8),
    "ffv1": ("video.mkv", partial(_encoded, "ffv1"), 16),
    "tiff": ("video.tif", _tiff, 16),
    "png": ("video", _png, 16),
}
