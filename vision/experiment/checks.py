"""What makes settings usable: signs and ranges, then what must fit together."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING

from vision.errors import InputError

if TYPE_CHECKING:
    from vision.experiment.settings import (
        Camera,
        Clocks,
        Experiment,
        ForceFile,
        Mechanics,
        Optics,
        Sheets,
    )


def check_experiment(e: Experiment) -> None:
    """InputError naming the first setting that cannot be used, with what was expected."""
    for group in (e.mechanics, e.sheets, e.optics, e.camera, e.clocks, e.load_cell):
        _check_ranges(group)
    _require(e.seed >= 0, "seed", "a whole number from 0", e.seed)
    _check_pull(e.mechanics)
    _check_view(e.sheets, e.optics, e.camera)
    _check_camera(e.camera)
    _check_force_file(e.force_file)
    _check_overlap(e.mechanics, e.camera, e.clocks)


_GROUPS = {
    **{name.title(): name for name in ("mechanics", "sheets", "optics", "camera", "clocks")},
    "LoadCell": "load_cell",
}
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
        name = f"{_GROUPS[type(group).__name__]}.{item.name}"
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
