"""analyse(): a video and, where there is one, a force recording go through every stage, once, in order.

The order of the stages is the order of this file: read, track, force, stick-slip events, model fits, clock,
deformation, shells. No stage needs a later one.
"""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

import base64
import math
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock, ClockSettings, synchronise
from vision.data import ForceMetadata, StripMetadata, warnings_of
from vision.deformation import DeformationSettings, horizontal_deformation
from vision.errors import InputError, known_as
from vision.escaping import html_table
from vision.figures.catalogue import Plots, figure_named
from vision.force import ForceSettings, find_stick_slip, read_force
from vision.models import ModelFits, fit_models
from vision.models.modulus import cycles_seen
from vision.numeric import Pixels
from vision.sample import PUBLISHED, Sample
from vision.sheets import (
    Correction,
    FitChoice,
    TrackingSettings,
    pixel_size_from_pitch,
    track_sheets,
    with_heights,
)
from vision.sheets.corrections import OF_SHEETS, last_of, ordered
from vision.sheets.ridges import describe_ridges
from vision.shells import ShellSettings, classify_shells
from vision.summary import (
    consistency_warnings,
    overexposure,
    ridges_per_side,
    shells_against_fits,
    summary_lines,
    tracking_warnings,
)
from vision.video import (
    Follow,
    ReadingLog,
    Video,
    VideoSettings,
    await_video,
    find_strip,
    open_video,
    reference_frame,
    strip_profile,
    strip_profiles,
)

