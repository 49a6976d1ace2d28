"""Track all sheets: from I(x, t) to x(n, t), for the whole strip and for parts of it at several heights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import xarray as xr

from vision.data import (
    PIXEL_SIZE_UM,
    STRIP_PARTS,
    TRACKS,
    StripMetadata,
    TrackMetadata,
    check_strip,
    record,
)
from vision.errors import InputError, NoRidgesError, check_number, check_within, check_word
from vision.memory import row_parts
from vision.numeric import (
    NORMAL_MEDIAN,
    Bools,
    Codes,
    Floats,
    Floats32,
    Ints,
    beside,
    median_step,
    nan_median,
    nan_quantile,
    typical_median,
    typical_where,
)
from vision.sheets.constant_shift import constant_shift
from vision.sheets.corrections import Correction, PossibleRidges, apply_corrections, last_of
from vision.sheets.distortion import (
    NO_LOCKING,
    PixelLocking,
    distortion,
    not_one_ridge,
    pixel_locking,
    two_in_one,
)
from vision.sheets.doubts import (
    LEAST_SCATTER,
    predicted_by_neighbours,
    seen_between,
    sheets_alike,
    unseen_jumps,
)
from vision.sheets.film import SecondComb, gap_depth, motion_blur, repeated_frames, second_comb
from vision.sheets.identities import WHYS, Doubt, identify_sheets
from vision.sheets.numbering import Numbering, number_sheets, placed
from vision.sheets.order import mixed_frames
from vision.sheets.recovery import FLAGS, Detections, Flag, assign_detections
from vision.sheets.reference import ReferenceComb, marks, rest_positions, wide_spacings
from vision.sheets.ridges import (
    RidgeComb,
    describe_ridges,
    find_faint,
    find_ridges,
    frames_with_values,
    no_ridges,
)
from vision.sheets.scatter import BetweenSlips, noise_excess, raise_left_behind, shared_error, spatial_scatter
from vision.sheets.settings import DEFAULT, QUARTER_PIXEL, TrackingSettings
from vision.sheets.subpixel import (
    WHOLE_LEVELS,
    FitChoice,
    FitName,
    choose_window,
    fit_sheets,
    intensity_noise,
    learned_template,
    noise_correlation,
    position_noise,
)
from vision.video.reader import BETWEEN_FRAMES, LOSSY
from vision.words import words

LEAST_ERROR_PX = 1e-4


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
    """Return the positions of all sheets in all frames.

    Parameters
    ----------
    strip
        I(x, t) from `vision.strip_profile`, (frame, x), grey levels, with coordinates x (px), time_s and
        status (without status, rows with NaN are "blank"). Its codec (`vision.data.StripMetadata`) decides
        whether errors are raised to the measured scatter.
    ridges
        Polarity of the ridges.
    sheets
        Number of sheets in view; None to find it.
    axis_px
        Symmetry axis; None to find it.
    fit
        "sliding", "paper" (exactly the publication's fit), "template", or "auto". "auto" uses the template
        for the sheets for which it is learned well, provided that these are most sheets, else "sliding".
    window_px
        Odd width of the fit window. None means 9 px for ridges 6–14 px wide without a flat top (with
        "paper" also for flat ones). For other ridges, and for "auto", the window follows their width.
    corrections
        Manual decisions from `vision.sheets.corrections.read_corrections`. Those about identities and about
        the axis are applied; the latter takes precedence over `axis_px`.
    settings
        Thresholds and costs.

    Returns
    -------
    xarray.Dataset
        x_px, x_err_px and flag (frame, sheet); side, n, x_mean_px, found, fwhm_px, snr, x_noise_px (sheet);
        time_s (frame); see `vision.data.TRACKS`. x_px is NaN unless flag is "ok" or "blurred". The other
        flags are "missing" (no ridge there), "merged" (several sheets, or a sheet and a mark, in one ridge),
        "edge" (outside the picture or too near its edge), "doubtful" (identity not certain), "unfit" (the fit
        fails, or an object that hides the next sheet cuts the ridge), and the state of the frame: "frozen",
        "blank", "corrupt" or "lost". `vision.data.TrackMetadata` holds what was found automatically.

    Raises
    ------
    InputError
        For a strip without a required variable, a constant picture, no ridges, fewer ridges than `sheets`,
        an impossible window, or an axis far from the picture.

    Notes
    -----
    x_err_px is the noise of the profile times the fit's error per grey level. It is larger where positions
    scatter by more (`vision.sheets.scatter.noise_excess`), where the ridge moves during the exposure
    (`vision.sheets.film.motion_blur`), and where the ridge is distorted
    (`vision.sheets.distortion.distortion`) or a second comb lies over the sheets
    (`vision.sheets.film.second_comb`). Positions of ridges sharper than their pixels are corrected for
    locking to whole pixels (`vision.sheets.distortion.pixel_locking`), except with ``fit="paper"``: x_err_px
    includes it. For lossy video it is the scatter between sheets, since compression hides the noise and adds
    its own artefacts. It does not include errors that are the same in all frames (`constant_error_px`: uneven
    light, neighbours that overlap, the choice of rows).
    """
    check_strip(strip)
    check_word(("bright", "dark", "auto"), ridges=ridges)
    check_word(get_args(FitChoice), fit=fit)
    check_number(axis_px=axis_px)
    check_within("a whole number from 1", 1, math.inf, whole=True, sheets=sheets)
    facts = StripMetadata.of(strip)
    profile = np.asarray(strip.values, np.float32)
    axis_decision = last_of(corrections, "axis")
    axis_px = axis_px if axis_decision is None else axis_decision.x_px
    _check(profile, facts.source)
    first_px, last_px = (float(x) for x in strip["x"].values[[0, -1]])
    check_axis(axis_px, first_px, last_px)
    comb = describe_ridges(profile, polarity=ridges, sheets=sheets, source=facts.source, settings=settings)
    window = choose_window(comb, window_px, fit=fit)
    number = strip["frame"].values

    detected = _detect(profile, comb, sheets, facts.source, corrections, number, first_px)
    detections = detected.detections
    frozen = repeated_frames(profile, settings)
    fitted = _fit(profile, detections.start_px, comb, fit, window, frozen)
    errors = _errors(profile, fitted, frozen, facts, settings)
    assessed = _assess_ridges(profile, fitted.x_px, errors, detected, frozen, comb)
    axis = None if axis_px is None else axis_px - first_px
    width = profile.shape[1]
    numbering = number_sheets(assessed.x_px, axis_px=axis, width_px=width, settings=settings)
    found = _Tracked(comb, detected, numbering, fitted, errors, assessed, frozen, first_px)
    likelier = ridges if ridges == "auto" else describe_ridges(profile, settings=settings).polarity
    metadata = replace(
        found.metadata(count_given=sheets is not None),
        ridges_likelier="" if likelier == ridges else likelier,
        window_px=window,
        fit_asked=fit,
        gap_depth=gap_depth(profile, assessed.x_px, comb),
        corrections_applied=len(corrections),
        noise_lasts=errors.lasting,
        mixed_frames=0.0 if facts.codec in BETWEEN_FRAMES else mixed_frames(profile, frozen, settings),
        **found.jumps(number),
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


class _Detected(NamedTuple):
    """The ridges of the sheets, the comb that they form, the least certain identity, nats, the share of the
    frames with ridges between most sheets, and which sheets a manual correction added, (N,)."""

    detections: Detections
    reference: ReferenceComb
    least_margin: float
    between: float
    added: Bools


def _detect(
    profile: Floats32,
    comb: RidgeComb,
    sheets: int | None,
    source: str,
    corrections: Sequence[Correction],
    frames: Ints,
    origin_px: float,
) -> _Detected:
    """Find and identify the ridges, and apply the manual corrections.
    frames: frame numbers in the film, (frame,). origin_px: column of the profile's first pixel."""
    ridges = find_ridges(profile, comb)
    if not ridges.count.any():
        raise no_ridges(profile, source)
    identities = identify_sheets(ridges, comb, sheets=sheets, source=source)
    detections = assign_detections(profile, ridges, identities, comb)
    by_hand = any(one.kind in ("add", "assign") for one in corrections)
    possible = PossibleRidges(ridges, find_faint(profile, comb) if by_hand else ridges)
    detections = apply_corrections(
        detections, possible, corrections, comb, frames=frames, origin_px=origin_px
    )
    added = np.zeros(detections.flag.shape[1], bool)
    for one in corrections:
        if one.kind == "add":
            away = np.abs(detections.start_px[frames == one.first] + origin_px - one.x_px)[0]
            added |= away <= comb.settings.faint_reach * comb.pitch_px
    margin = float(np.nanmin(identities.margin, initial=np.inf))
    between = seen_between(ridges, identities.match)
    return _Detected(detections, identities.reference, margin, between, added)


class _Assessed(NamedTuple):
    """Positions, flags and errors once blur, distortion and cut ridges are known, (frame, N); each sheet's
    rest position, the shift of all its positions by a distortion that lasts, and the relative error of its
    displacements, (N,); and a second comb over the sheets."""

    x_px: Floats
    flag: Codes
    err_px: Floats
    rest_px: Floats
    blurred: Bools
    distorted: Bools
    lasting_px: Floats
    scale: Floats
    second: SecondComb


def _assess_ridges(
    profile: Floats32, x_px: Floats, errors: _Errors, detected: _Detected, frozen: Bools, comb: RidgeComb
) -> _Assessed:
    """Find ridges that are blurred, cut or distorted, and those that are not the ridge of one sheet. What
    positions scatter beyond all these errors is added to them (`noise_excess`), and how far they lag where
    frames were averaged in time. Positions and errors are changed in place. A sheet that was added by hand is
    one, whatever its ridge looks like."""
    err, lasting, detections = errors.err_px, errors.lasting, detected.detections
    changing = _unrepeated(x_px, frozen)
    blurred, blur_px = motion_blur(changing, detections.contrast, detections.fwhm_px, comb)
    del changing
    smeared = (blur_px > 0) | blurred
    smears, blur2 = np.nonzero(blur_px), blur_px[blur_px != 0] ** 2  # few ridges
    del blur_px
    # An object that covers a sheet also cuts the next ridge, which may be off by half of its width.
    x_px[smeared & beside(detections.flag == Flag.MISSING) | _cut(detections, comb)] = np.nan
    distorted_px, usual_px, lasting_px, scale = distortion(
        profile, x_px, err, detections.fwhm_px, smeared, comb
    )
    rest_px = rest_positions(x_px)
    # images of the frames before are a second comb, which shifts positions by the lag
    second = SecondComb() if lasting else second_comb(profile, x_px, smeared, comb)
    not_a_sheet = not_one_ridge(profile, x_px, lasting_px, comb)
    not_a_sheet |= two_in_one(x_px, rest_px, detections.fwhm_px, comb)
    not_a_sheet |= marks(x_px, rest_px, err, np.hypot(lasting_px, usual_px), comb)
    not_a_sheet &= ~detected.added
    flag = np.where((detections.flag == Flag.OK) & not_a_sheet, np.uint8(Flag.MERGED), detections.flag)
    is_distorted = distorted_px > np.fmax(err, comb.settings.distortion_floor)
    np.square(err, out=err)
    err[smears] += blur2
    np.fmax(distorted_px, second.error_px, out=distorted_px)  # the shapes show part of it as well
    err += np.square(distorted_px, out=distorted_px)
    del distorted_px
    if lasting:
        lag = comb.settings.lag_error * lasting / (1 - lasting)
        moved = np.nan_to_num(np.diff(x_px, axis=0, prepend=x_px[:1]))
        err += lag**2 * np.fmax(moved**2 - 2 * err, typical_median(moved) ** 2)  # less noise; at least creep
    np.sqrt(err, out=err)
    usual = typical_where(np.isfinite(x_px), err)
    excess = noise_excess(BetweenSlips(_unrepeated(x_px, frozen)), err, comb.settings)
    np.hypot(err, np.nan_to_num(usual) * np.sqrt(np.fmax(excess**2 - 1.0, 0.0)), out=err)
    return _Assessed(x_px, flag, err, rest_px, blurred, is_distorted, lasting_px, scale, second)


def _cut(detections: Detections, comb: RidgeComb) -> Bools:
    """Return which ridges beside a missing sheet are lower or narrower than usual, beyond what light and
    focus change in all ridges of the frame, (frame, N): what hides that sheet cuts them as well. What is
    usual is measured where no sheet is missing beside."""
    changed = beside(detections.flag == Flag.MISSING)
    rows, alone = np.flatnonzero(changed.any(axis=1)), ~changed
    if not len(rows):
        return changed
    away = np.zeros((len(rows), changed.shape[1]))
    both = detections.contrast, detections.fwhm_px
    for sizes, least in zip(both, LEAST_SCATTER.ravel(), strict=True):
        usual = np.log(typical_where(alone, sizes))
        scatter = typical_where(alone, np.abs(np.log(sizes) - usual)) / NORMAL_MEDIAN
        off = np.log(sizes[rows].astype(np.float64)) - usual
        off -= nan_median(off, axis=1)[:, None]
        away += np.nan_to_num(np.minimum(off, 0.0) / np.fmax(scatter, least)) ** 2
    changed[rows] &= away > comb.settings.cut_sigmas**2
    return changed


def _unrepeated(x_px: Floats, frozen: Bools) -> Floats:
    """Return positions (frame, N), NaN in repeated frames."""
    return np.where(frozen[:, None], np.nan, x_px) if frozen.any() else x_px


class _Errors(NamedTuple):
    """Stated errors of positions (frame, N), for each sheet (N,) the noise measured from frame to frame, the
    scatter against neighbours and the error predicted from the pixels; all px; and `noise_correlation`."""

    err_px: Floats
    noise_px: Floats
    scatter_px: Floats
    predicted_px: Floats
    lasting: float


@dataclass(frozen=True)
class _Tracked:
    """Everything that the Dataset is made of, with positions relative to the strip's first column."""

    comb: RidgeComb
    detected: _Detected
    numbering: Numbering
    fitted: _Fitted
    errors: _Errors
    assessed: _Assessed
    frozen: Bools
    origin_px: float

    def metadata(self, *, count_given: bool) -> TrackMetadata:
        """Return what later stages need to know, with columns as in the picture."""
        comb, numbering, reference = self.comb, self.numbering, self.detected.reference
        unedited = len(reference.x_px) == len(numbering.n)  # no sheet was added or deleted manually
        # manual corrections may also have swapped sheets: sort
        positions = reference.x_px if unedited else np.sort(placed(typical_median(self.assessed.x_px)))
        wide = wide_spacings(positions, reference.dropped_px, settings=comb.settings)
        gaps = [] if count_given else zip(*wide, strict=True)
        decided_px = comb.settings.decided_sheets * comb.pitch_px
        return TrackMetadata(
            fit=self.fitted.fit,
            locking_px=self.fitted.locking.rms_px,
            locking_err_px=self.fitted.locking.error_px,
            ridges=comb.polarity,
            ridges_doubt=comb.doubt,
            ridges_alternate="yes" if comb.alternate else "no",
            sheets=len(numbering.n),
            sheets_how="given" if count_given else "found",
            ridge_fwhm_px=comb.fwhm_px,
            pitch_px=comb.pitch_px,
            spacing_px=float(nan_median(np.diff(np.sort(typical_median(self.assessed.x_px))))),
            contrast=comb.contrast,
            profile_noise=comb.noise,
            axis_px=numbering.axis_px + self.origin_px,
            axis_how=numbering.how,
            axis_low_px=numbering.low_px + self.origin_px,
            axis_high_px=numbering.high_px + self.origin_px,
            axis_open="no" if numbering.high_px - numbering.low_px <= decided_px else "yes",
            axis_carried=numbering.carried,
            axis_missing=numbering.missing,
            second_comb=self.assessed.second.depth,
            second_comb_err_px=self.assessed.second.error_px,
            least_margin=float(np.nan_to_num(self.detected.least_margin, posinf=1e9)),
            ridges_dropped=len(reference.dropped_px),
            ridges_beyond=reference.beyond,
            ridges_between=self.detected.between,
            wide_spacings=[f"{x + self.origin_px:.0f} px ({size:.1f} pitches)" for x, size in gaps],
        )

    def jumps(self, number: Ints) -> dict[str, Any]:
        """Return fields of `TrackMetadata` about jumps of the whole comb that the sheets may not show.
        number: of each frame in the film, (frame,)."""
        detections, assessed, comb = self.detected.detections, self.assessed, self.comb
        looks = assessed.rest_px, detections.contrast, detections.fwhm_px, comb
        alike = sheets_alike(*looks)
        step = median_step(np.where(np.isnan(assessed.x_px), detections.withheld_px, assessed.x_px))
        large = number[1:][np.abs(step) > comb.settings.step_fraction * comb.pitch_px]
        return {
            "sheets_alike": "yes" if alike else "no",
            "large_steps": large.tolist() if alike else [],
            "unseen_jumps": number[unseen_jumps(*looks)].tolist(),
        }


def _check(profile: Floats32, source: str) -> None:
    """Refuse a profile without usable frames, with too few columns, or without any contrast."""
    good = np.flatnonzero(frames_with_values(profile))
    if not len(good):
        raise InputError(source, "at least one usable frame", "none", "look at the frames' status")
    if profile.shape[1] < 8:
        raise InputError(source, "at least 8 columns", f"{profile.shape[1]}", "check `columns` and `rotate`")
    if all(np.ptp(profile[frame]) == 0 for frame in good):  # most films have contrast in the first frame
        raise NoRidgesError(source, "a picture with ridges", "a constant one", "check `rows` and `columns`")


def check_axis(axis_px: float | None, first_px: float, last_px: float) -> None:
    """Refuse an axis further outside the picture than the picture is wide; with one side in view it does lie
    outside."""
    width = last_px - first_px
    if axis_px is not None and not first_px - width <= axis_px <= last_px + width:
        near = f"a column near the picture ({first_px:.0f} to {last_px:.0f} px)"
        raise InputError("`axis_px`", near, f"{axis_px:g}", "give it in px, counted from the left")


class _Fitted(NamedTuple):
    """Positions and their errors from noise, px, (frame, N); error per grey level of noise, px, and noise of
    the profile, grey levels, of each sheet, (N,); the fit that was used, and its window; the locking to whole
    pixels that positions were corrected for."""

    x_px: Floats
    err_px: Floats
    per_grey: Floats
    noise: Floats
    fit: FitName
    window_px: int
    locking: PixelLocking


def _fit(
    profile: Floats32,
    start_px: Floats | Floats32,
    comb: RidgeComb,
    fit: FitChoice,
    window_px: int,
    frozen: Bools,
) -> _Fitted:
    """Fit all ridges, and measure the noise of the profile around them."""
    used: FitName = "sliding" if fit == "auto" else fit
    x, err = fit_sheets(profile, start_px, fit=used, window_px=window_px, comb=comb)
    noise = intensity_noise(profile, x, frozen, half_px=window_px // 2, fallback=comb.noise)
    noise[~(noise > 0)] = WHOLE_LEVELS  # no error is zero: a profile without noise has whole grey levels
    new, usual_px = _unrepeated(x, frozen), float(nan_median(typical_median(err) * noise))
    locking = NO_LOCKING if fit == "paper" else pixel_locking(new, comb.settings)
    if fit == "auto":
        matched, matched_err, learned = learned_template(profile, new, err, comb)
        if learned.any():
            matched_px = float(nan_median(typical_median(matched_err) * noise))
            other = pixel_locking(_unrepeated(matched, frozen), comb.settings)
            if _locks_less(other, matched_px, locking, usual_px):
                used, x, err, locking = "template", matched, matched_err, other
    per_grey = typical_median(err)
    err *= noise
    if locking.error_px:
        for rows in row_parts(len(x)):
            x[rows] -= locking.at(x[rows])
        np.hypot(err, locking.error_px, out=err)
    if fit == "paper":  # it locks to whole pixels by more than the noise, as the sliding window shows
        free, _ = fit_sheets(profile, start_px, fit="sliding", window_px=window_px, comb=comb)
        err = np.hypot(err, np.nan_to_num(np.abs(x - free)))
    return _Fitted(x, err, per_grey, noise, used, window_px, locking)


def _locks_less(template: PixelLocking, err_px: float, window: PixelLocking, window_err_px: float) -> bool:
    """Return whether the template is better than the sliding window as far as locking to pixels is concerned.
    Of ridges sharper than their pixels the mean shape is wrong, and locks more than the window does."""
    if template is NO_LOCKING:
        return True
    less = template.rms_px <= np.hypot(window.rms_px, err_px)
    better = np.hypot(err_px, template.error_px) <= np.hypot(window_err_px, window.error_px)
    return bool(less and better)


def _errors(
    profile: Floats32, fitted: _Fitted, frozen: Bools, facts: StripMetadata, settings: TrackingSettings
) -> _Errors:
    """Return the stated errors, and what was predicted from the pixels and measured from the positions.

    The prediction from the pixels holds where their noise is independent. Where a camera sharpens, it is too
    large; positions then scatter less (`noise_excess`), and the error is reduced. Compression hides the noise
    of pixels and shifts ridges for several frames: the scatter between sheets shows this, and `shared_error`
    adds what neighbours share if the codec predicts frames from others. Where sheets are too few for that, or
    nothing changes, such a codec is assumed to err by a rounding to quarter pixels. What its quantiser leaves
    behind is the least error (`raise_left_behind`), and limits what of the scatter is the codec's. Repeated
    frames are left out, as they would hide scatter. The errors of the fit are changed in place.
    """
    new = _unrepeated(fitted.x_px, frozen)
    between_frames = facts.codec in BETWEEN_FRAMES
    noise_px = position_noise(fitted.x_px[~frozen] if frozen.any() else fitted.x_px)
    positions = BetweenSlips(new)
    scatter_px = spatial_scatter(positions, between_frames=between_frames)
    err = fitted.err_px
    predicted = np.maximum(typical_where(np.isfinite(new), err), LEAST_ERROR_PX)  # NaN without positions
    rounding = QUARTER_PIXEL if between_frames else 0.0
    measured = np.where(scatter_px > 0, scatter_px, np.hypot(np.fmax(noise_px, predicted), rounding))
    lasting = 0.0
    if between_frames:  # all sheets share one quantiser
        measured = np.full_like(measured, np.hypot(nan_median(measured), shared_error(positions)))
    elif facts.codec not in LOSSY:  # whose artefacts last while ridges creep over them
        half_px, least = fitted.window_px // 2, settings.lasting_noise
        lasting = noise_correlation(profile, fitted.x_px, frozen, half_px=half_px, least=least)
        excess = float(nan_median(noise_excess(positions, err, settings)))
        # Locking to whole pixels lasts, and scatters less than the error that contains it.
        measured = predicted * (1.0 if fitted.fit == "paper" else min(1.0, settings.sharpened * excess))
    step_px = facts.quantiser_step * fitted.per_grey
    if facts.quantiser_step:  # what sheets that slip each in its own way scatter beyond that is their motion
        measured = np.fmin(measured, np.hypot(predicted, settings.left_behind[1] * step_px))
    err *= np.nan_to_num(measured / predicted, nan=1.0)
    if facts.quantiser_step:
        raise_left_behind(err, new, step_px, settings)
    return _Errors(np.maximum(err, LEAST_ERROR_PX, out=err), noise_px, scatter_px, predicted, lasting)


def _dataset(strip: xr.DataArray, found: _Tracked, metadata: TrackMetadata) -> xr.Dataset:
    """Assemble the Dataset that `track_sheets` returns; positions and errors are changed in place."""
    detections, errors, assessed = found.detected.detections, found.errors, found.assessed
    flag = _flags(strip, found)
    ok = (flag == Flag.OK) | (flag == Flag.BLURRED)
    x, err = assessed.x_px, assessed.err_px
    x[~ok] = err[~ok] = np.nan
    profile = np.asarray(strip.values, np.float32)
    withheld_px = detections.withheld_px
    withheld_px += np.float32(found.origin_px)  # whole pixels
    shift = constant_shift(profile, x, metadata.window_px, found.comb)
    x += found.origin_px
    why = np.where(flag == Flag.DOUBTFUL, detections.why, np.uint8(Doubt.NONE))
    values: dict[str, Any] = {
        "x_px": x,
        "x_err_px": err,
        "flag": words(flag, FLAGS),
        "why": words(why, WHYS),
        "x_withheld_px": withheld_px,
        "x_expected_px": predicted_by_neighbours(x),
        "x_mean_px": nan_median(x),
        "found": ok.mean(axis=0),
        "fwhm_px": typical_where(ok, detections.fwhm_px),
        "snr": typical_where(ok, detections.contrast) / np.maximum(found.fitted.noise, 1e-12),
        "distorted": (assessed.distorted & ok).sum(axis=0) / np.maximum(ok.sum(axis=0), 1),
        "x_lasting_px": assessed.lasting_px,
        "x_overlap_px": shift.overlap,
        "x_light_px": shift.light,
        "x_shape_px": shift.shape,
        "constant_error_px": np.hypot(StripMetadata.of(strip).strip_err_px, shift.size_px),
        "misscaled": assessed.scale,
        "x_noise_px": errors.noise_px,
        "x_scatter_px": errors.scatter_px,
        "x_predicted_px": errors.predicted_px,
        "time_s": strip["time_s"].values,
        "side": found.numbering.side,
        "n": found.numbering.n,
    }
    variables = TRACKS.declared(values)
    coords = {name: variables.pop(name) for name in ("time_s", "side", "n")}
    index = {"frame": strip["frame"].values, "sheet": np.arange(x.shape[1])}
    of_film = {name: fact for name, fact in strip.attrs.items() if name not in ("long_name", "units")}
    return xr.Dataset(variables, index | coords, of_film | metadata.attrs())


def _flags(strip: xr.DataArray, found: _Tracked) -> Codes:
    """Return OK or the reason why there is no position; the state of the frame takes precedence."""
    flag = found.assessed.flag.copy()
    flag[(flag == Flag.OK) & ~np.isfinite(found.assessed.x_px)] = Flag.UNFIT
    flag[(flag == Flag.OK) & found.assessed.blurred] = Flag.BLURRED
    flag[found.frozen] = Flag.FROZEN
    if "status" in strip.coords:
        for status in ("blank", "corrupt", "lost"):
            flag[strip["status"].values == status] = Flag[status.upper()]
    else:
        flag[~frames_with_values(strip.values)] = Flag.BLANK
    return flag


# --- from tracks to more ------------------------------------------------------------------------------------


def comb_is_stationary(tracks: xr.Dataset, settings: TrackingSettings) -> bool:
    """Return whether hardly any sheet moves relative to the comb; False for fewer than three sheets."""
    x = tracks["x_px"].values
    moved = x - typical_median(x)
    moved -= nan_median(moved, axis=1)[:, None]
    # not the scatter from frame to frame: it contains slips
    noise = typical_median(tracks["x_err_px"].values)
    moving = nan_quantile(np.abs(moved, out=moved), 0.95) > settings.still_sigmas * noise
    return bool(moving.mean() < settings.still_share) and x.shape[1] >= 3


def with_heights(
    tracks: xr.Dataset, parts: xr.DataArray, *, settings: TrackingSettings = DEFAULT
) -> xr.Dataset:
    """Add positions at several heights to tracks, with the identities and flags of the whole strip.

    Parameters
    ----------
    tracks
        Tracks of the whole strip, from `vision.track_sheets`.
    parts
        Profiles of its parts, (z, frame, x), from `vision.video.strip_profiles`.
    settings
        Thresholds.

    Returns
    -------
    xarray.Dataset
        The tracks with x_z_px and x_z_err_px (frame, sheet, z) and the coordinate z (px from the top).
        Positions are NaN where the strip has none, and where a part's fit fails within half a window of it.

    Raises
    ------
    InputError
        If tracks and parts have different frames.

    Notes
    -----
    Each part is fitted as the strip was, starting from the strip's position. The error in a part is the noise
    of its pixels times the fit's error per grey level. For each sheet it is enlarged by the same factor as
    the error in the strip (compression).
    """
    TRACKS.check(tracks, ("x_px", "x_err_px", "flag", "time_s"))
    STRIP_PARTS.check(parts)
    if not np.array_equal(tracks["frame"].values, parts["frame"].values):
        raise InputError("the parts of the strip", "the tracks' frames", "others", "use those of one reading")
    facts = TrackMetadata.of(tracks)
    comb = RidgeComb.of(facts, parts.sizes["x"], settings)
    start = np.rint(tracks["x_px"].values - float(parts["x"].values[0]))
    fit: FitChoice = "auto" if facts.fit == "template" else "paper" if facts.fit == "paper" else "sliding"
    x = np.empty((*start.shape, parts.sizes["z"]))
    err = np.empty_like(x)
    for k, part in enumerate(np.asarray(parts.values, np.float32)):
        frozen = repeated_frames(part, settings)
        fitted = _fit(part, start, comb, fit, facts.window_px, frozen)
        x[..., k], err[..., k] = fitted.x_px, fitted.err_px
    if "x_predicted_px" in tracks:
        stated = nan_median(tracks["x_err_px"].values) / tracks["x_predicted_px"].values
        err *= np.fmax(stated, 1.0)[:, None]
    found = {"x_z_px": x + float(parts["x"].values[0]), "x_z_err_px": err}
    return record(tracks.assign(TRACKS.declared(found)).assign_coords(z=parts["z"]), "with_heights")


def pixel_size_of(
    tracks: xr.Dataset, *, pixel_size_um: float | None = None, pitch_um: float | None = None
) -> float | None:
    """Return µm per pixel: as given, from the pitch, or as the film's file states it; None without.

    The pitch is the mean distance between neighbouring sheets at rest. It is divided by the mean spacing of
    the median positions, without spacings wider than 1.5 median ones. The mean is used, not the median: mean
    spacings add up to the width of the comb, in which the errors of single positions cancel.

    Raises
    ------
    InputError
        For a pitch that is not positive, or fewer than two neighbouring sheets.
    """
    if pitch_um is None:
        stated = StripMetadata.of(tracks).file_pixel_size_um
        plausible = PIXEL_SIZE_UM[0] <= stated <= PIXEL_SIZE_UM[1]  # not for NaN
        return pixel_size_um if pixel_size_um is not None or not plausible else stated
    if not 0 < pitch_um < np.inf:
        raise InputError("`pitch_um`", "a positive length in µm", f"{pitch_um:g}")
    spacing = np.diff(nan_median(tracks["x_px"].values))
    spacing = spacing[np.isfinite(spacing)]
    near = spacing[spacing < 1.5 * np.median(spacing)] if spacing.size else spacing
    if not near.size:
        raise InputError("`pitch_um`", "at least two neighbouring sheets", f"{tracks.sizes['sheet']} in view")
    return float(pitch_um / near.mean())
