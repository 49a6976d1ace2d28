"""The command as on Windows: without what Python has on POSIX systems alone, and unable to move or remove
what is open.

Run on Linux as `python -m tests.scenes.windows ARGUMENTS…`. Libraries are loaded first, since they choose
their own ways by the system that they see.
"""

import ctypes
import fcntl
import mmap
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
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


def held(path: object) -> str | None:
    """Return a file at or below a path that this process holds open or mapped, None if there is none."""
    place = os.path.abspath(os.fspath(path))  # noqa: PTH100
    opened = [os.readlink(entry.path) for entry in os.scandir("/proc/self/fd") if os.path.islink(entry.path)]  # noqa: PTH114, PTH115
    with open("/proc/self/maps", encoding="utf-8") as file:  # noqa: PTH123
        mapped = [line.split(maxsplit=5)[5].strip() for line in file if line.count("/")]
    return next((one for one in opened + mapped if one == place or one.startswith(place + "/")), None)


def _refusing(call: Callable[..., None]) -> Callable[..., None]:
    """Wrap a call that moves or removes a path, which Windows refuses for what is open."""

    def wrapped(path: object, *more: object, **options: object) -> None:
        if options.get("dir_fd") is None and (name := held(path)):
            raise PermissionError(13, "the process cannot access the file as it is being used", name)
        call(path, *more, **options)

    return wrapped


_last_error = [0]


def _create_mutex(security: None, owned: bool, name: str) -> int:
    """Make a mutex: a locked file, which is free again when its process has ended."""
    handle = os.open(Path(tempfile.gettempdir(), name.replace("\\", "-")), os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _last_error[:] = [0]
    except OSError:
        _last_error[:] = [183]
    return handle


def _close_handle(handle: ctypes.c_void_p) -> None:
    os.close(handle.value or 0)


def become_windows() -> None:
    """Take away what Windows lacks, and refuse what it refuses; before the project is imported."""
    for name in ("rename", "replace", "unlink", "remove", "rmdir"):
        setattr(os, name, _refusing(getattr(os, name)))
    shutil._use_fd_functions = False  # type: ignore[attr-defined]
    if hasattr(shutil, "_rmtree_impl"):  # from Python 3.14 on, chosen as shutil is loaded
        shutil._rmtree_impl = shutil._rmtree_unsafe  # type: ignore[attr-defined]
    for module, names in ABSENT.items():
        for name in names.split():
            if hasattr(module, name):
                delattr(module, name)
    for name in ("fcntl", "grp", "pwd", "resource", "termios"):
        sys.modules[name] = None  # type: ignore[assignment]
    ctypes.CDLL.__init__ = _load  # type: ignore[method-assign]
    kernel = SimpleNamespace(CreateMutexW=_create_mutex, CloseHandle=_close_handle)
    ctypes.WinDLL = lambda name, use_last_error: kernel
    ctypes.get_last_error = lambda: _last_error[0]

    from vision import files

    files.sys = SimpleNamespace(**vars(sys) | {"platform": "win32"})  # type: ignore[assignment]


if __name__ == "__main__":
    become_windows()
    from vision.command import main

    sys.exit(main())
