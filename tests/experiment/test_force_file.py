"""The load cell, and force.txt in the layouts of testing machines."""

import itertools

import pytest

from tests.scenes.experiments import SMALL
from vision.experiment import (
    force_recording,
    simulate,
    simulate_pull,
    with_settings,
)
from vision.force.recording import read_force


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
