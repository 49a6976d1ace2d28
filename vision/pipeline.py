"""analyse(): run every stage of the analysis once, in order, on a video, a force recording or both.

The stages are: read the strip, track the sheets, find the stick-slip events, fit the models, synchronise the
clocks, measure the deformation, classify the shells. No stage needs the result of a later one.
"""

from __future__ import annotations

import base64
import math
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import pandas as pd
import xarray as xr

from vision.checks import (
    CheckSettings,
    consistency_warnings,
    decision_warnings,
    overexposure,
    shells_against_fits,
    tracking_warnings,
    unlike_sides,
)
from vision.clock import Clock, ClockSettings, synchronise
from vision.clock.clock import given_clock
from vision.data import (
    FORCE,
    STIFF_BELOW,
    ForceMetadata,
    StripMetadata,
    TrackMetadata,
    Tunable,
    check_pixel_size,
    check_threshold,
    load_unit,
    parameters_of,
    warnings_of,
)
from vision.deformation import DeformationSettings, horizontal_deformation
from vision.errors import (
    PATH,
    InputError,
    NonNegative,
    NoRidgesError,
    Positive,
    PositiveInt,
    check_fields,
    check_kind,
    check_within,
    did_you_mean,
    known_as,
    renamed,
    unexpected,
)
from vision.figures.catalogue import Plots, Results, figure_named
from vision.files import Progress
from vision.folder import html_table, numbered
from vision.force import ForceSettings, find_stick_slip, read_force
from vision.memory import give_back_freed
from vision.models import FitSettings, ModelFits, fit_models
from vision.models.fits import check_fit_range
from vision.sample import PUBLISHED, Sample
from vision.sheets import Correction, FitChoice, TrackingSettings, pixel_size_of, track_sheets, with_heights
from vision.sheets.corrections import OF_SHEETS, check_corrections, last_of, ordered, read_corrections
from vision.sheets.ridges import describe_ridges
from vision.sheets.subpixel import check_window
from vision.sheets.tracks import check_axis
from vision.shells import ShellSettings, classify_shells
from vision.summary import summary_items, summary_lines
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
from vision.video.video import cut

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True, repr=False)
class Tuning(Tunable):
    """Tunable constants of every stage. Each field says what its value trades and what shows it is right."""

    video: VideoSettings = field(default_factory=VideoSettings)
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    force: ForceSettings = field(default_factory=ForceSettings)
    fits: FitSettings = field(default_factory=FitSettings)
    clock: ClockSettings = field(default_factory=ClockSettings)
    deformation: DeformationSettings = field(default_factory=DeformationSettings)
    shells: ShellSettings = field(default_factory=ShellSettings)
    checks: CheckSettings = field(default_factory=CheckSettings)


def _check_seconds(**values: Any) -> None:
    """Raise `InputError` for an argument that is neither "auto" nor a number of seconds from 0."""
    numbers = {name: value for name, value in values.items() if value != "auto"}
    check_within("a number of seconds from 0, or auto", 0, math.inf, **numbers)


_Separation = Annotated[float, partial(check_within, "a number of mm from 0", 0, math.inf)]
_Seconds = Annotated[float | Literal["auto"], _check_seconds]


