"""Every sheet keeps its number: no position is another sheet's, whatever the recording does."""

import numpy as np
import pytest

from tests.scenes.identity_cases import CASES, Case
from vision.sheets import track_sheets


def check(case: Case, tracks) -> None:
    """The right number of sheets, no position nearer to another sheet than to its own, and hardly any gap."""
    assert tracks.sizes["sheet"] == case.truth_px.shape[1]
    x, given = tracks.x_px.values, np.isin(tracks.flag.values, ("ok", "blurred"))
    wrong = given & ~(np.abs(x - case.truth_px) < case.pitch_px / 2)
    assert not wrong.any(), f"{wrong.sum()} positions of other sheets"
    assert given[case.visible].mean() >= case.least_found
    assert np.array_equal(given, np.isfinite(x))


@pytest.mark.thorough
@pytest.mark.parametrize("name", CASES)
def test_no_sheet_is_taken_for_another(name):
    """A failure means sheets are swapped, lost or invented in this recording without a word."""
    case = CASES[name]()
    check(case, track_sheets(case.picture, sheets=case.sheets))


def nearest_neighbours(x, truth):
    """Positions linked frame to frame, each sheet to the nearest ridge: what most trackers do."""
    linked = np.array(truth)
    for before, now, ridge in zip(linked[:-1], linked[1:], x[1:], strict=True):
        now[:] = ridge[np.argmin(np.abs(ridge - before[:, None]), axis=1)]
    return linked


@pytest.mark.parametrize(
    "name",
    [
        "slip 0.6 pitch, 7 px wide",
        "slip 0.85 pitch, 7 px wide",
        "slips every 2 to 3 frames",
        "whole comb jumps by (1.0, -1.0) pitches",
        "whole comb jumps by (2.0, 1.0, -2.0, -1.0) pitches",
    ],
)
def test_nearest_neighbours_fail_on_these(name):
    """These recordings are hard: even with all true positions, linking each to the nearest swaps sheets."""
    case = CASES[name]()
    linked = nearest_neighbours(case.truth_px, case.truth_px)
    assert (np.abs(linked - case.truth_px) > case.pitch_px / 2).any(axis=0).sum() >= 2
