"""Decisions by hand: what they change, and what is refused."""

import numpy as np
import pytest

from tests.scenes.combs import ridges, strip
from tests.sheets.test_neighbours import marked_comb
from vision.errors import InputError
from vision.sheets import doubtful_stretches, read_corrections, track_sheets


@pytest.fixture(scope="module")
def film():
    """A ridge is hidden in frames 80 to 110 while a speck stands 27 px beside it."""
    truth, picture = marked_comb(27)
    return truth, picture, track_sheets(picture, sheets=11)


def written(folder, text):
    path = folder / "fix.toml"
    path.write_text(text)
    return read_corrections(path)


def test_the_stretch_is_listed_with_its_reason(film):
    """A failure means that somebody who wants to settle a doubt does not learn where it is."""
    truth, _, tracks = film
    table = doubtful_stretches(tracks)
    assert len(table) == 1
    row = table.iloc[0]
    assert (row.sheet, row.first_frame, row.last_frame, row.frames) == (6, 80, 110, 31)
    assert "neighbours" in row.why
    assert abs(row.x_withheld_px - truth[80, 6] - 27) < 2
    assert abs(row.x_expected_px - truth[80, 6]) < 2


def test_accept_gives_the_withheld_ridge(film, tmp_path):
    truth, picture, _ = film
    fixed = track_sheets(
        picture, sheets=11, corrections=written(tmp_path, '[[accept]]\nsheet=6\nframes="80:111"')
    )
    assert np.abs(fixed.x_px.values[80:111, 6] - truth[80:111, 6] - 27).max() < 0.5
    assert fixed.attrs["operations"][-1]["parameters"]["corrections"][0]["kind"] == "accept"
    assert fixed.attrs["corrections_applied"] == 1


def test_assign_follows_the_ridge(film, tmp_path):
    truth, picture, _ = film
    text = f'[[assign]]\nsheet=6\nframes="80:111"\nx_px={truth[80, 6] + 27:.1f}'
    fixed = track_sheets(picture, sheets=11, corrections=written(tmp_path, text))
    assert np.abs(fixed.x_px.values[80:111, 6] - truth[80:111, 6] - 27).max() < 0.5


def test_swap_and_leave_out(film, tmp_path):
    truth, picture, _ = film
    text = '[[swap]]\nsheets=[2, 3]\nframes="10:12"\n[[leave_out]]\nsheet=0\nframes="5:6"'
    fixed = track_sheets(picture, sheets=11, corrections=written(tmp_path, text))
    assert np.abs(fixed.x_px.values[10:12, 2] - truth[10:12, 3]).max() < 0.5
    assert np.abs(fixed.x_px.values[12, 2] - truth[12, 2]) < 0.5
    assert fixed.flag.values[5, 0] == "left_out"
    assert np.isnan(fixed.x_px.values[5, 0])


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ('[[keep]]\nsheet=1\nframes="1:2"', "keep"),
        ("[[accept]]\nsheet=1", "[[accept]] 1"),
        ('[[accept]]\nsheet="a"\nframes="1:2"', "[[accept]] 1"),
        ('[[accept]]\nsheet=1\nframes="2:1"', "[[accept]] 1"),
        ('[[swap]]\nsheets=[1, 1]\nframes="1:2"', "[[swap]] 1"),
        ('[[assign]]\nsheet=1\nframes="1:2"\nx_px="left"', "[[assign]] 1"),
        ("accept = 3", "accept"),
        ("[[accept", "TOML"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, text, names):
    with pytest.raises(InputError) as error:
        written(tmp_path, text)
    assert names in str(error.value)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ('[[accept]]\nsheet=11\nframes="80:81"', "0 to 10"),
        ('[[accept]]\nsheet=6\nframes="80:999"', "0:200"),
        ('[[accept]]\nsheet=1\nframes="80:81"', "doubtful stretch"),
        ('[[assign]]\nsheet=6\nframes="80:81"\nx_px=5', "x_px = 5"),
        ('[[accept]]\nsheet=6\nframes="80:90"\n[[leave_out]]\nsheet=6\nframes="85:86"', "[[accept]] 1"),
    ],
)
def test_what_contradicts_is_refused(film, tmp_path, text, names):
    """A failure means that a slip of the pen changes results, or is ignored."""
    with pytest.raises(InputError) as error:
        track_sheets(film[1], sheets=11, corrections=written(tmp_path, text))
    assert names in str(error.value)


def test_no_ridge_is_given_twice(film, tmp_path):
    truth, picture, _ = film
    text = f'[[assign]]\nsheet=6\nframes="80:81"\nx_px={truth[80, 5]:.1f}'
    with pytest.raises(InputError, match="sheet 5"):
        track_sheets(picture, sheets=11, corrections=written(tmp_path, text))


def test_a_film_without_doubt_lists_nothing():
    x = np.broadcast_to(60 + 100.0 * np.arange(5), (20, 5))
    assert doubtful_stretches(track_sheets(strip(ridges(x, width=520)))).empty
