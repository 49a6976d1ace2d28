"""The films of a campaign: those in TABLE.csv, which is checked first, and those in a watched folder."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from vision.comparison.runs import ALIKE, COLUMNS, LIMITS, table_cells
from vision.data import Tunable
from vision.errors import InputError, nearest_word
from vision.files import TIFF, Watch, answered, matching, no_such_file, shortened
from vision.numeric import number
from vision.video import VideoSettings, open_video, video_files
from vision.video.video import FILMS, files_in

# --- tunable constants -------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, repr=False)
class CampaignSettings(Tunable):
    """Tunable constants of a campaign. `reports/campaign.py` measures the values used for estimates."""

    # estimates of a film's time and memory before any film has been measured
    base_seconds: float = 1.0
    """Time for a film's tables, pictures and report, however short the film is."""
    seconds_per_megasample: float = 0.7
    """Time per million values of I(x,t) (frames times columns): averaging, fits, identities, tables. It
    decides which films share a job and how much time a batch system is asked for. The measured times of
    finished films of the same campaign correct it."""
    seconds_per_gigapixel: float = 3.0
    """Time for reading and decoding, 1 to 4 s depending on the codec. It dominates if frames are tall."""
    force_seconds: float = 0.6
    """Time for a force recording: events, fits, clock, deformation, figures. Those of an hour take more; the
    measured times of finished films correct it."""
    start_seconds: float = 2.2
    """Time for starting a job's process and loading the libraries, before its first film. Without it a plan
    of many jobs of short films states half of its time (`reports/campaign.md`)."""
    campaign_seconds: float = 5.0
    """Time for starting Snakemake and comparing the finished tests, once for a campaign. Without it a dry run
    of a few short films states half of their time."""
    base_memory_mb: float = 600.0
    """Memory for libraries, figures and report."""
    memory_mb_per_megasample: float = 40.0
    """Memory per million values of I(x,t), including blocks of the fits and tables. With too small a value, a
    batch system kills the job, which is then repeated with twice as much."""
    margin: float = 3.0
    """Time requested from a batch system relative to the estimate. With a larger value the job waits longer
    in the queue, with a smaller one it may be killed."""
    spare_minutes: int = 10
    """Time requested for every job in addition, for slow starts on a busy file server."""

    # jobs
    job_seconds: float = 60.0
    """Duration up to which short films share a job, since the start of a process, of a scheduler's job and of
    the libraries costs 2 to 6 s. A longer job loses more when it is killed."""
    jobs_per_core: int = 4
    """Jobs of short films per core, so that all cores finish together; fewer if the jobs would be shorter
    than `least_job_seconds`. More jobs cost more starts."""
    least_job_seconds: float = 20.0
    """Smallest duration of jobs that are split so that all cores finish together. Shorter jobs lose more to
    their start (3 s), longer ones leave cores idle at the end."""

    # the page and the watched folder
    page_seconds: float = 3.0
    """Shortest interval between updates of index.html. It grows with the number of films, since the page
    reads a small file for each."""
    abandoned_seconds: float = 600.0
    """A film that is truncated or has no readable index is taken when it has not changed for this long, so
    that its damage is reported. A shorter time may take a film whose copying has stalled."""
    thumbnail_px: int = 220
    """Width of the pictures in index.html. Larger ones slow the page down with hundreds of films."""


SETTINGS = CampaignSettings()


# --- the table ----------------------------------------------------------------------------------------------

