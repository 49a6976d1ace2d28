"""`track VIDEO…`: track one film, several in turn, or one that a camera is still writing."""

from __future__ import annotations

import gc
import math
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr

from vision.command.console import attempt, complain, conclude, frame_progress, in_columns, say
from vision.command.main import prepare_review
from vision.command.options import ForceOptions, RunOptions, TestOptions, flag_of, option_names
from vision.command.settings import merged, parameters_given, settings_of, settings_of_run
from vision.data import FlagCounts, StripMetadata
from vision.errors import InputError, counted
from vision.files import AGAIN, TIFF, answered, reading
from vision.folder import check_target
from vision.force.files import EXCEL
from vision.pipeline import Analysis, Settings, analyse, open_recording, still_apply, track_strip
from vision.run.provenance import Checksums, Origin, Parameter, checksum_of, describe_input
from vision.run.reading import (
    Checkpoint,
    RunFolder,
    analyse_again,
    film_if_there,
    is_run,
    read_run,
    stored_analysis,
)
from vision.run.writing import FAILURES, set_aside, write_run
from vision.sheets.corrections import Correction, read_decisions
from vision.summary import aligned, findings, noise_figures
from vision.video import Follow, open_video, video_files
from vision.video.raw import PIXELS, is_photron
from vision.video.stacks import IMAGES
from vision.video.video import FILMS, files_in

OVERLAY = "_overlay"  # follows a run's name in that of the film which `track overlay` writes
TABLES = {".txt", ".csv", ".tsv", ".dat", ".lvm", ".tra", ".mat", ".xls", *EXCEL}  # not of films
LONG_FRAMES = 20_000
"""Number of frames from which a run stores what a review shows first. This takes seconds, where tracking took
minutes; a review reads shorter runs while its page loads."""


def track_films(
    videos: Sequence[Path],
    groups: Sequence[Any],
    run: RunOptions,
    config: Path | None,
    moved: Path | None = None,
) -> int:
    """Track one video or several, and return the exit status.

    groups: options of the video, the test, the force recording and the sample.  moved: new path of the film
    of a run folder.
    """
    parameters = merged(*groups, config=config)
    videos = [film for video in videos for film in films_of(video)]
    tables = [video for video in videos if video.suffix.lower() in TABLES]
    if tables and len(videos) <= len(tables) + 1:
        advice = "give a force recording with --force, times of frames with --timestamps"
        raise InputError(tables[0], "a video", "a table, by its name", advice)
    if len(videos) == 1 and is_run(videos[0]):
        return measure_again(videos[0], parameters, run, config, moved)
    if moved is not None:
        raise InputError("`film`", "a run folder whose film was moved", "a video", "leave the option out")
    if len(videos) == 1:
        _check_force(parameters)
        target = run.out or Path(f"{run_name(videos[0])}_tracks")
        return track_one(videos[0], target, parameters, run, config=config)[0]
    if run.follow:
        raise InputError("`follow`", "one video", f"{len(videos)}", "follow each in its own terminal")
    targets = _targets_of(videos, run.out, parameters)
    settings_of(parameters)  # an invalid option is reported once, not for every film
    _check_force(parameters)
    return _track_several(targets, parameters, run, config)


def films_of(video: Path) -> list[Path]:
    """Return the films of a folder or of a pattern, else the path itself. Pictures beside films are left out.

    A folder often holds pictures of its films, such as those of `track preview`, and overlays of its runs,
    which are left out as well.
    """
    if not answered(lambda: not is_run(video) if video.is_dir() else not video.exists(), video):
        return [video]
    films = [
        film
        for film in answered(lambda: files_in(video, FILMS), video)
        if not (film.stem.endswith(OVERLAY) and is_run(film.with_name(film.stem.removesuffix(OVERLAY))))
    ]
    if films and (pictures := answered(lambda: files_in(video, IMAGES), video)):
        both = f"{counted(len(films), 'film')} and {counted(len(pictures), 'picture')}"
        complain(f"{video}: {both}; the films are used (for the pictures, quote a pattern such as '*.png')")
    return films or [video]


def one_film(video: Path) -> Path:
    """Return the film of a folder that holds one, else the path itself.  Raises: InputError for several."""
    films = films_of(video)
    if len(films) > 1:
        raise InputError(video, "one film", f"{len(films)}", f"name one of them, such as {films[0].name}")
    return films[0]


