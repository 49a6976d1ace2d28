"""`track campaign TABLE.csv`: many films, here or on a cluster, through Snakemake."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter as Option

from vision.command.console import complain, outcome, say
from vision.command.options import (
    GROUPS,
    Flag,
    RunOptions,
    merged,
    number,
    option_fields,
    option_names,
    parse_option,
    read_config,
    settings_of,
)
from vision.command.track import REFUSED, command_line, run_name, track_one
from vision.errors import InputError, with_options
from vision.isolation import usable_cores

if TYPE_CHECKING:
    from vision.campaign.plan import Film, Plan
    from vision.campaign.states import State
    from vision.campaign.table import Check, Problem, Row
    from vision.campaign.watch import FolderWatch
    from vision.campaign.worker import Outcome
    from vision.run import Parameter

MOST_LISTED = 20  # films in the summary on the screen; campaign.csv has all


def campaign(
    table: Path | None = None,
    /,
    *,
    out: Path | None = None,
    config: Path | None = None,
    dry_run: Flag = False,
    executor: Literal["local", "slurm"] = "local",
    profile: Path | None = None,
    cores: int | None = None,
    watch: Path | None = None,
    idle: float | None = None,
    stage: Flag = False,
    report: Annotated[bool, Option(show_default=False)] = True,
    quiet: Flag = False,
    plan: Annotated[Flag, Option(show=False)] = False,
) -> int:
    """Track many films, on all cores of this machine or on a cluster; never repeat what is done.

    The table has a row a test: film, force, any option of track as a column, and what describes it: sample,
    V_mm_min, n_test, RH_percent, T_C. It is checked whole before anything starts. A film runs again where its
    files or its options have changed; one that fails is tried twice and keeps no other from being done.

    Writes a run folder for each film in runs/, campaign.csv, index.html (live while it runs), the comparison
    of the finished tests in pool/ and their tables as Parquet in tables/.

    Examples:

        track campaign tests.csv --dry-run

        track campaign tests.csv --out series

        track campaign tests.csv --executor slurm --stage

        track campaign --watch /data/camera --config setup.toml

    Parameters
    ----------
    table
        CSV; files in it are relative to it.
    out
        The campaign's folder; TABLE_campaign in the working directory if not given.
    config
        TOML file of options for all films; the table wins.
    dry_run
        Say what would run and how long it takes; write nothing.
    executor
        local or slurm.
    profile
        Folder with a Snakemake profile, in place of the shipped one.
    cores
        Jobs at a time; all cores (on a cluster, the profile's number of jobs) if not given.
    watch
        Folder into which films are written: each is taken when it is complete, until Ctrl-C.
    idle
        End watching when no film came for so many seconds.
    stage
        Copy each film to the node's own disk (TMPDIR) before it is read.
    report
        Write report.html of each run.
    quiet
        No progress and no summary.
    plan
        Write plan.json and end: for the Snakefile.
    """
    if table is None and watch is None:
        raise InputError(
            "TABLE.csv", "a table of tests, or a folder to watch", "none", "track campaign --help"
        )
    number(cores, "--cores", least=1)
    number(idle, "--idle", least=0)
    from vision.campaign import engine
    from vision.campaign.plan import check_folder, vanished_rows, write_plan
    from vision.campaign.table import Row, safe_name
    from vision.campaign.watch import FolderWatch

    named = table or watch
    assert named is not None
    target = out or Path(f"{run_name(named)}_campaign")
    check_folder(target)
    check = _checker(config)
    rows = [] if table is None else _read(table, check, watch)
    if not (dry_run or plan):
        engine.check_engine(executor, [row.film for row in rows])
    make = _planner(target, config=config, stage=stage, report=report, cores=cores, executor=executor)
    if dry_run:
        return _dry_run(make(rows, keep=False), cores)
    if plan:
        with engine.campaign_lock(target):
            write_plan(make(rows))
        return 0
    watcher = None if watch is None else FolderWatch(watch)
    conduct = _conductor(profile, executor, cores, quiet=quiet)
    with engine.campaign_lock(target):
        if watcher is None:
            return conduct(make(rows))

        def new(film: Path) -> Row:
            name = safe_name(run_name(film))
            return Row(row=0, film=str(film.absolute()), name=name, values=check({}).values)

        gone = vanished_rows(target, check, watcher.folder)  # done and moved away: they stay in the pool
        return _watch(watcher, rows, new, lambda ready: conduct(make([*gone, *ready])), idle)


def campaign_job(plan: Path, job: str, /, *fetched: Path) -> int:
    """Take the films of one job of a plan: for the Snakefile."""
    from vision.campaign.plan import read_plan
    from vision.campaign.worker import run_job

    content = read_plan(plan)
    if job not in content.jobs:
        raise InputError(plan, "a plan with this job", f"no '{job}'", "run track campaign again")
    copies = [path.absolute() for path in fetched]
    if content.started_in.is_dir():  # files that the configuration names are relative to it
        os.chdir(content.started_in)
    return run_job(content, job, _work(content), fetched=copies)


def campaign_pool(plan: Path, /) -> int:
    """Compare the finished runs of a plan: for the Snakefile."""
    from vision.campaign.plan import read_plan
    from vision.campaign.pool import pool, write_remarks

    content = read_plan(plan)
    lines = pool(content, command=command_line(), options=option_names())
    write_remarks(content, lines)
    return 0


# --- the table ----------------------------------------------------------------------------------------------


def _checker(config: Path | None) -> Check:
    """The command line's own validation of one row's options."""
    from vision.campaign.table import Checked

    if config is not None:
        read_config(config)  # what is wrong with it is said once, not for every row

    @cache
    def alone(name: str, text: str) -> tuple[Any, str]:
        try:
            value = parse_option(Path("table"), name, text)
            settings_of(merged(*_groups({name: value})))
        except InputError as error:
            return None, str(error).partition(": ")[2]
        return value, ""

    def check(options: Mapping[str, str]) -> Checked:
        found = {name: alone(name, text) for name, text in options.items()}
        problems = [(name, why) for name, (_, why) in found.items() if why]
        values = {name: value for name, (value, why) in found.items() if not why}
        try:
            parameters = merged(*_groups(values), config=config)
            settings_of(parameters)
        except InputError as error:
            return Checked(values={}, problems=[*problems, ("", str(error))])
        return Checked(values={name: one.value for name, one in parameters.items()}, problems=problems)

    return check


def _groups(values: Mapping[str, Any]) -> list[Any]:
    """The groups of options of the command line, from values by name."""
    from dataclasses import fields

    return [
        group(**{one.name: values[one.name] for one in fields(group) if one.name in values})
        for group in GROUPS
    ]


def _read(table: Path, check: Check, awaited: Path | None) -> list[Row]:
    """The table's rows.  Raises: InputError, after every problem of every row was shown."""
    from vision.campaign.table import read_campaign

    rows, problems = read_campaign(
        table, options=option_fields(), check=check, name_of=run_name, awaited=awaited
    )
    if problems:
        for line in _problem_lines(problems):
            complain(line)
        count, where = len(problems), len({problem.row for problem in problems})
        found = f"{count} problem{'s' * (count > 1)} in {where} row{'s' * (where > 1)}, listed above"
        raise InputError(table, "a table without problems", found, "nothing was started")
    return list(rows)


def _problem_lines(problems: Sequence[Problem]) -> list[str]:
    """One table of all problems."""
    table = [("row", "column", "problem"), *((str(p.row), p.column, p.text) for p in problems)]
    widths = [max(len(line[k]) for line in table) for k in range(2)]
    return [f"{row.rjust(widths[0])}  {column.ljust(widths[1])}  {text}" for row, column, text in table]


# --- planning and running -----------------------------------------------------------------------------------


def _planner(
    out: Path, *, config: Path | None, stage: bool, report: bool, cores: int | None, executor: str
) -> Callable[..., Plan]:
    from vision.campaign.plan import make_plan

    at_a_time = cores or usable_cores()
    if executor != "local":
        at_a_time = cores or 1  # jobs of full length: each one's start costs more there

    def make(rows: Sequence[Row], *, keep: bool = True) -> Plan:
        absolute = None if config is None else config.absolute()
        return make_plan(rows, out, config=absolute, stage=stage, report=report, cores=at_a_time, keep=keep)

    return make


def _dry_run(plan: Plan, cores: int | None) -> int:
    from vision.campaign.page import duration

    waiting = {name for job in plan.jobs.values() for name in job.films}
    lines = []
    for film in plan.films:
        what = "would run" if film.name in waiting else f"is {plan.state(film).state}"
        size = film.doubt or f"{film.frames} frames x {film.columns} px, about {duration(film.seconds)}"
        lines.append((film.name, what, size if film.name in waiting else ""))
    widths = [max((len(line[k]) for line in lines), default=0) for k in range(2)]
    say(f"{name.ljust(widths[0])}  {what.ljust(widths[1])}  {size}".rstrip() for name, what, size in lines)
    total = sum(job.seconds for job in plan.jobs.values())
    at_a_time = cores or usable_cores()
    longest = max((job.seconds for job in plan.jobs.values()), default=0.0)
    memory = max((job.memory_mb for job in plan.jobs.values()), default=0)
    say(
        [
            f"{len(waiting)} of {len(plan.films)} films would run in {len(plan.jobs)} jobs: about "
            f"{duration(total)} of computing, {duration(max(total / at_a_time, longest))} with "
            f"{at_a_time} at a time, up to {memory / 1000:.1f} GB for each; nothing was written"
        ]
    )
    return 0


def _conductor(
    profile: Path | None, executor: str, cores: int | None, *, quiet: bool
) -> Callable[[Plan], int]:
    """A function that takes a plan to its end, films, pool, page and summary, and gives the exit status."""
    from vision.campaign import engine
    from vision.campaign.page import write_page
    from vision.campaign.plan import write_plan
    from vision.campaign.pool import needs_pool, read_remarks

    where = profile or engine.profile_of(executor)
    if not (where / "config.yaml").is_file():
        found = "no config.yaml in it" if where.is_dir() else "no such folder"
        raise InputError(
            "`profile`", "a folder with a Snakemake profile", found, f"copy {engine.HERE / 'profiles'}"
        )

    run = partial(engine.run_snakemake, profile=where.absolute(), executor=executor, cores=cores)

    def conduct(plan: Plan) -> int:
        write_plan(plan)
        write_page(plan, live=bool(plan.jobs))
        started, unwritten = time.perf_counter(), False
        try:
            plan = engine.run_films(plan, lambda left: run(left, "films", watch=_progress(left, quiet=quiet)))
            if needs_pool(plan):
                run(plan, "pool")
        finally:
            try:
                write_page(plan, live=False, remarks=read_remarks(plan))
            except InputError as error:  # a full disk: what became of the films is said all the same
                unwritten = True
                complain(str(error))
        states = [plan.state(film) for film in plan.films]
        remarks = read_remarks(plan)
        if needs_pool(plan):
            remarks = (*remarks, f"the tests could not be compared; see {plan.out / engine.LOG}")
        _complain_of(states, remarks)
        if not quiet:
            say(_summary(plan, states, time.perf_counter() - started))
        good = not needs_pool(plan) and all(state.state == "done" for state in states)
        return 2 if unwritten else 0 if good else 1

    return conduct


def _complain_of(states: Sequence[State], remarks: Sequence[str]) -> None:
    """One line for each film that failed, and what was said of the pool."""
    for state in states:
        if state.state in ("failed", "partial"):
            complain(f"{state.name}: {state.state}: {state.reason}")
    for line in remarks:
        complain(line)


def _progress(plan: Plan, *, quiet: bool) -> Callable[[], None] | None:
    """Says which films have ended; None where nobody watches."""
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        return None
    left = {name: plan.film(name) for job in plan.jobs.values() for name in job.films}
    count, looked = len(left), [time.monotonic()]

    def look() -> None:
        if time.monotonic() - looked[0] < 2 + count / 200:
            return
        looked[0] = time.monotonic()
        for name, film in list(left.items()):
            state = plan.state(film)
            if state.state not in ("waiting", "running"):
                del left[name]
                complain(f"{count - len(left)} of {count}: {name}: {state.state} in {state.seconds:.1f} s")

    return look


def _summary(plan: Plan, states: Sequence[State], seconds: float) -> list[str]:
    from collections import Counter

    from vision.campaign.page import duration

    counts = Counter(state.state for state in states)
    ran = sum(len(job.films) for job in plan.jobs.values())
    said = ", ".join(f"{count} {word}" for word, count in sorted(counts.items()))
    lines = [f"{len(states)} tests: {said}; {ran} of them run now in {duration(seconds)}"]
    noted = [state for state in states if state.state == "warnings"]
    lines += [f"  {state.name}: {state.reason}" for state in noted[:MOST_LISTED]]
    if len(noted) > MOST_LISTED:
        lines.append(f"  and {len(noted) - MOST_LISTED} more with warnings: campaign.csv")
    return [*lines, f"results    {plan.out}/ (look at index.html first)"]


def _watch(
    watcher: FolderWatch,
    rows: Sequence[Row],
    new: Callable[[Path], Row],
    conduct: Callable[[Sequence[Row]], int],
    idle: float | None,
) -> int:
    """Take films as they are completed, until Ctrl-C or nothing came for so long; the exit status of all."""
    taken: dict[str, Row] = {}
    status, last = 0, time.monotonic()
    try:
        while True:
            ready = {row.name: row for row in watcher.rows(rows, new)}
            if not ready.keys() <= taken.keys():
                taken |= ready
                status = conduct(list(taken.values()))
                last = time.monotonic()
            elif idle is not None and time.monotonic() - last > idle:
                return status
            time.sleep(1.0)
    except KeyboardInterrupt:
        if not taken:
            raise
        complain(f"watching {watcher.folder} ended; run the same command to go on")
        return status


# --- one film -----------------------------------------------------------------------------------------------


def _work(plan: Plan) -> Callable[[Film, Path, Path], Outcome]:
    """What a job does with each film: the same as `track`."""
    from vision.campaign.table import is_remote
    from vision.campaign.worker import Outcome

    def parameters(film: Film) -> dict[str, Parameter]:
        values = {name: parse_option(plan.out, name, text) for name, text in film.options.items()}
        return merged(*_groups(values), config=plan.config)

    def work(film: Film, source: Path, target: Path) -> Outcome:
        found: list[Any] = []
        local = not is_remote(film.film)
        video = Path(film.film) if local else source
        chosen = parameters(film)
        # a job that was killed goes on where it ended, but not from a copy that is gone
        again = local and source == video and plan.state(film).attempts > 1 and not chosen["strips"].value

        def analyse(*, resume: bool) -> int:
            options = RunOptions(overwrite=True, report=plan.report, quiet=True, resume=resume)
            status, analysis = track_one(
                video, target, chosen, options, one_of_many=True, copy=source if local else None
            )
            found.append(analysis)
            return status

        status, why = outcome(partial(analyse, resume=again))
        if again and not found and status == 2:  # what was kept is of another reading
            status, why = outcome(partial(analyse, resume=False))
        analysis = found[0] if found else None
        if analysis is not None and not why and status >= 2:
            reasons = [
                analysis.reasons[name] for name in (*REFUSED, *analysis.failures) if name in analysis.reasons
            ]
            why = reasons[0] if reasons else f"a failure that nobody foresaw: {target / 'failures.txt'}"
        lines = [
            with_options(line, option_names()) for line in (why, *(analysis.warnings if analysis else ()))
        ]
        return Outcome(status=status, reason=lines[0], warnings=tuple(lines[1:]), analysis=analysis)

    return work
