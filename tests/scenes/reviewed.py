"""A small run with planted mistakes, and the decisions that put them right."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from typing import Any

import xarray as xr

from vision.pipeline import Analysis, Settings, analyse
from vision.run.provenance import Origin, Parameter
from vision.run.writing import write_run
from vision.sheets.corrections import correction_of

FIXTURE = Path(__file__).parents[2] / "fixtures" / "late"
VIDEO, FORCE = FIXTURE / "video.avi", FIXTURE / "force.txt"
SETTINGS = Settings(pixel_size_um=10.0, d0_mm=16.6, fps=60.0)

PLANTED: tuple[dict[str, Any], ...] = (
    {"kind": "swap", "sheets": [3, 4], "frames": "100:"},
    {"kind": "leave_out", "sheet": 7, "frames": "50:60"},
    {"kind": "delete", "sheet": 12},
    {"kind": "axis", "x_px": 540.0},
    {"kind": "clock", "offset_s": 23.0},
)
"""Two sheets exchanged, a gap, a sheet missing, the axis and the clock elsewhere."""


def truth() -> xr.Dataset:
    """x_px (frame, sheet) and everything else that is known of the film."""
    return xr.load_dataset(FIXTURE / "truth.nc", engine="h5netcdf")


def remedies() -> list[dict[str, Any]]:
    """What a person decides who knows the truth, one mistake after the other."""
    x_px = truth()["x_px"].values
    return [
        {"kind": "swap", "sheets": [3, 4], "frames": "100:"},
        {"kind": "assign", "sheet": 7, "frames": "50:60", "x_px": float(x_px[50, 7])},
        {"kind": "add", "frame": 30, "x_px": float(x_px[30, 12])},
        {"kind": "axis", "x_px": float(x_px[0, 24:26].mean())},
        {"kind": "clock", "offset_s": 24.0},
    ]


@cache
def clean() -> Analysis:
    """The film as it is tracked by itself, which is right."""
    return analyse(VIDEO, FORCE, SETTINGS)


def write_planted(folder: Path, planted: tuple[dict[str, Any], ...] = PLANTED) -> Path:
    """A run folder that follows the mistakes as if somebody had decided so."""
    mistakes = [
        correction_of(entry["kind"], {key: entry[key] for key in entry if key != "kind"} | {"date": date})
        for entry, date in zip(planted, _dates(len(planted)), strict=True)
    ]
    settings = dataclasses.replace(SETTINGS, corrections=tuple(mistakes))
    earlier = dataclasses.replace(clean(), settings=SETTINGS)
    analysis = analyse(VIDEO, FORCE, settings, earlier=earlier)
    given = {"force": str(FORCE), "pixel_size": 10.0, "d0": 16.6, "fps": 60.0, "threshold": 0.1}
    origin = Origin(
        command="track late.avi",
        inputs=(VIDEO, FORCE),
        parameters={name: Parameter(value, "given") for name, value in given.items()},
    )
    write_run(analysis, folder, origin, report=False)
    return folder


def _dates(count: int) -> list[str]:
    return [f"2026-01-01T00:00:{k:02}.000+00:00" for k in range(count)]
