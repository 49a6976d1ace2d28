# ruff: noqa: N815 (the unit is part of a name, and newton is N)
"""Everything that defines a synthetic traction test, in six small groups of numbers.

Checks happen when an `Experiment` is made: every group on its own, then what must fit together. A value that
cannot be used raises InputError naming the setting.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from vision.experiment.checks import check_experiment

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
        check_experiment(self)
