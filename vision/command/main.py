"""The console command: one default action, subcommands loaded when they are called."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

from cyclopts import App, CycloptsError

from vision.command.track import track
from vision.errors import InputError

HELP = """Follow every sheet of a stick-slip video to a hundredth of a pixel.

Examples:

    track test.avi --pixel-size 10 --fps 60

    track test.avi --strip 60:144 --sheets 50 --out results

    track beam.cine --rotate 90

    track markers.avi --ridges dark --sheets 7

Results go to a new folder, test_tracks beside the working directory: overview.png to look at first, then
tracks.csv, tracks.nc, sheets.csv, kymograph.tif and run.json. Exit status: 0 done, 1 finished with a
warning that matters, 2 input that cannot be used.
"""


def make_app() -> App:
    """The application; heavy imports wait until a command runs."""
    from vision import __version__

    app = App(name="track", help=HELP, version=f"sheetvision {__version__}", help_format="markdown")
    app.default(track)
    app.command("vision.command.force:force", name="force")
    app.command("vision.command.simulate:simulate", name="simulate")
    return app


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status; never a traceback for bad input."""
    sys.exit(run(sys.argv[1:] if arguments is None else list(arguments)))


def run(arguments: Sequence[str]) -> int:
    """Exit status of a command line: 0 done, 1 with a warning that matters, 2 bad input."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # cut files are reported by the reader itself
    app = make_app()
    try:
        status = app(
            list(arguments) or ["--help"],
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
    except InputError as error:
        return _complain(str(error), 2)
    except CycloptsError as error:
        return _complain(" ".join(str(error).split()) + " (track --help lists the options)", 2)
    except KeyboardInterrupt:
        return _complain("interrupted; nothing was written", 130)
    return status if isinstance(status, int) else 0


def _complain(message: str, status: int) -> int:
    sys.stderr.write(f"track: {message}\n")
    return status
