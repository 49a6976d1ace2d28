"""Standard output and standard error, also where nobody reads them; an exception becomes one line."""

from __future__ import annotations

import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from typing import TextIO, TypeVar

from cyclopts import CycloptsError, UnusedCliTokensError

from vision.command.options import option_names
from vision.errors import InputError, with_options

T = TypeVar("T")


def hold_streams() -> None:
    """Closed standard streams (`2>&-`) lead nowhere; otherwise messages go into the next file opened.

    Letters that a stream's encoding lacks become "?".
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)  # the lowest number: its own
            setattr(sys, name, os.fdopen(nowhere, mode, closefd=False))  # stays taken when it is replaced
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


def conclude(lines: Iterable[str], warnings: Sequence[str], *, quiet: bool) -> int:
    """A command's warnings and, unless it is quiet, its summary; the exit status, 1 with a warning."""
    for line in warnings:
        complain(f"warning: {line}")
    if not quiet:
        say(lines)
    return 1 if warnings else 0


def in_columns(rows: Sequence[Sequence[str]], align: str) -> list[str]:
    """Lines with columns of even width, each to the left (<) or to the right (>), and the last as it is."""
    widths = [max((len(row[k]) for row in rows), default=0) for k in range(len(align))]
    lines = []
    for row in rows:
        cells = [f"{cell:{side}{width}}" for cell, side, width in zip(row, align, widths, strict=False)]
        lines.append("  ".join([*cells, row[-1]]).rstrip())
    return lines


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
    """A function to call with (frames done, total frames or None); None where there is no terminal."""
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


# --- exceptions ---------------------------------------------------------------------------------------------


def attempt(work: Callable[[], T]) -> tuple[T | None, int, str]:
    """What some work returned, the exit status and what went wrong; Ctrl-C passes.

    0 and "": done.  2: input that cannot be used.  3: an unexpected error, with its details in a file that
    the line names.
    """
    try:
        return work(), 0, ""
    except (InputError, CycloptsError, OSError, MemoryError) as error:
        return None, 2, one_line(error)
    except Exception as error:
        return None, 3, _unexpected(error)


def _unexpected(error: Exception) -> str:
    what = " ".join(f"{type(error).__name__}: {error}".split())
    try:
        with tempfile.NamedTemporaryFile("w", prefix="track-", suffix=".txt", delete=False) as file:
            file.write("".join(traceback.format_exception(error)))
    except OSError:
        return f"unexpected error ({what}); its details could not be written"
    return f"unexpected error ({what}); please report it with {file.name}"


def one_line(error: Exception) -> str:
    """What went wrong, where, and what to do."""
    if isinstance(error, UnusedCliTokensError):
        advice = "quote a glob of images; track --help lists the options"
        error = InputError(" ".join(error.unused_tokens or ()), "one input", "more", advice)
    elif isinstance(error, CycloptsError):
        return " ".join(str(error).split()) + " (track --help lists the options)"
    elif isinstance(error, OSError):
        about = error.filename if isinstance(error.filename, str) else "the recording"
        found = (error.strerror or str(error)).lower()
        error = InputError(about, "a file or folder that can be used", found, "check the path and its rights")
    elif isinstance(error, MemoryError):
        advice = "take a part of it (`frames`)"
        error = InputError("the recording", "enough memory", "not enough memory", advice)
    return str(error)
