"""Groups of command-line options, and the option that sets each argument of the library."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group
from cyclopts import Parameter as Option


def _whole(kind: Any, tokens: Sequence[Any]) -> int:
    """Return a typed whole number; `int` would round 1.5 instead of refusing it.  Raises: ValueError."""
    text = str(tokens[0].value).strip()
    if not re.fullmatch(r"[-+]?[0-9]{1,9}(?:\.0{1,9})?", text):
        raise ValueError("give a whole number")
    return int(text.partition(".")[0])


def _sets(setting: str, default: Any = None) -> Any:
    """Return a field whose option sets what the library calls `setting`."""
    return field(default=default, metadata={"setting": setting})


Whole = Annotated[int, Option(converter=_whole)]
Switch = Annotated[bool, Option(negative="", show_default=False)]
Report = Annotated[bool, Option(show_default=False)]  # also --no-report
Quiet = Annotated[Switch, Option(help="Print no progress bar and no summary.")]
Run = Annotated[Path, Option(help="Run folder.")]
Config = Annotated[
    Path | None,
    Option(help="TOML file of any of these options, with paths relative to it; the command line wins."),
]
MovedFilm = Annotated[Path | None, Option(help="Path of the film, if it was moved since it was tracked.")]


@Option(name="*", group=Group.create_ordered("Video"))
@dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """How a video is read and its sheets are found."""

    strip: str | None = _sets("rows")
    """Rows to average, Z0:Z1, half-open, from the top; auto finds where ridges are straight and clear."""
    columns: str | None = None
    """Columns to use, X0:X1, half-open, from the left."""
    strips: Whole | None = None
    """Also measure in this many parts of the strip, one above the other: x(n,z,t) in tracks.nc."""
    sheets: Whole | None = None
    """Number of ridges in view; found if not given."""
    ridges: Literal["bright", "dark", "auto"] | None = None
    """Whether ridges are brighter or darker than the gaps between them: bright, dark or auto."""
    axis: float | None = _sets("axis_px")
    """Symmetry axis in px; by default from the motion, or the middle of the ridges where that shows none."""
    fit: Literal["auto", "sliding", "paper", "template"] | None = None
    """auto (template where it is learned well, else sliding), sliding, paper (as published) or template."""
    window: str | None = _sets("window_px")
    """Fit window in px, odd, or auto to follow the ridge width; 9 if ridges are 6 to 14 px wide and round."""
    corrections: Path | None = None
    """TOML file of manual decisions: accept, leave_out, swap, assign, add, delete, axis, strip, clock."""
    pixel_size: str | None = _sets("pixel_size_um")
    """µm per pixel: 10, 10um, 0.01mm or 10±0.1um; else as ImageJ or OME stored it, or lengths in px."""
    scale: str | None = None
    """Pixel size from a known length, such as 1mm=103px; with errors as 1mm=103±1px or 1±0.01mm=103px."""
    pitch: str | None = _sets("pitch_um")
    """Pixel size from the known mean distance between neighbouring sheets, such as 0.2mm or 0.2±0.002mm."""
    fps: float | None = None
    """The camera's frame rate, frames/s, where the file states only a playback rate."""
    timestamps: Path | None = None
    """Text file with the time of every frame: in s, with the unit above (time_ms), or 14:59:58.017."""
    frames: str | None = None
    """Part of the video, A:B, half-open, counted from 0."""
    rotate: Literal[0, 90, 180, 270] | None = None
    """Degrees by which each frame is first turned clockwise, for sheets that move along y."""


@Option(name="*", group=Group.create_ordered("Video with force"))
@dataclass(frozen=True, kw_only=True)
class TestOptions:
    """Options that relate the video to the force recording."""

    force: Path | None = None
    """Force recording of the testing machine; adds events, clocks, σ_x/Λ_st and shells."""
    offset: float | None = _sets("offset_s")
    """Time on the force clock at video time 0, s, if known (0 with a common hardware trigger)."""
    threshold: float | None = None
    """σ_x/Λ_st below which a sheet is stiff; 0.1 if not given."""
    common_mode: Literal["on", "off"] | None = None
    """Whether motion common to all sheets (the camera's) is subtracted; on if not given."""


