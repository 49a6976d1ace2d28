"""A run with planted faults: two sheets swapped, one left out, one in doubt, the axis in the wrong place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tifffile

from tests.scenes.combs import ridges, strip
from tests.scenes.identity_cases import brightness
from vision.command.main import run
from vision.numeric import Floats

SHEETS, FRAMES, WIDTH_PX, ROWS = 12, 240, 1220, 12
AXIS_PX, WRONG_AXIS_PX = 610.0, 510.0
SWAPPED, SWAPPED_FROM = (2, 3), 40
LEFT_OUT, GAP = 8, (150, 171)
DOUBTED, DOUBT = 6, (80, 111)
FAULTS = f"""
[[swap]]
sheets = [{SWAPPED[0]}, {SWAPPED[1]}]
frames = "{SWAPPED_FROM}:{FRAMES}"
[[leave_out]]
sheet = {LEFT_OUT}
frames = "{GAP[0]}:{GAP[1]}"
"""


def true_positions() -> Floats:
    """x (frame, sheet): all move alike, one hops by 27 px for 31 frames, so that it is doubted."""
    x = 60 + 100.0 * np.arange(SHEETS) + np.cumsum(np.random.default_rng(4).normal(0, 2, FRAMES))[:, None]
    x[DOUBT[0] : DOUBT[1], DOUBTED] += 27
    return np.asarray(x)


def doubted_run(folder: Path) -> Path:
    """The run folder of a film of the scene, tracked with the planted faults."""
    light = ridges(true_positions(), width=WIDTH_PX, fwhm_px=10, contrast=brightness(SHEETS))
    profile = np.clip(np.rint(strip(light).values), 0, 255).astype(np.uint8)
    film, faults, out = folder / "film.tif", folder / "faults.toml", folder / "doubted"
    tifffile.imwrite(film, np.repeat(profile[:, None], ROWS, axis=1), photometric="minisblack")
    faults.write_text(FAULTS, encoding="utf-8")
    options = [
        "--sheets",
        f"{SHEETS}",
        "--fps",
        "25",
        "--axis",
        f"{WRONG_AXIS_PX}",
        "--corrections",
        f"{faults}",
    ]
    status = run([f"{film}", *options, "--no-report", "--quiet", "--out", f"{out}"])
    assert status in (0, 1)  # 1: a doubt is left, as it should be
    return out
