"""The command as on Windows: without what Python has on POSIX systems alone.

Run as `python -m tests.scenes.windows ARGUMENTS…`. Stdlib and libraries are loaded first, since they choose
their own ways by the system that they see.
"""

import ctypes
import mmap
import multiprocessing
import os
import signal
import sys
from types import ModuleType, SimpleNamespace

import cv2  # noqa: F401
import matplotlib.pyplot  # noqa: F401
import pandas as pd  # noqa: F401
import scipy.optimize  # noqa: F401
import xarray  # noqa: F401

ABSENT: dict[ModuleType, str] = {
    os: "O_DIRECTORY O_NONBLOCK fork forkpty getpgid geteuid getuid killpg mkfifo posix_fadvise "
    "posix_fallocate pread preadv pwrite readv sched_getaffinity setsid statvfs",
    signal: "SIGALRM SIGHUP SIGUSR1 SIGXCPU",
    mmap: "MADV_DONTNEED",
}
_LOAD = ctypes.CDLL.__init__


def _load(self: ctypes.CDLL, name: str | None, *more: object, **options: object) -> None:
    if name is None:
        raise TypeError("argument of type 'NoneType' is not iterable")  # as on Windows
    _LOAD(self, name, *more, **options)  # type: ignore[arg-type]


def main() -> int:
    """Take away what Windows lacks, and run the command."""
    for module, names in ABSENT.items():
        for name in names.split():
            if hasattr(module, name):
                delattr(module, name)
    for name in ("fcntl", "grp", "pwd", "resource", "termios"):
        sys.modules[name] = None  # type: ignore[assignment]
    ctypes.CDLL.__init__ = _load  # type: ignore[method-assign]
    multiprocessing.get_all_start_methods = lambda: ["spawn"]

    from vision import files

    files.sys = SimpleNamespace(**vars(sys) | {"platform": "win32"})  # type: ignore[assignment]
    from vision.command import main as command

    return command()


if __name__ == "__main__":
    sys.exit(main())