def _check_force(parameters: Mapping[str, Parameter]) -> None:
    """Refuse typed options of the force without a recording; a configuration file may hold them."""
    names = [one.name for group in (ForceOptions, TestOptions) for one in fields(group)]
    typed = [flag_of(name) for name in names if parameters[name].how == "given"]
    if typed and parameters["force"].value is None:
        raise InputError(", ".join(typed), "also the force recording", "none", "give --force FILE")


def track_one(
    video: Path,
    target: Path,
    parameters: dict[str, Parameter],
    run: RunOptions,
    *,
    one_of_many: bool = False,
    copy: Path | None = None,
    config: Path | None = None,
    decide_again: bool = False,
) -> tuple[int, Analysis]:
    """Track one film into one run folder; return the exit status and the analysis, of a long film without
    I(x, t), force and motion, and without the tracks unless it is one of many.

    one_of_many: whether several films are tracked. Each warning then names its film, and the summary is
    printed only if `run.verbose`, as a table of all films follows.  copy: copy of the film, which is read
    instead, if there is one.  config: file from which options were taken, recorded as an input.
    decide_again: whether decisions of the run that is replaced are applied, unless others are given.
    """
    if not gc.get_freeze_count():
        gc.freeze()  # the libraries' objects stay: looking through them takes 0.1 s at the end of each stage
    settings, force = settings_of(parameters), parameters["force"].value
    if decide_again and parameters["corrections"].value is None:
        settings = replace(settings, corrections=_still_valid(target, video, force, settings))
    _check_run(video, target, run, settings)
    along = run.checksum and not run.follow and copy is None and video.exists()
    checkpoint, sums = Checkpoint(target, resume=run.resume), Checksums(video_files(video) if along else ())
    with checkpoint, sums, _resumable(checkpoint):
        if run.follow:
            with _following(settings, quiet=run.quiet) as follow:
                analysis = analyse(copy or video, force, settings, follow=follow)
        else:
            with frame_progress("reading", quiet=run.quiet) as progress:
                show = sums.following(progress)
                analysis = analyse(copy or video, force, settings, progress=show, log=checkpoint)
        # A review expects the film first and the force recording last.
        files = (parameters["timestamps"].value, config, parameters["corrections"].value, force)
        inputs = (*video_files(video), *(file for file in files if file is not None))
        analysis = _warn_of_other_film(analysis, parameters["corrections"].value, inputs[0])
        if kept := set_aside(target, analysis.settings.corrections, undone=False):
            some = "some " if decide_again and settings.corrections else ""
            line = f"{some}decisions of the earlier run were not applied: "
            line += f"give {target / kept} as `corrections`"
            analysis = replace(analysis, warnings=(*analysis.warnings, line))
        parameters = {**parameters, **parameters_given(run, config=config)}
        origin = origin_of(inputs, parameters, checksum=run.checksum, described=sums.found())
        facts = {"frames_resumed": checkpoint.resumed} if checkpoint.resumed else None
        write_run(analysis, target, origin, overwrite=run.overwrite, report=run.report, facts=facts)
        checkpoint.remove()
    status = finish(
        analysis,
        target,
        "overview.png",
        quiet=run.quiet or (one_of_many and not run.verbose),
        verbose=run.verbose,
        about=f"{video.name}: " if one_of_many else "",
    )
    if analysis.tracks is not None and analysis.tracks.sizes["frame"] >= LONG_FRAMES:
        # These are in the run folder, and most of what is in memory; a table of many films shows the tracks.
        shown = analysis.tracks if one_of_many else None
        analysis = replace(analysis, strip=None, tracks=shown, force=None, motion=None)
        prepare_review(target, settings)
    return status, analysis


