"""track_sheets(): I(x, t) becomes x(n, t)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.sheets.comb import Comb, describe_comb
from vision.sheets.fitting import FitName, choose_window, fit_sheets, locking_error
from vision.sheets.holes import wide_spacings
from vision.sheets.linking import Links, link
from vision.sheets.medians import nan_median
from vision.sheets.noise import intensity_noise, position_noise
from vision.sheets.numbering import Numbering, number_sheets
from vision.sheets.recovery import Sightings, sightings
from vision.sheets.ridges import find_ridges

if TYPE_CHECKING:
    import xarray as xr

Doubles = NDArray[np.float64]

LOSSY = frozenset({"h264", "hevc", "mjpeg", "mpeg1video", "mpeg2video", "mpeg4", "vp8", "vp9", "av1", "wmv3"})


@dataclass(frozen=True)
class _Found:
    """Everything the Dataset is made of."""

    comb: Comb
    links: Links
    seen: Sightings
    x_px: Doubles
    err_px: Doubles
    noise: Doubles
    window_px: int


def track_sheets(
    strip: xr.DataArray,
    *,
    ridges: Literal["bright", "dark", "auto"] = "auto",
    sheets: int | None = None,
    axis_px: float | None = None,
    fit: FitName = "sliding",
    window_px: int | Literal["auto"] | None = None,
) -> xr.Dataset:
    """Positions of all sheets in all frames.

    Args:
        strip: I(x, t) from `vision.strip_profile`, (frame, x), with coordinates x (px), time_s and status.
        ridges: polarity of the ridges.
        sheets: number in view, found if None.
        axis_px: symmetry axis, found if None.
        fit: "sliding", "paper" (the publication's, exactly) or "template".
        window_px: odd fit window; None is 9 where the ridges are 6–14 px wide, else, as with "auto", it
            follows their width.

    Returns:
        Dataset with x_px, x_err_px and flag (frame, sheet); side, n, x_mean_px, found, fwhm_px, snr,
        x_noise_px (sheet); time_s (frame). x_px is NaN wherever flag is not "ok": "missing" (no ridge there),
        "merged" (two sheets in one ridge), "edge" (outside the picture or too near its edge), "doubtful"
        (identity not certain), "unfit" (the fit has no answer), or the frame's own "blank", "corrupt",
        "lost". What was found by itself is in attrs.

    Raises:
        InputError: for a constant picture, no ridges, fewer ridges than `sheets`, an axis outside all reason.
    """
    source = str(strip.attrs.get("source", "the strip"))
    profile = np.asarray(strip.values, np.float32)
    _check(profile, source)
    _check_axis(axis_px, strip)
    comb = describe_comb(profile, polarity=ridges, sheets=sheets, source=source)
    candidates = find_ridges(profile, comb)
    links = link(candidates, comb, width_px=profile.shape[1], sheets=sheets, source=source)
    seen = sightings(profile, candidates, links, comb)
    window = choose_window(comb, window_px)
    bright = profile if comb.sign > 0 else -profile
    x, per_noise = fit_sheets(bright, seen.start_px, fit=fit, window_px=window, comb=comb)
    noise = intensity_noise(profile, x, half_px=window // 2, fallback=comb.noise)
    err = per_noise * noise
    if fit == "paper":
        err = np.hypot(err, locking_error(x, bright, seen.start_px, window, comb))
    if str(strip.attrs.get("codec", "")) in LOSSY:
        err = err * _understated(x, err)
    found = _Found(comb, links, seen, x, err, noise, window)
    origin = float(strip["x"].values[0])
    numbering = number_sheets(x, axis_px=None if axis_px is None else axis_px - origin)
    settings: dict[str, Any] = {
        "ridges_asked": ridges,
        "sheets_asked": -1 if sheets is None else sheets,
        "fit": fit,
    }
    settings["wide_spacings"] = "" if sheets else _wide(links.model.x_px + origin)
    low, high = numbering.between_px
    numbering = replace(
        numbering, axis_px=numbering.axis_px + origin, between_px=(low + origin, high + origin)
    )
    return _dataset(strip, found, numbering, settings)


def _understated(x_px: Doubles, err_px: Doubles) -> Doubles:
    """Factor, at least 1, by which positions scatter more than the pixel noise explains, (N,).

    Lossy compression wipes out the noise by which errors are judged, and adds artefacts of its own.
    """
    factor = position_noise(x_px) / np.maximum(nan_median(err_px), 1e-9)
    return np.maximum(np.nan_to_num(factor, nan=1.0), 1.0)


def _check(profile: NDArray[np.float32], source: str) -> None:
    good = profile[np.isfinite(profile).all(axis=1)]
    if not len(good):
        raise InputError(source, "at least one usable frame", "none", "look at the frames' status")
    if profile.shape[1] < 8:
        raise InputError(source, "at least 8 columns", f"{profile.shape[1]}", "check --columns and --rotate")
    if float(np.ptp(good, axis=1).max()) == 0:
        raise InputError(source, "a picture with ridges", "a constant one", "check --strip and --columns")


def _check_axis(axis_px: float | None, strip: xr.DataArray) -> None:
    """With one side in view the axis lies outside the picture, but no further than the picture is wide."""
    first, last = float(strip["x"].values[0]), float(strip["x"].values[-1])
    wide = last - first
    if axis_px is not None and not first - wide <= axis_px <= last + wide:
        raise InputError(
            "--axis",
            f"a column near the picture ({first:.0f} to {last:.0f} px)",
            f"{axis_px:g}",
            "give it in px",
        )


def _dataset(
    strip: xr.DataArray, found: _Found, numbering: Numbering, settings: dict[str, Any]
) -> xr.Dataset:
    import xarray as xr

    flag = _flags(strip, found)
    ok = flag == "ok"
    x = np.where(ok, found.x_px, np.nan) + float(strip["x"].values[0])
    sheet = ("sheet",)
    contrast = np.where(ok, found.seen.contrast, np.nan)
    data = {
        "x_px": (("frame", "sheet"), x, _about("position of the sheet", "px")),
        "x_err_px": (
            ("frame", "sheet"),
            np.where(ok, found.err_px, np.nan),
            _about(
                "standard error of x_px: noise of the profile; also the locking of the paper's fit; for "
                "lossy video no less than the scatter from frame to frame",
                "px",
            ),
        ),
        "flag": (("frame", "sheet"), flag, _about("ok, or why there is no position")),
        "x_mean_px": (sheet, nan_median(x), _about("median position", "px")),
        "found": (sheet, ok.mean(axis=0), _about("share of the frames with a position", "1")),
        "fwhm_px": (
            sheet,
            nan_median(np.where(ok, found.seen.fwhm_px, np.nan)),
            _about("width of the ridge", "px"),
        ),
        "snr": (
            sheet,
            nan_median(contrast) / np.maximum(found.noise, 1e-12),
            _about("contrast over noise", "1"),
        ),
        "x_noise_px": (
            sheet,
            position_noise(x),
            _about("scatter of x_px from frame to frame, as measured", "px"),
        ),
    }
    coords = {
        "frame": strip["frame"].values,
        "time_s": ("frame", strip["time_s"].values, _about("time of the frame", "s")),
        "sheet": np.arange(x.shape[1]),
        "side": (sheet, numbering.side, _about("-1 left, +1 right of the axis")),
        "n": (sheet, numbering.n, _about("number from the centre outwards")),
    }
    return xr.Dataset(data, coords, strip.attrs | settings | _facts(found, numbering, flag))


def _flags(strip: xr.DataArray, found: _Found) -> NDArray[np.str_]:
    """Why there is no position, or "ok"; the frame's own state goes first."""
    status = np.asarray(strip["status"].values).astype("<U8")
    flag = found.seen.flag.copy()
    flag[(flag == "ok") & ~np.isfinite(found.x_px)] = "unfit"
    return np.where(status[:, None] != "ok", status[:, None], flag)


def _facts(found: _Found, numbering: Numbering, flag: NDArray[np.str_]) -> dict[str, Any]:
    comb = found.comb
    names, counts = np.unique(flag, return_counts=True)
    return {
        "ridges": comb.polarity,
        "ridge_fwhm_px": comb.fwhm_px,
        "pitch_px": comb.pitch_px,
        "contrast": comb.contrast,
        "profile_noise": comb.noise,
        "window_px": found.window_px,
        "sheets": len(numbering.n),
        "axis_px": numbering.axis_px,
        "axis_how": numbering.how,
        "axis_low_px": numbering.between_px[0],
        "axis_high_px": numbering.between_px[1],
        "least_margin": float(np.nan_to_num(np.nanmin(found.links.margin, initial=np.inf), posinf=1e9)),
        "ridges_dropped": found.links.model.dropped,
        "flag_counts": ", ".join(f"{name} {count}" for name, count in zip(names, counts, strict=True)),
    }


def _wide(x_px: Doubles) -> str:
    """Where a sheet may be missing: "748 px (1.9 pitches), ..."."""
    return ", ".join(f"{x:.0f} px ({size:.1f} pitches)" for x, size in zip(*wide_spacings(x_px), strict=True))


def _about(long_name: str, units: str = "") -> dict[str, str]:
    return {"long_name": long_name} | ({"units": units} if units else {})
