"""What is drawn: the same for the same seed, each part independent of the others, in bounded memory."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from vision.experiment import Experiment, profiles
from vision.experiment.scene import make_scene
from vision.experiment.settings import Camera, Optics
from vision.experiment.simulate import frame_blocks

SHORT = Experiment(camera=Camera(duration_s=0.5, height=20, width=1200))


def frames(experiment):
    return np.concatenate(list(frame_blocks(make_scene(experiment))))


def test_same_seed_same_pixels_whatever_the_threads(monkeypatch):
    """A failure means a fixture cannot be remade."""
    once = frames(SHORT)
    monkeypatch.setattr("vision.files.usable_cores", lambda: 1)
    assert np.array_equal(once, frames(SHORT))
    assert not np.array_equal(once, frames(replace(SHORT, seed=1)))


def test_a_change_of_one_part_leaves_the_others():
    """More dust must not move the sheets or change the events."""
    _, truth = profiles(SHORT)
    _, dusty = profiles(replace(SHORT, optics=Optics(dust=30, texture=0.15)))
    assert np.array_equal(truth.x_px, dusty.x_px)
    assert np.array_equal(truth.F_p_N, dusty.F_p_N)


def test_a_longer_video_begins_like_a_shorter_one():
    """Positions in the frames both have agree, drift (stated over the whole video) left out."""
    calm = replace(SHORT, optics=Optics(drift_px=0.0))
    longer = replace(calm, camera=replace(calm.camera, duration_s=1.0))
    assert np.allclose(profiles(calm)[1].x_px, profiles(longer)[1].x_px[:30])


@pytest.mark.thorough
def test_memory_does_not_grow_with_the_video():
    """A failure means a full test (18 000 frames) would not fit: four times the frames, the same peak."""

    def peak(duration_s):
        scene = make_scene(replace(SHORT, camera=replace(SHORT.camera, height=60, duration_s=duration_s)))
        tracemalloc.start()
        for _ in frame_blocks(scene):
            pass
        highest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return highest

    peak(0.1)
    assert peak(8.0) < 1.3 * peak(2.5)


def test_texture_travels_with_the_pulled_block():
    """Every second sheet's texture moves along z with d; the others' stays."""
    e = Experiment(camera=Camera(duration_s=12, fps=5, height=60))
    texture = make_scene(e).texture(slice(None))
    travel = round((e.mechanics.speed_mm_min / 60) * 11.8 * 1000 / 10)
    assert texture[59, :, 1] == pytest.approx(texture[0, :, 1])
    assert np.corrcoef(texture[59, : 60 - travel, 0], texture[0, travel:, 0])[0, 1] > 0.98
    assert np.corrcoef(texture[59, :, 0], texture[0, :, 0])[0, 1] < 0.8
