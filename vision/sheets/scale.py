"""The size of a pixel from the sheets' own spacing."""

from __future__ import annotations

import numpy as np
import xarray as xr

from vision.data import TRACKS
from vision.errors import InputError
from vision.numeric import nan_median

WIDEST = 1.5  # times the median spacing: wider ones hide a sheet that was not found


def pixel_size_from_pitch(tracks: xr.Dataset, pitch_um: float) -> float:
    r"""µm per pixel, where the mean distance between neighbouring sheets is known.

    Parameters
    ----------
    tracks
        From `track_sheets`.
    pitch_um
        Mean distance between neighbouring sheets at rest, µm.

    Raises
    ------
    InputError
        For a pitch that is not positive, or fewer than two neighbouring sheets.

    Notes
    -----
    :math:`p / \langle \Delta x \rangle`, the mean over the spacings of the sheets' median positions, those
    wider than 1.5 median spacings left out. The mean spacing, not the median, adds up to the comb's whole
    width, in which errors of single positions cancel.
    """
    TRACKS.check(tracks)
    if not 0 < pitch_um < np.inf:
        raise InputError("`pitch_um`", "a positive length in µm", f"{pitch_um:g}")
    spacing = np.diff(nan_median(tracks["x_px"].values))
    spacing = spacing[np.isfinite(spacing)]
    near = spacing[spacing < WIDEST * np.median(spacing)] if spacing.size else spacing
    if not near.size:
        raise InputError("`pitch_um`", "at least two neighbouring sheets", f"{tracks.sizes['sheet']} in view")
    return float(pitch_um / near.mean())
