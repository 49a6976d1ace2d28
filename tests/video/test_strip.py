import errno
import os
import tracemalloc

import numpy as np
import pytest
import xarray as xr

from tests.scenes.films import comb, write_avi, write_encoded
from vision.data import STRIP, StripMetadata, operations_of
from vision.errors import InputError
from vision.video import VideoSettings, open_video, reference_frame, strip_profile
from vision.video.strip import FrameStore, is_blank, row_means
from vision.video.times import lost_between


@pytest.mark.parametrize(("dtype", "top"), [(np.uint8, 255), (np.uint16, 65535), (np.float32, 1e4)])
@pytest.mark.parametrize("rows", [1, 84, 300])
def test_row_means_are_exact(dtype, top, rows):
    """Failure: sums overflow their type at some depth or height."""
    pixels = np.random.default_rng(0).uniform(0.9 * top, top, (3, rows, 20)).astype(dtype)
    assert np.allclose(row_means(pixels), pixels.mean(axis=1, dtype=np.float64), rtol=1e-6)


def test_profile_coordinates(tmp_path):
    """Failure: columns or frames are counted from the cut instead of from the file."""
    frames = comb()
    seen = []
    video = open_video(write_avi(tmp_path / "a.avi", frames))
    strip = strip_profile(video, slice(2, 9), columns=slice(10, 30), progress=lambda *n: seen.append(n))
    assert strip.dims == ("frame", "x")
    assert (strip.name, strip.dtype) == ("intensity", np.float32)
    assert strip.x.values.tolist() == list(range(10, 30))
    assert (strip.strip_z0, strip.strip_z1, strip.strip_how) == (2, 9, "given")
    assert np.allclose(strip, frames[:, 2:9, 10:30].mean(axis=1), rtol=1e-6)
    assert seen[-1] == (6, 6)


def test_profile_is_as_declared_and_says_how_it_was_made(tmp_path):
    """Failure: a later stage refuses the strip, or how the pixels were read is not in it."""
    strip = strip_profile(open_video(write_avi(tmp_path / "a.avi", comb())), slice(2, 9))
    STRIP.check(strip)
    facts = StripMetadata.of(strip)
    assert (facts.container, facts.codec, facts.pixel_format) == ("avi", "uncompressed", "grey 8 bit")
    assert (facts.decoder, facts.grey, facts.warnings) == ("none", "values as stored", [])
    assert {*strip.attrs} == {*facts.attrs(), "units", "long_name", "operations"}
    (operation,) = operations_of(strip)
    assert operation["operation"] == "strip_profile"
    assert (operation["parameters"]["rows"], operation["parameters"]["columns"]) == ([2, 9], None)


def test_metadata_can_be_saved(tmp_path):
    """Failure: an attribute netCDF cannot hold breaks writing the run."""
    strip = strip_profile(open_video(write_avi(tmp_path / "a.avi", comb())), slice(0, 12))
    strip.attrs = StripMetadata.of(strip).attrs()
    strip.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with xr.open_dataarray(tmp_path / "a.nc", engine="h5netcdf") as saved:
        assert (saved.attrs["codec"], [*saved.attrs["warnings"]]) == ("uncompressed", [])


def test_spilled_profile_is_the_same(tmp_path):
    """Failure: a long recording gives other values than a short one, or leaves files behind."""
    path = write_avi(tmp_path / "a.avi", comb(count=700))
    kept = strip_profile(open_video(path), slice(0, 12))
    spilled = strip_profile(open_video(path), slice(0, 12), settings=VideoSettings(spill_bytes=1000))
    assert np.array_equal(kept, spilled)


@pytest.mark.parametrize("spill_bytes", [0, 1 << 30])
@pytest.mark.parametrize("expected", [None, 3, 5000])
def test_store_grows(expected, spill_bytes):
    """Failure: rows are lost when a file holds more or fewer frames than expected."""
    store = FrameStore(4, expected=expected, settings=VideoSettings(spill_bytes=spill_bytes))
    rows = np.arange(8000, dtype=np.float32).reshape(-1, 4)
    for part in np.array_split(rows, 13):
        store.append(part)
    assert np.array_equal(store.rows(), rows)


