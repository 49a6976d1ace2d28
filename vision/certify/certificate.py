"""Measure what a recording can resolve, on similar films whose truth is known."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.certify.encoder import Encoder, read_encoder
from vision.certify.likeness import Likeness, learn, smooth_motion
from vision.certify.settings import CertifySettings
from vision.clock import Clock
from vision.data import STIFF_BELOW, StripMetadata, TrackMetadata, parameters_of
from vision.deformation import horizontal_deformation
from vision.errors import InputError
from vision.files import Progress
from vision.folder import from_json
from vision.numeric import Bools, Floats, Ints, nan_median, rms
from vision.run.reading import RunFolder, read_strip
from vision.sheets import Correction, TrackingSettings, track_sheets
from vision.sheets.scatter import BetweenSlips, spatial_scatter
from vision.sheets.subpixel import FitChoice, position_noise
from vision.video.reader import BETWEEN_FRAMES

Tracker = Callable[[xr.DataArray], xr.Dataset]  # `track_sheets` with the parameters of a run


@dataclass(frozen=True, kw_only=True)
class Threshold:
    """Measured σ_x/Λ_st of films in which its true value is the threshold for every sheet."""

    ratio: float  # the threshold
    # mean of the measured ratio over the true one, less 1, with and without noise correction
    bias: float
    raw_bias: float
    scatter: float  # standard deviation of single measurements over the true ratio
    stated: float  # median stated error over the true ratio
    called_stiff: float  # share of the sheets called stiff, one half without a bias


@dataclass(frozen=True, kw_only=True)
class StickPhases:
    """What the results about σ_x/Λ_st need besides the pixel size: events, clock, and the threshold."""

    sticks: pd.DataFrame
    clock: Clock
    threshold: float = STIFF_BELOW


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What a recording can resolve."""

    source: str  # the video
    codec: str
    fit: str  # the subpixel fit used
    frames: int  # of a film
    films: int
    pixel_size_um: float | None  # if known
    # One row per sheet: index, side, n, x_px, error_px (RMS random error of a position), stated_px (median
    # x_err_px), within_error (share of positions within it), found, locking_px (peak to peak),
    # sweep_error_px and smallest_sweep_px (in a stick phase).
    sheets: pd.DataFrame
    error_px: float  # RMS over all sheets
    within_error: float  # shares of positions within their error, and found
    found: float
    wrong: int  # positions called ok that are wrong by more than half a pitch
    locking_px: float  # error that repeats with the fraction of a pixel, peak to peak, median over sheets
    smallest_sweep_px: float  # median over sheets
    errors_resolved: float  # number of standard errors by which the smallest sweep differs from zero
    stick_frames: float  # number of frames of a stick phase; NaN, like the sweep, if slips are too frequent
    largest_jump_pitches: float  # of a sheet from frame to frame
    identity_margin: float  # largest multiple of the recording's motion tracked without a wrong identity
    identity_tried: float  # largest multiple that was tested
    threshold: Threshold | None  # None without stick phases or pixel size
    warnings: tuple[str, ...]  # what the certificate does not cover
    encoding: str = ""  # how films were encoded again; "" if they have the recording's residuals
    uncertain: bool = False  # whether the recording contains something that the films do not reproduce well

    @property
    def facts(self) -> dict[str, Any]:
        """All fields but the table of sheets, for certificate.json."""
        return {name: value for name, value in vars(self).items() if name != "sheets"}


@dataclass(frozen=True)
class _Measured:
    """Errors of one film and stated errors, (frame, true sheet), px, NaN if not ok; wrong positions; and how
    far the errors scatter, px, without motion that was left as measured."""

    error_px: Floats
    stated_px: Floats
    wrong: int
    scatter_px: float


def certify_run(
    run: RunFolder, *, settings: CertifySettings = CertifySettings(), progress: Progress | None = None
) -> Certificate:
    """Return the certificate of a finished run, using its events and clock if it has them.

    Raises: InputError for a run without a video, or with sheets in too few frames.
    """
    clock, sticks, strip = run.clock, run.events, read_strip(run)
    phases = None
    if sticks is not None and clock is not None and clock.status != "ambiguous":
        phases = StickPhases(sticks=sticks, clock=clock, threshold=run.threshold)
    return certify(
        strip,
        run.tracks,
        pixel_size_um=run.pixel_size_um,
        phases=phases,
        encoder=_encoder(run, strip, settings),
        settings=settings,
        progress=progress,
    )