@Option(name="*", group=Group.create_ordered("Force recording"))
@dataclass(frozen=True, kw_only=True)
class ForceOptions:
    """How a force recording is read and its stick-slip events are found."""

    speed: float | None = _sets("speed_mm_min")
    """Pulling speed V in mm/min, if no displacement is recorded."""
    d0: str | None = _sets("d0_mm")
    """Initial separation in mm, also 13.0±0.1; 0 if the displacement column is the separation itself."""
    force_columns: str | None = None
    """Columns by name or number, such as time=Time,load=Load:kN,displacement=3."""
    force_threshold: float | None = _sets("force_threshold_N")
    """Smallest drop between fitted lines that counts as a slip, N; found from the noise if not given."""
    force_lowpass: str | None = _sets("force_lowpass_s")
    """Load-cell time constant to correct for, s; 0: no correction; auto: only if the slips show it."""
    force_average: str | None = _sets("force_average_s")
    """Time in s over which a load that rings after slips is averaged; auto: the period of the ringing."""
    machine_stiffness: float | None = _sets("machine_stiffness_N_per_mm")
    """Stiffness of the machine in N/mm, to correct d; no correction if not given."""
    fit_range: str | None = _sets("fit_range_mm")
    """Separations A:B in mm between which the models are fitted; from where Eq. 1 fits if not given."""
    fix_mu: float | None = _sets("mu")
    """Known friction coefficient, which is then not fitted."""
    fix_yeff: float | None = _sets("modulus_GPa")
    """Known effective modulus Y_eff in GPa, which is then not fitted."""


@Option(name="*", group=Group.create_ordered("Sample"))
@dataclass(frozen=True, kw_only=True)
class SampleOptions:
    """The sample; the publication's if not given."""

    sheets_per_block: Whole | None = None
    """M, number of sheets of one block on each side of the axis."""
    thickness: str | None = _sets("thickness_mm")
    """Thickness ε of one sheet, mm; with its error as 0.1±0.002."""
    width: str | None = _sets("width_mm")
    """Width W of the sheets, mm; with its error as 45±0.2."""
    length: str | None = _sets("length_mm")
    """Length L from the clamp to the end of the sheets, mm; with its error as 57±0.5."""
    t_star: str | None = _sets("t_star_N")
    """Friction force T* due to adhesion, N; with its error as 0.003±0.001."""


@Option(name="*", group=Group.create_ordered("Run folder"))
@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Where the results go."""

    out: Path | None = None
    """Run folder; NAME_tracks in the working directory if not given."""
    overwrite: Switch = False
    """Replace an earlier run folder."""
    resume: Switch = False
    """Continue an interrupted run of the same film."""
    follow: Switch = False
    """Track a film or folder while a camera writes it, until nothing was added for 10 s or Ctrl-C."""
    report: Report = True
    """Write report.html."""
    checksum: Switch = False
    """Store the SHA-256 of every whole input file instead of a fingerprint of 64 MiB of it."""
    quiet: Quiet = False
    verbose: Switch = False
    """Print all findings of run.json in the summary."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Where the results of a command go."""

    out: Path | None = None
    """Where the results go, instead of the name given above."""
    overwrite: Switch = False
    """Replace what an earlier command wrote there."""
    quiet: Quiet = False


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class WindowOptions:
    """Part of the strip that is shown."""

    sheet: Annotated[tuple[str, ...], Option(negative="", show_default=False)] = ()
    """Sheet to show: side and number, such as right:23, or the index from the left; can be repeated."""
    width: str | None = None
    """Width of the window in cm, mm, um, µm or px; 0.2mm, or one pitch without a pixel size."""
    follow: Switch = False
    """Move the window with the sheet (interpolated between pixels) instead of keeping it in place."""
    time: str | None = _sets("time_s")
    """Part of the recording, A:B in seconds of the video's clock."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class PaperOptions:
    """How figures for a manuscript are drawn."""

    width: str | None = _sets("width_mm")
    """Width on paper, such as 86mm; panels that lack the room side by side are stacked. 152mm if not given,
    and up to 330mm of several panels."""
    font_size: float = 10.0
    """Size of the labels' letters, pt; numbers at marks and legends are smaller."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """How several tests are compared."""

    table: Path | None = None
    """CSV or .xlsx with any of the columns run,sample,V_mm_min,n_test,RH_percent,T_C; n_test counts the
    sample's tests before this one."""
    main_sample: str | None = None
    """Sample whose Y_eff is used for all tests; that of the first run if not given."""
    fix_yeff: float | None = None
    """Y_eff in GPa, if it is known."""
    report: Report = True
    """Write report.html."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class ModulusOptions:
    """The sheet and the machine of push–pull cycles."""

    thickness: float | str = 0.1
    """Thickness of the sheet, mm; with its error as 0.1±0.002."""
    width: float | str = 45.0
    """Width of the sheet, mm; with its error as 45±0.2."""
    length: float | str = 16.8
    """Length of the sheet between the clamps, mm; with its error as 16.8±0.1."""
    clamp_distance: float | None = _sets("clamp_distance_mm")
    """Distance of the clamps at the first sample, mm, if it is neither the displacement nor the length."""
    machine_stiffness: float | None = None
    """Stiffness of the machine in N/mm, to correct the distance; no correction if not given."""
    part: str = "0.4:0.9"
    """Part of the rise of the force on each loading branch that is fitted."""
    force_columns: str | None = None
    """Columns by name or number, such as time=Time,load=Load:kN,displacement=3."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class FrictionOptions:
    """The discs of a rheometer and how friction is measured on them."""

    radius: float = _sets("radius_mm", 25.0)
    """Radius of the discs in mm."""
    normal_force: str | None = _sets("normal_force_N")
    """Normal force in N, instead of the recorded one: one value, or one per file, such as 0.1,0.5,1."""
    dynamic: str = "0.3:120"
    """Range of rotation angles in degrees over which the dynamic coefficient is averaged."""
    mu: float = 0.89
    """Constant friction coefficient for comparison."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """The main settings of a synthetic test; those not given are the preset's."""

    preset: str = "paper"
    """paper, late, fast, fresh, hostile or sheets."""
    container: str = "raw"
    """raw (Y800 AVI), mjpeg, h264, ffv1, tiff or png."""
    config: Path | None = None
    """TOML file of settings in the tables sample, mechanics, sheets, optics, camera, clocks, load_cell."""
    set_: Annotated[tuple[str, ...], Option(name="--set", negative="", show_default=False)] = ()
    """Any setting above by group and name, such as --set camera.fps=25 --set optics.tilt_deg=0.5."""
    overwrite: Switch = False
    """Replace an earlier synthetic test."""
    quiet: Quiet = False
    seed: int | None = None
    """Seed of the random numbers: the same seed gives the same data."""
    duration: float | None = _sets("camera.duration_s")
    """Length of the video, s."""


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class CampaignOptions:
    """How the films of a campaign are tracked."""

    out: Path | None = None
    """The campaign's folder; TABLE_campaign in the working directory if not given."""
    config: Path | None = None
    """TOML file of options for all films; values in the table take precedence."""
    dry_run: Switch = False
    """Print what would run and how long it would take; write nothing."""
    executor: Literal["local", "slurm"] = "local"
    """Where the jobs run: on this machine (local) or on a cluster (slurm)."""
    profile: Path | None = None
    """Folder with a Snakemake profile, instead of the shipped one."""
    cores: int | None = None
    """Number of jobs at a time; all cores (on a cluster, as in the profile) if not given."""
    watch: Path | None = None
    """Folder into which films are written: each is tracked when it is complete, until Ctrl-C."""
    idle: float | None = None
    """Stop watching when no new film has come for this many seconds."""
    stage: Switch = False
    """Copy each film to the node's local disk (TMPDIR) before it is read."""
    report: Report = True
    """Write report.html of each run."""
    quiet: Quiet = False
    plan: Annotated[Switch, Option(show=False)] = False
    """Write plan.json and end: for the Snakefile."""


