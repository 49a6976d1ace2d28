"""Manual decisions: what they change, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from tests.sheets.test_doubts import marked_comb
from vision.checks import consistency_warnings, tracking_warnings
from vision.data import operations_of
from vision.errors import InputError
from vision.sheets import doubtful_stretches, read_corrections, track_sheets
from vision.sheets.corrections import (
    Decisions,
    corrections_text,
    decision_texts,
    last_of,
    read_decisions,
    sheet_names,
)


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
    """A failure means that a doubt which a person has settled stays one."""
    truth, picture, _ = film
    fixed = track_sheets(
        picture, sheets=11, corrections=written(tmp_path, '[[accept]]\nsheet=6\nframes="80:111"')
    )
    assert np.abs(fixed.x_px.values[80:111, 6] - truth[80:111, 6] - 27).max() < 0.5
    assert operations_of(fixed)[-1]["parameters"]["corrections"][0]["kind"] == "accept"
    assert fixed.attrs["corrections_applied"] == 1


def test_assign_follows_the_ridge(film, tmp_path):
    """A failure means that a sheet gets another ridge than the one pointed at."""
    truth, picture, _ = film
    text = f'[[assign]]\nsheet=6\nframes="80:111"\nx_px={truth[80, 6] + 27:.1f}'
    fixed = track_sheets(picture, sheets=11, corrections=written(tmp_path, text))
    assert np.abs(fixed.x_px.values[80:111, 6] - truth[80:111, 6] - 27).max() < 0.5


def test_swap_and_leave_out(film, tmp_path):
    """A failure means that a decision reaches beyond its frames, or not to their end."""
    truth, picture, _ = film
    text = '[[swap]]\nsheets=[2, 3]\nframes="10:12"\n[[leave_out]]\nsheet=0\nframes="5:6"'
    fixed = track_sheets(picture, sheets=11, corrections=written(tmp_path, text))
    assert np.abs(fixed.x_px.values[10:12, 2] - truth[10:12, 3]).max() < 0.5
    assert np.abs(fixed.x_px.values[12, 2] - truth[12, 2]) < 0.5
    assert fixed.flag.values[5, 0] == "left_out"
    assert np.isnan(fixed.x_px.values[5, 0])


def test_one_entry_may_name_several_sheets(film, tmp_path):
    """A failure means that a stretch of many doubtful sheets takes as many entries."""
    _, picture, _ = film
    text = '[[leave_out]]\nsheets=[0, 3, 7]\nframes="5:7"'
    found = written(tmp_path, text)
    assert [one.sheets for one in found] == [(0,), (3,), (7,)]
    fixed = track_sheets(picture, sheets=11, corrections=found)
    left_out = fixed.flag.values == "left_out"
    assert sorted(zip(*np.nonzero(left_out), strict=True)) == [(t, k) for t in (5, 6) for k in (0, 3, 7)]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ('[[keep]]\nsheet=1\nframes="1:2"', "keep"),
        ("[[accept]]\nsheet=1", "[[accept]] 1"),
        ('[[accept]]\nsheet="a"\nframes="1:2"', "[[accept]] 1"),
        ('[[accept]]\nsheet=1\nframes="2:1"', "[[accept]] 1"),
        ('[[accept]]\nsheets=[]\nframes="1:2"', "[[accept]] 1"),
        ('[[accept]]\nsheets=[1, "a"]\nframes="1:2"', "[[accept]] 1"),
        ('[[accept]]\nsheet=1\nsheets=[2]\nframes="1:2"', "[[accept]] 1"),
        ("[[delete]]\nsheets=[1, 2]", "[[delete]] 1"),
        ('[[swap]]\nsheets=[1, 1]\nframes="1:2"', "[[swap]] 1"),
        ('[[assign]]\nsheet=1\nframes="1:2"\nx_px="left"', "[[assign]] 1"),
        ("accept = 3", "accept"),
        ("[[accept", "TOML"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, text, names):
    """A failure means that a slip of the pen in the file is guessed at."""
    with pytest.raises(InputError) as error:
        written(tmp_path, text)
    assert names in str(error.value)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ('[[accept]]\nsheet=11\nframes="80:81"', "0 to 10"),
        ('[[accept]]\nsheet=6\nframes="80:999"', "0:200"),
        ('[[accept]]\nsheet=1\nframes="80:81"', "doubtful stretch"),
        ('[[assign]]\nsheet=6\nframes="80:81"\nx_px=5', "x_px = 5; found the nearest at "),
        ('[[accept]]\nsheet=6\nframes="80:90"\n[[leave_out]]\nsheet=6\nframes="85:86"', "[[accept]] 1"),
    ],
)
def test_what_contradicts_is_refused(film, tmp_path, text, names):
    """A failure means that a slip of the pen changes results, or is ignored."""
    with pytest.raises(InputError) as error:
        track_sheets(film[1], sheets=11, corrections=written(tmp_path, text))
    assert names in str(error.value)


def test_no_ridge_is_given_twice(film, tmp_path):
    """A failure means that two sheets stand at one place."""
    truth, picture, _ = film
    text = f'[[assign]]\nsheet=6\nframes="80:81"\nx_px={truth[80, 5]:.1f}'
    with pytest.raises(InputError, match="sheet 5"):
        track_sheets(picture, sheets=11, corrections=written(tmp_path, text))


def test_a_film_without_doubt_lists_nothing():
    """A failure means that people are sent to look at what is certain."""
    x = np.broadcast_to(60 + 100.0 * np.arange(5), (20, 5))
    assert doubtful_stretches(track_sheets(strip(ridges(x, width=520)))).empty


# --- sheets, axis, and the order of decisions ---------------------------------------------------------------


@pytest.fixture(scope="module")
def comb_film():
    """Eleven sheets that move together, and a twelfth ridge beside them that stands out of the comb."""
    frames = np.arange(120)[:, None]
    x = 80 + 60.0 * np.arange(11) + 4 * np.sin(frames / 9)
    return x, strip(ridges(x, width=760))


def test_a_deleted_sheet_is_gone_and_the_others_keep_their_positions(comb_film, tmp_path):
    """A failure means that one sheet less shifts the others."""
    x, picture = comb_film
    fixed = track_sheets(picture, corrections=written(tmp_path, "[[delete]]\nsheet=4"))
    assert fixed.sizes["sheet"] == 10
    assert np.abs(fixed.x_px.values - np.delete(x, 4, axis=1)).max() < 0.5
    assert fixed.attrs["sheets"] == 10
    assert len(fixed.attrs["wide_spacings"]) == 1  # and the gap is said


def test_the_last_sheet_is_not_deleted(comb_film, tmp_path):
    """A failure means that a film without a sheet ends in an unexpected error."""
    text = "".join(f"[[delete]]\nsheet = {k}\n" for k in range(11))
    with pytest.raises(InputError, match="found the only one that is left"):
        track_sheets(comb_film[1], corrections=written(tmp_path, text))


def test_a_sheet_that_was_not_counted_is_added_and_followed_both_ways(comb_film, tmp_path):
    """A failure means that a sheet the program overlooked cannot be had."""
    x, picture = comb_film
    text = f"[[add]]\nframe=60\nx_px={x[60, 5] + 2:.1f}\n"
    without = written(tmp_path, f'[[delete]]\nsheet=5\ndate="2026-01-01"\n{text}date="2026-01-02"')
    fixed = track_sheets(picture, corrections=without)
    assert fixed.sizes["sheet"] == 11
    assert np.abs(fixed.x_px.values - x).max() < 0.5
    wrong = f"[[add]]\nframe=60\nx_px={x[60, 5]:.1f}"
    with pytest.raises(InputError, match="sheet 5"):
        track_sheets(picture, corrections=written(tmp_path, wrong))


@pytest.mark.parametrize(("widths", "faint"), [(6.5, 0.1), (9.0, 0.2), (9.3, 0.2)])
def test_a_faint_sheet_on_the_flanks_of_wide_ones_is_added(tmp_path, widths, faint):
    """Its neighbours leave only the top of its ridge, or make it unlike all others. A failure means that a
    sheet which a person sees cannot be measured, or is called a mark although this person says that it is a
    sheet; or that nothing says how far the neighbours pull it."""
    x = comb(120, per_side=10, pitch_px=16.0, axis_px=180, uneven=0.04, slip=0.2)
    height, width = np.ones(20), np.full(20, widths)
    height[14], width[[13, 15]] = faint, 1.15 * widths
    picture = strip(ridges(x, width=360, fwhm_px=width, contrast=height), snr=200)
    assert track_sheets(picture).sizes["sheet"] == 19
    text = f"[[add]]\nframe=50\nx_px={x[50, 14]:.0f}"
    tracks = track_sheets(picture, corrections=written(tmp_path, text))
    assert tracks.sizes["sheet"] == 20
    off = tracks.x_px.values[:, 14] - x[:, 14]
    assert (tracks.flag.values[:, 14] == "ok").mean() > 0.4
    assert abs(np.nanmean(off)) < 2 * float(tracks.constant_error_px[14]) + 0.03
    moved, known = np.abs(off - np.nanmean(off)), np.isfinite(off)
    assert (moved < tracks.x_err_px.values[:, 14])[known].mean() > 0.6


@pytest.mark.parametrize("covered", [5, 24, 40])
def test_a_sheet_that_is_covered_throughout_the_film_is_counted(tmp_path, covered):
    """A failure means that all sheets further out than a covered one keep an n that is too small, with a
    warning and no remedy."""
    x = comb(150)
    hidden = x.copy()
    hidden[:, covered] = np.nan
    picture = strip(ridges(hidden))
    n = np.r_[np.arange(25, 0, -1), np.arange(1, 26)]
    before = track_sheets(picture)
    assert (before.n.values != np.delete(n, covered)).any()
    assert len(before.attrs["wide_spacings"]) == 1
    added = written(tmp_path, f"[[add]]\nframe=3\nx_px={x[3, covered]:.0f}")
    tracks = track_sheets(picture, corrections=added)
    np.testing.assert_array_equal(tracks.n.values, n)
    assert set(tracks.flag.values[:, covered]) == {"missing"}
    assert np.isnan(tracks.x_predicted_px.values[covered])
    assert np.nanmax(np.abs(tracks.x_px.values - x)) < 0.2
    assert len(tracks.attrs["wide_spacings"]) == 0
    lines = tracking_warnings(tracks) + consistency_warnings(tracks)
    assert len(lines) == 1 and "of 7500 positions missing" in lines[0]


def test_a_sheet_is_counted_only_where_there_is_room(tmp_path):
    """A failure means that a typing error shifts n of a whole side without a word."""
    x = comb(60)
    hidden = x.copy()
    hidden[:, [10, 30, 31]] = np.nan
    picture = strip(ridges(hidden))

    def added(*places):
        text = "".join(f"[[add]]\nframe=0\nx_px={at:.0f}\n" for at in places)
        return track_sheets(picture, corrections=written(tmp_path, text)).sizes["sheet"]

    assert added(x[0, 10], x[0, 30], x[0, 31]) == 50
    for wrong in ([x[0, 10], x[0, 10] + 2], [x[0, 20] + 10], [x[0, 0] - 25], [x[0, 30], x[0, 30], x[0, 31]]):
        with pytest.raises(InputError, match="a ridge near x_px"):
            added(*wrong)


def test_the_axis_is_where_it_is_put(comb_film, tmp_path):
    """A failure means that a person's axis is overruled by an option or by the motion."""
    _, picture = comb_film
    fixed = track_sheets(picture, axis_px=300.0, corrections=written(tmp_path, "[[axis]]\nx_px=350.0"))
    assert fixed.side.values.tolist() == [-1] * 5 + [1] * 6
    assert fixed.attrs["axis_px"] == 350.0
    assert fixed.attrs["axis_how"] == "given"


