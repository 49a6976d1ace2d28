"""What is said on standard output and standard error, also where nobody reads it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from io import TextIOWrapper
from typing import TextIO


def hold_streams() -> None:
    """Closed standard streams (`2>&-`) lead nowhere; else the next file opened takes their place, and is
    written to by whoever has something to say.  Letters that a stream's encoding lacks become "?".
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))  # the lowest number: its own
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def say(lines: Iterable[str]) -> None:
    """Lines to standard output, after the results are safe: failing to print them fails nothing.

    A reader that left (`track … | head -1`), or none at all, is silent; a full disk is told.
    """
    error = _print(lines, sys.stdout)
    if error is not None and not isinstance(error, BrokenPipeError):
        complain(f"the summary could not be printed: {(error.strerror or str(error)).lower()}")


def complain(message: str) -> None:
    """One line to standard error, if there is one and it can take it."""
    _print([f"track: {message}"], sys.stderr)


def _print(lines: Iterable[str], stream: TextIO | None) -> OSError | None:
    """Lines to a stream; the error if it does not take them."""
    if stream is None:
        return None
    try:
        stream.write("".join(f"{line}\n" for line in lines))
        stream.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())  # else Python complains as it closes
        return error
    return None
