"""`track campaign TABLE.csv`: many films, here or on a cluster, through Snakemake."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter as Option

from vision.campaign import jobs
from vision.campaign.films import (
    NO_FILMS,
    SETTINGS,
    Check,
    FolderWatch,
    Row,
    is_remote,
    read_campaign,
    safe_name,
)
from vision.campaign.jobs import run_job
from vision.campaign.plan import (
    Plan,
    PlannedFilm,
    State,
    check_folder,
    make_plan,
    read_plan,
    vanished_films,
    write_plan,
)
from vision.campaign.results import duration, needs_pool, pool, read_remarks, write_page
from vision.command.console import attempt, complain, in_columns, say
from vision.command.options import SETTING_OF, CampaignOptions, RunOptions, option_names
from vision.command.settings import at_least, parse_option, read_config, settings_of, with_config
from vision.command.track import origin_of, run_name, track_one
from vision.errors import InputError, counted, with_options
from vision.files import answered, usable_cores
from vision.locks import Lock, claim
from vision.pipeline import check_recordings, open_force, open_recording
from vision.run.provenance import Parameter
from vision.summary import aligned


def campaign(
    table: Annotated[
        Path | None, Option(help="CSV or Excel file; paths in it are relative to its folder.")
    ] = None,
    /,
    options: CampaignOptions = CampaignOptions(),
) -> int:
    """Track many films, on all cores of this machine or on a cluster, each only once.

    The table has one row per test. Its columns are film, force, any option of track, the conditions sample,
    V_mm_min, n_test, RH_percent and T_C, and name where films have the same. All rows are checked before
    anything starts. A film is tracked again only if its files or options have changed. One that fails is
    tried twice; the others continue.

    Writes a run folder for each film in runs/, campaign.csv, index.html (updated while it runs), the
    comparison of the finished tests in pool/ and their tables as Parquet in tables/.

    For example:

        track campaign tests.csv --dry-run

        track campaign tests.csv --out series

        track campaign tests.csv --executor slurm --stage

        track campaign --watch /data/camera --config setup.toml
    """
    named = table or options.watch
    if named is None:
        wanted = "a table of tests, or a folder to watch"
        raise InputError("TABLE.csv", wanted, "none", "track campaign --help")
    for value, option, least in ((options.cores, "--cores", 1), (options.idle, "--idle", 0)):
        if value is not None:
            at_least(value, option, least)
    target = options.out or Path(f"{run_name(named)}_campaign")
    check_folder(target)
    check = _checker(options.config)
    rows = [] if table is None else _read(table, check, options.watch)
    if not (options.dry_run or options.plan):
        jobs.check_engine(options.executor, [row.film for row in rows])
    # On a cluster jobs have their full length, as starting one costs more there.
    cores = options.cores or (usable_cores() if options.executor == "local" else 1)
    config = options.config and options.config.absolute()
    make = partial(
        make_plan, out=target, config=config, stage=options.stage, report=options.report, cores=cores
    )
    if options.dry_run:
        return _dry_run(make(rows, keep=False), options.cores or usable_cores())
    if options.plan:
        with _claimed(target):
            write_plan(make(rows))
        return 0
    profile = _profile(options)
    watcher = None if options.watch is None else FolderWatch(options.watch)

    def new(film: Path) -> Row:
        name = safe_name(run_name(film))
        return Row(row=0, film=str(film.absolute()), name=name, values=check({})[0])

    with _claimed(target):
        if watcher is None:
            return _carry_out(make(rows), options, profile)
        # Films that were tracked and then moved away stay in the comparison.
        make = partial(make, earlier=vanished_films(target, watcher.folder))
        run = partial(_carry_out, options=options, profile=profile)
        return _watch(watcher, rows, new, lambda ready: run(make(ready)), options.idle)


def _claimed(out: Path) -> Lock:
    """Lock a campaign's folder.  Raises: InputError."""
    busy = InputError(out, "a campaign that is not running", "a running one", "wait for its end")
    return claim(out / ".lock", busy, "give another `out`")


def job(plan: Path, name: str, /, *fetched: Path) -> int:
    """Track the films of one job of a plan, and return the exit status: for the Snakefile."""
    content = read_plan(plan)
    if name not in content.jobs:
        raise InputError(plan, "a plan with this job", f"no '{name}'", "run track campaign again")
    copies = [path.absolute() for path in fetched]
    if content.started_in.is_dir():  # files that the configuration names are relative to it
        os.chdir(content.started_in)
    return run_job(content, name, partial(_track_film, content), fetched=copies)


def pool_runs(plan: Path, /) -> int:
    """Compare the finished runs of a plan, and return the exit status: for the Snakefile."""
    pool(read_plan(plan), origin_of((), {}))
    return 0


# --- the table ----------------------------------------------------------------------------------------------


