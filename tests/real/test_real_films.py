"""`track` on recordings of real things; skipped where they are absent."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.scenes.degraded import write_ffv1, write_h264
from tests.scenes.films import write_encoded
from vision import open_video
from vision.command.main import run
from vision.numeric import nan_median

DATA = Path(__file__).parents[2] / "../shared/data"
pytestmark = [
    pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not here"),
    pytest.mark.usefixtures("without_pictures"),
]


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """Of a film's name and arguments: exit status, positions (frame, sheet), flags (frame, sheet), run.json.

    Each is run once; results are not to be changed."""
    return cache(lambda name, *arguments: track(tmp_path_factory.mktemp("film") / "run", name, arguments))


def track(folder, name, arguments):
    status = run([str(DATA / name), "--quiet", "--out", str(folder), *arguments])
    table = pd.read_csv(folder / "tracks.csv")
    facts = json.loads((folder / "run.json").read_text())
    wide = table.pivot_table(index="frame", columns="index", values="x_px", dropna=False)
    flags = table["flag"].to_numpy().reshape(wide.shape)
    return status, wide.to_numpy(), flags, facts


def scatter(spacing, shift, slow):
    """Standard deviation about a quadratic in the shift (perspective and lens), over the slow frames."""
    fitted = np.polynomial.Polynomial.fit(shift[slow], spacing[slow], 2)
    return np.std(spacing[slow] - fitted(shift[slow]))


@pytest.fixture(scope="module", params=["their number given", "their number found"])
def markers(tracked, request):
    given = ("--sheets", "7") if request.param == "their number given" else ()
    return tracked("released_markers.avi", "--ridges", "dark", *given)


def test_all_markers_are_kept_through_the_releases(markers):
    """A failure means that a sudden slip of up to 92 px between two frames costs a marker or its identity."""
    status, x, flags, facts = markers
    assert status == 0
    assert x.shape == (582, 7)
    assert np.isin(flags, ("ok", "blurred")).all()
    assert np.abs(np.diff(x, axis=0)).max() > 80  # the releases are there
    spacing = np.diff(x, axis=1)
    assert np.abs(spacing - np.median(spacing, axis=0)).max() < 3  # on one stiff floor: a swap would be 160
    assert facts["found"]["window_px"] > 15  # markers are ~30 px wide: the window follows


def test_the_markers_spacing_scatters_by_less_than_0_08_px(markers):
    """A failure means that positions of wide, flat-bottomed ridges in lossy video are worse than stated."""
    _, x, _, _ = markers
    step = np.median(np.diff(x, axis=0), axis=1)
    slow = np.r_[False, np.abs(step) < 2]
    shift = np.median(x - x[0], axis=1)
    assert slow.sum() > 300
    scatters = [scatter(spacing, shift, slow) for spacing in np.diff(x, axis=1).T]
    assert np.median(scatters) <= 0.08
    assert np.median([scatter(s, shift, ~slow) for s in np.diff(x, axis=1).T]) > 0.08  # motion blur


def test_the_beam_s_white_frame_is_rejected_and_its_motion_is_common(tracked):
    """A failure means that a white frame is tracked, or that motion of a hundredth of a pixel is noise."""
    status, x, flags, facts = tracked("striped_beam.cine", "--rotate", "90")
    assert status == 1
    assert facts["frames"]["blank"] == 1
    assert "1 frame blank" in " ".join(facts["warnings"])
    assert (flags[-1] == "blank").all()
    assert (flags[:-1] == "ok").all()
    assert x.shape[1] >= 3
    motion = x[:-1] - x[:-1].mean(axis=0)
    together = np.corrcoef(motion.T)[np.triu_indices(x.shape[1], 1)]
    assert together.min() > 0.97
    assert 0.005 < motion.std() < 0.02


def test_sarcomeres_are_followed_with_doubts_flagged(tracked):
    """A failure means that a comb that drifts and merges is given with false certainty, or not at all."""
    status, x, flags, facts = tracked("sarcomeres.avi", "--rotate", "90", "--strip", "190:211")
    assert status == 1
    assert "is uncertain" in " ".join(facts["warnings"])
    known = np.isfinite(x)
    assert np.array_equal(known, np.isin(flags, ("ok", "blurred")))
    assert (flags == "frozen").all(axis=1).sum() == 20  # the film repeats these
    assert 25 <= x.shape[1] <= 45
    assert known.mean() > 0.4
    assert {"doubtful", "merged"} <= set(flags.ravel())
    for row, there in zip(x, known, strict=True):
        assert (np.diff(row[there]) > 0).all()
    astray = np.abs(x - nan_median(x)) > 30
    assert astray.sum() < 0.005 * known.sum()  # discs move by less than 15 px


def test_the_upper_floor_is_whole_to_the_end(tracked):
    """A failure means that one jump costs a marker for the rest of the film, or that a marker is taken for
    another."""
    chosen = ("--strip", "4:54", "--ridges", "dark", "--sheets", "7")
    _, x, flags, _ = tracked("released_markers_upper.avi", *chosen)
    assert np.isin(flags, ("ok", "blurred")).all()
    assert np.abs(np.diff(x, axis=0)).max() > 100
    spacing = np.diff(x, axis=1)
    assert np.abs(spacing - np.median(spacing, axis=0)).max() < 3  # a swap would be 160
    assert np.abs(x[-20:] - x[:20]).max() < 5  # it comes to rest where it began


@pytest.mark.parametrize("rows", ["4:54", "8:50"])
def test_markers_before_a_bright_background_have_no_reflection(tracked, rows):
    """Between some of the markers the background is nearly as bright as they are. A failure means an error
    of many pixels on all positions, for light over a height of nearly zero."""
    tracked_with = ("--strip", rows, "--ridges", "dark", "--sheets", "7")
    *_, facts = tracked("released_markers_upper.avi", *tracked_with)
    assert not any("a reflection" in line for line in facts["warnings"])


@pytest.mark.thorough
@pytest.mark.parametrize("rows", ["0:40", "2:38", "8:32"])
def test_no_ridge_of_the_whole_film_leaves_all_others(tracked, rows):
    """A failure means that one ridge hops 27 px away from all others with nothing said."""
    _, x, _, _ = tracked("released_markers.avi", "--strip", rows)
    moved = x - np.nanmedian(x, axis=0)
    own = np.abs(moved - np.nanmedian(moved, axis=1)[:, None])
    assert (own > 20).sum() <= 2


def test_no_part_of_the_sarcomeres_jumps_by_a_pitch_for_one_frame(tracked):
    """A failure means that misread groups (frames 24, 71, 113) pass as measured."""
    _, x, _, _ = tracked("sarcomeres.avi", "--rotate", "90", "--strip", "190:211")
    away = np.abs(np.diff(x, axis=0)) > 9  # discs 13 px apart
    back = away[:-1] & away[1:]
    assert back.sum(axis=1).max() <= 1


def test_two_bands_of_a_high_speed_camera(tracked):
    """Photron's .mraw with its .cih: size, depth and frame rate stand there; two bright bands vibrate along y
    together. A failure means that such recordings are misread, or the camera's rate is not taken."""
    status, x, flags, facts = tracked("two_bands.cih", "--rotate", "90")
    assert status == 1  # every hundredth frame may have been saved
    assert "save step is 100" in " ".join(facts["warnings"])
    assert x.shape == (75, 2) and (flags == "ok").all()
    assert facts["recording"]["depth_bits"] == 8
    assert facts["found"]["clock"] == {"kind": "file", "fps": 15000.0}
    assert facts["found"]["ridges"]["polarity"] == "bright"
    assert 14 < np.diff(np.median(x, axis=0))[0] < 18
    assert np.corrcoef(x.T)[0, 1] > 0.99


