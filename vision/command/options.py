"""What can be typed: groups of options that commands share, and how the library's names become options."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter as Option


def _whole(kind: Any, tokens: Sequence[Any]) -> int:
    """A whole number as it is written: 1.5 is none, where a conversion would round it.

    Raises
    ------
    ValueError
        For anything else.
    """
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
    """Time constant of the load cell that is undone, s: 0 as recorded; auto where the slips prove it."""
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
    "d0_err_mm": "--d0",
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
DEFAULTS: Mapping[str, Any] = {
    "strip": "auto",
    "force_lowpass": "0",
    "ridges": "auto",
    "fit": "auto",
    "rotate": 0,
    "threshold": 0.1,
    "common_mode": "on",
    "sheets_per_block": 25,
    "thickness": 0.1,
    "width": 45.0,
    "length": 57.0,
    "t_star": 0.003,
}


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
