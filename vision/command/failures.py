"""What becomes of an exception: an exit status and one line, never a traceback."""

from __future__ import annotations

import tempfile
import traceback
from collections.abc import Callable
from typing import Any

from cyclopts import CycloptsError, UnusedCliTokensError

from vision.errors import InputError


def outcome(work: Callable[[], Any]) -> tuple[int, str]:
    """Exit status of some work and what went wrong, "" for nothing; Ctrl-C passes.

    0 or what the work returns: done.  2: input that cannot be used.  3: an error that nobody foresaw, with
    its details in a file that the line names.
    """
    try:
        status = work()
    except (InputError, CycloptsError, OSError, MemoryError) as error:
        return 2, _one_line(error)
    except Exception as error:
        return 3, _unforeseen(error)
    return (status if isinstance(status, int) else 0), ""


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
