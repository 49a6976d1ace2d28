"""Groups of options, and how the library's names become options."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter as Option


def _whole(kind: Any, tokens: Sequence[Any]) -> int:
    """A whole number as it is written, 1.5 is none: a conversion would round it.  Raises: ValueError."""
    text = str(tokens[0].value).strip()
    if not re.fullmatch(r"[-+]?[0-9]{1,9}(?:\.0{1,9})?", text):
        raise ValueError("give a whole number")
    return int(text.partition(".")[0])


Whole = Annotated[int, Option(converter=_whole)]
Flag = Annotated[bool, Option(negative="", show_default=False)]
Report = Annotated[bool, Option(show_default=False)]  # also --no-report


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """How a video is read and its sheets are found."""

    strip: str | None = None
    """Rows averaged, Z0:Z1, half-open, from the top; auto finds where ridges are straight and clear."""
    columns: str | None = None
    """Columns looked at, X0:X1."""
    strips: Whole | None = None
    """Measure in so many parts of the strip as well, one above the other: x(n,z,t) in tracks.nc."""
    sheets: Whole | None = None
    """Number of ridges in view; found if not given."""
    ridges: Literal["bright", "dark", "auto"] | None = None
    """Polarity: bright, dark or auto."""
    axis: float | None = None
    """Symmetry axis in px; found from the motion if not given."""
    fit: Literal["auto", "sliding", "paper", "template"] | None = None
    """auto (template where it is learned well, else sliding), sliding, paper (as published) or template."""
    window: str | None = None
    """Fit window in px, odd, or auto to follow the ridges' width; 9 where they are 6 to 14 px wide."""
    corrections: Path | None = None
    """TOML file of decisions by hand: accept, leave_out, swap, assign, add, delete, axis, strip, clock."""
    pixel_size: str | None = None
    """µm per pixel, also as 10um or 0.01mm; without it lengths are in px."""
    scale: str | None = None
    """Pixel size from a known length, as in 1mm=103px."""
    pitch: str | None = None
    """Pixel size from the sheets' mean spacing, as in 0.2mm: the film's own ridges are the ruler."""
    fps: float | None = None
    """The camera's frame rate, where the file's own is only a playback rate."""
    timestamps: Path | None = None
    """Text file with the time of every frame."""
    frames: str | None = None
    """Part of the video, A:B."""
    rotate: Literal[0, 90, 180, 270] | None = None
    """Turn each frame clockwise first, for sheets that move along y."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class ForceOptions:
    """How a force recording is read and its stick-slip events are found."""

    speed: float | None = None
    """Pulling speed V in mm/min, where no displacement is recorded."""
    d0: str | None = None
    """Initial separation, mm, or 13.0±0.1, added to the crosshead's change; 0: column is separation."""
    force_columns: str | None = None
    """Columns by name or number, as in time=Time,load=Load:kN,displacement=3."""
    force_threshold: float | None = None
    """Smallest drop that is a slip, N; found from the noise if not given."""
    force_lowpass: str | None = None
    """Time constant of the load cell to correct for, s: 0 as recorded; auto where the slips prove it."""
    machine_stiffness: float | None = None
    """The machine's own stiffness in N/mm, to correct d; no correction if not given."""
    fit_range: str | None = None
    """Separations between which the models are fitted, A:B in mm; from where Eq. 1 fits if not given."""
    fix_mu: float | None = None
    """Friction coefficient, where it is known and not to be fitted."""
    fix_yeff: float | None = None
    """Effective modulus Y_eff in GPa, where it is known and not to be fitted."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class SampleOptions:
    """The sample; the publication's if not given."""

    sheets_per_block: Whole | None = None
    """M, sheets of one block on each side of the axis."""
    thickness: str | None = None
    """ε of one sheet, mm, or 0.1±0.002 with its error."""
    width: str | None = None
    """W of the sheets, mm, or with its error."""
    length: str | None = None
    """L from the clamp to the sheets' end, mm, or with its error."""
    t_star: str | None = None
    """T*, friction force of the adhering sheets, N, or with its error."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class TestOptions:
    """What joins the video and the force recording."""

    force: Path | None = None
    """Force recording of the testing machine; adds events, clocks, σ_x/Λ_st and shells."""
    offset: float | None = None
    """Force clock at video time 0, s, if known (0 with a common hardware trigger)."""
    threshold: float | None = None
    """σ_x/Λ_st below which a sheet is stiff; 0.1 if not given."""
    common_mode: Literal["on", "off"] | None = None
    """Whether motion that all sheets share (the camera's) is taken off; on if not given."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Where the results go."""

    out: Path | None = None
    """Run folder; NAME_tracks in the working directory if not given."""
    overwrite: Flag = False
    """Replace an earlier run folder."""
    resume: Flag = False
    """Go on where an interrupted run of the same film ended."""
    follow: Flag = False
    """Track a film or folder that a camera still writes, until it is closed or Ctrl-C is pressed."""
    report: Report = True
    """Write report.html."""
    checksum: Flag = False
    """SHA-256 of all of every input, in place of a fingerprint of 64 MiB."""
    quiet: Flag = False
    """No progress bar and no summary."""
    verbose: Flag = False
    """All of run.json's findings in the summary."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Where the results of a command go."""

    out: Path | None = None
    """Where the results go, in place of the name given above."""
    overwrite: Flag = False
    """Replace what an earlier command wrote there."""
    quiet: Flag = False
    """No progress bar and no summary."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class WindowOptions:
    """What of the strip is shown."""

    sheet: Annotated[tuple[str, ...], Option(negative="", show_default=False)] = ()
    """Window around a sheet: side and number, as right:23, or the index from the left; can be repeated."""
    width: str | None = None
    """Width of the window in mm, um, µm or px; 0.2mm, or one pitch where there is no pixel size."""
    follow: Flag = False
    """The window moves with the sheet, interpolated between pixels, instead of standing still."""
    time: str | None = None
    """Part of the recording in seconds of the video's clock, A:B."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class ModulusOptions:
    """The sheet and the machine of push–pull cycles."""

    thickness: float = 0.1
    """Of the sheet, mm."""
    width: float = 45.0
    """Of the sheet, mm."""
    length: float = 16.8
    """Between the clamps, mm."""
    clamp_distance: float | None = None
    """Distance of the clamps at the first sample, mm, where it is neither the displacement nor the length."""
    machine_stiffness: float | None = None
    """The machine's own stiffness in N/mm, to correct the distance; no correction if absent."""
    part: str = "0.4:0.9"
    """Part of the rise of the force on each loading branch that is fitted."""
    force_columns: str | None = None
    """Columns by name or number, as in time=Time,load=Load:kN,displacement=3."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class FrictionOptions:
    """The discs of a rheometer and what is measured on them."""

    radius: float = 25.0
    """Radius of the discs in mm."""
    normal_force: str | None = None
    """Normal force in N in place of a recorded one: one for all files, or one a file, as in 0.1,0.5,1."""
    dynamic: str = "0.3:120"
    """Travelled angles in degrees over which the dynamic coefficient is the mean."""
    mu: float = 0.89
    """Constant coefficient with which the thresholds are compared."""


def _sets(setting: str) -> Any:
    """An option, not given, for this setting of `vision.experiment`."""
    return field(default=None, metadata={"setting": setting})


@Option(name="*")
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


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class CampaignOptions:
    """How many films are tracked."""

    out: Path | None = None
    """The campaign's folder; TABLE_campaign in the working directory if not given."""
    config: Path | None = None
    """TOML file of options for all films; the table wins."""
    dry_run: Flag = False
    """Say what would run and how long it takes; write nothing."""
    executor: Literal["local", "slurm"] = "local"
    """local or slurm."""
    profile: Path | None = None
    """Folder with a Snakemake profile, in place of the shipped one."""
    cores: int | None = None
    """Jobs at a time; all cores (on a cluster, the profile's number of jobs) if not given."""
    watch: Path | None = None
    """Folder into which films are written: each is taken when it is complete, until Ctrl-C."""
    idle: float | None = None
    """End watching when no film came for so many seconds."""
    stage: Flag = False
    """Copy each film to the node's own disk (TMPDIR) before it is read."""
    report: Report = True
    """Write report.html of each run."""
    quiet: Flag = False
    """No progress and no summary."""
    plan: Annotated[Flag, Option(show=False)] = False
    """Write plan.json and end: for the Snakefile."""


GROUPS = (VideoOptions, ForceOptions, SampleOptions, TestOptions)
# What Python calls otherwise than the command line does.
_OPTION_OF: Mapping[str, str] = {
    "rows": "--strip",
    "axis_px": "--axis",
    "window_px": "--window",
    "pixel_size_um": "--pixel-size",
    "pitch_um": "--pitch",
    "speed_mm_min": "--speed",
    "d0_mm": "--d0",
    "d0_err_mm": "--d0 as 13.0±0.1",
    "force_threshold_N": "--force-threshold",
    "threshold_N": "--force-threshold",
    "force_lowpass_s": "--force-lowpass",
    "lowpass_s": "--force-lowpass",
    "fit_range_mm": "--fit-range",
    "mu": "--fix-mu",
    "modulus_GPa": "--fix-yeff",
    "machine_stiffness_N_per_mm": "--machine-stiffness",
    "offset_s": "--offset",
    "thickness_mm": "--thickness",
    "width_mm": "--width",
    "length_mm": "--length",
    "t_star_N": "--t-star",
    "clamp_distance_mm": "--clamp-distance",
    "normal_force_N": "--normal-force",
    "radius_mm": "--radius",
    "time_s": "--time",
    "width_um": "--width",
    "width_px": "--width",
    "runs": "RUN…",
}
_OF_ONE_COMMAND = ("sheet", "film", "table", "main_sample", "executor", "profile", "watch")


def flag_of(name: str) -> str:
    """How a field of a group is typed: pixel_size as --pixel-size."""
    return f"--{name.replace('_', '-')}"


@cache
def option_names() -> Mapping[str, str]:
    """The library's argument names and the options that set them, for `vision.errors.with_options`."""
    same = (*option_fields(), *(field.name for field in fields(RunOptions)), *_OF_ONE_COMMAND)
    return {name: flag_of(name) for name in same} | dict(_OPTION_OF)


def option_fields() -> list[str]:
    """The options that a file may give, by their names there."""
    return [field.name for group in GROUPS for field in fields(group)]
