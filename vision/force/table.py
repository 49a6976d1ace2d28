"""Table: the columns of a file as they stand, before anything is known about their meaning."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Table:
    """One block of numbers with its header.

    names, units: one per column, units "" where none is written.  numbers: (rows, columns), NaN where a cell
    is empty or not a number.  facts: how the file was read (layout, encoding, separator, decimal).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    numbers: NDArray[np.float64]
    facts: dict[str, str] = field(default_factory=dict)

    def listing(self) -> str:
        """The columns for a message: 1 "Time" [s], 2 "Load" [N] …; the first value where there is no name."""
        return ", ".join(self._label(k) for k in range(len(self.names)))

    def _label(self, k: int) -> str:
        if not self.names[k]:
            first = self.numbers[0, k] if len(self.numbers) else float("nan")
            return f"{k + 1} (no name, starts {first:g})"
        return f'{k + 1} "{self.names[k]}"' + (f" [{self.units[k]}]" if self.units[k] else "")