def test_memory_does_not_grow_with_the_video(tmp_path):
    """Failure: frames are kept; a 100 GB recording would need 100 GB of memory."""
    peaks = []
    for count in (2000, 4000):  # both fill the buffers of blocks that are read ahead
        path = write_avi(
            tmp_path / "a.avi", np.tile(comb(count=10, rows=60, columns=100), (count // 10, 1, 1))
        )
        tracemalloc.start()
        strip_profile(open_video(path), slice(10, 50))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    profile_bytes = 2000 * 100 * 4
    assert peaks[1] - peaks[0] < 4 * profile_bytes + (1 << 20)


def profiles(count=40):
    x = np.arange(400)
    t = np.arange(count)[:, None]
    rng = np.random.default_rng(5)
    wave = 100 + 20 * np.cos(2 * np.pi * (x - 0.7 * t) / 20) + 0.02 * x
    return (wave + rng.normal(0, 0.3, wave.shape)).astype(np.float32)


def blanks(profile):
    return np.flatnonzero(is_blank(profile, np.ones(len(profile), bool), saturation_level=255.0)).tolist()


@pytest.mark.parametrize("level", [0.0, 4.0, 128.0, 250.0, 255.0])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_empty_frames_are_blank(level, noise):
    """Failure: a white, black or grey frame is tracked as sheets."""
    profile = profiles()
    profile[[7, 39]] = np.clip(level + np.random.default_rng(1).normal(0, noise, (2, 400)), 0, 255)
    assert blanks(profile) == [7, 39]


def test_an_overexposed_frame_is_blank():
    """Failure: a frame in which only the light's gradient is left is tracked as sheets."""
    profile = profiles()
    profile[9] = 180 + 0.02 * np.arange(400)
    assert 0.1 < profile[9].std() / profile[8].std() < 0.35
    assert blanks(profile) == [9]


def test_white_frames_are_blank_where_they_are_the_most():
    """Failure: a recording that is mostly white makes its white frames the rule."""
    profile = profiles()
    rng = np.random.default_rng(1)
    profile[10:] = np.clip(253 + rng.normal(0, 0.3, (30, 400)), 0, 255)
    assert blanks(profile) == [*range(10, 40)]


def test_dim_blurred_and_bright_frames_are_not_blank():
    """Failure: flicker, a dimmed lamp or motion blur costs valid frames."""
    profile = profiles()
    profile[3] *= 0.25
    profile[4] *= 1.4
    profile[5] = 100 + 0.25 * (profile[5] - 100)
    assert blanks(profile) == []


def test_all_blank_is_bad_input(tmp_path):
    """Failure: a recording with the lens cap on gives an empty run instead of a message."""
    path = write_avi(tmp_path / "a.avi", np.full((5, 12, 50), 17, np.uint8))
    with pytest.raises(InputError, match="shows something"):
        strip_profile(open_video(path), slice(0, 12))
    with pytest.raises(InputError, match="shows something"):
        reference_frame(open_video(path))


def test_reference_frame_skips_a_white_start(tmp_path):
    """Failure: the overview picture is white."""
    frames = comb()
    frames[0] = 255
    assert np.array_equal(reference_frame(open_video(write_avi(tmp_path / "a.avi", frames))), frames[1])


def test_a_full_disk_for_a_long_recording_is_reported(monkeypatch):
    """Failure: the process is killed hours into a recording, as the mapped file finds the disk full."""

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(InputError, match=r"GiB for I\(x, t\).*a full disk"):
        FrameStore(100, expected=1000, settings=VideoSettings(spill_bytes=1000, memory_bytes=100_000))
    kept = FrameStore(100, expected=1000, settings=VideoSettings(spill_bytes=1000))  # fits into memory
    kept.append(np.ones((1000, 100), np.float32))
    assert (kept.rows() == 1).all()


def test_an_absurd_frame_count_takes_no_memory():
    """Failure: a damaged header that announces 4 thousand million frames ends as out of memory."""
    store = FrameStore(
        1920, expected=2**32 - 1, settings=VideoSettings(spill_bytes=1 << 16, memory_bytes=1 << 16)
    )
    for n in range(20):
        store.append(np.full((8, 1920), n, np.float32))
    assert store.rows().nbytes == 20 * 8 * 1920 * 4
    assert (store.rows()[::8, 0] == np.arange(20)).all()


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
    assert "3 frames lost according to gaps in its times, the first after frame 19" in strip.warnings[0]
    part = open_video(path, timestamps=tmp_path / "t.txt", frames=slice(10, None))
    assert "the first after frame 19" in strip_profile(part, slice(0, 12)).warnings[0]
    whole = strip_profile(open_video(path, fps=25), slice(0, 12))
    assert (whole.frames_lost, whole.warnings) == (0, [])


def test_the_missing_end_of_a_matroska_file_is_counted(tmp_path):
    """Failure: half a recording reads as "35 of 35 frames"."""
    frames = comb(count=60, rows=32)
    path = write_encoded(tmp_path / "a.mkv", frames, codec="ffv1", pix_fmt="gray", source="gray")
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    strip = strip_profile(open_video(path), slice(0, 32))
    assert strip.frames_read < 45
    assert strip.frames_expected == pytest.approx(60, abs=1)
    assert strip.frames_lost == strip.frames_expected - strip.frames_read
    assert "are missing" in strip.warnings[0]
