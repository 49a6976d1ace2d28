"""Reading ahead and decoding side by side, and what becomes of a disk that does not answer."""

import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import pytest
import tifffile

from tests.scenes.films import comb, write_avi
from vision.errors import InputError
from vision.files import answered, begun, in_threads, prefetch
from vision.video import VideoSettings, find_strip, open_video, reference_frame, strip_profile
from vision.video.reader import MappedReader


def test_prefetch_keeps_order_errors_and_ends():
    """Failure: blocks are swapped, an error in the reading thread is swallowed, or its thread never ends."""
    assert list(prefetch(iter(range(50)), Path("a"))) == list(range(50))

    def broken():
        yield 1
        raise InputError("a", "b", "c")

    items = prefetch(broken(), Path("a"))
    assert next(items) == 1
    with pytest.raises(InputError):
        next(items)
    closed = []

    def endless():
        try:
            while True:
                yield 0
        finally:
            closed.append(True)

    items = prefetch(endless(), Path("a"))
    next(items)
    items.close()
    assert closed == [True]


def test_a_disk_that_never_answers_is_given_up(tmp_path, monkeypatch):
    """Failure: a run whose network is gone waits for ever, or does not end when it is told to."""
    video = open_video(write_avi(tmp_path / "a.avi", comb()))
    lost = threading.Event()
    stored = MappedReader._stored

    def stops(reader, first, last, rows):
        return stored(reader, first, last, rows) if last == first + 1 else lost.wait()

    monkeypatch.setattr(MappedReader, "_stored", stops)
    try:
        with pytest.raises(
            InputError, match=r"a\.avi: expected a disk .* answers; found no answer for 0\.2 s"
        ):
            strip_profile(video, settings=VideoSettings(answer_s=0.2))
    finally:
        lost.set()


def test_a_reader_that_computes_is_waited_for(monkeypatch):
    """Failure: a film is given up whose frames take long to decode on a busy machine."""
    asked = []

    def computed_s():
        asked.append(len(asked))
        return float(len(asked))

    def slow():
        while len(asked) < 6:
            time.sleep(0.001)
        yield 1

    monkeypatch.setattr(time, "process_time", computed_s)
    assert list(prefetch(slow(), Path("a"), 0.01)) == [1]


@pytest.mark.parametrize("look", [find_strip, reference_frame])
def test_a_disk_that_dies_before_the_film_is_read_is_given_up(tmp_path, monkeypatch, look):
    """Failure: a run waits for ever where the strip or the first picture is looked for."""
    video = open_video(write_avi(tmp_path / "a.avi", comb()), answer_s=0.2)
    lost = threading.Event()
    monkeypatch.setattr(MappedReader, "_stored", lambda *_: lost.wait(20))
    try:
        with pytest.raises(
            InputError, match=r"a\.avi: expected a disk .* answers; found no answer for 0\.2 s"
        ):
            look(video)
    finally:
        lost.set()


@pytest.mark.parametrize(("name", "asked"), [("a.avi", "open"), ("frames", "iterdir"), ("a.avi", "stat")])
def test_a_disk_that_dies_while_a_film_is_opened_is_given_up(tmp_path, monkeypatch, name, asked):
    """Failure: a run waits for ever for a film on a disk whose connection is lost."""
    path = write_avi(tmp_path / "a.avi", comb()) if name == "a.avi" else tmp_path / name
    path.mkdir(exist_ok=True) if name == "frames" else None
    lost = threading.Event()
    real = getattr(Path, asked)

    def dead(self, *arguments, **options):
        return lost.wait(20) if self == path else real(self, *arguments, **options)

    monkeypatch.setattr(Path, asked, dead)
    try:
        with pytest.raises(InputError, match=rf"{name}: expected a disk .* found no answer for 0\.2 s"):
            open_video(path, answer_s=0.2)
    finally:
        lost.set()


def test_what_is_asked_of_a_disk_comes_back_as_it_is():
    """Failure: a film that cannot be read is taken for a disk that does not answer."""
    assert answered(lambda: None, Path("a")) is None
    with pytest.raises(ZeroDivisionError):
        answered(lambda: 1 // 0, Path("a"))


def test_what_is_begun_runs_before_it_is_asked_for():
    """Failure: a run waits for what it could have had read meanwhile."""
    done = threading.Event()
    result = begun(done.set, Path("a"))
    assert done.wait(20)
    assert result() is None


def test_threads_keep_the_order_and_raise_what_went_wrong():
    """Failure: frames change places with the load of the machine, or an error ends a recording early."""
    assert list(in_threads(lambda n: n, range(100))) == [*range(100)]
    with pytest.raises(ZeroDivisionError):
        list(in_threads(lambda n: 1 / (50 - n), range(100)))


ENDS = """
import sys, threading
from pathlib import Path
import vision.video.stacks as stacks
from vision.errors import InputError
from vision.video import VideoSettings, open_video, strip_profile

decoded, decode = [], getattr(stacks, sys.argv[2])

def dies(*arguments, **options):
    decoded.append(1)
    if len(decoded) > 20:
        threading.Event().wait()
    return decode(*arguments, **options)

video = open_video(sys.argv[1], answer_s=0.5)
setattr(stacks, sys.argv[2], dies)
try:
    strip_profile(video, slice(0, 12), settings=VideoSettings(answer_s=0.5))
except InputError as error:
    print(error)
"""


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "decode"), [("images", "_decode_image"), ("stack", "_decode_page")])
def test_a_process_ends_whose_disk_dies_while_images_are_decoded(tmp_path, kind, decode):
    """Failure: the line is printed, and then the process waits for ever for the threads that decode."""
    frames = comb(60)
    path = tmp_path / kind
    if kind == "images":
        path.mkdir()
        for number, frame in enumerate(frames):
            cv2.imwrite(str(path / f"{number:04}.png"), frame)
    else:
        tifffile.imwrite(path, frames, compression="zlib", photometric="minisblack")
    done = subprocess.run(
        [sys.executable, "-c", ENDS, path, decode], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.count("\n") == 1
    assert f"{kind}: expected a disk or network that answers" in done.stdout
