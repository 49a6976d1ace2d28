"""Standard output and standard error, even if closed, and exceptions as one line."""

from __future__ import annotations

import codecs
import errno
import os
import re
import sys
import tempfile
import traceback
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from typing import TextIO, TypeVar

from cyclopts import CoercionError, CycloptsError, UnknownOptionError, UnusedCliTokensError

from vision.command.options import option_names, with_point
from vision.errors import FULL_DISK, InputError, nearest_word, reason_of, with_options
from vision.files import Progress, c_library

T = TypeVar("T")
SPELLED = {"Λ": "Lambda", "−": "-", "–": "-", "±": "+/-", "µ": "u", "°": " deg", "→": "->", "\u0302": "^"}
CLOSED_PIPE = (errno.EPIPE, errno.EINVAL)  # the latter on Windows


def open_closed_streams() -> None:
    """Open closed standard streams (`2>&-`) to the null device, so that no other file takes their number.

    Characters that a stream's encoding lacks, as that of a file or pipe on Windows lacks Λ, are spelled.
    """
    codecs.register_error("spelled", _spelled)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            nowhere = os.open(os.devnull, os.O_RDWR)  # gets the lowest free number: the stream's
            # closefd=False: the number stays in use even if the stream is replaced
            setattr(sys, name, os.fdopen(nowhere, mode, closefd=False))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="spelled")


def _spelled(error: UnicodeError) -> tuple[str, int]:
    """Return what stands for a character that cannot be encoded: "Lambda" for Λ, "0" for ₀, else "?"."""
    assert isinstance(error, UnicodeEncodeError)
    character = error.object[error.start]
    greek = re.fullmatch(r"GREEK (?:SMALL|(CAPITAL)) LETTER (\w+)", unicodedata.name(character, ""))
    if character in SPELLED:
        shown = SPELLED[character]
    elif greek:
        shown = greek[2].capitalize() if greek[1] else greek[2].lower()
    else:
        shown = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode() or "?"
    return shown, error.start + 1


def silence_libraries() -> None:
    """Discard what C libraries write to standard error; what Python writes is printed.

    libpng, OpenCV and HDF5 print their own messages beside the one line that says what is wrong.
    """
    with suppress(OSError, ValueError, AttributeError):
        python = os.dup(sys.stderr.fileno())
        os.set_inheritable(python, False)
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stderr.fileno())
        os.close(nowhere)
        sys.stderr = open(  # noqa: SIM115, PTH123  # for as long as the program runs
            python, "w", buffering=1, encoding=sys.stderr.encoding, errors="replace"
        )


def return_freed_memory() -> None:
    """Make the C library return arrays of 4 MiB or more to the system when they are freed.

    By default it keeps arrays of up to 32 MB, and the gaps that they leave, for later use: of 100 000 frames
    with 24 sheets 55 MB while sheets are tracked, and 180 MB afterwards. Of smaller arrays it is to keep
    8 MiB: the system needs longer to give them again than most computations with them take.
    """
    if library := c_library():
        with suppress(AttributeError):  # only the GNU C library has these settings
            library.mallopt(-3, 4 << 20)  # M_MMAP_THRESHOLD of malloc.h
            library.mallopt(-1, 8 << 20)  # M_TRIM_THRESHOLD, 128 KiB once the other is set


def say(lines: Iterable[str]) -> None:
    """Print lines to standard output. The results are written by then, so a failure here is no error.

    A closed pipe (`track … | head -1`) or stream is ignored; a full disk is reported.
    """
    error = _print(lines, sys.stdout)
    if error is not None and error.errno not in CLOSED_PIPE:
        complain(f"the summary could not be printed: {reason_of(error)}")


def complain(message: str) -> None:
    """Print one line to standard error; do nothing if that fails."""
    _print([f"track: {message}"], sys.stderr)


def conclude(
    lines: Iterable[str], warnings: Sequence[str], *, quiet: bool, failures: Sequence[str] = ()
) -> int:
    """Print failures, warnings and, unless quiet, a summary; return the exit status.

    failures: what could not be used of several inputs.  The status is 1 if there is a failure or a warning.
    """
    for line in (*failures, *(f"warning: {line}" for line in warnings)):
        complain(line)
    if not quiet:
        say(lines)
    return 1 if failures or warnings else 0


