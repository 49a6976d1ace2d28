"""One small synthetic test, tracked and analysed: what figures and reports are made from."""

import math
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from vision.clock import Clock
from vision.deformation import horizontal_deformation
from vision.experiment import Experiment, force_recording, profiles, write_force
from vision.experiment.scene import make_scene
from vision.experiment.settings import Camera
from vision.figures import Results
from vision.force import find_stick_slip
from vision.force.recording import read_force
from vision.models.fits import fit_models
from vision.sheets.tracks import track_sheets
from vision.shells import classify_shells

PIXEL_UM = 10.0


def make_clock(experiment, **changes):
    """The true clock of a synthetic test."""
    known = {
        "offset_s": experiment.clocks.offset_s,
        "drift_ppm": experiment.clocks.drift_ppm,
        "residual_ms": 1.2,
        "matched": 6,
        "unmatched_video": 0,
        "unmatched_force": 0,
        "margin": 40.0,
        "status": "ok",
        "how": "events",
        "error_ms": math.nan,
    }
    return Clock(**known | changes)


def frame_like(profile, rows=120, seed=0):
    """A frame whose rows all look like the first profile."""
    noise = np.random.default_rng(seed).normal(0, 6, (rows, profile.shape[1]))
    return np.clip(np.repeat(profile.values[:1], rows, axis=0) + noise, 0, 255).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Found(Results):
    """What a run found, with a pixel size and a threshold of its own."""

    threshold: float = 0.1
    pixel_size_um: float | None = None
    pixel_size_err_um: float | None = None


EXPERIMENT = Experiment(camera=Camera(duration_s=6.0))


@cache
def video_only():
    """A run without force and without pixel size."""
    profile, _ = profiles(EXPERIMENT)
    return Found(strip=profile, tracks=track_sheets(profile), frame=frame_like(profile))


@cache
def with_force():
    """A run with everything."""
    video = video_only()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "force.txt"
        recording = force_recording(EXPERIMENT, make_scene(EXPERIMENT).pull)
        write_force(path, recording, EXPERIMENT.force_file)
        force = read_force(path, d0_mm=EXPERIMENT.mechanics.d0_mm)
    sticks = find_stick_slip(force)
    fits = fit_models(force, sticks)
    clock = make_clock(EXPERIMENT)
    motion = horizontal_deformation(video.tracks, sticks, clock, pixel_size_um=PIXEL_UM)
    return Found(
        strip=video.strip,
        tracks=video.tracks,
        frame=video.frame,
        pixel_size_um=PIXEL_UM,
        force=force,
        sticks=sticks,
        clock=clock,
        motion=motion,
        shells=classify_shells(motion, effective_sheets=fits.effective_sheets),
        fits=fits,
    )


FACTS = {
    "command": "track test.avi <script>alert(1)</script>",
    "parameters": {"fit": {"value": "sliding", "how": "default"}},
    "warnings": ["3 frames </script> lost"],
}