GROUPS = (VideoOptions, ForceOptions, SampleOptions, TestOptions)
SETTING_OF: Mapping[str, str] = {
    one.name: one.metadata.get("setting", one.name) for group in GROUPS for one in fields(group)
}
"""Options that a configuration file or a campaign's table may contain, and what the library calls each."""
_ALL_GROUPS = (
    RunOptions,
    OutputOptions,
    WindowOptions,
    PaperOptions,
    CompareOptions,
    ModulusOptions,
    FrictionOptions,
    SimulateOptions,
    CampaignOptions,
    *GROUPS,  # the last: if two options set arguments of one name, messages name that of `track`
)
_OTHER_NAMES: Mapping[str, str] = {
    "d0_err_mm": "--d0 with its error, like 13.0±0.1",
    "pixel_size_err_um": "--pixel-size with its error, like 10±0.1",
    "pitch_err_um": "--pitch with its error, like 0.2±0.002mm",
    "threshold_N": "--force-threshold",
    "lowpass_s": "--force-lowpass",
    "average_s": "--force-average",
    "width_um": "--width",
    "width_px": "--width",
    "runs": "RUN…",
    "out_dir": "DIRECTORY",
    "film": "--film",
    "port": "--port",
}
"""Arguments of the library that are no field of a group, and how a command's user gives them."""


def names_given(*groups: Any) -> list[str]:
    """Return the names of the options of these groups that differ from their defaults."""
    pairs = ((group, one) for group in groups for one in fields(group))
    return [one.name for group, one in pairs if getattr(group, one.name) != one.default]


def with_point(text: str) -> str:
    """Return how a text whose numbers have decimal commas is written; "" if none has."""
    pointed = re.sub(r"(?<![\w.,])([0-9]*),([0-9]+)(?![0-9.,])", r"\1.\2", text.strip())
    return f"write it with a decimal point: {pointed}" if pointed != text.strip() else ""


def flag_of(name: str) -> str:
    """Return the option of a group's field: --pixel-size for pixel_size."""
    return f"--{name.replace('_', '-')}"


@cache
def option_names() -> Mapping[str, str]:
    """Map each argument of the library to its option, `pixel_size_um` to ``--pixel-size``.

    The library's messages name its arguments in backticks. Before the command prints or stores a message,
    `vision.errors.with_options` finds these names and puts the options in their place.
    """
    every = [one for group in _ALL_GROUPS for one in fields(group)]
    flags = {one.name: flag_of(one.name) for one in every}
    settings = {one.metadata.get("setting", one.name): flags[one.name] for one in every}
    return {**flags, **settings, **_OTHER_NAMES}
