"""Locks by which runs, reviews and campaigns of several processes keep out of each other's files."""

from __future__ import annotations

import ctypes
import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from vision.errors import InputError, unwritable

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]
POSIX = fcntl is not None


@dataclass(frozen=True)
class Lock:
    """A lock that this process holds on a path. It ends with the process, however that ends."""

    handle: int | None
    """Of the open file, on Windows of a mutex; None where the file system has no locks."""

    file: Path | None = None
    """A file that only the lock is for, removed at its end."""

    def release(self) -> None:
        """End the lock."""
        if self.file is not None:
            with suppress(OSError):
                self.file.unlink()
        if self.handle is None:
            return
        if POSIX:
            os.close(self.handle)
        else:
            _kernel32().CloseHandle(ctypes.c_void_p(self.handle))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.release()


def lock_folder(folder: Path) -> Lock | None:
    """Lock a folder; None if another process holds its lock, or it cannot be locked."""
    try:
        return _locked(folder, os.O_RDONLY) if POSIX else _mutex_of(folder.resolve(strict=True))
    except OSError:
        return None


def claim(path: Path, taken: InputError, advice: str) -> Lock:
    """Lock a path; on POSIX systems it becomes a file, which is removed at the end.

    On a file system without locks nothing is locked.

    Raises: `taken` if another process holds the lock, InputError if the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return _locked_file(path) if POSIX else _mutex_of(path.resolve())
    except BlockingIOError:
        raise taken from None
    except OSError as error:
        raise unwritable(path.parent, error, advice) from error


def _locked_file(path: Path) -> Lock:
    """Make a file if there is none, and lock it.  Raises: as `_locked`."""
    while True:
        path.touch()
        try:
            lock = _locked(path, os.O_RDWR)
        except FileNotFoundError:  # its last holder removed it just now
            continue
        except BlockingIOError:
            raise
        except OSError:
            return Lock(None, path)
        if _is_still(path, lock.handle):
            return replace(lock, file=path)
        lock.release()


def _is_still(path: Path, handle: int | None) -> bool:
    """Return whether a path leads to an open file, which the last holder of its lock may have removed."""
    try:
        return handle is not None and os.path.samestat(path.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _locked(path: Path, flags: int) -> Lock:
    """Lock a file or folder on a POSIX system.

    Raises: BlockingIOError if another process holds the lock; OSError if there is no such path, or the file
    system has no locks.
    """
    handle = os.open(path, flags)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        raise
    return Lock(handle)


def _mutex_of(path: Path) -> Lock:
    """Lock a path on Windows.

    Windows can neither lock a folder nor rename one in which a file is open: a mutex, whose name follows from
    the path, stands for it.

    Raises: BlockingIOError if another process has made it.
    """
    kernel, name = _kernel32(), hashlib.sha256(os.path.normcase(path).encode()).hexdigest()
    handle = kernel.CreateMutexW(None, False, f"Global\\sheetvision-{name}")
    exists = ctypes.get_last_error() == 183  # type: ignore[attr-defined]  # ERROR_ALREADY_EXISTS
    if exists:
        kernel.CloseHandle(ctypes.c_void_p(handle))
    if exists or not handle:  # not: another user's
        raise BlockingIOError
    return Lock(handle)


def _kernel32() -> Any:
    """Return the functions of Windows' kernel32.dll."""
    kernel = ctypes.WinDLL("kernel32", use_last_error=True)  # type: ignore[attr-defined]
    kernel.CreateMutexW.restype = ctypes.c_void_p
    return kernel
