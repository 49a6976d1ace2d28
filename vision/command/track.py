"""`track VIDEO`: from the file to x(n,t), and with a force recording to the stiff shell."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vision.command.console import complain, frame_progress, say, skip_matplotlib_help
from vision.command.follow import following
from vision.command.options import (
    ForceOptions,
    RunOptions,
    SampleOptions,
    TestOptions,
    VideoOptions,
    merged,
    option_names,
    settings_of,
)
from vision.errors import InputError

if TYPE_CHECKING:
    from vision.pipeline import Analysis
    from vision.run import Checkpoint, Parameter

REFUSED = ("sticks", "clock", "motion", "shells")  # stages whose input cannot be used: exit status 2


def track(
    *videos: Path,
    reading: VideoOptions | None = None,
    test: TestOptions | None = None,
    machine: ForceOptions | None = None,
    sample: SampleOptions | None = None,
    run: RunOptions | None = None,
    config: Path | None = None,
) -> int:
    """Track every sheet of a video: positions x(n,t), their errors, pictures and tables in a new folder.

    Several videos are tracked one after the other, each into its own folder; one that cannot be used does not
    keep the others from being done.

    Parameters
    ----------
    videos
        A video file, a TIFF stack, a folder or a quoted glob of numbered images; or several.
    reading
        How the video is read and its sheets are found.
    test
        What joins video and force recording.
    machine
        How the force recording is read.
    sample
        Geometry of the sample.
    run
        Where the results go; with several videos --out is the folder that holds their folders.
    config
        TOML file with any of these options; the command line wins.
    """
    run = run or RunOptions()
    groups = (reading or VideoOptions(), test or TestOptions(), machine or ForceOptions())
    parameters = merged(*groups, sample or SampleOptions(), config=config)
    if len(videos) == 1:
        target = run.out or Path(f"{run_name(videos[0])}_tracks")
        return track_one(videos[0], target, parameters, run)[0]
    from vision.command.several import targets_of, track_several

    if run.follow:
        raise InputError("`follow`", "one video", f"{len(videos)}", "follow each in a terminal of its own")
    targets = targets_of(videos, run.out, parameters)
    settings_of(parameters)  # what fits no film is said once
    return track_several(
        targets,
        lambda film, target: track_one(film, target, parameters, run, one_of_many=True),
        quiet=run.quiet,
    )


def track_one(
    video: Path,
    target: Path,
    parameters: dict[str, Parameter],
    run: RunOptions,
    *,
    one_of_many: bool = False,
    copy: Path | None = None,
) -> tuple[int, Analysis]:
    """One film to one run folder: the exit status and what was found.

    Of many films each warning names its film, and the summary waits for the table unless all is asked for.
    A copy of the film is read in its place where there is one.
    """
    from vision.pipeline import analyse
    from vision.run import Checkpoint, Checksums, Origin, Parameter, check_target, write_run
    from vision.video import video_files

    skip_matplotlib_help()
    if run.follow and run.resume:
        raise InputError("`follow` and `resume`", "one of the two", "both")
    check_target(target, overwrite=run.overwrite)
    settings, force = settings_of(parameters), parameters["force"].value
    if run.resume and settings.strips != 1:
        raise InputError("`resume` and `strips`", "one of the two", "both", "leave `resume` out")
    along = run.checksum and not run.follow and copy is None and video.exists()
    checkpoint, sums = Checkpoint(target, resume=run.resume), Checksums(video_files(video) if along else ())
    with checkpoint, sums, resumable(checkpoint):
        if run.follow:
            with following(settings, quiet=run.quiet) as follow:
                analysis = analyse(copy or video, force, settings, follow=follow)
        else:
            with frame_progress("reading", quiet=run.quiet) as progress:
                show = sums.beside(progress)
                analysis = analyse(copy or video, force, settings, progress=show, log=checkpoint)
        inputs = (*video_files(video), *(() if force is None else (force,)))
        if settings.pitch_um is not None:
            parameters = {**parameters, "pixel_size": Parameter(analysis.pixel_size_um, "found")}
        analysis = _held_against(analysis, parameters["corrections"].value, inputs[0])
        origin = Origin(
            command=command_line(),
            inputs=inputs,
            parameters=parameters,
            checksum=run.checksum,
            options=option_names(),
            described=sums.found(),
        )
        facts = {"frames_resumed": checkpoint.resumed} if checkpoint.resumed else None
        write_run(analysis, target, origin, overwrite=run.overwrite, report=run.report, facts=facts)
        checkpoint.done()
    status = finish(
        analysis,
        target,
        "overview.png",
        quiet=run.quiet or (one_of_many and not run.verbose),
        verbose=run.verbose,
        about=f"{video.name}: " if one_of_many else "",
    )
    return status, analysis


def _held_against(analysis: Analysis, corrections: Path | None, film: Path) -> Analysis:
    """With a warning where the file of corrections was made for another film."""
    from vision.run import describe_input
    from vision.sheets.corrections import read_decisions

    about = "" if corrections is None else read_decisions(corrections).film
    known = describe_input(film) if about else {}
    if about in ("", known.get("sha256"), known.get("fingerprint")):
        return analysis
    if about == describe_input(film, whole=True).get("sha256"):  # the run was made with --checksum
        return analysis
    line = f"`corrections` were made for another film: {corrections} names one that is not {film.name}"
    return replace(analysis, warnings=(*analysis.warnings, line))


@contextmanager
def resumable(checkpoint: Checkpoint) -> Iterator[None]:
    """An interrupted run says how it goes on, where what it read is kept."""
    try:
        yield
    except KeyboardInterrupt:
        kept = checkpoint.kept
        raise KeyboardInterrupt(f"{kept} frames are kept for --resume" if kept else "") from None


def run_name(video: Path) -> str:
    """Base name of the run folder: the file's or folder's own; of a pattern what is no wildcard."""
    whole = video.absolute() if video.name else video.resolve()
    if whole.exists():
        return whole.name if whole.is_dir() else whole.stem
    readable = "".join(c for c in whole.stem if c not in '*?[]<>|:"').strip("_-. ")
    return readable or whole.parent.name or "video"


def command_line() -> str:
    """As typed, to be typed again."""
    return shlex.join(["track", *sys.argv[1:]])


def finish(
    analysis: Analysis, target: Path, picture: str, *, quiet: bool, verbose: bool = False, about: str = ""
) -> int:
    """Summary to standard output, warnings to standard error; the exit status.

    0: done.  1: a warning that matters.  2: the force recording could not be used (what was measured is
    kept).  3: a stage ended in an error that nobody foresaw (likewise).
    """
    from vision.summary import findings

    for line in analysis.warnings:
        complain(f"warning: {about}{line.removeprefix(about)}")
    if not quiet:
        lines = [*analysis.summary(), f"results    {target}/ (look at {picture} first)"]
        if verbose and analysis.tracks is not None:
            lines += [f"{name:>22}  {value}" for name, value in findings(analysis.tracks).items()]
        say(lines)
    ambiguous = analysis.clock is not None and analysis.clock.status == "ambiguous"
    refused = [] if ambiguous else [name for name in REFUSED if name in analysis.reasons]
    for name in refused:
        if name not in analysis.failures:
            complain(f"{about}{analysis.reasons[name]} (what was measured before is kept in {target})")
    if (target / "failures.txt").exists():
        details = target / "failures.txt"
        complain(f"{about}a failure that nobody foresaw; the rest is kept; please report it with {details}")
        return 3
    return 2 if refused else 1 if analysis.warnings else 0
