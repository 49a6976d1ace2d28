"""A folder into which a camera writes: films are taken when they are complete."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from vision.campaign.settings import CampaignSettings
from vision.campaign.table import PATHS, Row, safe_name
from vision.errors import InputError
from vision.files import Stamp
from vision.video import open_video, video_files
from vision.video.high_speed import PIXELS

FILMS = {".avi", ".mp4", ".m4v", ".mkv", ".mov", ".cine", PIXELS, ".tif", ".tiff"}


class FolderWatch:
    """Which files of a folder are complete films.

    A film is complete when its size and time stood still and its index can be read. One that stays
    cut (the camera's computer failed) is taken in the end, too, and named by its own warnings.

    Parameters
    ----------
    folder
        Not searched below.
    settings
        Tunable constants.
    clock
        Seconds that only grow.
    """

    def __init__(
        self,
        folder: Path,
        settings: CampaignSettings | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if not folder.is_dir():
            found = "a file" if folder.exists() else "no such folder"
            raise InputError(folder, "a folder to watch", found, "check the path")
        self.folder = folder
        self._settings = settings or CampaignSettings()
        self._clock = clock
        self._seen: dict[Path, tuple[Stamp, float]] = {}

    def films(self) -> list[Path]:
        """Every film in the folder, complete or not, in order of their names."""
        files = sorted(self.folder.iterdir())
        return [
            file
            for file in files
            if file.suffix.lower() in FILMS and not file.name.startswith(".") and file.is_file()
        ]

    def complete(self, film: Path) -> bool:
        """Whether a film stands still and can be opened whole."""
        try:
            ages = [self._still(file) for file in video_files(film)]
        except InputError:
            return False  # a recording of two files of which one is to come
        if min(ages) < self._settings.still_seconds:
            return False
        try:
            whole = not open_video(film).reader.facts.warnings
        except InputError:
            whole = False
        return whole or min(ages) >= self._settings.abandoned_seconds

    def rows(self, table: Sequence[Row], new: Callable[[Path], Row]) -> list[Row]:
        """What can be done now.

        Parameters
        ----------
        table
            Rows whose films may be still to come.
        new
            Makes a row for a film that no row names.

        Returns
        -------
        The table's rows whose files are there and stand still, and complete films without a row. Two of one
        name (a.avi, a.mp4) are told apart by their endings.
        """
        named = {Path(row.film).resolve() for row in table}
        used = {row.name.casefold() for row in table}
        ready = [row for row in table if self._ready(row)]
        for film in self.films():
            if film.resolve() not in named:
                row = new(film)
                row = replace(row, name=safe_name(film.name)) if row.name.casefold() in used else row
                used.add(row.name.casefold())
                ready += [row] if self.complete(film) else []
        return ready

    def _ready(self, row: Row) -> bool:
        """Whether a row's files that lie in the folder stand still; those elsewhere were there before."""
        given = (Path(row.options[name]) for name in PATHS if name in row.options)
        ages = [self._still(file) for file in given if self._here(file)]
        film = Path(row.film)
        whole = not self._here(film) or self.complete(film)  # looked at also while others are awaited
        return whole and min(ages, default=math.inf) >= self._settings.still_seconds

    def _here(self, file: Path) -> bool:
        return file.parent.resolve() == self.folder.resolve()

    def _still(self, file: Path) -> float:
        """For how long a file has not changed, s, as far as was seen; -1 for one that is not there."""
        now, stamp = self._clock(), Stamp.of(file)
        if stamp.facts is None:
            self._seen.pop(file, None)
            return -1.0
        earlier = self._seen.get(file)
        if earlier is None or earlier[0] != stamp:
            self._seen[file] = (stamp, now)
            return 0.0
        return now - earlier[1]