@dataclass(frozen=True, kw_only=True, repr=False)
class Settings(Tunable):
    """Options of the analysis, which ``track --help`` explains. One that is None is found from the data.

    The unit is the last part of a name. Called otherwise there: `rows` is --strip, `d0_err_mm` the error in
    --d0, `pixel_size_err_um` and `pitch_err_um` likewise, `geometry_err` those of the sample, `mu` --fix-mu,
    `modulus_GPa` --fix-yeff. Parts of film and picture are slices, as in ``rows=slice(60, 144)``; a sample is
    a `vision.sample.Sample`.
    """

    rows: slice | None = None  #: averaged to the strip; half-open, px, after rotation, as are `columns`
    columns: slice | None = None  #: of the strip
    strips: PositiveInt = 1  #: parts, one above the other, in which the strip is measured as well; 1 for none
    rotate: Literal[0, 90, 180, 270] = 0  #: degrees clockwise by which each frame is rotated first
    frames: slice | None = None  #: part of the video, half-open
    fps: Positive | None = None  #: the camera's frame rate
    timestamps: Path | None = None  #: text file with the time of every frame; its name is enough
    ridges: Literal["bright", "dark", "auto"] = "auto"  #: polarity
    sheets: PositiveInt | None = None  #: number of ridges in view
    axis_px: float | None = None  #: symmetry axis
    fit: FitChoice = "auto"  #: subpixel method: "auto", "sliding", "paper" or "template"
    window_px: Annotated[int | Literal["auto"], check_window] | None = None  #: of the fit, odd
    #: Manual corrections, or the name of their file. Those of the strip, the axis and the clock take
    #: precedence over `rows`, `axis_px` and `offset_s`.
    corrections: Annotated[tuple[Correction, ...], check_corrections] = ()
    #: µm per pixel (None: as the film's file states). Without it: no lengths in µm and no deformation.
    pixel_size_um: Annotated[float, check_pixel_size] | None = None
    pixel_size_err_um: NonNegative | None = None  #: its error
    pitch_um: Positive | None = None  #: mean distance of neighbouring sheets, which gives the pixel size
    pitch_err_um: NonNegative | None = None  #: its error, which gives that of the pixel size
    speed_mm_min: Positive | None = None  #: V, if no displacement is recorded
    d0_mm: _Separation | None = None  #: initial separation
    d0_err_mm: _Separation | None = None  #: its error
    force_columns: Mapping[str, str] | None = None  #: the recording's columns by role
    force_threshold_N: NonNegative | None = None  #: smallest drop of the force that counts as a slip
    #: Time constant of the load cell to correct for; 0: none; "auto": found, if it is proven.
    force_lowpass_s: _Seconds = 0.0
    #: Time over which a load that rings is averaged; 0: none; "auto": the period of the ringing.
    force_average_s: _Seconds = 0.0
    #: Separations between which the models are fitted.
    fit_range_mm: Annotated[tuple[float, float], check_fit_range] | None = None
    mu: Positive | None = None  #: friction coefficient, if it is known
    modulus_GPa: Positive | None = None  #: Y_eff, if it is known
    machine_stiffness_N_per_mm: Positive | None = None  #: by which d is corrected
    offset_s: float | None = None  #: force clock at video time 0
    threshold: Annotated[float, check_threshold] = STIFF_BELOW  #: σ_x/Λ_st below which a sheet is stiff
    common_mode: bool = True  #: whether the motion that all sheets share (the camera's) is subtracted
    #: Geometry and adhesion (None: the publication's, with a remark that it is assumed).
    sample: Sample | None = None
    geometry_err: Mapping[str, float] = field(default_factory=dict)  #: errors of the sample's fields by name
    t_star_fitted: bool = False  #: whether T*, which can hardly be separated from μ, is fitted as well
    tuning: Tuning = field(default_factory=Tuning)  #: constants of the stages

    def __post_init__(self) -> None:
        for name, of_file in (("timestamps", Path), ("corrections", read_corrections)):
            if isinstance(value := getattr(self, name), PATH):
                object.__setattr__(self, name, of_file(Path(value)))
        check_fields(self)
        for name, unit in (("pixel_size", "um"), ("pitch", "um"), ("d0", "mm")):
            value, error = getattr(self, f"{name}_{unit}"), getattr(self, f"{name}_err_{unit}")
            if value and error and error > value:
                raise InputError(f"`{name}_err_{unit}`", f"at most the value {value:g}", f"{error:g}")


_TYPED = {
    "strip": "rows", "scale": "pixel_size_um", "fix_mu": "mu", "fix_yeff": "modulus_GPa",
    **dict.fromkeys(("thickness", "width", "length", "sheets_per_block", "t_star"), "sample"),
}  # fmt: skip
"""Options of the command that have another name in `Settings`, apart from its unit."""


def _nearest_setting(word: str) -> str:
    """Return which setting may have been meant by a word, such as an option of the command."""
    known = Settings.__dataclass_fields__
    meant = _TYPED.get(word) or next((name for name in known if name.startswith(f"{word}_")), "")
    return f"did you mean {meant}?" if meant else did_you_mean(word, known)


