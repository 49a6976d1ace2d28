"""A folder into which a camera writes: films are taken when they are complete."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from vision.campaign.settings import CampaignSettings
from vision.errors import InputError
from vision.files import Stamp
from vision.video import open_video, video_files
from vision.video.photron import PIXELS

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

    def still(self, file: Path) -> bool:
        """Whether a file that belongs to a film stands still."""
        return self._still(file) >= self._settings.still_seconds

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
