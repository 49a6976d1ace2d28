"""`track VIDEO` against a hostile world, as processes: one clear line, no traceback, nothing half-written."""

import errno
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import tifffile

from tests.scenes.comb_video import frames_of, positions, write_video
from tests.scenes.films import write_avi, write_encoded
from vision.command.console import complain, one_line, say
from vision.command.main import run

pytestmark = pytest.mark.usefixtures("without_pictures")

ROOT = Path(__file__).parents[2]
COMMAND = [sys.executable, str(ROOT / "cli.py")]
UNDRAWN = [sys.executable, "-m", "tests.scenes.undrawn"]
PLACE = os.environ | {"PYTHONPATH": str(ROOT)}


@pytest.fixture(scope="module")
def frames():
    return frames_of(positions())


@pytest.fixture
def video(place, frames):
    return write_video(place / "comb.tif", frames)


def start(*arguments, command=COMMAND, **options):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": PLACE}
    return subprocess.Popen([*command, *map(str, arguments)], **(pipes | options))


def finish(*arguments, **options):
    """Exit status, standard output and standard error of a process."""
    process = start(*arguments, **options)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


# --- files that are no recordings ---------------------------------------------------------------------------


@pytest.mark.posix
@pytest.mark.parametrize(
    "options", ["--force", "--timestamps", "--corrections", "--config", "simulate made --config"]
)
def test_a_pipe_given_to_any_option_is_refused(options, video, refused):
    """A failure means a program that waits for ever. If it does open the pipe, this test ends it."""
    os.mkfifo("pipe")
    writer = threading.Timer(20, lambda: os.close(os.open("pipe", os.O_WRONLY | os.O_NONBLOCK)))
    writer.start()
    try:
        said = refused(*(() if "simulate" in options else (video,)), *options.split(), "pipe")
    finally:
        writer.cancel()
    assert said.startswith("track: pipe: expected a ")
    assert "damaged" not in said


def note(path, frames):
    path.write_text("This is not a video.\n" * 100)


def nothing(path, frames):
    path.write_bytes(b"")


def noise(path, frames):
    path.write_bytes(np.random.default_rng(0).bytes(50_000))


def noise_behind(magic):
    def make(path, frames):
        path.write_bytes(magic + np.random.default_rng(0).bytes(50_000))

    return make


def unknown_codec(path, frames):
    write_avi(path, frames, fourcc=b"QZQZ")


def mp4_without_index(path, frames):
    write_encoded(path, frames, codec="libx264", pix_fmt="yuv420p", source="gray")
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])


def flat(path, frames):
    write_video(path, np.full_like(frames, 90))


def no_ridges(path, frames):
    write_video(path, np.random.default_rng(0).normal(100, 2, frames.shape).astype(np.uint8))


def all_nan(path, frames):
    write_video(path, np.full(frames.shape, np.nan, np.float32))


def sizes_change(path, frames):
    with tifffile.TiffWriter(path) as out:
        for n, frame in enumerate(frames[:9]):
            out.write(frame if n != 7 else frame[:, :100])


def folder_of_text(path, frames):
    path.mkdir()
    (path / "a.txt").write_text("x")


def folder_of_several_sizes(path, frames):
    path.mkdir()
    for n, frame in enumerate(frames[:9]):
        cv2.imwrite(str(path / f"a_{n:04d}.png"), frame if n != 7 else frame[:, :90])


NO_RECORDING = {
    "text": (note, "note.avi", "a video"),
    "empty": (nothing, "empty.avi", "0 bytes"),
    "random bytes": (noise, "noise.mp4", "a video"),
    "random bytes after an AVI's first twelve": (noise_behind(b"RIFF\0\0\0\0AVI "), "n.avi", "video stream"),
    "random bytes after a TIFF's first four": (noise_behind(b"II*\0"), "n.tif", "TIFF"),
    "random bytes after a cine's first four": (noise_behind(b"CI\x2c\0"), "n.cine", "cine header"),
    "codec nobody has": (unknown_codec, "u.avi", "codec"),
    "MP4 without its index": (mp4_without_index, "cut.mp4", "without its index"),
    "constant image": (flat, "flat.tif", "shows something"),
    "no ridges": (no_ridges, "noise.tif", "ridges"),
    "NaN throughout": (all_nan, "nan.tif", "60 corrupt"),
    "pages of several sizes": (sizes_change, "s.tif", "180 x 12 and 100 x 12"),
    "folder without images": (folder_of_text, "texts", "images"),
    "images of several sizes": (folder_of_several_sizes, "images", "90 x 12"),
}