def _encoder(run: RunFolder, strip: xr.DataArray, settings: CertifySettings) -> Encoder | None:
    """Return how the run's film was encoded, if it exists and its codec predicts frames from others."""
    facts = StripMetadata.of(strip)
    if facts.codec not in BETWEEN_FRAMES:
        return None
    try:
        film = run.input("film")
    except InputError:
        return None
    columns = (int(strip["x"].values[0]), int(strip["x"].values[-1]) + 1)
    rows = (facts.strip_z0, facts.strip_z1)
    first = int(strip["frame"].values[0])
    return read_encoder(film, rows, columns, rotate=facts.rotate, first=first, settings=settings)


def certify(
    strip: xr.DataArray,
    tracks: xr.Dataset,
    *,
    pixel_size_um: float | None = None,
    phases: StickPhases | None = None,
    encoder: Encoder | None = None,
    settings: CertifySettings = CertifySettings(),
    progress: Progress | None = None,
) -> Certificate:
    """Measure what one recording can resolve.

    Films are made from the recording's own mean picture, smooth motion and residuals, see
    `vision.certify.likeness`: nothing is assumed about the shape of ridges, the light or the noise. Residuals
    are those of other frames, including the effect of the codec. The films do not show a constant error of a
    sheet's position, which displacements do not have, nor errors that last as long as a stick phase, which
    look like motion; codecs that predict frames from others make such errors.

    strip, tracks: I(x, t) and x(n, t) of the recording.  pixel_size_um, phases: both needed for σ_x/Λ_st.
    encoder: how the recording was encoded (`read_encoder`); films are then encoded again instead of getting
    its residuals.  progress: called with (films tracked, total films).

    Raises: InputError if fewer than `settings.least_frames` frames show the sheets.
    """
    like, track, recorded_px = _imitated(strip, tracks, encoder, settings)
    scales = [scale for scale in (1.5, 2.0, 3.0, 4.0) if scale <= settings.largest_jump]
    phases = None if pixel_size_um is None else phases
    if progress is not None:
        films = settings.films if phases is None else 2 * settings.films
        track = _counting(track, progress, films + 1 + len(scales))
    measured = [
        _measure(like, like.motion_px, track(like.film(like.motion_px, number=number)))
        for number in range(settings.films)
    ]
    error = np.concatenate([film.error_px - _columns(film.error_px, np.mean) for film in measured])
    stated = np.concatenate([film.stated_px for film in measured])
    locking = _locking(like, track)
    sweeps, stick_frames = _sweep_errors(like, measured)
    margin, tried = _identity_margin(like, track, measured, scales)
    metadata, facts = TrackMetadata.of(tracks), StripMetadata.of(strip)
    at_threshold = None
    if phases is not None and pixel_size_um is not None:
        creeping = _creep_at_threshold(like, phases, pixel_size_um, metadata.axis_px)
        tracked = (track(like.film(creeping, number=number)) for number in range(settings.films))
        at_threshold = _at_threshold(tracked, phases, pixel_size_um)
    imitated = tracks.isel(frame=like.frames)
    sheets = _sheet_table(like, tracks, error, stated, locking, sweeps, settings.errors_resolved)
    known = np.isfinite(error)
    scatter_px = float(np.median([film.scatter_px for film in measured]))
    doubts = _doubts(like, imitated, rms(error), scatter_px, recorded_px, settings)
    return Certificate(
        source=facts.source,
        codec=facts.codec,
        fit=metadata.fit,
        frames=len(like.motion_px),
        films=settings.films,
        pixel_size_um=pixel_size_um,
        sheets=sheets,
        error_px=rms(error),
        within_error=float((np.abs(error) <= stated)[known].mean()) if known.any() else math.nan,
        found=float(known.mean()),
        wrong=sum(film.wrong for film in measured),
        locking_px=float(nan_median(locking)),
        smallest_sweep_px=settings.errors_resolved * float(nan_median(sweeps)),
        errors_resolved=settings.errors_resolved,
        stick_frames=stick_frames,
        largest_jump_pitches=_largest_jump(like),
        identity_margin=margin,
        identity_tried=tried,
        threshold=at_threshold,
        warnings=(*doubts, *_gaps(like, tracks, known)),
        encoding="" if like.encoder is None else like.encoder.described,
        uncertain=bool(doubts),
    )


