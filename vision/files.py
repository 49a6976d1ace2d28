"""Safe reading of input files.

A read from a disk or a network that does not answer never returns and cannot be cancelled. All access to a
recording is therefore made in threads that can be abandoned (`answered`, `prefetch`): unlike those of
`concurrent.futures` they do not keep the process from ending. Parsers that may crash or hang first read the
file in a separate process (`try_out`).
"""

from __future__ import annotations

import contextlib
import ctypes
import glob
import itertools
import json
import os
import queue
import re
import signal
import stat
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from vision.errors import InputError, did_you_mean, reason_of

TIFF = {".tif", ".tiff"}
"""Suffixes of TIFF files, which hold one picture or a film."""
AGAIN = "run track again"  # advice for a damaged file of a run
Progress = Callable[[int, int | None], None]
"""Function that is called with the number of frames done and of all frames, None if that is not known."""
MOST_PIXELS = 100_000_000
"""Largest number of pixels of a frame. A larger limit accepts more damaged headers, for which memory is then
allocated; the largest film cameras have 70 million (tests/video/test_broken.py)."""


def check_regular(path: Path, wanted: str) -> os.stat_result:
    """Return the facts of a regular file. A pipe or a device, which could block or never end, is refused.

    wanted: what the file should be, for the message.
    Raises: InputError for anything but an existing regular file.
    """
    try:
        facts = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        if isinstance(error, FileNotFoundError):
            raise no_such_file(path, wanted) from None
        raise InputError(path, wanted, reason_of(error), "check the path") from None
    if not stat.S_ISREG(facts.st_mode):
        kind = "a folder" if stat.S_ISDIR(facts.st_mode) else "a device, pipe or socket"
        raise InputError(path, wanted, kind, "give a file")
    return facts


def members(path: Path) -> list[Path]:
    """Return what a folder holds, else the path itself or what matches it as a pattern; in no order."""
    return list(path.iterdir()) if path.is_dir() else matching(path)


def matching(path: Path) -> list[Path]:
    """Return the path itself if it exists, else what matches it as a pattern; in no order."""
    return [path] if path.exists() else [Path(name) for name in glob.glob(str(path))]  # noqa: PTH207  # absolute


def expanded(paths: Iterable[Path]) -> tuple[Path, ...]:
    """Return paths with patterns replaced by what matches them, in order: not every shell does so."""
    return tuple(one for path in paths for one in sorted(matching(path)) or [path])


def no_such_file(path: Path, wanted: str) -> InputError:
    """Return the error for a missing file, which names the file of its folder that may be meant.

    That is a file with another extension or capitals, else the one with the most similar name.
    """
    if path.is_symlink():
        return InputError(path, wanted, f"a link to {path.readlink()}, which does not exist", "restore it")
    names: list[str] = []
    with contextlib.suppress(OSError, ValueError):
        names = sorted(itertools.islice(os.listdir(path.parent), 10_000))  # noqa: PTH208 - names are enough
    stem = path.stem.casefold()
    alike = [name for name in names if Path(name).stem.casefold() == stem]
    advice = f"did you mean {alike[0]}?" if alike else did_you_mean(path.name, names, 0.8)
    return InputError(path, wanted, "no such file", advice or "check the path, with quotes if it has spaces")


def check_pixels(path: Path, rows: int, columns: int) -> None:
    """Refuse a frame of no pixels, or of more than `MOST_PIXELS`, before memory is allocated for it.

    Raises: InputError.
    """
    if not (rows > 0 and columns > 0 and rows * columns <= MOST_PIXELS):
        wanted = f"frames of 1 to {MOST_PIXELS // 1_000_000} million pixels"
        raise InputError(path, wanted, f"{columns} x {rows} in its header", "copy or export it again")


@contextmanager
def reading(path: Path, wanted: str, advice: str = "copy or export it again") -> Iterator[None]:
    """Convert every exception that a decoder raises inside to an `InputError` of one line.

    Damaged data cause all kinds of exceptions: struct errors, failed assertions, overflows, wrong types.

    wanted: what the file should be.  advice: what the user can do.
    """
    try:
        yield
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(path, wanted, "one that asks for more memory than there is", advice) from error
    except OSError as error:
        found = f"one that cannot be read ({reason_of(error)})"
        raise InputError(path, wanted, found, advice) from error
    except Exception as error:
        why = _plain_reason(error)
        raise InputError(path, wanted, "a damaged one" + (f" ({why})" if why else ""), advice) from error


