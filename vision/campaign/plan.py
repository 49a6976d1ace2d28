"""The plan: all films, which of them are finished, estimates for the others, and their division into jobs.

Each film has a key, a digest of its files' contents and its options. It is finished if a finished run has the
same key. The job of a film writes the film's state to a small file.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

import vision
from vision.campaign.films import PATHS, SETTINGS, Row, is_remote
from vision.errors import InputError, reason_of
from vision.files import Stamp, answered, reading, shortened
from vision.folder import RUN_JSON, from_json, plain, whole_file, write_json
from vision.run.provenance import checksum_of, describe_input
from vision.run.reading import is_run, read_json
from vision.video import open_video, video_files

# --- states -------------------------------------------------------------------------------------------------

Word = Literal["waiting", "running", "done", "warnings", "partial", "failed"]
FINISHED: tuple[Word, ...] = ("done", "warnings", "partial")
"""States of films that are not repeated while the key is the same. ``partial``: the film is tracked, but its
force recording cannot be used or a late stage failed; repeating it would give the same result."""


@dataclass(frozen=True, kw_only=True)
class State:
    """One film's state."""

    name: str
    key: str = ""  # key of the film when its job began
    state: Word = "waiting"
    reason: str = ""  # one line: the first warning, or the error
    seconds: float = 0.0  # duration of its analysis
    warnings: tuple[str, ...] = ()  # all warnings of the run
    frames: int = 0  # that were read
    mu: str = ""  # with its statistical and systematic error in quadrature
    stiff: str = ""  # sheets per side
    run: str = ""  # digest of the run.json that this describes; with another one, the run was corrected
    attempts: int = 0  # attempts with this key
    at: float = 0.0  # when this was written, seconds since 1970


def read_state(out: Path, name: str) -> State:
    """Return a film's state; "waiting" if its file is missing or damaged."""
    return State(**{"name": name} | from_json(State, read_if_whole(_path(out, name))))


def write_state(out: Path, state: State) -> None:
    """Write a film's state atomically.  Raises: InputError."""
    with whole_file(_path(out, state.name)) as path:
        write_json(asdict(state) | {"at": time.time()}, path)


def _path(out: Path, name: str) -> Path:
    return out / "states" / f"{name}.json"


# --- the plan -----------------------------------------------------------------------------------------------

PLAN = "plan.json"
LAYOUT = 1  # version of the campaign folder's layout; a folder with another one is refused
FINGERPRINTS = "fingerprints.json"


@dataclass(frozen=True, kw_only=True)
class PlannedFilm:
    """One test of the plan."""

    # as in the table (`vision.campaign.films.Row`)
    name: str
    film: str
    options: Mapping[str, str]
    facts: Mapping[str, Any]
    key: str  # digest of its files' contents and its options; with another key the film is run again
    # from the file's header; 0 if it cannot be read
    frames: int = 0
    rows: int = 0
    columns: int = 0
    # estimates
    seconds: float = 0.0
    memory_mb: int = 0
    doubt: str = ""  # why there are no estimates; the film is tried nevertheless


@dataclass(frozen=True, kw_only=True)
class Job:
    """Films that one process analyses one after the other, and the resources requested for it."""

    films: tuple[str, ...]
    seconds: float
    memory_mb: int
    minutes: int


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The films of a campaign and the jobs that remain to be done."""

    out: Path  # the campaign's folder
    films: tuple[PlannedFilm, ...]  # all tests, in the table's order
    jobs: Mapping[str, Job]  # remaining jobs by name
    config: Path | None = None  # TOML file with options for all films
    stage: bool = False  # whether films are first copied to the node's local disk
    report: bool = True  # whether each run gets a report.html
    started_in: Path = field(default_factory=Path.cwd)  # base of relative paths in the configuration
    # versions of the program and of the folder's layout; a folder with other ones is refused
    version: str = vision.__version__
    layout: int = LAYOUT

    def film(self, name: str) -> PlannedFilm:
        """Return the film of that name."""
        return next(film for film in self.films if film.name == name)

    def remote(self, job: str) -> list[str]:
        """Return the addresses of a job's films in object storage."""
        return [address for name in self.jobs[job].films if is_remote(address := self.film(name).film)]

    def run_of(self, name: str) -> Path:
        """Return the run folder of a film."""
        return self.out / "runs" / name

    def finished(self, film: PlannedFilm) -> State | None:
        """Return the state of a finished film; None if the film must be run."""
        state = read_state(self.out, film.name)
        current = state.key == film.key and state.state in FINISHED
        return state if current and is_run(self.run_of(film.name)) else None

    def state(self, film: PlannedFilm) -> State:
        """Return the current state of a film; "waiting" if the stored state belongs to another key."""
        state = read_state(self.out, film.name)
        return state if state.key == film.key else State(name=film.name, key=film.key)

    def run_digest(self, name: str) -> str:
        """Return a digest of a film's run.json, which differs after every correction; "" if it has none."""
        try:
            return hashlib.sha256((self.run_of(name) / RUN_JSON).read_bytes()).hexdigest()[:16]
        except OSError:
            return ""

    def pool_key(self) -> str:
        """Return a digest of the finished runs and their facts, which changes when the pool must."""
        done = [film for film in self.films if self.finished(film)]
        return _digest([(film.name, film.key, film.facts, self.run_digest(film.name)) for film in done])


