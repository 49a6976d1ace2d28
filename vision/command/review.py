"""`track review RUN`: the run in a browser."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vision import files
from vision.command.console import say
from vision.command.options import (
    ForceOptions,
    RunOptions,
    SampleOptions,
    TestOptions,
    VideoOptions,
    option_names,
    settings_of,
)
from vision.command.track import run_name, track
from vision.errors import InputError

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from vision.pipeline import Settings

NEEDED = ("starlette", "uvicorn")


def review(
    run_or_video: Path,
    /,
    reading: VideoOptions | None = None,
    test: TestOptions | None = None,
    machine: ForceOptions | None = None,
    sample: SampleOptions | None = None,
    run: RunOptions | None = None,
    *,
    config: Path | None = None,
    film: Path | None = None,
    browser: bool = True,
    port: int = 0,
) -> int:
    """See a run and correct it in a browser; a video is tracked first.

    The page is served to this machine alone, at an address with a token. Decisions are kept at once in
    corrections.toml of the run folder; saving re-runs what follows from them. Ctrl-C or the page's button
    ends it.

    Examples:

        track review test_tracks

        track review test.avi --force test.txt --pixel-size 10

    Parameters
    ----------
    run_or_video
        Run folder, or a video as for track.
    reading
        How a video is read; of a run everything is known.
    test
        What joins video and force recording.
    machine
        How the force recording is read.
    sample
        Geometry of the sample.
    run
        Where the results of a video go.
    config
        TOML file with any of these options.
    film
        Where the film of a run lies now, if not where it was when it was tracked.
    browser
        Open the default browser; the address is printed in any case.
    port
        Of the address; a free one if not given.
    """
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        found = f"no {' and no '.join(missing)}"
        raise InputError("track review", "the extra 'review'", found, "pip install 'sheetvision[review]'")
    folder = run_or_video
    if not (folder / "run.json").is_file():  # as `vision.run.is_run`, which takes a second to import
        chosen = run or RunOptions()
        folder = chosen.out or Path(f"{run_name(run_or_video)}_tracks")
        groups: dict[str, Any] = {"reading": reading, "test": test, "machine": machine, "sample": sample}
        status = track(run_or_video, **groups, run=replace(chosen, out=folder), config=config)
        if status > 1:
            return status
    elif any(group is not None for group in (reading, test, machine, sample, run, config)):
        raise InputError(
            folder, "a run without further options", "some", "give the video, or run track again"
        )
    from vision.review.first_view import read_first_view
    from vision.review.server import serve

    def opened(address: str) -> None:
        say([f"review     {address}", "           Ctrl-C ends it"])
        if browser:
            import webbrowser

            webbrowser.open(address)

    kept = read_first_view(folder, film)
    with ExitStack() as held:
        serve(lambda stop: _answers(folder, film, held, stop), opened=opened, port=port, kept=kept)
    return 0


def _answers(folder: Path, film: Path | None, held: ExitStack, stop: Callable[[], None]) -> ASGIApp:
    """Reads the run, which `held` closes; its tracks while modules are imported."""
    from vision.review.tracks_file import read_tracks

    with ThreadPoolExecutor(1) as beside:
        tracks = beside.submit(read_tracks, folder / "tracks.nc")
        from vision.review.api import answers, keep_first_view
        from vision.review.session import Session

        session = Session(folder, settings_of_run(folder), film=film, options=option_names(), tracks=tracks)
    held.enter_context(session)
    held.callback(keep_first_view, session)
    return answers(session, stop)


def settings_of_run(folder: Path) -> Settings:
    """The settings that a run was made with; its corrections stand in the run folder.

    Raises
    ------
    InputError
        For a folder that is no run, or one whose run.json is damaged.
    """
    from vision.run.folder import MARK
    from vision.run.provenance import Parameter
    from vision.run.reading import AGAIN, parameters_of, read_json

    parameters = parameters_of(folder, read_json(folder / MARK))
    parameters["corrections"] = Parameter(None, "default")
    with files.reading(folder / MARK, "the parameters of a run", AGAIN):
        return settings_of(parameters)
