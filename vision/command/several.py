"""Several films in one call: a run folder each, failures kept to their own film, one table at the end."""

from __future__ import annotations

import glob
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from vision.command.console import complain, say
from vision.command.failures import outcome
from vision.errors import InputError

if TYPE_CHECKING:
    from vision.pipeline import Analysis
    from vision.run import Parameter

STILLS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}
OF_ONE_FILM = ("force", "timestamps", "offset")  # options that cannot be true of several


def targets_of(
    videos: Sequence[Path], out: Path | None, parameters: Mapping[str, Parameter]
) -> dict[Path, Path]:
    """The run folder of each film: NAME_tracks in the working directory, or in the folder `out`.

    A Photron recording of which both files are named counts once.

    Raises
    ------
    InputError
        For no film, one that is not there, still images (the frames of one film, not quoted), two films of
        one name, and options
        that only one film can have.
    """
    from vision.command.track import run_name
    from vision.video.photron import PIXELS, is_photron

    if not videos:
        advice = "track --help lists the options"
        raise InputError("VIDEO", "a video file, a folder or a quoted glob of images", "none", advice)
    for video in videos:
        if not video.exists() and not glob.has_magic(str(video)):
            raise InputError(video, "a video", "no such file", "check the path; options begin with --")
    if all(_is_still(video) for video in videos):
        found = f"{len(videos)} still images"
        raise InputError(videos[0].parent, "films", found, "quote the glob: track 'frames/*.png'")
    given = [f"--{name}" for name in OF_ONE_FILM if parameters[name].value is not None]
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
    """Whether this is one image: a TIFF of several pages is a film."""
    if path.suffix.lower() not in STILLS or not path.is_file():
        return False
    if path.suffix.lower() not in (".tif", ".tiff"):
        return True
    from vision.video import open_video

    try:
        return (open_video(path).expected or 0) == 1
    except InputError:
        return False  # it is named when its turn comes


def track_several(
    targets: Mapping[Path, Path], work: Callable[[Path, Path], tuple[int, Analysis]], *, quiet: bool
) -> int:
    """Every film in turn, and a table of them; the highest of their exit statuses.

    Parameters
    ----------
    targets
        Film to run folder.
    work
        Tracks one film: exit status and what was found.
    quiet
        No table.
    """
    rows, worst = [], 0
    for video, target in targets.items():
        started = time.perf_counter()
        found: list[Analysis] = []
        status, why = outcome(partial(_noted, work, video, target, found))
        if why:
            complain(why)
        worst = max(worst, status)
        seconds = time.perf_counter() - started
        rows.append(_row(video, status, found[0] if found else None, why, seconds))
    if not quiet:
        say(_table(rows))
    return worst


def _noted(
    work: Callable[[Path, Path], tuple[int, Analysis]], video: Path, target: Path, found: list[Analysis]
) -> int:
    """The work's exit status; what it found is added to the list."""
    status, analysis = work(video, target)
    found.append(analysis)
    return status


HEAD = ("film", "status", "sheets", "frames", "lost", "measured", "noise px", "seconds", "remark")


def _row(video: Path, status: int, found: Analysis | None, why: str, seconds: float) -> tuple[str, ...]:
    from vision.data import StripMetadata
    from vision.summary import flag_counts, noise_figures

    if found is None or found.tracks is None:
        return (video.name, str(status), "", "", "", "", "", f"{seconds:.1f}", why)
    strip, flags = StripMetadata.of(found.tracks), flag_counts(found.tracks)
    share = flags.get("ok", 0) / max(1, sum(flags.values()))
    count = len(found.warnings)
    return (
        video.name,
        str(status),
        str(found.tracks.sizes["sheet"]),
        str(strip.frames_read),
        str(strip.frames_lost),
        f"{100 * share:.2f} %",
        f"{noise_figures(found.tracks, None)['measured_px']:.4f}",
        f"{seconds:.1f}",
        "" if not count else f"{count} warning{'s' * (count > 1)}",
    )


def _table(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Columns of even width, the remark last."""
    table = [HEAD, *rows]
    widths = [max(len(row[k]) for row in table) for k in range(len(HEAD) - 1)]
    lines = []
    for row in table:
        first = row[0].ljust(widths[0])
        rest = "  ".join(cell.rjust(width) for cell, width in zip(row[1:-1], widths[1:], strict=True))
        lines.append(f"{first}  {rest}  {row[-1]}".rstrip())
    return lines
