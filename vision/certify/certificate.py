"""certify(): what one recording can resolve, measured on films like it whose truth is known."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.certify.encoder import Encoder, read_encoder
from vision.certify.likeness import Likeness, learn
from vision.certify.settings import DEFAULT, CertifySettings
from vision.clock import Clock
from vision.data import StripMetadata, TrackMetadata
from vision.deformation import horizontal_deformation
from vision.errors import InputError
from vision.numeric import Bools, Floats, Ints, nan_median
from vision.run import RunFolder, read_strip, read_table
from vision.run.export import film_of
from vision.run.reading import read_json, tracks_of
from vision.sheets import TrackingSettings, track_sheets
from vision.sheets.quality import BetweenSlips, spatial_scatter, suppressed_motion
from vision.sheets.tracks import BETWEEN_FRAMES

Progress = Callable[[int, int | None], None]


@dataclass(frozen=True, kw_only=True)
class Threshold:
    """σ_x/Λ_st of films in which every sheet stands at the threshold.

    Parameters
    ----------
    ratio
        The threshold, which is the truth.
    bias, raw_bias
        Mean of the measured ratio over the truth, less 1; the same for the RMS displacement as measured.
    scatter
        Standard deviation of single measurements over the truth.
    stated
        Median stated error over the truth.
    called_stiff
        Share called stiff: half, where there is no bias.
    """

    ratio: float
    bias: float
    raw_bias: float
    scatter: float
    stated: float
    called_stiff: float


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What a recording can resolve.

    Parameters
    ----------
    source, codec, fit
        The video, its codec, and the subpixel fit used.
    frames, films, pixel_size_um
        Frames imitated, films made, and the scale where it is known.
    sheets
        One row a sheet: index, side, n, x_px, error_px (RMS error of a displacement), stated_px (median
        x_err_px), within_error (share of positions within it), found, locking_px (peak to peak),
        sweep_error_px and smallest_sweep_px (over a stick).
    error_px, within_error, found, wrong
        RMS over all sheets; shares; positions called ok that are more than half a pitch off.
    locking_px
        Error that repeats with the fraction of a pixel, peak to peak, median over sheets.
    smallest_sweep_px, stick_frames
        Median over sheets, and the frames of a stick for which it holds; NaN without a piece long enough.
    largest_jump_pitches, identity_margin
        Largest jump of a sheet from frame to frame, and how many times the recording's motion was followed
        without a wrong identity; the largest that was tried is a lower bound.
    identity_tried
        That largest.
    threshold
        At the stiffness threshold; None without stick phases or scale.
    warnings
        What the certificate does not cover.
    encoding
        How films were encoded again; "" where they got the recording's residuals.
    uncertain
        Whether the recording contains what the films do not reproduce well: errors may then be others.
    """

    source: str
    codec: str
    fit: str
    frames: int
    films: int
    pixel_size_um: float | None
    sheets: pd.DataFrame
    error_px: float
    within_error: float
    found: float
    wrong: int
    locking_px: float
    smallest_sweep_px: float
    stick_frames: float
    largest_jump_pitches: float
    identity_margin: float
    identity_tried: float
    threshold: Threshold | None
    warnings: tuple[str, ...]
    encoding: str = ""
    uncertain: bool = False

    @property
    def facts(self) -> dict[str, Any]:
        """Everything but the table of sheets, for certificate.json."""
        values = {part.name: getattr(self, part.name) for part in fields(self)}
        values.pop("sheets")
        return values


@dataclass(frozen=True)
class _Measured:
    """Errors of one film, (frame, sheet of the truth), px; NaN where nothing is called ok."""

    error_px: Floats
    stated_px: Floats
    wrong: int


def certify_run(
    run: RunFolder, *, settings: CertifySettings = DEFAULT, progress: Progress | None = None
) -> Certificate:
    """The certificate of a finished run, with its events and clock where it has them.

    Raises
    ------
    InputError
        For a run without a video, or whose sheets are seen in too few frames.
    """
    sticks, path = read_table(run.folder, "events"), run.folder / "clock.json"
    clock = _clock(read_json(path)) if path.exists() else None
    given = run.facts.get("parameters", {}).get("threshold", {}).get("value")
    strip = read_strip(run)
    return certify(
        strip,
        tracks_of(run),
        pixel_size_um=run.pixel_size_um,
        sticks=sticks,
        clock=clock,
        threshold=0.1 if given is None else float(given),
        encoder=_encoder(run, strip),
        settings=settings,
        progress=progress,
    )


