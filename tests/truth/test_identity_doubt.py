"""Combs that fill the picture: only brightness and motion tell their sheets apart, or nothing does."""

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from tests.scenes.identity_cases import FRAMES, brightness, jumps
from vision.checks import tracking_warnings
from vision.sheets import track_sheets
from vision.sheets.settings import DEFAULT

PITCH = 20.0


def cropped(moved, *, slip=0.4, equal=False):
    """50 sheets in a picture that holds 48, moved as a whole."""
    x = comb(FRAMES, slip=slip, axis_px=480) + moved
    return x, strip(ridges(x, width=960, contrast=1.0 if equal else brightness()))


def wrong_positions(tracks, truth):
    """Positions of other sheets, whichever sheet the counting began with (the first may never be seen)."""
    given, x = tracks.flag.values == "ok", tracks.x_px.values
    padded = np.pad(truth, ((0, 0), (3, 3)), constant_values=np.nan)
    starts = range(padded.shape[1] - x.shape[1] + 1)
    errors = (np.abs(x - padded[:, i : i + x.shape[1]]) for i in starts)
    return min(int((given & ~(error < PITCH / 2)).sum()) for error in errors)


MOTIONS = {
    "drift 3 px": np.linspace(-3, 3, FRAMES)[:, None],
    "drift 16 px": np.linspace(-8, 8, FRAMES)[:, None],
    "drift 60 px": np.linspace(-30, 30, FRAMES)[:, None],
    "drift 120 px": np.linspace(-60, 60, FRAMES)[:, None],
    "jumps of half a pitch": jumps(0.5, -0.5),
    "jumps of a pitch": jumps(1, -1),
    "jumps of two pitches": jumps(2, -2),
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", MOTIONS)
def test_brightness_tells_sheets_of_a_cropped_comb(name):
    """A failure means the count of sheets in view outweighs their looks, with the ends out of view."""
    truth, picture = cropped(MOTIONS[name])
    tracks = track_sheets(picture)
    assert wrong_positions(tracks, truth) == 0
    assert (tracks.flag == "ok").values.mean() > 0.85


@pytest.mark.parametrize("slip", [0.4, 0.85])
def test_equal_sheets_of_a_cropped_comb_keep_their_numbers_through_slips(slip):
    """A failure means slips swap equally bright sheets where the ends of the comb are out of view."""
    truth, picture = cropped(0.0, slip=slip, equal=True)
    tracks = track_sheets(picture)
    assert wrong_positions(tracks, truth) == 0
    assert (tracks.flag == "ok").values.mean() > 0.98


@pytest.mark.parametrize("name", ["drift 16 px", "drift 60 px", "drift 120 px"])
def test_equal_sheets_of_a_cropped_drifting_comb_are_told_by_how_far_it_was_carried(name):
    """No picture tells which sheets it shows, only how the film came there.  A failure means that two thirds
    of such a film are withheld, or sheets that come in at an edge renumber those in view."""
    truth, picture = cropped(MOTIONS[name], equal=True)
    tracks = track_sheets(picture)
    assert wrong_positions(tracks, truth) == 0
    assert (tracks.flag == "ok").values.mean() > 0.7


def test_equal_sheets_of_a_cropped_jumping_comb_are_doubted_rather_than_swapped():
    """Half a pitch to the right or to the left: nothing tells which.  What is said without doubt is right."""
    truth, picture = cropped(MOTIONS["jumps of half a pitch"], equal=True)
    tracks = track_sheets(picture)
    assert wrong_positions(tracks, truth) == 0
    assert (tracks.flag == "doubtful").values.mean() > 0.3


def test_where_most_is_doubted_the_rest_is_not_called_certain():
    """A failure means that nobody is told that what is left of such a film may be wrong, too."""
    _, picture = cropped(MOTIONS["jumps of half a pitch"], equal=True)
    assert "other positions may also be wrong" in " ".join(tracking_warnings(track_sheets(picture)))
    _, picture = cropped(MOTIONS["jumps of half a pitch"])
    assert "other positions may also be wrong" not in " ".join(tracking_warnings(track_sheets(picture)))


def test_a_jump_that_cannot_be_seen_is_not_made_up():
    """Equal sheets, ends out of view, jumps of exactly a pitch: the comb looks still, and is given so."""
    _, picture = cropped(MOTIONS["jumps of a pitch"], equal=True)
    tracks = track_sheets(picture)
    step = np.diff(tracks.x_px.values, axis=0)
    assert np.nanmax(np.abs(np.nanmedian(step, axis=1))) < 0.5 * PITCH
    assert tracks.attrs["sheets_alike"] == "yes"
    assert track_sheets(cropped(MOTIONS["jumps of a pitch"])[1]).attrs["sheets_alike"] == "no"


def test_large_steps_of_sheets_that_are_alike_are_named():
    """Half a pitch or more between two frames may as well be the rest of the pitch, the other way. A failure
    means that nobody is told of it, or that combs with a pattern, or with an end in view, get the warning."""
    far = np.where(np.arange(FRAMES) < 50, 0.0, 0.4 * PITCH)[:, None]
    _, picture = cropped(far, equal=True)
    assert "large steps before frame 50:" in " ".join(tracking_warnings(track_sheets(picture)))
    for picture in (cropped(far)[1], strip(ridges(comb(FRAMES, slip=0.4, axis_px=480)[:, 4:], width=960))):
        assert "large steps" not in " ".join(tracking_warnings(track_sheets(picture)))


def test_an_even_comb_with_an_end_in_view_needs_no_doubt():
    """The same jumps are told by one end in view: a failure means ends do not anchor identity."""
    truth = comb(FRAMES, slip=0.4, axis_px=480)[:, 4:] + jumps(1, -1)
    tracks = track_sheets(strip(ridges(truth, width=960)))
    assert wrong_positions(tracks, truth) == 0
    assert (tracks.flag == "ok").values.mean() > 0.85


def test_a_whole_comb_that_was_pushed_is_not_doubted_for_one_sheet():
    """Thirteen sheets, both ends in view, pushed by 0.7 pitch; one is dimmed from then on. A failure means
    that a single sheet of another brightness leaves all positions after the push in doubt."""
    x = comb(FRAMES, per_side=7, axis_px=200, slip=0.15)[:, 1:]
    x[2 * FRAMES // 3 :] -= 0.7 * PITCH
    height = np.tile(brightness(13), (FRAMES, 1))
    height[2 * FRAMES // 3 :, 5] *= 0.3
    tracks = track_sheets(strip(ridges(x, width=400, contrast=height)))
    assert wrong_positions(tracks, x) == 0
    assert (tracks.flag == "ok").values.mean() > 0.99


def fading(seed, *, uneven=0.3, over=1):
    """24 sheets, bright in the middle; in frames 100 to 139 the light has moved on by a pitch, unevenly, one
    sheet too faint to count stands out at the left end, and one at the right is gone. They hardly move. The
    light moves over so many frames."""
    rng = np.random.default_rng(seed)
    n = np.arange(25)
    x = comb(FRAMES, per_side=13, axis_px=300, slip=0.1)[:, :25]
    level = np.exp(-(((n - 12) / 7) ** 2)) * np.exp(0.15 * rng.normal(size=25))
    level[0] = 0.04
    moved = np.r_[level[1:], 0.0] * np.exp(uneven * rng.normal(size=25))
    frame = np.arange(FRAMES)[:, None]
    share = np.clip(np.minimum(frame - 99, 139 + over - frame) / over, 0, 1)
    height = (level + (moved - level) * share) * np.exp(0.03 * rng.normal(size=(FRAMES, 25)))
    return x, strip(ridges(x, width=600, contrast=height), snr=60)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_comb_whose_light_moved_has_not_jumped(seed):
    """A failure means that a comb that stays is given a pitch off, with no doubt, because its ends fade in
    and out and its brightness changes: the best numbering of a bad fit."""
    truth, picture = fading(seed)
    tracks = track_sheets(picture)
    assert wrong_positions(tracks, truth) == 0
    assert (tracks.flag == "ok").values[:100].mean() > 0.9
    credulous = replace(DEFAULT, least_misfit=1.0)
    assert wrong_positions(track_sheets(picture, settings=credulous), truth) > 200


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_comb_whose_light_moves_slowly_keeps_its_numbers(seed):
    """The numbering that fits such frames best is a pitch off, but every ridge of one frame is in the next,
    equally bright. A failure means that a fifth of the film is other sheets, called ok, or is withheld."""
    truth, picture = fading(seed, uneven=0.1, over=20)
    tracks = track_sheets(picture)
    assert wrong_positions(tracks, truth) == 0
    assert (tracks.flag == "ok").values.mean() > 0.95


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_comb_back_at_rest_after_a_large_slip_is_not_doubted(seed):
    """It slips by 0.75 pitches, creeps back, and from then on reflections flicker. A failure means that the
    rest of the film is withheld as displaced by whole pitches, although the sheets are where they were."""
    rng = np.random.default_rng(seed)
    away = np.interp(np.arange(FRAMES), [199, 200, 210], [0.0, 0.75, 0.0])[:, None] * PITCH
    truth = comb(FRAMES, per_side=8, axis_px=300, slip=0.1) + away
    flicker = np.where(np.arange(FRAMES)[:, None] < 200, 0.03, 0.5)
    height = np.exp(flicker * rng.normal(size=(FRAMES, 16)))
    tracks = track_sheets(strip(ridges(truth, width=600, contrast=height * brightness(16))))
    assert wrong_positions(tracks, truth) == 0
    assert (tracks.flag == "doubtful").values.mean() < 0.05


@pytest.mark.parametrize(("spread", "until"), [(0.05, 180), (0.1, FRAMES)])
def test_a_jump_that_only_brightness_shows_is_named(spread, until):
    """Sheets that differ by little, both ends out of view, pushed by 0.95 pitch: they seem to stay. A failure
    means that all positions after it are other sheets and nobody is told, or that a comb that stays is told
    of a jump."""
    frame, level = np.arange(FRAMES), np.exp(spread * np.random.default_rng(1).normal(size=50))
    for pitches in (0.0, 0.95):
        truth = comb(FRAMES, slip=0.4, axis_px=480)
        truth = truth + pitches * PITCH * ((frame >= 150) & (frame < until))[:, None]
        tracks = track_sheets(strip(ridges(truth, width=960, contrast=level)))
        told = "moved on by sheets before frame" in " ".join(tracking_warnings(tracks))
        assert told == bool(pitches)
        assert (wrong_positions(tracks, truth) > 0) == bool(pitches)
        assert set(tracks.attrs["unseen_jumps"]) <= {150, *range(until - 8, until + 1)}


def test_noise_of_equal_sheets_is_no_jump():
    """A thousand frames of equal sheets in much noise. A failure means that chance is named as a jump."""
    picture = strip(ridges(comb(1000, slip=0.4, axis_px=480), width=960), snr=12)
    assert track_sheets(picture).attrs["unseen_jumps"] == []
