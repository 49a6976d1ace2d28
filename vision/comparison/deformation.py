"""What the film of a test shows, for comparisons: σ_x/Λ_st of its sheets, and the number of stiff ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import pandas as pd

from vision.data import SIDES
from vision.errors import InputError
from vision.numeric import Floats
from vision.run.reading import RunFolder

INTERVAL = 2 * 1.645  # standard errors in an interval that contains 90 %
WHOLE = 12**-0.5  # standard error by counting whole sheets
MEDIAN = 1.2533  # standard error of a median over that of a mean, √(π/2)
OF_SHEETS = ["event", "side", "n", "ratio", "ratio_err"]
OF_SHELLS = ["event", "d_v_mm", "side", "stiff_sheets", "stiff_low", "stiff_high"]


@dataclass(frozen=True, kw_only=True, eq=False)
class FilmResults:
    """Rows of deformation.csv and shells.csv of one run, without those in which nothing is known."""

    sheets: pd.DataFrame  # OF_SHEETS and d_v_mm
    shells: pd.DataFrame  # OF_SHELLS
    threshold: float  # σ_x/Λ_st below which a sheet is stiff

    @classmethod
    def of(cls, run: RunFolder, warnings: list[str]) -> Self | None:
        """Read the tables of a run; None without them. A damaged one is a warning: the force counts still."""
        try:
            sheets, shells = run.table("deformation", OF_SHEETS), run.table("shells", OF_SHELLS)
        except InputError as error:
            warnings.append(f"{error}; the film of this run is not compared")
            return None
        if sheets is None or shells is None:
            return None
        sheets, shells = _numbers(sheets[OF_SHEETS]), _numbers(shells[OF_SHELLS])
        sheets = sheets.assign(d_v_mm=sheets["event"].map(shells.groupby("event")["d_v_mm"].first()))
        return cls(sheets=sheets.dropna(), shells=shells.dropna(), threshold=run.threshold)

    def separations_mm(self) -> Floats:
        """Return d_v of the stick phases in which a ratio is known, rising."""
        return np.sort(self.sheets.groupby("event")["d_v_mm"].first().to_numpy(float))

    def mean_ratios(self, low_mm: float, high_mm: float) -> pd.DataFrame:
        """Return σ_x/Λ_st of each sheet, mean over the stick phases with d_v in this range.

        Columns: number (side · n, rising), ratio, and error: the standard error by the scatter between stick
        phases, and the error of one, which others may share.
        """
        table = self.sheets[self.sheets["d_v_mm"].between(low_mm, high_mm)]
        table = table.assign(number=table["side"] * table["n"], variance=table["ratio_err"] ** 2)
        groups = table.groupby("number")
        scatter = groups["ratio"].std(ddof=0)
        error = np.sqrt(groups["variance"].mean() + scatter**2 / groups.size())
        return pd.DataFrame({"ratio": groups["ratio"].mean(), "error": error}).reset_index()


def _numbers(table: pd.DataFrame) -> pd.DataFrame:
    """Return the values as finite numbers, NaN for all others."""
    table = table.apply(pd.to_numeric, errors="coerce").astype(float)
    return table.where(np.isfinite(table))


def film_columns(film: FilmResults | None) -> dict[str, float]:
    """Return the columns of tests.csv about the film: medians over its stick phases; NaN if not known.

    Their errors contain that of a stick phase in full, since other stick phases may share it (of the stick
    lengths, the sheets' own movement), the scatter between stick phases, and of numbers of sheets that they
    are whole: where all stick phases agree, the shell may still end anywhere between two sheets.
    """
    of_side = ("stiff_{}", "stiff_{}_err", "ratio_n_{}", "ratio_{}", "ratio_{}_err")
    names = [name.format(side) for side in SIDES.values() for name in of_side]
    found = dict.fromkeys(["film_sticks", "film_d_mm", *names], np.nan)
    if film is None or film.sheets.empty:
        return found
    d_mm = film.separations_mm()
    found |= {"film_sticks": len(d_mm), "film_d_mm": float(np.median(d_mm))}
    for side, name in SIDES.items():
        sizes, sheets = (table[table["side"] == side] for table in (film.shells, film.sheets))
        if len(sizes):
            width = float((sizes["stiff_high"] - sizes["stiff_low"]).median())
            scatter = float(sizes["stiff_sheets"].std(ddof=0)) / np.sqrt(len(sizes))
            found[f"stiff_{name}"] = float(sizes["stiff_sheets"].median())
            error = np.hypot(width / INTERVAL, MEDIAN * scatter)
            found[f"stiff_{name}_err"] = float(np.hypot(error, WHOLE))
        often = sheets["n"].value_counts()
        often = often[2 * often >= len(d_mm)]  # one that leaves the picture in most sticks says little
        if len(often):
            n = int(often.index.max())
            outer = sheets[sheets["n"] == n]
            scatter = float(outer["ratio"].std(ddof=0)) / np.sqrt(len(outer))
            found |= {f"ratio_n_{name}": n, f"ratio_{name}": float(outer["ratio"].median())}
            found[f"ratio_{name}_err"] = float(np.hypot(outer["ratio_err"].median(), MEDIAN * scatter))
    return found
