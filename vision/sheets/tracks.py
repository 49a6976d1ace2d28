"""I(x, t) becomes x(n, t): in the whole strip, and in parts of it one above the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr

from vision.data import STRIP, STRIP_PARTS, TRACKS, StripMetadata, TrackMetadata, record
from vision.errors import InputError
from vision.numeric import Bools, Floats, Floats32, Strings, nan_median
from vision.sheets.corrections import Correction, apply_corrections, last_of
from vision.sheets.distortion import distortion, not_one_ridge, shift_by_lamp
from vision.sheets.identities import Identities, identify_sheets
from vision.sheets.neighbours import said_by_neighbours
from vision.sheets.numbering import Numbering, number_sheets
from vision.sheets.quality import (
    BetweenSlips,
    beside_missing,
    motion_blur,
    repeated_frames,
    scene_changes,
    shared_error,
    spatial_scatter,
)
from vision.sheets.recovery import Detections, assign_detections
from vision.sheets.reference import marks, wide_spacings
from vision.sheets.ridges import RidgeComb, describe_ridges, find_ridges, no_ridges
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.sheets.subpixel import (
    FitChoice,
    FitName,
    choose_window,
    fit_sheets,
    intensity_noise,
    learned_template,
    locking_error,
    position_noise,
)

_MPEG = {"mpeg1video", "mpeg2video", "mpeg4", "h261", "h263", "h264", "hevc", "vvc"}
_OTHERS = {"av1", "vp3", "vp6", "vp7", "vp8", "vp9", "theora", "flv1", "rv30", "rv40", "svq3", "cinepak"}
_MICROSOFT = {"msmpeg4v1", "msmpeg4v2", "msmpeg4v3", "wmv1", "wmv2", "wmv3", "vc1", "msvideo1"}
BETWEEN_FRAMES = frozenset(_MPEG | _OTHERS | _MICROSOFT)
"""Codecs that carry a picture's content, and with it errors, from frame to frame."""
LOSSY = BETWEEN_FRAMES | {"mjpeg", "mjpegb", "amv", "jpeg2000", "dvvideo", "dnxhd", "prores", "cfhd"}


