"""write_comparison(): several tests become one folder, whole or not at all."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from vision.comparison import Comparison
from vision.figures import save_figures
from vision.report.compare import write_compare_report
from vision.run.folder import run_folder
from vision.run.provenance import Origin, write_json
from vision.run.tables import write_table

MARK = "compare"  # of run.json: tells a comparison from a run
PICTURES = ("collapse", "trends")


def write_comparison(
    found: Comparison, target: Path, origin: Origin, *, overwrite: bool = False, report: bool = True
) -> dict[str, Any]:
    """Write tests.csv, trends.json, all_events.csv, the figures, report.html and run.json.

    Parameters
    ----------
    found
        Of `vision.compare`.
    target
        The folder.
    origin
        For run.json.
    overwrite
        Replace an earlier comparison.
    report
        Whether report.html is written.

    Returns
    -------
    dict
        What run.json holds.

    Raises
    ------
    InputError
        Where the folder exists (without ``overwrite``) or cannot be written; nothing is left then.
    """
    started = time.perf_counter()
    facts = origin.facts() | {
        MARK: {"runs": [str(test.folder) for test in found.tests], "failures": list(found.failures)},
        "warnings": origin.named((*found.failures, *found.warnings)),
    }
    with run_folder(target, overwrite=overwrite) as folder:
        write_table(found.table, folder / "tests.csv")
        write_table(found.events(), folder / "all_events.csv")
        write_json(found.to_json(), folder / "trends.json")
        figures = found.figures()
        save_figures(folder / "figures.npz", figures)
        for figure in figures:
            if figure.name in PICTURES:
                figure.save(folder / f"{figure.name}.png")
        if report:
            write_compare_report(folder / "report.html", found, facts, figures=figures)
        facts["seconds"] = {"writing": time.perf_counter() - started}
        write_json(facts, folder / "run.json")
    return facts