def _encoder(run: RunFolder, strip: xr.DataArray) -> Encoder | None:
    """How the run's film was encoded, where the film is still there and its codec chains frames."""
    facts = StripMetadata.of(strip)
    if facts.codec not in BETWEEN_FRAMES:
        return None
    try:
        film = film_of(run)
    except InputError:
        return None
    columns = (int(strip["x"].values[0]), int(strip["x"].values[-1]) + 1)
    rows = (facts.strip_z0, facts.strip_z1)
    return read_encoder(film, rows, columns, rotate=facts.rotate, first=int(strip["frame"].values[0]))


def _clock(facts: dict[str, Any]) -> Clock | None:
    """The run's clock; None for one that may be wrong by whole slips."""
    if facts.get("status") not in ("ok", "given"):
        return None
    known = {part.name for part in fields(Clock)} - {"candidates", "warnings"}
    values: dict[str, Any] = {name: facts[name] for name in known if name in facts}
    for name, value in values.items():
        values[name] = math.nan if value is None else value
    return Clock(**values)


def certify(
    strip: xr.DataArray,
    tracks: xr.Dataset,
    *,
    pixel_size_um: float | None = None,
    sticks: pd.DataFrame | None = None,
    clock: Clock | None = None,
    threshold: float = 0.1,
    encoder: Encoder | None = None,
    settings: CertifySettings = DEFAULT,
    progress: Progress | None = None,
) -> Certificate:
    """What one recording can resolve.

    Parameters
    ----------
    strip, tracks
        I(x, t) and x(n, t) of the recording, as `strip_profile` and `track_sheets` return them.
    pixel_size_um, sticks, clock
        Scale, stick-slip events and clock, without which there is no statement about σ_x/Λ_st.
    threshold
        σ_x/Λ_st below which a sheet is stiff.
    encoder
        How the recording was encoded, from `vision.certify.encoder.read_encoder`: films are then encoded
        again in place of getting the recording's residuals.
    settings
        Tunable constants.
    progress
        Called with (films tracked, total films).

    Returns
    -------
    Certificate

    Raises
    ------
    InputError
        Where fewer than 30 frames show the sheets.

    Notes
    -----
    Films are made from the recording's own mean picture, smooth motion and residuals, see
    `vision.certify.likeness`: nothing is assumed about the shape of ridges, the light or the noise. Residuals
    are those that were recorded, what the codec did to them included, moved in time against the motion. What
    a film cannot tell: a constant error of a sheet's position (displacements do not have it), and errors that
    last as long as a stick, since those cannot be told from motion; codecs that carry content from frame to
    frame make such.
    """
    like = learn(strip, tracks, settings)
    if encoder is not None:
        # What the codec left out of the camera's shaking must be there to be left out again. A part of what
        # all sheets do in single frames is no motion but the noise of their median: π/2 of a mean's variance.
        x_px = np.asarray(tracks["x_px"].values, float)
        between = BetweenSlips(x_px)
        scatter = float(np.nan_to_num(nan_median(spatial_scatter(between, between_frames=True))))
        noise = 1.57 * scatter**2 / x_px.shape[1]
        moved = max(0.0, 1 - noise / max(float(np.var(like.common_px)), 1e-12))
        more = suppressed_motion(between) * np.sqrt(moved) * like.common_px
        like = replace(like, motion_px=like.motion_px + more[:, None])
        drawn, shown = like.film(like.motion_px, number=None).values, like.shown_px(like.motion_px)
        like = replace(like, encoder=encoder.fitted(drawn, shown, like.strip.values))
    again = _tracking(tracks)
    scales = [scale for scale in (1.5, 2.0, 3.0, 4.0) if scale <= settings.largest_jump]
    work = settings.films + 1 + len(scales) + (settings.films if sticks is not None else 0)
    finished = itertools.count(1)

    def done() -> None:
        if progress is not None:
            progress(next(finished), work)

    measured = []
    for number in range(settings.films):
        measured.append(_measure(like, like.motion_px, again(like.film(like.motion_px, number=number))))
        done()
    error = np.concatenate([_without_means(film.error_px) for film in measured])
    stated = np.concatenate([film.stated_px for film in measured])
    locking = _locking(like, again)
    done()
    sweeps, stick_frames = _sweep_errors(like, measured, settings)
    margin, tried = _identity_margin(like, again, measured, scales, done)
    at_threshold = None
    if sticks is not None and clock is not None and pixel_size_um is not None:
        at_threshold = _at_threshold(
            like, again, settings.films, sticks, clock, pixel_size_um, threshold, tracks
        )
    metadata, facts = TrackMetadata.of(tracks), StripMetadata.of(strip)
    sheets = _sheet_table(like, tracks, error, stated, locking, sweeps * settings.errors_resolved, sweeps)
    known = np.isfinite(error)
    doubts = _doubts(like, facts, tracks, _rms(error))
    return Certificate(
        source=facts.source,
        codec=facts.codec,
        fit=metadata.fit,
        frames=len(like.motion_px),
        films=settings.films,
        pixel_size_um=pixel_size_um,
        sheets=sheets,
        error_px=_rms(error),
        within_error=float((np.abs(error) <= stated)[known].mean()) if known.any() else math.nan,
        found=float(known.mean()),
        wrong=sum(film.wrong for film in measured),
        locking_px=float(nan_median(locking[None], axis=1)[0]),
        smallest_sweep_px=settings.errors_resolved * float(nan_median(sweeps[None], axis=1)[0]),
        stick_frames=stick_frames,
        largest_jump_pitches=_largest_jump(like),
        identity_margin=margin,
        identity_tried=tried,
        threshold=at_threshold,
        warnings=(*doubts, *_gaps(like, tracks, known, at_threshold is None)),
        encoding="" if like.encoder is None else like.encoder.described,
        uncertain=bool(doubts),
    )


