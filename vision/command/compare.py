"""`track compare RUN… --table tests.csv`: several finished tests side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter as Option

from vision.command.console import complain, say
from vision.command.options import Flag, option_names
from vision.command.track import command_line

if TYPE_CHECKING:
    from vision.comparison import Comparison


def compare(
    *runs: Path,
    table: Path | None = None,
    main_sample: str | None = None,
    fix_yeff: float | None = None,
    out: Path | None = None,
    overwrite: Flag = False,
    report: Annotated[bool, Option(show_default=False)] = True,
    quiet: Flag = False,
) -> int:
    """Several finished tests side by side: one table, one μ, the collapse, the change points, the trends.

    Writes tests.csv (one row per run), trends.json, all_events.csv, figures.npz, collapse.png, trends.png,
    report.html and run.json. A run that cannot be used is named, the rest is done, and the exit status is 1.

    Examples:

        track compare old_tracks new_tracks --table tests.csv

        track compare --table tests.csv --main-sample A --out comparison

    Parameters
    ----------
    runs
        Run folders with a force recording; those that the table names if none is given.
    table
        CSV with any of the columns run,sample,V_mm_min,n_test,RH_percent,T_C.
    main_sample
        Sample whose Y_eff is held fixed for all tests; that of the first run if not given.
    fix_yeff
        Y_eff in GPa, where it is known otherwise.
    out
        Folder; comparison in the working directory if not given.
    overwrite
        Replace an earlier comparison.
    report
        Write report.html.
    quiet
        No summary.
    """
    from vision.comparison import compare as compare_runs
    from vision.run import Origin, Parameter, check_mark, check_target
    from vision.run.comparing import MARK, write_comparison

    target = out or Path("comparison")
    check_target(target, overwrite=overwrite)
    check_mark(target, MARK)
    found = compare_runs(runs, table, main_sample=main_sample, modulus_GPa=fix_yeff)
    typed: dict[str, Any] = {"table": table, "main_sample": main_sample, "fix_yeff": fix_yeff}
    origin = Origin(
        command=command_line(),
        inputs=[path for test in found.tests for path in (test.folder / "events.csv",)]
        + ([table] if table else []),
        parameters={
            name: Parameter(value, "default" if value is None else "given") for name, value in typed.items()
        },
        options=option_names(),
    )
    write_comparison(found, target, origin, overwrite=overwrite, report=report)
    for line in (*found.failures, *found.warnings):
        complain(line)
    if not quiet:
        say(_summary(found, target))
    return 1 if found.failures or found.warnings else 0


def _summary(found: Comparison, target: Path) -> list[str]:
    from vision.comparison.comparison import summary_lines

    return [f"{len(found.tests)} tests -> {target}/", *summary_lines(found)]
