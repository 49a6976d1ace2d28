"""Settings of a synthetic traction test, in groups.

The type of a setting states its range. When an `Experiment` is created, first the ranges are checked, then
whether the settings are consistent; an invalid value raises InputError with the name of the setting.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from vision.errors import (
    InputError,
    NonNegative,
    NonNegativeInt,
    Positive,
    PositiveInt,
    check_fields,
    check_within,
)
from vision.files import read_toml
from vision.folder import flattened
from vision.numeric import number
from vision.sample import PUBLISHED, Sample

Fraction = Annotated[float, partial(check_within, "a fraction from 0 to below 1", 0, math.nextafter(1, 0))]
RidgeShape = Literal["gaussian", "flat", "shouldered"]


@dataclass(frozen=True, kw_only=True)
class Mechanics:
    """Friction, stiffness, the pull, and how regular the stick-slip events are."""

    #: Origin of the events: drawn from the publication's equations, or the result of 2M springs whose
    #: thresholds decide which sheets stick. With "sheets", `mu` applies to every face,
    #: `amplitude` is 2(μ_s − μ_d), `modulus_GPa` is that of a sheet, and settings that describe events
    #: (`n_hat_N`, `t0_N`, and `peak_scatter` to `buildup_mm`) are not used.
    model: Literal["equations", "sheets"] = "equations"
    threshold_scatter: Fraction = 0.02  #: relative spread of the sheets' thresholds (model sheets)
    speed_mm_min: Positive = 1.0  #: speed V of the crosshead
    d0_mm: Positive = 13.0  #: separation at which the pull starts
    d_end_mm: Positive = 18.0  #: separation at which the machine stops
    mu: Positive = 0.89  #: friction coefficient
    t0_N: float = 0.0  #: 𝒯0, constant offset of the peaks
    amplitude: Positive = 0.34  #: A, force drop over total normal force
    n_hat_N: Positive = 0.57  #: N̂, normal force above which a sheet is stiff
    modulus_GPa: Positive = 3.8  #: effective modulus of a sheet
    peak_scatter: Fraction = 0.015  #: relative standard deviation of the peak forces
    #: Relative standard deviation of the force drops and hence of the stick lengths.
    period_jitter: Fraction = 0.07
    softening: Fraction = 0.07  #: relative decrease of the slope from the start to the end of a stick phase
    #: Factor by which the first `early_fraction` of each stick phase is steeper, as above 1 mm/min in the
    #: publication; K is then the later slope.
    early_stiffness_ratio: Positive = 1.0
    early_fraction: Fraction = 0.3  #: fraction of the stick phase that is steeper
    #: Distance over which the peaks initially grow to those of Eq. 1; 0: no build-up.
    buildup_mm: NonNegative = 0.0
    slip_s: Positive = 0.001  #: duration of a slip

    @property
    def pull_s(self) -> float:
        """How long the machine pulls."""
        return (self.d_end_mm - self.d0_mm) / (self.speed_mm_min / 60)


@dataclass(frozen=True, kw_only=True)
class Sheets:
    """Positions and motion of the ridges."""

    count: PositiveInt | None = None  #: number of ridges in view; None: all ridges of the sides in view
    #: Number of ridges on one side of the axis (2 M if the sheets of both blocks are visible); None: the
    #: sample's M. The displacement depends on rank / per_side.
    per_side: PositiveInt | None = None
    side: Literal["both", "left", "right"] = "both"  #: side of the axis that is in view
    pitch_px: Positive = 20.0  #: mean distance between ridges
    pitch_jitter: Fraction = 0.06  #: largest deviation of a ridge from a regular comb, in pitches
    outer_ratio: NonNegative = 0.5  #: σ_x/Λ_st of the outermost sheet
    stiff_ratio: NonNegative = 0.1  #: σ_x/Λ_st at M_eff; below it a sheet is stiff
    sweep_scatter: Fraction = 0.0  #: relative scatter of a sheet's sweep from one stick phase to the next
    spread_per_mm: float = 0.004  #: relative widening of the comb per mm of separation
    bow_px: float = 1.0  #: deflection of the bowed outermost ridge over half the frame's height
    slip_delay_s: NonNegative = 0.0  #: largest delay of the slip of a single sheet


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Appearance of the sheets: ridges, paper, light, lens, and movement of the camera."""

    shape: RidgeShape = "gaussian"  #: profile of a ridge
    polarity: Literal["bright", "dark"] = "bright"  #: brightness of the ridges relative to the gaps
    fwhm_px: Positive = 8.0  #: mean full width of the ridges at half maximum
    fwhm_spread: Fraction = 0.05  #: relative spread of the widths
    contrast: Fraction = 0.25  #: (ridge - gap) / (ridge + gap)
    contrast_spread: Fraction = 0.2  #: relative spread of the heights
    faint_sheets: NonNegativeInt = 0  #: number of ridges with a fifth of their height
    level: Fraction = 0.4  #: brightness between the ridges as a fraction of saturation
    surround: NonNegative = 0.5  #: brightness beyond the sample relative to that between the ridges
    gradient: NonNegative = 0.2  #: relative change of the light across the frame
    flicker: Fraction = 0.015  #: relative amplitude of the flicker of the light
    flicker_Hz: Positive = 100.0  #: frequency of the flicker
    tilt_deg: float = 0.2  #: tilt of the ridges against the vertical
    distortion: float = 0.0  #: relative radial magnification error at the frame's far corner
    drift_px: float = 0.5  #: slow movement of the camera over the whole video
    vibration_px: NonNegative = 0.05  #: RMS vibration of the camera
    texture: Fraction = 0.08  #: RMS relative brightness of the paper's texture
    texture_px: Positive = 6.0  #: size (FWHM) of the texture's grains
    dust: NonNegativeInt = 0  #: number of dark spots on the lens


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Sensor, region, and length of the video. Defaults: an IMX392-class sensor behind 10 µm/px."""

    width: PositiveInt = 1920  #: columns
    height: PositiveInt = 100  #: rows
    #: Rows of the strip for which the truth is computed, in the middle of the frame.
    strip_rows: PositiveInt = 84
    pixel_size_um: Positive = 10.0  #: size of a pixel in the plane of the sheets
    fps: Positive = 60.0  #: frames per second
    duration_s: Positive = 20.0  #: length of the video
    exposure_s: NonNegative = 0.004  #: exposure time of a frame
    bits: PositiveInt = 8  #: bits per pixel, 8 to 16
    full_well_e: Positive = 10500.0  #: electrons at saturation
    read_noise_e: NonNegative = 2.5  #: RMS read-out noise, electrons
    prnu: Fraction = 0.007  #: relative spread of the sensitivity of pixels (photo-response non-uniformity)
    noise: bool = True  #: whether photon and read-out noise are added

    @property
    def saturation_level(self) -> int:
        """Highest grey level."""
        return int(2**self.bits - 1)

    @property
    def electrons_per_level(self) -> float:
        """Gain: the full well over the grey levels."""
        return self.full_well_e / self.saturation_level


@dataclass(frozen=True, kw_only=True)
class Clocks:
    """Clocks of camera and machine: t_force = offset_s + (1 + drift_ppm / 1e6) t_video.

    The time of a frame is the middle of its exposure.
    """

    offset_s: float = 36.0  #: force clock at video time 0
    drift_ppm: float = 50.0  #: relative excess of the rate of the force clock
    dropped: Fraction = 0.0  #: fraction of the frames that are lost
    stale: Fraction = 0.0  #: fraction of the time stamps that repeat the previous one
    force_rate_Hz: Positive = 200.0  #: samples per second of the force recording


@dataclass(frozen=True, kw_only=True)
class LoadCell:
    """Load cell and amplifier."""

    lowpass_s: NonNegative = 0.003  #: time constant of the first-order low-pass
    ringing_Hz: NonNegative = 0.0  #: frequency at which the load cell rings after slips; 0 for none
    ringing_damping: Positive = 0.05  #: damping of the ringing, as a fraction of the critical one
    noise_N: NonNegative = 0.05  #: RMS white noise
    drift_N: float = 0.2  #: drift of the zero over the whole pull
    quantum_N: NonNegative = 0.01  #: resolution of the recorded load
    displacement_quantum_mm: NonNegative = 5e-5  #: resolution of the recorded displacement


@dataclass(frozen=True, kw_only=True)
class ForceFile:
    """Format of force.txt."""

    layout: Literal["mts", "instron", "zwick", "csv"] = "mts"  #: layout, named after the testing machine
    decimal: Literal[".", ","] = "."  #: decimal mark
    encoding: Literal["utf-8-sig", "utf-8", "latin-1"] = "utf-8-sig"  #: encoding of the text
    unit: Literal["N", "kN"] = "N"  #: unit of the force
    video_time: bool = False  #: whether the camera's clock is an additional column (mts only)


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """All settings of a synthetic test. The same settings, including the seed, give the same data.

    Raises: InputError for an invalid setting; the message names it and what was expected.
    """

    seed: NonNegativeInt = 0  #: seed of all random numbers
    sample: Sample = PUBLISHED  #: M, the dimensions of the sheets, and T*
    mechanics: Mechanics = field(default_factory=Mechanics)
    sheets: Sheets = field(default_factory=Sheets)
    optics: Optics = field(default_factory=Optics)
    camera: Camera = field(default_factory=Camera)
    clocks: Clocks = field(default_factory=Clocks)
    load_cell: LoadCell = field(default_factory=LoadCell)
    force_file: ForceFile = field(default_factory=ForceFile)

    def __post_init__(self) -> None:
        groups = {f"{part.name}.": getattr(self, part.name) for part in fields(self) if part.name != "seed"}
        for prefix, one in ({"": self} | groups).items():
            with _naming(prefix):
                check_fields(one)
        _check_together(self)

    @property
    def ridges_per_side(self) -> int:
        """Number of ridges on one side: `sheets.per_side` or, if that is None, the sample's M."""
        return self.sheets.per_side or self.sample.sheets_per_block

    @property
    def ridges_in_view(self) -> int:
        """Number of ridges in view: `sheets.count` or, if that is None, all of the sides in view."""
        return self.sheets.count or self.ridges_per_side * (2 if self.sheets.side == "both" else 1)


