"""`track export RUN`: tables of a finished run in another program's format."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from vision.command.console import complain, say
from vision.command.options import Flag


def export(
    run: Path,
    /,
    *,
    to: Literal["csv", "xlsx", "parquet", "mat", "trackpy", "napari"],
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """Tables of a finished run in another program's format.

    csv and parquet: a folder with a file for each table. xlsx: one worksheet for each. mat: matrices and
    structs for MATLAB. trackpy: x, y, frame, particle. napari: track_id, t, y, x. The unit is the last part
    of a column's name; trackpy and napari have px.

    Positions that were not measured are empty in csv, xlsx and parquet, NaN in mat, and left out for trackpy
    and napari.

    Examples:

        track export test_tracks --to xlsx

        track export test_tracks --to mat --out for_matlab.mat

    Parameters
    ----------
    run
        Run folder.
    to
        Format.
    out
        File or folder; the run's name with the format's ending in the working directory by default.
    overwrite
        Replace an earlier export.
    quiet
        No summary.
    """
    from vision.run import export_run, read_run

    exported = export_run(read_run(run), to, out=out, overwrite=overwrite)
    for note in exported.notes:
        complain(note)
    if not quiet:
        folder = "/" if exported.target.is_dir() else ""
        say([f"{to} -> {exported.target}{folder}"])
    return 0