def track_sheets(
    strip: xr.DataArray,
    *,
    ridges: Literal["bright", "dark", "auto"] = "auto",
    sheets: int | None = None,
    axis_px: float | None = None,
    fit: FitChoice = "auto",
    window_px: int | Literal["auto"] | None = None,
    corrections: Sequence[Correction] = (),
    settings: TrackingSettings = DEFAULT,
) -> xr.Dataset:
    """Positions of all sheets in all frames.

    Parameters
    ----------
    strip
        I(x, t) from `vision.strip_profile`, (frame, x), grey levels, with coordinates x (px), time_s and
        status (without it, rows with NaN are "blank"). Its codec (`vision.data.StripMetadata`) decides
        whether errors are raised to the scatter.
    ridges
        Polarity of the ridges.
    sheets
        Number in view, found if None.
    axis_px
        Symmetry axis, found if None.
    fit
        "sliding", "paper" (the publication's, exactly), "template", or "auto": the template for the sheets
        for which it is learned well if these are most of them, else sliding.
    window_px
        Odd fit window; None is 9 where the ridges are 6–14 px wide, else, as with "auto", it follows their
        width.
    corrections
        Decisions by hand, from `vision.sheets.corrections.read_corrections`: those about identities, and of
        the axis, which goes before `axis_px`.
    settings
        Thresholds and costs.

    Returns
    -------
    xarray.Dataset
        x_px, x_err_px and flag (frame, sheet); side, n, x_mean_px, found, fwhm_px, snr, x_noise_px (sheet);
        time_s (frame); see `vision.data.TRACKS`. x_px is NaN wherever flag is neither "ok" nor "blurred":
        "missing" (no ridge there), "merged" (several sheets in one ridge), "edge" (outside the picture or too
        near its edge), "doubtful" (identity not certain), "unfit" (the fit has no answer, or what hides
        the next sheet cuts the ridge), or the frame's own "frozen", "blank", "corrupt", "lost". What was
        found automatically is in `vision.data.TrackMetadata`.

    Raises
    ------
    InputError
        For a strip that lacks something, a constant picture, no ridges, fewer ridges than `sheets`, an
        impossible window, or an axis far from the picture.

    Notes
    -----
    x_err_px is the noise of the profile times the fit's error per grey level, enlarged where positions
    scatter by more both in time and between sheets, where the ridge moves within the exposure
    (`vision.sheets.quality.motion_blur`), where something pulls it aside
    (`vision.sheets.distortion.distortion`) and where light moves over the whole comb; with ``fit="paper"``
    also the locking to whole pixels. For lossy video it is the scatter between sheets, since compression
    hides the noise and adds artefacts of its own. What is the same in all frames (uneven light, the choice of
    rows) is no part of it.
    """
    STRIP.check(strip)
    facts = StripMetadata.of(strip)
    profile = np.asarray(strip.values, np.float32)
    _check(profile, facts.source)
    origin_px = float(strip["x"].values[0])
    decided = last_of(corrections, "axis")
    axis_px = axis_px if decided is None else decided.x_px
    _check_axis(axis_px, origin_px, float(strip["x"].values[-1]))
    comb = describe_ridges(profile, polarity=ridges, sheets=sheets, source=facts.source, settings=settings)
    window = choose_window(comb, window_px, settings=settings)
    candidates = find_ridges(profile, comb, settings=settings)
    if not candidates.count.any():
        raise no_ridges(profile, facts.source)
    identities = identify_sheets(
        candidates, comb, width_px=profile.shape[1], sheets=sheets, source=facts.source, settings=settings
    )
    detections = assign_detections(profile, candidates, identities, comb, settings=settings)
    detections = apply_corrections(
        detections,
        candidates,
        corrections,
        comb,
        frames=strip["frame"].values,
        origin_px=origin_px,
        settings=settings,
    )
    frozen = repeated_frames(profile, settings)
    x, err, noise, used = _positions(profile, detections.start_px, comb, fit, window, frozen, settings)
    errors = _errors(x, err, noise, frozen, facts.codec, settings)
    judged = _judged(comb.bright(profile), x, errors, detections, frozen, comb, settings)
    x, detections = judged.x_px, replace(detections, flag=judged.flag)
    axis = None if axis_px is None else axis_px - origin_px
    numbering = number_sheets(x, axis_px=axis, settings=settings)
    found = _Tracked(
        comb=comb,
        identities=identities,
        detections=detections,
        numbering=numbering,
        x_px=x,
        err_px=judged.err_px,
        noise=noise,
        errors=errors,
        frozen=frozen,
        blurred=judged.blurred,
        distorted=judged.distorted,
        origin_px=origin_px,
    )
    metadata = found.metadata(used, window, settings, count_given=sheets is not None)
    number = strip["frame"].values
    changes = scene_changes(detections.start_px, detections.contrast, comb, settings)
    metadata = replace(
        metadata,
        fit_asked=fit,
        corrections_applied=len(corrections),
        scene_changes=[change._asdict() | {"frame": int(number[change.frame])} for change in changes],
    )
    return record(
        _dataset(strip, found, metadata),
        "track_sheets",
        ridges=ridges,
        sheets=sheets,
        axis_px=axis_px,
        fit=fit,
        window_px=window_px,
        corrections=[asdict(correction) for correction in corrections],
        settings=asdict(settings),
    )


class _Judged(NamedTuple):
    """Positions without those that are cut, flags, errors with what is more than noise, and what of it shows,
    all (frame, N)."""

    x_px: Floats
    flag: Strings
    err_px: Floats
    blurred: Bools
    distorted: Bools