def _checker(config: Path | None) -> Check:
    """Return a function that validates one row's options as the command line does."""
    if config is not None:
        read_config(config)  # its errors are reported once, not for every row

    @cache
    def one_option(name: str, text: str) -> Any:
        value = parse_option(Path("table"), name, text)
        settings_of(_parameters({name: value}))
        return value

    def check(options: Mapping[str, str]) -> tuple[dict[str, Any], list[tuple[str, str]]]:
        values: dict[str, Any] = {}
        problems: list[tuple[str, str]] = []
        for name, text in options.items():
            try:
                values[name] = one_option(name, text)
            except InputError as error:
                problems.append((name, error.problem))
        try:
            parameters = _parameters(values, config)
            settings_of(parameters)
        except InputError as error:
            return {}, [*problems, ("", str(error))]
        return {name: one.value for name, one in parameters.items()}, problems

    return check


def _parameters(values: Mapping[str, Any], config: Path | None = None) -> dict[str, Parameter]:
    """Return every option of `track` with its origin, from the values of some."""
    return with_config({**dict.fromkeys(SETTING_OF), **values}, config)


def _read(table: Path, check: Check, awaited: Path | None) -> list[Row]:
    """Return the table's rows.  Raises: InputError, after printing every problem of every row."""
    rows, problems = read_campaign(table, options=SETTING_OF, check=check, name_of=run_name, awaited=awaited)
    if problems:
        if any((p.row, p.column, p.text) == (1, "film", NO_FILMS) for p in problems):
            raise InputError(table, "a column film, with a film in each row", "none", "is it another table?")
        shown = [(str(p.row), p.column, p.text) for p in problems[:10]]
        for line in in_columns([("row", "column", "problem"), *shown], "><"):
            complain(line)
        if more := len(problems) - len(shown):
            complain(f"and {more} more")
        count, where = len(problems), len({problem.row for problem in problems})
        found = f"{counted(count, 'problem')} in {counted(where, 'row')}, listed above"
        raise InputError(table, "a table without problems", found, "nothing was started")
    return list(rows)


# --- planning and running -----------------------------------------------------------------------------------


def _dry_run(plan: Plan, cores: int) -> int:
    """Print what would run and how long it would take; return the exit status."""
    waiting = {name for job in plan.jobs.values() for name in job.films}
    running, lines = 0, []
    for film in plan.films:
        what, size = f"is {plan.state(film).state}", ""
        if film.name in waiting:
            why = _refused(plan, film)
            what = "would fail" if why else "would run"
            length = f"{film.frames} frames x {film.columns} px, about {duration(film.seconds)}"
            size = why or film.doubt or length
            running += not why
        lines.append((film.name, what, size))
    say(in_columns(lines, "<<"))
    seconds = [job.seconds for job in plan.jobs.values()]
    memory = max((job.memory_mb for job in plan.jobs.values()), default=0)
    once = SETTINGS.campaign_seconds if seconds else 0.0
    total, longest = sum(seconds) + once, max(sum(seconds) / cores, *seconds, 0.0) + once
    films, jobs_ = counted(len(plan.films), "film"), counted(len(plan.jobs), "job")
    line = (
        f"{running} of {films} would run in {jobs_}: about "
        f"{duration(total)} of computing, {duration(longest)} with "
        f"{cores} at a time, up to {memory / 1000:.1f} GB for each; nothing was written"
    )
    say([line])
    if running == len(waiting):
        return 0
    return 1 if running else 2


def _refused(plan: Plan, film: PlannedFilm) -> str:
    """Return why the film, its force recording or its options will be refused before the film is read; "" if
    they will not. A film in object storage is not looked at.
    """

    def check() -> None:
        parameters = _parameters_of(plan, film)
        settings, force = settings_of(parameters), parameters["force"].value
        machine = None if force is None else open_force(force, settings)
        if not is_remote(film.film):
            check_recordings(open_recording(film.film, settings), machine, settings)

    _, _, why = attempt(partial(answered, check, Path(film.film)))
    return with_options(why, option_names())


def _parameters_of(plan: Plan, film: PlannedFilm) -> dict[str, Parameter]:
    """Return every option of a planned film with its origin."""
    values = {name: parse_option(plan.out, name, text) for name, text in film.options.items()}
    return _parameters(values, plan.config)


def _profile(options: CampaignOptions) -> Path:
    """Return the folder of the Snakemake profile.  Raises: InputError."""
    where = options.profile or jobs.HERE / "profiles" / options.executor
    if not (where / "config.yaml").is_file():
        found = "no config.yaml in it" if where.is_dir() else "no such folder"
        advice = f"copy {jobs.HERE / 'profiles'}"
        raise InputError("`profile`", "a folder with a Snakemake profile", found, advice)
    return where.absolute()