@contextmanager
def _naming(prefix: str) -> Iterator[None]:
    """Name a setting with its group in an `InputError` about one of its fields."""
    try:
        yield
    except InputError as error:
        about = f"setting {prefix}{error.about.strip('`')}"
        raise InputError(about, error.expected, error.found) from None


def with_settings(experiment: Experiment, changes: Mapping[str, Any]) -> Experiment:
    """Return a copy of the experiment with some settings changed.

    changes: new values by name, such as ``{"camera.fps": 25, "seed": 3}``; text is read as a number, true or
    false where it is one.  Raises: InputError for an unknown name or an invalid value.
    """
    top: dict[str, Any] = {}
    for name, value in changes.items():
        if name == "seed":
            top["seed"] = _read(value)
            continue
        group, key = _known(name, experiment)
        before = top.get(group, getattr(experiment, group))
        given = _read(value)
        kind = type(getattr(before, key))
        if type(given) is int and (kind is float or (kind is bool and given in (0, 1))):
            given = kind(given)
        with _naming(f"{group}."):
            top[group] = replace(before, **{key: given})
    return replace(experiment, **top)


def _read(value: Any) -> Any:
    """Return the number, True or False that a text stands for, else the value; whole numbers as int."""
    if isinstance(value, str) and value.lower() in ("true", "false"):
        return value.lower() == "true"
    if type(value) not in (str, float):
        return value
    read = number(value)
    if math.isnan(read):
        return value
    return int(read) if read.is_integer() else read


