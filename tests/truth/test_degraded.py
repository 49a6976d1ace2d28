"""Films that are not perfect: no sheet is taken for another, and how far the stated errors can be trusted.

`reports/degraded.md` has the whole table. The bounds here hold for one film of each kind; wanted are 62 to
74 % of displacements within one error, and no gross error that is called ok.
"""

import numpy as np
import pytest

from tests.scenes.combs import comb, ridges
from tests.scenes.degraded import (
    CHAINED,
    CODECS,
    DEGRADATIONS,
    SHEETS,
    Film,
    clean,
    compare,
    dirty,
    measured,
    passing_hand,
    slow_hand,
    write_chained,
    write_h264,
)
from vision.sheets import TrackingSettings, track_sheets
from vision.video import open_video, strip_profile

TRUSTED = tuple(
    name
    for name in (*DEGRADATIONS, *CODECS)
    if name not in ("dirt", "glare", "passing hand", "slow hand", "shadow", "scale bar", "FFV1", *CHAINED)
)


def outcome(name, folder):
    """One film of a degradation, lossless, or the undamaged film through a codec."""
    if name in DEGRADATIONS:
        return measured(DEGRADATIONS[name](1), folder)
    return measured(clean(1), folder, name)


@pytest.mark.thorough
@pytest.mark.parametrize("name", TRUSTED)
def test_stated_errors_hold(name, tmp_path):
    """A failure means that such recordings lose sheets, take one for another, or misstate their errors.

    62 to 74 in 100 displacements are to lie within one error. Chance alone moves the share of one film by
    ±2 %, since the film's few slips leave fixed-pattern error to each sheet; H.264's moves by ±5 %. Where
    frames were dropped, sheets creep in jumps, which count as scatter.
    """
    found = outcome(name, tmp_path)
    assert (found.sheets, found.wrong) == (SHEETS, 0)
    assert found.found > 0.84  # frozen and duplicated frames are left out
    assert found.gross < 1e-3
    assert 0.61 < found.coverage_moved < (0.79 if name in ("dropped frames", "auto-exposure steps") else 0.76)
    assert found.rms_px < (0.12 if name.startswith("H.264") else 0.04)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["HEVC crf 18", "MPEG-4 q 3", "VP9 crf 20"])
def test_stated_errors_hold_on_average_for_other_codecs(name, tmp_path):
    """Over three films, since a film's few sticks move its share by ±8 %.  A failure means that errors of
    these codecs are stated as those of others: all were understated by a third once. VP9 moves all sheets
    together by less than the others do."""
    found = [measured(clean(seed), tmp_path, name) for seed in (1, 2, 3)]
    assert all((one.sheets, one.wrong) == (SHEETS, 0) for one in found)
    assert 0.6 < np.mean([one.coverage_moved for one in found]) < (0.79 if name == "VP9 crf 20" else 0.76)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "gross"),
    [("dirt", 1e-3), ("glare", 1e-3), ("passing hand", 1e-3), ("shadow", 1e-3), ("scale bar", 1e-3)],
)
def test_what_covers_sheets_confuses_none(name, gross, tmp_path):
    """A failure means that a covered sheet is reported at another's place, or far off with a small error."""
    found = outcome(name, tmp_path)
    assert found.wrong == 0
    assert found.found > 0.85
    assert found.gross < gross
    assert 0.58 < found.coverage_moved < 0.78


@pytest.mark.parametrize(("seed", "codec"), [(7047, "MJPEG 90"), (7313, "VP9 crf 20"), (7940, "MPEG-2 q 3")])
def test_a_bump_beside_the_comb_is_no_sheet(seed, codec, tmp_path):
    """A speck on the lens beside the comb leaves a bump of the background that does not move along with the
    outermost sheet: twice as wide as a sheet and half as high, or less wide and fainter.  A failure means
    that it is a sheet, all of whose positions are called ok."""
    film = dirty(seed)
    picture = strip_profile(open_video(CODECS[codec](tmp_path, film.pixels)))
    assert track_sheets(picture).sizes["sheet"] == SHEETS
    blind = TrackingSettings(along_end=-1.0)  # all bumps pass as moving along
    assert track_sheets(picture, settings=blind).sizes["sheet"] == SHEETS + 1


@pytest.mark.parametrize("seed", [3, 7])
def test_a_hand_over_nine_sheets_leaves_those_beside_it_where_they_are(seed, tmp_path):
    """Combs on both sides of a gap of nine sheets were read as shifted by six sheets against each other."""
    assert measured(passing_hand(seed), tmp_path).wrong == 0


@pytest.mark.parametrize("seed", [1, 3, 11, 12])
def test_a_hand_that_is_always_over_the_comb_exchanges_no_sheets(seed, tmp_path):
    """No frame shows all sheets.  A failure means that the comb is put together from too few of them, and
    those on one side of the hand are read as others: hundreds were wrong and called ok."""
    found = measured(slow_hand(seed), tmp_path)
    assert (found.sheets, found.wrong) == (SHEETS, 0)
    assert found.found > 0.75


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