_OF_STICKS = {name: f"force_{name}" for name in ("threshold_N", "lowpass_s", "average_s")}
"""Arguments of `find_stick_slip` and what `Settings` calls them."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Analysis(Results):
    """Results of all stages for one test. The result of a stage that could not run is None.

    Its other fields are those of `vision.figures.Results`.
    """

    settings: Settings  #: the requested options
    video: Video | None = None  #: the recording
    failures: Mapping[str, str] = field(default_factory=dict)  #: by stage: traceback of an unexpected error
    seconds: Mapping[str, float] = field(default_factory=dict)  #: wall-clock time of each stage

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel; None if it is unknown."""
        return self.settings.pixel_size_um

    @property
    def pixel_size_err_um(self) -> float | None:
        """Its error; None if it is unknown."""
        return self.settings.pixel_size_err_um

    @property
    def threshold(self) -> float:
        """σ_x/Λ_st below which a sheet is stiff."""
        return self.settings.threshold

    @property
    def plot(self) -> Plots:
        """All figures by name: ``analysis.plot.tracks(ax=None)`` takes and returns an Axes."""
        return Plots(self)

    @property
    def assumed_sample(self) -> Sample | None:
        """The publication's sample if models are fitted and none was given, else None."""
        return PUBLISHED if self.fits is not None and self.settings.sample is None else None

    def summary(self) -> list[str]:
        """Return the results in about ten lines of text."""
        return summary_lines(self, self.assumed_sample)

    def __repr__(self) -> str:
        return "\n".join(self.summary())

    def _repr_html_(self) -> str:
        found: dict[str, str] = {}
        name = ""
        for one in summary_items(self, self.assumed_sample):
            name = one.what or name
            found[name] = f"{found[name]}; {one.text}" if name in found else one.text
        text = html_table("analysis", found | numbered("warning", self.warnings))
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
    **options: Any,
) -> Analysis:
    """Run every stage on one test, in order.

    Parameters
    ----------
    video
        A file, a folder or pattern of images, or an open `Video`; None for a force recording alone.
    force
        A testing machine's file, or a recording from `read_force`; None for a video alone.
    settings
        Options; those not given are found from the data. Those of a film that is open and of a recording that
        was read are as they were opened.
    earlier
        An analysis of the same video with other settings. Its strip, tracks and clock are reused unless a
        changed setting or correction affects them. With the strip reused, no video is needed.
    progress
        Called with (frames done, total frames or None) while the video is read.
    log
        `vision.run.reading.Checkpoint`, which stores what is read so that an interrupted run can be resumed.
    follow
        `vision.video.Follow`, which reads a growing recording until it is closed.
    options
        Fields of `Settings`, in place of those in `settings`: ``analyse("test.avi", fps=60)``.

    Returns
    -------
    Analysis
        The results. If a stage after the tracking is not possible, its result is None and `reasons` says why.
        After an unexpected error in such a stage, only the stages that need its result are skipped.

    Raises
    ------
    InputError
        If the video or force recording cannot be read, or the video shows no ridges.
    """
    if video is None and force is None and earlier is None:
        raise InputError("`video` and `force`", "at least one of them", "none")
    _check_arguments(video, force, settings)
    if unknown := [name for name in options if name not in Settings.__dataclass_fields__]:
        raise InputError("`options`", "fields of `Settings`", unknown[0], _nearest_setting(unknown[0]))
    chosen = _with_opened(replace(settings or Settings(), **options), video, force)
    if chosen.strips != 1 and follow is not None:
        raise InputError("`strips` and `follow`", "one of the two", "both", "track again when it is complete")
    if chosen.pitch_um is not None and (chosen.pixel_size_um, chosen.pixel_size_err_um) != (None, None):
        raise InputError("`pitch_um` and `pixel_size_um`", "one of the two", "both")
    stages = _Stages()
    # Reading a video takes long, so an unreadable force file is rejected first.
    machine = None if force is None else stages.required("reading force", open_force, force, chosen)
    film = None if video is None else open_recording(video, chosen, follow)
    found = _reusable(earlier, Analysis(settings=chosen, video=film, force=machine))
    if film is not None and found.strip is None:
        check_recordings(film, None if follow else machine, chosen)
    found = _read_and_track(stages, found, progress, log, follow)
    chosen, tracks = found.settings, found.tracks
    sticks = stages.optional("sticks", _sticks, machine, chosen, alone=found.strip is None)
    fits = stages.optional("fits", _fits, machine, sticks, chosen)
    clock = found.clock or stages.optional("clock", _clock, tracks, machine, sticks, chosen)
    motion = stages.optional("motion", _motion, tracks, sticks, clock, chosen)
    shells = stages.optional("shells", partial(_shells, fits), motion, chosen)
    found = replace(
        found,
        force=machine,
        sticks=sticks,
        fits=fits,
        clock=clock,
        motion=motion,
        shells=shells,
        reasons=stages.reasons,
        failures=stages.failures,
        seconds=stages.seconds,
    )
    return replace(found, warnings=all_warnings(found))


