"""MATLAB recordings: the vectors of a .mat file as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vision.errors import InputError
from vision.force.table import Table
from vision.force.units import split_name

_MAX_COLUMNS = 20


def read_mat(path: Path) -> list[Table]:
    """The vectors of a .mat file (v4 to v7.3) that share the commonest length, as one table.

    Fields of a struct appear as "struct.field", columns of a matrix as "matrix 1", "matrix 2" ….  A .mat file
    writes no units: they are "" unless a name ends in one ("load_N").  Raises InputError where there are no
    vectors.
    """
    version, variables = _load(path)
    vectors = dict(_vectors(variables))
    if not vectors:
        raise InputError(
            path, "vectors of time and force", "no numeric vectors", "save them with plain names"
        )
    length = Counter(v.size for v in vectors.values()).most_common(1)[0][0]
    chosen = {name: v for name, v in vectors.items() if v.size == length}
    names, units = zip(*(split_name(name) for name in chosen), strict=True)
    values = np.column_stack(list(chosen.values()))
    return [Table(tuple(names), tuple(units), values, {"layout": f"MATLAB {version}", "encoding": "binary"})]


def _load(path: Path) -> tuple[str, Mapping[str, Any]]:
    import h5py
    from scipy.io import loadmat

    if h5py.is_hdf5(path):
        return "v7.3", _load_hdf5(path)
    try:
        return "v5", loadmat(path, squeeze_me=True, struct_as_record=True)
    except Exception as error:  # SciPy's reader raises many kinds on damaged files
        raise InputError(
            path, "a MATLAB .mat file", f"one that cannot be read ({error})", "save it again"
        ) from error


def _load_hdf5(path: Path) -> dict[str, Any]:
    import h5py

    found: dict[str, Any] = {}

    def keep(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            # MATLAB stores columns first: a matrix comes out of HDF5 turned over.
            found[name.replace("/", ".")] = np.squeeze(np.asarray(item).T)

    with h5py.File(path) as file:
        file.visititems(keep)
    return found


def _vectors(variables: Mapping[str, Any]) -> Iterator[tuple[str, np.ndarray[Any, np.dtype[np.float64]]]]:
    for name, value in variables.items():
        array = np.asarray(value)
        if name.startswith("__"):
            continue
        if array.dtype.names and array.ndim == 0:
            yield from _vectors({f"{name}.{key}": array[key].item() for key in array.dtype.names})
        elif array.dtype.kind in "fiu" and array.ndim == 1 and array.size >= 3:
            yield name, array.astype(float)
        elif array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] <= _MAX_COLUMNS:
            yield from ((f"{name} {k + 1}", column.astype(float)) for k, column in enumerate(array.T))