def test_a_swap_from_a_frame_on_lasts_to_the_end(comb_film, tmp_path):
    """A failure means that sheets change places again by themselves."""
    x, picture = comb_film
    fixed = track_sheets(picture, corrections=written(tmp_path, '[[swap]]\nsheets=[2, 3]\nframes="50:"'))
    assert np.abs(fixed.x_px.values[50:, 2] - x[50:, 3]).max() < 0.5
    assert np.abs(fixed.x_px.values[:50, 2] - x[:50, 2]).max() < 0.5


def test_dates_are_the_order(comb_film, tmp_path):
    """Each decision speaks of the sheets that those before it left, however the file is sorted.

    Applied in the order of the file, the second entry would exchange other sheets.
    """
    x, picture = comb_film
    later = '[[swap]]\nsheets=[2, 3]\nframes="0:"\ndate=2026-05-02T10:00:00Z\n'
    earlier = "[[delete]]\nsheet=0\ndate=2026-05-02T11:30:00+02:00\n"  # half an hour before
    both = written(tmp_path, later + earlier)
    assert [one.kind for one in both] == ["delete", "swap"]
    fixed = track_sheets(picture, corrections=both)
    assert np.abs(fixed.x_px.values[:, 2] - x[:, 4]).max() < 0.5


def test_what_is_written_is_read_again(tmp_path):
    """A failure means that a review loses or changes decisions when it is opened again."""
    text = """
[run]
film = "abc"
[[swap]]
sheets = [2, 3]
frames = "50:"
date = "2026-01-03"
[[accept]]
sheet = 6
frames = "80:111"
date = "2026-01-01T00:00:00.000+00:00"
[[assign]]
sheet = 6
frames = "80:111"
x_px = 687.25
date = "2026-01-02"
[[clock]]
offset_s = 36.00241
drift_ppm = -181.4
[[strip]]
rows = "60:144"
[[strip]]
rows = "61:140"
date = "2026-01-04"
[[undone]]
kind = "add"
frame = 5
x_px = 3.5
"""
    written(tmp_path, text)
    first = read_decisions(tmp_path / "fix.toml")
    assert last_of(first.corrections, "strip").rows == (61, 140)
    assert last_of(first.corrections, "axis") is None
    (tmp_path / "again.toml").write_text(corrections_text(first))
    again = read_decisions(tmp_path / "again.toml")
    assert [(one.what, one.date) for one in again.corrections] == [
        (one.what, one.date) for one in first.corrections
    ]
    assert [one.what for one in again.undone] == [("add", {"frame": 5, "x_px": 3.5})]
    assert again.film == "abc"