def all_warnings(found: Analysis) -> tuple[str, ...]:
    """Return the warnings that matter for the results, in the order of the stages, without repetition."""
    lines: list[str] = []
    tuning = found.settings.tuning
    if (tracks := found.tracks) is not None:
        lines += warnings_of(tracks)
        if found.frame is not None:
            strip = StripMetadata.of(tracks)
            rows, dark = slice(strip.strip_z0, strip.strip_z1), TrackMetadata.of(tracks).ridges == "dark"
            frame = found.frame if found.strip is None else found.frame[:, found.strip["x"].values]
            lines += overexposure(frame, rows, tuning.video, dark=dark)
        lines += tracking_warnings(tracks, tuning.checks, tuning.tracking)
        lines += decision_warnings(tracks, found.settings.corrections)
        lines += consistency_warnings(
            tracks,
            found.settings.sample,
            assumed=found.assumed_sample,
            pixel_size_um=found.pixel_size_um,
            columns=None if found.strip is None else found.strip["x"].values,
            settings=tuning.checks,
        )
    if found.force is not None:
        lines += warnings_of(found.force, found.sticks)
        facts = ForceMetadata.of(found.force)
        if facts.lacks_d0:
            lines.append(
                "the initial separation is not known: d is how far the machine moved, and no model is "
                "fitted; give `d0_mm` (0 if the displacement is the separation itself)"
            )
        elif "fits" in found.reasons and math.isfinite(facts.d0_mm) and load_unit(found.force) == "N":
            lines.append(f"no model fits: {found.reasons['fits']}")
    lines += found.fits.warnings if found.fits else ()
    lines += found.clock.warnings if found.clock else ()
    lines += warnings_of(found.motion)
    codec = "" if tracks is None else StripMetadata.of(tracks).codec
    lines += shells_against_fits(found.shells, found.fits, tuning.shells, codec=codec)
    lines += unlike_sides(found.shells, tuning.shells)
    return tuple(dict.fromkeys(renamed(line, _OF_STICKS) for line in lines))


def _check_arguments(video: object, force: object, settings: object) -> None:
    """Refuse arguments of another kind than `analyse` takes.  Raises: InputError."""
    if isinstance(force, Settings):
        advice = "`settings` is the third argument: analyse(video, force, settings)"
        raise InputError("`force`", "a file or a recording", "Settings", advice)
    films = "the path of a video, or what `vision.open_video` returns"
    check_kind((Video, *PATH, NoneType), films, video=video)
    recordings = "the path of a force recording, or what `vision.read_force` returns"
    check_kind((xr.Dataset, *PATH, NoneType), recordings, force=force)
    check_kind(Settings | None, "a `Settings`, as in Settings(pixel_size_um=10)", settings=settings)


def _with_opened(chosen: Settings, video: object, force: object) -> Settings:
    """Return the settings with those of a film that is open and of a recording that was read.

    Raises: InputError if another one is given, which would change nothing.
    """
    opened: dict[str, dict[str, Any]] = {}
    if isinstance(video, Video):
        frames = None if (video.first, video.stop) == (0, None) else slice(video.first, video.stop)
        clock = {"fps": video.given_fps, "timestamps": video.timestamps}
        opened["the film was opened"] = {"rotate": video.rotate, "frames": frames, **clock}
    if isinstance(force, xr.Dataset):
        read, names = parameters_of(force, "read_force"), ("speed_mm_min", "d0_mm", "d0_err_mm")
        columns = {"force_columns": read.get("columns")}
        opened["`force` was read"] = {name: read.get(name) for name in names} | columns
    default = Settings()
    for done, values in opened.items():
        for name, value in values.items():
            given = getattr(chosen, name)
            if given == getattr(default, name):
                chosen = replace(chosen, **{name: value})
            elif _comparable(given) != _comparable(value):
                wanted = f"{'none' if value is None else value}, with which {done}"
                raise InputError(
                    f"`{name}`", wanted, str(given), "do that again with this value, or give the path"
                )
    return chosen


def _comparable(value: object) -> object:
    """Return a setting in one form: a whole path, and frames from 0 if no start is given."""
    if isinstance(value, slice):
        return None if (value.start or 0, value.stop) == (0, None) else slice(value.start or 0, value.stop)
    return value.resolve() if isinstance(value, Path) else value


