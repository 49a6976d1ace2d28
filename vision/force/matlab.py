"""MATLAB files of testing machines as tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy

from vision.errors import InputError
from vision.files import reading
from vision.force.columns import Table, split_name
from vision.isolation import try_out
from vision.numeric import Floats

LEAST_ROWS = 3
_MOST_MATRIX_COLUMNS = 20  # of a matrix; wider ones are images or tables of something else
_MOST_LEVELS = 20  # of structs in structs
_WANTED = "a MATLAB .mat file"


def read_mat(path: Path) -> list[Table]:
    """The vectors of a .mat file that share the commonest length, as one table."""
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
    """(version, variables by name) of a .mat file; fields of groups as "group.field".

    Both parsers can crash or run for ever on a damaged file, so that a process of its own tries it first.
    """
    with reading(path, _WANTED, "save it again"):
        if not h5py.is_hdf5(path):
            try_out(path, "MATLAB", _WANTED)
            return "v5", scipy.io.loadmat(path, squeeze_me=True, struct_as_record=True)
        try_out(path, "HDF5", _WANTED)
        found: dict[str, Any] = {}

        def keep(name: str, item: object) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                # MATLAB stores columns first: a matrix comes out of HDF5 transposed.
                found[name.replace("/", ".")] = np.squeeze(np.asarray(item).T)

        with h5py.File(path) as file:
            file.visititems(keep)
    return "v7.3", found


def _vectors(variables: Mapping[str, Any], level: int = 0) -> Iterator[tuple[str, Floats]]:
    """Numeric vectors, and columns of matrices, by name."""
    for name, value in variables.items():
        array = np.asarray(value)
        if name.startswith("__"):
            continue
        if array.dtype.names and array.ndim == 0 and level < _MOST_LEVELS:
            yield from _vectors({f"{name}.{key}": array[key].item() for key in array.dtype.names}, level + 1)
        elif array.dtype.kind in "fiu" and array.ndim == 1 and array.size >= LEAST_ROWS:
            yield name, array.astype(float)
        elif array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] <= _MOST_MATRIX_COLUMNS:
            yield from ((f"{name} {k + 1}", column.astype(float)) for k, column in enumerate(array.T))
