"""What is said on standard output and standard error, also where nobody reads it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable


def say(lines: Iterable[str]) -> None:
    """Lines to standard output, after the results are safe: failing to print them fails nothing.

    A reader that left (`track … | head -1`), or none at all, is silent; a full disk is told.
    """
    if sys.stdout is None:
        return
    try:
        sys.stdout.write("".join(f"{line}\n" for line in lines))
        sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains as it closes
        if not isinstance(error, BrokenPipeError):
            complain(f"the summary could not be printed: {(error.strerror or str(error)).lower()}")


def complain(message: str) -> None:
    """One line to standard error, if there is one."""
    if sys.stderr is not None:
        sys.stderr.write(f"track: {message}\n")