def _imitated(
    strip: xr.DataArray, tracks: xr.Dataset, encoder: Encoder | None, settings: CertifySettings
) -> tuple[Likeness, Tracker, float]:
    """Return what films are made of, how they are tracked, and the scatter of recorded positions, px."""
    like = learn(strip, _without_locking(strip, tracks), settings)
    if encoder is not None:
        drawn, shown_px = like.film(like.motion_px, number=None).values, like.shown_px(like.motion_px)
        like = replace(like, encoder=encoder.fitted(drawn, shown_px, like.strip.values))
    x_px = np.asarray(tracks["x_px"].values[like.frames], float)
    recorded_px = _scatter(x_px, like.residuals.between_frames)
    track = _tracker(tracks, like, recorded_px)
    return like if encoder is None else _with_hidden_motion(like, track, settings), track, recorded_px


def _counting(track: Tracker, progress: Progress, total: int) -> Tracker:
    """Return `track`, which then reports its number of films so far."""
    number = itertools.count(1)

    def tracked(film: xr.DataArray) -> xr.Dataset:
        tracks = track(film)
        progress(next(number), total)
        return tracks

    return tracked


def _with_hidden_motion(like: Likeness, track: Tracker, settings: CertifySettings) -> Likeness:
    """Return a likeness whose films show as much common motion of all sheets as the recording. The codec
    leaves out a part of this motion. If films had just the motion that is left, hardly any of it would be
    lost when they are encoded again. They have another one with the same spectrum."""
    if not (kept := like.common_px).any():
        return like
    waves = np.abs(np.fft.rfft(kept)).astype(complex)
    waves *= np.exp(2j * np.pi * np.random.default_rng(0).random(waves.size))
    another = np.fft.irfft(waves, kept.size)
    another *= rms(kept) / rms(another)

    def moved(factor: float) -> Likeness:
        return replace(like, motion_px=like.motion_px + (factor * another - kept)[:, None])

    def shown(factor: float) -> float:
        tried = moved(factor)
        found = track(tried.film(tried.motion_px, number=0))["x_px"].values
        return rms(smooth_motion(found, like.slips, settings, between_frames=True)[1]) / rms(kept)

    once = shown(1.0)
    most = float(np.clip(1 / max(once, 1e-3), 1.0, settings.most_hidden))
    slope = (shown(most) - once) / (most - 1) if most > 1 else 0.0
    return moved(float(np.clip(1 + (1 - once) / slope, 1.0, most)) if slope > 0 else most)


def _tracker(tracks: xr.Dataset, like: Likeness, recorded_px: float) -> Tracker:
    """Return `track_sheets` with the run's parameters and axis, which films of another motion may not show.

    It does not search for false sheets and marks again, as the recording has shown which they are. If the run
    chose its fit itself, this choice, which is one for each sheet, may come out differently on a film: either
    the film's own choice or the same fit for all sheets is used, whichever gives a scatter more like the
    recording's, `recorded_px`.
    """
    parameters, known = _parameters(tracks)
    settings = TrackingSettings(**known | {"mark_distorted": math.inf, "most_distorted": math.inf})
    used: FitChoice = TrackMetadata.of(tracks).fit  # type: ignore[assignment]
    asked = parameters.pop("fit", used)
    parameters["axis_px"] = TrackMetadata.of(tracks).axis_px
    parameters.pop("corrections", None)  # they name frames of the recording

    def with_fit(fit: FitChoice) -> Tracker:
        return lambda film: track_sheets(film, **parameters, fit=fit, settings=settings)

    if asked != "auto" or used == "sliding":
        return with_fit(used)
    film, choices = like.film(like.motion_px, number=0), (used, asked)

    def unlike(track: Tracker) -> float:
        return abs(math.log(_measure(like, like.motion_px, track(film)).scatter_px / recorded_px))

    return min((with_fit(fit) for fit in choices), key=unlike)


