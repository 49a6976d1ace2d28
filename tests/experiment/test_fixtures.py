"""The recordings in fixtures/ can be remade by the commands in their README."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.scenes.single_sheets import CyclesTest, DiscTest, write_cycles, write_rheocompass
from vision.command.main import run
from vision.video import open_video

FIXTURES = Path(__file__).parents[2] / "fixtures"
COMMANDS = {
    Path(words[2]).name: words[3:]
    for line in (FIXTURES / "README.md").read_text("utf-8").splitlines()
    if line.startswith("track simulate ") and (words := shlex.split(line))
}


def pixels(folder):
    (video,) = folder.glob("video*")
    return np.concatenate([block.pixels for block in open_video(video).blocks()]).astype(int)


def test_every_fixture_has_its_command_and_they_are_small():
    """A folder without a command cannot be remade; large ones do not belong in a repository."""
    assert {p.name for p in FIXTURES.iterdir() if p.is_dir()} == set(COMMANDS)
    assert sum(p.stat().st_size for p in FIXTURES.rglob("*") if p.is_file()) < 15e6


def _settings(truth):
    groups = json.loads(truth.attrs["settings"])
    seed = {"seed": groups.pop("seed")}
    return seed | {f"{group}.{key}": value for group, of in groups.items() for key, value in of.items()}


@pytest.mark.thorough
@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_remade_it_is_the_same(tmp_path, name):
    """Same truth, same force, same pixels; lossy codecs may change a little with their release."""
    assert run(["simulate", str(tmp_path / name), *COMMANDS[name], "--quiet"]) == 0
    old, new = FIXTURES / name, tmp_path / name
    with xr.open_dataset(old / "truth.nc") as was, xr.open_dataset(new / "truth.nc") as now:
        xr.testing.assert_allclose(was, now, rtol=1e-9)
        gone = {"optics.psf_px": 0.0, "camera.black_level": 0.0}  # settings that only the fixtures name
        assert _settings(was).items() <= (_settings(now) | gone).items()
    assert (old / "force.txt").read_bytes() == (new / "force.txt").read_bytes()
    assert (old / "timestamps.txt").read_text() == (new / "timestamps.txt").read_text()
    difference = pixels(old) - pixels(new)
    if name in ("hostile", "deep"):
        assert np.abs(difference).max() <= 1
        assert (difference != 0).mean() < 1e-4
    else:
        # An encoder spends its bits a little otherwise from run to run; another seed differs by 6 levels.
        assert np.sqrt((difference**2).mean()) < 2


def test_the_commands_to_analyse_them_state_the_true_settings():
    """A failure means that a reader's first command gives lengths, separations or clocks of another test."""
    text = (FIXTURES / "README.md").read_text("utf-8")
    commands = [shlex.split(line) for line in text.splitlines() if line.startswith("track fixtures/")]
    rows = {row[0].strip("` "): row[1:4] for line in text.splitlines() if (row := line.split("|")[1:])}
    assert sorted(Path(words[1]).parent.name for words in commands) == sorted(COMMANDS)
    for words in commands:
        folder, given = (
            FIXTURES.parent / Path(words[1]).parent,
            dict(zip(words[2::2], words[3::2], strict=True)),
        )
        assert all(
            (FIXTURES.parent / path).is_file() for path in (words[1], given["--force"], given["--timestamps"])
        )
        with xr.open_dataset(folder / "truth.nc") as truth:
            made = [
                _settings(truth)["mechanics.d0_mm"],
                *(truth.attrs[k] for k in ("pixel_size_um", "offset_s")),
            ]
        assert [float(given["--d0"]), float(given["--pixel-size"])] == made[:2]
        assert float(given.get("--offset", made[2])) == made[2]
        assert [float(cell) for cell in rows[folder.name]] == made


def test_a_video_of_another_seed_would_be_noticed(tmp_path):
    """The comparison above is not blind: another seed differs by more than two levels RMS."""
    arguments = [*COMMANDS["paper"], "--quiet", "--set", "camera.duration_s=0.2", "--set", "seed=9"]
    assert run(["simulate", str(tmp_path / "x"), *arguments]) == 0
    other = pixels(tmp_path / "x")
    assert np.sqrt(((pixels(FIXTURES / "paper")[: len(other)] - other) ** 2).mean()) > 2


def test_recordings_of_single_sheets_are_those_of_the_generator(tmp_path):
    """A failure means that the README states truths that the files do not have."""
    truth = write_rheocompass(tmp_path / "discs.csv", DiscTest(), encoding="utf-8")
    modulus = write_cycles(tmp_path / "strip.txt", CyclesTest())["Y_p_GPa"]
    for name in ("discs.csv", "strip.txt"):
        assert (FIXTURES / name).read_bytes() == (tmp_path / name).read_bytes()
    assert np.allclose(truth["mu_s"], 0.507 * (1 + 0.143 / truth["N_N"]))
    assert np.allclose(truth["mu_d"], 0.44, atol=0.001)
    assert np.allclose(modulus, 2.5)
