"""Write a comparison of several tests to a folder with a page."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import vision
from vision.comparison import Comparison
from vision.comparison.comparison import joint_detail
from vision.comparison.figures import compare_sections
from vision.figures import Figure, both_errors, plus_minus, save_figures
from vision.models import Estimate
from vision.report.page import render_page
from vision.report.text import Answer, citation
from vision.run.folder import run_folder, write_json
from vision.run.provenance import Origin
from vision.run.tables import write_table

MARK = "compare"  # key in run.json that distinguishes a comparison from a run
PICTURES = ("collapse", "trends")


def write_comparison(
    found: Comparison, target: Path, origin: Origin, *, overwrite: bool = False, report: bool = True
) -> dict[str, Any]:
    """Write the tables, figures, report.html and run.json of a comparison; return the content of run.json.

    Raises: InputError if the folder exists (without `overwrite`) or cannot be written; nothing is left then.
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
            _write_page(folder / "report.html", found, facts, figures)
        facts["seconds"] = {"writing": time.perf_counter() - started}
        write_json(facts, folder / "run.json")
    return facts


# --- the page -----------------------------------------------------------------------------------------------


def _write_page(path: Path, found: Comparison, facts: Mapping[str, Any], figures: Sequence[Figure]) -> None:
    """Write report.html of several tests."""
    samples = {test.sample_name for test in found.tests}
    speeds = sorted({float(f"{test.speed_mm_min:.2g}") for test in found.tests if test.speed_mm_min > 0})
    pulled = f", V = {', '.join(f'{v:g}' for v in speeds)} mm/min" if speeds else ""
    render_page(
        path,
        compare_sections(figures),
        facts,
        title=f"{len(found.tests)} tests",
        kind="comparison",
        subtitle=f"{len(found.tests)} tests of {len(samples)} sample{'s' * (len(samples) > 1)}{pulled}",
        answers=_answers(found),
        warnings=list(facts.get("warnings", ())),
        missing=_missing(found),
        methods=_methods(found),
        citation=citation(),
        tables=(),
    )


def _answers(found: Comparison) -> list[Answer]:
    """Return the main results for the top of the page."""
    answers = [
        Answer(
            f"friction coefficient, {one.sample or 'all tests'}",
            f"μ = {both_errors(one.mu)}",
            f"{len(one.runs)} tests{joint_detail(one)}",
            doubt=one.disagrees or bool(one.at_limit),
        )
        for one in found.joint
    ]
    if found.collapse is not None:
        c = found.collapse
        detail = (
            f"{c.rms_before:.2g} with one Λ̂ for all tests; neighbouring events scatter by {c.rms_noise:.2g}"
        )
        doubt = c.rms_after > 2 * c.rms_noise
        answers.append(Answer("collapse", f"rms {c.rms_after:.2g} sheets", detail, doubt=doubt))
    changed = [one for one in found.irregular if np.isfinite(one.change_mm)]
    if changed:
        first = changed[0]
        change = plus_minus(Estimate(first.change_mm, first.change_err_mm))
        detail = f"{first.run}; {len(changed)} of {len(found.irregular)} tests change"
        answers.append(Answer("irregular stick-slip", f"from d_v = {change} mm", detail))
    claimed = [f"{t.quantity} with {t.predictor}" for t in found.trends if t.claimed]
    tested = sum(not t.reason for t in found.trends)
    if tested:
        answers.append(Answer("trends", f"{len(claimed)} of {tested}", ", ".join(claimed) or "none claimed"))
    return answers


def _missing(found: Comparison) -> list[str]:
    """Return what could not be determined, with the reason."""
    lines = [f"{t.quantity} with {t.predictor}: {t.reason}." for t in found.trends if t.reason]
    if found.collapse is None:
        lines.append("The collapse: no test has a Λ̂.")
    return lines


def _methods(found: Comparison) -> list[str]:
    t_star = 1000 * found.tests[0].sample.t_star_N
    source = "as given" if found.modulus_from == ("given",) else f"of {', '.join(found.modulus_from)}"
    modulus = plus_minus(found.modulus)
    return [
        f"For each of {len(found.tests)} tests the peak forces were fitted with Eq. 1 of the publication and "
        f"an offset, with T* = {t_star:.3g} mN fixed. K was fitted with M_eff K_eff, with Y_eff = {modulus} "
        f"GPa ({source}) fixed and only Λ̂ free; N̂ follows from Λ̂ and μ. One μ for all tests of a sample "
        "was fitted with an individual offset of each test within ±10 N. Standard errors are White's, scaled "
        "if χ²/dof exceeds 1.",
        "Stick-slip becomes irregular at the event that best divides the logarithm of the relative deviation "
        "of ΔF from its smooth course into two levels. The change is claimed if fewer than 1 % of random "
        "permutations divide as well, and a steady rise fits worse. Trends are weighted lines. Their p "
        "values come from permutations, with the other predictor fixed after Freedman and Lane, and are "
        "adjusted for the number of trends after Holm.",
        f"The analysis was done with sheetvision {vision.__version__}.",
    ]
