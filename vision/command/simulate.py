"""`track simulate DIR`: a synthetic traction test with known truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from vision.command.console import frame_progress, say
from vision.command.options import Flag
from vision.errors import InputError


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """The main settings of a synthetic test. What is not given is the preset's."""

    seed: int | None = None
    """Same seed, same data."""
    duration: float | None = None
    """Length of the video, s."""
    fps: float | None = None
    """Frames per second."""
    width: int | None = None
    """Columns, px."""
    height: int | None = None
    """Rows, px."""
    pixel_size: float | None = None
    """Micrometres per pixel."""
    exposure: float | None = None
    """Exposure, ms."""
    bits: int | None = None
    """Bits per pixel, 8 to 16."""
    speed: float | None = None
    """Speed V of the pull, mm/min."""
    d0: float | None = None
    """Separation at the start of the pull, mm."""
    d_end: float | None = None
    """Separation at its end, mm."""
    offset: float | None = None
    """Force clock at video time 0, s."""
    sheets: int | None = None
    """Ridges in view."""
    pitch: float | None = None
    """Distance between ridges, px."""
    fwhm: float | None = None
    """Ridge width, px."""
    contrast: float | None = None
    """Michelson contrast of the ridges."""
    ridges: Literal["bright", "dark"] | None = None
    """Polarity."""
    dropped: float | None = None
    """Fraction of frames lost."""
    force_rate: float | None = None
    """Force samples per second."""
    force_layout: Literal["mts", "instron", "zwick", "csv"] | None = None
    """Layout of force.txt."""
    force_decimal: Literal[".", ","] | None = None
    """Decimal mark in force.txt."""
    force_encoding: Literal["utf-8-sig", "utf-8", "latin-1"] | None = None
    """Encoding of force.txt."""
    force_unit: Literal["N", "kN"] | None = None
    """Unit of force in force.txt."""
    video_time: bool | None = None
    """Write the camera's clock as a column of force.txt."""


_SETTING = {
    "seed": "seed",
    "duration": "camera.duration_s",
    "fps": "camera.fps",
    "width": "camera.width",
    "height": "camera.height",
    "pixel_size": "camera.pixel_size_um",
    "bits": "camera.bits",
    "speed": "mechanics.speed_mm_min",
    "d0": "mechanics.d0_mm",
    "d_end": "mechanics.d_end_mm",
    "offset": "clocks.offset_s",
    "sheets": "sheets.count",
    "pitch": "sheets.pitch_px",
    "fwhm": "optics.fwhm_px",
    "contrast": "optics.contrast",
    "ridges": "optics.polarity",
    "dropped": "clocks.dropped",
    "force_rate": "clocks.force_rate_Hz",
    "force_layout": "force_file.layout",
    "force_decimal": "force_file.decimal",
    "force_encoding": "force_file.encoding",
    "force_unit": "force_file.unit",
    "video_time": "force_file.video_time",
}


def simulate(
    directory: Path,
    /,
    options: SimulateOptions | None = None,
    *,
    preset: str = "paper",
    container: str = "raw",
    toml: Path | None = None,
    set_: Annotated[tuple[str, ...], Parameter(name="--set")] = (),
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """Make a synthetic traction test: video, force.txt, truth.nc and the camera's timestamps.txt.

    Settings come from the preset, then the TOML file, then the options, then --set.

    Parameters
    ----------
    directory
        Folder to make.
    options
        The main settings.
    preset
        paper, late, fast, fresh, hostile or sheets.
    container
        raw (Y800 AVI), mjpeg, h264, ffv1, tiff or png.
    toml
        Settings from a file: tables sample, mechanics, sheets, optics, camera, clocks, load_cell.
    set_
        Any setting by name, such as --set optics.tilt_deg=0.5; can be repeated.
    overwrite
        Replace an earlier synthetic test.
    quiet
        No progress bar and no summary.
    """
    from vision.experiment import preset as ready_made
    from vision.experiment import settings_from_toml, with_settings
    from vision.experiment import simulate as make

    experiment = ready_made(preset)
    for changes in (settings_from_toml(toml) if toml else {}, _given(options), dict(map(_pair, set_))):
        experiment = with_settings(experiment, changes)
    with frame_progress("drawing", quiet=quiet) as progress:
        test = make(experiment, directory, container=container, overwrite=overwrite, progress=progress)
    if not quiet:
        lost = f", {test.frames_lost} lost" if test.frames_lost else ""
        camera, sheets = experiment.camera, experiment.ridges_in_view
        files = {"video": test.video, "force": test.force, "truth": test.truth, "stamps": test.timestamps}
        say(
            [
                f"{test.frames} frames{lost} of {camera.width} x {camera.height} px, {sheets} sheets, "
                f"seed {experiment.seed}",
                *(f"{name:<6} {path}" for name, path in files.items()),
            ]
        )
    return 0


def _given(options: SimulateOptions | None) -> dict[str, Any]:
    """The options that were given, by the names of their settings; milliseconds become seconds."""
    if options is None:
        return {}
    changes = {name: getattr(options, option) for option, name in _SETTING.items()}
    if options.exposure is not None:
        changes["camera.exposure_s"] = options.exposure / 1000
    return {name: value for name, value in changes.items() if value is not None}


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise InputError("--set", "GROUP.SETTING=VALUE", text)
    return name.strip(), value.strip()