def _carry_out(plan: Plan, options: CampaignOptions, profile: Path) -> int:
    """Carry out a plan: films, comparison, page and summary; return the exit status."""
    run = partial(jobs.run_snakemake, profile=profile, executor=options.executor, cores=options.cores)
    write_plan(plan)
    write_page(plan, live=bool(plan.jobs))
    started, unwritten = time.perf_counter(), False
    try:
        plan = jobs.run_films(
            plan, lambda left: run(left, "films", watch=_progress(left, quiet=options.quiet))
        )
        if needs_pool(plan):
            run(plan, "pool")
    finally:
        try:
            write_page(plan, live=False, remarks=read_remarks(plan))
        except InputError as error:  # a full disk: the states of the films are still printed
            unwritten = True
            complain(str(error))
    states = [plan.state(film) for film in plan.films]
    for state in states:
        if state.state in ("failed", "partial"):
            complain(f"{state.name}: {state.state}: {state.reason}")
    for line in read_remarks(plan):
        complain(line)
    pooled = not needs_pool(plan)
    if not pooled:
        complain(f"the tests could not be compared; see {plan.out / jobs.LOG}")
    if not options.quiet:
        say(_summary(plan, states, time.perf_counter() - started))
    found = {state.state for state in states}
    if unwritten or found == {"failed"}:
        return 2
    return 0 if pooled and found <= {"done"} else 1


def _progress(plan: Plan, *, quiet: bool) -> Callable[[], None] | None:
    """Return a function that prints which films have ended; None without a terminal."""
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        return None
    left = {name: plan.film(name) for job in plan.jobs.values() for name in job.films}
    count, checked_at = len(left), time.monotonic()

    def print_ended() -> None:
        nonlocal checked_at
        if time.monotonic() - checked_at < 2 + count / 200:
            return
        checked_at = time.monotonic()
        for name, film in list(left.items()):
            state = plan.state(film)
            if state.state not in ("waiting", "running"):
                del left[name]
                complain(f"{count - len(left)} of {count}: {name}: {state.state} in {state.seconds:.1f} s")

    return print_ended


def _summary(plan: Plan, states: Sequence[State], seconds: float) -> list[str]:
    """Return the numbers of tests in each state, and the first twenty tests with warnings."""
    counts = Counter(state.state for state in states)
    ran = sum(len(job.films) for job in plan.jobs.values())
    named = {name: "with warnings" if name == "warnings" else name for name in sorted(counts)}
    by_state = ", ".join(f"{counts[name]} {text}" for name, text in named.items())
    lines = [f"{counted(len(states), 'test')}: {by_state}; {ran} of them run now in {duration(seconds)}"]
    warned = [state for state in states if state.state == "warnings"]
    lines += [f"  {state.name}: {state.reason}" for state in warned[:20]]
    if len(warned) > 20:
        lines.append(f"  and {len(warned) - 20} more with warnings: campaign.csv")
    return [*lines, *aligned([("results", f"{plan.out}/ (look at index.html first)")])]


def _watch(
    watcher: FolderWatch,
    rows: Sequence[Row],
    new: Callable[[Path], Row],
    run: Callable[[Sequence[Row]], int],
    idle: float | None,
) -> int:
    """Track films as they are completed, until Ctrl-C or `idle` seconds without one; return the status."""
    taken: dict[str, Row] = {}
    status, last = 0, time.monotonic()
    try:
        while True:
            ready = {row.name: row for row in watcher.rows(rows, new)}
            if not ready.keys() <= taken.keys():
                taken |= ready
                status = run(list(taken.values()))
                last = time.monotonic()
            elif idle is not None and time.monotonic() - last > idle:
                return status
            time.sleep(1.0)
    except KeyboardInterrupt:
        if not taken:
            raise
        complain(f"watching {watcher.folder} ended; run the same command to continue")
        return status


# --- one film -----------------------------------------------------------------------------------------------


def _track_film(plan: Plan, film: PlannedFilm, source: Path, target: Path) -> str:
    """Track one film of a job as `track` does; return why there is no run, or "".

    `source` is the film or a copy of it.
    """
    parameters = _parameters_of(plan, film)
    local = not is_remote(film.film)
    video = Path(film.film) if local else source

    def analyse(*, resume: bool) -> Any:
        options = RunOptions(overwrite=True, report=plan.report, quiet=True, resume=resume)
        copy = source if local else None
        more = {"one_of_many": True, "decide_again": True}
        return track_one(video, target, parameters, options, copy=copy, config=plan.config, **more)

    # A job that was killed is continued, unless it read a copy, which is gone.
    again = local and source == video and plan.state(film).attempts > 1 and not parameters["strips"].value
    done, status, why = attempt(partial(analyse, resume=again))
    if again and status == 2 and done is None:  # the frames kept were read with other settings
        _, _, why = attempt(partial(analyse, resume=False))
    return with_options(why, option_names())
