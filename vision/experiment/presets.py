"""Ready-made experiments, and how single settings of one are changed by name."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from vision.errors import InputError
from vision.experiment.settings import (
    Camera,
    Clocks,
    Experiment,
    LoadCell,
    Mechanics,
    Optics,
    Sheets,
)


def preset(name: str, *, seed: int = 0) -> Experiment:
    """One of the ready-made experiments.

    paper: 1 mm/min with the publication's numbers, d near 13.7 mm. late: d near 17, sweeps under a pixel.
    fast: 10 mm/min, two slopes in every stick. fresh: a new sample with 600 N peaks, jumps over half a pitch.
    hostile: everything at its worst at once. Raises: InputError for another name.
    """
    if name not in _PRESETS:
        raise InputError("setting preset", ", ".join(_PRESETS), name)
    return replace(_PRESETS[name], seed=seed)


_PRESETS = {
    "paper": Experiment(),
    "late": Experiment(
        clocks=Clocks(offset_s=240.0, drift_ppm=50.0),
        camera=Camera(duration_s=15.0),
    ),
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
}


def with_settings(experiment: Experiment, changes: Mapping[str, Any]) -> Experiment:
    """The experiment with settings changed by name, such as {"camera.fps": 25, "seed": 3}.

    Texts are converted to the setting's own type. Raises: InputError for an unknown name or a value that
    does not convert, and whatever the changed experiment itself refuses.
    """
    groups: dict[str, dict[str, Any]] = {}
    top: dict[str, Any] = {}
    for name, value in changes.items():
        group, _, key = name.partition(".")
        if group == "seed" and not key:
            top["seed"] = _converted(value, 0, name)
            continue
        _known(name, group, key, experiment)
        groups.setdefault(group, {})[key] = _converted(value, getattr(getattr(experiment, group), key), name)
    top |= {group: replace(getattr(experiment, group), **values) for group, values in groups.items()}
    return replace(experiment, **top)


def settings_from_toml(path: Path) -> dict[str, Any]:
    """Settings by name from a TOML file with tables [mechanics], [sheets], [optics], [camera], [clocks] …

    Raises: InputError where the file cannot be read or is not TOML.
    """
    try:
        content = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(path, "a readable TOML file", error.strerror or str(error)) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(path, "TOML", str(error)) from error
    flat: dict[str, Any] = {}
    for name, value in content.items():
        flat |= {f"{name}.{key}": v for key, v in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def _known(name: str, group: str, key: str, experiment: Experiment) -> None:
    groups = {item.name for item in fields(experiment)} - {"seed"}
    if group not in groups:
        expected = "seed or GROUP.SETTING with GROUP one of " + ", ".join(sorted(groups))
        raise InputError(f"setting {name}", expected, name)
    keys = [item.name for item in fields(getattr(experiment, group))]
    if key not in keys:
        raise InputError(f"setting {name}", f"one of {', '.join(keys)}", key or "no name after the dot")


def _converted(value: Any, like: object, name: str) -> Any:
    """The value in the type of the setting it replaces."""
    kind: Any = type(like)
    try:
        if kind is bool:
            return {"true": True, "false": False, "1": True, "0": False}[str(value).lower()]
        if kind is int and float(value) != int(float(value)):
            raise ValueError
        return kind(float(value)) if kind is int else kind(value)
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        wanted = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}[kind]
        raise InputError(f"setting {name}", wanted, str(value)) from error
