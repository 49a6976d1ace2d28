"""`track overlay RUN`: the film with the tracks drawn on it."""

from __future__ import annotations

from pathlib import Path

from vision.command.console import frame_progress, say
from vision.command.options import Flag, parse_range
from vision.errors import InputError


def overlay(
    run: Path,
    /,
    *,
    film: Path | None = None,
    frames: str | None = None,
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """The film of a finished run with its tracks drawn on it, as MP4: to see whether they follow the sheets.

    Examples:

        track overlay test_tracks

        track overlay test_tracks --frames 300:600 --film /archive/test.avi

    Parameters
    ----------
    run
        Run folder.
    film
        Where the film lies now, if not where it was when it was tracked.
    frames
        Part of the film, A:B, frame numbers as in tracks.csv.
    out
        The MP4; the run's name with _overlay.mp4 in the working directory by default.
    overwrite
        Replace a file that is there.
    quiet
        No progress bar and no summary.
    """
    part = parse_range(frames, "--frames")
    from vision.run import read_run, whole_file
    from vision.run.overlay import film_of, write_overlay

    made = read_run(run)
    target = out or Path(f"{made.folder.resolve().name}_overlay.mp4")
    if target.suffix.lower() != ".mp4":
        raise InputError("`out`", "a name that ends in .mp4", f"'{target}'")
    if target.exists() and not overwrite:
        raise InputError(target, "a new file", "one that exists", "give `overwrite` or another `out`")
    source = film_of(made, film)
    with frame_progress("drawing", quiet=quiet) as progress, whole_file(target) as path:
        written = write_overlay(made, source, path, frames=part, progress=progress)
    if not quiet:
        rows, columns = written.shape
        size = target.stat().st_size / 1e6
        say(
            [
                f"{written.frames} frames of {columns} x {rows} px, played at {written.fps:g} frames/s, "
                f"{size:.1f} MB -> {target}"
            ]
        )
    return 0
