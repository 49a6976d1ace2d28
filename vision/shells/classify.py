"""Which sheets are stiff, and the size of the stiff inner shell of each side in each stick phase."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import scipy
import xarray as xr

from vision.data import MOTION, ShellMetadata, record
from vision.errors import InputError
from vision.numeric import Floats
from vision.shells.sizes import LEAST_ERROR, ShellSettings, Side, breakpoint_n, isotonic, shell_sizes


def classify_sheets(motion: xr.Dataset, *, threshold: float = 0.1, certainty: float = 0.9) -> xr.Dataset:
    """Probability that each sheet is stiff, taken on its own.

    Parameters
    ----------
    motion
        From `horizontal_deformation`.
    threshold
        σ_x/Λ_st below which a sheet is stiff.
    certainty
        Probability from which on a sheet is called stiff or mobile.

    Returns
    -------
    `motion` with two more variables (event, sheet): p_stiff, the probability that the true ratio lies below
    the threshold given `ratio_signed` and its normal error (NaN where there is no ratio), and shell: "stiff",
    "mobile" or "undetermined".

    Raises
    ------
    InputError
        For a threshold that is not above 0 or a certainty not between 0.5 and 1.
    """
    MOTION.check(motion)
    _check(threshold, certainty)
    value, error = motion["ratio_signed"].to_numpy(), np.maximum(motion["ratio_err"].to_numpy(), LEAST_ERROR)
    p = scipy.special.ndtr((threshold - value) / error) - scipy.special.ndtr((-threshold - value) / error)
    shell = np.select([p >= certainty, p <= 1 - certainty], ["stiff", "mobile"], default="undetermined")
    about = {"units": "1", "long_name": f"probability that the true ratio is below {threshold:g}"}
    judged = motion.assign(
        p_stiff=(("event", "sheet"), p, about),
        shell=(("event", "sheet"), shell, {"long_name": f"at a certainty of {certainty:g}"}),
    )
    judged = judged.assign_attrs(ShellMetadata(threshold=threshold, certainty=certainty).attrs())
    return record(judged, "classify_sheets", threshold=threshold, certainty=certainty)


def deformation_table(motion: xr.Dataset, *, threshold: float = 0.1, certainty: float = 0.9) -> pd.DataFrame:
    """The table of `deformation.csv`: one row per event and sheet, event after event.

    Parameters are those of `classify_sheets`.
    """
    judged = classify_sheets(motion, threshold=threshold, certainty=certainty)
    events, sheets = judged.sizes["event"], judged.sizes["sheet"]
    columns = {
        "event": np.repeat(judged["event"].to_numpy(), sheets),
        "index": np.tile(judged["sheet"].to_numpy(), events),
        "side": np.tile(judged["side"].to_numpy(), events),
        "n": np.tile(judged["n"].to_numpy(), events),
    }
    lengths = ["sigma_x_um", "sigma_x_corrected_um", "sweep_um"]
    columns |= {name: judged[name].to_numpy().ravel() for name in lengths}
    columns["stick_length_um"] = np.repeat(judged["stick_length_um"].to_numpy(), sheets)
    rest = ["ratio", "ratio_err", "p_stiff", "shell", "frames", "flag"]
    return pd.DataFrame(columns | {name: judged[name].to_numpy().ravel() for name in rest})


def classify_shells(
    motion: xr.Dataset,
    *,
    threshold: float = 0.1,
    certainty: float = 0.9,
    effective_sheets: Callable[[Floats], Floats] | None = None,
    settings: ShellSettings = ShellSettings(),
) -> pd.DataFrame:
    """Size of the stiff inner shell of each side in each stick phase, one row per event and side.

    The ratio should not fall with n. Some thousand rising profiles, from power laws to steps, are each
    weighted by how well they fit all sheets of that side, and true ratios are drawn about them, near each
    sheet's own measurement as far as its error is small; the number below the threshold is counted in each
    draw. The size is the median, the interval holds `certainty` of the draws. Sheets far off every profile
    are counted by their own measurement. Errors that all sheets of an event share are not allowed for, except
    that of the stick length.

    Parameters
    ----------
    motion
        From `horizontal_deformation`.
    threshold
        σ_x/Λ_st below which a sheet is stiff.
    certainty
        Probability that the interval holds the true size.
    effective_sheets
        The force's M_eff at d in mm, for example `ModelFits.effective_sheets`.
    settings
        See `ShellSettings`.

    Returns
    -------
    A table with the columns

    - event, d_v_mm, side;
    - stiff_sheets, stiff_low, stiff_high: missing (<NA>) with fewer than three ratios on that side; unknown
      sheets inside a shell count as part of it;
    - M_eff_model: NaN without a model;
    - stiff_breakpoint, which needs no threshold: the n at which a flat inner part with a rising straight line
      after it fits best; NaN where the rise is not significant or fewer than five ratios are known;
    - monotone: False where the ratio falls with n by more than chance (isotonic regression);
    - sheets_known: number of sheets with a ratio.

    Raises
    ------
    InputError
        For a threshold that is not above 0 or a certainty not between 0.5 and 1.

    Notes
    -----
    Source: paper, shaded region of the deformation figure.
    """
    MOTION.check(motion)
    _check(threshold, certainty)
    sides = [Side.of(motion, side) for side in np.unique(motion["side"].to_numpy())]
    table = pd.concat([_side_table(side, motion, threshold, certainty, settings) for side in sides])
    table = table.sort_values(["event", "side"], ignore_index=True)
    table.attrs |= ShellMetadata(threshold=threshold, certainty=certainty).attrs()
    table = record(table, "classify_shells", threshold=threshold, certainty=certainty)
    return table if effective_sheets is None else with_model(table, effective_sheets)


def with_model(shells: pd.DataFrame, effective_sheets: Callable[[Floats], Floats]) -> pd.DataFrame:
    """The same table with M_eff_model filled in: the force's M_eff per side at d_v, mm."""
    d_mm = shells["d_v_mm"].to_numpy(float)
    return shells.assign(M_eff_model=np.asarray(effective_sheets(d_mm), float))


def _side_table(
    side: Side, motion: xr.Dataset, threshold: float, certainty: float, settings: ShellSettings
) -> pd.DataFrame:
    known = side.known.sum(axis=1)
    names = ("stiff_sheets", "stiff_low", "stiff_high")
    sizes = shell_sizes(side, threshold=threshold, certainty=certainty, settings=settings)
    d_v = motion["d_v_mm"].to_numpy() if "d_v_mm" in motion.coords else np.full(known.size, np.nan)
    return pd.DataFrame(
        {"event": motion["event"].to_numpy(), "d_v_mm": d_v, "side": side.side}
        | {
            name: pd.Series(count).astype("Int64").where(known >= 3)  # fewer are no profile
            for name, count in zip(names, sizes, strict=True)
        }
        | {
            "M_eff_model": np.nan,
            "stiff_breakpoint": breakpoint_n(side, settings.significance),
            "monotone": isotonic(side, settings.significance)[1],
            "sheets_known": known,
        }
    )


def _check(threshold: float, certainty: float) -> None:
    """Raises InputError for a threshold or certainty that cannot be meant."""
    if not (np.isfinite(threshold) and threshold > 0):
        raise InputError("`threshold`", "a number above 0", f"{threshold:g}", "0.1 is the publication's")
    if not 0.5 < certainty < 1:
        raise InputError("`certainty`", "a probability above 0.5 and below 1", f"{certainty:g}")
