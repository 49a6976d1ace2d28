"""A run folder appears whole or not at all."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vision.errors import InputError

MARK = "run.json"  # what makes a folder a run folder


def check_target(target: Path, *, overwrite: bool) -> None:
    """Refuse early what would fail late: an existing folder, one that is no run, a place that cannot be
    written.

    Raises: InputError.
    """
    try:
        if target.exists():
            _check_earlier(target, overwrite=overwrite)
        parent = _existing_parent(target)
    except OSError as error:
        raise _unwritable(target, error) from error
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(target, "a place that can be written", f"{parent} is not", "give another `out`")


def _check_earlier(target: Path, *, overwrite: bool) -> None:
    """Only a run folder of one's own may be replaced, and only if asked for."""
    if not overwrite:
        raise InputError(target, "a new folder", "one that exists", "give `overwrite` or another `out`")
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
    as it was.

    Raises: InputError where the target exists or cannot be written, or the disk is full.
    """
    check_target(target, overwrite=overwrite)
    made = target.parent / f".{target.name}.{secrets.token_hex(4)}"  # named first: an interrupt finds it
    try:
        made.mkdir(parents=True)
        yield made
        _replace(made, target, overwrite=overwrite)
    except OSError as error:
        raise _unwritable(target, error) from error
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _replace(made: Path, target: Path, *, overwrite: bool) -> None:
    """Put `made` in the place of `target`; an earlier run is removed only when the new one stands.

    Raises: InputError where another run has taken the place meanwhile.
    """
    if not target.exists():
        made.rename(target)
        return
    _check_earlier(target, overwrite=overwrite)
    old = Path(tempfile.mkdtemp(prefix=f".{target.name}.old.", dir=target.parent))
    try:
        earlier = target.rename(old / target.name)
        try:
            made.rename(target)
        except OSError:
            earlier.rename(target)
            raise
    finally:
        shutil.rmtree(old, ignore_errors=True)


@contextmanager
def whole_file(target: Path) -> Iterator[Path]:
    """A path beside the target; what is written there takes the target's place when it is whole."""
    made = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
        yield made / target.name
        (made / target.name).replace(target)
    except OSError as error:
        found = str(error.strerror or error).lower()
        raise InputError(target, "a place that can be written", found, "nothing was written") from error
    finally:
        if made is not None:
            shutil.rmtree(made, ignore_errors=True)


def _existing_parent(path: Path) -> Path:
    return next(parent for parent in path.absolute().parents if parent.exists())


def _unwritable(target: Path, error: OSError) -> InputError:
    short = error.errno is None and "requested and" in str(error)  # NumPy's words for a write cut short
    full = short or error.errno in (errno.ENOSPC, errno.EDQUOT)
    found = "a full disk" if full else str(error.strerror or error).lower()
    return InputError(target, "a place that can be written", found, "nothing was written; give another `out`")
