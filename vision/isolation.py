"""What this process may use of the machine, and a process of its own for parsers that crash or never end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

from vision.errors import InputError
from vision.files import check_regular, shortened

PACKAGES = tuple(place for place in sys.path if place)
"""Where the process finds packages. Not as it is later: while OpenCV is imported, in another thread perhaps,
its own folders come first, and one of them holds a `typing` that is not Python's."""

# Reads every value of a file and keeps none. The names come from the caller, the path from the command line.
_PARSERS = {
    "MATLAB": "from scipy.io import loadmat; loadmat(path, squeeze_me=True, struct_as_record=True)",
    "HDF5": (
        "import h5py\n"
        "def look(name, item):\n"
        "    dict(item.attrs)\n"
        "    if isinstance(item, h5py.Dataset): item[()]\n"
        "with h5py.File(path, 'r') as file:\n"
        "    dict(file.attrs)\n"
        "    file.visititems(look)"
    ),
}
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
    print(json.dumps(type(error).__name__ + ": " + str(error)))
    sys.exit(1)
"""


def usable_cores() -> int:
    """Cores that this process may use: on a cluster those of its job, not all of the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def try_out(path: Path, kind: str, wanted: str, *, seconds: float | None = None) -> None:
    """Let a process of its own, bounded in time and memory, read the whole file; refuse one it cannot read.

    The process finds the same packages as this one, and none in the working directory or beside the data. It
    ends with this one.

    Parameters
    ----------
    path
        The file.
    kind
        "MATLAB" (version 4 and 5) or "HDF5".
    wanted
        What the file should be, for the message.
    seconds
        Longest computing time it may take; by the file's size if not given.

    Raises
    ------
    InputError
        Where it is no regular file, or the parser raises, crashes, or takes longer.
    """
    run_parser(path, _PARSERS[kind], wanted, seconds=seconds)


def run_parser(path: Path, parser: str, wanted: str, *, seconds: float | None = None) -> None:
    """`try_out` with other lines of Python, in which `path` is the file's."""
    size = check_regular(path, wanted).st_size
    # Recordings in use take under one second, most of which is the start of the process.
    seconds = 8 + 5e-8 * size if seconds is None else seconds
    wall_s = 5 * seconds  # on a busy machine a process gets part of a core
    memory = (2 << 30) + 4 * size  # of address space, of which the libraries reserve half a GiB
    task = json.dumps([os.path.abspath(path), PACKAGES, int(seconds) + 1, memory, parser])  # noqa: PTH100
    quiet = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # each thread would reserve memory
    child = subprocess.Popen(
        [sys.executable, "-I", "-c", _CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=os.environ | quiet,
    )
    try:  # a `with` alone would wait for a process that never ends
        out, _ = child.communicate(task.encode() + b"\n", timeout=wall_s)
        found = _found(child.returncode, out, seconds)
    except subprocess.TimeoutExpired:
        found = f"one whose reading does not end within {wall_s:g} s"
    finally:
        child.kill()
        with child:  # closes its pipes
            pass
    if found:
        raise InputError(path, wanted, found, "save or copy it again")


def _found(status: int, out: bytes, seconds: float) -> str:
    """What is wrong with the file; "" for nothing."""
    if status == 0:
        return ""
    if -status == getattr(signal, "SIGXCPU", None):
        return f"one whose reading does not end within {seconds:g} s of computing"
    if status < 0:
        return f"one that ends its reader ({signal.Signals(-status).name})"
    try:
        why = str(json.loads(out.decode().splitlines()[-1]))
    except (ValueError, IndexError):
        why = f"status {status}"
    return f"one that cannot be read ({shortened(why)})"
