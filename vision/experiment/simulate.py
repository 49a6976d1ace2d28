"""simulate(): the files of a synthetic traction test."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import scipy

from vision.errors import InputError
from vision.experiment.images import Progress, frame_blocks
from vision.experiment.mechanics import Pull, camera_time, random_stream
from vision.experiment.scene import Scene, make_scene, save_truth, truth_of
from vision.experiment.settings import Experiment, ForceFile
from vision.experiment.video_files import check_container, write_video
from vision.numeric import Floats, Pixels


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

    Frames are drawn and written in blocks: memory does not grow with the length of the video. The folder
    appears when everything is in it, or not at all.

    Parameters
    ----------
    experiment
        What to simulate.
    out_dir
        Folder to make.
    container
        ``"raw"``, ``"mjpeg"``, ``"h264"``, ``"ffv1"``, ``"tiff"`` or ``"png"``, see
        `vision.experiment.video_files.write_video`.
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
    _check_folder(folder, overwrite=overwrite)
    part = folder.with_name(f".{folder.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        scene = make_scene(experiment)
        made = _write(scene, part, container, progress)
        if folder.exists():
            shutil.rmtree(folder)
        part.rename(folder)
    except OSError as error:
        raise InputError(folder, "a folder that can be written", error.strerror or str(error)) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return SimulatedTest(
        video=folder / made.name,
        force=folder / "force.txt",
        truth=folder / "truth.nc",
        timestamps=folder / "timestamps.txt",
        frames=len(scene.times.camera_s),
        frames_lost=scene.times.lost,
    )


def _write(scene: Scene, folder: Path, container: str, progress: Progress | None) -> Path:
    """Write every file; the path of the video."""
    experiment, times = scene.experiment, scene.times
    recording = force_recording(experiment, scene.pull)
    write_force(folder / "force.txt", recording, experiment.force_file, name="synthetic")
    (folder / "timestamps.txt").write_text("".join(f"{t:.6f}\n" for t in times.stamp_s), "utf-8")
    save_truth(truth_of(scene), folder / "truth.nc")
    blocks = _with_progress(frame_blocks(scene), len(times.camera_s), progress)
    return write_video(folder, blocks, experiment.camera, times, container=container)


def _with_progress(blocks: Iterator[Pixels], total: int, progress: Progress | None) -> Iterator[Pixels]:
    """The same blocks; `progress` is called after each."""
    done = 0
    for block in blocks:
        yield block
        done += len(block)
        if progress is not None:
            progress(done, total)


def _check_folder(folder: Path, *, overwrite: bool) -> None:
    """InputError where a folder must not be replaced."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(folder, "a folder", "a file", "choose another name")
    if not any(folder.iterdir()):
        return
    if not (folder / "truth.nc").exists():
        raise InputError(folder, "a new folder or an earlier synthetic test", "a folder of other things")
    if not overwrite:
        raise InputError(folder, "a new folder", "an earlier synthetic test", "replace it with `overwrite`")


# --- force.txt ---


def force_recording(experiment: Experiment, pull: Pull) -> pd.DataFrame:
    """What the machine records.

    Parameters
    ----------
    experiment
        For the load cell and the clocks.
    pull
        The exact force and separation.

    Returns
    -------
    DataFrame
        Columns time_s, crosshead_mm, load_N and video_time_s. The exact force goes through a first-order
        low-pass on a time grid fine enough for the slip, is sampled, drifts, gets white noise and is rounded
        to the quantum.
    """
    cell, rate = experiment.load_cell, experiment.clocks.force_rate_Hz
    finest = min(pull.settings.slip_s / 4, cell.lowpass_s / 5 or np.inf)
    oversampling = max(int(np.ceil(1 / (rate * finest))), 1)
    samples = int(pull.stop_s * rate) + 1
    fine = np.arange((samples - 1) * oversampling + 1) / (rate * oversampling)
    force = pull.force_N(fine)
    if cell.lowpass_s:
        keep = np.exp(-1 / (rate * oversampling * cell.lowpass_s))
        force = scipy.signal.lfilter([1 - keep], [1, -keep], force)
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
    """To multiples of step; as they are for step 0."""
    return np.asarray(np.round(values / step) * step) if step else values