def setting_names() -> str:
    """Return the names of all settings in one line for each group."""
    groups = {name: group for name, group in vars(Experiment()).items() if name != "seed"}
    return "\n\n".join(f"{name}: {', '.join(vars(group))}." for name, group in groups.items())


def settings_from_toml(path: Path) -> dict[str, Any]:
    """Read settings by name, as `with_settings` takes them, from a TOML file.

    path: a file with tables [sample], [mechanics], [sheets], [optics], [camera], [clocks] …
    Raises: InputError if it cannot be read or is not TOML.
    """
    content = read_toml(path, "a TOML file of settings", "write lines like: fps = 60 under [camera]")
    return dict(flattened(content, "."))


def _known(name: str, experiment: Experiment) -> tuple[str, str]:
    """Split a name such as "camera.fps" into group and setting."""
    group, _, key = name.partition(".")
    groups = sorted(part.name for part in fields(experiment) if part.name != "seed")
    if group not in groups:
        expected = "seed or GROUP.SETTING with GROUP one of " + ", ".join(groups)
        raise InputError(f"setting {name}", expected, name)
    keys = [part.name for part in fields(getattr(experiment, group))]
    if key not in keys:
        raise InputError(f"setting {name}", f"one of {', '.join(keys)}", key or "no name after the dot")
    return group, key


def _require(e: Experiment, setting: str, ok: bool, expected: str, found: str = "", advice: str = "") -> None:
    """Raise InputError about a setting unless it is ok; `found` is by default its value."""
    if not ok:
        group, _, key = setting.partition(".")
        value = getattr(getattr(e, group), key)
        raise InputError(f"setting {setting}", expected, found or str(value), advice)


