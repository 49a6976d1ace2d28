from datetime import datetime, timedelta

import numpy as np
import pytest
import tifffile

from tests.scenes.films import comb, write_avi, write_encoded
from vision.data import StripMetadata
from vision.errors import InputError
from vision.summary import frame_rate_text
from vision.video import open_video, read_timestamps, strip_profile
from vision.video.times import usual_rate

TIMES_S = np.array([0.0, 0.021, 0.04, 0.0605, 0.08, 0.1])


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
def test_rotation_turns_clockwise_and_cuts_afterwards(tmp_path, rotate):
    """Failure: strip rows are taken before turning, or turned the other way."""
    frames = comb()
    video = open_video(write_avi(tmp_path / "a.avi", frames), rotate=rotate)
    turned = np.rot90(frames, -rotate // 90, axes=(1, 2))
    assert video.shape == turned.shape[1:]
    block = next(video.blocks(slice(2, 7), slice(3, 11)))
    assert np.array_equal(block.pixels, turned[:, 2:7, 3:11])
    assert np.array_equal(next(video.sample(1)), turned[0])


def test_part_of_the_video(tmp_path):
    """Failure: `--frames` renumbers frames, so times and tracks no longer fit the file."""
    frames = comb(count=9)
    video = open_video(write_avi(tmp_path / "a.avi", frames), frames=slice(3, 7), fps=10)
    strip = strip_profile(video, slice(0, 12))
    assert strip.frame.values.tolist() == [3, 4, 5, 6]
    assert np.allclose(strip.time_s, [0.3, 0.4, 0.5, 0.6])
    assert (strip.frames_expected, strip.clock_kind, strip.fps) == (4, "given", 10.0)
    assert open_video(tmp_path / "a.avi", frames=slice(3, 9)).warnings == ()
    assert "has 9" in open_video(tmp_path / "a.avi", frames=slice(3, 90)).warnings[0]


def test_bad_requests_are_named(tmp_path):
    """Failure: a slip of the pen ends in a traceback or in an empty result."""
    path = write_avi(tmp_path / "a.avi", comb())
    for rows in (slice(5, 40), slice(-3, 5), slice(5, 5)):
        with pytest.raises(InputError, match="`rows`: expected a range within 0:12"):
            strip_profile(open_video(path), rows)
    with pytest.raises(InputError, match="found 0:12 in steps of 2"):
        strip_profile(open_video(path), slice(0, 12, 2))
    with pytest.raises(InputError, match="found 0:8:2"):
        open_video(path, frames=slice(0, 8, 2))
    for options in ({"rotate": 45}, {"fps": 0}, {"fps": float("nan")}, {"frames": slice(9, 12)}):
        with pytest.raises(InputError, match=f"`{next(iter(options))}`"):
            open_video(path, **options)


def test_a_recording_shows_itself_in_one_line(tmp_path):
    """Failure: a notebook shows addresses in memory in place of the recording's size and rate."""
    tifffile.imwrite(tmp_path / "stack.tif", comb(6, 12, 50), photometric="minisblack")
    assert repr(open_video(tmp_path / "stack.tif", fps=25)) == (
        "<stack.tif: 6 frames of 50 x 12 px, 8 bit, 25 frames/s (given)>"
    )


def test_frames_beyond_the_end_are_reported_where_none_are_declared_too(tmp_path):
    """Failure: frames 0:500 of a shorter Matroska file passes as if all were there."""
    path = write_encoded(
        tmp_path / "a.mkv", comb(count=20, rows=32), codec="ffv1", pix_fmt="gray", source="gray"
    )
    assert "500" in open_video(path, frames=slice(0, 500)).warnings[0]
    assert open_video(path, frames=slice(0, 20)).warnings == ()


@pytest.mark.parametrize(
    ("header", "scale", "line"),
    [
        ("", 1, "{t!r}"),
        ("time_s\n", 1, "{t!r}"),
        ("time_ms\n", 1e3, "{t!r}"),
        ("Timestamp (us)\n", 1e6, "{t!r}"),
        ("t [ns]\n", 1e9, "{t!r}"),
        ("frame,time_ms\n", 1e3, "{n},{t!r}"),
        ("# camera 7\nframe;timestamp [µs];gain\n", 1e6, "{n};{t!r};2.5"),
        ("frame, time (ms)\n", 1e3, "{n} {t!r}"),
        ("# frame time\n", 1, "{n},{t!r}"),
        ("frame time [us]\n", 1e6, "{n} {t!r}"),
        ("", 1, "{n}\t{t!r}"),
        ("\ufefftime_s\r\n", 1, "{t!r}\r"),
    ],
)
def test_layouts_and_units(tmp_path, header, scale, line):
    """Failure: times are off by a factor of a thousand, or taken from the frame-number column."""
    path = tmp_path / "t.csv"
    rows = "\n".join(line.format(n=n, t=float(t * scale)) for n, t in enumerate(TIMES_S))
    path.write_text(header + rows, encoding="utf-8", newline="")
    times_s, warnings = read_timestamps(path)
    assert np.allclose(times_s, TIMES_S, rtol=1e-12)
    assert warnings == ()


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("", "{0:%H:%M:%S.%f}"),
        ("Zeit (hh:mm:ss.ms)\n", "{0:%d.%m.%Y %H:%M:%S},{2}"),
        ("frame,timestamp\n", "{1},{0:%Y-%m-%dT%H:%M:%S.%f}Z"),
        ("frame;time\n", "{1};{0:%Y-%m-%dT%H:%M:%S.%f}+01:00"),
        ("Date;Time;Frame\n", "{0:%d.%m.%Y;%H:%M:%S},{2};{1}"),
        ("", "{0:%I:%M:%S.%f %p}"),
    ],
)
def test_times_of_the_day_become_seconds(tmp_path, header, line):
    """Failure: stamps of the computer's clock cannot be read, jump at midnight, or are read in ms."""
    start, n = datetime(2026, 11, 30, 23, 59, 59), np.arange(120)
    stamps = [start + timedelta(microseconds=int(k) * 16_667) for k in n]
    lines = [line.format(t, k, f"{t:%f}") for k, t in enumerate(stamps)]
    (tmp_path / "t.csv").write_text(header + "\n".join(lines))
    times_s, warnings = read_timestamps(tmp_path / "t.csv")
    np.testing.assert_allclose(times_s, 86399 + 0.016667 * n, atol=1e-6)
    assert warnings == ()


