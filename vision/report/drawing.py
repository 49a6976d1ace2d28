"""The figures' files, PDF and SVG, drawn by two processes at once: a run spends most of its end on them."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from vision.report.chart import Chart
from vision.report.draw import draw_chart
from vision.report.style import picture_style

_WIDTH_IN = 6.0
_RESOLUTION = 300  # of pictures within a vector file, dots per inch
_STAMPS = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}  # the same run gives the same files


def draw_files(folder: Path, chart: Chart) -> None:
    """NAME.pdf and NAME.svg of a chart. Text stays text in both."""
    from matplotlib.figure import Figure

    with picture_style():
        size = (_WIDTH_IN, max(2.4, _WIDTH_IN * chart.aspect + 0.7))
        figure = Figure(figsize=size, layout="constrained")
        draw_chart(figure.subplots(), chart, legend_above=True)
        figure.draw_without_rendering()
        figure.set_layout_engine(None)  # placed once, not once for each format
        for suffix, stamp in _STAMPS.items():
            figure.savefig(folder / f"{chart.name}.{suffix}", dpi=_RESOLUTION, metadata=stamp)


@contextmanager
def drawn_meanwhile(folder: Path, charts: Sequence[Chart]) -> Iterator[None]:
    """A second process begins with the first chart while the block runs; then this one begins with the last.

    What the helper leaves undone, or cannot do, is done here. Leaving the block by an exception ends it.
    Raises: OSError where the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for chart in charts:
        _claim(folder, chart).unlink(missing_ok=True)
    helper = _start(folder, charts) if (os.cpu_count() or 1) > 1 else None
    try:
        yield
        mine = {chart.name for chart in reversed(charts) if _drawn_here(folder, chart)}
        if helper is not None and helper.wait() != 0:
            for chart in charts:
                if chart.name not in mine:
                    draw_files(folder, chart)
    finally:
        if helper is not None:
            helper.kill()
            helper.wait()


def _start(folder: Path, charts: Sequence[Chart]) -> subprocess.Popen[bytes] | None:
    """The helper, with its work; None where no process can be started."""
    there = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable or "python", "-m", "vision.report.drawing", str(folder.resolve())]
    none = subprocess.DEVNULL
    try:
        with tempfile.TemporaryFile() as work:
            pickle.dump(list(charts), work)
            work.seek(0)
            return subprocess.Popen(command, stdin=work, stdout=none, stderr=none, env=there)
    except OSError:
        return None


def _claim(folder: Path, chart: Chart) -> Path:
    """The file that says that a chart is being drawn: whoever makes it first draws the chart."""
    return folder / f"{chart.name}.pdf"


def _drawn_here(folder: Path, chart: Chart) -> bool:
    """Draw a chart unless the other process has begun it."""
    try:
        _claim(folder, chart).touch(exist_ok=False)
    except FileExistsError:
        return False
    draw_files(folder, chart)
    return True


if __name__ == "__main__":
    for one in pickle.load(sys.stdin.buffer):
        _drawn_here(Path(sys.argv[1]), one)
