"""InputError, the exception for invalid input, and the wording of its messages."""

from __future__ import annotations

import difflib
import errno
import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import cache, partial
from numbers import Integral, Real
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

PATH = (str, os.PathLike)
"""Types of an argument that names a file."""
RANGE = "a slice such as slice(60, 144)"
"""What an argument for rows, columns or frames must be, for messages."""
FULL_DISK = "a full disk"
_NAMED = re.compile(r"`([A-Za-z_][A-Za-z0-9_]*)`")


class InputError(ValueError):
    """Invalid input or arguments.

    The message is one line: the file or argument, what was expected, what was found, and what to do.
    Arguments are named in backticks, as in "give `pixel_size_um`". The command replaces these names by its
    options (`with_options`) and ends with exit status 2.

    Parameters
    ----------
    about
        A file, or an argument in backticks.
    expected, found
        What the input should be, and what it is.
    advice
        What the user can do; may be empty.
    """

    def __init__(self, about: str | os.PathLike[str], expected: str, found: str, advice: str = "") -> None:
        super().__init__(about, expected, found, advice)
        self.about, self.expected, self.found, self.advice = os.fspath(about), expected, found, advice

    @property
    def problem(self) -> str:
        """The message without the file or argument."""
        parts = f"expected {self.expected}; found {self.found}" + (f"; {self.advice}" if self.advice else "")
        return " ".join(parts.split())

    @property
    def is_of_argument(self) -> bool:
        """Whether an argument is invalid, rather than a file."""
        return self.about.startswith("`")

    def __str__(self) -> str:
        return f"{' '.join(self.about.split())}: {self.problem}"


class NoRidgesError(InputError):
    """A picture that shows no upright ridges."""


def install_advice(extra: str) -> str:
    """Return how to install the optional packages of an extra in pyproject.toml."""
    return f"in sheetvision's folder: pip install -c constraints.txt '.[{extra}]'"


def check_kind(kind: Any, expected: str, **values: Any) -> None:
    """Raise `InputError` for an argument that is not of this type; say what was expected."""
    for name, value in values.items():
        if not isinstance(value, kind):
            raise InputError(f"`{name}`", expected, shown(value))


def check_within(expected: str, low: float, high: float, *, whole: bool = False, **values: Any) -> None:
    """Raise `InputError` for an argument that is neither None nor a finite number from `low` to `high`."""
    kind: type = Integral if whole else Real
    for name, value in values.items():
        number = isinstance(value, kind) and not isinstance(value, bool)
        if value is not None and not (number and math.isfinite(value) and low <= value <= high):
            whole_float = whole and isinstance(value, float)
            raise InputError(f"`{name}`", expected, repr(value) if whole_float else shown(value))


def check_word(words: Collection[object], **values: Any) -> None:
    """Raise `InputError` for an argument that is none of these words or numbers."""
    for name, value in values.items():
        if value not in words:
            raise InputError(f"`{name}`", f"one of {', '.join(map(str, words))}", shown(value))


def check_positive(**values: Any) -> None:
    """Raise `InputError` for an argument that is neither None nor a positive, finite number."""
    check_within("a positive number", math.nextafter(0, 1), math.inf, **values)


def check_number(**values: Any) -> None:
    """Raise `InputError` for an argument that is neither None nor a finite number."""
    check_within("a number", -math.inf, math.inf, **values)


# Types of a dataclass's fields that state which numbers they may be; `check_fields` checks them.
Positive = Annotated[float, check_positive]
NonNegative = Annotated[float, partial(check_within, "a number from 0", 0, math.inf)]
PositiveInt = Annotated[int, partial(check_within, "a whole number from 1", 1, math.inf, whole=True)]
NonNegativeInt = Annotated[int, partial(check_within, "a whole number from 0", 0, math.inf, whole=True)]


def check_fields(one: Any) -> None:
    """Raise `InputError` for a field of a dataclass that has another value than its type allows.

    Choices are written as ``Literal``. A type that is ``Annotated`` names functions such as `check_positive`,
    which are called with the field. Numbers of other fields are finite. ``| None`` allows None as well.
    """
    for name, optional, check in _checks_of(one.__class__):
        value = getattr(one, name)
        if not (optional and value is None):
            check(**{name: value})


