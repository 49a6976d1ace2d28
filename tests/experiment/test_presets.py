"""The ready-made experiments are what they promise."""

from dataclasses import replace

import numpy as np
import pytest

from vision.experiment import preset, profiles, simulate_pull
from vision.experiment.motion import comb_at_rest, sheet_motion


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
