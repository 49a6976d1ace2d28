"""`track simulate DIR`: a synthetic traction test with known truth."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from vision.command.console import frame_progress, say
from vision.command.options import Flag
from vision.errors import InputError


def _sets(setting: str) -> Any:
    """An option, not given, for this setting of `vision.experiment`."""
    return field(default=None, metadata={"setting": setting})


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """The main settings of a synthetic test. What is not given is the preset's."""

    seed: int | None = _sets("seed")
    """Same seed, same data."""
    duration: float | None = _sets("camera.duration_s")
    """Length of the video, s."""
    fps: float | None = _sets("camera.fps")
    """Frames per second."""
    width: int | None = _sets("camera.width")
    """Columns, px."""
    height: int | None = _sets("camera.height")
    """Rows, px."""
    pixel_size: float | None = _sets("camera.pixel_size_um")
    """Micrometres per pixel."""
    exposure: float | None = _sets("camera.exposure_s")
    """Exposure, ms."""
    bits: int | None = _sets("camera.bits")
    """Bits per pixel, 8 to 16."""
    speed: float | None = _sets("mechanics.speed_mm_min")
    """Speed V of the pull, mm/min."""
    d0: float | None = _sets("mechanics.d0_mm")
    """Separation at the start of the pull, mm."""
    d_end: float | None = _sets("mechanics.d_end_mm")
    """Separation at its end, mm."""
    offset: float | None = _sets("clocks.offset_s")
    """Force clock at video time 0, s."""
    sheets: int | None = _sets("sheets.count")
    """Ridges in view."""
    pitch: float | None = _sets("sheets.pitch_px")
    """Distance between ridges, px."""
    fwhm: float | None = _sets("optics.fwhm_px")
    """Ridge width, px."""
    contrast: float | None = _sets("optics.contrast")
    """Michelson contrast of the ridges."""
    ridges: Literal["bright", "dark"] | None = _sets("optics.polarity")
    """Polarity."""
    dropped: float | None = _sets("clocks.dropped")
    """Fraction of frames lost."""
    force_rate: float | None = _sets("clocks.force_rate_Hz")
    """Force samples per second."""
    force_layout: Literal["mts", "instron", "zwick", "csv"] | None = _sets("force_file.layout")
    """Layout of force.txt."""
    force_decimal: Literal[".", ","] | None = _sets("force_file.decimal")
    """Decimal mark in force.txt."""
    force_encoding: Literal["utf-8-sig", "utf-8", "latin-1"] | None = _sets("force_file.encoding")
    """Encoding of force.txt."""
    force_unit: Literal["N", "kN"] | None = _sets("force_file.unit")
    """Unit of force in force.txt."""
    video_time: bool | None = _sets("force_file.video_time")
    """Write the camera's clock as a column of force.txt."""


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
    for changes in (
        settings_from_toml(toml) if toml else {},
        _given(options or SimulateOptions()),
        dict(map(_pair, set_)),
    ):
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


def _given(options: SimulateOptions) -> dict[str, Any]:
    """The options that were given, by the names of their settings; milliseconds become seconds."""
    given = {one.metadata["setting"]: getattr(options, one.name) for one in fields(options)}
    if options.exposure is not None:
        given["camera.exposure_s"] = options.exposure / 1000
    return {setting: value for setting, value in given.items() if value is not None}


def _pair(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise InputError("--set", "GROUP.SETTING=VALUE", text)
    return name.strip(), value.strip()
