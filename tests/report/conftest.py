"""One small synthetic test, tracked and analysed, shared by the tests of the report."""

import math

import numpy as np
import pytest
from vision.report.results import RunResults

from vision.clock import Clock
from vision.deformation import horizontal_deformation
from vision.experiment import Camera, Experiment, profiles
from vision.experiment.force_file import force_recording, write_force
from vision.experiment.scene import make_scene
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


@pytest.fixture(scope="session")
def experiment():
    return Experiment(camera=Camera(duration_s=6.0))


@pytest.fixture(scope="session")
def video_only(experiment):
    """A run without force and without pixel size."""
    profile, _ = profiles(experiment)
    return RunResults(profile=profile, tracks=track_sheets(profile), frame=frame_like(profile))


@pytest.fixture(scope="session")
def pulled(experiment, video_only, tmp_path_factory):
    """A run with everything."""
    path = tmp_path_factory.mktemp("pulled") / "force.txt"
    write_force(
        path, force_recording(experiment, make_scene(experiment).pull), experiment.force_file, name="test"
    )
    force = read_force(path, d0_mm=experiment.mechanics.d0_mm)
    sticks = find_stick_slip(force)
    fits = fit_models(sticks)
    clock = make_clock(experiment)
    motion = horizontal_deformation(video_only.tracks, sticks, clock, pixel_size_um=PIXEL_UM)
    return RunResults(
        profile=video_only.profile,
        tracks=video_only.tracks,
        frame=video_only.frame,
        facts={
            "command": "track test.avi <script>alert(1)</script>",
            "parameters": {"fit": {"value": "sliding", "how": "default"}},
            "warnings": ["3 frames </script> lost"],
        },
        pixel_size_um=PIXEL_UM,
        force=force,
        sticks=sticks,
        clock=clock,
        motion=motion,
        shells=classify_shells(motion, effective_sheets=fits.effective_sheets),
        fits=fits,
    )
