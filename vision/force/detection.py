"""How small a slip this recording could show: known slips put in and looked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vision.errors import InputError
from vision.force.stickslip import find_stick_slip

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_LEVELS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 12.0)
_FOUND = 0.95
_NEAR = 0.1


def detection_limit(
    force: xr.Dataset,
    sticks: pd.DataFrame,
    *,
    levels_N: tuple[float, ...] | None = None,
    injected: int = 40,
    seed: int = 0,
) -> pd.DataFrame:
    """The share of known small slips that are found when put into the recording's own sticks.

    In the middle of up to `injected` sticks, chosen at random, the load is lowered by a known step until the
    stick's own slip, so the noise, spikes and stiffness are the recording's; the threshold stays as it was.
    A slip counts as found if an event peaks within a tenth of that stick.  The stick is thereby cut in two,
    which makes this a little pessimistic.

    Args: force and sticks, as from `read_force` and `find_stick_slip`.  levels_N, drops to try; by default 1
    to 12 times the noise.  seed, of the choice of sticks.

    Returns: dF_N, dF_over_noise, recall, injected; attrs["limit_N"] is the smallest level from which on at
    least 95 % are found, NaN if none.  Raises InputError with fewer than three whole sticks.
    """
    import pandas as pd

    whole = sticks[(sticks["flag"] == "ok") & (sticks["samples"] >= 2 * sticks["samples"].median() / 3)]
    if len(whole) < 3:
        raise InputError("detection limit", "at least three whole sticks", f"{len(whole)}")
    noise = float(sticks.attrs["noise_N"])
    levels = levels_N or tuple(noise * level for level in _LEVELS)
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.choice(len(whole), size=min(injected, len(whole)), replace=False))
    picked = whole.iloc[chosen]
    recall = [_recall(force, picked, level, float(sticks.attrs["threshold_N"])) for level in levels]
    table = pd.DataFrame(
        {
            "dF_N": levels,
            "dF_over_noise": np.array(levels) / noise,
            "recall": recall,
            "injected": chosen.size,
        }
    )
    good = np.flatnonzero(np.logical_and.accumulate((np.array(recall) >= _FOUND)[::-1])[::-1])
    limit = float(levels[good[0]]) if good.size else float("nan")
    table.attrs |= {"limit_N": limit, "noise_N": noise, "seed": seed}
    return table


def _recall(force: xr.Dataset, picked: pd.DataFrame, drop_N: float, threshold_N: float) -> float:
    begin, end, slip = (picked[name].to_numpy() for name in ("t_v_s", "t_p_s", "slip_time_s"))
    middle = 0.5 * (begin + end)
    time = force["time_s"].to_numpy()
    # Lowered from mid-stick to the middle of the stick's own slip, which is smaller by as much.
    begun, over = (np.searchsorted(at, time, side="right") for at in (middle, end + 0.5 * slip))
    lowered = force.assign(load_N=force["load_N"] - drop_N * (begun - over))
    try:
        found = find_stick_slip(lowered, threshold_N=threshold_N)
    except InputError:
        return 0.0
    peaks = np.r_[found.attrs["first_slip_s"], found["t_p_s"].to_numpy()]
    nearest = np.min(np.abs(peaks[:, np.newaxis] - middle), axis=0)
    return float(np.mean(nearest < _NEAR * (end - begin)))
