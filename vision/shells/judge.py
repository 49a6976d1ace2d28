"""What can be said of each sheet on its own: stiff, mobile, or not to be told."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vision.errors import InputError

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

LEAST_ERROR = 1e-9


def judge_sheets(motion: xr.Dataset, *, threshold: float = 0.1, certainty: float = 0.9) -> xr.Dataset:
    """`motion` with what can be said of each sheet on its own.

    Args: motion, of `horizontal_deformation`.  threshold, σ_x/Λ_st below which a sheet is stiff.  certainty,
    the probability from which a sheet is called stiff or mobile.

    Returns: a Dataset with two more variables (event, sheet): p_stiff, the probability that the true ratio
    lies below the threshold given `ratio_signed` and its normal error (NaN where there is no ratio), and
    shell: "stiff", "mobile" or "undetermined".
    Raises: InputError for a threshold that is not above 0 or a certainty not between 0.5 and 1.
    """
    from scipy.special import ndtr

    check_settings(threshold, certainty)
    value, error = motion["ratio_signed"].to_numpy(), np.maximum(motion["ratio_err"].to_numpy(), LEAST_ERROR)
    p = ndtr((threshold - value) / error) - ndtr((-threshold - value) / error)
    shell = np.select([p >= certainty, p <= 1 - certainty], ["stiff", "mobile"], default="undetermined")
    about = {"units": "1", "long_name": f"probability that the true ratio is below {threshold:g}"}
    judged = motion.assign(
        p_stiff=(("event", "sheet"), p, about),
        shell=(("event", "sheet"), shell, {"long_name": f"at a certainty of {certainty:g}"}),
    )
    return judged.assign_attrs(threshold=threshold, certainty=certainty)


def deformation_table(motion: xr.Dataset, *, threshold: float = 0.1, certainty: float = 0.9) -> pd.DataFrame:
    """deformation.csv: one row per event and sheet, event after event; then frames used and the flag."""
    import pandas as pd

    judged = judge_sheets(motion, threshold=threshold, certainty=certainty)
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
    verdicts = ["ratio", "ratio_err", "p_stiff", "shell", "frames", "flag"]
    return pd.DataFrame(columns | {name: judged[name].to_numpy().ravel() for name in verdicts})


def check_settings(threshold: float, certainty: float) -> None:
    """Raises InputError for a threshold or certainty that cannot be meant."""
    if not (np.isfinite(threshold) and threshold > 0):
        raise InputError("--threshold", "a number above 0", f"{threshold:g}", "0.1 is the publication's")
    if not 0.5 < certainty < 1:
        raise InputError("certainty", "a probability above 0.5 and below 1", f"{certainty:g}")
