"""x(n, z, t): the positions of tracked sheets in several parts of the strip, one above the other."""

from __future__ import annotations

import numpy as np
import xarray as xr

from vision.data import STRIP_PARTS, TRACKS, TrackMetadata, record
from vision.errors import InputError
from vision.numeric import Floats, Floats32, nan_median
from vision.sheets.quality import repeated_frames
from vision.sheets.ridges import RidgeComb
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.sheets.subpixel import FitName, fit_sheets, intensity_noise, learned_template

NEEDS = ("x_px", "x_err_px", "flag", "time_s")


def with_heights(
    tracks: xr.Dataset, parts: xr.DataArray, *, settings: TrackingSettings = DEFAULT
) -> xr.Dataset:
    """Add positions at several heights to tracks; identities and flags stay those of the whole strip.

    Parameters
    ----------
    tracks
        From `vision.track_sheets`, of the whole strip.
    parts
        Its parts, (z, frame, x), from `vision.video.strip_profiles`.
    settings
        Thresholds.

    Returns
    -------
    xarray.Dataset
        The tracks with x_z_px and x_z_err_px (frame, sheet, z) and the coordinate z (px from the top). NaN
        where the strip has no position, and where a part's fit has no answer within half a window of it.

    Raises
    ------
    InputError
        Where tracks and parts are not of the same frames.

    Notes
    -----
    Each part is fitted as the strip was, from the strip's position on. A part's error is its own pixels'
    noise times the fit's error per grey level, enlarged for each sheet as that of the strip is (compression).
    """
    TRACKS.check(tracks, NEEDS)
    STRIP_PARTS.check(parts)
    if not np.array_equal(tracks["frame"].values, parts["frame"].values):
        raise InputError("the parts of the strip", "the tracks' frames", "others", "use those of one reading")
    facts = TrackMetadata.of(tracks)
    comb = RidgeComb.of(facts)
    start = tracks["x_px"].values - float(parts["x"].values[0])
    x = np.empty((*start.shape, parts.sizes["z"]))
    err = np.empty_like(x)
    for k, part in enumerate(np.asarray(parts.values, np.float32)):
        x[..., k], err[..., k] = _fitted(part, start, facts, comb, settings)
    if "x_predicted_px" in tracks:
        stated = nan_median(tracks["x_err_px"].values) / tracks["x_predicted_px"].values
        err *= np.fmax(stated, 1.0)[:, None]
    found = {"x_z_px": x + float(parts["x"].values[0]), "x_z_err_px": err}
    variables = {name: (TRACKS[name].dims, data, TRACKS[name].attrs) for name, data in found.items()}
    return record(tracks.assign(variables).assign_coords(z=parts["z"]), "with_heights")


def _fitted(
    profile: Floats32, start_px: Floats, facts: TrackMetadata, comb: RidgeComb, settings: TrackingSettings
) -> tuple[Floats, Floats]:
    """Positions and errors (frame, N) in one part."""
    bright = profile if comb.sign > 0 else -profile
    fit: FitName = "paper" if facts.fit == "paper" else "sliding"
    x, per_grey = fit_sheets(bright, np.rint(start_px), fit=fit, window_px=facts.window_px, comb=comb)
    new = ~repeated_frames(profile, settings)
    if facts.fit == "template":
        usable = np.where(new[:, None], x, np.nan)
        x, per_grey, _ = learned_template(bright, usable, per_grey, comb, settings=settings)
    noise = intensity_noise(profile[new], x[new], half_px=facts.window_px // 2, fallback=comb.noise)
    return x, per_grey * noise