def _plain_reason(error: Exception) -> str:
    """Return what an exception says of a file if a user understands it; "" for what only a decoder does."""
    if isinstance(error, tomllib.TOMLDecodeError | json.JSONDecodeError):
        return shortened(str(error))
    if isinstance(error, UnicodeDecodeError):
        return "its text is not UTF-8"
    if isinstance(error, KeyError) and error.args and isinstance(error.args[0], str):
        return f"'{shortened(error.args[0], 40)}' is missing"
    open_quote = ("inside string", "unexpected end of data")  # pandas, csv
    return "a quotation mark is never closed" if any(mark in str(error) for mark in open_quote) else ""


def read_toml(path: Path, wanted: str, advice: str) -> dict[str, Any]:
    """Return the content of a TOML file of at most 1 MiB.

    wanted: what the file should hold.  advice: what the user can do about a damaged one.
    Raises: InputError for anything but a regular file of TOML.
    """
    if check_regular(path, wanted).st_size > 1 << 20:
        raise InputError(path, wanted, "more than 1 MiB", "check its name")
    with reading(path, wanted, advice):
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))


def decode_text(path: Path, data: bytes, wanted: str) -> tuple[str, str]:
    """Return the text of a file in whatever encoding, and that encoding.

    Raises InputError for an empty or a binary file.
    """
    if not data.strip(b"\x00 \t\r\n"):
        raise InputError(path, wanted, "an empty file")
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace"), "utf-16"
    even, odd = (data[first:4096:2].count(0) for first in (0, 1))
    pairs = len(data[:4096]) / 2
    if max(even, odd) > 0.4 * pairs and min(even, odd) < 0.1 * pairs:
        # Latin text in UTF-16 without a byte order mark
        return data.decode("utf-16-le" if odd > even else "utf-16-be", errors="replace"), "utf-16"
    if even or odd:
        raise InputError(path, f"{wanted} as text", "a binary file", "export it as text or CSV")
    utf_8 = "utf-8 with BOM" if data.startswith(b"\xef\xbb\xbf") else "utf-8"
    for encoding, name in (("utf-8-sig", utf_8), ("cp1252", "latin-1")):
        try:
            return data.decode(encoding), name
        except UnicodeDecodeError:
            continue
    return data.decode("latin-1"), "latin-1"


def some_lines(lines: list[str]) -> list[str]:
    """Return the first 400 lines and 400 from the middle on: enough to tell how numbers are written."""
    few, middle = 400, len(lines) // 2
    return [*lines[:few], *lines[max(few, middle) :][:few]]


THOUSANDS = "[1-9][0-9]{{0,2}}(?:{mark}[0-9]{{3}})++(?![0-9])"
"""Pattern of a whole number with a mark between its thousands."""


def groups_thousands(column: Iterable[str], mark: str) -> bool | None:
    """Return whether a mark in the numbers of a column groups digits (True) or is decimal; None for either.

    It groups digits where numbers without it have up to three digits, or some have several marks, and all
    others have only groups of three. Decimals have it in every row, or, without the zeros at their ends,
    sometimes with fewer than three digits after it.
    """
    cells = [cell.lstrip("+-") for cell in column]
    pattern = re.compile(THOUSANDS.format(mark=re.escape(mark)))
    grouped = [cell for cell in cells if pattern.fullmatch(cell)]
    decimal = re.compile(rf"[0-9]*{re.escape(mark)}[0-9]*(?:[eE][-+]?[0-9]+)?")
    if any(map(decimal.fullmatch, {*cells} - {*grouped})):
        return False
    short = sum(cell.count(mark) > 1 or re.fullmatch("[0-9]{1,3}", cell) is not None for cell in cells)
    return True if min(len(grouped), short) >= 3 else None  # one or two may be errors


def path_beside(folder: Path, name: str | Path) -> Path:
    """Return a path that a file in this folder names: relative to it or, if only that exists, to the working
    directory."""
    beside = folder / name
    return beside if beside.exists() or not Path(name).exists() else Path(name)


def shortened(text: str, most: int = 160) -> str:
    """Return the text as one line of at most `most` characters."""
    line = " ".join(text.split())
    return line if len(line) <= most else line[: most - 1] + "…"


