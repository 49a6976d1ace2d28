"""Everything a report can be made from, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from vision.clock import Clock
    from vision.models.fits_result import ModelFits


@dataclass(frozen=True, kw_only=True)
class RunResults:
    """What a run found. Parts that are None are left out of the report, which says so.

    profile: I(x, t) from `vision.strip_profile`.  tracks: from `vision.track_sheets`.  frame: one whole
    frame (rows, columns), any depth.  facts: the content of run.json.  pixel_size_um: None gives lengths in
    px.  force: from `read_force`.  sticks: from `find_stick_slip`.  clock: from `synchronise`.  motion: from
    `horizontal_deformation`.  shells: one row per event and side, columns as in shells.csv.  fits: from
    `fit_models`.  threshold: sigma_x over stick length below which a sheet counts as stiff.  notes: why a
    part is missing, or what else the reader must know, one line each.
    """

    profile: xr.DataArray
    tracks: xr.Dataset
    frame: NDArray[np.generic] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    pixel_size_um: float | None = None
    force: xr.Dataset | None = None
    sticks: pd.DataFrame | None = None
    clock: Clock | None = None
    motion: xr.Dataset | None = None
    shells: pd.DataFrame | None = None
    fits: ModelFits | None = None
    threshold: float = 0.1
    notes: tuple[str, ...] = ()