@pytest.mark.parametrize("case", NO_RECORDING)
def test_what_is_no_recording_is_refused_in_one_line(case, place, frames, refused):
    """A failure means a traceback, a silent guess, or a message that does not say what is wrong."""
    make, name, expected = NO_RECORDING[case]
    make(place / name, frames)
    said = refused(name)
    assert name in said
    assert expected in said


def test_what_is_no_film_is_said_before_the_folder_that_exists(place, refused):
    """A failure means that who types test.txt for test.avi is told to replace the run of test.avi."""
    Path("test.txt").write_text("no film")
    Path("test_tracks").mkdir()
    (Path("test_tracks") / "run.json").write_text("{}")
    line = refused("test.txt")
    assert "test.txt: expected" in line and "--overwrite" not in line


def test_a_run_is_no_video(place, refused):
    """A failure means that whoever names the run in place of the film reads of images of two kinds."""
    (place / "run").mkdir()
    note(place / "run" / "run.json", None)
    assert "track review, figures and export take a run as it is" in refused("run")


# --- arguments that do not fit ------------------------------------------------------------------------------

ARGUMENTS = {
    "strip outside": (["--strip", "5:99"], "0:12"),
    "strip is no range": (["--strip", "rows"], "--strip"),
    "empty strip": (["--strip", "5:5"], "--strip"),
    "columns outside": (["--columns", "170:190"], "0:180"),
    "columns too few": (["--columns", "50:54"], "columns"),
    "too many sheets": (["--sheets", "9"], "found 8"),
    "frames behind the end": (["--frames", "100:200"], "below 60"),
    "one number for frames": (["--frames", "5"], "A:B"),
    "frame rate nan": (["--fps", "nan"], "--fps"),
    "window wider than the picture": (["--window", "999"], "180 columns"),
    "window over two ridges": (["--window", "31"], "no wider than the ridges' spacing"),
    "even window": (["--window", "8"], "--window"),
    "window is no number": (["--window", "wide"], "--window"),
    "unknown option": (["--stripe", "1:2"], "--stripe"),
    "unknown option in the file": (["--config", "bad.toml"], "stripe"),
    "broken file of options": (["--config", "note.txt"], "note.txt"),
    "unknown polarity": (["--ridges", "grey"], "grey"),
    "rotation": (["--rotate", "45"], "45"),
    "axis far outside": (["--axis", "5000"], "--axis"),
    "axis is no number": (["--axis", "nan"], "--axis"),
    "pixel size 0": (["--pixel-size", "0"], "--pixel-size"),
    "pixel size in another unit": (["--pixel-size", "10mm"], "10.5um"),
    "negative pixel size": (["--pixel-size", "-1"], "--pixel-size"),
    "two pixel sizes": (["--scale", "1mm=103px", "--pitch", "0.2mm"], "one of"),
    "scale without pixels": (["--scale", "1mm"], "1mm=103px"),
    "scale of lengths": (["--scale", "1mm=2mm"], "1mm=103px"),
    "pitch in px": (["--pitch", "20px"], "--pitch"),
    "times that are not there": (["--timestamps", "none.txt"], "none.txt"),
    "out is a file": (["--out", "comb.tif"], "comb.tif"),
    "out below a file": (["--out", "comb.tif/run"], "comb.tif"),
    "out is the working directory": (["--out", ".", "--overwrite"], "run folder"),
    "out has too long a name": (["--out", "x" * 300], "name too long"),
    "video has too long a name": (["y" * 300], "y" * 300),
    "folder of nothing given as out": (["--out", "/proc/none/run"], "/proc/none"),
}
ON_POSIX = ("out has too long a name", "folder of nothing given as out")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.posix] * (case in ON_POSIX)) for case in ARGUMENTS]
)
def test_arguments_that_do_not_fit_are_refused_in_one_line(case, video, refused):
    """A failure means that a mistyped option is guessed at or ends in a traceback."""
    arguments, expected = ARGUMENTS[case]
    note(Path("note.txt"), None)
    Path("bad.toml").write_text("stripe = '1:2'\n")
    first = [] if case.startswith("video has") else [video]
    assert expected in refused(*first, *arguments)