@dataclass(frozen=True)
class Stamp:
    """Size, time and identity of a file, to notice changes; None if the file does not exist.

    For a folder or a pattern: the total size of its files and the time of the latest.
    """

    facts: tuple[int, int, int, int] | None = None

    @classmethod
    def of(cls, path: Path) -> Stamp:
        """Return the stamp of a file, a folder or a pattern."""
        try:
            if path.is_dir():
                with os.scandir(path) as entries:
                    return cls._of_all([entry.stat() for entry in entries if entry.is_file()])
            if not path.exists() and glob.has_magic(str(path)):
                return cls._of_all([file.stat() for file in matching(path)])
            found = path.stat()
        except (OSError, ValueError):
            return cls(None)
        return cls((found.st_size, found.st_mtime_ns, found.st_ino, found.st_dev))

    @classmethod
    def _of_all(cls, found: Sequence[os.stat_result]) -> Stamp:
        latest = max((one.st_mtime_ns for one in found), default=0)
        return cls((sum(one.st_size for one in found), latest, 0, 0)) if found else cls(None)

    def change(self, path: Path) -> str:
        """Return how the file has changed since; "" if it has not."""
        now = Stamp.of(path).facts
        if self.facts is None or now == self.facts:
            return ""
        if now is None:
            return "was removed"
        if now[2:] != self.facts[2:]:
            return "was replaced"
        if now[0] != self.facts[0]:
            return "became shorter" if now[0] < self.facts[0] else "grew"
        return "was changed"


class Watch:
    """Watches for how long a file or folder has not changed, by the clock of this process."""

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._clock = path, clock
        self.stamp, self._since = Stamp.of(path), clock()

    def unchanged_s(self) -> float:
        """Take a new stamp, and return the seconds since a change was last seen."""
        if (now := Stamp.of(self._path)) != self.stamp:
            self.stamp, self._since = now, self._clock()
        return self._clock() - self._since

    def age_s(self) -> float:
        """Return the seconds since the file's own time of change; 0 if it does not exist."""
        return 0.0 if self.stamp.facts is None else time.time() - self.stamp.facts[1] / 1e9


# --- in threads that can be abandoned -----------------------------------------------------------------------

ANSWER_S = 60.0
"""Seconds without any reading or computation after which reading fails. A shorter time fails while a disk
starts, a longer one waits for a lost connection (test_threads.py)."""

Item = TypeVar("Item")
Result = TypeVar("Result")
Made = queue.Queue[tuple[Item] | Exception | None]

LEAVE_S = 0.5  # longest wait for a thread that is no longer needed: Ctrl-C ends within a second


def answered(work: Callable[[], Result], path: Path, answer_s: float = ANSWER_S) -> Result:
    """Return the result of `work`, which reads a recording.  Raises: InputError as `prefetch`."""
    return begun(work, path, answer_s)()


def begun(work: Callable[[], Result], path: Path, answer_s: float = ANSWER_S) -> Callable[[], Result]:
    """Start `work` at once, and return a function that waits for its result as `answered` does."""
    ready: Made[Result] = queue.Queue()
    _start((work() for _ in range(1)), ready, threading.Event())
    return lambda: _item(_awaited(ready, path, answer_s))


def prefetch(items: Iterator[Item], path: Path, answer_s: float = ANSWER_S) -> Generator[Item, None, None]:
    """Yield the same items in the same order, up to two of them made ahead in one thread.

    Decoders release the interpreter lock, so decoding and reducing share two cores. An exception raised by
    `items` is raised here, in its turn. Abandoning the iterator stops the thread, or abandons it if
    it is busy or blocked.

    path: the recording, for the message.
    Raises: InputError if there is no item and no computation for `answer_s` seconds.
    """
    ready: Made[Item] = queue.Queue(maxsize=2)
    abandoned = threading.Event()
    worker = _start(items, ready, abandoned)
    try:
        while (entry := _awaited(ready, path, answer_s)) is not None:
            yield _item(entry)
    finally:
        abandoned.set()
        worker.join(LEAVE_S)


def _start(items: Iterator[Item], ready: Made[Item], abandoned: threading.Event) -> threading.Thread:
    thread = threading.Thread(target=_make_ahead, args=(items, ready, abandoned), daemon=True)
    thread.start()
    return thread


def _item(entry: tuple[Item] | Exception | None) -> Item:
    """Return the item of an entry, or raise its exception."""
    if isinstance(entry, Exception):
        raise entry
    assert entry is not None  # only `prefetch` reads up to the end
    return entry[0]


def _make_ahead(items: Iterator[Item], ready: Made[Item], abandoned: threading.Event) -> None:
    """Put each item into the queue in a tuple, and finally None or the exception that ended them."""

    def hand_over(entry: tuple[Item] | Exception | None) -> None:
        while not abandoned.is_set():
            with contextlib.suppress(queue.Full):
                ready.put(entry, timeout=0.1)
                return

    try:
        for item in items:
            hand_over((item,))
            if abandoned.is_set():
                break
        hand_over(None)
    except Exception as error:  # any exception is handled in the consuming thread
        hand_over(error)
    finally:
        close = getattr(items, "close", None)
        if close is not None:
            close()