def in_columns(rows: Sequence[Sequence[str]], sides: str) -> list[str]:
    """Format rows in columns; `sides` has < or > for each but the last, which is not padded."""
    widths = [max((len(row[k]) for row in rows), default=0) for k in range(len(sides))]
    lines = []
    for row in rows:
        cells = [f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=False)]
        lines.append("  ".join([*cells, row[-1]]).rstrip())
    return lines


def _print(lines: Iterable[str], stream: TextIO | None) -> OSError | None:
    """Print lines with options in place of arguments; return the error if the stream fails."""
    if stream is None:
        return None
    try:
        stream.write("".join(f"{with_options(line, option_names())}\n" for line in lines))
        stream.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # or Python reports it again at exit
        return error
    return None


@contextmanager
def frame_progress(what: str, *, quiet: bool = False) -> Iterator[Progress | None]:
    """Show a progress bar; yield a function of (frames done, total or None), or None without a terminal."""
    if quiet or sys.stderr is None or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    rate = TextColumn("{task.fields[rate]}")
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}"), rate)
    with Bar(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None, rate="")

        def show(done: int, total: int | None) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, total=total, rate=f"{speed:,.0f} frames/s" if speed else "")

        yield show


# --- exceptions ---------------------------------------------------------------------------------------------


def attempt(work: Callable[[], T]) -> tuple[T | None, int, str]:
    """Call `work` and return its result, the exit status and a line that says what went wrong.

    Status 0 and "": no error.  2: input that cannot be used.  3: an unexpected error; the line names a file
    with its details. With 2 and 3 the result is None. KeyboardInterrupt is not caught.
    """
    try:
        return work(), 0, ""
    except (InputError, CycloptsError, OSError, MemoryError) as error:
        return None, 2, one_line(error)
    except Exception as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())
        try:
            with tempfile.NamedTemporaryFile("w", prefix="track-", suffix=".txt", delete=False) as file:
                file.write("".join(traceback.format_exception(error)))
        except OSError:
            return None, 3, f"unexpected error ({what}); its details could not be written"
        return None, 3, f"unexpected error ({what}); please report it with {file.name}"


def _unknown_option(error: UnknownOptionError) -> str:
    """Return the message on an unknown option, which suggests one that begins or is spelled like it."""
    typed = (error.token.keyword or error.token.value).partition("=")[0]
    options = [name for one in error.argument_collection if one.parse for name in one.names]
    near = [option for option in options if typed.startswith("--") and option.startswith(typed)]
    meant = near[0] if len(near) == 1 else nearest_word(typed, options, 0.8)
    if os.path.lexists(typed):
        return f"Unknown option: {typed}. If the file of this name is meant, write .{os.sep}{typed}"
    return f"Unknown option: {typed}." + (f" Did you mean {meant}?" if meant else "")


def _help_of(error: CycloptsError) -> str:
    """Return which command line lists the options of the command in which the error was found."""
    return " ".join(("track", *(error.command_chain or ()), "--help lists the options"))


def one_line(error: Exception) -> str:
    """Return an exception as one line: where, what is wrong, and what to do."""
    if isinstance(error, UnusedCliTokensError):
        advice = f"quote a glob of images; {_help_of(error)}"
        error = InputError(" ".join(error.unused_tokens or ()), "one input", "more", advice)
    elif isinstance(error, UnknownOptionError):
        return f"{_unknown_option(error)} ({_help_of(error)})"
    elif isinstance(error, CoercionError) and error.target_type in (int, float) and error.token is not None:
        typed, kind = error.token.value, "number" if error.target_type is float else "whole number"
        advice = with_point(typed) if kind == "number" else ""
        if not advice and re.match(r"[-+]?[0-9.]+(?:e[-+]?[0-9]+)?\s*[^\W\d]", typed):
            advice = f"write only the number; {_help_of(error)} with their units"
        error = InputError(error.token.keyword or "an argument", f"a {kind}", f"'{typed}'", advice)
    elif isinstance(error, CycloptsError):
        return " ".join(str(error).split()) + f" ({_help_of(error)})"
    elif isinstance(error, OSError):
        about, found = error.filename if isinstance(error.filename, str) else "the disk", reason_of(error)
        advice = "free some space" if found == FULL_DISK else "check the path and its rights"
        error = InputError(about, "a file or folder that can be used", found, advice)
    elif isinstance(error, MemoryError):
        advice = "take a part of it (`frames`)"
        error = InputError("the recording", "enough memory", "not enough memory", advice)
    return str(error)
