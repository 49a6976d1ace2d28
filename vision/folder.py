"""Folders and files that are written completely or not at all, and the JSON and tables in them."""

from __future__ import annotations

import errno
import glob
import html
import itertools
import json
import math
import os
import re
import secrets
import shutil
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vision.errors import InputError, reason_of, unwritable
from vision.files import c_library
from vision.locks import POSIX, lock_folder

if TYPE_CHECKING:
    import pandas as pd

RUN_JSON = "run.json"
TRUTH = "truth.nc"
KNOWN_BY = {RUN_JSON: "a run folder", TRUTH: "a synthetic test"}  # what a folder is, by a file in it
PART, OLD = ".part", ".old"  # suffixes of a run that is being written, and of one that was moved aside
READING = ".reading"  # suffix of the folder that holds the frames read so far
CLOSE_FILES = "close its files where they are open (Excel, a notebook)"


def check_target(target: Path, *, overwrite: bool) -> None:
    """Check that a run folder can be written, before anything is computed.

    Raises: InputError, also on Windows if a file in it is open.
    """
    _check_writable(target, overwrite=overwrite, known_by=RUN_JSON)
    if not POSIX:
        _check_closed(target)


def _check_writable(target: Path, *, overwrite: bool, known_by: str) -> None:
    """Check that a folder can be written.

    known_by: the file that an earlier folder must hold to be replaced, one of `KNOWN_BY`.
    Raises: InputError if it exists, not empty (with `overwrite`: without that file), or the disk refuses.
    """
    try:
        if target.exists():
            _check_earlier(target, overwrite=overwrite, known_by=known_by)
    except OSError as error:
        raise unwritable(target, error) from error
    check_place(target)


def check_place(target: Path) -> None:
    """Check that a file or folder can be written, before anything is computed.  Raises: InputError."""
    try:
        parent = existing_parent(target)
    except OSError as error:
        raise unwritable(target, error) from error
    if not parent.is_dir():
        raise InputError(target, "a place for a folder", f"a file at {parent}", "give another `out`")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(
            target, "a place that can be written", f"no right to write in {parent}", "give another `out`"
        )


def check_new(target: Path, *, overwrite: bool, kind: str = "file") -> None:
    """Check that nothing is overwritten unless that is asked for.  Raises: InputError."""
    if target.exists() and not overwrite:
        raise InputError(target, f"a new {kind}", "one that exists", "give `overwrite` or another `out`")


def _check_earlier(target: Path, *, overwrite: bool, known_by: str) -> None:
    """Check that an existing folder may be replaced: an empty one, or one with `known_by`, if asked for.

    Raises: InputError if not, or if it cannot be written; errors that `overwrite` cannot avoid come first.
    """
    if not target.is_dir():
        raise InputError(target, "a folder to write", "a file of this name", "give another `out`")
    empty = not any(target.iterdir())
    wanted = f"a new folder, or {KNOWN_BY[known_by]} to overwrite"
    if not (empty or (target / known_by).is_file()):
        raise InputError(target, wanted, f"something else (no {known_by} in it)", "give another `out`")
    if target.samefile(Path.cwd()):
        raise InputError(target, wanted, "the working directory", "go one folder up")
    if not os.access(target, os.W_OK | os.X_OK):
        raise InputError(target, wanted, "one that is read-only", "give another `out`")
    check_new(target, overwrite=overwrite or empty, kind="folder")


def _check_closed(folder: Path) -> None:
    """Check that no file of a folder is open: Windows would not let the folder be replaced.

    Raises: InputError.
    """
    for one in folder.rglob("*"):
        try:
            one.rename(one)  # refused if it is open
        except OSError as error:
            found = f"{one.relative_to(folder)}: {reason_of(error)}"
            raise InputError(folder, "a folder that no program uses", found, CLOSE_FILES) from error


@contextmanager
def run_folder(target: Path, *, overwrite: bool = False, known_by: str = RUN_JSON) -> Iterator[Path]:
    """Yield a temporary folder beside `target`; replace `target` by it at the end.

    After an error or an interrupt the temporary folder is removed and an earlier run is unchanged. What a
    killed process left behind is first removed or restored (`clean_up`). A link to a folder stays, and the
    folder that it leads to is replaced.

    known_by: the file that an earlier folder must hold to be replaced, one of `KNOWN_BY`.
    Raises: InputError if the target exists or cannot be written, or the disk is full.
    """
    target = target.resolve() if target.is_symlink() else target
    clean_up(target)
    _check_writable(target, overwrite=overwrite, known_by=known_by)
    lock = None
    try:
        with _temporary_folder(target, PART) as temporary:
            lock = lock_folder(temporary)
            yield temporary
            put_in_place(temporary, target, overwrite=overwrite, known_by=known_by)
    except OSError as error:
        raise unwritable(target, error) from error
    finally:
        if lock is not None:
            lock.release()


