"""Where the recording is cut into segments in which candidates can be followed."""

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from tests.scenes.identity_cases import brightness, jumps
from vision.sheets import track_sheets
from vision.sheets.identities import fill_rows, identify_sheets, split_segments
from vision.sheets.ridges import describe_ridges, find_ridges
from vision.sheets.settings import TrackingSettings

FRAMES, WIDTH = 120, 560


def candidates(truth, *, width=WIDTH, contrast=1.0):
    profile = strip(ridges(truth, width=width, contrast=contrast)).values
    described = describe_ridges(profile)
    return find_ridges(profile, described), described


def starts(truth, *, width=WIDTH, contrast=1.0):
    found, described = candidates(truth, width=width, contrast=contrast)
    return split_segments(found, described).start


def small(slip):
    return comb(FRAMES, per_side=8, axis_px=WIDTH / 2, slip=slip)


def test_small_slips_need_no_cut_and_large_ones_are_cut_where_they_are():
    """A failure means that a slip is followed to the nearest ridge, or every frame is a riddle of its own."""
    assert starts(small(0.1)).tolist() == [0]
    assert starts(small(0.85)).tolist() == [0, 25, 50, 75, 100]


def test_sheets_that_cross_the_picture_s_edge_do_not_cut():
    """A failure means that a drifting comb falls into segments too short to be told apart."""
    drift = np.linspace(0, 60, FRAMES)[:, None]
    found, described = candidates(comb(FRAMES, slip=0.0, axis_px=480) + drift, width=960)
    segments = split_segments(found, described)
    assert len(segments.start) == 1
    assert len(np.unique(found.count)) > 1
    assert segments.place[-1] != segments.place[0]


def test_a_jump_of_a_pitch_is_cut_by_the_change_of_brightness():
    """A failure means that every sheet takes its neighbour's number and nobody notices."""
    truth = comb(FRAMES, slip=0.0, axis_px=480) + jumps(1, -1, frames=FRAMES)
    assert starts(truth, width=960, contrast=brightness()).tolist() == [0, 30, 60, 90]
    assert starts(truth, width=960).tolist() == [0]  # equal sheets: it cannot be seen


def test_an_identity_that_leaves_no_other_has_a_large_margin():
    """A failure means that sound recordings are flagged as doubtful."""
    truth = small(0.4)
    found, described = candidates(truth)
    identities = identify_sheets(found, described)
    assert identities.match.shape == truth.shape
    assert (identities.match == np.arange(16)).all()
    assert identities.margin.min() > 5
    assert np.abs(identities.rest_px - truth).max() < 10


@pytest.mark.parametrize(("gone", "parted"), [(0, 160), (1, 160), (0, 120)])
def test_sheets_that_stay_when_the_blocks_part_keep_their_identities(gone, parted):
    """Every second sheet leaves the picture in mid-film, and the others relax outwards. A failure means that
    a comb with twice the spacing is taken for a stretched one, and sheets for their neighbours, or that
    sheets seen before are lost."""
    truth = comb(220, per_side=10, pitch_px=16.0, axis_px=230, uneven=0.1)
    truth[parted:] += 1.2 * (truth[parted:] - 230) / 10
    truth[parted:, gone::2] = np.nan
    tracks = track_sheets(strip(ridges(truth, width=460, contrast=brightness(20))))
    assert tracks.sizes["sheet"] == 20
    off = np.abs(tracks["x_px"].values - truth)
    assert np.nanmax(off) < 0.5 and not np.isfinite(tracks["x_px"].values[np.isnan(truth)]).any()
    assert np.isfinite(off[:parted]).mean() > 0.98


def test_gaps_in_rows_are_filled_along_straight_lines():
    """A failure means that a missing sheet is looked for in the wrong place."""
    at = np.array([0.0, 1, 3, 7])
    rows = np.array([[0, np.nan, 3, np.nan], [np.nan, 2, np.nan, np.nan], [np.nan] * 4])
    filled = fill_rows(rows, at)
    assert filled[0] == pytest.approx([0, 1, 3, 3])
    assert filled[1] == pytest.approx([2, 2, 2, 2])
    assert np.isnan(filled[2]).all()


def test_a_comb_of_slightly_unlike_sheets_that_jumps_by_its_pitch():
    """Neither end is in view, and sheets differ in height by 6 %. A failure means that a comb which jumps by
    its pitch seems to stay, every sheet is taken for the next one, and all positions are called ok."""
    rng = np.random.default_rng(1)
    moved_px = 18.0 * (np.searchsorted([30, 60, 90], np.arange(120), side="right") % 2)
    rest_px = 18.0 * np.arange(60) - 260 + rng.normal(0, 0.9, 60)
    x_px = rest_px + moved_px[:, None]
    film = strip(ridges(x_px, width=520, fwhm_px=5.4, contrast=np.exp(rng.normal(0, 0.06, 60))), snr=50)

    def wrong(settings: TrackingSettings) -> float:
        """Share of the positions that are those of another sheet than in the first frame."""
        found = track_sheets(film, settings=settings)["x_px"].to_numpy()
        sheet = np.abs(found[:, :, None] - x_px[:, None]).argmin(axis=2)
        return float(np.mean((sheet != sheet[0])[np.isfinite(found) & np.isfinite(found[0])]))

    assert wrong(TrackingSettings()) == 0
    assert wrong(TrackingSettings(pattern_ratio=6.0)) > 0.4