_OF_TRACKS = ("ridges", "sheets", "axis_px", "fit", "window_px", "tuning.tracking")
_OF_SLIPS = ("force_columns", "force_threshold_N", "force_lowpass_s", "force_average_s", "tuning.force")
_OF_CLOCK = ("offset_s", "tuning.clock", *_OF_SLIPS)
_AFTERWARDS = (
    *("pixel_size_um", "pixel_size_err_um", "pitch_um", "pitch_err_um", "speed_mm_min", "d0_mm", "d0_err_mm"),
    *("machine_stiffness_N_per_mm", "fit_range_mm", "mu", "modulus_GPa", "threshold", "common_mode"),
    *("sample", "geometry_err", "t_star_fitted", "corrections"),
    *("tuning.fits", "tuning.deformation", "tuning.shells", "tuning.checks"),
)
"""Settings that change the tracks, the clock, and only the stages after it. Those that no list names change
the strip. What changes, changes the next, too; so does the force."""


def _reusable(earlier: Analysis | None, new: Analysis) -> Analysis:
    """Return `new` with the earlier strip, tracks and clock, unless a changed setting affects them.

    Raises: InputError if the strip must be read again but there is no film.
    """
    if earlier is None:
        return new
    before, now = earlier.settings, new.settings

    def decisions(settings: Settings, kinds: Sequence[str]) -> list[Any]:
        return [one.what for one in ordered(settings.corrections) if one.kind in kinds]

    def unchanged(kind: str) -> bool:
        return decisions(before, [kind])[-1:] == decisions(now, [kind])[-1:]  # only the last one counts

    changed = _changed_of_strip(before, now)
    changed += [] if unchanged("strip") else ["corrections"]
    films = [one.video.stamp for one in (earlier, new) if one.video is not None]
    strip = None if changed or len(set(films)) == 2 else earlier.strip
    same_sheets = unchanged("axis") and decisions(before, OF_SHEETS) == decisions(now, OF_SHEETS)
    same_sheets = same_sheets and not _changed(before, now, _OF_TRACKS)
    tracks = earlier.tracks if strip is not None and same_sheets else None
    if tracks is None and now.strips != 1:
        strip, changed = None, ["strips"]  # the parts of the strip, which tracking needs, are not stored
    if strip is None and new.video is None:
        wanted = "the film, to be read again"
        if changed:
            wanted += f" for {' '.join(f'`{name}`' for name in changed)}"
        raise InputError("the strip", wanted, "none", "say where it lies (`film`)")
    recordings = [one.force for one in (earlier, new) if one.force is not None]
    # A stored run has no recording, but that which is read is its own.
    same_force = new.force is not None and all(one.equals(new.force) for one in recordings)
    same_clock = unchanged("clock") and not _changed(before, now, _OF_CLOCK) and same_force
    clock = earlier.clock if tracks is not None and same_clock else None
    return replace(new, strip=strip, tracks=tracks, clock=clock)


def _changed(before: Settings, now: Settings, names: Sequence[str]) -> list[str]:
    """Return the names of the settings among these that differ."""
    return [name for name in names if attrgetter(name)(before) != attrgetter(name)(now)]


def _changed_of_strip(before: Settings, now: Settings) -> list[str]:
    """Return the names of the settings that differ and change the strip."""
    every = {*vars(now)} - {"tuning"} | {f"tuning.{stage}" for stage in vars(now.tuning)}
    return _changed(before, now, sorted(every - {*_OF_TRACKS, *_OF_CLOCK, *_AFTERWARDS}))


def still_apply(
    corrections: Sequence[Correction], before: Settings, now: Settings, *, same_clocks: bool
) -> tuple[Correction, ...]:
    """Return the corrections of a run that hold for the same film with other settings.

    The strip holds if the same pixels are read, decisions about sheets and the axis if the sheets are also
    found in the same way, and the clock if times and slips are the same, too.  before, now: settings without
    corrections.  same_clocks: whether the content of the force recording and the time stamps is the same.
    """
    changed = _changed_of_strip(before, now)
    strip = {*changed} <= {"fps", "timestamps", "strips"}
    tracks = strip and not _changed(before, now, _OF_TRACKS)
    clock = not changed and same_clocks and not _changed(before, now, _OF_CLOCK)
    holds = {"strip": strip, "clock": clock}
    return tuple(one for one in corrections if holds.get(one.kind, tracks))


