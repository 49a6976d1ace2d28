"""The console command `track`; heavy modules are imported only when a command runs."""

from __future__ import annotations

import _thread
import atexit
import gc
import glob
import importlib.util
import logging
import os
import re
import signal
import sys
import threading
import warnings
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App
from cyclopts import Parameter as Option

from vision import __version__
from vision.command.console import (
    attempt,
    complain,
    open_closed_streams,
    return_freed_memory,
    say,
    silence_libraries,
)
from vision.command.options import (
    Config,
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
from vision.errors import InputError, did_you_mean, install_advice
from vision.files import MOST_PIXELS, no_such_file

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from vision.pipeline import Settings

HELP = """Track every sheet of a stick-slip video to a hundredth of a pixel.

The results of test.avi go to a new folder test_tracks in the working directory: look at overview.png first, \
then at tracks.csv, tracks.nc, sheets.csv, kymograph.tif and run.json. Examples:

    track test.avi --pixel-size 10 --fps 60
    track test.avi --pixel-size 10 --fps 60 --force test.txt --d0 16.6
    track test.avi --strip 60:144 --sheets 50 --out results
    track beam.cine --rotate 90
    track markers.avi --ridges dark --sheets 7
    track 'frames/*.tiff' --fps 60
    track *.avi --out series
    track test_tracks --pixel-size 9.8 --out corrected

Exit status: 0 done, 1 finished with a warning that matters, 2 input that cannot be used, 3 an unexpected \
error (earlier results are written); of several films the highest. compare, friction and campaign end with 1 \
if some of their inputs cannot be used.
"""


def track(
    *videos: Annotated[
        Path,
        Option(
            help="One or several: a video file, a TIFF stack, a folder of films or images, or a quoted glob "
            "of images."
        ),
    ],
    reading: VideoOptions = VideoOptions(),
    test: TestOptions = TestOptions(),
    machine: ForceOptions = ForceOptions(),
    sample: SampleOptions = SampleOptions(),
    run: RunOptions = RunOptions(),
    config: Config = None,
    film: MovedFilm = None,
) -> int:
    """Track every sheet of a video: positions x(n,t), their errors, pictures and tables in a new folder.

    Several videos are tracked one after the other, each into its own folder. If one cannot be used, the
    others are still tracked, and the exit status is the highest of all, here 2. --out is then the folder that
    holds their folders.

    A run folder is measured again with the options that are given, such as --pixel-size or --force; the
    others are those of the run. Its film is read again only for another strip. Needs --out or --overwrite.
    """
    from vision.command.track import track_films  # takes a second, which `--help` does not need

    return track_films(videos, (reading, test, machine, sample), run, config, film)


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
    if film is not None:
        from vision.run.reading import read_run

        read_run(folder).input("film", film)  # a wrong film is refused before the page opens
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


_IMPORTED_WHEN_CALLED = {
    "views": ("preview", "overlay", "kymograph", "export", "figures", "certify", "compare"),
    "recordings": ("force", "simulate", "friction", "modulus"),
    "campaign": ("campaign",),
}
"""Commands by the module of this package that holds them."""


def make_app(*, brief: bool = False) -> App:
    """Return the application with all its commands.

    brief: of the commands, only the first lines of their help are needed, which are read from the source:
    importing it takes a second.
    """
    app = App(
        name="track",
        help=HELP,
        usage="Usage: track COMMAND [OPTIONS] [ARGS...]",  # as it would be found from all options
        version=f"sheetvision {__version__}",
        help_format="plaintext",
        suppress_keyboard_interrupt=False,
        default_parameter=Option(json_list=False, json_dict=False),  # names may begin with "[" or "{"
    )
    app.default(track)
    app.command(review, help_format="markdown")
    for module, names in _IMPORTED_WHEN_CALLED.items():
        source = Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8") if brief else ""
        for name in names:
            first = re.search(rf'^def {name}\(.*?"""([^\n]+)', source, re.MULTILINE | re.DOTALL)
            shown = {"help": first[1]} if first else {}
            app.command(f"vision.command.{module}:{name}", help_format="markdown", **shown)
    # for the Snakefile
    app.command("vision.command.campaign:job", name="campaign-job", show=False)
    app.command("vision.command.campaign:pool_runs", name="campaign-pool", show=False)
    return app


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status; bad input never ends in a traceback.

    A signal to stop (a closed terminal, a batch system's time limit) ends a run as Ctrl-C does.
    """
    ended: list[int] = []
    if arguments is None:  # this process does nothing else
        atexit.register(_leave, ended)  # the first to be registered is the last to be called
    gc.set_threshold(50_000)  # the libraries' half a million objects stay: looking through them takes 0.2 s
    open_closed_streams()
    silence_libraries()
    _isolate_environment()
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _interrupt)
    status = run(sys.argv[1:] if arguments is None else list(arguments))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the status is decided
    ended.append(130 if _interrupted else status)
    sys.exit(ended[0])


def _leave(ended: Sequence[int]) -> None:
    """End the process with its status. Python would first delete every object, a twentieth of a short run."""
    sys.stdout.flush()
    sys.stderr.flush()
    if ended:
        os._exit(ended[0])


def _isolate_environment() -> None:
    """Ignore settings for other programs, modules in the working directory and warnings of libraries."""
    sys.path[:] = [place for place in sys.path if place]  # "" is the working directory, with the data
    os.environ.pop("MPLBACKEND", None)  # Jupyter sets one that may not be installed here
    os.environ["MATPLOTLIBRC"] = os.devnull
    # Matrices are small: a second thread of linear algebra mostly keeps a core busy while it waits for work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Tables of positions are formatted by Arrow, whose own allocator keeps what it frees.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))
    warnings.simplefilter("ignore")  # the run has its own warnings for what a user should know
    sys.unraisablehook = _unraisable


_interrupted: list[int] = []  # numbers of the signals received


def _interrupt(number: int, frame: Any) -> None:
    """Raise KeyboardInterrupt, and record the signal."""
    _interrupted.append(number)
    raise KeyboardInterrupt


def _unraisable(ignored: sys.UnraisableHookArgs) -> None:
    """Repeat an interruption that Python ignored; other errors there follow one that is reported."""
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        again = threading.Timer(0.02, _thread.interrupt_main)  # at once, it would be ignored here as well
        again.daemon = True
        again.start()


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit status: 0, 1 (warning), 2 (bad input) or 3 (unexpected)."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # our reader reports truncated files
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # a read-only home directory does no harm
    return_freed_memory()
    try:
        returned, status, why = attempt(lambda: _answer(list(arguments)))
    except KeyboardInterrupt as stop:
        return _stopped(str(stop))
    if _interrupted:  # a library turned the KeyboardInterrupt into another exception
        return _stopped()
    if why:
        complain(why)
    return returned if isinstance(returned, int) else status


def _answer(arguments: Sequence[str]) -> Any:
    """Call the command and return its result.  Raises: InputError if the first word is nearly a command."""
    if arguments in ([], ["--help"]):  # skipping the parser saves a quarter of the time
        return make_app(brief=True).help_print([])
    app, first = make_app(), arguments[0]
    commands = [name for name in app if not name.startswith("-")]
    near = "" if first.startswith("-") else did_you_mean(first.lower(), commands, 0.7)
    if near and first not in commands and "." not in first and not os.path.lexists(first):
        raise InputError(first, "a command or a video", "neither", near)
    return app(arguments, exit_on_error=False, print_error=False, result_action="return_value")


def _stopped(kept: str = "") -> int:
    """Report an interruption and what is kept of the run; return the exit status."""
    complain(f"interrupted; {kept or 'no half-written run folder is left'}")
    return 130


# --- the review, whose page is served before the modules that read the run are imported ---------------------


def _open_app(folder: Path, film: Path | None, cleanup: ExitStack, stop: Callable[[], None]) -> ASGIApp:
    """Open the run and return the application that serves it; `cleanup` closes the run."""
    from vision.command.settings import settings_of_run
    from vision.review.api import keep_first_view, session_app
    from vision.review.session import Session

    session = Session(folder, settings_of_run(folder), film=film, options=option_names())
    cleanup.enter_context(session)
    cleanup.callback(keep_first_view, session)
    return session_app(session, stop)


def prepare_review(folder: Path, settings: Settings) -> None:
    """Store in a run folder what a review shows first, if the extra `review` is installed."""
    if importlib.util.find_spec("starlette") is not None:
        from vision.memory import give_back_freed
        from vision.review import api
        from vision.review.session import Session

        gc.collect()  # the analysis
        give_back_freed()
        with suppress(InputError), Session(folder, settings) as session:
            api.keep_first_view(session)
