"""Which stripes are the sheets where the sheets are wider than the gaps between them."""

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges, strip
from vision.checks import tracking_warnings
from vision.figures import Results
from vision.sheets import track_sheets
from vision.sheets.ridges import describe_ridges
from vision.summary import summary_lines

FRAMES, WIDTH = 40, 480


def wide_sheets(*, shift_px=0.0, per_side=10, contrast=1.0, uneven=0.15, slip=0.3):
    """Sheets of 11 px at a pitch of 18 px, half as wide again as the gaps."""
    x = comb(FRAMES, per_side=per_side, pitch_px=18.0, axis_px=WIDTH / 2 + shift_px, uneven=uneven, slip=slip)
    return x, ridges(x, width=WIDTH, fwhm_px=3.0, flat_px=11.0, contrast=contrast)


def shades(sheets):
    return np.random.default_rng(4).normal(1, 0.15, sheets)


def chosen(light, sign):
    return describe_ridges(strip(light, sign=sign).values).polarity == ("bright" if sign > 0 else "dark")


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("shift_px", [-90.0, 0.0, 90.0])
def test_the_background_beside_the_comb_tells_sheets_from_gaps(sign, shift_px):
    """A failure means that gaps are measured where only one end of the comb is in view."""
    x, light = wide_sheets(shift_px=shift_px)
    assert ((x.min() > 40) & (x.max() < WIDTH - 40)) == (shift_px == 0)
    assert chosen(light, sign)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_given_polarity_that_takes_gaps_for_sheets_is_told(sign):
    """A failure means that the user of a wrong --ridges publishes the gaps and never learns of it."""
    _, light = wide_sheets()
    right, wrong = ("bright", "dark") if sign > 0 else ("dark", "bright")
    film = strip(light, sign=sign)
    for asked, likelier in (("auto", ""), (right, ""), (wrong, right)):
        tracks = track_sheets(film, ridges=asked)
        assert tracks.attrs["ridges_likelier"] == likelier
        said = next(line for line in summary_lines(Results(tracks=tracks)) if line.startswith("sheets"))
        assert (f"the {right} stripes look more like sheets" in said) == bool(likelier)


@pytest.mark.parametrize("sign", [1, -1])
def test_sheets_that_touch_do_not_turn_the_comb_over(sign):
    """Two sheets without a gap are one ridge, so that ridges are no more than gaps. A failure means that this
    turns sheets into gaps in a film whose ends are both in view."""
    x, _ = wide_sheets()
    x[:, 1] = x[:, 0] + 11.0
    assert chosen(ridges(x, width=WIDTH, fwhm_px=3.0, flat_px=11.0), sign)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("slip", [0.0, 0.6])
def test_a_comb_without_ends_is_known_by_what_varies(sign, slip):
    """A failure means that gaps are measured in a film that the comb fills from edge to edge."""
    x, light = wide_sheets(per_side=18, contrast=shades(36), slip=slip)
    assert x[:, 1].max() < 0
    assert x[:, -2].min() > WIDTH
    assert chosen(light, sign)


def test_sheets_of_a_comb_that_leaves_the_picture_are_measured():
    """A failure means that positions are those of gaps, which move by the mean of two sheets."""
    x, light = wide_sheets(contrast=shades(20))
    x = x + np.linspace(0, 90, FRAMES)[:, None]
    light = ridges(x, width=WIDTH, fwhm_px=3.0, flat_px=11.0, contrast=shades(20))
    found = track_sheets(strip(light)).x_px.values
    there = np.isfinite(found)
    away = np.abs(found[..., None] - x[:, None, :]).min(axis=2)
    assert there.mean() > 0.7
    assert away[there].max() < 0.5


