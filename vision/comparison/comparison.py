"""compare(): finished runs and a table of tests become one comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vision.comparison.collapse import Collapse, collapse
from vision.comparison.irregular import Irregularity, find_irregular
from vision.comparison.joint import (
    CompareSettings,
    JointFriction,
    TestFit,
    common_modulus,
    fit_joint,
    fit_test,
)
from vision.comparison.tests import TractionTest, read_tests
from vision.comparison.trends import Trend, find_trends
from vision.errors import InputError
from vision.figures import Figure, load_figures
from vision.figures.compare import Overlay, compare_figures
from vision.models import Estimate


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Everything that was found in several tests.

    Parameters
    ----------
    tests, fits
        The runs and what each gives, in one order.
    table
        One row a run: the content of tests.csv.
    modulus, modulus_from
        Y_eff that was held fixed, GPa, and the runs it comes from ("given" where the user gave it).
    joint
        One μ for each sample with several tests, and one for all where there are several samples.
    collapse
        K/K_eff against d̂; None without any Λ̂.
    irregular
        Where stick-slip turns irregular, for each test.
    trends
        With n_test and humidity.
    failures, warnings
        Runs that could not be used, and remarks that matter.
    """

    tests: tuple[TractionTest, ...]
    fits: tuple[TestFit, ...]
    table: pd.DataFrame
    modulus: Estimate
    modulus_from: tuple[str, ...]
    joint: tuple[JointFriction, ...]
    collapse: Collapse | None
    irregular: tuple[Irregularity, ...]
    trends: tuple[Trend, ...]
    failures: tuple[str, ...]
    warnings: tuple[str, ...]

    def events(self) -> pd.DataFrame:
        """The events of all tests with the name of their run, and whether the fits used them."""
        parts = [
            test.events.assign(
                run=test.run, V_mm_min=test.speed_mm_min, sample=test.sample_name, used=fit.used
            )
            for test, fit in zip(self.tests, self.fits, strict=True)
        ]
        table = pd.concat(parts, ignore_index=True)
        first = ["run", "sample", "V_mm_min"]
        return table[[*first, *(name for name in table if name not in first)]]

    def figures(self) -> list[Figure]:
        """Every figure that these tests allow, in reading order."""
        return compare_figures(_overlay(self))

    def to_json(self) -> dict[str, Any]:
        """The content of trends.json."""
        return {
            "Y_eff_GPa": asdict(self.modulus) | {"from": list(self.modulus_from)},
            "joint": [asdict(one) for one in self.joint],
            "collapse": None
            if self.collapse is None
            else {name: item for name, item in vars(self.collapse).items() if name != "table"},
            "irregular": [
                {name: item for name, item in vars(one).items() if name not in ("d_mm", "variation")}
                for one in self.irregular
            ],
            "trends": [asdict(one) for one in self.trends],
        }


def compare(
    runs: Sequence[str | Path] = (),
    table: str | Path | pd.DataFrame | None = None,
    *,
    main_sample: str | None = None,
    modulus_GPa: float | None = None,
    settings: CompareSettings | None = None,
) -> Comparison:
    """Put several finished tests side by side: one table, one μ, the collapse, the trends.

    Parameters
    ----------
    runs
        Run folders of `track` or `track force`; those that the table names if none is given.
    table
        CSV or data frame with any of the columns run, sample, V_mm_min, n_test, RH_percent, T_C.
    main_sample
        Sample whose Y_eff is held fixed for all; that of the first run if not given.
    modulus_GPa
        Y_eff in GPa where it is known otherwise.
    settings
        Tunable constants.

    Returns
    -------
    The comparison. A run that cannot be used is named in ``failures``, and the rest is done.

    Raises
    ------
    InputError
        Where no run can be used, the table cannot be read, or the main sample is not among the tests.

    Examples
    --------
    >>> found = vision.compare(["old_tracks", "new_tracks"], "tests.csv")  # doctest: +SKIP
    >>> found.table[["run", "mu", "mu_err"]]  # doctest: +SKIP
    """
    tuning = settings or CompareSettings()
    read = read_tests(runs, table)
    tests = read.tests
    warnings = list(read.warnings)
    modulus, source = _modulus(tests, main_sample, modulus_GPa, tuning)
    tests, fits, unfitted = _fits(tests, modulus, tuning)
    for test, fit in zip(tests, fits, strict=True):
        warnings += [f"{test.run}: {note}" for note in fit.notes if "𝒯0" in note or "misfit" in note]
    if modulus_GPa is None and any(f.scale_mm.value != f.scale_mm.value for f in fits):
        lost = ", ".join(t.run for t, f in zip(tests, fits, strict=True) if np.isnan(f.scale_mm.value))
        warnings.append(f"no Λ̂ with Y_eff = {modulus.value:.3g} GPa: {lost} (`modulus_GPa`, `main_sample`)")
    rows = _table(tests, fits)
    return Comparison(
        tests=tests,
        fits=fits,
        table=rows,
        modulus=modulus,
        modulus_from=source,
        joint=_joint(tests, fits, tuning),
        collapse=collapse(tests, fits, modulus),
        irregular=tuple(find_irregular(test, tuning) for test in tests),
        trends=find_trends(rows, tuning),
        failures=(*read.failures, *unfitted),
        warnings=tuple(warnings),
    )


