"""A run folder as a review finds it, and how a review writes into it."""

from __future__ import annotations

import math
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import pandas as pd

from vision.clock import Candidate, Clock
from vision.errors import InputError
from vision.run.folder import MARK, lock_open_file
from vision.run.reading import AGAIN, read_json, read_table_of
from vision.sheets.corrections import Correction, correction_of

COLUMNS = {
    "events": ("event", "t_v_s", "t_p_s", "stick_length_um"),
    "deformation": ("event", "index", "side", "n", "ratio", "ratio_err", "p_stiff", "shell", "flag"),
    "shells": ("event", "side", "stiff_sheets"),
}
"""Tables of a run, and what a review needs of each."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a run folder holds, read once.

    Parameters
    ----------
    folder
        The run folder.
    facts
        run.json.
    clock, events, deformation, shells
        As far as the run has them.
    """

    folder: Path
    facts: Mapping[str, Any]
    clock: Clock | None = None
    events: pd.DataFrame | None = None
    deformation: pd.DataFrame | None = None
    shells: pd.DataFrame | None = None

    @classmethod
    def of(cls, folder: Path) -> Found:
        """Raises: InputError for a folder that is no run of a video, or a damaged one."""
        facts = read_json(folder / MARK)
        clock = folder / "clock.json"
        return cls(
            folder=folder,
            facts=facts,
            clock=clock_of(read_json(clock)) if clock.exists() else None,
            **{name: _table(folder, name) for name in COLUMNS},
        )

    @property
    def film_checksum(self) -> str:
        """Of the film, as run.json has it."""
        first: dict[str, Any] = next(iter(self.facts.get("inputs") or []), {})
        return str(first.get("sha256") or first.get("fingerprint") or "")

    @property
    def applied(self) -> list[Correction]:
        """Decisions that its tables already follow."""
        return [
            correction_of(entry["kind"], _as_entry(entry)) for entry in self.facts.get("corrections") or []
        ]


def _table(folder: Path, name: str) -> pd.DataFrame | None:
    """One of the run's tables, with the columns that are needed; None where the run has none."""
    table = read_table_of(folder, name)
    absent = [] if table is None else [column for column in COLUMNS[name] if column not in table]
    if absent:
        raise InputError(
            folder / f"{name}.csv", "a table as track writes it", f"no {', '.join(absent)}", AGAIN
        )
    return table


def clock_of(facts: Mapping[str, Any]) -> Clock:
    """`Clock` from clock.json."""
    values: dict[str, Any] = {name: math.nan if value is None else value for name, value in facts.items()}
    values["candidates"] = tuple(Candidate(**one) for one in facts.get("candidates") or ())
    values["warnings"] = tuple(facts.get("warnings") or ())
    return Clock(**{name: values[name] for name in Clock.__dataclass_fields__ if name in values})


def _as_entry(facts: Mapping[str, Any]) -> dict[str, Any]:
    """An entry of a corrections file from what run.json says about a correction."""
    known = {name: value for name, value in facts.items() if name in Correction.__dataclass_fields__}
    for name in ("sheets", "rows"):
        if known.get(name) is not None:
            known[name] = tuple(known[name])
    return Correction(**known).entry()


def decided_clock(own: Clock | None, decided: Correction) -> Clock:
    """The clock of a decision; slips are counted again when it is saved."""
    known = own or Clock(
        offset_s=0.0,
        drift_ppm=0.0,
        residual_ms=math.nan,
        matched=0,
        unmatched_video=0,
        unmatched_force=0,
        margin=math.nan,
        status="given",
        how="given",
    )
    return replace(
        known,
        offset_s=decided.offset_s or 0.0,
        drift_ppm=decided.drift_ppm,
        status="given",
        how="given",
        error_ms=math.nan,
        drift_err_ppm=math.nan,
    )


def claim(folder: Path) -> IO[str]:
    """An open file beside the run folder that keeps others from reviewing it; they may once it is closed.

    Beside it, as saving puts another folder in the run's place. The claim ends with the process, however that
    ends. Where the system has no such locks (Windows) nothing is claimed.

    Raises
    ------
    InputError
        Where another process reviews the run, or the place cannot be written.
    """
    path = folder.resolve()
    path = path.with_name(f".{path.name}.review")
    try:
        file = path.open("w", encoding="utf-8")
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(path, "a place that can be written", found, "copy the run folder") from error
    try:
        lock_open_file(file.fileno())
    except OSError:
        file.close()
        found, advice = "a review of it that is open", "go to its window, or end it there"
        raise InputError(folder, "a run that nobody reviews now", found, advice) from None
    return file


def write_durably(path: Path, text: str) -> None:
    """Replace a text file in one step; on the disk when this returns.

    Raises
    ------
    InputError
        Where it cannot be written; the file is as it was then.
    """
    made = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with made.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        made.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        found = (error.strerror or str(error)).lower()
        raise InputError(path, "a place that can be written", found, "the decision is not kept") from error
    finally:
        made.unlink(missing_ok=True)