def make_plan(
    rows: Sequence[Row],
    out: Path,
    *,
    config: Path | None = None,
    stage: bool = False,
    report: bool = True,
    cores: int = 1,
    keep: bool = True,
    earlier: Sequence[PlannedFilm] = (),
) -> Plan:
    """Fingerprint the films, estimate their time and memory, and divide the unfinished ones into jobs.

    out, config, stage, report: as in `Plan`; the folder need not exist.  cores: number of jobs that run at a
    time.  keep: whether the fingerprints are stored for the next time; if False nothing is written.
    earlier: films of an earlier plan that are gone and stay in this one.

    Raises: InputError if ``out`` is not a campaign, or one of another version, or the disk of a film does not
    answer.
    """
    check_folder(out)
    known = read_if_whole(out / FINGERPRINTS)  # if not, all files are read again
    new = [answered(partial(_film, row, known), Path(row.film)) for row in rows]
    films = [*earlier, *new]
    if keep:
        with whole_file(out / FINGERPRINTS) as path:
            write_json(known, path)
    plan = Plan(out=out.absolute(), films=tuple(films), jobs={}, config=config, stage=stage, report=report)
    factor = _time_correction(plan)
    waiting = [film for film in films if plan.finished(film) is None]
    jobs = {
        _digest([(film.name, film.key) for film in job])[:12]: _job(job, factor)
        for job in share(waiting, factor, cores)
    }
    return replace(plan, jobs=jobs)


def vanished_films(out: Path, folder: Path) -> list[PlannedFilm]:
    """Return the finished films of the earlier plan that have since left the watched folder.

    Raises: InputError if the plan is damaged or the folder's disk does not answer.
    """
    if not (out / PLAN).is_file():
        return []
    plan = read_plan(out / PLAN)

    def has_left(film: PlannedFilm) -> bool:
        path = Path(film.film)
        return path.parent.resolve() == folder.resolve() and not path.exists()

    return [
        film
        for film in plan.films
        if plan.finished(film) is not None and answered(partial(has_left, film), folder)
    ]


def check_folder(out: Path) -> None:
    """Refuse a folder that is not a campaign, or one of another version.  Raises: InputError."""
    try:
        empty = not out.exists() or (out.is_dir() and not any(out.iterdir()))
    except OSError as error:
        raise InputError(out, "a folder of a campaign", reason_of(error)) from error
    if empty:
        return
    if not (out / PLAN).is_file():
        # left by a campaign that was stopped before it had written its plan
        if out.is_dir() and {path.name for path in out.iterdir()} <= {FINGERPRINTS, ".lock"}:
            return
        found = "another folder (no plan.json in it)" if out.is_dir() else "a file"
        raise InputError(out, "a new folder or one of a campaign", found, "give another `out`")
    content = read_json(out / PLAN)
    version, layout = content.get("version"), content.get("layout")
    if version != vision.__version__ or layout != LAYOUT:
        found = f"one of {shortened(str(version), 20)}"
        found += "" if layout == LAYOUT else f", layout {shortened(str(layout), 20)}"
        advice = "its runs are kept; give another `out`, or go on with that version"
        raise InputError(out, f"a campaign of sheetvision {vision.__version__}", found, advice)


def write_plan(plan: Plan) -> None:
    """Write plan.json atomically.  Raises: InputError."""
    with whole_file(plan.out / PLAN) as path:
        write_json(asdict(plan), path)


def read_plan(path: Path) -> Plan:
    """Read a plan written by `write_plan`.  Raises: InputError."""
    content = read_json(path)
    with reading(path, "a plan as track campaign writes it", "run track campaign again"):
        films = tuple(PlannedFilm(**film) for film in content.pop("films"))
        jobs = {
            name: Job(**{**job, "films": tuple(job["films"])}) for name, job in content.pop("jobs").items()
        }
        paths = {name: Path(content[name]) for name in ("out", "started_in", "config") if content[name]}
        return Plan(**{**content, **paths}, films=films, jobs=jobs)


