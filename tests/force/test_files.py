"""Every layout of a testing machine is read back to the numbers that were written."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from tests.scenes.machine_files import LAYOUTS, LOAD, PULL, TIME, written
from vision.data import ForceMetadata
from vision.errors import InputError
from vision.force import read_force


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layout_gives_back_the_numbers(layout: str, tmp_path: Path) -> None:
    """A failure means a unit, separator, decimal mark or column of that machine is misread."""
    force = read_force(written(tmp_path, *LAYOUTS[layout]), d0_mm=13)
    np.testing.assert_allclose(force["time_s"], TIME, atol=1e-4)
    np.testing.assert_allclose(force["load_N"], LOAD, rtol=1e-3)
    np.testing.assert_allclose(force["d_mm"], 13 + PULL, atol=2e-5)
    assert force.attrs["separation_from"] == "displacement"
    assert set(force["flag"].values) == {"ok"}


def test_facts_of_the_file_are_told(tmp_path: Path) -> None:
    """A failure means the run folder would not say how a recording was understood."""
    facts = ForceMetadata.of(read_force(written(tmp_path, *LAYOUTS["mpt"])))
    assert facts.layout == "MTS 793"
    assert facts.encoding == "utf-8"  # nothing in that file is outside ASCII
    assert (facts.separator, facts.decimal, facts.blocks) == ("tab", ",", "2 of 3")
    assert "load = Ch 1 Kraft [kN]" in facts.columns
    assert facts.notes == ["`d0_mm` not given: d counts from the crosshead's zero"]


def test_video_time_is_kept_apart_from_time(tmp_path: Path) -> None:
    """A failure means the camera's clock in an MTS file is lost or taken for the machine's."""
    force = read_force(written(tmp_path, *LAYOUTS["mts"]))
    np.testing.assert_allclose(force["video_time_s"], 0.999958 * TIME + 8.0853, atol=1e-4)


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_matlab(version: str, tmp_path: Path) -> None:
    """A failure means .mat files, the only form of some public data, cannot be used."""
    path = tmp_path / "test.mat"
    if version == "5":
        savemat(path, {"t": TIME[:, None], "run": {"load_kN": LOAD / 1e3}, "note": "hello"})
    else:
        with h5py.File(path, "w") as file:
            file["t"], file["run/load_kN"] = TIME[None, :], LOAD[None, :] / 1e3
    force = read_force(path, speed_mm_min=1.2)
    np.testing.assert_allclose(force["load_N"], LOAD)
    np.testing.assert_allclose(force["d_mm"], TIME * 0.02)
    assert force.attrs["separation_from"] == "speed"


def test_missing_or_damaged_files(tmp_path: Path) -> None:
    """A failure means a traceback for a wrong path or a broken .mat."""
    with pytest.raises(InputError, match="no such file"):
        read_force(tmp_path / "absent.txt")
    for damaged in ("not a mat file", "\x89HDF\r\n\x1a\n and no more"):
        path = tmp_path / "bad.mat"
        path.write_bytes(damaged.encode("latin-1"))
        with pytest.raises(InputError, match="MATLAB"):
            read_force(path)