def measure_again(
    folder: Path,
    parameters: Mapping[str, Parameter],
    run: RunOptions,
    config: Path | None,
    moved: Path | None = None,
) -> int:
    """Measure a finished run with other options; return the exit status.

    Options that are not given are those of the run, also its corrections. What they do not change is used
    again: the film is read for another strip only.
    """
    if along := [name for name in ("follow", "resume", "checksum") if getattr(run, name)]:
        raise InputError(folder, f"a video with {flag_of(along[0])}", "a run folder", "leave the option out")
    typed = [name for name, one in parameters.items() if one.how != "default"]
    if not typed:
        advice = "give --pixel-size, for example; track review, figures and export take a run as it is"
        raise InputError(folder, "a video, or options to measure a run again with", "a run folder", advice)
    stored, target = read_run(folder), run.out or folder
    check_target(target, overwrite=run.overwrite)
    before = settings_of_run(folder)
    earlier, force = stored_analysis(stored, before), parameters["force"].value
    if force is None:
        force = stored.force()
    else:
        earlier = replace(earlier, clock=None)
    settings, parameters = _with_options(before, stored, parameters, typed)
    film = film_if_there(stored, settings, moved, asked=True)
    with frame_progress("reading", quiet=run.quiet) as progress:
        analysis = analyse_again(stored, settings, film, force, earlier=earlier, progress=progress)
    files = {"timestamps": settings.timestamps, "force": force}  # where they are, seen from here
    parameters |= {name: replace(parameters[name], value=file) for name, file in files.items()}
    with reading(folder, "a run folder as track writes it", AGAIN):
        known = {stored.found(Path(str(one["path"]))): one for one in stored.facts["inputs"]}
        film_files = video_files(moved or next(iter(known)))
    used = (*film_files, settings.timestamps, config, parameters["corrections"].value, force)
    origin = origin_of(
        [file for file in map(Path, filter(None, used)) if file in known or file.exists()],
        parameters | parameters_given(run, config=config),
        described={file: {**one, "path": str(file)} for file, one in known.items()},
    )
    write_run(analysis, target, origin, overwrite=run.overwrite, report=run.report)
    return finish(analysis, target, "overview.png", quiet=run.quiet, verbose=run.verbose)


def _with_options(
    before: Settings, stored: RunFolder, parameters: Mapping[str, Parameter], typed: Sequence[str]
) -> tuple[Settings, dict[str, Parameter]]:
    """Return the settings of a run, and its options, with those that are typed in place of its own."""
    sizes = ("pixel_size", "pixel_size_err", "scale", "pitch")  # of which one replaces all
    names = [*typed, "corrections", *(sizes if any(name in typed for name in sizes) else ())]
    options = {**parameters, **stored.parameters, **{name: parameters[name] for name in names}}
    settings = settings_of(options)
    kept: dict[str, Any] = {"tuning": before.tuning, "t_star_fitted": before.t_star_fitted}  # are no options
    if "timestamps" not in typed:
        kept["timestamps"] = before.timestamps
    if "corrections" not in typed:
        kept["corrections"] = tuple(stored.applied)
    return replace(settings, **kept), options


def _check_run(video: Path, target: Path, run: RunOptions, settings: Settings) -> None:
    """Refuse options that exclude each other, a run folder in place of a film, and a folder that is kept."""
    if run.follow and run.resume:
        raise InputError("`follow` and `resume`", "one of the two", "both")
    if run.resume and settings.strips != 1:
        raise InputError("`resume` and `strips`", "one of the two", "both", "leave `resume` out")
    if is_run(video):
        advice = "give it alone to measure it again with other options"
        raise InputError(video, "a video or a folder of images", "a run folder", advice)
    if run.resume and not run.overwrite and is_run(target):
        advice = "give `overwrite` to track the film again"
        raise InputError(target, "an interrupted run to resume", "one that is finished", advice)
    try:
        check_target(target, overwrite=run.overwrite)
    except InputError:
        if not run.follow:
            open_recording(video, settings)  # reports first that there is no film
        raise


def _still_valid(target: Path, video: Path, force: Path | None, settings: Settings) -> tuple[Correction, ...]:
    """Return the decisions of the run in a folder that also hold for this film with these settings."""
    if not is_run(target):
        return ()
    with suppress(InputError):  # a damaged run: its decisions are kept beside the new one
        stored = read_run(target)
        if stored.applied and _is_input(stored, video):
            clocks = [file for file in (force, settings.timestamps) if file is not None]
            same = all(_is_input(stored, file) for file in clocks)
            return still_apply(stored.applied, settings_of_run(target), settings, same_clocks=same)
    return ()


def _is_input(stored: RunFolder, path: Path) -> bool:
    """Return whether a file has the content of one that a run was made from."""
    now = describe_input(path)
    known = [one for one in stored.facts.get("inputs") or () if one.get("size_bytes") == now["size_bytes"]]
    if any("sha256" in one for one in known) and "sha256" not in now:  # the run was made with --checksum
        now = describe_input(path, whole=True)
    return checksum_of(now) in map(checksum_of, known)


def _warn_of_other_film(analysis: Analysis, corrections: Path | None, film: Path) -> Analysis:
    """Return the analysis, with a warning if the file of corrections was made for another film."""
    checksum = "" if corrections is None else read_decisions(corrections).film
    known = describe_input(film) if checksum else {}
    if checksum in ("", known.get("sha256"), known.get("fingerprint")):
        return analysis
    if checksum == describe_input(film, whole=True).get("sha256"):  # the run was made with --checksum
        return analysis
    line = (
        f"`corrections` were made for another film: the checksum in {corrections} is not that of {film.name}"
    )
    return replace(analysis, warnings=(*analysis.warnings, line))