def _tracking(tracks: xr.Dataset) -> Callable[[xr.DataArray], xr.Dataset]:
    """`track_sheets` with what the run was asked for, and the fit that it used.

    Which sheets are none, or lie under a mark, the recording has told: its films are not asked again.
    """
    steps = [step for step in tracks.attrs.get("operations", ()) if step["operation"] == "track_sheets"]
    asked = dict(steps[-1]["parameters"]) if steps else {}
    tuned = asked.pop("settings", {})
    known = {part.name for part in fields(TrackingSettings)}
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in tuned.items()
        if name in known
    }
    chosen = TrackingSettings(**values | {"mark_pulled": math.inf, "most_pulled": math.inf})
    asked["fit"] = TrackMetadata.of(tracks).fit
    return lambda film: track_sheets(film, **asked, settings=chosen)


def _measure(like: Likeness, truth_px: Floats, found: xr.Dataset) -> _Measured:
    """Errors of the ridge that is nearest to each true sheet most of the time."""
    x = found["x_px"].values - float(like.strip["x"].values[0])
    ok = found["flag"].values == "ok"
    away = nan_median(np.abs(np.where(ok, x, np.nan)[:, :, None] - truth_px[:, None, :]))
    sheet = np.argmin(np.nan_to_num(away, nan=np.inf), axis=1)
    error, stated = np.full(truth_px.shape, np.nan), np.full(truth_px.shape, np.nan)
    half, wrong = 0.5 * _pitch(like), 0
    for k, n in enumerate(sheet):
        off = np.where(ok[:, k], x[:, k] - truth_px[:, n], np.nan)
        far = np.abs(off) > half
        wrong += int(far.sum())
        error[:, n] = np.where(far, np.nan, off)
        stated[:, n] = found["x_err_px"].values[:, k]
    return _Measured(error, stated, wrong)


def _pitch(like: Likeness) -> float:
    return float(np.median(np.diff(like.rest_px))) if like.rest_px.size > 1 else 20.0