@contextmanager
def _temporary_folder(target: Path, suffix: str = "") -> Iterator[Path]:
    """Yield a new hidden folder beside `target`, and remove it and the empty folders above it at the end."""
    # The name is known before the folder exists, so that it is removed after an interrupt at any time.
    temporary = target.parent / f".{target.name}.{secrets.token_hex(4)}{suffix}"
    missing = [parent for parent in target.absolute().parents if not parent.exists()]
    try:
        temporary.mkdir(parents=True)
        yield temporary
    finally:
        try:
            shutil.rmtree(temporary, ignore_errors=True)
        finally:  # again, as an interrupt may have ended it
            shutil.rmtree(temporary, ignore_errors=True)
            for parent in missing:
                with suppress(OSError):  # not empty
                    parent.rmdir()


def reading_folder(target: Path) -> Path:
    """Return the folder that holds the frames read so far for the run folder `target`."""
    return target.parent / f".{target.name}{READING}"


def clean_up(target: Path) -> None:
    """Remove what killed processes left beside `target`, or restore an earlier run that they moved aside."""
    hidden = f".{glob.escape(target.name)}.*"
    earlier = list(target.parent.glob(hidden + OLD))
    for left in (reading_folder(target), *earlier, *target.parent.glob(hidden + PART)):
        if (lock := lock_folder(left)) is None:
            continue
        if left in earlier:
            _restore_or_remove(left, target)
        else:
            shutil.rmtree(left, ignore_errors=True)
        lock.release()


def keep_others(earlier: Path, made: Path, written: Collection[str]) -> None:
    """Link into a new folder, or copy, what an earlier one holds besides the files `written` by the program.

    The earlier folder is not changed, so that nothing is lost if the new one does not take its place.
    """
    if not earlier.is_dir():
        return
    for one in earlier.iterdir():
        if one.name in written or (made / one.name).exists():
            continue
        if one.is_dir() and not one.is_symlink():
            shutil.copytree(one, made / one.name, symlinks=True, copy_function=_link_or_copy)
        else:
            _link_or_copy(one, made / one.name)


def _link_or_copy(source: str | Path, target: str | Path) -> None:
    try:
        os.link(source, target, follow_symlinks=False)
    except OSError:  # a file system without links
        shutil.copy2(source, target, follow_symlinks=False)


def put_in_place(made: Path, target: Path, *, overwrite: bool, known_by: str = RUN_JSON) -> None:
    """Rename `made` to `target`; an earlier run there may get the name `made`, and the caller removes it.

    If the file system can exchange two names in one step, the target is at any time the old run or the new
    one. Otherwise a kill between two renames leaves the old run aside, and `clean_up` restores it.

    Raises: InputError if the target exists by now and may not be replaced, or the system does not let it be
    moved; in that case `made` gets another name, so that nothing that was computed is lost.
    """
    if not target.exists():
        _rename(made, target)
        return
    _check_earlier(target, overwrite=overwrite, known_by=known_by)
    if _exchange(made, target):
        return
    old = target.parent / f".{target.name}.{secrets.token_hex(4)}{OLD}"
    try:
        try:
            _rename(target, old)
        except OSError as error:
            beside = _free_name(target)
            _rename(made, beside)
            advice = f"the new run is in {beside}; {CLOSE_FILES} before the next"
            raise InputError(target, "a folder that can be replaced", reason_of(error), advice) from error
        _rename(made, target)
    finally:
        try:
            _restore_or_remove(old, target)
        finally:  # again, as an interrupt may have ended it
            _restore_or_remove(old, target)


def _rename(folder: Path, name: Path) -> None:
    """Rename a folder. Windows does not, while a virus scanner looks into a new file: then again, for 3 s."""
    patience_until = time.monotonic() + (0 if POSIX else 3)
    while True:
        try:
            folder.rename(name)
            return
        except PermissionError:
            if time.monotonic() > patience_until:
                raise
            time.sleep(0.05)


def _free_name(target: Path) -> Path:
    """Return the first of NAME_2, NAME_3, … that does not exist."""
    names = (target.with_name(f"{target.name}_{n}") for n in itertools.count(2))
    return next(name for name in names if not name.exists())


def _restore_or_remove(old: Path, target: Path) -> None:
    """Rename a run that was moved aside back to `target`, or remove it if there is another one."""
    if target.exists():
        shutil.rmtree(old, ignore_errors=True)
    else:
        with suppress(OSError):
            old.rename(target)


