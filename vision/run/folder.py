"""A run folder appears whole or not at all."""

from __future__ import annotations

import ctypes
import errno
import glob
import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vision.errors import InputError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

MARK = "run.json"  # what makes a folder a run folder
PART, OLD = ".part", ".old"  # endings of a run that is being written, and of one that was moved aside
READING = ".reading"  # ending of what is kept while a long film is read


def check_target(target: Path, *, overwrite: bool) -> None:
    """Refuse early what would fail late: an existing folder, one that is no run, a place that cannot be
    written.

    Raises: InputError.
    """
    try:
        if target.exists():
            _check_earlier(target, overwrite=overwrite)
        parent = existing_parent(target)
    except OSError as error:
        raise _unwritable(target, error) from error
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(target, "a place that can be written", f"{parent} is not", "give another `out`")


def check_new(target: Path, *, overwrite: bool, kind: str = "file") -> None:
    """Refuse to write over something, unless that is asked for.  Raises: InputError."""
    if target.exists() and not overwrite:
        raise InputError(target, f"a new {kind}", "one that exists", "give `overwrite` or another `out`")


def _check_earlier(target: Path, *, overwrite: bool) -> None:
    """Only a run folder of one's own may be replaced, and only if asked for."""
    check_new(target, overwrite=overwrite, kind="folder")
    if not (target.is_dir() and (not any(target.iterdir()) or (target / MARK).is_file())):
        raise InputError(
            target, "a run folder to overwrite", "something else (no run.json in it)", "give another `out`"
        )
    if target.samefile(Path.cwd()):
        raise InputError(target, "a run folder to overwrite", "the working directory", "go one folder up")
    if not os.access(target, os.W_OK | os.X_OK):
        raise InputError(target, "a run folder to overwrite", "one that is read-only", "give another `out`")


@contextmanager
def run_folder(target: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside `target` that takes its place when everything in it is written.

    If anything goes wrong, an interrupt included, the temporary folder is removed and an earlier run stays
    as it was. What a killed process left behind is removed, or put back where the kill came between moving
    an earlier run aside and putting the new one in its place.

    Raises
    ------
    InputError
        Where the target exists or cannot be written, or the disk is full.
    """
    clean_up(target)
    check_target(target, overwrite=overwrite)
    # named first: an interrupt finds it
    made = target.parent / f".{target.name}.{secrets.token_hex(4)}{PART}"
    lock, missing = None, _missing_parents(target)
    try:
        made.mkdir(parents=True)
        lock = lock_folder(made)
        yield made
        put_in_place(made, target, overwrite=overwrite)
    except OSError as error:
        raise _unwritable(target, error) from error
    finally:
        shutil.rmtree(made, ignore_errors=True)
        if lock is not None:
            os.close(lock)
        _remove_empty(missing)


def reading_folder(target: Path) -> Path:
    """Where frames are kept while a long film is read for the run folder `target`."""
    return target.parent / f".{target.name}{READING}"


def clean_up(target: Path) -> None:
    """Remove or restore what processes that were killed left beside `target`."""
    hidden = f".{glob.escape(target.name)}.*"
    earlier = list(target.parent.glob(hidden + OLD))
    for left in (reading_folder(target), *earlier, *target.parent.glob(hidden + PART)):
        if (lock := lock_folder(left)) is None:
            continue
        if left in earlier and not target.exists():
            with suppress(OSError):
                left.rename(target)
        else:
            shutil.rmtree(left, ignore_errors=True)
        os.close(lock)


def lock_folder(folder: Path) -> int | None:
    """Claim a folder; None where a living process has it, where it is not there, or, off POSIX, always.

    The claim ends with the process, however that ends.
    """
    if fcntl is None:
        return None
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:
        return None
    try:
        lock_open_file(handle)
    except OSError:
        os.close(handle)
        return None
    return handle


def lock_open_file(handle: int) -> None:
    """Claim an open file for this process, until it is closed; off POSIX nothing is claimed.

    Raises: BlockingIOError where another process has it, OSError where the file system has no locks.
    """
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def put_in_place(made: Path, target: Path, *, overwrite: bool) -> None:
    """Put `made` in the place of `target`; an earlier run takes the temporary place, and is removed there.

    Where the file system can exchange two names in one step, the target is at every moment the old run or
    the new one; elsewhere a kill between two renames leaves the old run aside, and `clean_up` puts it back.

    Raises
    ------
    InputError
        Where another run has taken the place meanwhile.
    """
    if not target.exists():
        made.rename(target)
        return
    _check_earlier(target, overwrite=overwrite)
    if _exchange(made, target):
        return
    old = target.parent / f".{target.name}.{secrets.token_hex(4)}{OLD}"
    target.rename(old)
    try:
        made.rename(target)
    except OSError:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
    """Swap two names in one step; False where the system or the file system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    here, exchange = -100, 2  # AT_FDCWD: relative names are those of the working directory; RENAME_EXCHANGE
    return int(call(here, os.fsencode(one), here, os.fsencode(other), exchange)) == 0


@contextmanager
def whole_file(target: Path, *, durable: bool = False) -> Iterator[Path]:
    """A path beside the target; what is written there takes the target's place when it is whole.

    durable: it is on the disk when this returns, whatever ends the machine; that takes some milliseconds.

    Raises
    ------
    InputError
        Where it cannot be written; an earlier file is as it was then.
    """
    made, missing = None, _missing_parents(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
        yield made / target.name
        if durable:
            _to_disk(made / target.name)
        (made / target.name).replace(target)
        if durable:
            _to_disk(target.parent)
    except OSError as error:
        found = str(error.strerror or error).lower()
        raise InputError(target, "a place that can be written", found, "nothing was written") from error
    finally:
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)
        _remove_empty(missing)


def _to_disk(path: Path) -> None:
    """Wait until a file, or what a folder's names stand for, is on the disk."""
    if path.is_dir() and fcntl is None:  # Windows opens no folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _missing_parents(path: Path) -> list[Path]:
    """Folders above a path that must be made, the nearest first."""
    return [parent for parent in path.absolute().parents if not parent.exists()]


def _remove_empty(folders: list[Path]) -> None:
    """Folders that were made for something that failed."""
    for folder in folders:
        with suppress(OSError):  # not empty: it did not fail
            folder.rmdir()


def existing_parent(path: Path) -> Path:
    """The nearest folder above a path that is there."""
    return next(parent for parent in path.absolute().parents if parent.exists())


def _unwritable(target: Path, error: OSError) -> InputError:
    short = error.errno is None and "requested and" in str(error)  # NumPy's words for a write cut short
    full = short or error.errno in (errno.ENOSPC, errno.EDQUOT)
    found = "a full disk" if full else str(error.strerror or error).lower()
    return InputError(target, "a place that can be written", found, "nothing was written; give another `out`")