# --- one film -----------------------------------------------------------------------------------------------


def _film(row: Row, known: dict[str, Any]) -> PlannedFilm:
    values = {name: value for name, value in row.values.items() if name not in PATHS}
    remote = is_remote(row.film)
    contents = [] if remote else [_fingerprint(path, known) for path in inputs_of(row.film, row.values)]
    facts = _header(row)
    megasamples = facts.get("frames", 0) * facts.get("columns", 0) / 1e6
    per_megasample = SETTINGS.seconds_per_megasample
    per_megasample += facts.get("rows", 0) / 1000 * SETTINGS.seconds_per_gigapixel
    fixed = SETTINGS.base_seconds + SETTINGS.force_seconds * (row.values.get("force") is not None)
    return PlannedFilm(
        name=row.name,
        film=row.film,
        options=dict(row.options),
        facts=dict(row.facts),
        key=_digest([LAYOUT, row.film if remote else "", contents, values]),
        seconds=round(fixed + megasamples * per_megasample, 2),
        memory_mb=math.ceil(SETTINGS.base_memory_mb + megasamples * SETTINGS.memory_mb_per_megasample),
        **facts,
    )


def inputs_of(film: str, values: Mapping[str, Any]) -> list[Path]:
    """Return every file that a film's analysis reads."""
    given = [Path(str(values[name])) for name in PATHS if values.get(name) is not None]
    return [*video_files(Path(film)), *given]


def _header(row: Row) -> dict[str, Any]:
    """Return the film's size according to its header, or ``doubt`` if the header cannot be read."""
    if is_remote(row.film):
        return {"doubt": "in object storage; its size is not known before it is fetched"}
    try:
        video = open_video(row.film, rotate=int(row.values.get("rotate") or 0))
        frames, (rows, columns) = video.estimated or 0, video.shape
    except (InputError, OSError) as error:
        return {"doubt": shortened(str(error))}
    return {"frames": int(frames), "rows": int(rows), "columns": int(columns)}


def _fingerprint(path: Path, known: dict[str, Any]) -> str:
    """Return a digest of a file's content; the file is read only if its size or time has changed."""
    stamp = list(Stamp.of(path).facts or ())
    earlier = known.get(str(path))
    if earlier is not None and (not stamp or (path.is_file() and earlier[0] == stamp)):
        return str(earlier[1])  # also for a finished film that has been moved away
    try:
        facts = describe_input(path)
    except InputError:
        return "unreadable"  # the error is reported when the film is run
    digest = f"{facts['size_bytes']}:{checksum_of(facts)}"
    if path.is_file():
        known[str(path)] = [stamp, digest]
    return digest


def read_if_whole(path: Path) -> dict[str, Any]:
    """Read a JSON object; an empty one if the file is missing or damaged."""
    try:
        return read_json(path)
    except InputError:
        return {}


def _digest(content: Any) -> str:
    text = json.dumps(plain(content), sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]


# --- jobs ---------------------------------------------------------------------------------------------------


def _time_correction(plan: Plan) -> float:
    """Return the median ratio of measured to estimated time of the finished films; 1 for fewer than three."""
    ratios = [
        state.seconds / film.seconds for film in plan.films if (state := plan.finished(film)) and film.seconds
    ]
    return float(np.clip(np.median(ratios), 0.2, 20.0)) if len(ratios) > 2 else 1.0


def share(films: Iterable[PlannedFilm], factor: float, cores: int) -> list[list[PlannedFilm]]:
    """Divide films into jobs: each long film has its own, short films share one.

    Shared jobs are long enough for their start not to dominate, and short enough for all cores to finish at
    about the same time. A film in object storage has its own job, since Snakemake fetches all files of a job
    before it starts.
    """
    alone, short = [], []
    for film in sorted(films, key=lambda film: -film.seconds):
        if film.seconds * factor >= SETTINGS.job_seconds / 2 or is_remote(film.film):
            alone.append([film])
        else:
            short.append(film)
    total = factor * sum(film.seconds for film in short)
    even = min(cores * SETTINGS.jobs_per_core, max(cores, int(total / SETTINGS.least_job_seconds)))
    count = max(even, math.ceil(total / SETTINGS.job_seconds))
    return alone + [part for k in range(count) if (part := short[k::count])]


def _job(films: Sequence[PlannedFilm], factor: float) -> Job:
    seconds = SETTINGS.start_seconds + factor * sum(film.seconds for film in films)
    return Job(
        films=tuple(film.name for film in films),
        seconds=round(seconds, 1),
        memory_mb=max(film.memory_mb for film in films),
        minutes=math.ceil(SETTINGS.margin * seconds / 60) + SETTINGS.spare_minutes,
    )