def _exchange(one: Path, other: Path) -> bool:
    """Exchange two names in one step; return False if the system or the file system cannot."""
    call = getattr(c_library(), "renameat2", None)
    if call is None:
        return False
    at_fdcwd, rename_exchange = -100, 2  # the former: relative names start at the working directory
    return int(call(at_fdcwd, os.fsencode(one), at_fdcwd, os.fsencode(other), rename_exchange)) == 0


@contextmanager
def whole_file(target: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path; replace `target` by the file written there at the end.

    durable: wait until the file is on the disk, so that a power failure does not lose it; this takes some
    milliseconds.

    Raises: InputError if it cannot be written; an earlier file is then unchanged.
    """
    try:
        with _temporary_folder(target) as temporary:
            yield temporary / target.name
            if durable:
                _to_disk(temporary / target.name)
            (temporary / target.name).replace(target)
            if durable:
                _to_disk(target.parent)
    except OSError as error:
        raise unwritable(target, error, "nothing was written") from error


def _to_disk(path: Path) -> None:
    """Wait until a file, or the list of names in a folder, is on the disk."""
    if path.is_dir() and not POSIX:  # Windows cannot open folders
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def existing_parent(path: Path) -> Path:
    """Return the nearest folder above a path that exists.

    Raises: FileNotFoundError if none does: a drive or server of Windows that is not there.
    """
    for parent in path.absolute().parents:
        if parent.exists():
            return parent
    raise FileNotFoundError(errno.ENOENT, "no such drive or server")


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write strict JSON, indented; NaN and infinity become null."""
    text = json.dumps(plain(content), indent=2, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8", errors="replace")


def plain(value: Any) -> Any:
    """Convert a value for JSON: NaN and infinity to None, dataclasses to dicts, arrays to lists, else str."""
    if type(value) is float:  # most values are, in long lists
        return value if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)


def from_json(kind: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of the values that are fields of a dataclass, with tuples again in place of lists."""
    found = {one.name: values[one.name] for one in fields(kind) if one.name in values}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in found.items()}


def flattened(values: Mapping[str, Any], joint: str, before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of nested mappings, with the names joined by `joint`."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flattened(value, joint, f"{before}{name}{joint}")
        else:
            yield f"{before}{name}", value


# --- tables, and text of files and names made safe in them --------------------------------------------------

_FORMULA = tuple("=+-@")  # first characters of cells that Excel and LibreOffice take for formulas
_NUMBER = re.compile(r"[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?")


class Shown:
    """A result that shows its main values as a table in notebooks, and as lines of text elsewhere."""

    def _shown(self) -> tuple[str, dict[str, str]]:
        """Return the title, and the names and texts of the values."""
        raise NotImplementedError

    def __repr__(self) -> str:
        title, rows = self._shown()
        return "\n".join([title, *(f"  {name}: {text}" for name, text in rows.items())])

    def _repr_html_(self) -> str:
        return html_table(*self._shown())


def numbered(name: str, lines: Sequence[str]) -> dict[str, str]:
    """Return lines as rows of a table, under this name and their number: "warning 1"."""
    return {f"{name} {k}": line for k, line in enumerate(lines, 1)}


def html_table(title: str, rows: Mapping[str, str]) -> str:
    """Return an HTML table of two columns for notebooks, with escaped text."""
    cells = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th>'
        f'<td style="text-align:left">{html.escape(value)}</td></tr>'
        for name, value in rows.items()
    )
    return f"<table><caption>{html.escape(title)}</caption>{cells}</table>"


def harmless(text: str) -> str:
    """Put an apostrophe before text that a spreadsheet would take for a formula.

    Numbers are not changed. Carriage returns become spaces, since some programs start a row there.
    """
    text = text.replace("\r", " ")
    is_formula = text.lstrip()[:1] in _FORMULA or text[:1] == "\t"
    return f"'{text}" if text and is_formula and not _NUMBER.fullmatch(text) else text


def write_csv(table: pd.DataFrame, path: Path, *, digits: int | None = 9) -> None:
    """Write a table as CSV, with `harmless` text and column names.

    digits: significant digits of numbers that are not whole; None for all.
    """
    safe = table.rename(columns=lambda name: harmless(str(name)))
    for name, dtype in safe.dtypes.items():
        if dtype.kind not in "iufb":
            safe[name] = safe[name].map(lambda cell: harmless(cell) if isinstance(cell, str) else cell)
    style = None if digits is None else f"%.{digits}g"
    safe.to_csv(path, index=False, float_format=style, lineterminator="\n")
