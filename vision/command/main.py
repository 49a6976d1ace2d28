"""The console command: one default action and subcommands; heavy imports wait until one of them runs."""

from __future__ import annotations

import logging
import signal
import sys
import tempfile
import traceback
from collections.abc import Sequence
from typing import Any

from cyclopts import App, CycloptsError, UnusedCliTokensError

from vision.command.certify import certify
from vision.command.console import complain, hold_streams
from vision.command.export import export
from vision.command.figures import figures
from vision.command.force import force
from vision.command.friction import friction
from vision.command.kymograph import kymograph
from vision.command.modulus import modulus
from vision.command.simulate import simulate
from vision.command.track import track
from vision.errors import InputError

HELP = """Follow every sheet of a stick-slip video to a hundredth of a pixel.

The results go to a new folder, test_tracks in the working directory: overview.png to look at first, then
tracks.csv, tracks.nc, sheets.csv, kymograph.tif and run.json. Try:

    track test.avi --pixel-size 10 --fps 60
    track test.avi --strip 60:144 --sheets 50 --out results
    track beam.cine --rotate 90
    track markers.avi --ridges dark --sheets 7
    track 'frames/*.tiff' --fps 60

Exit status: 0 done, 1 finished with a warning that matters, 2 input that cannot be used, 3 a failure that
nobody foresaw (what was measured before it is kept).
"""


def make_app() -> App:
    """The application with all its commands."""
    from vision import __version__

    app = App(
        name="track",
        help=HELP,
        version=f"sheetvision {__version__}",
        help_format="markdown",
        suppress_keyboard_interrupt=False,
    )
    app.default(track)
    for command in (force, simulate, kymograph, export, figures, certify, friction, modulus):
        app.command(command)
    return app


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status; never a traceback for bad input.

    Being told to stop (a closed terminal, a batch system's time limit) ends a run as Ctrl-C does.
    """
    hold_streams()
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _interrupt)
    sys.exit(run(sys.argv[1:] if arguments is None else list(arguments)))


def _interrupt(number: int, frame: Any) -> None:
    raise KeyboardInterrupt


def run(arguments: Sequence[str]) -> int:
    """Exit status of a command line: 0 done, 1 with a warning that matters, 2 bad input, 3 unforeseen."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # cut files are reported by the reader itself
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # a home that cannot be written is no concern
    try:
        status = make_app()(
            list(arguments) or ["--help"],
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
    except (InputError, CycloptsError, OSError, MemoryError) as error:
        complain(_one_line(error))
        return 2
    except KeyboardInterrupt:
        complain("interrupted; no half-written run folder is left")
        return 130
    except Exception as error:
        complain(_unforeseen(error))
        return 3
    return status if isinstance(status, int) else 0


def _unforeseen(error: Exception) -> str:
    """One line, and the details in a file that it names."""
    what = " ".join(f"{type(error).__name__}: {error}".split())
    try:
        with tempfile.NamedTemporaryFile("w", prefix="track-", suffix=".txt", delete=False) as file:
            file.write("".join(traceback.format_exception(error)))
    except OSError:
        return f"a failure that nobody foresaw ({what}); its details could not be written"
    return f"a failure that nobody foresaw ({what}); please report it with {file.name}"


def _one_line(error: Exception) -> str:
    """What went wrong, where, and what to do."""
    if isinstance(error, UnusedCliTokensError):
        extra = " ".join(error.unused_tokens or ())
        error = InputError(
            extra, "one input", "more", "quote a glob of images; track --help lists the options"
        )
    elif isinstance(error, CycloptsError):
        return " ".join(str(error).split()) + " (track --help lists the options)"
    elif isinstance(error, OSError):
        about = error.filename if isinstance(error.filename, str) else "the recording"
        found = (error.strerror or str(error)).lower()
        error = InputError(about, "a file or folder that can be used", found, "check the path and its rights")
    elif isinstance(error, MemoryError):
        error = InputError(
            "the recording", "enough memory", "not enough memory", "take a part of it (`frames`)"
        )
    return str(error)