def _rms(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def _columns(values: Floats, work: Callable[[Floats], float]) -> Floats:
    """`work` of what is known of each column; NaN where nothing is."""
    known = (column[np.isfinite(column)] for column in values.T)
    return np.array([work(column) if column.size else math.nan for column in known])


def _without_means(error: Floats) -> Floats:
    return error - _columns(error, lambda column: float(column.mean()))


def _locking(like: Likeness, again: Callable[[xr.DataArray], xr.Dataset]) -> Floats:
    """Peak to peak of the error, without noise, while all sheets cross one pixel together, (sheet,)."""
    motion = like.rest_px + np.linspace(0, 1, 41)[:, None]
    error = _measure(like, motion, again(like.film(motion, number=None))).error_px
    return _columns(error, lambda column: float(np.ptp(column)))


def _pieces(like: Likeness) -> list[Ints]:
    """Frames from slip to slip, without those that a slip may have blurred."""
    edges = np.unique(np.concatenate([[0, len(like.motion_px)], like.slips]))
    pieces = [
        np.arange(start + (start > 0), stop - (stop < edges[-1])) for start, stop in itertools.pairwise(edges)
    ]
    return [piece for piece in pieces if piece.size >= 5]


def _sweep_errors(
    like: Likeness, measured: list[_Measured], settings: CertifySettings
) -> tuple[Floats, float]:
    """RMS error of the sweep by a straight line over a stick, (sheet,), and the frames of a typical one."""
    pieces = _pieces(like)
    if not pieces:
        return np.full(like.rest_px.size, np.nan), math.nan
    frames = int(np.median([piece.size for piece in pieces]))
    found = []
    for piece in pieces:
        for first in range(0, piece.size - frames + 1, frames):
            u = np.linspace(-0.5, 0.5, frames)
            slope = u / (u @ u)
            found += [slope @ film.error_px[piece[first : first + frames]] for film in measured]
    return _columns(np.array(found), _rms), float(frames)


def _largest_jump(like: Likeness) -> float:
    """Largest movement of a sheet from frame to frame against the others, in pitches."""
    if len(like.motion_px) < 2:
        return 0.0
    step = np.diff(like.motion_px, axis=0)
    return float(np.abs(step - np.median(step, axis=1)[:, None]).max() / _pitch(like))


def _identity_margin(
    like: Likeness,
    again: Callable[[xr.DataArray], xr.Dataset],
    measured: list[_Measured],
    scales: list[float],
    done: Callable[[], None],
) -> tuple[float, float]:
    """The largest multiple of the motion that is followed without a wrong identity, and the largest tried.

    Multiples at which sheets would overlap are not tried.
    """
    middle = np.median(like.motion_px, axis=0)
    margin = 0.0 if any(film.wrong for film in measured) else 1.0
    tried, kept = 1.0, float(np.isfinite(measured[0].error_px).mean())
    for scale in scales if margin else []:
        motion = middle + scale * (like.motion_px - middle)
        if np.diff(motion, axis=1).min(initial=np.inf) < 0.6 * _pitch(like):
            break
        tried = scale
        film = _measure(like, motion, again(like.film(motion, number=0)))
        done()
        if film.wrong or np.isfinite(film.error_px).mean() < 0.9 * kept:
            break
        margin = scale
    return margin, tried


def _at_threshold(
    like: Likeness,
    again: Callable[[xr.DataArray], xr.Dataset],
    films: int,
    sticks: pd.DataFrame,
    clock: Clock,
    pixel_size_um: float,
    threshold: float,
    tracks: xr.Dataset,
) -> Threshold | None:
    """Films in which every sheet creeps by √12 × threshold × Λ_st in every stick, fully analysed."""
    time = np.asarray(clock.to_force_s(np.asarray(like.strip["time_s"].values, float)), float)
    side = np.where(like.rest_px < TrackMetadata.of(tracks).axis_px - float(like.strip["x"].values[0]), -1, 1)
    length = sticks["stick_length_um"].to_numpy(float)
    start, stop = sticks["t_v_s"].to_numpy(float), sticks["t_p_s"].to_numpy(float)
    inward = np.zeros(time.size)
    for begin, end, long in zip(start, stop, length, strict=True):
        inside = (time >= begin) & (time <= end)
        share = (time[inside] - begin) / max(end - begin, 1e-9) - 0.5
        inward[inside] = share * np.sqrt(12) * threshold * np.nan_to_num(long) / pixel_size_um
    motion = like.rest_px - side * inward[:, None]
    ratios, raws, errors = [], [], []
    for number in range(films):
        try:
            moved = horizontal_deformation(
                again(like.film(motion, number=number)), sticks, clock, pixel_size_um=pixel_size_um
            )
        except InputError:
            return None
        ratios.append(moved["ratio_signed"].values.ravel() / threshold)
        raw = moved["sigma_x_um"].values / moved["stick_length_um"].values[:, None]
        raws.append(raw.ravel() / threshold)
        errors.append(moved["ratio_err"].values.ravel() / threshold)
    ratio, raw, error = (np.concatenate(part) for part in (ratios, raws, errors))
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
    smallest: Floats,
    sweeps: Floats,
) -> pd.DataFrame:
    """One row a sheet of the run; empty cells where a sheet was seen too seldom to be imitated."""
    place = like.rest_px + float(like.strip["x"].values[0])
    middle = nan_median(tracks["x_px"].values)
    nearest = np.argmin(np.abs(np.nan_to_num(middle, nan=np.inf)[:, None] - place), axis=0)
    within = np.where(np.isfinite(error), np.abs(error) <= stated, np.nan)
    return pd.DataFrame(
        {
            "index": tracks["sheet"].values[nearest],
            "side": tracks["side"].values[nearest],
            "n": tracks["n"].values[nearest],
            "x_px": place.round(3),
            "error_px": _columns(error, _rms).round(5),
            "stated_px": nan_median(stated).round(5),
            "within_error": _columns(within, lambda column: float(column.mean())).round(4),
            "found": np.isfinite(error).mean(axis=0).round(4),
            "locking_px": locking.round(5),
            "sweep_error_px": sweeps.round(5),
            "smallest_sweep_px": smallest.round(5),
        }
    )


