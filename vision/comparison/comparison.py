"""compare(): read finished runs and a table of tests, and compare them; the comparison's folder and page."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vision.comparison.figures import compare_figures, label_of, slope_text, velocity
from vision.comparison.joint import (
    COMPARED,
    Collapse,
    CompareSettings,
    JointFriction,
    TestFit,
    collapse,
    common_modulus,
    fit_joint,
    fit_test,
    shared_shifts,
    systematic_shifts,
)
from vision.comparison.runs import TractionTest, film_columns, read_tests
from vision.comparison.trends import Irregularity, Trend, find_irregular, find_trends
from vision.data import with_word
from vision.errors import InputError, counted, first_of
from vision.figures import Figure, save_figures
from vision.folder import Shown, numbered, write_csv, write_json
from vision.models import Estimate, both_errors, plus_minus
from vision.models.single_fits import SYMBOLS, low_speed
from vision.report.page import FactsTable, render_page
from vision.run.provenance import Origin
from vision.run.writing import results_folder
from vision.summary import Answer

MARK = "compare"  # key in run.json that distinguishes a comparison from a run
PICTURES = ("collapse", "trends")


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Comparison(Shown):
    """Results of comparing several tests."""

    tests: tuple[TractionTest, ...]  #: the runs
    fits: tuple[TestFit, ...]  #: the fit of each, in the same order
    table: pd.DataFrame  #: one row per run: the content of tests.csv
    modulus: Estimate  #: Y_eff that was held fixed, GPa
    modulus_from: tuple[str, ...]  #: the runs it comes from ("given" if the user gave it)
    #: A joint μ for each sample with several tests, and one for all tests if there are several samples.
    joint: tuple[JointFriction, ...]
    collapse: Collapse | None  #: K/K_eff against d̂; None if no test has a Λ̂
    irregular: tuple[Irregularity, ...]  #: for each test, where stick-slip becomes irregular
    trends: tuple[Trend, ...]  #: with the number of previous tests and with humidity
    failures: tuple[str, ...]  #: runs that could not be used
    warnings: tuple[str, ...]  #: those that matter for the results
    settings: CompareSettings = CompareSettings()  #: constants of the comparison

    @property
    def modulus_undetermined(self) -> bool:
        """Whether K does not determine the Y_eff that was held fixed."""
        return any(test.modulus_undetermined for test in self.tests if test.run in self.modulus_from)

    @property
    def modulus_text(self) -> str:
        """Y_eff that was held fixed, with its error and unit, or as not determined by K."""
        if self.modulus_undetermined:
            return f"{self.modulus.value:.3g} GPa (not determined)"
        return f"{plus_minus(self.modulus)} GPa"

    def _shown(self) -> tuple[str, dict[str, str]]:
        rows = {one.what: ", ".join(filter(None, (one.value, one.detail))) for one in answers(self)}
        lines = numbered("warning", (*self.failures, *self.warnings))
        return f"comparison of {counted(len(self.tests), 'test')}", rows | lines

    def events(self) -> pd.DataFrame:
        """Return the events of all tests with the names of their runs, and whether the fits used them."""
        parts = [
            test.events.assign(
                run=test.run, V_mm_min=test.speed_mm_min, sample=test.sample_name, used=fit.used
            )
            for test, fit in zip(self.tests, self.fits, strict=True)
        ]
        table = pd.concat(parts, ignore_index=True)
        first = ["run", "sample", "V_mm_min"]
        return table[[*first, *table.columns.difference(first, sort=False)]]

    def figures(self) -> list[Figure]:
        """Return every figure for which there are data, in reading order."""
        return [figure for part in compare_figures(self).values() for figure in part]

    def to_json(self) -> dict[str, Any]:
        """Return the content of trends.json."""
        return {
            "Y_eff_GPa": asdict(self.modulus) | {"from": list(self.modulus_from)},
            "joint": [asdict(one) for one in self.joint],
            "collapse": None if self.collapse is None else _without(self.collapse, "table"),
            "irregular": [_without(one, "d_mm", "variation") for one in self.irregular],
            "trends": [asdict(one) for one in self.trends],
        }


def _without(item: Collapse | Irregularity, *names: str) -> dict[str, Any]:
    """Return the fields of a dataclass as a dictionary, without the named ones."""
    return {name: value for name, value in vars(item).items() if name not in names}


def compare(
    runs: Sequence[str | Path] = (),
    table: str | Path | pd.DataFrame | None = None,
    *,
    main_sample: str | None = None,
    modulus_GPa: float | None = None,
    settings: CompareSettings = CompareSettings(),
) -> Comparison:
    """Compare several finished tests: one table, a joint μ, the collapse, the trends.

    Parameters
    ----------
    runs
        Run folders of `track` or `track force`; by default those named in the table.
    table
        CSV or data frame with any of the columns run, sample, V_mm_min, n_test, RH_percent, T_C.
    main_sample
        Sample whose Y_eff is held fixed for all tests; by default that of the first run.
    modulus_GPa
        Y_eff in GPa, if it is known from elsewhere.
    settings
        Tunable constants.

    Returns
    -------
    Comparison
        The results. A run that cannot be used is named in ``failures`` and skipped.

    Raises
    ------
    InputError
        If no run can be used, the table cannot be read, or the main sample is not among the tests.

    Examples
    --------
    >>> found = vision.compare(["old_tracks", "new_tracks"], "tests.csv")  # doctest: +SKIP
    >>> found.table[["run", "mu", "mu_err"]]  # doctest: +SKIP
    """
    read = read_tests(runs, table)
    tests = _with_geometry_errors_of_samples(read.tests)
    warnings = list(read.warnings)
    main = None  # the sample from which Y_eff is taken
    if modulus_GPa is None:
        main = tests[0].sample_name if main_sample is None else main_sample
    modulus, source = _modulus(tests, main, modulus_GPa)
    if main is not None and not any(low_speed(test.speed_mm_min) for test in tests if test.run in source):
        which = f"no test of sample {main}" if main else "no test"
        warnings.append(
            f"{which} is slow, so Y_eff is that of faster ones, for which the models do not hold: compare a "
            "slow test of it, too, or give `modulus_GPa`, or another `main_sample`"
        )
    if unknown := [t.run for t in tests if t.run in source and t.modulus_undetermined]:
        warnings.append(
            f"K does not determine Y_eff in {', '.join(unknown)}, so that the Y_eff held fixed, and with it "
            "every Λ̂ and N̂, is no result: compare another test of the sample, too, or give `modulus_GPa`"
        )
    tests, fits, unfitted = _fits(tests, modulus, main, settings)
    for test, fit in zip(tests, fits, strict=True):
        warnings += [f"{test.run}: {line}" for line in fit.warnings]
    no_scale = ", ".join(t.run for t, f in zip(tests, fits, strict=True) if np.isnan(f.scale_mm.value))
    if modulus_GPa is None and no_scale:
        text = f"no Λ̂ with Y_eff = {modulus.value:.3g} GPa: {no_scale} (`modulus_GPa`, `main_sample`)"
        warnings.append(text)
    joint = _joint(tests, fits, settings)
    warnings += [one.warning for one in joint if one.warning]
    rows = _table(tests, fits)
    shared = {name: shared_shifts(tests, fits, name) for name in COMPARED}
    individual = {with_word(name, "err"): [fit.individual_error(name) for fit in fits] for name in COMPARED}
    return Comparison(
        tests=tests,
        fits=fits,
        table=rows,
        modulus=modulus,
        modulus_from=source,
        joint=joint,
        collapse=collapse(tests, fits, modulus),
        irregular=tuple(find_irregular(test, settings) for test in tests),
        trends=find_trends(rows.assign(**individual), settings, shared=shared),
        failures=(*read.failures, *unfitted),
        warnings=tuple(warnings),
        settings=settings,
    )


def _with_geometry_errors_of_samples(tests: Sequence[TractionTest]) -> tuple[TractionTest, ...]:
    """Give every test of a sample the largest error of each dimension that any of its tests states."""
    errors: dict[str, dict[str, float]] = {}
    for test in tests:
        shared = errors.setdefault(test.sample_name, {})
        for name, error in test.errors.items():
            if name != "d0_mm":
                shared[name] = max(error, shared.get(name, 0.0))
    return tuple(replace(test, errors={**test.errors, **errors[test.sample_name]}) for test in tests)


def _modulus(
    tests: Sequence[TractionTest], main: str | None, given: float | None
) -> tuple[Estimate, tuple[str, ...]]:
    """Return Y_eff, as given or from the tests of the main sample, and where it comes from."""
    if given is not None:
        if not 0 < given < 1e6:
            raise InputError("`modulus_GPa`", "a positive number", f"{given!r}")
        return Estimate(given, float("nan")), ("given",)
    names = [test.sample_name for test in tests]
    if main is None or main not in names:
        known = ", ".join(sorted(set(names)))
        raise InputError("`main_sample`", f"one of the tests' samples ({known})", f"'{main}'")
    modulus, source = common_modulus(tests, main)
    if not np.isfinite(modulus.value):
        raise InputError("`modulus_GPa`", "tests of the main sample that give Y_eff", "none", "give it")
    return modulus, source


def _fits(
    tests: Sequence[TractionTest], modulus: Estimate, main: str | None, settings: CompareSettings
) -> tuple[tuple[TractionTest, ...], tuple[TestFit, ...], list[str]]:
    """Return the tests that can be fitted, their fits, and an error message for each of the others."""
    done: dict[TractionTest, TestFit] = {}
    errors = []
    for test in tests:
        try:
            fit = fit_test(test, modulus, settings)
            done[test] = systematic_shifts(test, fit, modulus, test.sample_name == main)
        except InputError as error:
            errors.append(error)
    if not done:
        raise errors[0]
    return tuple(done), tuple(done.values()), [str(error) for error in errors]


def _table(tests: Sequence[TractionTest], fits: Sequence[TestFit]) -> pd.DataFrame:
    rows = [
        {
            "run": test.run,
            "sample": test.sample_name,
            "V_mm_min": test.speed_mm_min,
            "n_test": test.n_test,
            "RH_percent": test.humidity_percent,
            **{
                column: number
                for name, one in fit.values.items()
                for column, number in ((name, one.value), (with_word(name, "err"), one.error))
            },
            "chi2_dof": fit.chi2_dof,
            **{with_word(name, "systematic"): fit.systematic_error(name) for name in fit.values},
            "T_C": test.temperature_C,
            "events": len(test.events),
            "events_used": int(fit.used.sum()),
            **film_columns(test.film),
            "notes": "; ".join((*fit.warnings, *fit.notes, *test.notes)),
        }
        for test, fit in zip(tests, fits, strict=True)
    ]
    return pd.DataFrame(rows)


def _joint(
    tests: Sequence[TractionTest], fits: Sequence[TestFit], settings: CompareSettings
) -> tuple[JointFriction, ...]:
    names = list(dict.fromkeys(test.sample_name for test in tests))
    groups = {name: [k for k, test in enumerate(tests) if test.sample_name == name] for name in names}
    if len(names) > 1:
        groups["all samples"] = list(range(len(tests)))
    return tuple(
        fit_joint([tests[k] for k in which], [fits[k] for k in which], name, settings)
        for name, which in groups.items()
        if len(which) > 1
    )


# --- summary ------------------------------------------------------------------------------------------------


def answers(found: Comparison) -> list[Answer]:
    """Return the main results, for the top of the page and for the summary of the command."""
    named = {test.sample_name for test in found.tests}
    boxes = [
        Answer(
            f"one μ of {'sample ' * (one.name in named)}{one.name}",
            both_errors(one.mu, one.error_contains) if one.fits else "none fits the tests",
            f"for {len(one.runs)} tests{_joint_detail(one)}",
            doubt=one.disagrees or bool(one.at_limit),
        )
        for one in found.joint
    ]
    if not boxes:
        mu = both_errors(found.fits[0].estimate("mu"))
        detail = f"needs at least two tests; that of {found.tests[0].run} is {mu}"
        boxes.append(Answer("one μ of all tests", "not fitted", detail))
    source, doubt = f"from {first_of(found.modulus_from, 3)}", found.modulus_undetermined
    boxes.append(Answer("Y_eff, held fixed", found.modulus_text, source, doubt=doubt))
    if (c := found.collapse) is not None:
        before = f"{c.rms_before:.2g} with one Λ̂ for all tests"
        detail = f"{before}; neighbouring events scatter by {c.rms_noise:.2g}"
        doubt = c.rms_after > 2 * c.rms_noise
        boxes.append(Answer("collapse", f"rms {c.rms_after:.2g} sheets", detail, doubt=doubt))
    changed = [one for one in found.irregular if np.isfinite(one.change_mm)]
    places = [f"{one.run} from d_v = {one.change_text}" for one in changed[:6]]
    which = f"in {len(changed)} of {len(found.irregular)} tests" if changed else "in no test"
    boxes.append(Answer("irregular stick-slip", which, "; ".join(places)))
    if examined := [t for t in found.trends if not t.reason]:
        claimed = [t for t in examined if t.claimed]
        lines = [_trend_line(t) for t in claimed]
        if doubtful := [t.name for t in examined if not t.beyond_systematic]:
            lines.append(f"within the systematic errors of the geometry: {', '.join(doubtful)}")
        boxes.append(Answer("trends", f"{len(claimed)} of {len(examined)} examined", "; ".join(lines)))
    return boxes


def _trend_line(t: Trend) -> str:
    partial = bool(np.isfinite(t.partial_slope))
    how = ", the other held fixed" if partial else ""
    return f"{t.name}: {slope_text(t, partial=partial)}{how} (adjusted p {t.p_adjusted:.2g})"


def _joint_detail(one: JointFriction) -> str:
    """State A of several tests, and whether they agree on μ."""
    line = ""
    if np.isfinite(one.amplitude.value):
        line += f", A {plus_minus(one.amplitude)}"
    if one.disagrees:
        line += f"; the tests differ by more than their errors (χ²/dof {one.disagreement:.3g})"
    if one.without_d0_error:
        missing = one.without_d0_error
        which = f" in {first_of(missing, 3)}" if missing != one.runs else ""
        line += f"; without the error of d0, which is not given{which}"
    if one.at_limit:
        line += f"; 𝒯0 at its limit in {', '.join(one.at_limit)}"
    return line


# --- the folder ---------------------------------------------------------------------------------------------


def write_comparison(
    found: Comparison, target: Path, origin: Origin, *, overwrite: bool = False, report: bool = True
) -> None:
    """Write the tables, figures, report.html and run.json of a comparison.

    origin: with the inputs besides the runs.
    Raises: InputError if the folder exists (without `overwrite`) or cannot be written; nothing is left then.
    """
    started = time.perf_counter()
    events = [test.folder / "events.csv" for test in found.tests]
    origin = replace(origin, inputs=[*events, *origin.inputs])
    facts = origin.facts(warnings=(*found.failures, *found.warnings))
    facts[MARK] = {"runs": [str(test.folder) for test in found.tests], "failures": list(found.failures)}
    with results_folder(target, facts, started=started, overwrite=overwrite) as folder:
        write_csv(found.table, folder / "tests.csv")
        write_csv(found.events(), folder / "all_events.csv")
        write_json(found.to_json(), folder / "trends.json")
        sections = compare_figures(found)
        figures = [figure for part in sections.values() for figure in part]
        save_figures(folder / "figures.npz", figures)
        for figure in figures:
            if figure.name in PICTURES:
                figure.save(folder / f"{figure.name}.png")
        if report:
            _write_page(folder / "report.html", found, facts, sections)


# --- its page -----------------------------------------------------------------------------------------------


def _subtitle(tests: Sequence[TractionTest]) -> str:
    """Return the numbers of tests and of samples, if each is named, and the velocities."""
    names = {test.sample_name for test in tests}
    samples = "" if "" in names else f" of {counted(len(names), 'sample')}"
    speeds = sorted({velocity(test.speed_mm_min) for test in tests if test.speed_mm_min > 0})
    pulled = f", V = {', '.join(f'{v:g}' for v in speeds)} mm/min" if speeds else ""
    return f"{counted(len(tests), 'test')}{samples}{pulled}"


def _write_page(
    path: Path, found: Comparison, facts: Mapping[str, Any], figures: Mapping[str, Sequence[Figure]]
) -> None:
    """Write report.html of several tests, with the figures of one panel."""
    shown = {name: [one for one in part if len(one.panels) == 1] for name, part in figures.items()}
    render_page(
        path,
        [(heading, part) for heading, part in shown.items() if part],
        facts,
        title=counted(len(found.tests), "test"),
        kind="comparison",
        subtitle=_subtitle(found.tests),
        answers=answers(found),
        warnings=list(facts.get("warnings", ())),
        missing=_missing(found),
        methods=_methods(found),
        tables=[_table_of_tests(found)],
    )


def _table_of_tests(found: Comparison) -> FactsTable:
    """Return the fit of each test, in the order of `compare`."""

    def text(fit: TestFit, name: str) -> str:
        if not np.isfinite(fit.values[name].value):
            return "not known"
        return both_errors(fit.estimate(name)).replace(" (stat.)", "").replace(" (syst.)", "")

    rows = tuple(
        (
            row["run"],
            row["sample"],
            f"{velocity(row['V_mm_min']):g}" if row["V_mm_min"] > 0 else "not known",
            f"{row['events_used']} of {row['events']}",
            *(text(fit, name) for name in COMPARED),
            row["notes"],
        )
        for row, fit in zip(found.table.to_dict("records"), found.fits, strict=True)
    )
    heads = "test", "sample", "V (mm/min)", "events used", *map(label_of, COMPARED), "notes"
    return FactsTable(
        "Tests", heads, rows, "Errors are statistical and, if known, systematic, as in tests.csv."
    )


def _missing(found: Comparison) -> list[str]:
    """Return what could not be determined, with the reason."""
    reasons: dict[str, list[str]] = {}
    for t in found.trends:
        if t.reason:
            reasons.setdefault(f"with {t.predictor}: {t.reason}", []).append(SYMBOLS[t.quantity][0])
    lines = [f"Trends of {', '.join(names)} {why}." for why, names in reasons.items()]
    if found.collapse is None:
        lines.append("The collapse: no test has a Λ̂.")
    return lines


def _methods(found: Comparison) -> list[str]:
    t_star = ", ".join(f"{mN:.3g}" for mN in sorted({1000 * test.sample.t_star_N for test in found.tests}))
    source = "as given" if found.modulus_from == ("given",) else f"of {', '.join(found.modulus_from)}"
    paragraphs = [
        "The peak forces of each test were fitted with Eq. 1 of the publication and an offset, with "
        f"T* = {t_star} mN fixed. K was fitted with M_eff K_eff, with Y_eff = {found.modulus_text} "
        f"({source}) fixed and only Λ̂ free; N̂ follows from Λ̂ and μ. Standard errors are White's, scaled if "
        "χ²/dof exceeds 1."
    ]
    if found.joint:
        paragraphs.append(
            "One μ for all tests of a sample was fitted with an individual offset of each test within "
            f"±{found.settings.t0_limit_N:g} N."
        )
    paragraphs.append(
        "Stick-slip becomes irregular at the event that best divides the logarithm of the relative deviation "
        "of ΔF from its smooth course into two levels. The change is claimed if fewer than "
        f"{100 * found.settings.change_p:g} % of random permutations divide as well, and a steady rise fits "
        "worse."
    )
    if any(not trend.reason for trend in found.trends):
        paragraphs.append(
            "Trends are weighted lines through the tests of all samples. Their p values come from "
            "permutations, with the other predictor fixed after Freedman and Lane, and are adjusted for the "
            "number of trends after Holm."
        )
    return paragraphs