def test_a_note_is_kept_and_shown(tmp_path):
    """A failure means that the reason of a decision is lost, or changes what the decision is."""
    (one,) = written(tmp_path, '[[leave_out]]\nsheet = 1\nframes = "70"\nnote = "dust,\\nleft"\n')
    assert (one.first, one.stop, one.note) == (70, 71, "dust, left")
    names = sheet_names(np.array([-1, -1, 1]), np.array([2, 1, 1]))
    assert one.text(names) == "left 1 (index 1) left out, frames 70:71 (dust, left)"
    (again,) = written(tmp_path, corrections_text(Decisions(corrections=(one,))))
    assert again.note == one.note
    assert again.what == replace(one, note="").what


def test_sheets_have_their_present_names_only_since_the_numbering_changed(tmp_path):
    """A failure means that a decision of the history is read as one about another sheet."""
    found = written(
        tmp_path,
        '[[swap]]\nsheets = [0, 1]\nframes = "3:4"\ndate = "2026-01-01"\n'
        '[[delete]]\nsheet = 1\ndate = "2026-01-02"\n'
        '[[swap]]\nsheets = [0, 1]\nframes = "5"\ndate = "2026-01-03"\n',
    )
    assert decision_texts(found, sheet_names(np.array([-1, 1]), np.array([1, 1]))) == [
        "the sheet of index 0 and the sheet of index 1 swapped, frames 3:4",
        "the sheet of index 1 deleted",
        "left 1 (index 0) and right 1 (index 1) swapped, frames 5:6",
    ]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        (
            '[[accept]]\nsheet=1\nframes="1:2"\nreason="dust"',
            "sheet, frames, date, note; found 'reason'",
        ),
        ('[[accept]]\nsheet=1\nframes="1:2"\nnotes="dust"', "found 'notes'; did you mean note?"),
        ("[[add]]\nframe=1.5\nx_px=3", "frame"),
        ('[[delete]]\nsheet=1\nframes="1:2"', "[[delete]] 1"),
        ("[[axis]]\nx_px=inf", "x_px"),
        ('[[strip]]\nrows="60:"', "rows"),
        ('[[clock]]\noffset_s="soon"', "offset_s"),
        ('[[axis]]\nx_px=3\ndate="tomorrow"', "date"),
        ('[[undone]]\nkind="axes"', "[[undone]] 1"),
        ("run = 3", "[run]"),
    ],
)
def test_decisions_that_cannot_be_read_are_named(tmp_path, text, names):
    """A failure means that somebody looks through a file of decisions for the one that is wrong."""
    with pytest.raises(InputError) as error:
        written(tmp_path, text)
    assert names in str(error.value)
