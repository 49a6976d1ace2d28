"""A finished run in another program's format."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from vision.errors import InputError
from vision.run.export_files import write_csv, write_mat, write_parquet, write_xlsx
from vision.run.export_tables import all_tables, napari_table, trackpy_table
from vision.run.folder import check_target, run_folder
from vision.run.provenance import write_run_json
from vision.run.reading import Run, check_mark

Format = Literal["csv", "xlsx", "parquet", "mat", "trackpy", "napari"]
FORMATS: tuple[Format, ...] = get_args(Format)
ENDINGS = {"xlsx": ".xlsx", "mat": ".mat", "trackpy": "_trackpy.csv", "napari": "_napari.csv"}
NEEDS = {"xlsx": "openpyxl", "parquet": "pyarrow"}
MARK = "export"  # of run.json: tells a folder of exported tables from a run


@dataclass(frozen=True)
class Exported:
    """target, the file or folder written.  notes, what is not in it."""

    target: Path
    notes: tuple[str, ...] = ()


def export_run(run: Run, to: Format, *, out: Path | None = None, overwrite: bool = False) -> Exported:
    """Write a run's tables for another program; csv and parquet become a folder, the rest one file.

    Positions whose flag is not "ok" are empty in csv, xlsx and parquet, NaN in mat, and left out for
    trackpy and napari.

    Args: out, file or folder; by default the run's name with the format's ending in the working directory.
    Raises: InputError for a target that exists (without overwrite), lies in the run itself, is another run or
    cannot be written, for a package that is not installed, or for a run without what the format holds.
    """
    _check_package(to)
    name = run.folder.resolve().name
    target = out or Path(f"{name}{ENDINGS.get(to, f'_{to}')}")
    _check_outside(run, target)
    if to not in ENDINGS:
        _write_folder(run, to, target, overwrite=overwrite)
        return Exported(target)
    _check_file(target, overwrite=overwrite)
    with _whole_file(target) as path:
        return Exported(target, tuple(_write_file(run, to, path)))


def _write_folder(run: Run, to: Format, target: Path, *, overwrite: bool) -> None:
    check_target(target, overwrite=overwrite)
    check_mark(target, MARK)
    tables = all_tables(run)
    with run_folder(target, overwrite=overwrite) as folder:
        (write_csv if to == "csv" else write_parquet)(tables, folder)
        rows = {name: len(table) for name, table in tables.items()}
        write_run_json(folder, {**run.facts, MARK: {"to": to, "from": str(run.folder), "rows": rows}})


def _write_file(run: Run, to: Format, path: Path) -> list[str]:
    """Notes on what was left out."""
    if to == "xlsx":
        return write_xlsx(all_tables(run), path)
    if to == "mat":
        write_mat(run, path)
    else:
        table = trackpy_table(run) if to == "trackpy" else napari_table(run)
        table.to_csv(path, index=False, lineterminator="\n")
    return []


def _check_package(to: str) -> None:
    package = NEEDS.get(to)
    if package and importlib.util.find_spec(package) is None:
        advice = "install it: pip install 'sheetvision[export]'"
        raise InputError(f"--to {to}", f"the package {package}", "none", advice)


def _check_outside(run: Run, target: Path) -> None:
    if target.resolve().is_relative_to(run.folder.resolve()):
        raise InputError(target, "a place outside the run folder", "one inside", "give another --out")


def _check_file(target: Path, *, overwrite: bool) -> None:
    if target.is_dir():
        raise InputError(target, "a file to write", "a folder", "give another --out")
    if target.exists() and not overwrite:
        raise InputError(target, "a new file", "one that exists", "give --overwrite or another --out")


@contextmanager
def _whole_file(target: Path) -> Iterator[Path]:
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
