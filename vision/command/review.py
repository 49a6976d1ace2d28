"""`track review RUN`: serve a run to a browser.

The page is served first. The modules that read the run are imported after that.
"""

from __future__ import annotations

import glob
import importlib.util
import webbrowser
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter as Option

from vision.command.console import say
from vision.command.options import (
    ForceOptions,
    MovedFilm,
    RunOptions,
    SampleOptions,
    TestOptions,
    VideoOptions,
    flag_of,
    names_given,
    option_names,
)
from vision.errors import InputError, install_advice
from vision.files import no_such_file

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from vision.pipeline import Settings


def review(
    run_or_video: Annotated[Path, Option(help="Run folder, or a video as for track.")],
    /,
    reading: VideoOptions = VideoOptions(),
    test: TestOptions = TestOptions(),
    machine: ForceOptions = ForceOptions(),
    sample: SampleOptions = SampleOptions(),
    run: RunOptions = RunOptions(),
    *,
    config: Annotated[Path | None, Option(help="TOML file with any of these options.")] = None,
    film: MovedFilm = None,
    browser: Annotated[
        bool, Option(help="Open the default browser; the address is printed in any case.")
    ] = True,
    port: Annotated[int, Option(help="Port of the address; a free one if not given.")] = 0,
) -> int:
    """Inspect and correct a run in a browser; a video is tracked first.

    Only this computer can open the page, at an address with a token. Each decision is written at once to
    corrections.toml in the run folder; saving repeats the analysis that depends on it. Ctrl-C or the page's
    button ends the review. Options of track apply to a video only, as those of a run are known.

    For example:

        track review test_tracks

        track review test.avi --force test.txt --pixel-size 10
    """
    groups = (reading, test, machine, sample)
    missing = [name for name in ("starlette", "uvicorn") if importlib.util.find_spec(name) is None]
    if missing:
        found = f"no {' and no '.join(missing)}"
        raise InputError("track review", "the extra 'review'", found, install_advice("review"))
    folder = run_or_video
    if not (folder / "run.json").is_file():  # as `vision.run.is_run`, which takes a second to import
        if not run_or_video.exists() and not glob.has_magic(str(run_or_video)):
            raise no_such_file(folder, "a run folder or a video")
        from vision.command.track import one_film, run_name, track_films

        run_or_video = one_film(run_or_video)
        folder = run.out or Path(f"{run_name(run_or_video)}_tracks")
        status = track_films([run_or_video], groups, replace(run, out=folder), config)
        if status > 1:
            return status
    elif given := [*map(flag_of, names_given(*groups, run)), *(["--config"] if config else [])]:
        wanted, advice = "a run without further options", "give the video, or run track again"
        raise InputError(folder, wanted, ", ".join(given), advice)
    from vision.review.server import read_first_view, serve

    def opened(address: str) -> None:
        say([f"review     {address}", "           Ctrl-C ends it"])
        if browser:
            webbrowser.open(address)

    kept = read_first_view(folder, film)
    with ExitStack() as cleanup:
        try:
            serve(lambda stop: _open_app(folder, film, cleanup, stop), opened=opened, port=port, kept=kept)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the review has ended, and its decisions are stored") from None
    return 0


def _open_app(folder: Path, film: Path | None, cleanup: ExitStack, stop: Callable[[], None]) -> ASGIApp:
    """Open the run and return the application that serves it; `cleanup` closes the run."""
    from vision.command.settings import settings_of_run
    from vision.review.api import keep_first_view, session_app
    from vision.review.session import Session

    session = Session(folder, settings_of_run(folder), film=film, options=option_names())
    cleanup.enter_context(session)
    cleanup.callback(keep_first_view, session)
    return session_app(session, stop)


def keep_first_view(folder: Path, settings: Settings) -> None:
    """Store in a run folder what a review shows first, if the extra `review` is installed."""
    if importlib.util.find_spec("starlette") is not None:
        from vision.review import api
        from vision.review.session import Session

        with suppress(InputError), Session(folder, settings) as session:
            api.keep_first_view(session)
