"""Damaged files through the readers: each is read, or refused by an InputError; nothing else, and soon."""

import shutil
import signal
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.fuzz.mutations import mutated
from tests.fuzz.seeds import write_seeds
from vision.errors import InputError
from vision.force import read_force
from vision.video import open_video, read_timestamps

try:
    import resource
except ImportError:  # Windows
    resource = None

SECONDS = 60  # on a machine that does much else; on a quiet one a case takes milliseconds
MEMORY_BYTES = 2 << 30
FORCE = ("text", "mat", "hdf5", "xlsx")
ALONGSIDE = ("photron", "images")  # read with the files beside them
# Out of 1000: MATLAB and HDF5 start a process each, which takes as long as twenty others.
SHARE = {
    "riff": 160,
    "tiff": 230,
    "mp4": 90,
    "matroska": 100,
    "png": 50,
    "bytes": 80,
    "cine": 60,
    "text": 110,
}
SHARE |= {"times": 30, "photron": 40, "images": 40, "mat": 5, "hdf5": 5, "xlsx": 40}


class HangError(BaseException):
    """A case that took longer than `SECONDS`."""


@dataclass(frozen=True)
class Failure:
    """A case that ended in anything but a result or an InputError; file: kept for a look."""

    case: int
    file: Path
    what: str


def run_cases(cases: int, seed: int, folder: Path) -> Iterator[tuple[int, str, Failure | None]]:
    """(number, kind and outcome, failure) of each case; case n of a seed is always the same file."""
    (folder / "seeds").mkdir(parents=True, exist_ok=True)
    seeds = write_seeds(folder / "seeds")
    kinds = list(SHARE)
    weights = np.array([SHARE[kind] for kind in kinds]) / sum(SHARE.values())
    for case in range(cases):
        random = np.random.default_rng([seed, case])
        kind = kinds[int(random.choice(len(kinds), p=weights))]
        source, other = (seeds[kind][int(random.integers(len(seeds[kind])))] for _ in range(2))
        place = folder / f"{seed}_{case}"
        shutil.copytree(source.parent, place) if kind in ALONGSIDE else place.mkdir()
        file = place / source.name
        file.write_bytes(mutated(source.read_bytes(), kind, random, other.read_bytes()))
        outcome = one_case(place if kind == "images" else file, kind)
        failed = outcome not in ("read", "refused")
        if not failed:
            shutil.rmtree(place)
        yield case, f"{kind} {outcome.splitlines()[-1]}", Failure(case, file, outcome) if failed else None


def one_case(file: Path, kind: str) -> str:
    """ "read", "refused", or what went wrong."""
    forget_peak()
    started = time.monotonic()
    try:
        with alarm(SECONDS):
            read(file, kind)
        outcome = "read"
    except InputError as error:
        outcome = "refused" if "\n" not in str(error) else "a message of several lines"
    except HangError:
        outcome = f"hang: {traceback.format_exc()}\nhang"
    except Exception:
        outcome = traceback.format_exc()
    if time.monotonic() - started > SECONDS:
        return f"{time.monotonic() - started:.0f} s: {outcome}"
    if peak_bytes() > MEMORY_BYTES:
        return f"{peak_bytes() >> 20} MiB: {outcome}"
    return outcome


def read(file: Path, kind: str) -> None:
    """The file read to its end as the program does."""
    if kind in FORCE:
        read_force(file)
    elif kind == "times":
        read_timestamps(file)
    else:
        video = open_video(file)
        for pixels in video.sample(3):
            assert pixels.shape == video.shape
        frames = 0
        for block in video.blocks():
            assert block.start == frames
            frames += len(block.status)


def forget_peak() -> None:
    """Count the most memory from now on, where the system allows it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_bytes() -> int:
    """The most memory this process has had since `forget_peak`."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) << 10
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10 if resource else 0


@contextmanager
def alarm(seconds: int) -> Iterator[None]:
    """HangError after so many seconds; without such a signal (Windows) the case goes on."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def ring(*_: object) -> None:
        raise HangError

    earlier = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, earlier)