@pytest.mark.thorough
@pytest.mark.parametrize("strip", [(), ("--strip", "190:211"), ("--strip", "255:270"), ("--strip", "60:80")])
def test_the_sarcomeres_are_never_a_pitch_off_all_together(tracked, strip):
    """A failure means that a comb that contracts by 3 px is said to have jumped by a pitch, flagged ok."""
    status, x, _, facts = tracked("sarcomeres.avi", "--rotate", "90", *strip)
    assert status == 1
    seen = np.isfinite(x).any(axis=1)
    common = nan_median((x - nan_median(x))[seen], axis=1)
    off = np.abs(common) > 0.6 * facts["found"]["ridges"]["pitch_px"]
    assert np.isfinite(x[seen][off]).sum() <= 1
    assert np.isfinite(x).mean() > 0.25


def test_discs_in_plain_view_are_not_withheld(tracked):
    """In frames 20, 67 to 69 and 115 discs beyond the comb come and go, but none of the others moves. A
    failure means that a comb that lies where it was is withheld as a whole."""
    _, _, flags, _ = tracked("sarcomeres.avi", "--rotate", "90")
    assert ((flags == "doubtful").mean(axis=1) > 0.5).sum() <= 1


@pytest.mark.thorough
def test_sarcomeres_compressed_again_keep_their_numbers(tracked, tmp_path):
    """The film as it is and through another codec shows the same discs. A failure means that at the height of
    a contraction all discs are given as their neighbours, flagged ok, or that these frames are withheld."""
    _, x, _, _ = tracked("sarcomeres.avi", "--rotate", "90")
    film = np.stack(list(open_video(DATA / "sarcomeres.avi").frames()))
    path = write_h264(tmp_path / "again.mkv", film, 23)
    _, again, flags, _ = track(tmp_path / "run", path, ("--rotate", "90"))
    same = np.abs(nan_median(again)[:, None] - nan_median(x)).argmin(axis=1)
    off = np.abs(again - nan_median(again) - (x - nan_median(x))[:, same])
    assert (off > 6).sum() <= 2  # discs 12 px apart
    assert (flags == "doubtful").mean() < 0.05