def _check_together(e: Experiment) -> None:
    """Check settings that limit each other."""
    m, offset, video_s, length = e.mechanics, e.clocks.offset_s, e.camera.duration_s, e.sample.length_mm
    end = "mechanics.d_end_mm"
    _require(e, end, m.d0_mm < m.d_end_mm, f"more than d0 = {m.d0_mm:g} mm")
    expected, advice = f"less than the sheet length {length:g} mm", "beyond it the blocks are apart"
    _require(e, end, m.d_end_mm < length, expected, advice=advice)
    _require(e, "mechanics.early_stiffness_ratio", m.early_stiffness_ratio >= 1, "1 or more")
    expected = f"a video that sees some of the pull, {-video_s:g} to {m.pull_s:g} s"
    advice = "set the offset (force clock at video time 0) to suit the speed"
    _require(e, "clocks.offset_s", -video_s < offset < m.pull_s, expected, f"{offset:g} s", advice)

    sheets, width, count = e.sheets, e.camera.width, e.ridges_in_view
    comb_px = count * sheets.pitch_px
    found = f"{count} sheets {sheets.pitch_px:g} px apart = {comb_px:g} px"
    advice = "widen the frame or take fewer or closer sheets"
    _require(e, "sheets.count", comb_px <= width, f"sheets that fit in {width} px", found, advice)
    possible = e.ridges_per_side * 2 + 1 if sheets.side == "both" else e.ridges_per_side
    _require(e, "sheets.count", count <= possible, f"at most {possible} with this per_side", str(count))
    _require(e, "optics.faint_sheets", e.optics.faint_sheets <= count, "at most the sheets in view")

    camera, longest = e.camera, 1 / e.camera.fps
    _require(e, "camera.bits", 8 <= camera.bits <= 16, "8 to 16")
    _require(e, "camera.exposure_s", camera.exposure_s <= longest, f"at most 1/fps = {longest:.4g} s")
    _require(e, "camera.duration_s", camera.duration_s * camera.fps >= 1, "at least one frame")


# --- ready-made experiments ---------------------------------------------------------------------------------


def preset(name: str, *, seed: int = 0) -> Experiment:
    """Return one of the ready-made experiments.

    Parameters
    ----------
    name
        - ``"paper"``: 1 mm/min with the publication's numbers, d near 13.7 mm.
        - ``"late"``: d near 17 mm, sweeps under a pixel.
        - ``"fast"``: 10 mm/min, two slopes in every stick phase.
        - ``"fresh"``: a new sample with 600 N peaks, jumps over half a pitch.
        - ``"hostile"``: every disturbance at once.
        - ``"sheets"``: 2M springs determine which sheets stick, with the publication's numbers.

    Raises
    ------
    InputError
        For another name.
    """
    if name not in _PRESETS:
        raise InputError("`preset`", ", ".join(_PRESETS), name)
    return replace(_PRESETS[name], seed=seed)


_PRESETS = {
    "paper": Experiment(),
    "late": Experiment(clocks=Clocks(offset_s=240.0, drift_ppm=50.0), camera=Camera(duration_s=15.0)),
    "fast": Experiment(
        mechanics=Mechanics(speed_mm_min=10.0, early_stiffness_ratio=1.8, slip_s=0.005),
        camera=Camera(fps=160.0, duration_s=5.0, exposure_s=0.002),
        clocks=Clocks(offset_s=4.0, force_rate_Hz=2000.0),
        load_cell=LoadCell(lowpass_s=0.001),
    ),
    "fresh": Experiment(
        mechanics=Mechanics(mu=1.003, period_jitter=0.1, peak_scatter=0.03),
        sheets=Sheets(pitch_px=11.0, pitch_jitter=0.04),
        optics=Optics(fwhm_px=5.5, fwhm_spread=0.03),
        clocks=Clocks(offset_s=6.0),
    ),
    "hostile": Experiment(
        mechanics=Mechanics(peak_scatter=0.03, period_jitter=0.1, softening=0.1),
        sheets=Sheets(pitch_jitter=0.12, sweep_scatter=0.1, bow_px=2.0, slip_delay_s=0.02),
        optics=Optics(
            shape="shouldered",
            fwhm_spread=0.12,
            contrast=0.12,
            contrast_spread=0.35,
            faint_sheets=4,
            gradient=0.4,
            flicker=0.03,
            tilt_deg=1.0,
            distortion=0.01,
            drift_px=1.5,
            vibration_px=0.1,
            texture=0.15,
            dust=40,
        ),
        camera=Camera(fps=25.0, exposure_s=0.01, read_noise_e=8.0, prnu=0.015),
        clocks=Clocks(offset_s=27.3, drift_ppm=-3000.0, dropped=0.01, stale=0.02, force_rate_Hz=100.0),
        load_cell=LoadCell(lowpass_s=0.01, noise_N=0.5, drift_N=2.0),
    ),
    "sheets": Experiment(mechanics=Mechanics(model="sheets")),
}