FACTS = (*COLUMNS[1:], "notes")  # columns that describe the test
PATHS = ("force", "timestamps", "corrections")  # options that name a file, relative to the table
NO_FILMS = "expected a column film; found none"
# Usual names of the columns. A message about an unknown column suggests the nearest of them.
_ALIKE = ALIKE | {
    "video": "film", "file": "film", "movie": "film", "path": "film", "recording": "force", "load": "force",
    "comment": "notes", "remark": "notes", "run": "name", "test": "name", "name": "name", "folder": "name",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Problem:
    """An error in the table, which keeps the campaign from starting."""

    row: int  # line of the file, 1 for the heading
    column: str  # "" if it concerns the whole row
    text: str  # what was expected and what was found


@dataclass(frozen=True, kw_only=True)
class Row:
    """One test."""

    row: int  # line of the file; 0 for a film that is not in the table
    film: str  # path, quoted glob, or an address in object storage (s3://…)
    name: str  # name of its run folder
    # options as typed, by their names in a TOML file
    options: Mapping[str, str] = field(default_factory=dict)
    # options as the pipeline takes them, with those of the configuration file and the defaults
    values: Mapping[str, Any] = field(default_factory=dict)
    # description of the test: sample, V_mm_min, n_test, RH_percent, T_C, notes
    facts: Mapping[str, Any] = field(default_factory=dict)


Check = Callable[[Mapping[str, str]], tuple[Mapping[str, Any], Sequence[tuple[str, str]]]]
"""Returns the options of one row as the command line validates them, and (column, text) of each error."""


def is_remote(film: str) -> bool:
    """Return whether a film lies in object storage, from which Snakemake fetches it."""
    return re.match(r"[a-z][a-z0-9+.-]*://", film) is not None


def safe_name(text: str) -> str:
    """Replace the characters that a file name or a line of text cannot have on some system."""
    return re.sub(r"[\x00-\x1f\x7f/\\:*?\"<>|]", "_", text).strip(". ") or "film"


def read_campaign(
    path: Path,
    *,
    options: Collection[str],
    check: Check,
    name_of: Callable[[Path], str],
    awaited: Path | None = None,
) -> tuple[tuple[Row, ...], tuple[Problem, ...]]:
    """Read a table of films; return the rows without problems, and the problems in order of the rows.

    path: a table as `table_cells` reads it, with a column ``film``. Others may be ``name``, `FACTS` and
    options; paths in it are relative to it.  options, check: names of the options of `track`, and a function
    that converts those of one row into values.  name_of: returns the default name of a film.  awaited: a
    watched folder; films in it, and their other files, need not exist yet.

    Raises: InputError if the file is not a table or has no rows, or a disk does not answer.
    """
    read = partial(table_cells, path, "a CSV or Excel table with a column film")
    header, lines = answered(read, path)
    columns, problems = _columns(header, ("film", "name", *FACTS, *options))
    rows: list[Row] = []
    for line, cells in lines:
        pairs = zip(columns, cells, strict=False)
        given = {name: cell.strip() for name, cell in pairs if name and cell.strip()}
        base = path.absolute().parent
        read_row = partial(_row, line, given, base, check, name_of, awaited)
        row, found = answered(read_row, base / given.get("film", ""))
        if any(cell.strip() for cell in cells[len(columns) :]):
            found.append(("", f"expected {len(columns)} cells; found {len(cells)}"))
        problems += [Problem(row=line, column=column, text=text) for column, text in found]
        rows.append(row)
    problems += _clashes(rows)
    bad = {problem.row for problem in problems}
    good = tuple(row for row in rows if row.row not in bad)
    return good, tuple(sorted(problems, key=lambda p: (p.row, p.column)))


def _columns(header: Sequence[str], known: Sequence[str]) -> tuple[list[str], list[Problem]]:
    """Return the standard name of each column, "" for unknown ones, and the problems of the heading."""
    standard = {_plain(name): name for name in known}
    alike = _ALIKE | standard
    columns, problems = [], []
    for name in header:
        column = standard.get(_plain(name), "")
        if name.strip() and not column:
            nearest = alike[nearest_word(_plain(name), alike)]
            found = f"'{shortened(name, 60)}'; the nearest is {nearest}"
            text = f"expected a column of a campaign; found {found}"
            problems.append(Problem(row=1, column=shortened(name, 30), text=text))
        elif column and column in columns:
            problems.append(Problem(row=1, column=column, text="expected each column once; found it twice"))
        columns.append(column)
    if "film" not in columns:
        problems.append(Problem(row=1, column="film", text=NO_FILMS))
    return columns, problems


def _plain(name: str) -> str:
    return name.strip().lstrip("-").replace("-", "_").replace(" ", "_").lower()


def _row(
    line: int,
    given: Mapping[str, str],
    base: Path,
    check: Check,
    name_of: Callable[[Path], str],
    awaited: Path | None,
) -> tuple[Row, list[tuple[str, str]]]:
    """Return one row with absolute paths, and (column, text) of each problem in it."""

    def may_come_later(path: str) -> bool:
        return awaited is not None and Path(path).parent.resolve() == awaited.resolve()

    film, problems = _film(given.get("film", ""), base, may_come_later)
    facts, wrong = _conditions(given)
    problems += wrong
    options = {name: text for name, text in given.items() if name not in ("film", "name", *FACTS)}
    for name in PATHS:
        if name in options:
            options[name] = str(base / options[name])
            if not Path(options[name]).is_file() and not may_come_later(options[name]):
                problems.append((name, str(no_such_file(Path(options[name]), "a file"))))
    values, refused = check({name: text for name, text in options.items() if name not in dict(problems)})
    problems += refused
    name = safe_name(given.get("name", "") or name_of(Path(film)))
    if len(name.encode()) > 150:  # the names of folders and files are longer
        wanted = "expected a name of at most 150 bytes (an accented letter has 2)"
        problems.append(("name", f"{wanted}; found {len(name.encode())}; give one in a column name"))
    row = Row(row=line, film=film, name=name, options=options, values=values, facts=facts)
    return row, problems


def _film(text: str, base: Path, may_come_later: Callable[[str], bool]) -> tuple[str, list[tuple[str, str]]]:
    """Return the path of a row's film, and (column, text) of what is wrong with it."""
    if not text:
        return "", [("film", "expected a film; found an empty cell")]
    if is_remote(text):
        return text, []
    film = str(base / text)
    if films := files_in(Path(film), FILMS) if Path(film).is_dir() else []:
        one = str(films[0])
        wrong = f"{shortened(film)}: expected one film; found {len(films)}; name one of them, such as {one}"
        return one, [("film", wrong)] if len(films) > 1 else []
    if ("\0" not in film and matching(Path(film))) or may_come_later(film):
        return film, []
    return film, [("film", f"{shortened(film)}: {no_such_file(Path(film), 'a film').problem}")]


def _conditions(given: Mapping[str, str]) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    facts: dict[str, Any] = {name: given[name] for name in ("sample", "notes") if name in given}
    problems = []
    for name, (low, high) in LIMITS.items():
        if name not in given:
            continue
        if low <= (value := number(given[name])) <= high:
            facts[name] = value
        else:
            found = shortened(given[name], 40)
            problems.append((name, f"expected a number from {low:g} to {high:g}; found '{found}'"))
    return facts, problems


def _clashes(rows: Iterable[Row]) -> list[Problem]:
    """Find rows with the same film, and films whose folders would have the same name."""
    problems: list[Problem] = []
    films: dict[str, Row] = {}
    names: dict[str, Row] = {}
    for row in rows:
        if not row.film:
            continue
        if (first := films.setdefault(row.film, row)) is not row:
            problems.append(Problem(row=row.row, column="film", text=_twice(row, first)))
        elif (other := names.setdefault(row.name.casefold(), row)) is not row:
            found = f"'{row.name}' also in row {other.row}; add a column name"
            text = f"expected films of different names; found {found}"
            problems.append(Problem(row=row.row, column="name", text=text))
    return problems


def _twice(row: Row, first: Row) -> str:
    names = sorted({*row.options, *first.options})
    differ = [name for name in names if row.options.get(name) != first.options.get(name)]
    how = "with the same settings"
    if differ:
        how = f"with another {', '.join(differ)}; give it in another table"
    return f"expected each film once; found {Path(row.film).name} also in row {first.row}, {how}"


# --- a folder that is watched -------------------------------------------------------------------------------


class FolderWatch:
    """Finds the complete films of a folder, without its subfolders.

    A film is complete when its size and modification time have not changed for some time and its index can be
    read. A film that remains truncated (the camera's computer failed) is taken later, with its warnings.

    Raises: InputError if it is not a folder, and from `rows` if its disk does not answer.
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        is_folder, exists = answered(lambda: (folder.is_dir(), folder.exists()), folder)
        if not is_folder:
            found = "a file" if exists else "no such folder"
            raise InputError(folder, "a folder to watch", found, "check the path")
        self.folder = folder
        self._clock = clock
        self._watches: dict[Path, Watch] = {}

    def films(self) -> list[Path]:
        """Return every film in the folder, complete or not, in order of their names."""
        return files_in(self.folder, FILMS | TIFF)

    def complete(self, film: Path) -> bool:
        """Return whether a film no longer changes and can be opened without warnings."""
        try:
            ages = [self._unchanged_for(file) for file in video_files(film)]
        except InputError:
            return False  # one of the two files of a recording is still to come
        if min(ages) < VideoSettings.follow_still_s:
            return False
        try:
            whole = not open_video(film).reader.facts.warnings
        except InputError:
            whole = False
        return whole or min(ages) >= SETTINGS.abandoned_seconds

    def rows(self, table: Sequence[Row], new: Callable[[Path], Row]) -> list[Row]:
        """Return the rows of the table whose files no longer change, and rows for complete films not in it.

        `new` makes a row for such a film; films of the same name (a.avi, a.mp4) keep their endings.
        """
        return answered(lambda: self._rows(table, new), self.folder)

    def _rows(self, table: Sequence[Row], new: Callable[[Path], Row]) -> list[Row]:
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
        """Return whether those of a row's files that lie in the folder are complete."""
        given = (Path(row.options[name]) for name in PATHS if name in row.options)
        ages = [self._unchanged_for(file) for file in given if self._in_folder(file)]
        film = Path(row.film)
        complete = not self._in_folder(film) or self.complete(film)
        return complete and min(ages, default=math.inf) >= VideoSettings.follow_still_s

    def _in_folder(self, file: Path) -> bool:
        return file.parent.resolve() == self.folder.resolve()

    def _unchanged_for(self, file: Path) -> float:
        """Return for how long a file has been seen unchanged, s; -1 if it does not exist."""
        if file not in self._watches:
            self._watches[file] = Watch(file, self._clock)
        watch = self._watches[file]
        unchanged_s = watch.unchanged_s()
        return -1.0 if watch.stamp.facts is None else unchanged_s