@pytest.mark.parametrize("fps", [7.3, 24.97, 60.0])
def test_whole_seconds_are_spread_evenly(tmp_path, fps):
    """Failure: of times in whole seconds one frame in 60 is used, or they are off by a second."""
    true_s = 3600.37 + np.arange(300) / fps
    stamps = [f"{datetime(2026, 1, 1) + timedelta(seconds=int(t)):%H:%M:%S}" for t in true_s]
    (tmp_path / "t.txt").write_text("\n".join(stamps))
    times_s, warnings = read_timestamps(tmp_path / "t.txt")
    np.testing.assert_allclose(times_s, true_s, atol=1 / fps)
    assert "in steps of 1 s are spread evenly" in "".join(warnings)
    late = np.where(np.arange(300) < 150, true_s, true_s + 3)  # frames were lost
    np.savetxt(tmp_path / "t.txt", np.floor(late), fmt="%d")
    assert "do not increase" in "".join(read_timestamps(tmp_path / "t.txt")[1])


@pytest.mark.parametrize(("mark", "rate"), [(":", 25), (";", 30), (":", 50)])
def test_timecode_counts_the_frames_of_a_second(tmp_path, mark, rate):
    """Failure: timecode is refused, or its frames are taken for hundredths or for the only times."""
    n = np.arange(40, 40 + 4 * rate)
    lines = [f"{k};10:59:{30 + k // rate}{mark}{k % rate:02d}" for k in n]
    (tmp_path / "t.csv").write_text("frame;timecode\n" + "\n".join(lines))
    times_s, warnings = read_timestamps(tmp_path / "t.csv")
    np.testing.assert_allclose(times_s, 10 * 3600 + 59 * 60 + 30 + n / rate, atol=1e-5)
    assert f"timecode is read at {rate} frames/s" in "".join(warnings)
    (tmp_path / "t.csv").write_text("\n".join(lines[: rate // 3]).replace(":31", ":30"))
    with pytest.raises(InputError, match="timecode of a second"):
        read_timestamps(tmp_path / "t.csv")


def test_a_rate_from_rounded_times_is_not_rounded(tmp_path):
    """Failure: 60 frames/s in whole ms are 58.8, and in µs 59.9988, in the methods of a manuscript."""
    stamps = np.delete(np.arange(300), [50, 51, 120]) / 60
    for digits in (3, 6):
        np.savetxt(tmp_path / "t.txt", stamps, fmt=f"%.{digits}f")
        assert usual_rate(read_timestamps(tmp_path / "t.txt")[0]) == pytest.approx(60, rel=0.3 * 10**-digits)


@pytest.mark.parametrize("separator", [";", "\t", ","])
def test_times_that_were_cut_short_are_refused(tmp_path, separator):
    """Failure: a last line without its time is taken for the only line of data."""
    lines = [f"{n}{separator}{t}" for n, t in enumerate(TIMES_S)]
    (tmp_path / "t.csv").write_text("\n".join(lines)[: -len(lines[-1]) + 1])
    with pytest.raises(InputError, match="the same number of columns"):
        read_timestamps(tmp_path / "t.csv")


def test_times_reach_the_profile(tmp_path):
    """Failure: given times are ignored in favour of the playback rate."""
    video_path = write_avi(tmp_path / "a.avi", comb())
    (tmp_path / "t.txt").write_text("\n".join(map(str, TIMES_S)))
    strip = strip_profile(open_video(video_path, timestamps=tmp_path / "t.txt"), slice(0, 12))
    assert np.array_equal(strip.time_s, TIMES_S)
    assert (strip.clock_kind, round(strip.fps)) == ("given", 50)
    assert frame_rate_text(StripMetadata.of(strip)) == "from the time stamps in t.txt, about 50 frames/s"


@pytest.mark.parametrize(("header", "scale", "told"), [("", 1000, 1), ("time_ms\n", 1000, 0), ("", 1, 0)])
def test_times_in_ms_that_do_not_say_so(tmp_path, header, scale, told):
    """Failure: a film of five seconds lasts more than an hour, and nobody is told."""
    path = write_avi(tmp_path / "a.avi", comb())
    played = np.arange(6) / open_video(path).clock.fps
    (tmp_path / "t.txt").write_text(header + "\n".join(map(str, scale * played)))
    warnings = open_video(path, timestamps=tmp_path / "t.txt").warnings
    assert len(warnings) == told
    assert not told or "(time_ms)" in warnings[0]


def test_backward_times_are_reported(tmp_path):
    """Failure: a clock that was reset in the middle goes unnoticed."""
    (tmp_path / "t.txt").write_text("0\n1\n2\n1.5\n3\n4\n")
    video = open_video(write_avi(tmp_path / "a.avi", comb()), timestamps=tmp_path / "t.txt")
    assert "1 of 6 times do not increase, the first at frame 3" in video.warnings[0]
    assert "not used for the clocks and stick phases" in video.warnings[0]
    assert "restart" not in video.warnings[0]


def test_the_frame_from_which_times_restart_is_named(tmp_path):
    """Failure: nothing says where a clock was reset, nor what becomes of the frames after it."""
    times = [*np.arange(60) / 20, *np.arange(40) / 20]
    (tmp_path / "t.txt").write_text("\n".join(map(str, times)))
    _, (line,) = read_timestamps(tmp_path / "t.txt")
    assert "40 of 100 times do not increase" in line
    assert "restart from frame 60 on" in line
    assert "0:60 or 60:100" in line


@pytest.mark.parametrize("header", ["", "t (s)\n"])
@pytest.mark.parametrize("times_s", [np.arange(6) / 60, np.arange(6) / 25, 99.9 + np.arange(6) / 25])
def test_decimal_commas(tmp_path, header, times_s):
    """Failure: 0,016667 is read as a frame number and 16 667 s."""
    path = tmp_path / "t.txt"
    path.write_text(header + "\n".join(f"{t:.6f}".replace(".", ",") for t in times_s))
    assert np.allclose(read_timestamps(path)[0], times_s, atol=1e-6)


@pytest.mark.parametrize("lines", ["1,50\n1,54\n1,58", "0,0,016667\n1,0,033333", "0,5\n1\n1,5"])
def test_commas_of_unknown_meaning_are_refused(tmp_path, lines):
    """Failure: commas that may separate columns or be decimal marks are read as one of the two."""
    path = tmp_path / "t.txt"
    path.write_text(lines)
    with pytest.raises(InputError, match="commas either between columns or in numbers"):
        read_timestamps(path)


@pytest.mark.parametrize("mark", [".", ","])
@pytest.mark.parametrize(("row", "unit_s"), [("{0}", 1e-3), ("{1};{0}", 1e-3), ("{1} {0}", 1e-6)])
def test_marks_between_thousands_are_no_decimal_marks(tmp_path, mark, row, unit_s):
    """Failure: whole milliseconds 983, 1.000, 1.017 start again every second, with advice to cut the film."""
    whole = 500 + 17 * np.arange(120) * round(1e-3 / unit_s)
    path, header = tmp_path / "t.txt", f"time_{'ms' if unit_s == 1e-3 else 'us'}"
    lines = [row.format(f"{t:,}".replace(",", mark), k) for k, t in enumerate(whole)]
    path.write_text("\n".join([header, *lines]))
    times_s, warnings = read_timestamps(path)
    assert warnings == ()
    np.testing.assert_allclose(times_s, unit_s * whole)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_times_in_any_encoding_keep_their_unit(tmp_path, encoding):
    """Failure: microseconds, with the sign of another encoding above them, are read as seconds."""
    (tmp_path / "t.csv").write_text('"Zeit (µs)"\n"0"\n"16667"\n"33333"\n', encoding=encoding)
    np.testing.assert_allclose(read_timestamps(tmp_path / "t.csv")[0], [0, 0.016667, 0.033333])


def test_numbered_whole_times_are_two_columns(tmp_path):
    """Failure: the times of frames that are counted in the first column are read as decimals."""
    path = tmp_path / "t.txt"
    path.write_text("7,980\n8,1000\n9,1020")
    assert np.array_equal(read_timestamps(path)[0], [980, 1000, 1020])


def test_given_times_state_the_duration(tmp_path):
    """Failure: a video with the time of every frame says that its duration is not known."""
    (tmp_path / "t.txt").write_text("\n".join(str(3 + n / 10) for n in range(6)))
    video = open_video(write_avi(tmp_path / "a.avi", comb()), timestamps=tmp_path / "t.txt")
    assert "0.6 s" in video._repr_html_()


@pytest.mark.parametrize(
    "text", ["", "time_s\n", "0\n1\nx\n3\n4\n5", "0\n1\n2\n3\n4", "0\n1,2\n3\n4\n5\n6", "0\nnan\n2\n3\n4\n5"]
)
def test_bad_time_files(tmp_path, text):
    """Failure: a wrong file of time stamps is used as far as it goes."""
    (tmp_path / "t.txt").write_text(text)
    video_path = write_avi(tmp_path / "a.avi", comb())
    with pytest.raises(InputError):
        open_video(video_path, timestamps=tmp_path / "t.txt")
    with pytest.raises(InputError):
        open_video(video_path, timestamps=tmp_path / "missing.txt")
    with pytest.raises(InputError):
        open_video(video_path, timestamps=tmp_path / "t.txt", fps=20)