def _judged(
    bright: Floats32,
    x_px: Floats,
    errors: _Errors,
    detections: Detections,
    frozen: Bools,
    comb: RidgeComb,
    settings: TrackingSettings,
) -> _Judged:
    """What moved while the shutter was open, what is pulled aside, and what is no ridge of one sheet."""
    changing = np.where(frozen[:, None], np.nan, x_px)
    blur = motion_blur(changing, detections.contrast, detections.fwhm_px, comb, settings)
    smeared = (blur.err_px > 0) | blur.blurred
    x_px = np.where(smeared & beside_missing(detections.flag), np.nan, x_px)
    pulled = distortion(bright, x_px, errors.err_px, smeared, comb, settings)
    lamp = shift_by_lamp(x_px, detections.contrast, comb, settings)
    several = not_one_ridge(bright, x_px, comb, settings)
    several |= nan_median(pulled) > settings.most_pulled * comb.fwhm_px
    several |= marks(x_px, errors.err_px, pulled, comb, settings)
    flag = np.where((detections.flag == "ok") & several, "merged", detections.flag)
    err = np.sqrt(errors.err_px**2 + blur.err_px**2 + pulled**2 + lamp**2)
    return _Judged(x_px, flag, err, blur.blurred, pulled > 0)


class _Errors(NamedTuple):
    """Errors of positions (frame, N), and by sheet (N,) what they come from, all px."""

    err_px: Floats
    noise_px: Floats
    scatter_px: Floats
    predicted_px: Floats


@dataclass(frozen=True, kw_only=True)
class _Tracked:
    """Everything the Dataset is made of; columns counted from the strip's first. Of frames (frame,): frozen;
    of sheets (N,): noise, grey levels; of both: x_px, err_px, blurred, distorted."""

    comb: RidgeComb
    identities: Identities
    detections: Detections
    numbering: Numbering
    x_px: Floats
    err_px: Floats
    noise: Floats
    errors: _Errors
    frozen: Bools
    blurred: Bools
    distorted: Bools
    origin_px: float

    def metadata(
        self, fit: FitName, window_px: int, settings: TrackingSettings, *, count_given: bool
    ) -> TrackMetadata:
        """What later stages need to know; columns counted as in the picture."""
        comb, numbering, reference = self.comb, self.numbering, self.identities.reference
        counted = len(reference.x_px) == self.x_px.shape[1]  # else sheets were added or deleted by hand
        places = reference.x_px if counted else np.sort(nan_median(self.x_px))  # they may be swapped
        gaps = [] if count_given else zip(*wide_spacings(places, settings=settings), strict=True)
        least_margin = np.nanmin(self.identities.margin, initial=np.inf)
        return TrackMetadata(
            fit=fit,
            window_px=window_px,
            ridges=comb.polarity,
            sheets=len(numbering.n),
            ridge_fwhm_px=comb.fwhm_px,
            pitch_px=comb.pitch_px,
            contrast=comb.contrast,
            profile_noise=comb.noise,
            axis_px=numbering.axis_px + self.origin_px,
            axis_how=numbering.how,
            axis_low_px=numbering.low_px + self.origin_px,
            axis_high_px=numbering.high_px + self.origin_px,
            least_margin=float(np.nan_to_num(least_margin, posinf=1e9)),
            ridges_dropped=reference.dropped,
            ridges_beyond=reference.beyond,
            wide_spacings=[f"{x + self.origin_px:.0f} px ({size:.1f} pitches)" for x, size in gaps],
        )


def _check(profile: Floats32, source: str) -> None:
    good = np.flatnonzero(np.isfinite(profile).all(axis=1))
    if not len(good):
        raise InputError(source, "at least one usable frame", "none", "look at the frames' status")
    if profile.shape[1] < 8:
        raise InputError(source, "at least 8 columns", f"{profile.shape[1]}", "check `columns` and `rotate`")
    if all(np.ptp(profile[frame]) == 0 for frame in good):  # the first frame of most films is not
        raise InputError(source, "a picture with ridges", "a constant one", "check `rows` and `columns`")


