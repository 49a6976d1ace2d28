"""Why a sheet has no position, and faint ridges that are found on a second look."""

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from vision.sheets import TrackingSettings, track_sheets
from vision.sheets.identities import identify_sheets
from vision.sheets.recovery import Flag, assign_detections
from vision.sheets.ridges import describe_ridges, find_ridges

FRAMES, WIDTH = 120, 520


def truth(slip=0.2):
    return comb(FRAMES, per_side=8, axis_px=WIDTH / 2, slip=slip)


def flags(x, **options):
    return track_sheets(strip(ridges(x, width=WIDTH, **options)), sheets=16)["flag"].values


def faded(level):
    """Sheet 5, fainter than the others, fades to this share of its contrast in frames 60 to 79: to less than
    the first search finds."""
    contrast = np.ones((FRAMES, 16))
    contrast[:, 5] = 0.3
    contrast[60:80, 5] *= level
    return contrast


def test_a_sheet_that_fades_is_found_on_a_second_look_and_one_that_is_gone_is_missing():
    """A failure means that shadow loses sheets, or that positions are made up where there is nothing."""
    at = (slice(60, 80), 5)
    assert (flags(truth(), contrast=faded(0.25))[at] == "ok").all()
    assert (flags(truth(), contrast=faded(0.0))[at] == "missing").all()


@pytest.mark.parametrize("frames", [40, 70])
def test_sheets_that_touch_are_one_ridge(frames):
    """One sheet leans against its neighbour and comes back, against what all others do: a failure means that
    the middle of both is called the place of one (in most frames, that what is usual is measured there).
    Without the rule about the ridge's height it is."""
    x = comb(120, per_side=8, axis_px=200)
    touching = np.arange(40, 40 + frames)
    x[touching, 9] = x[touching, 8] + 2.5
    picture = strip(ridges(x, width=400))
    for height, honest in ((TrackingSettings().merged_height, True), (np.inf, False)):
        tracks = track_sheets(picture, settings=TrackingSettings(merged_height=height))
        off = np.abs(tracks.x_px.values - x)
        off = off > np.fmax(5 * tracks.x_err_px.values, 0.5) if honest else off > 0.5
        assert (not (off & (tracks.flag.values == "ok")).any()) is honest
    assert (tracks.flag.values[touching][:, [7, 10]] == "ok").all()


def test_a_sheet_behind_its_neighbour_is_not_given_as_the_other():
    """The outermost sheet comes in and goes behind the next one, which hides it: no ridge is higher than one
    sheet, and the one that is left may be either. A failure means that the wrong one is called ok."""
    x = comb(120, per_side=8, axis_px=200)
    come = np.clip(1.6 * np.sin(np.pi * (np.arange(120) - 15) / 80), 0, 1)
    x[:, 15] -= come * (x[:, 15] - x[:, 14] - 3.0)
    front, behind = (ridges(x[:, k], width=400) for k in (slice(0, 15), slice(15, 16)))
    picture = strip(front + behind * (1 - np.minimum(front, 1)))
    blind = TrackingSettings(merged_width=np.inf, covered_width=np.inf)
    for settings, honest in ((TrackingSettings(), True), (blind, False)):
        tracks = track_sheets(picture, settings=settings)
        off = np.abs(tracks.x_px.values - x) > np.fmax(5 * tracks.x_err_px.values, 0.5)
        given = np.isin(tracks.flag.values, ("ok", "blurred"))
        assert (not (off & given).any()) is honest
        assert given[:, :14].all()


