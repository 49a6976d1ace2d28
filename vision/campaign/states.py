"""What became of each film: one small file a film, written by its job."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Literal

from vision.run import whole_file, write_json

Word = Literal["waiting", "running", "done", "warnings", "partial", "failed"]
FINISHED: tuple[Word, ...] = ("done", "warnings", "partial")
"""Not done again while the film's key is the same. ``partial``: the film is tracked, but its force recording
cannot be used or a late stage failed; only other input or another version changes that."""


@dataclass(frozen=True, kw_only=True)
class State:
    """One film's state.

    Parameters
    ----------
    name, key
        Of the film when its job began.
    state
        waiting, running, done, warnings, partial or failed.
    reason
        One line: the first warning, or what went wrong.
    seconds
        How long it took.
    warnings
        All warnings of the run.
    attempts
        How often it was tried with this key.
    at
        Seconds since 1970 when this was written.
    """

    name: str
    key: str = ""
    state: Word = "waiting"
    reason: str = ""
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()
    attempts: int = 0
    at: float = 0.0


def read_state(out: Path, name: str) -> State:
    """A film's state; "waiting" where there is no file, or a damaged one."""
    try:
        content = json.loads(_path(out, name).read_text(encoding="utf-8"))
        known = {part.name for part in fields(State)}
        content = {part: value for part, value in content.items() if part in known}
        return State(**{**content, "warnings": tuple(content.get("warnings", ()))})
    except (OSError, ValueError, TypeError, AttributeError):
        return State(name=name)


def write_state(out: Path, state: State) -> None:
    """Write a film's state, whole.  Raises: InputError."""
    with whole_file(_path(out, state.name)) as path:
        write_json(asdict(state) | {"at": time.time()}, path)


def _path(out: Path, name: str) -> Path:
    return out / "states" / f"{name}.json"