def _check_axis(axis_px: float | None, first_px: float, last_px: float) -> None:
    """With one side in view the axis lies outside the picture, but no further than the picture is wide."""
    wide = last_px - first_px
    if axis_px is not None and not first_px - wide <= axis_px <= last_px + wide:
        near = f"a column near the picture ({first_px:.0f} to {last_px:.0f} px)"
        raise InputError("`axis_px`", near, f"{axis_px:g}", "give it in px")


def _positions(
    profile: Floats32,
    start_px: Floats,
    comb: RidgeComb,
    fit: FitChoice,
    window_px: int,
    frozen: Bools,
    settings: TrackingSettings,
) -> tuple[Floats, Floats, Floats, FitName]:
    """Positions and their standard error (frame, N), the profile's noise at each sheet (N,), the fit used."""
    bright = comb.bright(profile)
    used: FitName = "sliding" if fit == "auto" else fit
    x, per_grey = fit_sheets(bright, start_px, fit=used, window_px=window_px, comb=comb)
    new = ~frozen if frozen.any() else slice(None)  # without a copy of all frames
    noise = intensity_noise(profile[new], x[new], half_px=window_px // 2, fallback=comb.noise)
    if fit == "auto":
        usable = np.where(frozen[:, None], np.nan, x)
        matched, matched_per_grey, learned = learned_template(
            bright, usable, per_grey, comb, settings=settings
        )
        if learned.any():
            used, x, per_grey = "template", matched, matched_per_grey
    err = per_grey * noise
    if fit == "paper":
        err = np.hypot(err, locking_error(x, bright, start_px, window_px, comb))
    return x, err, noise, used


def _errors(
    x: Floats, err: Floats, noise: Floats, frozen: Bools, codec: str, settings: TrackingSettings
) -> _Errors:
    """Predicted from the pixels, measured in time and between sheets, and what is stated.

    What the pixels predict holds where their noise is independent. Noise alike in neighbouring pixels (a soft
    lens, clipped tops) shifts ridges by more, in time and between sheets: the smaller of both counts, over
    all sheets, since motion of its own in time or in n is no error. Compression hides the noise of pixels and
    shifts ridges for some frames: the scatter between sheets sees that, and `shared_error` what codecs do to
    neighbours alike. Repeated frames, which would hide scatter, are left out. Never zero: a profile without
    noise still holds whole grey levels.
    """
    new = np.where(frozen[:, None], np.nan, x)
    between_frames = codec in BETWEEN_FRAMES
    positions = BetweenSlips(new)
    noise_px = position_noise(x[~frozen])
    scatter_px = spatial_scatter(positions, between_frames=between_frames)
    with np.errstate(divide="ignore", invalid="ignore"):
        per_grey = err / noise
    whole_levels = 0.05  # grey: noise of a profile drawn without any, averaged over some rows
    err = np.where(np.isfinite(err) & (err > 0), err, whole_levels * np.nan_to_num(per_grey, nan=1.0))
    err = np.maximum(err, 1e-4)
    predicted = nan_median(np.where(np.isfinite(new), err, np.nan))
    measured = np.where(np.isfinite(scatter_px), scatter_px, np.fmax(noise_px, predicted))
    known = np.isfinite(measured)
    if between_frames and known.any():  # one quantiser for all sheets
        measured = np.full_like(measured, np.sqrt(np.mean(measured[known] ** 2)))
    if codec in LOSSY:
        measured = np.hypot(measured, shared_error(positions, between_frames=between_frames))
    else:
        more = nan_median(np.minimum(noise_px, scatter_px) / predicted)
        measured = predicted * (np.fmax(more, 1.0) if more < settings.most_correlated else 1.0)
    stated = err * np.nan_to_num(measured / predicted, nan=1.0)
    return _Errors(np.maximum(stated, 1e-4), noise_px, scatter_px, predicted)


def _dataset(strip: xr.DataArray, found: _Tracked, metadata: TrackMetadata) -> xr.Dataset:
    flag = _flags(strip, found)
    ok = (flag == "ok") | (flag == "blurred")
    x = np.where(ok, found.x_px, np.nan) + found.origin_px
    contrast = np.where(ok, found.detections.contrast, np.nan)
    values: dict[str, Any] = {
        "x_px": x,
        "x_err_px": np.where(ok, found.err_px, np.nan),
        "flag": flag,
        "why": np.where(flag == "doubtful", found.detections.why, ""),
        "x_withheld_px": found.detections.withheld_px + found.origin_px,
        "x_expected_px": said_by_neighbours(x),
        "x_mean_px": nan_median(x),
        "found": ok.mean(axis=0),
        "fwhm_px": nan_median(np.where(ok, found.detections.fwhm_px, np.nan)),
        "snr": nan_median(contrast) / np.maximum(found.noise, 1e-12),
        "distorted": (found.distorted & ok).sum(axis=0) / np.maximum(ok.sum(axis=0), 1),
        "x_noise_px": found.errors.noise_px,
        "x_scatter_px": found.errors.scatter_px,
        "x_predicted_px": found.errors.predicted_px,
        "time_s": strip["time_s"].values,
        "side": found.numbering.side,
        "n": found.numbering.n,
    }
    variables = {name: (TRACKS[name].dims, data, TRACKS[name].attrs) for name, data in values.items()}
    coords = {name: variables.pop(name) for name in ("time_s", "side", "n")}
    places = {"frame": strip["frame"].values, "sheet": np.arange(x.shape[1])}
    of_film = {name: fact for name, fact in strip.attrs.items() if name not in ("long_name", "units")}
    return xr.Dataset(variables, places | coords, of_film | metadata.attrs())


def _flags(strip: xr.DataArray, found: _Tracked) -> Strings:
    """Why there is no position, or "ok"; the frame's own state goes first."""
    if "status" in strip.coords:
        status = np.asarray(strip["status"].values).astype("<U8")
    else:
        status = np.where(np.isfinite(strip.values).all(axis=1), "ok", "blank").astype("<U8")
    flag = found.detections.flag.copy()
    flag[(flag == "ok") & ~np.isfinite(found.x_px)] = "unfit"
    flag[(flag == "ok") & found.blurred] = "blurred"
    flag[found.frozen] = "frozen"
    return np.where(status[:, None] != "ok", status[:, None], flag)


# --- from tracks to more ------------------------------------------------------------------------------------


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
    TRACKS.check(tracks, ("x_px", "x_err_px", "flag", "time_s"))
    STRIP_PARTS.check(parts)
    if not np.array_equal(tracks["frame"].values, parts["frame"].values):
        raise InputError("the parts of the strip", "the tracks' frames", "others", "use those of one reading")
    facts = TrackMetadata.of(tracks)
    comb = RidgeComb.of(facts)
    start = np.rint(tracks["x_px"].values - float(parts["x"].values[0]))
    fit: FitChoice = "auto" if facts.fit == "template" else "paper" if facts.fit == "paper" else "sliding"
    x = np.empty((*start.shape, parts.sizes["z"]))
    err = np.empty_like(x)
    for k, part in enumerate(np.asarray(parts.values, np.float32)):
        frozen = repeated_frames(part, settings)
        x[..., k], err[..., k], *_ = _positions(part, start, comb, fit, facts.window_px, frozen, settings)
    if "x_predicted_px" in tracks:
        stated = nan_median(tracks["x_err_px"].values) / tracks["x_predicted_px"].values
        err *= np.fmax(stated, 1.0)[:, None]
    found = {"x_z_px": x + float(parts["x"].values[0]), "x_z_err_px": err}
    variables = {name: (TRACKS[name].dims, data, TRACKS[name].attrs) for name, data in found.items()}
    return record(tracks.assign(variables).assign_coords(z=parts["z"]), "with_heights")


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
    near = spacing[spacing < 1.5 * np.median(spacing)] if spacing.size else spacing
    if not near.size:
        raise InputError("`pitch_um`", "at least two neighbouring sheets", f"{tracks.sizes['sheet']} in view")
    return float(pitch_um / near.mean())
