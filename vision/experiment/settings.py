# ruff: noqa: N815 (the unit is part of a name, and newton is N)
"""Everything that defines a synthetic traction test, in six small groups of numbers.

Checks happen when an `Experiment` is made: every group on its own, then what must fit together. A value that
cannot be used raises InputError naming the setting.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

from vision.errors import InputError

RidgeShape = Literal["gaussian", "flat", "shouldered"]
Side = Literal["both", "left", "right"]


@dataclass(frozen=True, kw_only=True)
class Mechanics:
    """The sample and the pull: Eq. 1, amplitude, stiffness, and how regular the events are.

    The stick is as long as its force rise over its stiffness. `early_stiffness_ratio` > 1 makes the first
    `early_fraction` of each stick steeper, as above 1 mm/min in the paper; K is then the later slope.
    """

    speed_mm_min: float = 1.0
    d0_mm: float = 13.0
    d_end_mm: float = 18.0
    mu: float = 0.89
    t_star_N: float = 0.003
    t0_N: float = 0.0
    amplitude: float = 0.34
    n_hat_N: float = 0.57
    modulus_GPa: float = 3.8
    sheets_per_side: int = 25
    thickness_mm: float = 0.1
    width_mm: float = 45.0
    length_mm: float = 57.0
    peak_scatter: float = 0.015
    period_jitter: float = 0.07
    softening: float = 0.07
    early_stiffness_ratio: float = 1.0
    early_fraction: float = 0.3
    buildup_mm: float = 0.0
    slip_s: float = 0.001


@dataclass(frozen=True, kw_only=True)
class Sheets:
    """Where the ridges are and how far they move.

    count: ridges in view. per_side: ridges on one side of the axis in the whole sample (25, or 50 where
    both blocks' sheets show); the displacement depends on rank / per_side. outer_ratio: sigma_x / stick
    length of the outermost; the profile falls to `stiff_ratio` at M_eff. slip_delay_s: spread of the
    slips of single sheets.
    """

    count: int = 50
    per_side: int = 25
    side: Side = "both"
    pitch_px: float = 20.0
    pitch_jitter: float = 0.06
    outer_ratio: float = 0.5
    stiff_ratio: float = 0.1
    sweep_scatter: float = 0.0
    spread_per_mm: float = 0.004
    bow_px: float = 1.0
    slip_delay_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Optics:
    """What the sheets look like: ridges, paper, light, lens, and how steadily the camera is held.

    level: brightness between the ridges as a fraction of saturation. contrast: (ridge - gap) / (ridge + gap).
    distortion: relative radial magnification error at the frame's far corner. drift_px: over the whole video.
    """

    shape: RidgeShape = "gaussian"
    polarity: Literal["bright", "dark"] = "bright"
    fwhm_px: float = 8.0
    fwhm_spread: float = 0.05
    contrast: float = 0.25
    contrast_spread: float = 0.2
    faint_sheets: int = 0
    level: float = 0.4
    surround: float = 0.5
    psf_px: float = 0.0
    gradient: float = 0.2
    flicker: float = 0.015
    flicker_Hz: float = 100.0
    tilt_deg: float = 0.2
    distortion: float = 0.0
    drift_px: float = 0.5
    vibration_px: float = 0.05
    texture: float = 0.08
    texture_px: float = 6.0
    dust: int = 0


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Sensor, region, and how long the video is. Defaults: an IMX392-class sensor behind 10 um/px."""

    width: int = 1920
    height: int = 100
    strip_rows: int = 84
    pixel_size_um: float = 10.0
    fps: float = 60.0
    duration_s: float = 20.0
    exposure_s: float = 0.004
    bits: int = 8
    full_well_e: float = 10500.0
    read_noise_e: float = 2.5
    prnu: float = 0.007
    black_level: float = 0.0
    noise: bool = True


@dataclass(frozen=True, kw_only=True)
class Clocks:
    """The camera's clock against the machine's, and what each loses on the way to its file.

    t_force = offset_s + (1 + drift_ppm / 1e6) t_video. A frame's time is the middle of its exposure.
    """

    offset_s: float = 36.0
    drift_ppm: float = 50.0
    dropped: float = 0.0
    stale: float = 0.0
    force_rate_Hz: float = 200.0


@dataclass(frozen=True, kw_only=True)
class LoadCell:
    """The force chain: first-order low-pass, drift, white noise, and the steps in which values are
    written."""

    lowpass_s: float = 0.003
    noise_N: float = 0.05
    drift_N: float = 0.2
    quantum_N: float = 0.01
    displacement_quantum_mm: float = 5e-5


@dataclass(frozen=True, kw_only=True)
class ForceFile:
    """How force.txt is written: layout (mts, instron, zwick, csv), decimal mark, encoding, unit of force.

    video_time adds the camera's clock as a column of its own (mts only).
    """

    layout: str = "mts"
    decimal: Literal[".", ","] = "."
    encoding: Literal["utf-8-sig", "utf-8", "latin-1"] = "utf-8-sig"
    unit: Literal["N", "kN"] = "N"
    video_time: bool = False


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """A whole synthetic test. The same experiment, seed included, gives the same data."""

    seed: int = 0
    mechanics: Mechanics = field(default_factory=Mechanics)
    sheets: Sheets = field(default_factory=Sheets)
    optics: Optics = field(default_factory=Optics)
    camera: Camera = field(default_factory=Camera)
    clocks: Clocks = field(default_factory=Clocks)
    load_cell: LoadCell = field(default_factory=LoadCell)
    force_file: ForceFile = field(default_factory=ForceFile)

    def __post_init__(self) -> None:
        for group in (self.mechanics, self.sheets, self.optics, self.camera, self.clocks, self.load_cell):
            _check_ranges(group)
        _require(self.seed >= 0, "seed", "a whole number from 0", self.seed)
        _check_pull(self.mechanics)
        _check_view(self.sheets, self.optics, self.camera)
        _check_camera(self.camera)
        _check_force_file(self.force_file)
        _check_overlap(self.mechanics, self.camera, self.clocks)


_MAY_BE_NEGATIVE = {
    "t0_N",
    "tilt_deg",
    "distortion",
    "drift_px",
    "offset_s",
    "drift_ppm",
    "bow_px",
    "drift_N",
}
_MAY_BE_NEGATIVE |= {"spread_per_mm"}
_MAY_BE_ZERO = {
    *("t0_N", "peak_scatter", "period_jitter", "softening", "early_fraction", "buildup_mm", "pitch_jitter"),
    *("stiff_ratio", "outer_ratio", "sweep_scatter", "slip_delay_s", "fwhm_spread", "contrast_spread"),
    *("faint_sheets", "surround", "psf_px", "gradient", "flicker", "vibration_px", "texture", "dust", "prnu"),
    *("read_noise_e", "black_level", "dropped", "stale", "lowpass_s", "noise_N", "quantum_N"),
    *("displacement_quantum_mm", "exposure_s", "noise"),
}
_FRACTIONS = {
    *("peak_scatter", "period_jitter", "softening", "early_fraction", "pitch_jitter", "contrast", "level"),
    *("contrast_spread", "fwhm_spread", "flicker", "texture", "dropped", "stale", "prnu", "sweep_scatter"),
}


def _require(condition: bool, setting: str, expected: str, found: object, advice: str = "") -> None:
    if not condition:
        raise InputError(f"setting {setting}", expected, str(found), advice)


def _check_ranges(group: object) -> None:
    """Signs, fractions below one and numbers that are numbers, for every setting of a group."""
    for item in fields(group):  # type: ignore[arg-type]  # any dataclass instance will do
        value = getattr(group, item.name)
        if isinstance(value, str):
            continue
        name = f"{type(group).__name__.lower()}.{item.name}"
        _require(value == value and abs(value) != float("inf"), name, "a finite number", value)
        if item.name in _FRACTIONS:
            _require(0 <= value < 1, name, "a fraction from 0 to below 1", value)
        elif item.name in _MAY_BE_ZERO and item.name not in _MAY_BE_NEGATIVE:
            _require(value >= 0, name, "zero or more", value)
        elif item.name not in _MAY_BE_NEGATIVE:
            _require(value > 0, name, "more than zero", value)


def _check_pull(m: Mechanics) -> None:
    _require(m.d0_mm < m.d_end_mm, "mechanics.d_end_mm", f"more than d0 = {m.d0_mm:g} mm", m.d_end_mm)
    _require(
        m.d_end_mm < m.length_mm,
        "mechanics.d_end_mm",
        f"less than the sheet length {m.length_mm:g} mm",
        m.d_end_mm,
        "beyond it the blocks are apart",
    )
    _require(
        m.early_stiffness_ratio >= 1, "mechanics.early_stiffness_ratio", "1 or more", m.early_stiffness_ratio
    )


def _check_view(sheets: Sheets, optics: Optics, camera: Camera) -> None:
    comb, room = sheets.count * sheets.pitch_px, camera.width
    _require(
        comb <= room,
        "sheets.count",
        f"sheets that fit in {room} px",
        f"{sheets.count} sheets {sheets.pitch_px:g} px apart = {comb:g} px",
        "widen the frame or take fewer or closer sheets",
    )
    possible = sheets.per_side * (2 if sheets.side == "both" else 1) + (sheets.side == "both")
    _require(sheets.count <= possible, "sheets.count", f"at most {possible} with this per_side", sheets.count)
    _require(sheets.side in ("both", "left", "right"), "sheets.side", "both, left or right", sheets.side)
    shapes = ("gaussian", "flat", "shouldered")
    _require(optics.shape in shapes, "optics.shape", ", ".join(shapes), optics.shape)
    _require(optics.polarity in ("bright", "dark"), "optics.polarity", "bright or dark", optics.polarity)
    _require(
        optics.faint_sheets <= sheets.count,
        "optics.faint_sheets",
        "at most the sheets in view",
        optics.faint_sheets,
    )


def _check_camera(camera: Camera) -> None:
    _require(8 <= camera.bits <= 16, "camera.bits", "8 to 16", camera.bits)
    longest = 1 / camera.fps
    _require(
        camera.exposure_s <= longest,
        "camera.exposure_s",
        f"at most 1/fps = {longest:.4g} s",
        camera.exposure_s,
    )
    _require(
        camera.duration_s * camera.fps >= 1, "camera.duration_s", "at least one frame", camera.duration_s
    )
    _require(
        camera.black_level < 2**camera.bits - 1, "camera.black_level", "below saturation", camera.black_level
    )


def _check_force_file(style: ForceFile) -> None:
    name = "force_file."
    choices = {"layout": ("mts", "instron", "zwick", "csv"), "decimal": (".", ","), "unit": ("N", "kN")}
    choices["encoding"] = ("utf-8-sig", "utf-8", "latin-1")
    for setting, allowed in choices.items():
        found = getattr(style, setting)
        _require(found in allowed, name + setting, " or ".join(allowed), found)


def _check_overlap(m: Mechanics, camera: Camera, clocks: Clocks) -> None:
    pull_s = (m.d_end_mm - m.d0_mm) / (m.speed_mm_min / 60)
    _require(
        -camera.duration_s < clocks.offset_s < pull_s,
        "clocks.offset_s",
        f"a video that sees some of the pull, {-camera.duration_s:g} to {pull_s:g} s",
        f"{clocks.offset_s:g} s",
        "set the offset (force clock at video time 0) to suit the speed",
    )
