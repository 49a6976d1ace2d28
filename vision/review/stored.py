"""A run folder as a review finds it, and how a review writes into it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import pandas as pd

from vision.clock import Candidate, Clock
from vision.errors import InputError
from vision.run.folder import MARK, lock_open_file
from vision.run.provenance import Parameter
from vision.run.reading import AGAIN, parameters_of, read_json, read_table
from vision.sheets.corrections import Correction, correction_of

COLUMNS = ("event", "t_v_s", "t_p_s", "stick_length_um")
"""Of events.csv that a review needs."""


@dataclass(frozen=True, kw_only=True)
class Found:
    """What a run folder holds, read once.

    Parameters
    ----------
    folder
        The run folder.
    facts, parameters
        run.json, and what the run was made with by the names of the command's options.
    stamp
        By which another run in its place is recognised.
    clock, events
        As far as the run has them.
    """

    folder: Path
    facts: Mapping[str, Any]
    parameters: Mapping[str, Parameter]
    stamp: tuple[int, int, int]
    clock: Clock | None = None
    events: pd.DataFrame | None = None

    @classmethod
    def of(cls, folder: Path) -> Found:
        """Raises: InputError for a folder that is no run of a video, or a damaged one."""
        stamp, facts = _stamp(folder), read_json(folder / MARK)
        clock = folder / "clock.json"
        return cls(
            folder=folder,
            facts=facts,
            parameters=parameters_of(folder, facts),
            stamp=stamp,
            clock=clock_of(read_json(clock)) if clock.exists() else None,
            events=_events(folder),
        )

    def check_there(self) -> None:
        """Raises: InputError where the run folder is gone, or another run has taken its place."""
        if _stamp(self.folder) != self.stamp:
            found, advice = "none, or another one", "nothing was changed; end the review and start it again"
            raise InputError(self.folder, "the run that is reviewed", found, advice)

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel; None where it was not given."""
        size = self.parameters.get("pixel_size")
        return None if size is None or size.value is None else float(size.value)

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


def _stamp(folder: Path) -> tuple[int, int, int]:
    """Of run.json; zeros where there is none."""
    try:
        facts = (folder / MARK).stat()
    except OSError:
        return 0, 0, 0
    return facts.st_ino, facts.st_size, facts.st_mtime_ns


def _events(folder: Path) -> pd.DataFrame | None:
    """The stick-slip events; None where the run has none."""
    table = read_table(folder, "events")
    absent = [] if table is None else [column for column in COLUMNS if column not in table]
    if absent:
        found = f"no {', '.join(absent)}"
        raise InputError(folder / "events.csv", "a table as track writes it", found, AGAIN)
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