@pytest.mark.parametrize("seed", [1, 2])
def test_errors_of_few_sheets_include_what_the_codec_may_do(seed, tmp_path):
    """Three sheets do not show by how much H.264 moves each. A failure means that their errors are stated as
    if it moved none, and hold for a third of the truths."""
    film = clean(seed)
    middle = film.truth_px.shape[1] // 2
    truth = film.truth_px[:, middle : middle + 3]
    first, last = (2 * round(x / 2) for x in (truth.min() - 14, truth.max() + 14))
    path = write_h264(tmp_path / "few.mkv", np.ascontiguousarray(film.pixels[:, :, first:last]), 23)
    found = compare(track_sheets(strip_profile(open_video(path))), truth - first)
    assert found.sheets == 3
    assert 0.62 < found.coverage_moved < 0.9


X264 = {"crf": "28", "preset": "ultrafast", "threads": "1", "x264-params": "asm=0"}
X265 = {"crf": "28", "x265-params": "log-level=none:pools=1:frame-threads=1"}


def through(path, encoder, options, x, *, contrast):
    """Tracks of sheets at positions x (frame, sheet) after a codec."""
    grey = 60 + contrast * ridges(x, width=288, fwhm_px=6.0)
    pixels = np.random.default_rng(0).normal(grey[:, None], 3.0, (len(x), 32, 288))
    write_chained(path, np.rint(pixels).clip(0, 255).astype(np.uint8), encoder, options)
    return track_sheets(strip_profile(open_video(path)))


def creeping_through(path, encoder, options, *, slip, contrast, shaken_px=0.0):
    """Positions of sheets that creep by `slip` pitches and slip back, and their tracks after a codec. All
    vibrate together with an amplitude of `shaken_px`."""
    x = comb(120, per_side=8, pitch_px=16.0, axis_px=144.0, period=30.0, slip=slip, uneven=0.05)
    x += shaken_px * np.sin(2.2 * np.arange(120))[:, None]
    return x, through(path, encoder, options, x, contrast=contrast)


@pytest.mark.parametrize(
    ("encoder", "options", "contrast", "slip", "shaken_px"),
    [
        ("libx264", X264, 25, 0.02, 0.0),
        ("libx264", X264, 25, 0.03, 0.0),
        ("libx264", X264, 60, 0.03, 0.05),
        ("libx265", X265, 25, 0.02, 0.0),
        ("libx265", X265, 60, 0.02, 0.05),
        ("wmv2", {"qmin": "4", "qmax": "4"}, 25, 0.02, 0.05),
    ],
)
def test_errors_hold_where_a_codec_codes_no_motion(encoder, options, contrast, slip, shaken_px, tmp_path):
    """Sheets of low contrast that creep, or all vibrate, by less than the quantiser sees. A failure means
    that the scatter of frames that hardly change is taken for the error: it holds for a third of the truths,
    or for none."""
    path = tmp_path / ("film.avi" if encoder == "wmv2" else "film.mp4")
    x, tracks = creeping_through(path, encoder, options, slip=slip, contrast=contrast, shaken_px=shaken_px)
    found = compare(tracks, x)
    assert (found.sheets, found.wrong) == (16, 0)
    assert 0.6 < found.coverage_moved < 0.92


def test_sheets_that_slip_each_by_its_own_length_have_no_larger_errors(tmp_path):
    """Every 14 frames, by 0 to 4 px. A failure means that their motion counts as an error of the codec:
    errors were stated six times too large."""
    own = np.random.default_rng(0).uniform(0, 2, (12, 16)) * np.linspace(-2, 2, 16)
    frame = np.arange(160)
    x = 24 + 16 * np.arange(16) - own[frame // 14] * (frame % 14 / 14)[:, None]
    options = X264 | {"crf": "14", "preset": "medium"}
    found = compare(through(tmp_path / "film.mp4", "libx264", options, x, contrast=100), x)
    assert (found.sheets, found.wrong) == (16, 0)
    assert 0.6 < found.coverage_moved < 0.9
    assert found.stated_px < 2 * found.rms_px


def test_errors_hold_in_slips_that_a_codec_rounds(tmp_path):
    """A failure means that frames of slips have the error of others, and it holds for two fifths of them."""
    x, tracks = creeping_through(
        tmp_path / "film.mp4", "libx264", X264 | {"crf": "18"}, slip=0.1, contrast=60
    )
    off = tracks.x_px.values - x
    off = np.abs(off - np.mean(off, axis=0))
    slips = np.abs(np.diff(x, axis=0, prepend=x[:1])) > 0.08
    assert 0.6 < (off < tracks.x_err_px.values)[slips].mean() < 0.9


@pytest.mark.parametrize("seed", [4, 12, 13])
def test_bumps_beside_specks_are_no_sheets(seed, tmp_path):
    """What dirt leaves of the background beyond the last sheet: faint, and still or of another width."""
    found = measured(dirty(seed), tmp_path)
    assert (found.sheets, found.wrong) == (SHEETS, 0)