def _parameters(tracks: xr.Dataset) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the run's parameters of `track_sheets`, and its settings."""
    parameters = parameters_of(tracks, "track_sheets")
    values = from_json(TrackingSettings, parameters.pop("settings", {}))
    if decided := parameters.get("corrections"):
        parameters["corrections"] = [Correction(**from_json(Correction, one)) for one in decided]
    return parameters, values


def _without_locking(strip: xr.DataArray, tracks: xr.Dataset) -> xr.Dataset:
    """Return positions without the publication's locking to pixels, which would be taken for motion."""
    if TrackMetadata.of(tracks).fit != "paper":
        return tracks
    parameters, known = _parameters(tracks)
    return track_sheets(strip, **parameters | {"fit": "sliding"}, settings=TrackingSettings(**known))


def _measure(like: Likeness, truth_px: Floats, found: xr.Dataset) -> _Measured:
    """Compare tracks with the true positions (frame, sheet); tracks belong to the nearest true sheet."""
    x = found["x_px"].values - float(like.strip["x"].values[0])
    ok = found["flag"].values == "ok"
    distance = nan_median(np.abs(np.where(ok, x, np.nan)[:, :, None] - truth_px[:, None, :]))
    sheet = np.argmin(np.nan_to_num(distance, nan=np.inf), axis=1)
    error, stated = np.full(truth_px.shape, np.nan), np.full(truth_px.shape, np.nan)
    half, wrong = 0.5 * _pitch(like), 0
    for k, n in enumerate(sheet):
        off = np.where(ok[:, k], x[:, k] - truth_px[:, n], np.nan)
        far = np.abs(off) > half
        wrong += int(far.sum())
        error[:, n] = np.where(far, np.nan, off)
        stated[:, n] = np.where(ok[:, k] & ~far, found["x_err_px"].values[:, k], np.nan)
    return _Measured(error, stated, wrong, _scatter(error, like.residuals.between_frames))


def _scatter(x_px: Floats, between_frames: bool) -> float:
    """Return how far positions (frame, sheet) scatter between sheets, or in time if there are few sheets."""
    between = spatial_scatter(BetweenSlips(x_px), between_frames=between_frames)
    each = between if np.isfinite(between).any() else position_noise(x_px)
    return float(np.sqrt(np.nanmean(each**2)))


def _pitch(like: Likeness) -> float:
    return float(np.median(np.diff(like.picture.rest_px))) if like.picture.rest_px.size > 1 else 20.0


def _columns(values: Floats, work: Callable[[Floats], Any]) -> Floats:
    """Apply `work` to the known values of each column; NaN without any."""
    known = (column[np.isfinite(column)] for column in values.T)
    return np.array([work(column) if column.size else math.nan for column in known])


def _locking(like: Likeness, track: Tracker) -> Floats:
    """Return the peak-to-peak error without noise while all sheets cross one pixel, (sheet,)."""
    motion = like.picture.rest_px + np.linspace(0, 1, 41)[:, None]
    error = _measure(like, motion, track(like.film(motion, number=None))).error_px
    return _columns(error, np.ptp)


def _pieces(like: Likeness) -> list[Ints]:
    """Return the frames from slip to slip, without those that a slip may have blurred."""
    edges = np.unique(np.concatenate([[0, len(like.motion_px)], like.slips]))
    pieces = [
        np.arange(start + (start > 0), stop - (stop < edges[-1])) for start, stop in itertools.pairwise(edges)
    ]
    return [piece for piece in pieces if piece.size >= 5]


