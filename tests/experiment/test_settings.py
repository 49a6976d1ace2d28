"""Bad settings get one clear line, settings by name and from files are obeyed, presets keep their promise."""

from dataclasses import replace

import numpy as np
import pytest

from vision.errors import InputError
from vision.experiment import (
    Experiment,
    preset,
    profiles,
    settings_from_toml,
    simulate,
    simulate_pull,
    with_settings,
)
from vision.experiment.mechanics import comb_at_rest, sheet_motion


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"load_cell.noise_N": -1}, "load_cell.noise_N: expected a number from 0; found -1"),
        ({"camera.read_noise_e": -2}, "a number from 0"),
        ({"sheets.count": 200, "sheets.per_side": 200}, "sheets that fit in 1920 px"),
        ({"sheets.count": 52}, "at most 51"),
        ({"mechanics.d_end_mm": 60}, "less than the sheet length 57 mm"),
        ({"mechanics.d_end_mm": 12}, "more than d0"),
        ({"camera.bits": 20}, "8 to 16"),
        ({"camera.exposure_s": 1.0}, "at most 1/fps"),
        ({"camera.fps": float("nan")}, "a positive number"),
        ({"optics.contrast": 1.5}, "a fraction"),
        ({"optics.shape": "square"}, "gaussian, flat, shouldered"),
        ({"mechanics.speed_mm_min": 10}, "sees some of the pull"),
        ({"camera.gain": 3}, "one of width, height"),
        ({"lens.f": 3}, "GROUP.SETTING"),
        (
            {"camera.width": "wide"},
            "setting camera.width: expected a whole number from 1; found the text 'wide'",
        ),
        ({"force_file.layout": "word"}, "mts, instron"),
        ({"sample.thickness_mm": -0.1}, "setting sample.thickness_mm: expected a positive number"),
        ({"sample.sheets_per_block": 2.5}, "sample.sheets_per_block: expected a whole number"),
        ({"sheets.per_side": 0}, "a whole number from 1"),
        ({"seed": -1}, "setting seed: expected a whole number from 0; found -1"),
    ],
)
def test_bad_settings_are_refused_in_one_line(change, says):
    """The message names the setting, what was expected and what was found."""
    with pytest.raises(InputError) as caught:
        with_settings(Experiment(), change)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_preset_and_container_and_existing_folder(tmp_path):
    """Nothing is written before everything is known to be right."""
    with pytest.raises(InputError, match="paper, late, fast, fresh, hostile"):
        preset("nice")
    with pytest.raises(InputError, match="raw, mjpeg"):
        simulate(Experiment(), tmp_path / "a", container="wmv")
    with pytest.raises(InputError, match="at most 8 bits in raw"):
        simulate(with_settings(Experiment(), {"camera.bits": 12}), tmp_path / "a")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match=r"no truth\.nc"):
        simulate(Experiment(), tmp_path / "full", overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["full"]


def test_settings_come_from_toml_in_their_own_types(tmp_path):
    """A failure means a TOML file is read but not obeyed."""
    path = tmp_path / "mine.toml"
    path.write_text('seed = 4\n[camera]\nfps = 25\nbits = 12\n[optics]\npolarity = "dark"\n', "utf-8")
    e = with_settings(preset("late"), settings_from_toml(path))
    assert (e.seed, e.camera.fps, e.camera.bits, e.optics.polarity) == (4, 25.0, 12, "dark")
    assert e.clocks == preset("late").clocks
    path.write_text("camera = [", "utf-8")
    with pytest.raises(InputError, match="a damaged one"):
        settings_from_toml(path)
    with pytest.raises(InputError, match="no such file"):
        settings_from_toml(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("name", "value", "read"),
    [
        ("camera.fps", "25", 25.0),
        ("camera.width", 1900.0, 1900),
        ("camera.noise", "0", False),
        ("camera.noise", "True", True),
        ("force_file.decimal", ",", ","),
    ],
)
def test_settings_have_the_type_of_their_default(name, value, read):
    """A failure means that a typed number of pixels is a float, or that noise cannot be switched off."""
    group, _, key = name.partition(".")
    found = getattr(getattr(with_settings(Experiment(), {name: value}), group), key)
    assert found == read and type(found) is type(read)


def test_what_depends_on_the_number_of_sheets_follows_the_sample():
    """A failure means that a sample of other sheets needs several settings that must agree."""
    e = with_settings(Experiment(), {"sample.sheets_per_block": "10"})
    assert (e.ridges_per_side, e.ridges_in_view) == (10, 20)
    one_side = with_settings(e, {"sheets.side": "left"})
    assert one_side.ridges_in_view == 10
    both_blocks = with_settings(e, {"sheets.per_side": 20})
    assert (both_blocks.ridges_per_side, both_blocks.ridges_in_view) == (20, 40)
    assert with_settings(e, {"sheets.count": 7}).ridges_in_view == 7


def outer_jump_px(e):
    pull = simulate_pull(e.mechanics, seed=e.seed)
    motion = sheet_motion(e, pull, comb_at_rest(e))
    seen = (pull.end_s > e.clocks.offset_s) & (pull.end_s < e.clocks.offset_s + e.camera.duration_s)
    return np.abs(motion.outer_px[1:] - motion.inner_px[:-1])[seen[:-1]].max(axis=1), pull


def test_presets_are_what_they_promise():
    """late: under a pixel; fresh: 600 N and jumps over half a pitch; fast: 10 mm/min with many slips."""
    jumps, _ = outer_jump_px(preset("late"))
    assert jumps.max() < 1.5
    assert np.median(jumps) < 1.05
    jumps, pull = outer_jump_px(preset("fresh"))
    assert np.median(jumps) > 0.5 * preset("fresh").sheets.pitch_px
    assert pull.high_N.max() == pytest.approx(600, rel=0.1)
    jumps, _ = outer_jump_px(preset("fast"))
    assert len(jumps) > 40
    assert preset("fast").mechanics.speed_mm_min == 10
    jumps, _ = outer_jump_px(preset("paper"))
    assert 10 < len(jumps) < 40
    assert 1.5 < np.median(jumps) < 5


def test_the_paper_preset_looks_like_the_experiment():
    """50 upright bright ridges around the frame's centre, in order in every frame."""
    e = replace(preset("paper"), camera=replace(preset("paper").camera, duration_s=2.0))
    intensity, truth = profiles(e)
    x = truth.x_px.values
    assert x.shape[1] == 50
    assert (np.diff(x, axis=1) > 10).all()
    assert x.mean() == pytest.approx(959.5, abs=3)
    line = intensity.values[0]
    at = np.round(x[0]).astype(int)
    between = ((at[1:] + at[:-1]) / 2).astype(int)
    assert line[at].min() > 1.2 * line[between].max()
