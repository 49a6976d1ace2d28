"""`track simulate`."""

import numpy as np
import pytest
import xarray as xr

from vision.command.main import run
from vision.experiment import Experiment


def test_options_toml_and_set_in_that_order(tmp_path, capsys):
    """The preset gives way to TOML, and TOML to options and --set."""
    toml = tmp_path / "a.toml"
    toml.write_text("[camera]\nfps = 20\nheight = 30\n[optics]\ntilt_deg = 0.0\n", "utf-8")
    arguments = ["simulate", str(tmp_path / "t"), "--preset", "late", "--config", str(toml)]
    arguments += ["--duration", "0.4", "--set", "camera.width=1100", "--set", "camera.fps=25"]
    arguments += ["--seed", "3", "--set", "optics.tilt_deg=0.1", "--set", "camera.exposure_s=0.002"]
    arguments += ["--set", "sheets.count=40", "--container", "tiff"]
    assert run(arguments) == 0
    with xr.open_dataset(tmp_path / "t" / "truth.nc", engine="h5netcdf") as truth:
        settings = truth.attrs["settings"]
        assert truth.sizes["frame"] == 10
        assert truth.sizes["sheet"] == 40
        assert np.diff(truth.time_s)[0] == pytest.approx(1 / 25)
    for part in ('"tilt_deg": 0.1', '"height": 30', '"offset_s": 240.0', '"exposure_s": 0.002', '"seed": 3'):
        assert part in settings
    out = capsys.readouterr()
    assert "10 frames of 1100 x 30 px, 40 sheets" in out.out
    assert out.err == ""


def test_settings_are_checked_together(tmp_path):
    """A failure means that 90 sheets are refused, although the next setting allows 45 per side."""
    sizes = ("sheets.count=90", "sheets.per_side=45", "camera.width=2000", "sheets.pitch_px=20")
    arguments = ["simulate", str(tmp_path / "t"), "--duration", "0.1", "--quiet"]
    arguments += [word for size in (*sizes, "camera.height=20") for word in ("--set", size)]
    assert run(arguments) == 0
    with xr.open_dataset(tmp_path / "t" / "truth.nc", engine="h5netcdf") as truth:
        assert truth.sizes["sheet"] == 90


@pytest.mark.parametrize(
    "bad",
    [
        ["--set", "sheets.count=200"],
        ["--container", "wmv"],
        ["--preset", "nice"],
        ["--set", "mechanics.d_end_mm=80"],
        ["--set", "load_cell.noise_N=-1"],
        ["--set", "tilt"],
        ["--config", "none.toml"],
    ],
)
def test_bad_options_end_with_one_line_and_status_2(tmp_path, refused, bad):
    """Never a traceback, nothing left behind."""
    assert "expected" in refused("simulate", tmp_path / "t", *bad)


def test_an_earlier_test_is_kept_and_the_advice_is_this_command_s(tmp_path, refused):
    """A failure means that a folder is lost, or that the advice names an option which is not there."""
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "truth.nc").touch()
    said = refused("simulate", tmp_path / "t")
    assert said.endswith("found one that exists; give --overwrite or another DIRECTORY\n")


def test_help_names_every_setting(capsys):
    """A failure means that settings can only be guessed from messages about wrong ones."""
    assert run(["simulate", "--help"]) == 0
    said = capsys.readouterr().out.split()
    for group in (part for part in vars(Experiment()).values() if not isinstance(part, int)):
        assert {name for name in vars(group) if not {name, f"{name},", f"{name}."} & {*said}} == set()
