"""The folder of a synthetic test: all of its files or none, and every one read back as it was drawn."""

import itertools

import numpy as np
import pytest
import xarray as xr

from tests.scenes.experiments import SMALL
from vision.errors import InputError
from vision.experiment import force_recording, preset, simulate, simulate_pull, with_settings
from vision.experiment.scene import make_scene
from vision.experiment.simulate import frame_blocks
from vision.force.recording import read_force
from vision.video import open_video


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


def test_only_synthetic_tests_are_overwritten(tmp_path):
    """A failure means that `overwrite` deletes the run folder of a real test."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").touch()
    with pytest.raises(InputError, match=r"a synthetic test to overwrite; .*no truth\.nc"):
        simulate(SMALL, tmp_path / "run", overwrite=True)
    assert (tmp_path / "run" / "run.json").exists()


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


def drawn(experiment):
    return np.concatenate(list(frame_blocks(make_scene(experiment))))


def read(path):
    return np.concatenate([block.pixels for block in open_video(path).blocks()])


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("container", "bits"),
    [
        ("raw", 8),
        ("ffv1", 8),
        ("ffv1", 10),
        ("ffv1", 12),
        ("ffv1", 16),
        ("tiff", 8),
        ("tiff", 12),
        ("png", 8),
        ("png", 16),
    ],
)
def test_lossless_containers_hold_the_frames_exactly(tmp_path, container, bits):
    """A failure means the reader or the writer changes values."""
    e = with_settings(SMALL, {"camera.bits": bits})
    test = simulate(e, tmp_path / "t", container=container)
    pixels = read(test.video)
    assert pixels.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert np.array_equal(pixels, drawn(e))


@pytest.mark.parametrize(("container", "tolerance"), [("mjpeg", 3.0), ("h264", 8.0)])
def test_lossy_containers_hold_them_nearly(tmp_path, container, tolerance):
    """RMS difference in grey levels; h264 also rescales to its limited range, undone here."""
    test = simulate(SMALL, tmp_path / "t", container=container)
    pixels = read(test.video).astype(float)
    frames = drawn(SMALL).astype(float)
    if container == "h264":
        pixels = (pixels - 16) * 255 / 219
    assert pixels.shape == frames.shape
    assert np.sqrt(((pixels - frames) ** 2).mean()) < tolerance


def test_load_cell_low_pass_noise_and_quantum():
    """A failure means the force file is cleaner or dirtier than its settings say."""
    quiet = with_settings(SMALL, {"load_cell.noise_N": 0, "load_cell.drift_N": 0, "load_cell.quantum_N": 0})
    pull = simulate_pull(quiet.mechanics, seed=0)
    record = force_recording(quiet, pull)
    exact = pull.force_N(record["time_s"].to_numpy())
    lag = 0.003 * pull.stiffness_N_per_mm[0] / 60
    steady = (record["time_s"] > 0.5) & (record["time_s"] < 2.5)
    assert (exact - record["load_N"])[steady].mean() == pytest.approx(lag, rel=0.05)
    loud = force_recording(
        with_settings(quiet, {"load_cell.noise_N": 0.5, "load_cell.quantum_N": 0.01}), pull
    )
    assert (loud["load_N"] - record["load_N"]).std() == pytest.approx(0.5, rel=0.1)
    assert (loud["load_N"] * 100 % 1).round(6).isin([0, 1]).all()


STYLES = itertools.product(
    ("mts", "instron", "zwick", "csv"), ((".", "utf-8-sig", "N"), (",", "latin-1", "kN"))
)


@pytest.mark.parametrize(("layout", "style"), list(STYLES))
def test_force_files_are_read_back_in_every_layout(tmp_path, layout, style):
    """Machine layouts, decimal comma, latin-1 and kN, as physicists' files have them."""
    decimal, encoding, unit = style
    changes = {"layout": layout, "decimal": decimal, "encoding": encoding, "unit": unit}
    e = with_settings(SMALL, {f"force_file.{key}": value for key, value in changes.items()})
    test = simulate(with_settings(e, {"camera.duration_s": 0.05}), tmp_path / "t")
    record = force_recording(e, simulate_pull(e.mechanics, seed=0))
    force = read_force(test.force, d0_mm=13.0)
    assert force["load_N"].values == pytest.approx(record["load_N"].to_numpy(), abs=1e-6)
    assert force["d_mm"].values == pytest.approx(13 + record["crosshead_mm"].to_numpy(), abs=1e-6)


def test_mts_file_looks_like_the_machine_wrote_it(tmp_path):
    """BOM, CRLF, trailing tab and spaces, the camera's clock as a column of its own."""
    test = simulate(with_settings(SMALL, {"force_file.video_time": "true"}), tmp_path / "t")
    data = test.force.read_bytes()
    assert data.startswith(b"\xef\xbb\xbfFile Path:")
    assert b"\r\nCrosshead \tLoad \tTime \tVideo Time \t\r\nmm\tN\tsec\tsec\r\n" in data
    assert b"\n" not in data.replace(b"\r\n", b"")
