"""Speed of finding, fitting and linking, against the usual loop, on the same I(x, t) in memory.

Run: python reports/benchmark_tracking.py    (needs trackpy: pip install -e '.[bench]')
Writes reports/tracking_speed.md.
"""

from __future__ import annotations

import os
import platform
import statistics
import time
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import find_peaks

import vision
from vision.experiment import Experiment, profiles, with_settings

FRAMES, RUNS = 8000, 5
RIVAL_FRAMES = 1500  # the loop's time grows in proportion


def strip():
    """8000 frames of the paper's test: 50 ridges in 1920 columns."""
    seconds = FRAMES / 60
    experiment = with_settings(Experiment(), {"camera.duration_s": seconds})
    return profiles(experiment)[0]


def rival(intensity):
    """One Python loop: local maxima, parabola through 9 pixels, nearest-neighbour linking."""
    import trackpy

    trackpy.quiet()
    offsets, found = np.arange(-4, 5), []
    for number, profile in enumerate(intensity):
        for peak in find_peaks(profile, prominence=10, distance=8)[0]:
            c2, c1, _ = np.polyfit(offsets, profile[peak - 4 : peak + 5], 2)
            found.append((number, peak - c1 / (2 * c2), 0.0))
    table = pd.DataFrame(found, columns=["frame", "x", "y"])
    return trackpy.link(table, search_range=9, memory=3)


def timed(call, runs):
    """Wall-clock seconds of each run, the first left out."""
    seconds = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return seconds[1:]


def main() -> None:
    """Measure both and write the report."""
    intensity = strip()
    ours = [len(intensity) / s for s in timed(lambda: vision.track_sheets(intensity), RUNS)]
    part = np.asarray(intensity.values[:RIVAL_FRAMES])
    loop = [len(part) / s for s in timed(lambda: rival(part), 1)]
    ratio = statistics.median(ours) / statistics.median(loop)
    lines = [
        "# Speed of tracking",
        "",
        f"From I(x, t) in memory, {FRAMES} frames of 1920 columns, to x(n, t) of 50 sheets.",
        "",
        "| what | frames/s: min | median | max |",
        "|---|---|---|---|",
        f"| `vision.track_sheets` | {min(ours):,.0f} | {statistics.median(ours):,.0f} | {max(ours):,.0f} |",
        f"| loop: `find_peaks` + `numpy.polyfit` + `trackpy.link` | {min(loop):,.0f} | "
        f"{statistics.median(loop):,.0f} | {max(loop):,.0f} |",
        "",
        f"Ratio of the medians: {ratio:.0f}. Measured on {os.cpu_count()} cores ({platform.machine()}),",
        f"Python {platform.python_version()}, numpy {np.__version__}; {RUNS} runs after a first one;",
        f"the loop on {RIVAL_FRAMES} frames.",
        "",
        "Made by `python reports/benchmark_tracking.py`.",
    ]
    text = "\n".join(lines) + "\n"
    (Path(__file__).parent / "tracking_speed.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
