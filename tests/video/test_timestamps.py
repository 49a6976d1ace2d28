import numpy as np
import pytest

from tests.scenes.films import comb, write_avi
from vision.errors import InputError
from vision.video import open_video, strip_profile
from vision.video.timestamps import read_timestamps

TIMES_S = np.array([0.0, 0.021, 0.04, 0.0605, 0.08, 0.1])


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


def test_times_reach_the_profile(tmp_path):
    """Failure: given times are ignored in favour of the playback rate."""
    video_path = write_avi(tmp_path / "a.avi", comb())
    (tmp_path / "t.txt").write_text("\n".join(map(str, TIMES_S)))
    strip = strip_profile(open_video(video_path, timestamps=tmp_path / "t.txt"), slice(0, 12))
    assert np.array_equal(strip.time_s, TIMES_S)
    assert (strip.clock_kind, round(strip.fps)) == ("given", 50)


def test_backward_times_are_told(tmp_path):
    """Failure: a clock that was reset in the middle goes unnoticed."""
    (tmp_path / "t.txt").write_text("0\n1\n2\n1.5\n3\n4\n")
    video = open_video(write_avi(tmp_path / "a.avi", comb()), timestamps=tmp_path / "t.txt")
    assert "do not grow" in video.warnings[0]


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
