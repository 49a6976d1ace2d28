"""Frames whose upper and lower rows show different times are named; light, vibration, and rows that are
exposed in turn are not taken for them."""

import re

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges
from tests.scenes.films import write_avi
from vision.video import open_video, strip_profile

FRAMES, ROWS, WIDTH = 120, 24, 520


def light(shift_px=0.0):
    """Light of sheets that creep and slip, (frame, x), 60 to 180."""
    profile = ridges(comb(FRAMES, per_side=10, axis_px=WIDTH / 2) + shift_px, width=WIDTH)
    return 60 + 120 * (profile - profile.min()) / np.ptp(profile)


def named(rows, folder):
    """The torn frames that are named of a film of these rows, (frame, row, x), with noise."""
    noise = np.random.default_rng(1).normal(0, 2, rows.shape)
    film = write_avi(folder / "film.avi", np.clip(np.rint(rows + noise), 0, 255).astype(np.uint8))
    said = [
        line for line in strip_profile(open_video(film), slice(0, ROWS)).attrs["warnings"] if "torn" in line
    ]
    return [int(frame) for line in said for frame in re.split(r"[()…]", line)[1].split(",")]


@pytest.mark.parametrize("earlier", ["upper", "lower"])
@pytest.mark.parametrize("share", [0.2, 1.0])
def test_torn_frames_are_named(share, earlier, tmp_path):
    """A failure means that a film recorded from a screen is analysed in silence: its positions lie between
    those of two frames, and slips last for two."""
    rng, whole = np.random.default_rng(0), np.repeat(light()[:, None], ROWS, axis=1)
    rows, torn = whole.copy(), np.flatnonzero(rng.random(FRAMES) < share)[1:]
    for frame in torn:
        tear = rng.integers(4, ROWS - 4)
        old = np.s_[:tear] if earlier == "upper" else np.s_[tear:]
        rows[frame, old] = whole[frame - 1, old]
    found = named(rows, tmp_path)
    assert found
    assert set(found) <= set(torn)


def in_order(kind):
    """Rows (frame, row, x) of films whose frames are whole."""
    whole, place = np.repeat(light()[:, None], ROWS, axis=1), np.linspace(-0.5, 0.5, ROWS)[:, None]
    before = np.concatenate([whole[:1], whole[:-1]])
    rng, frame = np.random.default_rng(0), np.arange(FRAMES)[:, None, None]
    if kind == "rolling shutter":  # the lower rows are later, by the same part of a frame in all of them
        return before + (0.6 + 0.4 * 2 * place) * (whole - before)
    if kind == "interlaced":
        return np.where(np.arange(ROWS)[:, None] % 2, whole, (whole + before) / 2)
    if kind == "camera that turns":
        turned = rng.normal(0, 0.5, (FRAMES, 1, 1)) * place
        return whole + turned * np.gradient(whole, axis=2)
    if kind == "light that flickers from row to row":
        return whole * (1 + 0.1 * np.sin(2.3 * frame + 4 * place))
    if kind == "sheets that lean":
        rest = light().mean(axis=0)
        return whole + 0.3 * place * (whole - rest)
    return whole


@pytest.mark.parametrize(
    "kind",
    [
        "whole",
        "rolling shutter",
        "interlaced",
        "camera that turns",
        "light that flickers from row to row",
        "sheets that lean",
    ],
)
def test_whole_frames_are_not_torn(kind, tmp_path):
    """A failure means a warning of films that are in order."""
    assert not named(in_order(kind), tmp_path)