@contextmanager
def _resumable(checkpoint: Checkpoint) -> Iterator[None]:
    """Make a KeyboardInterrupt say how many frames a later run with --resume need not read again."""
    try:
        yield
    except KeyboardInterrupt:
        kept = checkpoint.kept
        raise KeyboardInterrupt(f"{kept} frames are stored for --resume" if kept else "") from None


def run_name(video: Path) -> str:
    """Return the base name of the run folder: that of the film, or a pattern without its wildcards."""
    path = video.absolute() if video.name else video.resolve()
    is_there, is_folder = answered(lambda: (path.exists(), path.is_dir()), video)
    if is_there:
        return path.name if is_folder else path.stem
    readable = "".join(c for c in path.stem if c not in '*?[]<>|:"').strip("_-. ")
    return readable or path.parent.name or "video"


def origin_of(inputs: Sequence[Path], parameters: dict[str, Parameter], **more: Any) -> Origin:
    """Return the provenance of what this command writes, whose messages name options."""
    command = shlex.join(["track", *sys.argv[1:]])
    return Origin(command=command, inputs=inputs, parameters=parameters, options=option_names(), **more)


def finish(
    analysis: Analysis, target: Path, picture: str, *, quiet: bool, verbose: bool = False, about: str = ""
) -> int:
    """Print the summary and the warnings (to standard error), and return the exit status.

    0: done.  1: a warning that matters.  2: a stage after the tracking could not use its input (other
    results are written).  3: an unexpected error ended a stage (likewise).  `about` precedes each warning.
    """
    lines = [] if quiet else analysis.summary()
    lines += aligned([("results", f"{target}/ (look at {picture} first)")])
    if verbose and analysis.tracks is not None:
        lines += in_columns([(name, str(value)) for name, value in findings(analysis.tracks).items()], ">")
    warnings = [f"{about}{line.removeprefix(about)}" for line in analysis.warnings]
    status = conclude(lines, warnings, quiet=quiet)
    refused = [name for name in analysis.refused() if name not in analysis.failures]
    for name in refused:
        complain(f"{about}{analysis.reasons[name]} (earlier results are in {target})")
    details = target / FAILURES
    if details.exists():
        complain(f"{about}unexpected error; the other results are written; please report it with {details}")
        return 3
    return 2 if refused else status


# --- several films ------------------------------------------------------------------------------------------


def _targets_of(
    videos: Sequence[Path], out: Path | None, parameters: Mapping[str, Parameter]
) -> dict[Path, Path]:
    """Return the run folder of each film: NAME_tracks in the working directory or in the folder `out`.

    A Photron recording counts once if both its files are named.
    """
    if not videos:
        advice = "track --help lists the options"
        raise InputError("VIDEO", "a video file, a folder or a quoted glob of images", "none", advice)
    if all(_is_still(video) for video in videos):
        found = f"{len(videos)} still images"
        pattern = videos[0].parent / f"*{videos[0].suffix}"
        raise InputError(videos[0].parent, "films", found, f"quote the pattern: track '{pattern}'")
    of_one_film = ("force", "timestamps", "offset")
    given = [f"--{name}" for name in of_one_film if parameters[name].value is not None]
    if given:
        wanted = f"one video with {', '.join(given)}"
        raise InputError(given[0], wanted, f"{len(videos)} videos", "track campaign takes a table of tests")
    targets: dict[str, Path] = {}
    for video in dict.fromkeys(videos):
        name = run_name(video)
        other = targets.get(name)
        if other is not None and is_photron(video) and is_photron(other):
            targets[name] = video if video.suffix.lower() == PIXELS else other
        elif other is not None:
            found = f"{other} and {video}"
            raise InputError(f"{name}_tracks", "films of different names", found, "track them apart")
        else:
            targets[name] = video
    return {video: (out or Path()) / f"{name}_tracks" for name, video in targets.items()}


def _is_still(path: Path) -> bool:
    """Tell whether a file holds a single image; a TIFF of several pages is a film."""
    if path.suffix.lower() not in IMAGES or not path.is_file():
        return False
    if path.suffix.lower() not in TIFF:
        return True
    try:
        return (open_video(path).expected or 0) == 1
    except InputError:
        return False  # reported when this file is tracked


