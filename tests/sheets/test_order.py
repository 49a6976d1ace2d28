"""Frames in the wrong order are found by the motion of the sheets, and frames mixed from two by their noise;
vibration is not taken for them."""

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from vision.sheets import track_sheets
from vision.sheets.order import exchanged_frames

NOISE = 0.01  # px


def tracks(frames=200, seed=0, **motion):
    """Positions of creeping and slipping sheets (frame, N), and their errors."""
    x_px = comb(frames, per_side=10, **motion)
    return x_px + np.random.default_rng(seed).normal(0, NOISE, x_px.shape), np.full(x_px.shape, NOISE)


@pytest.mark.parametrize("first", [[30, 80, 149, 174], range(1, 198, 2), range(1, 196, 3)])
def test_exchanged_neighbours_are_found(first):
    """A failure means that positions belong to other times than stated, and nothing says so."""
    x_px, err_px = tracks()
    order, first = np.arange(len(x_px)), np.array(first)
    order[first], order[first + 1] = order[first + 1], order[first]
    found = exchanged_frames(x_px[order], err_px)
    assert set(found) <= set(first) and len(found) > 0.7 * len(first)


@pytest.mark.parametrize("lost", [[], [120, 260]], ids=["whole", "with missing positions"])
@pytest.mark.parametrize("parity", [0, 1])
def test_films_exchanged_pair_by_pair_are_found(parity, lost):
    """A failure means that a film whose fields were put in the wrong order passes where sheets creep slowly:
    from frame to frame by less than the error of a position."""
    x_px, err_px = tracks(400, slip=0.02)
    assert not len(exchanged_frames(x_px, err_px))
    first = np.arange(parity, 399, 2)
    order = np.arange(400)
    order[first], order[first + 1] = order[first + 1], order[first]
    x_px[lost] = np.nan
    np.testing.assert_array_equal(exchanged_frames(x_px[order], err_px), first)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", ["none", "noise", "wandering", "ringing", "alternating", "common"])
def test_vibration_is_no_wrong_order(kind, seed):
    """A failure means a false warning on films whose sheets or camera vibrate."""
    x_px, err_px = tracks(400, seed)
    rng, frame = np.random.default_rng(seed), np.arange(400)
    noise = rng.normal(0, 0.2, 400)
    decay = np.exp(-(frame % 25) / 6) * np.cos(0.93 * np.pi * (frame % 25))
    vibration = {
        "none": 0 * noise,
        "noise": noise,
        "wandering": np.cumsum(noise),
        "ringing": decay,
        "alternating": 0.3 * (-1.0) ** frame,
        "common": noise,
    }[kind]
    shape = np.ones(20) if kind == "common" else np.linspace(-1, 1, 20)
    assert not len(exchanged_frames(x_px + vibration[:, None] * shape, err_px))


def test_missing_positions_say_nothing():
    """A failure means an error, or a warning, where a film is too short or shows no sheets."""
    x_px, err_px = tracks()
    assert not len(exchanged_frames(x_px[:3], err_px[:3]))
    assert not len(exchanged_frames(np.full_like(x_px, np.nan), np.full_like(x_px, np.nan)))


@pytest.mark.parametrize("kind", ["still", "mixed", "vibrating", "dimmed"])
def test_frames_mixed_from_two_are_named(kind):
    """A failure means that every fourth position lies between two moments in silence, or a false warning."""
    x_px = comb(200, per_side=10, axis_px=260)
    if kind == "vibrating":
        x_px = x_px + 0.5 * np.sin(2.1 * np.arange(200))[:, None]
    film = strip(ridges(x_px, width=520), snr=60)
    grey, every = film.values.copy(), np.arange(3, 200, 4)
    if kind == "mixed":
        grey[every] = (grey[every] + grey[every - 1]) / 2
    if kind == "dimmed":
        grey[every] *= 0.9
    share = track_sheets(film.copy(data=grey)).attrs["mixed_frames"]
    assert abs(share - 0.25 * (kind == "mixed")) < 0.03