def test_frames_beyond_the_end_give_what_there_is(video, capsys):
    """A failure means that a generous --frames loses the run, or that its shortness is not told."""
    assert run([str(video), "--quiet", "--frames", "50:200"]) == 1
    assert "the file has 60" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["a b [é](1).tif", "-1 €'$x.png", "one.avi"])
def test_one_frame_and_any_name_will_do(name, place, frames, capsys):
    """A failure means that brackets are taken for a glob, that a space or accent stops the run, or that a
    single picture, the first thing a user tries, cannot be measured, or passes for a film that shows motion.
    """
    if name.endswith("png"):
        Path(name).write_bytes(cv2.imencode(".png", frames[0])[1].tobytes())
    elif name.endswith("avi"):
        write_avi(place / name, frames[:1])
    else:
        write_video(place / name, frames[:1])
    assert run([f"./{name}", "--quiet", "--out", "run"]) == 1
    said = capsys.readouterr().err
    assert said == "track: warning: only 1 frame: neither motion nor noise can be measured\n"
    assert (pd.read_csv("run/tracks.csv")["flag"] == "ok").all()


def test_results_may_lie_among_the_images(place, frames):
    """A failure means that a folder of images is spoilt as input by its own results."""
    (place / "images" / "earlier_tracks").mkdir(parents=True)
    for name in ("a_0000.png", "a_0001.png", "a_0002.png", "earlier_tracks/overview.png"):
        cv2.imwrite(str(place / "images" / name), frames[int(name[5])] if name[0] == "a" else frames[0])
    assert run(["images", "--quiet", "--out", "images/run"]) == 0


# --- the machine --------------------------------------------------------------------------------------------


def limited(size):
    """A process whose files can be no larger, as on a disk that fills up."""
    resource = pytest.importorskip("resource")
    return {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))}


@pytest.mark.parametrize("size", [4_000, 30_000, 42_000])
def test_a_write_that_fails_leaves_nothing(size, video):
    """A failure means half a run folder, a traceback, or a crash of HDF5 when the disk is full."""
    status, out, err = finish(video, "--quiet", **limited(size))
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert "a place that can be written" in err
    assert [p.name for p in video.parent.iterdir()] == [video.name]


WAITS_WHILE_IT_WRITES = """
import sys, time
from vision.command.main import main
from vision.run import writing

def wait(*_):
    print("writing", flush=True)
    while True:  # a signal just before a single long sleep would be seen only after it
        time.sleep(0.05)

writing._write_tables = wait
main(sys.argv[1:])
"""


@pytest.mark.posix
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_leaves_nothing(sent, place, video):
    """A failure means that Ctrl-C, a closed terminal or a time limit leaves rubbish or looks like success."""
    command = [sys.executable, "-c", WAITS_WHILE_IT_WRITES, "comb.tif"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=PLACE
    ) as process:
        assert process.stdout.readline() == "writing\n"
        assert any(p.name.startswith(".comb_tracks") for p in place.iterdir())
        process.send_signal(sent)
        out, err = process.communicate(timeout=300)
    assert process.returncode == 130
    assert (out, err.count("\n")) == ("", 1)
    assert "interrupted" in err
    assert [p.name for p in place.iterdir()] == ["comb.tif"]


INTERRUPTED_IN_A_DESTRUCTOR = """
import os, signal, sys, time
from vision.command.main import main
from vision.run import writing

class Closes:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0)

def write(*_):
    Closes()
    for _ in range(100):  # on a busy machine the second interruption may come late
        time.sleep(0.05)
    print("went on", flush=True)

writing._write_tables = write
main(sys.argv[1:])
"""


@pytest.mark.posix
def test_an_interruption_in_a_destructor_is_not_lost(place, video):
    """A failure means that Ctrl-C does nothing if it comes at a bad moment: Python ignores errors there."""
    status, out, err = finish(video, command=[sys.executable, "-c", INTERRUPTED_IN_A_DESTRUCTOR])
    assert (status, out, err.count("\n")) == (130, "", 1)
    assert [p.name for p in place.iterdir()] == ["comb.tif"]


