"""Deformation and shells of a simulated test, from I(x, t): ridges, identities, fits and all."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from vision.deformation import horizontal_deformation
from vision.experiment import preset, profiles
from vision.sheets.tracks import track_sheets
from vision.shells import classify_shells


@dataclass(frozen=True)
class TrueClock:
    """The simulated clocks as they are."""

    offset_s: float
    drift_ppm: float
    status: str = "given"
    residual_ms: float = 2.0

    def to_force_s(self, video_time_s):
        return self.offset_s + (1 + self.drift_ppm * 1e-6) * np.asarray(video_time_s)


@pytest.fixture(scope="module", params=["paper", "late", "fast"])
def simulated(request):
    experiment = preset(request.param, seed=1)
    seconds = {"paper": 12.0, "late": 8.0, "fast": 3.0}[request.param]
    camera = replace(experiment.camera, duration_s=seconds)
    strip, truth = profiles(replace(experiment, camera=camera))
    columns = ["t_v_s", "t_p_s", "d_v_mm", "stick_length_um"]
    sticks = truth[columns].to_dataframe().reset_index(names="event")
    clock = TrueClock(truth.attrs["offset_s"], truth.attrs["drift_ppm"])
    size = truth.attrs["pixel_size_um"]
    motion = horizontal_deformation(track_sheets(strip), sticks, clock, pixel_size_um=size)
    return truth.isel(event=motion["event"].to_numpy()), motion


def test_ratios_and_errors(simulated):
    """A failure means that errors of the whole chain from the picture on are larger than it says."""
    truth, motion = simulated
    wrong = motion["ratio"].to_numpy() - truth["ratio"].to_numpy()
    assert motion.sizes["event"] >= 8
    assert abs(wrong.mean()) < 0.002
    assert 0.60 < np.mean(np.abs(wrong) < motion["ratio_err"].to_numpy()) < 0.78


def test_shells(simulated):
    """A failure means that the shells of a clean test are off by more than one sheet."""
    truth, motion = simulated
    shells = classify_shells(motion)
    sizes = [truth["shell"].sel(sheet=truth["side"] == side).sum("sheet").to_numpy() for side in (-1, 1)]
    expected = np.stack(sizes, axis=1).ravel()
    assert np.mean(np.abs(shells["stiff_sheets"].astype(float) - expected) <= 1) >= 0.9
    inside = (shells["stiff_low"] <= expected) & (expected <= shells["stiff_high"])
    assert inside.mean() >= 0.9
