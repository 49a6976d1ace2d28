"""The one exception that input can cause."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

_NAMED = re.compile(r"`([A-Za-z_][A-Za-z0-9_]*)`")


class InputError(ValueError):
    """Input or arguments that cannot be used.

    The message is one line: what it is about (a file, an argument), what was expected, what was found and
    what to do. Arguments have their Python names in backticks, as in "give `pixel_size_um`"; the
    command shows the same line with its own options in their place (`with_options`) and ends with exit
    status 2.

    Parameters
    ----------
    about
        A file, or an argument in backticks.
    expected, found
        What the input should be, and what it is.
    advice
        What to do about it; may be empty.
    """

    def __init__(self, about: str | os.PathLike[str], expected: str, found: str, advice: str = "") -> None:
        parts = f"{os.fspath(about)}: expected {expected}; found {found}"
        super().__init__(" ".join(f"{parts}; {advice}".split()) if advice else " ".join(parts.split()))


def check_positive(**values: float | None) -> None:
    """Raises `InputError` for an argument, by name, that is neither None nor a positive, finite number."""
    for name, value in values.items():
        if value is not None and not 0 < value < math.inf:
            raise InputError(f"`{name}`", "a positive number", f"{value!r}")


@contextmanager
def known_as(**names: str) -> Iterator[None]:
    """Lets an `InputError` raised within speak of arguments by the names that the caller has for them.

    Parameters
    ----------
    names
        An argument's name where it is raised to its name here, such as ``columns="force_columns"``.
    """
    try:
        yield
    except InputError as error:
        error.args = (_NAMED.sub(lambda match: f"`{names.get(match[1], match[1])}`", str(error)),)
        raise


def with_options(message: str, options: Mapping[str, str] | None = None) -> str:
    """Return a message with command-line options in place of the library's arguments.

    An argument is any single name in backticks, which a regular expression finds in the text: a message must
    have nothing else in backticks.

    Parameters
    ----------
    message
        Message of an `InputError`, or a warning of the library.
    options
        Python name to option, such as ``{"pixel_size_um": "--pixel-size"}``. Names that are not in it only
        lose their backticks.
    """
    known = options or {}
    return _NAMED.sub(lambda match: known.get(match[1], match[1]), message)