@pytest.mark.posix
def test_a_reader_that_leaves_is_no_failure(video):
    """A failure means a traceback, or a false status, from `track … | head -1`."""
    shell = ["bash", "-o", "pipefail", "-c", '"$@" | true', "bash", *UNDRAWN, str(video)]
    done = subprocess.run(shell, capture_output=True, text=True, env=PLACE, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (video.parent / "comb_tracks" / "run.json").exists()


def test_a_full_disk_is_not_blamed_on_the_recording():
    """A failure means that a user whose disk is full looks for a damaged film."""
    for code in (errno.ENOSPC, errno.EDQUOT):
        line = one_line(OSError(code, os.strerror(code)))
        assert line.startswith("the disk: ")
        assert line.endswith("found a full disk; free some space")


def test_no_reader_at_all_is_no_failure(monkeypatch):
    """A failure means a traceback where standard output is closed, as under some schedulers."""
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    say(["a line"])
    complain("a line")


def test_a_terminal_without_greek_letters_is_no_failure(place):
    """A failure means a traceback after the work is done, where output is piped in a narrow encoding."""
    force = Path(__file__).parents[2] / "fixtures" / "paper" / "force.txt"
    status, out, err = finish(
        "force", force, "--d0", "13", "--out", "run", env=PLACE | {"PYTHONIOENCODING": "ascii"}
    )
    assert (status, "Traceback" in err) == (0, False), err
    assert "median DeltaF" in out
    assert Path("run/force.png").stat().st_size > 10_000


@pytest.mark.thorough
@pytest.mark.posix
@pytest.mark.parametrize(
    ("words", "nowhere"),
    [
        ("note.avi", "<&- >&- 2>&-"),
        ("force note.avi", ">&- 2>&-"),
        ("comb.tif --frobnicate", "2>&-"),
        ("comb.tif --frobnicate", "2>/dev/full"),
    ],
)
def test_bad_input_is_status_2_also_where_nobody_can_be_told(video, words, nowhere):
    """A failure means that a scheduler which closes the streams takes a bad file for a finished run."""
    note(Path("note.avi"), None)
    command = f"{' '.join(COMMAND)} {words} {nowhere}"
    assert subprocess.call(command, shell=True, env=PLACE, timeout=300) == 2


A_LIBRARY_PRINTS = """
import os, sys
from vision.command.main import main

def run(arguments):
    with open("results", "w") as file:
        for stream in (1, 2):
            os.write(stream, b"what a library prints")
        file.write("results")
    return 0

sys.modules["vision.command.main"].run = run
main([])
"""


@pytest.mark.posix
def test_closed_streams_do_not_end_up_in_the_results(place):
    """A failure means that the first file opened takes the place of standard error, and its messages."""
    command = f'{sys.executable} -c "$CODE" <&- >&- 2>&-'
    place_and_code = PLACE | {"CODE": A_LIBRARY_PRINTS}
    assert subprocess.call(command, shell=True, env=place_and_code, timeout=300) == 0
    assert Path("results").read_text() == "results"


def test_two_runs_into_one_folder_keep_one_of_them_whole(video):
    """A failure means that a run silently replaces another's results, or that the two are mixed."""
    both = [start(video, "--quiet", "--out", "run", command=UNDRAWN) for _ in range(2)]
    said = [process.communicate(timeout=300)[1] for process in both]
    assert sorted(process.returncode for process in both) == [0, 2], said
    assert "a new folder" in "".join(said) or "not empty" in "".join(said)
    assert sorted(p.name for p in video.parent.iterdir()) == ["comb.tif", "run"]
    assert {"run.json", "tracks.csv", "overview.png"} <= {p.name for p in Path("run").iterdir()}


def test_a_run_that_may_not_be_replaced_stays(video, refused):
    """A failure means that --overwrite hides or destroys an earlier run it cannot replace."""
    if os.name != "posix" or os.geteuid() == 0:
        pytest.skip("rights bind no root")
    assert run([str(video), "--quiet"]) == 0
    Path("comb_tracks").chmod(0o555)
    try:
        assert "read-only" in refused(video, "--overwrite")
    finally:
        Path("comb_tracks").chmod(0o755)


INTERRUPTED_WHILE_IT_STARTS = """
import sys
from vision.command import main

class Interrupts:
    def find_spec(self, name, *_):
        if name == "cyclopts":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupts())
main()
"""


def test_an_interruption_while_the_program_starts_is_one_line(place, video):
    """A failure means that Ctrl-C in the first moments, a second on a busy machine, ends in a traceback."""
    status, out, err = finish(video, command=[sys.executable, "-c", INTERRUPTED_WHILE_IT_STARTS])
    assert (status, out) == (130, "")
    assert err == "track: interrupted; nothing was begun\n"
    assert [p.name for p in place.iterdir()] == ["comb.tif"]
