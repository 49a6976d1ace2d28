"""The collapse: K of all tests in units of one sheet, against d over each test's own Λ̂."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from vision.comparison.joint import TestFit, fit_scale, stiffness_errors
from vision.comparison.tests import TractionTest
from vision.models import Estimate, equations


@dataclass(frozen=True, kw_only=True)
class Collapse:
    """How well the tests fall on the master curve.

    Parameters
    ----------
    table
        One row an event: ``run``, ``d_v_mm``, ``d_hat``, ``sheets`` (K/K_eff) and its error, ``model``.
    common_scale_mm
        The one Λ̂ that fits all tests best.
    rms_before, rms_after
        Root mean square distance of K/K_eff, in sheets, from the master curve with the one Λ̂, and with each
        test's own.
    rms_noise
        What the scatter between neighbouring events alone gives.
    """

    table: pd.DataFrame
    common_scale_mm: float
    rms_before: float
    rms_after: float
    rms_noise: float


def collapse(tests: Sequence[TractionTest], fits: Sequence[TestFit], modulus: Estimate) -> Collapse | None:
    r"""K/K_eff against d̂ = d_v/Λ̂ with M√(1 − d̂), for the tests that have a Λ̂; None where none has.

    The distance before is that with one Λ̂ for all: what their differences cost.
    """
    parts = []
    for test, fit in zip(tests, fits, strict=True):
        if not np.isfinite(fit.scale_mm.value):
            continue
        one = float(equations.sheet_stiffness(modulus_GPa=modulus.value, sample=test.sample))
        d = test.column("d_v_mm")[fit.used]
        sheets = test.column("K_N_per_mm")[fit.used] / one
        d_hat = d / fit.scale_mm.value
        noise = np.diff(sheets - equations.effective_sheets(d_hat, sample=test.sample))
        parts.append(
            pd.DataFrame(
                {
                    "run": test.run,
                    "d_v_mm": d,
                    "d_hat": d_hat,
                    "sheets": sheets,
                    "sheets_err": stiffness_errors(test)[fit.used] / one,
                    "model": equations.effective_sheets(d_hat, sample=test.sample),
                    "sheets_per_block": test.sample.sheets_per_block,
                    "noise": float(np.sqrt(np.mean(noise**2) / 2)),
                }
            )
        )
    if not parts:
        return None
    table = pd.concat(parts, ignore_index=True)
    scale = _common_scale(tests, fits, modulus)
    block = table["sheets_per_block"].to_numpy(float)
    before = block * np.sqrt(np.maximum(1 - table["d_v_mm"].to_numpy(float) / scale, 0))
    return Collapse(
        table=table,
        common_scale_mm=scale,
        rms_before=_rms(table["sheets"].to_numpy(float) - before),
        rms_after=_rms((table["sheets"] - table["model"]).to_numpy(float)),
        rms_noise=_rms(table["noise"].to_numpy(float)),
    )


def _common_scale(tests: Sequence[TractionTest], fits: Sequence[TestFit], modulus: Estimate) -> float:
    """One Λ̂ for all events; tests of one geometry are fitted together, others averaged by their events."""
    groups: dict[object, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    for test, fit in zip(tests, fits, strict=True):
        if np.isfinite(fit.scale_mm.value):
            columns = test.column("d_v_mm"), test.column("K_N_per_mm"), stiffness_errors(test)
            groups.setdefault(test.sample, []).append(tuple(part[fit.used] for part in columns))  # type: ignore[arg-type]
    scales, counts = [], []
    for sample, parts in groups.items():
        d, k, sigma = (np.concatenate(part) for part in zip(*parts, strict=True))
        scales.append(fit_scale(d, k, sigma, modulus, sample)[0].value)  # type: ignore[arg-type]
        counts.append(d.size)
    known = np.isfinite(scales)
    return (
        float(np.average(np.array(scales)[known], weights=np.array(counts)[known])) if known.any() else np.nan
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
