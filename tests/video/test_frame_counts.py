"""Frames that never reached the file are counted from the times of those that did."""

import numpy as np
import pytest

from tests.scenes.films import comb, write_avi, write_encoded
from vision.video import open_video, strip_profile
from vision.video.frame_counts import lost_between

FRAMES = 2000


def stamps(*, fps=60.0, lost=(), jitter=0.0, rounded_s=None):
    """Times of the frames that arrived, s."""
    noise = np.random.default_rng(3).uniform(-jitter, jitter, FRAMES)
    times_s = np.delete((np.arange(FRAMES) + noise) / fps, list(lost))
    return times_s if rounded_s is None else np.round(times_s / rounded_s) * rounded_s


@pytest.mark.parametrize("jitter", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("share", [0.002, 0.01, 0.1])
def test_lost_frames_are_counted_whatever_the_jitter(share, jitter):
    """Failure: frames the camera lost go unnoticed, or jitter of the stamps is taken for loss."""
    gone = np.flatnonzero(np.random.default_rng(4).random(FRAMES) < share)
    gone = gone[(gone > 0) & (gone < FRAMES - 1)]
    count, first = lost_between(stamps(lost=gone, jitter=jitter))
    assert count == pytest.approx(gone.size, abs=0.005 * gone.size)
    assert first == gone[0] - 1


@pytest.mark.parametrize("fps", [25, 60, 140, 400, 900, 1000])
def test_times_rounded_to_a_millisecond_lose_nothing(fps):
    """Failure: Matroska's millisecond is taken for lost frames at high rates (1 and 2 ms steps at 900/s)."""
    assert lost_between(stamps(fps=fps, rounded_s=1e-3)) == (0, 0)
    longest = np.diff(stamps(fps=fps, rounded_s=1e-3)).max() * fps
    assert fps != 900 or longest > 1.5  # the bare rule, 1.5 times the usual step, fails here


def test_a_frame_that_only_came_late_is_not_lost():
    """Failure: a busy computer's late stamps count as lost frames."""
    times_s = np.arange(100.0) / 50
    times_s[40:43] += [0.05, 0.035, 0.015]
    assert np.diff(times_s).max() > 3 / 50
    assert lost_between(times_s) == (0, 0)


@pytest.mark.parametrize(
    "times_s", [np.empty(0), np.zeros(1), np.arange(2.0), np.full(9, np.nan), np.zeros(9), -np.arange(9.0)]
)
def test_no_usable_times_count_nothing(times_s):
    """Failure: a recording of one frame, or a still clock, ends in a traceback or in phantom losses."""
    assert lost_between(times_s) == (0, 0)


def test_a_frame_without_a_time_is_no_gap():
    """Failure: a corrupt frame, whose time is unknown, is counted twice."""
    times_s = np.arange(100.0)
    times_s[50] = np.nan
    assert lost_between(times_s) == (0, 0)


def test_gaps_in_given_times_reach_counts_and_warnings(tmp_path):
    """Failure: `track` ends with status 0 although the camera lost frames."""
    frames = comb(count=40)
    times = np.delete(np.arange(43), [20, 21, 30]) * 0.04
    (tmp_path / "t.txt").write_text("\n".join(map(str, times)))
    path = write_avi(tmp_path / "a.avi", frames)
    strip = strip_profile(open_video(path, timestamps=tmp_path / "t.txt"), slice(0, 12))
    assert (strip.frames_expected, strip.frames_read, strip.frames_lost) == (43, 40, 3)
    assert "3 frame(s) lost where its times leap, the first after place 19" in strip.warnings
    whole = strip_profile(open_video(path, fps=25), slice(0, 12))
    assert (whole.frames_lost, whole.warnings) == (0, "")


def test_the_missing_end_of_a_matroska_file_is_counted(tmp_path):
    """Failure: half a recording reads as "35 of 35 frames"."""
    frames = comb(count=60, rows=32)
    path = write_encoded(tmp_path / "a.mkv", frames, codec="ffv1", pix_fmt="gray", source="gray")
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    strip = strip_profile(open_video(path), slice(0, 32))
    assert strip.frames_read < 45
    assert strip.frames_expected == pytest.approx(60, abs=1)
    assert strip.frames_lost == strip.frames_expected - strip.frames_read
    assert "are missing" in strip.warnings


def test_frames_beyond_the_end_are_told_without_a_promise_too(tmp_path):
    """Failure: --frames 0:500 of a shorter Matroska file passes as if all were there."""
    path = write_encoded(
        tmp_path / "a.mkv", comb(count=20, rows=32), codec="ffv1", pix_fmt="gray", source="gray"
    )
    assert "500" in open_video(path, frames=slice(0, 500)).warnings[0]
    assert open_video(path, frames=slice(0, 20)).warnings == ()