def _doubts(like: Likeness, facts: StripMetadata, tracks: xr.Dataset, error_px: float) -> list[str]:
    """What the recording contains and films do not reproduce well: errors may be others."""
    lines = []
    chained = facts.codec in BETWEEN_FRAMES
    if chained and like.encoder is None:
        lines.append(
            f"{facts.codec} carries content from frame to frame, and nothing could be encoded again like it "
            "(no encoder here, or the film is gone): its residuals were put in again, in which errors that "
            "last as long as a stick look like motion; the true error is larger, up to twice in tests"
        )
    noise_px = max(float(np.nan_to_num(nan_median(tracks["x_noise_px"].values))), 1e-6)
    # The publication's fit errs by more than it scatters, and codecs that chain frames let it scatter less.
    if not chained and TrackMetadata.of(tracks).fit != "paper" and error_px > 1.3 * noise_px:
        lines.append(
            f"errors of the films, {error_px:.3f} px, are above the noise of the recording from frame to "
            f"frame, {noise_px:.3f} px: where its motion is not smooth, the films take some of it for "
            "errors, and the true ones are smaller, 0.5 to 0.8 times these in tests"
        )
    if not like.smooth.any():
        lines.append("slips follow each other so fast that motion and noise are hard to tell apart")
    disturbed = float(like.disturbed.mean())
    if disturbed > 0.02:
        lines.append(
            f"something pulls ridges aside or hides them in {100 * disturbed:.0f} % of the film (dirt, a "
            "highlight, a hand): the films show what was recorded there, and the sheets around are taken for "
            "where those were; the true errors were 0.4 to 1.9 times these in tests"
        )
    return lines


def _gaps(like: Likeness, tracks: xr.Dataset, known: Bools, no_threshold: bool) -> list[str]:
    """What the certificate does not cover."""
    lines, left_out_sheets = [], tracks.sizes["sheet"] - like.rest_px.size
    if left_out_sheets:
        lines.append(f"{left_out_sheets} sheets seen in under half of the frames left out")
    if known.mean() < 0.95:
        lines.append(f"only {100 * known.mean():.0f} % of the positions of the films were found")
    if no_threshold:
        lines.append("nothing about σ_x/Λ_st: that needs a force recording, a clock and the pixel size")
    return lines