@pytest.mark.thorough
@pytest.mark.parametrize("noise", [8, 20])
def test_sarcomeres_in_noise_are_never_a_pitch_off_all_together(tracked, tmp_path, noise):
    """Noise hides the ends of the comb, so that it fits a pitch further nearly as well. A failure means that
    all discs are given as their neighbours, flagged ok, in a twentieth or a quarter of all positions."""
    _, x, _, _ = tracked("sarcomeres.avi", "--rotate", "90")
    film = np.stack(list(open_video(DATA / "sarcomeres.avi").frames()))
    noisy = np.rint(film + np.random.default_rng(noise).normal(0, noise, film.shape)).clip(0, 255)
    _, again, _, _ = track(
        tmp_path / "run", write_ffv1(tmp_path / "noisy.mkv", noisy.astype(np.uint8)), ("--rotate", "90")
    )
    same = np.abs(nan_median(again)[:, None] - nan_median(x)).argmin(axis=1)
    off = again - x[:, same]
    assert (np.abs(off - nan_median(off)) > 6).sum() <= 0.02 * np.isfinite(again).sum()  # discs 12 px apart
    assert np.isfinite(again).sum() > 500


@pytest.mark.thorough
def test_a_slow_hand_over_the_upper_floor_renumbers_no_marker(tracked, tmp_path):
    """Something dark comes over two of seven markers and leaves again. A failure means that the others are
    given as their neighbours, flagged ok."""
    chosen = ("--strip", "4:54", "--ridges", "dark", "--sheets", "7")
    _, x, _, _ = tracked("released_markers_upper.avi", *chosen)
    film = np.stack(list(open_video(DATA / "released_markers_upper.avi").frames()))
    frames, _, width = film.shape
    over = np.clip((np.arange(frames) - frames // 4) / (3 * frames // 4 - frames // 4), 0, 1)
    edge = np.where(over > 0, 0.25 * width * np.sin(np.pi * over), -width)
    covered = 1 / (1 + np.exp((np.arange(width) - edge[:, None]) / 6))[:, None]
    path = write_ffv1(tmp_path / "hand.mkv", np.rint(film * (1 - covered) + 25 * covered).astype(np.uint8))
    _, beside, flags, _ = track(tmp_path / "run", path, chosen)
    assert np.nanmax(np.abs(beside - x)) < 20  # 160 px apart
    assert np.isin(flags, ("ok", "blurred")).mean() > 0.75  # two of seven, a third of the time


def test_the_upper_floor_in_poor_jpegs_is_not_given_a_marker_further(tracked, tmp_path):
    """The bright ridges beside the markers come in pairs, which look alike. A failure means that a comb that
    moves by 5 px is said to have jumped to the next pair, flagged ok."""
    _, x, _, _ = tracked("released_markers_upper.avi", "--strip", "4:54", "--ridges", "dark", "--sheets", "7")
    moved = nan_median(x - x[0], axis=1)[:, None]
    film = np.stack(list(open_video(DATA / "released_markers_upper.avi").frames()))
    kind = {"codec": "mjpeg", "pix_fmt": "yuvj420p", "source": "gray", "fps": 25}
    path = write_encoded(tmp_path / "poor.avi", film, **kind, options={"qmin": "20", "qmax": "20"})
    _, poor, _, _ = track(tmp_path / "run", path, ())
    off = poor - moved
    assert (np.abs(off - nan_median(off)) > 60).sum() == 0  # pairs 160 px apart
    assert np.isfinite(poor).mean() > 0.65
