"""A run that is tracked again with one more decision, beside the run, until it is kept or thrown away."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vision.errors import InputError
from vision.run.folder import clean_up, put_in_place

if TYPE_CHECKING:
    from vision.review.session import Session


class Trial:
    """Tracks a run again under a decision that is not kept, and says what that would change.

    Parameters
    ----------
    run
        The session.

    Notes
    -----
    The new run is written whole, beside the old one, with the decision in its corrections.toml. Keeping it is
    a change of two names: what is kept is exactly what was shown, and the film is not read a second time.
    """

    def __init__(self, run: Session) -> None:
        self.run = run
        self._place: Path | None = None  # where it is written
        self._found: Mapping[str, Any] | None = None

    def start(self, request: Mapping[str, Any]) -> None:
        """Begin to track again.  Raises: InputError where the decision does not fit, or while it is busy."""
        run = self.run
        with run.lock:
            run.check_free()
            decision = run.decision_of(request, dated=True)
            self._place = _beside(run.folder)
            job = run.job([*run.decisions, decision], [])
            run.saver.start(replace(job, into=self._place), self._take)

    def state(self) -> dict[str, Any]:
        """How far it is, and what was found."""
        saver, begun = self.run.saver, self._place is not None
        told = {"stage": saver.stage, "done": saver.done, "total": saver.total}
        error = saver.error if begun else ""
        return {"running": begun and saver.running, "error": error, "found": self._found, **told}

    def at(self, frame: int) -> dict[str, Any]:
        """Positions about a frame, and σ_x/Λ_st of the stick there, before and after.

        Raises
        ------
        InputError
            Where nothing was tracked again.
        """
        with self.run.lock:
            return self.run.effects.of_other(self._ready() / "tracks.nc", frame)

    def _ready(self) -> Path:
        """Where the new run lies."""
        if self._found is None or self._place is None:
            raise InputError("the trial", "a run that was tracked again", "none", "track again first")
        return self._place

    def keep(self) -> None:
        """Put the new run, whose corrections.toml holds the decision, in the old one's place.

        Raises
        ------
        InputError
            Where nothing was tracked again, or it cannot be written; the run stays as it was.
        """
        run = self.run
        with run.lock:
            place = self._ready()
            run.found.check_there()
            try:
                put_in_place(place, run.folder.resolve(), overwrite=True)
            except OSError as error:
                found = (error.strerror or str(error)).lower()
                raise InputError(run.folder, "a place that can be written", found, "not kept") from error
            self.discard()
            run.reload()

    def discard(self) -> None:
        """Throw it away, also while it is being made."""
        with self.run.lock:
            if self._place is None:
                return
            if self.run.saver.running and self._found is None:
                self.run.saver.cancel()
            self.sweep()
            self._place = self._found = None

    def sweep(self) -> None:
        """Remove what lies beside the run, from a killed review, too."""
        place = _beside(self.run.folder)
        shutil.rmtree(place, ignore_errors=True)
        clean_up(place)

    def _take(self, found: Mapping[str, Any]) -> None:
        self._found = found


def _beside(folder: Path) -> Path:
    path = folder.resolve()
    return path.with_name(f".{path.name}.tried")