def _sweep_errors(like: Likeness, measured: list[_Measured]) -> tuple[Floats, float]:
    """Return the RMS error of a line's sweep over a stick phase, (sheet,), and its median frames."""
    pieces = _pieces(like)
    if not pieces:
        return np.full(like.picture.rest_px.size, np.nan), math.nan
    frames = int(np.median([piece.size for piece in pieces]))
    found = []
    for piece in pieces:
        for first in range(0, piece.size - frames + 1, frames):
            u = np.linspace(-0.5, 0.5, frames)
            slope = u / (u @ u)
            found += [slope @ film.error_px[piece[first : first + frames]] for film in measured]
    return _columns(np.array(found), rms), float(frames)


def _largest_jump(like: Likeness) -> float:
    """Return the largest motion of a sheet from frame to frame relative to the others, in pitches."""
    if len(like.motion_px) < 2:
        return 0.0
    step = np.diff(like.motion_px, axis=0)
    return float(np.abs(step - np.median(step, axis=1)[:, None]).max() / _pitch(like))


def _identity_margin(
    like: Likeness, track: Tracker, measured: list[_Measured], scales: list[float]
) -> tuple[float, float]:
    """Return the largest multiple of the motion without a wrong identity, and the largest tested. Multiples
    at which sheets would overlap are not tested."""
    centre = np.median(like.motion_px, axis=0)
    margin = 0.0 if any(film.wrong for film in measured) else 1.0
    tried, found = 1.0, float(np.isfinite(measured[0].error_px).mean())
    for scale in scales if margin else []:
        motion = centre + scale * (like.motion_px - centre)
        if np.diff(motion, axis=1).min(initial=np.inf) < 0.6 * _pitch(like):
            break
        tried = scale
        film = _measure(like, motion, track(like.film(motion, number=0)))
        if film.wrong or np.isfinite(film.error_px).mean() < 0.9 * found:
            break
        margin = scale
    return margin, tried


def _creep_at_threshold(like: Likeness, phases: StickPhases, pixel_size_um: float, axis_px: float) -> Floats:
    """Return positions (frame, sheet) that creep by √12 × threshold × Λ_st in every stick phase, px."""
    sticks = phases.sticks
    time = np.asarray(phases.clock.to_force_s(np.asarray(like.strip["time_s"].values, float)), float)
    side = np.where(like.picture.rest_px < axis_px - float(like.strip["x"].values[0]), -1, 1)
    length = sticks["stick_length_um"].to_numpy(float)
    start, stop = sticks["t_v_s"].to_numpy(float), sticks["t_p_s"].to_numpy(float)
    inward = np.zeros(time.size)
    for begin, end, long in zip(start, stop, length, strict=True):
        inside = (time >= begin) & (time <= end)
        share = (time[inside] - begin) / max(end - begin, 1e-9) - 0.5
        inward[inside] = share * np.sqrt(12) * phases.threshold * np.nan_to_num(long) / pixel_size_um
    return np.asarray(like.picture.rest_px - side * inward[:, None])


def _at_threshold(
    tracked: Iterable[xr.Dataset], phases: StickPhases, pixel_size_um: float
) -> Threshold | None:
    """Return σ_x/Λ_st where it is the threshold for every sheet; None if it cannot be measured."""
    sticks, clock, threshold = phases.sticks, phases.clock, phases.threshold
    try:
        moved = [horizontal_deformation(one, sticks, clock, pixel_size_um=pixel_size_um) for one in tracked]
    except InputError:
        return None
    moved = [one.assign(raw=one["sigma_x_um"] / one["stick_length_um"]) for one in moved]
    ratio, raw, error = (
        np.concatenate([one[name].values.ravel() for one in moved]) / threshold
        for name in ("ratio_signed", "raw", "ratio_err")
    )
    known = np.isfinite(ratio)
    if not known.any():
        return None
    return Threshold(
        ratio=threshold,
        bias=float(ratio[known].mean() - 1),
        raw_bias=float(np.nanmean(raw) - 1),
        scatter=float(ratio[known].std()),
        stated=float(np.median(error[known])),
        called_stiff=float((ratio[known] < 1).mean()),
    )