class _Stages:
    """Runs stages. Records the time each takes, and why a stage has no result."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.reasons: dict[str, str] = {}
        self.failures: dict[str, str] = {}

    def required(self, name: str, work: Callable[..., Result], *inputs: Any) -> Result:
        """Run a stage without which there is no analysis; its errors are raised."""
        started = time.perf_counter()
        try:
            return work(*inputs)
        finally:
            give_back_freed()
            self.seconds[name] = time.perf_counter() - started

    def optional(
        self, name: str, work: Callable[..., Result], *inputs: Any, alone: bool = False
    ) -> Result | None:
        """Run a stage; return None if an input is None or if the stage ends in an error, which is recorded.

        alone: there is no other result yet, so errors are raised as in `required`.
        """
        if any(part is None for part in inputs):
            return None
        if alone:
            return self.required(name, work, *inputs)
        try:
            return self.required(name, work, *inputs)
        except InputError as error:
            self.reasons[name] = str(error)
        except Exception as error:  # no error in a late stage may lose the results of the earlier ones
            self.reasons[name] = unexpected(error)
            self.failures[name] = traceback.format_exc()
        return None


def _read_and_track(
    stages: _Stages,
    reused: Analysis,
    progress: Progress | None,
    log: ReadingLog | None,
    follow: Follow | None,
) -> Analysis:
    """Return the analysis with its first frame and, unless they are reused, its strip and tracks."""
    chosen, film, strip, tracks = reused.settings, reused.video, reused.strip, reused.tracks
    frame, parts = None, None
    if film is not None:
        if strip is None:
            read = partial(_strip, film, chosen, progress, log, follow)
            strip, parts = stages.required("reading", _suggesting_rotation, film, chosen, read)
        if follow is not None:  # the file has grown since it was opened
            with suppress(InputError):
                film = open_recording(film.path, chosen)
        frame = stages.required("first frame", reference_frame, film)
    if strip is not None and tracks is None:
        track = partial(track_strip, strip, chosen, parts)
        tracks = stages.required("tracking", _suggesting_rotation, film, chosen, track)
    if tracks is not None:
        size = pixel_size_of(tracks, pixel_size_um=chosen.pixel_size_um, pitch_um=chosen.pitch_um)
        chosen = replace(chosen, pixel_size_um=size)
        if size is not None and chosen.pitch_um is not None and chosen.pitch_err_um is not None:
            relative = chosen.pitch_err_um / chosen.pitch_um
            chosen = replace(chosen, pixel_size_err_um=size * relative)
    return replace(reused, settings=chosen, video=film, frame=frame, strip=strip, tracks=tracks)


def open_recording(video: Video | str | Path, chosen: Settings, follow: Follow | None = None) -> Video:
    """Open a video with the rotation, frames and time stamps of the settings; an open one is returned as is.

    With `follow`, wait until the recording exists.
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
    video: Video, chosen: Settings, progress: Progress | None, log: ReadingLog | None, follow: Follow | None
) -> tuple[xr.DataArray, xr.DataArray | None]:
    """Return I(x, t) of the strip, and that of its parts if `strips` asks for them."""
    rows = _rows(chosen)
    how: dict[str, Any] = {"columns": chosen.columns, "progress": progress, "settings": chosen.tuning.video}
    if chosen.strips != 1:
        return strip_profiles(video, chosen.strips, rows, folder=None if log is None else log.folder, **how)
    return strip_profile(video, rows, log=log, follow=follow, **how), None


def _rows(chosen: Settings) -> slice | None:
    """Return the rows of the strip, if they are given; those of a correction take precedence."""
    correction = last_of(chosen.corrections, "strip")
    return chosen.rows if correction is None or correction.rows is None else slice(*correction.rows)


def check_recordings(film: Video, force: xr.Dataset | None, chosen: Settings) -> None:
    """Reject what the picture or the recordings cannot have before they are read.  Raises: InputError."""
    (height, width), window = film.shape, chosen.window_px
    cut(_rows(chosen), height, what=f"{film.path}: `rows`")
    cut(chosen.columns, width, what=f"{film.path}: `columns`")
    check_axis(chosen.axis_px, 0, width - 1)
    if isinstance(window, int) and window > width:
        raise InputError("`window_px`", f"at most the picture's {width} columns", str(window), "try auto")
    offset_s, drift_ppm = _given_clock(chosen)
    if force is not None and offset_s is not None and film.expected and not film.facts.times_in_blocks:
        times_s = film.times(np.array([film.first, film.first + film.expected - 1]))
        if np.isfinite(times_s).all():
            given_clock(offset_s, drift_ppm, times_s, force)