@pytest.mark.parametrize("sign", [1, -1])
def test_a_lit_field_that_ends_beside_the_comb_is_not_the_background(sign):
    """Dark sheets before a lamp that is a little wider than the comb; beyond the lamp it is dark again. A
    failure means that the bright gaps are taken for sheets."""
    x, light = wide_sheets(contrast=0.6 * shades(20))
    columns = np.arange(WIDTH)
    lamp = (columns > x.min() - 20) & (columns < x.max() + 20)
    assert chosen(light - 0.6 * lamp, sign)


def boards(x, *, away_px):
    """Light of boards as bright as a sheet, whose edges stand this far beyond the outermost sheets."""
    columns = np.arange(WIDTH)
    beyond = np.fmax(x[:, :1] - away_px - columns, columns - x[:, -1:] - away_px)
    return 1 / (1 + np.exp(-np.clip(beyond, -30, 30)))


def polarity_warnings(tracks):
    return [line for line in tracking_warnings(tracks) if "stripes are taken for the sheets" in line]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("fwhm", "away_px"), [(5.0, 10.0), (5.0, 14.0), (6.0, 16.0), (7.0, 14.0)])
def test_boards_beside_the_comb_are_not_its_background(sign, fwhm, away_px):
    """Narrow sheets between two boards as bright as they are (or as dark). A failure means that every
    position is that of a gap, or that nobody is told that the evidence is contradictory."""
    x = comb(FRAMES, per_side=10, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.12)
    light = ridges(x, width=WIDTH, fwhm_px=fwhm, contrast=np.random.default_rng(8).normal(1, 0.08, 20))
    tracks = track_sheets(strip(light + boards(x, away_px=away_px), sign=sign))
    found = tracks.x_px.values
    away = np.abs(found[..., None] - x[:, None, :]).min(axis=2)
    assert np.isfinite(found).mean() > 0.9
    assert np.nanmedian(away) < 0.1
    (line,) = polarity_warnings(tracks)
    assert "`ridges`" in line
    assert "background" in line


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("scatter", [0.0, 0.03, 0.05])
@pytest.mark.parametrize(("fwhm", "flat_px"), [(6.0, 0.0), (7.0, 0.0), (8.0, 0.0), (3.5, 9.0), (3.5, 10.0)])
def test_equal_sheets_that_fill_the_picture_are_told_from_gaps(sign, scatter, fwhm, flat_px):
    """Where the flanks of sheets overlap, gaps differ in level and sheets do not. A failure means that every
    position is that of a gap."""
    x = comb(FRAMES, per_side=18, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.12)
    shade = np.random.default_rng(8).normal(1, scatter, 36)
    assert chosen(ridges(x, width=WIDTH, fwhm_px=fwhm, flat_px=flat_px, contrast=shade), sign)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_close_call_between_sheets_and_gaps_is_a_warning_unless_given(sign):
    """Equal sheets as wide as the gaps, with no end of the comb in view. A failure means that gaps may be
    measured and nobody is told, or that a decision by hand is doubted."""
    x = comb(FRAMES, per_side=18, pitch_px=16.0, axis_px=WIDTH / 2, uneven=0.12)
    film = strip(ridges(x, width=WIDTH, fwhm_px=9.0), sign=sign)
    (line,) = polarity_warnings(track_sheets(film))
    assert "no clear background" in line
    assert not polarity_warnings(track_sheets(film, ridges="bright" if sign > 0 else "dark"))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("shift_px", [-90.0, 0.0, 90.0])
def test_thick_sheets_before_a_background_are_not_doubted(sign, shift_px):
    """A failure means a warning on clear films: nobody reads the next one."""
    _, light = wide_sheets(shift_px=shift_px)
    assert not describe_ridges(strip(light, sign=sign).values).doubt


@pytest.mark.parametrize("sign", [1, -1])
def test_sheets_of_different_shades_that_fill_the_picture_are_not_doubted(sign):
    """A failure means a warning on clear films: nobody reads the next one."""
    _, light = wide_sheets(per_side=18, contrast=shades(36))
    assert not describe_ridges(strip(light, sign=sign).values).doubt
