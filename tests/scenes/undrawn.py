"""`track` without its pictures, where these are not what is tested: python -m tests.scenes.undrawn VIDEO …

Files of one pixel or byte stand in their place. Drawing, and loading what draws, takes a third of a short
run's time.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np

DRAWING = "vision.figures.drawing"
BYTE = b"."


@contextmanager
def undrawn() -> Iterator[None]:
    """Within this process, for as long as the block lasts. PDF, SVG and axes are drawn all the same."""
    from vision.figures import drawing  # which a process that draws nothing does not load

    render, drawing.render = drawing.render, lambda figure, **how: np.zeros((1, 1, 4), np.uint8)
    try:
        yield
    finally:
        drawing.render = render


def undraw() -> None:
    """For the rest of this process, which then need not load matplotlib."""
    stand_in = ModuleType(DRAWING)
    stand_in.png = lambda figure, **how: BYTE  # type: ignore[attr-defined]
    stand_in.render = lambda figure, **how: None  # type: ignore[attr-defined]
    stand_in.write = lambda figure, path, **how: path.write_bytes(BYTE)  # type: ignore[attr-defined]
    stand_in.write_png = lambda pixels, path: path.write_bytes(BYTE)  # type: ignore[attr-defined]
    sys.modules[DRAWING] = stand_in


if __name__ == "__main__":
    from vision.command.main import main

    undraw()
    main()