def _sheet_table(
    like: Likeness,
    tracks: xr.Dataset,
    error: Floats,
    stated: Floats,
    locking: Floats,
    sweeps: Floats,
    errors_resolved: float,
) -> pd.DataFrame:
    """Return the table of the sheets that are in the films, one row per sheet."""
    x_px = like.picture.rest_px + float(like.strip["x"].values[0])
    in_run = nan_median(tracks["x_px"].values)
    nearest = np.argmin(np.abs(np.nan_to_num(in_run, nan=np.inf)[:, None] - x_px), axis=0)
    within = np.where(np.isfinite(error), np.abs(error) <= stated, np.nan)
    return pd.DataFrame(
        {
            "index": tracks["sheet"].values[nearest],
            "side": tracks["side"].values[nearest],
            "n": tracks["n"].values[nearest],
            "x_px": x_px.round(3),
            "error_px": _columns(error, rms).round(5),
            "stated_px": nan_median(stated).round(5),
            "within_error": _columns(within, np.mean).round(4),
            "found": np.isfinite(error).mean(axis=0).round(4),
            "locking_px": locking.round(5),
            "sweep_error_px": sweeps.round(5),
            "smallest_sweep_px": (errors_resolved * sweeps).round(5),
        }
    )


def _doubts(
    like: Likeness,
    tracks: xr.Dataset,
    error_px: float,
    scatter_px: float,
    recorded_px: float,
    settings: CertifySettings,
) -> list[str]:
    """Return warnings about parts of the recording that the films do not reproduce well."""
    lines, codec = [], StripMetadata.of(like.strip).codec
    between_frames = codec in BETWEEN_FRAMES
    if between_frames and like.encoder is None:
        lines.append(
            f"{codec} carries content from frame to frame, and films could not be encoded in this way "
            "(no encoder, or the film was moved): they have the recording's residuals, which lack errors "
            "that last as long as a stick phase; the true error is larger, up to twice in tests"
        )
    if abs(math.log(scatter_px / recorded_px)) > math.log(settings.alike):
        lines.append(
            f"positions of the films scatter by {scatter_px:.4f} px, those of the recording by "
            f"{recorded_px:.4f} px: the films do not reproduce its noise, and their errors are approximate"
        )
    noise_px = max(float(np.nan_to_num(nan_median(tracks["x_noise_px"].values))), 1e-6)
    # Errors exceed the noise also with the publication's fit, and with codecs that predict frames.
    if (
        not between_frames
        and TrackMetadata.of(tracks).fit != "paper"
        and error_px > settings.above_noise * noise_px
    ):
        lines.append(
            f"errors of the films, {error_px:.3f} px, are above the noise of the recording from frame to "
            f"frame, {noise_px:.3f} px: if its motion is not smooth, the films contain some of it as noise"
        )
    if not like.smooth.any():
        lines.append("slips follow each other so fast that motion and noise can hardly be separated")
    disturbed = max(float(like.disturbed.mean()), float(tracks["distorted"].mean()))
    stated = np.where(tracks["flag"].values == "ok", tracks["x_err_px"].values, np.nan)
    large = (stated > settings.distorted_errors * nan_median(stated)) | (tracks["distorted"].values > 0)
    at_distorted = float(np.nansum(stated[large] ** 2) / max(np.nansum(stated**2), 1e-12))
    if at_distorted > settings.most_at_distorted:
        lines.append(
            f"something distorts or hides ridges in {100 * disturbed:.1f} % of the film (dirt, a highlight, "
            f"a hand), and {100 * at_distorted:.0f} % of the total error (the sum of squares of the stated "
            "errors) is that of the positions there. Where these sheets really were is unknown, so the films "
            "take it from their neighbours, and the certified error is approximate: in tests, the true error "
            "was 0.5 to 4 times as large. Remove the cause, or track rows without it"
        )
    return lines


def _gaps(like: Likeness, tracks: xr.Dataset, known: Bools) -> list[str]:
    """Return warnings about what the certificate does not cover."""
    lines, left_out_sheets = [], tracks.sizes["sheet"] - like.picture.rest_px.size
    if left_out_sheets:
        lines.append(f"{left_out_sheets} sheets left out, which are found in fewer than half of the frames")
    if known.mean() < 0.95:
        lines.append(f"only {100 * known.mean():.0f} % of the positions of the films were found")
    return lines
