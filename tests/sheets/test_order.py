"""Frames that are missing or in the wrong order are found by the motion of the sheets, pictures that come
again by their positions, and frames mixed from two by their noise; vibration is not taken for them."""

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from vision.sheets import track_sheets
from vision.sheets.order import out_of_turn, shown_before, wrong_period

NOISE = 0.01  # px
UNKNOWN = np.full(400, np.nan)  # times


def tracks(frames=200, seed=0, **motion):
    """Positions of creeping and slipping sheets (frame, N), and their errors."""
    x_px = comb(frames, per_side=10, **motion)
    return x_px + np.random.default_rng(seed).normal(0, NOISE, x_px.shape), np.full(x_px.shape, NOISE)


ORDERS = {
    "two neighbours": np.r_[:30, 31, 30, 32:200],
    "two parts": np.r_[:40, 97:150, 40:97, 150:200],
    "one frame of another part": np.r_[:70, 31, 71:200],
    "one frame lost": np.r_[:44, 45:200],
    "a part lost": np.r_[:57, 67:200],
    "names sorted as text": np.array(sorted(range(200), key=str)),
}


@pytest.mark.parametrize("kind", ORDERS)
def test_missing_frames_and_wrong_orders_are_found(kind):
    """A failure means that the times of a film are wrong in silence, or that a slip is named."""
    order = ORDERS[kind]
    x_px, err_px = tracks()
    found = out_of_turn(x_px[order], err_px[order], UNKNOWN[: len(order)])
    assert len(found.rows) > 0 and (np.diff(order)[found.rows - 1] != 1).all()
    assert (found.frames > 1.6).all()


def test_frames_whose_times_show_the_loss_are_in_turn():
    """A failure means a warning of lost frames though the camera's times tell when each was taken."""
    x_px, err_px = tracks()
    order = np.delete(np.arange(200), [20, 44, 45, 46, 90])
    x_px[[100, 101]] = np.nan  # frozen
    assert len(out_of_turn(x_px[order], err_px[order], UNKNOWN[: len(order)]).rows) == 3
    assert not len(out_of_turn(x_px[order], err_px[order], order / 25).rows)


@pytest.mark.parametrize("ratio", [1.5, 3.0])
@pytest.mark.parametrize("stick", [5, 8, 25])
def test_fast_creep_after_slips_is_in_turn(stick, ratio):
    """A failure means a false warning on films in which sheets creep faster in the first third of a stick."""
    part = np.arange(400) % stick / stick
    creep = np.where(part < 1 / 3, ratio * part, ratio / 3 + (part - 1 / 3)) * stick
    x_px = 20.0 * np.arange(20) + 0.05 * creep[:, None] * np.linspace(-1, 1, 20)
    x_px += np.random.default_rng(stick).normal(0, NOISE, x_px.shape)
    assert not len(out_of_turn(x_px, np.full(x_px.shape, NOISE), UNKNOWN).rows)


@pytest.mark.parametrize("period", [3, 4, 1e9], ids=["ringing", "slower ringing", "overshoot"])
@pytest.mark.parametrize("share", [0.05, 0.3])
def test_sheets_that_swing_back_after_slips_are_in_turn(share, period):
    """A failure means that missing frames are said to be before every second frame after a slip."""
    since = (np.arange(400) + 50) % 100
    creep = 0.02 * since - 0.02 * 100 * share * np.exp(-since / 1.5) * np.cos(2 * np.pi * since / period)
    x_px = 20.0 * np.arange(20) + creep[:, None] * np.linspace(-1, 1, 20)
    x_px += np.random.default_rng(0).normal(0, NOISE, x_px.shape)
    assert not len(out_of_turn(x_px, np.full(x_px.shape, NOISE), UNKNOWN).rows)


GROUPS = [[1, 0], [0, 2, 1], [2, 0, 1], [4, 2, 1, 3]]


@pytest.mark.parametrize("lost", [[], [120, 260]], ids=["whole", "with missing positions"])
@pytest.mark.parametrize(("group", "slip"), [(g, 0.8) for g in GROUPS] + [(g, 0.02) for g in GROUPS[:3]])
def test_films_in_the_wrong_order_throughout_are_found(group, slip, lost):
    """A failure means that a film whose fields were put in the wrong order, or that was not put into the
    order of display, passes: also where sheets creep from frame to frame by less than a position's error."""
    x_px, err_px = tracks(400, slip=slip)
    assert not wrong_period(x_px, err_px)
    period = len(group)
    order = np.arange(399 // period * period).reshape(-1, period)[:, np.array(group) % period]
    x_px[lost] = np.nan
    assert wrong_period(x_px[order.ravel()], err_px[order.ravel()]) == period


@pytest.mark.parametrize("stick", range(2, 9))
def test_slips_after_the_same_number_of_frames_are_no_wrong_order(stick):
    """A failure means a false warning where slips follow one another as the frames of a group would."""
    x_px = 20.0 * np.arange(20) + 0.1 * (np.arange(400) % stick)[:, None] * np.linspace(-1, 1, 20)
    x_px += np.random.default_rng(stick).normal(0, NOISE, x_px.shape)
    err_px = np.full(x_px.shape, NOISE)
    assert not wrong_period(x_px, err_px) and not len(out_of_turn(x_px, err_px, UNKNOWN).rows)


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
    x_px = x_px + vibration[:, None] * shape
    assert not len(out_of_turn(x_px, err_px, UNKNOWN).rows) and not wrong_period(x_px, err_px)


def test_missing_positions_say_nothing():
    """A failure means an error, or a warning, where a film is too short or shows no sheets."""
    x_px, err_px = tracks()
    for x, err in ((x_px[:3], err_px[:3]), (np.full_like(x_px, np.nan), np.full_like(x_px, np.nan))):
        assert not len(out_of_turn(x, err, UNKNOWN[: len(x)]).rows)
        assert not wrong_period(x, err) and not len(shown_before(x).rows)


def test_pictures_that_come_again_are_found():
    """A failure means that a part of a film that was written twice passes as a later time."""
    x_px, _ = tracks()
    x_px[10, 3] = np.nan
    assert not len(shown_before(x_px).rows)
    again = shown_before(x_px[np.r_[:90, 90, 5:15, 91:200]])  # the frame before is said to be frozen
    np.testing.assert_array_equal(again.rows, np.arange(91, 101))
    np.testing.assert_array_equal(again.earlier, np.arange(5, 15))


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