def write_force(path: Path, recording: pd.DataFrame, style: ForceFile, *, name: str) -> None:
    """Write a recording in the layout, units, decimal mark and encoding of `style`.

    `name` is the test's name in the file's header (mts only).
    """
    data = recording.copy()
    if style.unit == "kN":
        data["load_N"] /= 1000
    if not style.video_time:
        data = data.drop(columns="video_time_s")
    text = _LAYOUTS[style.layout](data, style, name)
    path.write_bytes(text.encode(style.encoding))


def _numbers(data: pd.DataFrame, style: ForceFile, *, separator: str, quote: str = "") -> str:
    """The table's rows, CRLF, ten digits, with the style's decimal mark."""
    columns = [
        data[name].map(lambda v: quote + f"{v:.10g}".replace(".", style.decimal) + quote) for name in data
    ]
    return "\r\n".join(map(separator.join, zip(*columns, strict=True))) + "\r\n"


def _mts(data: pd.DataFrame, style: ForceFile, name: str) -> str:
    """MTS TestSuite text export: tabs, names with trailing spaces, a trailing tab on the header row."""
    video = style.video_time
    order = ["crosshead_mm", "load_N", "time_s", *(["video_time_s"] if video else [])]
    head = [
        rf"File Path: C:\MTS\{name}\DAQ- Crosshead, Load, Time - (Timed).txt",
        "Test: MTS EM Tension (Simplified)",
        f"Test Run: {name}",
        "Date: 1/10/2022 12:52:17 PM",
        "",
        "",
        "\t".join(["Crosshead ", "Load ", "Time ", *(["Video Time "] if video else []), ""]),
        "\t".join(["mm", style.unit, "sec", *(["sec"] if video else [])]),
    ]
    return "\r\n".join(head) + "\r\n" + _numbers(data[order], style, separator="\t")


def _instron(data: pd.DataFrame, style: ForceFile, name: str) -> str:
    """Instron Bluehill: quoted numbers, or semicolons without quotes where the decimal mark is a comma."""
    comma = style.decimal == ","
    separator, quote = (";", "") if comma else (",", '"')
    order = ["time_s", "crosshead_mm", "load_N"]
    names = separator.join(["Time", "Displacement", "Force"] if comma else ["Time", "Extension", "Load"])
    units = separator.join(["(s)", "(mm)", f"({style.unit})"])
    return f"{names}\r\n{units}\r\n" + _numbers(data[order], style, separator=separator, quote=quote)


def _zwick(data: pd.DataFrame, style: ForceFile, name: str) -> str:
    """Zwick .TRA, French names."""
    separator = ";" if style.decimal == "," else ","
    names = separator.join(['"Temps"', '"Traverse absolue"', '"Force standard"'])
    units = separator.join(['"s"', '"mm"', f'"{style.unit}"'])
    head = separator.join(['"Épaisseur éprouvette"', "1", '"mm"'])
    order = ["time_s", "crosshead_mm", "load_N"]
    return f"{head}\r\n{names}\r\n{units}\r\n" + _numbers(data[order], style, separator=separator)


def _csv(data: pd.DataFrame, style: ForceFile, name: str) -> str:
    """Plain table, names with units in brackets."""
    separator = ";" if style.decimal == "," else ","
    names = {"time_s": "time (s)", "crosshead_mm": "displacement (mm)", "load_N": f"force ({style.unit})"}
    head = separator.join(names[column] for column in names)
    return head + "\r\n" + _numbers(data[list(names)], style, separator=separator)


_LAYOUTS: dict[str, Callable[[pd.DataFrame, ForceFile, str], str]] = {
    "mts": _mts,
    "instron": _instron,
    "zwick": _zwick,
    "csv": _csv,
}
