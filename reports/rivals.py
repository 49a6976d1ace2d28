"""The programs that `reports/speed.py` compares with, each run in a separate process.

Run: python reports/rivals.py NAME FILM COLUMNS ROWS. The last line printed is the seconds of the work itself,
without imports.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.signal import find_peaks

STRIP_ROWS = 84  # in the middle of the frame
BLOCK = 64  # frames averaged at once


def strip_of(rows: int) -> slice:
    """Return the strip in a frame of so many rows."""
    first = max(0, (rows - STRIP_ROWS) // 2)
    return slice(first, min(rows, first + STRIP_ROWS))


def loop(film: Path, columns: int, rows: int) -> None:
    """Fit parabolas through nine pixels at local maxima frame by frame, as laboratories program it."""
    capture, offsets, found, number = cv2.VideoCapture(str(film)), np.arange(-4, 5), [], 0
    while (read := capture.read())[0]:
        profile = cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY)[strip_of(rows)].mean(axis=0)
        for peak in find_peaks(profile[4:-4], prominence=10, distance=8)[0] + 4:
            c2, c1, _ = np.polyfit(offsets, profile[peak - 4 : peak + 5], 2)
            found.append((number, peak - c1 / (2 * c2)))
        number += 1
    pd.DataFrame(found, columns=["frame", "x"]).to_csv(film.with_suffix(".csv"), index=False)


def opencv(film: Path, columns: int, rows: int) -> None:
    """Decode by OpenCV and average the strip, nothing else."""
    capture = cv2.VideoCapture(str(film))
    while (read := capture.read())[0]:
        cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY)[strip_of(rows)].mean(axis=0)


def mean(film: Path, columns: int, rows: int) -> None:
    """Average the strip of a memory-mapped raw film; headers count as pixels."""
    for frames in _blocks(film, columns, rows):
        frames.mean(axis=1)


def sums(film: Path, columns: int, rows: int) -> None:
    """Add up the rows of the strip in 16-bit numbers, the least that any program must do."""
    for frames in _blocks(film, columns, rows):
        np.add.reduce(frames, axis=1, dtype=np.uint16)


def _blocks(film: Path, columns: int, rows: int) -> Iterator[NDArray[np.uint8]]:
    """Yield the strip of some frames at a time, from the film mapped into memory."""
    data = np.memmap(film, np.uint8, "r")
    frames = data[: data.size // (rows * columns) * rows * columns].reshape(-1, rows, columns)
    for start in range(0, len(frames), BLOCK):
        yield frames[start : start + BLOCK, strip_of(rows)]


def decode(film: Path, columns: int, rows: int) -> None:
    """Decode by FFmpeg on all cores without using the pixels."""
    with av.open(str(film)) as container:
        container.streams.video[0].thread_type = "AUTO"
        for _ in container.decode(video=0):
            pass


if __name__ == "__main__":
    work = {"loop": loop, "opencv": opencv, "mean": mean, "sums": sums, "decode": decode}[sys.argv[1]]
    started = time.perf_counter()
    work(Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
    print(time.perf_counter() - started)