@pytest.mark.parametrize(("hidden", "frames"), [((40, 61), [50, 51]), ((0, 20), [0])])
def test_a_ridge_where_a_sheet_never_was_is_doubtful_if_nothing_beside_confirms_it(hidden, frames):
    """The edge of what hides a third of the comb looks like a ridge, a pitch from where the last sheet was
    and will be. A failure means that it is the sheet's position, as it was, or that sheets that come back
    are doubted."""
    x = comb(FRAMES, per_side=12, axis_px=300, slip=0.2)
    contrast = np.ones(x.shape)
    contrast[slice(*hidden), :8] = 0
    edge = np.zeros((FRAMES, 1))
    edge[frames] = 1
    pitch = np.median(np.diff(x, axis=1))
    picture = ridges(x, width=600, contrast=contrast)
    picture += ridges(x[:, :1] - pitch, width=600, contrast=edge)
    picture -= ridges(x[:, :1], width=600, contrast=0 * edge)  # the background, which came twice
    found = track_sheets(strip(picture))
    assert (found.flag.values[frames, 0] == "doubtful").all()
    assert (found.why.values[frames, 0] == "alone").all()
    assert (found.flag.values == "doubtful").sum() == len(frames)
    assert (found.flag.values[contrast > 0] == "ok").mean() > 0.99


@pytest.mark.parametrize(("away_px", "flag"), [(3.0, Flag.MERGED), (10.0, Flag.MISSING)])
def test_a_sheet_hidden_in_its_neighbour_s_ridge_is_merged_with_it(away_px, flag):
    """A failure means that the middle between two sheets passes for the position of one."""
    x = truth(slip=0.0)
    hidden = np.insert(x, 6, x[:, 6] - away_px, axis=1)  # a sheet that has no ridge of its own
    profile = strip(ridges(x, width=WIDTH)).values
    described = describe_ridges(profile)
    found = find_ridges(profile, described)
    identities = identify_sheets(found, described)
    one_more = replace(
        identities,
        match=np.insert(identities.match, 6, -1, axis=1),
        margin=np.insert(identities.margin, 6, np.nan, axis=1),
        rest_px=hidden,
        usual_px=np.insert(identities.usual_px, 6, np.nan, axis=1),
    )
    got = assign_detections(profile, found, one_more, described).flag
    assert (got[:, 6] == flag).all()
    assert (got[:, 7] == (Flag.MERGED if flag == Flag.MERGED else Flag.OK)).all()
    assert (np.delete(got, (6, 7), axis=1) == Flag.OK).all()


def test_a_sheet_that_leaves_the_picture_is_at_the_edge():
    """A failure means that a sheet out of view counts as lost by the program."""
    x = truth(slip=0.0) - 115.0 * (np.arange(FRAMES) >= 60)[:, None]
    got = flags(x)
    gone = x[:, 0] < 0
    assert gone.any()
    assert (got[gone, 0] == "edge").all()
    assert (got[:60] == "ok").all()


def test_a_sheet_displaced_unlike_its_neighbours_is_doubtful():
    """A failure means that a speck where a sheet was lost passes for the sheet."""
    x = truth(slip=0.0)
    x[60:63, 5] -= 13.0  # two thirds of a pitch, alone
    got = flags(x)
    assert not (got[60:63, 5] == "ok").any()
    # both are one ridge with its neighbour, or this is measured with a larger error
    assert np.isin(np.delete(got, 5, axis=1), ("ok", "blurred", "merged")).all()
    assert (np.delete(got, (4, 5), axis=1) == "ok").all()


@pytest.mark.parametrize("seed", range(3))
def test_half_of_a_sheet_that_splits_is_not_followed(seed):
    """Its halves, half as wide, part within ten frames. A failure means that one of them is called ok, a
    quarter of the pitch from the middle of the sheet."""
    x = comb(FRAMES, per_side=8, pitch_px=15.0, axis_px=150, slip=0.2, uneven=0.05, seed=seed)
    whole, apart = 4 + 3 * seed, 2.7 * np.clip((np.arange(FRAMES) - 50) / 10, 0, 1)[:, None]
    light = ridges(np.delete(x, whole, axis=1), width=300, fwhm_px=2.2, flat_px=5.0)
    for side in (-1, 1):
        own = x[:, [whole]] + side * (apart + 1.25)
        light = light + ridges(own, width=300, fwhm_px=2.2, flat_px=2.5)
    tracks = track_sheets(strip(light, snr=100, seed=seed))
    assert tracks.sizes["sheet"] == 16
    assert (tracks.why.values[65:, whole] == "split").all()
    assert (np.delete(tracks.flag.values, whole, axis=1) == "ok").mean() > 0.99