def _suggesting_rotation(film: Video | None, chosen: Settings, work: Callable[[], Result]) -> Result:
    """Return ``work()``. If it fails, the error names a saturated film or horizontal ridges."""
    try:
        return work()
    except InputError as error:
        share = _saturated(film) if film is not None and isinstance(error, NoRidgesError) else 0.0
        if film is not None and share > chosen.tuning.checks.most_saturated:
            found = f"a saturated picture: {100 * share:.0f} % of the pixels are at the brightest grey level"
            raise InputError(film.path, "upright ridges", found, "film with less light") from None
        rows_given = chosen.rows is not None or chosen.columns is not None
        if film is None or rows_given or not _has_horizontal_ridges(film):
            raise
        found, way = "horizontal ridges, one above the other", (film.rotate + 90) % 360
        if film.rotate == 90:  # rather as recorded than upside down
            way = 0
        raise InputError(film.path, "upright ridges", found, f"give `rotate` {way}") from None


def _saturated(film: Video) -> float:
    """Return the share of saturated pixels in the first frame, 0 if it is not known."""
    level = film.saturation_level
    with suppress(InputError):
        return 0.0 if level is None else float((reference_frame(film) >= level).mean())
    return 0.0


def _has_horizontal_ridges(film: Video) -> bool:
    """Return whether the film shows a comb when it is rotated by 90 degrees."""
    rotated = replace(film, rotate=(film.rotate + 90) % 360)
    try:
        rows = find_strip(rotated).rows
        pictures = [picture[rows].mean(axis=0, dtype=np.float32) for picture in rotated.sample(8)]
        comb = describe_ridges(np.stack(pictures))
    except (InputError, ValueError):  # no ridges in this direction either, or no picture
        return False
    return comb.count >= 5  # two or three ridges can be found in any picture


def track_strip(strip: xr.DataArray, chosen: Settings, parts: xr.DataArray | None = None) -> xr.Dataset:
    """Track the sheets with the options of the settings; in the parts of the strip as well, if given."""
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
    """Read a force recording with the options of the settings; a dataset is only checked."""
    if isinstance(force, xr.Dataset):
        FORCE.check(force)
        return force
    return read_force(
        force,
        speed_mm_min=chosen.speed_mm_min,
        d0_mm=chosen.d0_mm,
        d0_err_mm=chosen.d0_err_mm,
        columns=chosen.force_columns,
        settings=chosen.tuning.force,
    )


@known_as(columns="force_columns", **_OF_STICKS)
def _sticks(force: xr.Dataset, chosen: Settings) -> pd.DataFrame:
    return find_stick_slip(
        force,
        threshold_N=chosen.force_threshold_N,
        machine_stiffness_N_per_mm=chosen.machine_stiffness_N_per_mm,
        lowpass_s=chosen.force_lowpass_s,
        average_s=chosen.force_average_s,
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
        settings=chosen.tuning.fits,
    )


def _clock(tracks: xr.Dataset, force: xr.Dataset, sticks: pd.DataFrame, chosen: Settings) -> Clock:
    offset_s, drift_ppm = _given_clock(chosen)
    return synchronise(
        tracks, force, sticks, offset_s=offset_s, drift_ppm=drift_ppm, settings=chosen.tuning.clock
    )


def _given_clock(chosen: Settings) -> tuple[float | None, float]:
    """Return the given offset, None without, and drift; those of a correction take precedence."""
    correction = last_of(chosen.corrections, "clock")
    return (chosen.offset_s, 0.0) if correction is None else (correction.offset_s, correction.drift_ppm)


def _motion(tracks: xr.Dataset, sticks: pd.DataFrame, clock: Clock, chosen: Settings) -> xr.Dataset:
    unmatched = min(clock.unmatched_video, clock.unmatched_force)
    if clock.status == "given" and clock.matched == 0 and unmatched >= 3:  # of fewer slips, all may be missed
        given = "the given offset" if clock.how == "given" else "the column of video times"
        found = f"none of {clock.unmatched_video} and {clock.unmatched_force} with {given}"
        advice = "check it, and whether the two files belong together"
        raise InputError("the clocks", "slips that coincide in video and force", found, advice)
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