@cache
def _checks_of(kind: Any) -> list[tuple[str, bool, Callable[..., None]]]:
    """Return the fields of a dataclass, whether each may be None, and the functions that check it."""
    found: list[tuple[str, bool, Callable[..., None]]] = []
    for name, declared in get_type_hints(kind, include_extras=True).items():
        optional = NoneType in get_args(declared)
        part = get_args(declared)[0] if optional else declared
        origin = get_origin(part) or part
        checks = getattr(part, "__metadata__", [_CHECKS[origin]] if origin in _CHECKS else [])
        if origin is Literal:
            checks = [partial(check_word, get_args(part))]
        elif is_dataclass(origin):
            checks = [partial(check_kind, origin, f"a `{part.__name__}`")]
        found += [(name, optional, check) for check in checks]
    return found


_CHECKS: Mapping[Any, Callable[..., None]] = {
    float: check_number,
    bool: partial(check_kind, bool, "True or False"),
    slice: partial(check_kind, slice, RANGE),
    Path: partial(check_kind, PATH, "the path of a file"),
    Mapping: partial(check_kind, Mapping, "names and values"),
}
"""How values of a type are checked."""


def reason_of(error: BaseException) -> str:
    """Return what an error says: `FULL_DISK`, or the system's reason without its number and the file."""
    if isinstance(error, OSError):
        short = error.errno is None and "requested and" in str(error)  # NumPy's words for an incomplete write
        if short or error.errno in (errno.ENOSPC, errno.EDQUOT):
            return FULL_DISK
    return str(getattr(error, "strerror", None) or error).lower()


def unwritable(
    target: Path, error: OSError, advice: str = "nothing was written; give another `out`"
) -> InputError:
    """Return the error for a file or folder that could not be written."""
    return InputError(target, "a place that can be written", reason_of(error), advice)


def unexpected(error: BaseException) -> str:
    """Return an error that nobody foresaw in one line, with its type."""
    return " ".join(f"unexpected {type(error).__name__}: {error}".split())


def counted(count: int, noun: str) -> str:
    """Return "1 film" or "2 films"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def first_of(items: Sequence[object], most: int) -> str:
    """Return up to this many items with commas, and an ellipsis if there are more."""
    return ", ".join(map(str, items[:most])) + (" …" if len(items) > most else "")


def did_you_mean(word: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """Return "did you mean …?" with the known word most similar to this one; "" if none is."""
    near = nearest_word(word, known, cutoff)
    return f"did you mean {near}?" if near else ""


def nearest_word(word: str, known: Iterable[str], cutoff: float = 0.0) -> str:
    """Return the known word most similar to this one; "" if none is as similar as `cutoff`, 0 to 1."""
    return next(iter(difflib.get_close_matches(word, known, 1, cutoff)), "")


def shown(value: Any) -> str:
    """Return a value of an argument for a message: a number, a text, or its type."""
    if value is None:
        return "none"
    if isinstance(value, Real | tuple | slice):
        return f"{value:g}" if isinstance(value, Real) and not isinstance(value, bool) else repr(value)[:60]
    return f"the text {value[:60]!r}" if isinstance(value, str) else f"the type {type(value).__name__}"


@contextmanager
def known_as(**names: str) -> Iterator[None]:
    """Rename arguments in the message of an `InputError` raised inside, as by ``columns="force_columns"``."""
    try:
        yield
    except InputError as error:
        for part in ("about", "expected", "found", "advice"):
            setattr(error, part, renamed(getattr(error, part), names))
        raise


def renamed(message: str, names: Mapping[str, str]) -> str:
    """Return a message with the caller's names of arguments, as in `known_as`."""
    return _NAMED.sub(lambda match: f"`{names.get(match[1], match[1])}`", message)


def with_options(message: str, options: Mapping[str, str] | None = None) -> str:
    """Return an error or a warning with command-line options in place of the library's arguments.

    options: by argument, as in ``{"pixel_size_um": "--pixel-size"}``; other arguments lose their backticks.

    An argument is any single name in backticks, which a regular expression finds in the text: a message must
    have nothing else in backticks.
    """
    known = options or {}
    return _NAMED.sub(lambda match: known.get(match[1], match[1]), message)
