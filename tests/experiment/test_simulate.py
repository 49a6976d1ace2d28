"""The folder of a synthetic test: all of its files or none, with the truth in them."""

import numpy as np
import pytest
import xarray as xr

from tests.scenes.experiments import SMALL
from vision.errors import InputError
from vision.experiment import preset, simulate, with_settings


def test_truth_file_holds_everything(tmp_path):
    """Other programs read truth.nc: names, dimensions, settings."""
    test = simulate(SMALL, tmp_path / "t")
    with xr.open_dataset(test.truth, engine="h5netcdf") as truth:
        assert truth.sizes["frame"] == test.frames == 24
        assert truth.sizes["sheet"] == 12
        for name in (
            "x_px",
            "t_v_s",
            "t_p_s",
            "d_v_mm",
            "F_p_N",
            "K_N_per_mm",
            "M_eff",
            "sigma_x_um",
            "ratio",
            "shell",
        ):
            assert np.isfinite(truth[name]).all()
        assert truth["x_px"].attrs["units"] == "px"
        assert '"mu": 0.89' in truth.attrs["settings"]
        assert ((truth.ratio < 0.1) == truth.shell).all()


def test_clocks_lose_and_repeat_as_asked(tmp_path):
    """Dropped frames shift the file's count, stale stamps repeat, times keep the stated offset and drift."""
    e = with_settings(SMALL, {"clocks.dropped": 0.2, "clocks.stale": 0.1, "clocks.drift_ppm": 3000})
    e = with_settings(e, {"camera.duration_s": 4.0, "camera.height": 2})
    test = simulate(e, tmp_path / "t")
    with xr.open_dataset(test.truth, engine="h5netcdf") as truth:
        assert test.frames + test.frames_lost == 240
        assert 25 < test.frames_lost < 75
        assert truth.time_s.values == pytest.approx(truth.exposed.values / 60)
        assert truth.time_force_s.values == pytest.approx(5.0 + 1.003 * truth.time_s.values)
        repeated = np.diff(truth.stamp_s.values) == 0
        assert 5 < repeated.sum() < 40
        stamps = np.loadtxt(test.timestamps)
        assert stamps == pytest.approx(truth.stamp_s.values, abs=1e-6)
        assert truth.slip_video_s.values * 1.003 + 5 == pytest.approx(truth.slip_s.values)


def test_overwrite_replaces_only_when_asked(tmp_path):
    """An earlier test is kept unless the user says otherwise."""
    simulate(SMALL, tmp_path / "t")
    with pytest.raises(InputError, match="`overwrite`"):
        simulate(SMALL, tmp_path / "t")
    simulate(with_settings(SMALL, {"seed": 2}), tmp_path / "t", overwrite=True)
    with xr.open_dataset(tmp_path / "t" / "truth.nc", engine="h5netcdf") as truth:
        assert truth.attrs["seed"] == 2
    assert [p.name for p in tmp_path.iterdir()] == ["t"]


def test_an_interrupted_run_leaves_nothing(tmp_path):
    """No half-written folder after Ctrl-C."""

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(preset("paper"), tmp_path / "t", progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_progress_counts_every_frame(tmp_path):
    """The callback ends at the total."""
    seen = []
    simulate(SMALL, tmp_path / "t", progress=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (24, 24)
