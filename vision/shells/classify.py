"""Size of the stiff inner shell of each side in each stick phase."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from vision.shells.judge import check_settings
from vision.shells.sides import Doubles, Side, breakpoint_n, isotonic
from vision.shells.sizes import shell_sizes

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_LEAST_SHEETS = 3  # with a ratio, on one side: with fewer there is no shell to speak of


def classify_shells(
    motion: xr.Dataset,
    *,
    threshold: float = 0.1,
    certainty: float = 0.9,
    effective_sheets: Callable[[Doubles], Doubles] | None = None,
) -> pd.DataFrame:
    """Size of the stiff inner shell, one row per event and side.

    The ratio should not fall with n.  Some thousand rising profiles, from power laws to steps, are each
    weighed by how well they fit all sheets of that side, and true ratios are drawn about them, near each
    sheet's own measurement as far as its error is small; the number below the threshold is counted in each
    draw.  The size is the median, the interval holds `certainty` of the draws.  Sheets far off every
    profile are counted by their own measurement.  Errors that all sheets of an event share are not allowed
    for, but for that of the stick length.

    Args: as `judge_sheets`; certainty is that of the interval.  effective_sheets, the force's M_eff at d in
    mm, for example `ModelFits.effective_sheets`.

    Returns: event, d_v_mm, side, stiff_sheets, stiff_low, stiff_high (missing, <NA>, with fewer than three
    ratios on that side), M_eff_model (NaN without a model), and as additions stiff_breakpoint, monotone and
    sheets_known.  stiff_breakpoint needs no threshold: the n at which a flat inner part with a rising
    straight line after it fits best; NaN where the ratio does not surely rise or fewer than five ratios are
    known.  monotone: False where the ratio falls with n somewhere by more than chance (isotonic
    regression).  Unknown sheets inside a shell count as part of it.
    Raises: InputError as `judge_sheets`.  Source: paper, shaded region of the deformation figure.
    """
    import pandas as pd

    check_settings(threshold, certainty)
    sides = [Side.of(motion, side) for side in np.unique(motion["side"].to_numpy())]
    table = pd.concat([_side_table(side, motion, threshold, certainty) for side in sides])
    table = table.sort_values(["event", "side"], ignore_index=True)
    table.attrs |= {"threshold": threshold, "certainty": certainty}
    return table if effective_sheets is None else with_model(table, effective_sheets)


def with_model(shells: pd.DataFrame, effective_sheets: Callable[[Doubles], Doubles]) -> pd.DataFrame:
    """The same table with M_eff_model filled in: the force's M_eff a side at d_v, mm."""
    d_mm = shells["d_v_mm"].to_numpy(float)
    return shells.assign(M_eff_model=np.asarray(effective_sheets(d_mm), float))


def _side_table(side: Side, motion: xr.Dataset, threshold: float, certainty: float) -> pd.DataFrame:
    import pandas as pd

    known = side.known.sum(axis=1)
    names = ("stiff_sheets", "stiff_low", "stiff_high")
    sizes = zip(names, shell_sizes(side, threshold=threshold, certainty=certainty), strict=True)
    d_v = motion["d_v_mm"].to_numpy() if "d_v_mm" in motion.coords else np.full(known.size, np.nan)
    return pd.DataFrame(
        {"event": motion["event"].to_numpy(), "d_v_mm": d_v, "side": side.side}
        | {name: pd.Series(count).astype("Int64").where(known >= _LEAST_SHEETS) for name, count in sizes}
        | {
            "M_eff_model": np.nan,
            "stiff_breakpoint": breakpoint_n(side),
            "monotone": isotonic(side)[1],
            "sheets_known": known,
        }
    )