Progress = Callable[[int, int | None], None]
Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """The tunable constants of every stage; each says what it trades and what shows its value is right."""

    video: VideoSettings = field(default_factory=VideoSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    force: ForceSettings = field(default_factory=ForceSettings)
    clock: ClockSettings = field(default_factory=ClockSettings)
    deformation: DeformationSettings = field(default_factory=DeformationSettings)
    shells: ShellSettings = field(default_factory=ShellSettings)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a user may choose of the analysis; None is found from the data.

    Parameters
    ----------
    rows, columns
        Of the strip, half-open, px, after rotation.
    strips
        Number of parts of the strip, one above the other, that are measured as well; 1 for none.
    rotate
        Degrees clockwise by which each frame is turned first: 0, 90, 180 or 270.
    frames
        Part of the video, half-open.
    fps, timestamps
        The camera's frame rate, or a text file with the time of every frame.
    ridges, sheets, axis_px
        Polarity ("bright", "dark" or "auto"), number of ridges in view, symmetry axis in px.
    fit, window_px
        Subpixel method ("auto", "sliding", "paper" or "template") and its window: odd, or "auto".
    corrections
        Decisions by hand, from `vision.sheets.read_corrections`. Those about the strip, the axis and the
        clock go before `rows`, `axis_px` and `offset_s`.
    pixel_size_um
        µm per pixel; without it there are no lengths in µm and no deformation.
    pitch_um
        Mean distance between neighbouring sheets, from which µm per pixel are found in place of
        `pixel_size_um`.
    speed_mm_min, d0_mm, d0_err_mm, force_columns
        V where no displacement is recorded, the initial separation with its error, and the recording's
        columns by role.
    force_threshold_N, force_lowpass_s, machine_stiffness_N_per_mm
        Smallest drop that is a slip; the load cell's time constant to correct for (0: as recorded; "auto":
        where it is proven); the machine's own stiffness.
    fit_range_mm, mu, modulus_GPa
        Separations between which the models are fitted; friction coefficient and Y_eff where they are known.
    offset_s
        Force clock at video time 0.
    threshold
        σ_x/Λ_st below which a sheet is stiff.
    common_mode
        Whether motion that all sheets share, the camera's, is taken off.
    sample, geometry_err
        Geometry and adhesion of the sample (None: the publication's, and said to be assumed), and the errors
        of its fields by name, for systematic errors.
    t_star_fitted
        Fit T* as well, which can hardly be told from μ.
    tuning
        Constants of the stages.
    """

    rows: slice | None = None
    columns: slice | None = None
    strips: int = 1
    rotate: int = 0
    frames: slice | None = None
    fps: float | None = None
    timestamps: Path | None = None
    ridges: Literal["bright", "dark", "auto"] = "auto"
    sheets: int | None = None
    axis_px: float | None = None
    fit: FitChoice = "auto"
    window_px: int | Literal["auto"] | None = None
    corrections: tuple[Correction, ...] = ()
    pixel_size_um: float | None = None
    pitch_um: float | None = None
    speed_mm_min: float | None = None
    d0_mm: float | None = None
    d0_err_mm: float | None = None
    force_columns: Mapping[str, str] | None = None
    force_threshold_N: float | None = None
    force_lowpass_s: float | Literal["auto"] = 0.0
    fit_range_mm: tuple[float, float] | None = None
    mu: float | None = None
    modulus_GPa: float | None = None
    machine_stiffness_N_per_mm: float | None = None
    offset_s: float | None = None
    threshold: float = 0.1
    common_mode: bool = True
    sample: Sample | None = None
    geometry_err: Mapping[str, float] = field(default_factory=dict)
    t_star_fitted: bool = False
    tuning: Tuning = field(default_factory=Tuning)


@dataclass(frozen=True, kw_only=True)
class Analysis:
    """Everything that was found in one test. A stage that the data did not allow is None.

    Parameters
    ----------
    settings
        As asked for.
    video, frame
        The recording, and its first frame that shows something (rows, columns).
    strip, tracks
        I(x, t) and x(n, t).
    force, sticks, fits
        The force recording, its stick-slip events, the models fitted to them.
    clock, motion, shells
        The camera's clock against the machine's, the deformation of each sheet in each stick phase, the
        stiff inner shell.
    reasons
        Stage to reason, for each stage that is None although its input was given.
    failures
        Stage to traceback, for stages that ended in an error nobody foresaw.
    warnings
        What matters for the results, in order, each once.
    seconds
        Wall-clock time of each stage.
    """

    settings: Settings
    video: Video | None = None
    frame: Pixels | None = None
    strip: xr.DataArray | None = None
    tracks: xr.Dataset | None = None
    force: xr.Dataset | None = None
    sticks: pd.DataFrame | None = None
    fits: ModelFits | None = None
    clock: Clock | None = None
    motion: xr.Dataset | None = None
    shells: pd.DataFrame | None = None
    reasons: Mapping[str, str] = field(default_factory=dict)
    failures: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel, None where it was not given."""
        return self.settings.pixel_size_um

    @property
    def threshold(self) -> float:
        """σ_x/Λ_st below which a sheet is stiff."""
        return self.settings.threshold

    @property
    def plot(self) -> Plots:
        """Every figure by its name: ``analysis.plot.tracks(ax=None)`` takes and returns an Axes."""
        return Plots(self)

    def summary(self) -> list[str]:
        """What was found, in about ten lines."""
        lines, sample = summary_lines(self), PUBLISHED
        if self.fits is not None and self.settings.sample is None:
            size = f"{sample.thickness_mm:g} x {sample.width_mm:g} x {sample.length_mm:g} mm"
            line = f"sample     assumed: the publication's, M = {sample.sheets_per_block} of {size}"
            shown = ridges_per_side(self.tracks) if self.tracks is not None else sample.sheets_per_block
            lines.append(line + f"; the video shows {shown} per side" * (shown != sample.sheets_per_block))
        return lines

    def _repr_html_(self) -> str:
        found: dict[str, str] = {}
        name = ""
        for line in self.summary():
            head, _, rest = line.partition(" ")
            name = head or name  # an indented line goes on with the one before
            found[name] = f"{found[name]}; {rest.strip()}" if name in found else rest.strip()
        found |= {f"warning {k}": line for k, line in enumerate(self.warnings, 1)}
        text = html_table("analysis", found)
        if self.tracks is None:
            return text
        picture = base64.b64encode(figure_named(self, "tracks").png()).decode()
        return f'{text}<img style="max-width:40em" alt="x(n,t)" src="data:image/png;base64,{picture}">'


def analyse(
    video: Video | str | Path | None = None,
    force: xr.Dataset | str | Path | None = None,
    settings: Settings | None = None,
    *,
    earlier: Analysis | None = None,
    progress: Progress | None = None,
    log: ReadingLog | None = None,
    follow: Follow | None = None,
) -> Analysis:
    """Every stage of one test, in order.

    Parameters
    ----------
    video
        A file, a folder or pattern of images, or an open `Video`; None for a force recording alone.
    force
        A testing machine's file, or a recording from `read_force`; None for a video alone.
    settings
        What is not to be found from the data.
    earlier
        An analysis of the same video with settings that differ in their corrections alone. Its strip, tracks
        and clock are taken over as far as no decision changes them; without a change of the strip the video
        is not read, and need not be given.
    progress
        Called with (frames done, total frames or None) while the video is read.
    log
        Keeps what is read, for a run that takes up an interrupted one (`vision.run.Checkpoint`).
    follow
        Reads on as the recording grows, until it is closed (`vision.video.Follow`).

    Returns
    -------
    Analysis
        What was found. A stage after the tracking that the data did not allow is None, with its reason;
        an unforeseen error in such a stage is kept in `failures` and costs only what depends on it.

    Raises
    ------
    InputError
        For a video or force recording that cannot be read, or a video without ridges.
    """
    chosen = settings or Settings()
    if chosen.strips != 1 and follow is not None:
        raise InputError("`strips` and `follow`", "one of the two", "both", "track again when it is complete")
    if chosen.pitch_um is not None and chosen.pixel_size_um is not None:
        raise InputError("`pitch_um` and `pixel_size_um`", "one of the two", "both")
    stage = _Stages()
    # A force file that is not understood is refused before the long work of reading a video.
    machine = None if force is None else stage.must("reading force", open_force, force, chosen)
    recording = None if video is None else open_recording(video, chosen, follow)
    kept = _kept(earlier, chosen, film=recording is not None)
    strip, tracks, clock, frame, parts = kept.strip, kept.tracks, kept.clock, None, None
    if recording is not None:
        if strip is None:
            read = partial(_strip, recording, chosen, progress, log, follow)
            strip, parts = stage.must("reading", _upright, recording, chosen, read)
        if follow is not None:  # it has grown
            with suppress(InputError):
                recording = open_recording(recording.path, chosen)
        frame = stage.must("first frame", reference_frame, recording)
    if strip is not None:
        if tracks is None:
            track = partial(track_strip, strip, chosen, parts)
            tracks = stage.must("tracking", _upright, recording, chosen, track)
        if chosen.pitch_um is not None:
            chosen = replace(chosen, pixel_size_um=pixel_size_from_pitch(tracks, chosen.pitch_um))
    sticks = stage.may("sticks", _sticks, machine, chosen, needed=strip is None)
    fits = stage.may("fits", _fits, machine, sticks, chosen)
    if clock is None:
        clock = stage.may("clock", _clock, tracks, machine, sticks, chosen)
    motion = stage.may("motion", _motion, tracks, sticks, clock, chosen)
    shells = stage.may("shells", partial(_shells, fits), motion, chosen)
    analysis = Analysis(
        settings=chosen,
        video=recording,
        frame=frame,
        strip=strip,
        tracks=tracks,
        force=machine,
        sticks=sticks,
        fits=fits,
        clock=clock,
        motion=motion,
        shells=shells,
        reasons=stage.reasons,
        failures=stage.failures,
        seconds=stage.seconds,
    )
    return replace(analysis, warnings=_warnings(analysis))


def _kept(earlier: Analysis | None, chosen: Settings, *, film: bool) -> Analysis:
    """Strip, tracks and clock of an earlier analysis, as far as no decision about them, or about what they
    follow from, is another one now.

    Raises
    ------
    InputError
        Where the strip must be read again, and the film is not given.
    """
    if earlier is None:
        return Analysis(settings=chosen)

    def decided(kinds: Sequence[str]) -> list[list[Any]]:
        parts = (earlier.settings.corrections, chosen.corrections)
        return [[one.what for one in ordered(part) if one.kind in kinds] for part in parts]

    def same(kind: str) -> bool:
        before, now = decided((kind,))
        return before[-1:] == now[-1:]

    of_sheets = decided(OF_SHEETS)
    strip = earlier.strip if same("strip") else None
    as_tracked = strip is not None and same("axis") and of_sheets[0] == of_sheets[1]
    tracks = earlier.tracks if as_tracked else None
    if tracks is None and chosen.strips != 1:
        strip = None  # positions at several heights need the film again
    if strip is None and not film:
        raise InputError("the strip", "the film, to be read again", "none", "say where it lies (`film`)")
    clock = earlier.clock if tracks is not None and same("clock") else None
    return Analysis(settings=chosen, strip=strip, tracks=tracks, clock=clock)


class _Stages:
    """Runs stages, keeps the time they take, and why those ended that could not be done."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.reasons: dict[str, str] = {}
        self.failures: dict[str, str] = {}

    def must(self, name: str, work: Callable[..., Result], *inputs: Any) -> Result:
        """Without this stage there is nothing: its errors are raised."""
        started = time.perf_counter()
        try:
            return work(*inputs)
        finally:
            self.seconds[name] = time.perf_counter() - started

    def may(
        self, name: str, work: Callable[..., Result], *inputs: Any, needed: bool = False
    ) -> Result | None:
        """None where an input is missing, or where the stage ends in an error, which is kept.

        needed: nothing was found before it, so that its errors are raised.
        """
        if any(part is None for part in inputs):
            return None
        if needed:
            return self.must(name, work, *inputs)
        try:
            return self.must(name, work, *inputs)
        except InputError as error:
            self.reasons[name] = str(error)
        except Exception as error:  # whatever it is, what was measured before it is kept
            self.reasons[name] = " ".join(f"unexpected {type(error).__name__}: {error}".split())
            self.failures[name] = traceback.format_exc()
        return None


def open_recording(video: Video | str | Path, chosen: Settings, follow: Follow | None = None) -> Video:
    """The video as the settings want it turned, cut and timed; one that is open already, as it is.

    One that is followed is waited for.
    """
    if isinstance(video, Video):
        return video
    opened = partial(
        open_video,
        video,
        rotate=chosen.rotate,
        frames=chosen.frames,
        fps=chosen.fps,
        timestamps=chosen.timestamps,
        answer_s=chosen.tuning.video.answer_s,
    )
    if follow is None:
        return opened()
    if chosen.timestamps is not None:
        raise InputError("`follow` and `timestamps`", "one of the two", "both", "give `fps`")
    return await_video(video, opened, follow, chosen.tuning.video)


def _strip(
    video: Video,
    chosen: Settings,
    progress: Progress | None,
    log: ReadingLog | None,
    follow: Follow | None,
) -> tuple[xr.DataArray, xr.DataArray | None]:
    """I(x, t) of the strip, and of its parts where they are asked for."""
    _check_lengths(chosen, video.shape[1])
    decided, settings = last_of(chosen.corrections, "strip"), chosen.tuning.video
    rows = chosen.rows if decided is None or decided.rows is None else slice(*decided.rows)
    if chosen.strips != 1:
        return strip_profiles(
            video, chosen.strips, rows, columns=chosen.columns, progress=progress, settings=settings
        )
    whole = strip_profile(
        video, rows, columns=chosen.columns, progress=progress, settings=settings, log=log, follow=follow
    )
    return whole, None


def _check_lengths(chosen: Settings, width_px: int) -> None:
    """Lengths far beyond the picture's width are refused before a long film is read."""
    axis, window = chosen.axis_px, chosen.window_px
    if axis is not None and not -width_px <= axis <= 2 * width_px:
        found, advice = f"{axis:g}", "give it in px, counted from the left"
        raise InputError("`axis_px`", f"a column within or near the picture's {width_px}", found, advice)
    if isinstance(window, int) and window > width_px:
        raise InputError("`window_px`", f"at most the picture's {width_px} columns", str(window), "try auto")


def _upright(film: Video | None, chosen: Settings, work: Callable[[], Result]) -> Result:
    """The result; where the picture has no upright ridges, the message tells whether it has level ones."""
    try:
        return work()
    except InputError:
        if film is None or chosen.rows is not None or chosen.columns is not None or not _lie_level(film):
            raise
        found, way = "ridges that lie level, one above the other", (film.rotate + 90) % 360
        raise InputError(film.path, "upright ridges", found, f"give `rotate` {way}") from None


def _lie_level(film: Video) -> bool:
    """Whether the film shows a comb once it is turned by 90 degrees."""
    turned = replace(film, rotate=(film.rotate + 90) % 360)
    try:
        rows = find_strip(turned).rows
        pictures = [picture[rows].mean(axis=0, dtype=np.float32) for picture in turned.sample(8)]
        comb = describe_ridges(np.stack(pictures))
    except (InputError, ValueError):  # no ridge either, or no picture
        return False
    return comb.count >= 5  # two or three are seen in any picture


def track_strip(strip: xr.DataArray, chosen: Settings, parts: xr.DataArray | None = None) -> xr.Dataset:
    """x(n, t) as the settings want it; of the strip's parts as well, where they are given."""
    tracks = track_sheets(
        strip,
        ridges=chosen.ridges,
        sheets=chosen.sheets,
        axis_px=chosen.axis_px,
        fit=chosen.fit,
        window_px=chosen.window_px,
        corrections=chosen.corrections,
        settings=chosen.tuning.tracking,
    )
    return tracks if parts is None else with_heights(tracks, parts, settings=chosen.tuning.tracking)


@known_as(columns="force_columns")
def open_force(force: xr.Dataset | str | Path, chosen: Settings) -> xr.Dataset:
    """The force recording as the settings want it read; one that is read already, as it is."""
    if isinstance(force, xr.Dataset):
        return force
    return read_force(
        force,
        speed_mm_min=chosen.speed_mm_min,
        d0_mm=chosen.d0_mm,
        d0_err_mm=chosen.d0_err_mm,
        columns=chosen.force_columns,
        settings=chosen.tuning.force,
    )


@known_as(columns="force_columns")
def _sticks(force: xr.Dataset, chosen: Settings) -> pd.DataFrame:
    return find_stick_slip(
        force,
        threshold_N=chosen.force_threshold_N,
        machine_stiffness_N_per_mm=chosen.machine_stiffness_N_per_mm,
        lowpass_s=chosen.force_lowpass_s,
        settings=chosen.tuning.force,
    )


def _fits(force: xr.Dataset, sticks: pd.DataFrame, chosen: Settings) -> ModelFits:
    return fit_models(
        force,
        sticks,
        chosen.sample or PUBLISHED,
        free_t_star=chosen.t_star_fitted,
        mu=chosen.mu,
        modulus_GPa=chosen.modulus_GPa,
        fit_range_mm=chosen.fit_range_mm,
        geometry_err=chosen.geometry_err,
    )


def _clock(tracks: xr.Dataset, force: xr.Dataset, sticks: pd.DataFrame, chosen: Settings) -> Clock:
    decided = last_of(chosen.corrections, "clock")
    offset_s, drift_ppm = (chosen.offset_s, 0.0) if decided is None else (decided.offset_s, decided.drift_ppm)
    return synchronise(
        tracks, force, sticks, offset_s=offset_s, drift_ppm=drift_ppm, settings=chosen.tuning.clock
    )


def _motion(tracks: xr.Dataset, sticks: pd.DataFrame, clock: Clock, chosen: Settings) -> xr.Dataset:
    seen = min(clock.unmatched_video, clock.unmatched_force)
    if clock.status == "given" and clock.matched == 0 and seen >= 3:  # fewer may have been missed
        raise InputError(
            "the clocks",
            "slips that coincide in video and force",
            f"none of {clock.unmatched_video} and {clock.unmatched_force} with the given {clock.how} clock",
            "check `offset_s`, or whether the two files belong together",
        )
    return horizontal_deformation(
        tracks,
        sticks,
        clock,
        pixel_size_um=chosen.pixel_size_um,
        common_mode=chosen.common_mode,
        settings=chosen.tuning.deformation,
    )


def _shells(fits: ModelFits | None, motion: xr.Dataset, chosen: Settings) -> pd.DataFrame:
    return classify_shells(
        motion,
        threshold=chosen.threshold,
        effective_sheets=fits.effective_sheets if fits else None,
        settings=chosen.tuning.shells,
    )


def _warnings(found: Analysis) -> tuple[str, ...]:
    """What matters for the results, in the order of the stages, each once."""
    lines: list[str] = []
    if found.tracks is not None:
        lines += warnings_of(found.tracks)
        if found.frame is not None:
            strip = StripMetadata.of(found.tracks)
            rows = slice(strip.strip_z0, strip.strip_z1)
            lines += overexposure(found.frame, rows, found.settings.tuning.video)
        lines += tracking_warnings(found.tracks)
        # An assumed sample matters where models are fitted with it.
        assumed = PUBLISHED if found.fits is not None and found.settings.sample is None else None
        lines += consistency_warnings(found.tracks, found.settings.sample, assumed=assumed)
    if found.force is not None:
        lines += warnings_of(found.force, found.sticks)
        lines += filter(None, [cycles_seen(found.force)])
        # Without d0, or with a force over a weight, nobody asked for the models.
        expected = (
            math.isfinite(ForceMetadata.of(found.force).d0_mm) and found.force["load_N"].attrs["units"] == "N"
        )
        if "fits" in found.reasons and expected:
            lines.append(f"no model fits: {found.reasons['fits']}")
    lines += found.fits.warnings if found.fits else ()
    lines += found.clock.warnings if found.clock else ()
    lines += shells_against_fits(found.shells, found.fits, found.settings.tuning.shells)
    return tuple(dict.fromkeys(lines))
