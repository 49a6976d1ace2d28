"""The one exception a user can cause."""

from __future__ import annotations

import os


class InputError(Exception):
    """Input or arguments the program cannot use.

    The message is one line: what it is about (a file, an option), what was expected, what was found
    and what to do. Commands show it as it is and end with exit status 2.
    """

    def __init__(self, about: str | os.PathLike[str], expected: str, found: str, advice: str = "") -> None:
        parts = f"{os.fspath(about)}: expected {expected}; found {found}"
        super().__init__(" ".join(f"{parts}; {advice}".split()) if advice else " ".join(parts.split()))
