"""simulate(): the files of a synthetic traction test."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vision.errors import InputError
from vision.experiment.force_file import force_recording, write_force
from vision.experiment.images import Progress, frame_blocks
from vision.experiment.scene import Scene, make_scene
from vision.experiment.settings import Experiment
from vision.experiment.truth import save_truth, truth_of
from vision.experiment.video_files import check_container, write_video
from vision.numeric import Pixels


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