def _track_several(
    targets: Mapping[Path, Path], parameters: dict[str, Parameter], run: RunOptions, config: Path | None
) -> int:
    """Track the films in turn, print a table of them, and return the highest exit status."""
    head = ("film", "status", "sheets", "frames", "lost", "measured", "noise px", "seconds", "remark")
    rows: list[tuple[str, ...]] = [head]
    worst = 0
    for video, target in targets.items():
        started = time.perf_counter()
        done, status, why = attempt(
            partial(track_one, video, target, parameters, run, one_of_many=True, config=config)
        )
        status, analysis = done or (status, None)
        if why:
            complain(why)
        worst = max(worst, status)
        rows.append(_row(video, status, analysis, why, time.perf_counter() - started))
    if not run.quiet:
        lines = in_columns(rows, "<>>>>>>>")
        if folder := next((target.parent for target in targets.values() if is_run(target)), None):
            lines.append(f"results: {folder / 'FILM_tracks'}/ (look at overview.png first)")
        say(lines)
    return worst


def _row(video: Path, status: int, found: Analysis | None, why: str, seconds: float) -> tuple[str, ...]:
    """Return the table's row of one film; `why` says why there is no analysis."""
    if found is None or found.tracks is None:
        return (video.name, str(status), "", "", "", "", "", f"{seconds:.1f}", why)
    strip, flags = StripMetadata.of(found.tracks), FlagCounts(found.tracks)
    sheets = found.tracks.sizes["sheet"]
    wanted = max(flags.total(), sheets * (strip.frames_read + strip.frames_lost))
    share = flags.measured / max(1, wanted)  # lost frames at the end: no rows
    count, noise = len(found.warnings), noise_figures(found.tracks, None)["measured_px"]
    return (
        video.name,
        str(status),
        str(sheets),
        str(strip.frames_read),
        str(strip.frames_lost),
        f"{100 * share:.2f} %",
        f"{noise:.4f}" if math.isfinite(noise) else "",  # not measured in a few frames
        f"{seconds:.1f}",
        counted(count, "warning") if count else "",
    )


# --- a film that a camera is still writing ------------------------------------------------------------------


@contextmanager
def _following(settings: Settings, *, quiet: bool) -> Iterator[Follow]:
    """Follow a growing recording and print its state every five seconds; Ctrl-C completes the recording.

    A second Ctrl-C, or one while the results are written, interrupts the run as usual.
    """
    next_at = time.monotonic()

    def show(last: Callable[[int], xr.DataArray], behind: int | None) -> None:
        nonlocal next_at
        if sys.stderr is None or time.monotonic() < next_at:
            return
        strip = last(100)  # give the noise to 10 %, and are tracked quickly
        if behind and strip.sizes["frame"] < 20:
            return  # too few to measure the noise, and more are in the file
        line = _state(strip, behind, settings)
        sys.stderr.write(f"\r\x1b[K{line}" if sys.stderr.isatty() else f"{line}\n")
        sys.stderr.flush()
        next_at = time.monotonic() + 5.0

    def wait(reason: str) -> None:
        complain(f"waiting: {reason}")

    follow = Follow() if quiet else Follow(seen=show, waiting=wait)
    earlier = signal.getsignal(signal.SIGINT)

    def end(number: int, frame: Any) -> None:
        if callable(earlier) and (follow.stop.is_set() or follow.closed.is_set()):
            earlier(number, frame)
        follow.stop.set()

    signal.signal(signal.SIGINT, end)
    try:
        yield follow
    finally:
        signal.signal(signal.SIGINT, earlier)


def _state(strip: xr.DataArray, behind: int | None, settings: Settings) -> str:
    """Return a line that says how far the recording is read and what its last frames show."""
    frame, time_s = int(strip["frame"].values[-1]), float(strip["time_s"].values[-1])
    where = f"frame {frame}" + (f", {time_s:.1f} s" if math.isfinite(time_s) else "")
    late = "" if behind is None else f"; {behind} more in the file"
    try:
        # Corrections apply to the whole film.
        tracks = track_strip(strip, replace(settings, corrections=()))
    except InputError as error:
        return f"{where}{late}; {error}"
    flags = FlagCounts(tracks)
    noise_px = noise_figures(tracks, None)["measured_px"]
    share = 100 * (flags.total() - flags.measured) / max(1, flags.total())
    return (
        f"{where}{late}; {tracks.sizes['sheet']} sheets, noise {noise_px:.4f} px, {share:.1f} % not measured"
    )