def _modulus(
    tests: Sequence[TractionTest],
    main_sample: str | None,
    given: float | None,
    tuning: CompareSettings,
) -> tuple[Estimate, tuple[str, ...]]:
    if given is not None:
        if not 0 < given < 1e6:
            raise InputError("`modulus_GPa`", "a positive number", f"{given!r}")
        return Estimate(given, float("nan")), ("given",)
    names = [test.sample_name for test in tests]
    main = names[0] if main_sample is None else main_sample
    if main not in names:
        known = ", ".join(sorted(set(names)))
        raise InputError("`main_sample`", f"one of the tests' samples ({known})", f"'{main}'")
    modulus, source = common_modulus(tests, main, tuning)
    if not np.isfinite(modulus.value):
        raise InputError("`modulus_GPa`", "tests of the main sample that give Y_eff", "none", "give it")
    return modulus, source


def _fits(
    tests: Sequence[TractionTest], modulus: Estimate, tuning: CompareSettings
) -> tuple[tuple[TractionTest, ...], tuple[TestFit, ...], list[str]]:
    """The tests that can be fitted, their fits, and one line for each of the others."""
    done: dict[TractionTest, TestFit] = {}
    errors = []
    for test in tests:
        try:
            done[test] = fit_test(test, modulus, tuning)
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
            "mu": fit.mu.value,
            "mu_err": fit.mu.error,
            "T0_N": fit.t0_N.value,
            "T0_err_N": fit.t0_N.error,
            "A": fit.amplitude.value,
            "A_err": fit.amplitude.error,
            "N_hat_N": fit.n_hat_N.value,
            "N_hat_err_N": fit.n_hat_N.error,
            "Lambda_hat_mm": fit.scale_mm.value,
            "Lambda_hat_err_mm": fit.scale_mm.error,
            "chi2_dof": fit.chi2_dof,
            "N_hat_systematic_N": fit.n_hat_N.systematic_error,
            "Lambda_hat_systematic_mm": fit.scale_mm.systematic_error,
            "T_C": test.temperature_C,
            "events": len(test.events),
            "events_used": int(fit.used.sum()),
            "notes": "; ".join(fit.notes),
        }
        for test, fit in zip(tests, fits, strict=True)
    ]
    return pd.DataFrame(rows)


def _joint(
    tests: Sequence[TractionTest], fits: Sequence[TestFit], tuning: CompareSettings
) -> tuple[JointFriction, ...]:
    names = list(dict.fromkeys(test.sample_name for test in tests))
    groups = {name: [k for k, test in enumerate(tests) if test.sample_name == name] for name in names}
    if len(names) > 1:
        groups["all samples"] = list(range(len(tests)))
    return tuple(
        fit_joint([tests[k] for k in which], [fits[k] for k in which], name, tuning)
        for name, which in groups.items()
        if len(which) > 1
    )


def _overlay(found: Comparison) -> Overlay:
    """What the figures draw, as plain tables."""
    main = found.joint[0] if found.joint else None
    mu = found.fits[0].mu if main is None else main.mu
    amplitude = found.fits[0].amplitude if main is None else main.amplitude
    return Overlay(
        events=found.events(),
        table=found.table,
        sample=found.tests[0].sample,
        mu=mu,
        amplitude=amplitude,
        modulus=found.modulus,
        joint_name="" if main is None else main.sample,
        collapse=None if found.collapse is None else found.collapse.table,
        rms=(np.nan,) * 3
        if found.collapse is None
        else (found.collapse.rms_before, found.collapse.rms_after, found.collapse.rms_noise),
        irregular=tuple(vars(one) for one in found.irregular),
        trends=tuple(asdict(one) for one in found.trends),
        sticks=_sticks(found.tests),
    )


def _sticks(tests: Sequence[TractionTest]) -> tuple[tuple[float, Figure], ...]:
    """(V, the run's figure of single sticks) of one test a velocity, where runs have kept them."""
    chosen: dict[float, Figure] = {}
    for test in sorted(tests, key=lambda t: -len(t.events)):
        path = test.folder / "figures.npz"
        if test.speed_mm_min in chosen or not np.isfinite(test.speed_mm_min) or not path.is_file():
            continue
        try:
            named = {figure.name: figure for figure in load_figures(path)}
        except (InputError, OSError):
            continue  # a figure less, no result less
        if "sticks" in named:
            chosen[test.speed_mm_min] = named["sticks"]
    return tuple(sorted(chosen.items(), key=lambda item: item[0]))