def _awaited(ready: Made[Item], path: Path, answer_s: float) -> tuple[Item] | Exception | None:
    """Return the next entry; InputError if there is none while this process computes nothing."""
    while True:
        computed_s = time.process_time()
        with contextlib.suppress(queue.Empty):
            return ready.get(timeout=answer_s)
        if time.process_time() - computed_s < 0.01 * answer_s:
            wanted, found = "a disk or network that answers", f"no answer for {answer_s:g} s"
            advice = "look at the connection, or copy the recording to another disk"
            raise InputError(path, wanted, found, advice)


def usable_cores() -> int:
    """Return the number of cores that this process may use, on a cluster those of its job."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def c_library() -> ctypes.CDLL | None:
    """Return the C library of a Linux system, for calls that only it has; None on others."""
    return ctypes.CDLL(None, use_errno=True) if sys.platform.startswith("linux") else None


def in_threads(work: Callable[[Item], Result], items: Iterable[Item], *, held: int = 32) -> Iterator[Result]:
    """Yield the result of `work` for each item in order, on all cores.

    `held` items are drawn and worked on before the next are drawn, since both may read the same file.
    """
    source, count, abandoned = iter(items), usable_cores(), threading.Event()
    threads: list[threading.Thread] = []
    try:
        while batch := list(itertools.islice(source, held)):
            ready: list[Made[Result]] = [queue.Queue() for _ in range(count)]
            threads = [_start(map(work, batch[n::count]), made, abandoned) for n, made in enumerate(ready)]
            for n in range(len(batch)):
                yield _item(ready[n % count].get())
    finally:
        abandoned.set()
        for thread in threads:
            thread.join(LEAVE_S / count)


# --- in a separate process ----------------------------------------------------------------------------------

PACKAGE_PATHS = tuple(folder for folder in sys.path if folder)
"""Search path of packages for the separate process. It is stored early, because OpenCV temporarily puts its
own folders first while it is imported, and one of them contains a module `typing` that is not Python's."""

# Python code that reads every value of the file at `path`; MATLAB versions 4 and 5.
READ_MATLAB = "from scipy.io import loadmat; loadmat(path, squeeze_me=True, struct_as_record=True)"
READ_HDF5 = """
import h5py
def visit(name, item):
    dict(item.attrs)
    if isinstance(item, h5py.Dataset): item[()]
with h5py.File(path, "r") as file:
    dict(file.attrs)
    file.visititems(visit)
"""
_CHILD = """
import json, sys
path, modules, seconds, memory, parser = json.loads(sys.stdin.readline())
sys.path[:] = modules
try:
    import ctypes, resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(1, 9)  # killed with its parent
except (ImportError, OSError, ValueError, AttributeError):
    pass
try:
    exec(parser, {"path": path})
except BaseException as error:
    sys.exit(2 if isinstance(error, MemoryError) else 1)
"""


def try_out(path: Path, parser: str, wanted: str, *, seconds: float | None = None) -> None:
    """Read a file in a separate process, limited in time and memory, and refuse it if that fails.

    The process finds the same packages as this one, but none in the working directory or beside the data. It
    ends with this process.

    parser: Python code, such as `READ_HDF5`, in which ``path`` is the path of the file.
    wanted: what the file should be, for the message.
    seconds: largest computing time; by default it follows from the file's size.
    Raises: InputError if it is not a regular file, or the parser raises, crashes, or takes longer.
    """
    size = check_regular(path, wanted).st_size
    # Usual recordings take less than one second, mostly for starting the process.
    seconds = 8 + 5e-8 * size if seconds is None else seconds
    wall_s = 5 * seconds  # on a busy machine a process gets only part of a core
    memory = (2 << 30) + 4 * size  # address space, of which the libraries reserve half a GiB
    task = json.dumps([os.path.abspath(path), PACKAGE_PATHS, int(seconds) + 1, memory, parser])  # noqa: PTH100
    quiet = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # each thread would reserve memory
    child = subprocess.Popen(
        [sys.executable, "-I", "-c", _CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | quiet,
    )
    try:  # leaving a `with` would wait for a process that never ends
        child.communicate(task.encode() + b"\n", timeout=wall_s)
        found = _found(child.returncode, seconds)
    except subprocess.TimeoutExpired:
        found = f"one whose reading does not end within {wall_s:g} s"
    finally:
        child.kill()
        with child:  # close its pipes
            pass
    if found:
        raise InputError(path, wanted, found, "save or copy it again")


def _found(status: int, seconds: float) -> str:
    """Return what is wrong with the file; "" if nothing is."""
    if status == 0:
        return ""
    if -status == getattr(signal, "SIGXCPU", None):
        return f"one whose reading does not end within {seconds:g} s of computing"
    if status < 0:
        return f"one that ends its reader ({signal.Signals(-status).name})"
    return "one that asks for more memory than there is" if status == 2 else "a damaged or incomplete one"
