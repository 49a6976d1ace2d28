"""What is shown on standard output and standard error, also where nobody reads it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from typing import TextIO

from vision.command.options import option_names
from vision.errors import with_options


def hold_streams() -> None:
    """Closed standard streams (`2>&-`) lead nowhere; otherwise the next file opened takes their place, and
    messages are written into it.  Letters that a stream's encoding lacks become "?".
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))  # the lowest number: its own
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def silence_libraries() -> None:
    """What C libraries write to standard error by themselves leads nowhere; Python's own messages do not.

    libpng, OpenCV and HDF5 print a line of theirs beside the one that says what is wrong.
    """
    with suppress(OSError, ValueError, AttributeError):
        kept = os.dup(sys.stderr.fileno())
        os.set_inheritable(kept, False)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stderr.fileno())
        os.close(nowhere)
        sys.stderr = open(  # noqa: SIM115, PTH123  # for as long as the program runs
            kept, "w", buffering=1, encoding=sys.stderr.encoding, errors="replace"
        )


def say(lines: Iterable[str]) -> None:
    """Lines to standard output, after the results are safe: failing to print them fails nothing.

    A reader that left (`track … | head -1`), or none at all, is silent; a full disk is reported.
    """
    error = _print(lines, sys.stdout)
    if error is not None and not isinstance(error, BrokenPipeError):
        complain(f"the summary could not be printed: {(error.strerror or str(error)).lower()}")


def complain(message: str) -> None:
    """One line to standard error, if there is one and it can take it."""
    _print([f"track: {message}"], sys.stderr)


def _print(lines: Iterable[str], stream: TextIO | None) -> OSError | None:
    """Lines to a stream, with options in place of arguments; the error if the stream does not take them."""
    if stream is None:
        return None
    try:
        stream.write("".join(f"{with_options(line, option_names())}\n" for line in lines))
        stream.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # else Python complains as it closes
        return error
    return None


@contextmanager
def frame_progress(what: str, *, quiet: bool = False) -> Iterator[Callable[[int, int | None], None] | None]:
    """A function to call with (frames done, total frames or None); None where nobody watches."""
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class Rate(ProgressColumn):
        """Frames per second."""

        def render(self, task: Task) -> Text:
            return Text("" if not task.speed else f"{task.speed:,.0f} frames/s")

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}"), Rate())
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)

        def show(done: int, total: int | None) -> None:
            bar.update(task, completed=done, total=total)

        yield show


def skip_matplotlib_help() -> None:
    """Leave the help texts of matplotlib's artists unwritten: a third of the time that its import takes."""
    import matplotlib.artist

    matplotlib.artist.kwdoc = lambda artist: ""
