"""Films that are not perfect: no sheet is taken for another, and how far the stated errors can be trusted.

`reports/degraded.md` has the whole table, and what is not as it should be. The bounds here hold for one film
of each kind; wanted are 62 to 74 % within one error, and no gross error that is called ok.
"""

import pytest

from tests.scenes.degraded import DEGRADATIONS, SHEETS, Film, clean, compare, measured, passing_hand
from vision.sheets import track_sheets
from vision.video import open_video, strip_profile

TRUSTED = (
    "none",
    "dropped frames",
    "duplicated frames",
    "autofocus hunting",
    "auto-exposure steps",
    "rolling shutter",
    "interlaced",
    "gamma 0.45",
    "vibration",
)
# Share of the displacements within one error, at least: what there is today, where it is not as wanted.
UNDERSTATED = {
    "frozen frames": 0.25,
    "soft lens": 0.5,
    "defocus": 0.5,
    "8-bit clipping": 0.54,
    "H.264 crf 12": 0.50,
    "H.264 crf 23": 0.20,
}


def outcome(name, folder):
    """One film of a degradation, lossless, or the undamaged film through a codec."""
    if name in DEGRADATIONS:
        return measured(DEGRADATIONS[name](1), folder)
    return measured(clean(1), folder, name)


@pytest.mark.parametrize("name", [*TRUSTED, "MJPEG 98", "MJPEG 90", "MJPEG 75", "MJPEG 60"])
def test_stated_errors_hold(name, tmp_path):
    """A failure means that such recordings lose sheets, take one for another, or understate their errors.

    Chance alone moves the share by ±2 %, since the film's few slips leave fixed-pattern error to each sheet.
    """
    found = outcome(name, tmp_path)
    assert (found.sheets, found.wrong) == (SHEETS, 0)
    assert found.found > 0.9  # duplicated frames may be left out
    assert found.gross == 0
    assert 0.62 < found.coverage_moved < 0.85
    assert found.rms_px < 0.035


@pytest.mark.parametrize("name", UNDERSTATED)
def test_sheets_are_never_confused_where_errors_are_understated(name, tmp_path):
    """A failure means that such a film has wrong identities, or that its errors hold less than before."""
    found = outcome(name, tmp_path)
    assert (found.sheets, found.wrong) == (SHEETS, 0)
    assert found.coverage_moved > UNDERSTATED[name]
    assert found.rms_px < 0.12


@pytest.mark.parametrize("name", ["dirt", "glare", "passing hand"])
def test_what_covers_sheets_confuses_none(name, tmp_path):
    """A failure means that a covered sheet is reported at another's place and called ok."""
    found = outcome(name, tmp_path)
    assert found.wrong == 0
    assert found.found > 0.85
    assert found.coverage_moved > 0.5


def test_positions_beside_a_hand_that_are_called_ok(tmp_path):
    """Known today: the edge of what covers the picture is taken for a ridge in 9 of 3120 positions.

    A failure means that there are more.
    """
    assert measured(passing_hand(3), tmp_path).wrong <= 9


def test_the_comparison_sees_wrong_sheets(tmp_path):
    """Half of a film with two sheets exchanged, and a film one pitch off: counted, every position."""
    film = clean(1)
    swapped = film.truth_px.copy()
    half = len(swapped) // 2 - 10
    swapped[:half, [4, 5]] = swapped[:half, [5, 4]]
    assert measured(Film(film.pixels, swapped), tmp_path).wrong == 2 * half


def test_the_comparison_sees_understated_errors(tmp_path):
    """Errors stated at half their size hold for fewer truths: 38 % in place of 68 % were they normal."""
    film = clean(1)
    from_film = measured(film, tmp_path)
    tracks = track_sheets(strip_profile(open_video(tmp_path / "film.mkv")))
    halved = compare(tracks.assign(x_err_px=tracks.x_err_px / 2), film.truth_px)
    assert halved.coverage_moved < 0.5 < from_film.coverage_moved
