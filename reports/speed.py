"""Speed of the whole command, compared with the loop it replaces and with the limits of the machine.

Run from the checkout on a quiet machine: python -m reports.speed [--runs 5] [--folder /tmp/films]
Takes half an hour and 20 GB of disk. Writes reports/speed.md and reports/speed.png.
"""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import itertools
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure as Page

from reports.rivals import strip_of
from reports.writing import head, row, write_report
from vision.experiment import Experiment, with_settings
from vision.experiment.scene import frame_times, make_scene
from vision.experiment.simulate import frame_blocks, write_video
from vision.numeric import Pixels

HERE = Path(__file__).parent
PYTHON = [sys.executable, "-P"]
RENDERED = 48  # frames drawn for a film; it shows them forwards and backwards until it is long enough
FIXED = "import numpy, scipy, pandas, xarray"


@dataclass(frozen=True)
class Film:
    """A film to measure with; raw unless its container differs."""

    frames: int
    columns: int = 1920
    rows: int = 100
    sheets: int = 50
    container: str = "raw"

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.container}_{self.frames}_{self.columns}x{self.rows}_{self.sheets}"


@dataclass(frozen=True)
class Cost:
    """Wall-clock and computing seconds of one process, and its output."""

    wall_s: float
    cpu_s: float
    said: str = ""


def made(film: Film, folder: Path) -> Path:
    """Return the file of the film, which is rendered once."""
    target = folder / film.name
    found = next(iter(target.glob("video.*")), None) if target.is_dir() else None
    if found is not None:
        return found
    settings = {
        "camera.width": film.columns,
        "camera.height": film.rows,
        "camera.strip_rows": min(84, film.rows),
        "camera.duration_s": RENDERED / 60,
        "sheets.count": film.sheets,
        "sheets.per_side": max(25, film.sheets // 2),
        "sheets.pitch_px": 0.9 * film.columns / film.sheets,
    }
    experiment = with_settings(Experiment(), settings)
    rendered = np.concatenate(list(frame_blocks(make_scene(experiment))))
    times = frame_times(with_settings(experiment, {"camera.duration_s": (film.frames + 0.5) / 60}))
    partial = Path(tempfile.mkdtemp(dir=folder))
    write_video(
        partial, _there_and_back(rendered, film.frames), experiment.camera, times, container=film.container
    )
    partial.rename(target)
    return next(target.glob("video.*"))


def _there_and_back(rendered: Pixels, frames: int) -> Iterator[Pixels]:
    order = itertools.cycle([*range(len(rendered)), *range(len(rendered) - 2, 0, -1)])
    for number in itertools.islice(order, frames):
        yield rendered[number : number + 1]


def process(arguments: Sequence[str]) -> Cost:
    """Run a command to its end."""
    with tempfile.TemporaryFile("w+") as said:
        started = time.perf_counter()
        child = subprocess.Popen(
            arguments, stdout=said, stderr=subprocess.DEVNULL, cwd=HERE.parent, env=_surroundings()
        )
        _, status, used = os.wait4(child.pid, 0)
        wall_s = time.perf_counter() - started
        if os.waitstatus_to_exitcode(status) not in (0, 1):
            raise SystemExit(f"{' '.join(arguments)} ended with status {status}")
        said.seek(0)
        return Cost(wall_s, used.ru_utime + used.ru_stime, said.read())


def _surroundings() -> dict[str, str]:
    """Return the environment for this checkout; modules are compiled once, as after an installation."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"PYTHONPATH": str(HERE.parent)}


def in_turn(
    commands: Mapping[str, Sequence[str]], runs: int, before: Callable[[], None] = lambda: None
) -> dict[str, list[Cost]]:
    """Run every command once to warm up, then all of them in turn, `runs` times, each after `before`."""
    for command in commands.values():
        process(command)
    costs: dict[str, list[Cost]] = {name: [] for name in commands}
    for _ in range(runs):
        for name, command in commands.items():
            before()
            costs[name].append(process(command))
    return costs


def out_of_cache(path: Path) -> None:
    """Make the system forget a film, which must be read from the disk then, as a new one."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def into_cache(path: Path) -> None:
    """Read a film, of which the system may have forgotten a part since the last run."""
    with path.open("rb", buffering=0) as file:
        while file.read(1 << 24):
            pass


def ours(film: Film, path: Path, *options: str) -> list[str]:
    """Return the command `track FILM`, with the strip that the other programs use."""
    rows = strip_of(film.rows)
    out = str(path.parent / "run")
    return [
        *(*PYTHON, str(HERE.parent / "cli.py"), str(path), "--strip", f"{rows.start}:{rows.stop}"),
        *("--fps", "60", "--out", out, "--overwrite", "--quiet", *options),
    ]


def rival(name: str, film: Film, path: Path) -> list[str]:
    """Return the command of a program of `reports/rivals.py`."""
    return [*PYTHON, str(HERE / "rivals.py"), name, str(path), str(film.columns), str(film.rows)]


def stages(path: Path) -> dict[str, float]:
    """Return the seconds of each stage of the last run."""
    record = json.loads((path.parent / "run" / "run.json").read_text(encoding="utf-8"))
    return {str(name): float(seconds) for name, seconds in record["seconds"].items()}


def middle(costs: Sequence[Cost]) -> float:
    """Return the median wall-clock time, s."""
    return statistics.median(cost.wall_s for cost in costs)


def timed(name: str, costs: Sequence[Cost], unit_s: float | None = None) -> str:
    """Return a line of a table: seconds, computing time, memory, and the ratio to a reference."""
    walls = sorted(cost.wall_s for cost in costs)
    ratio = "" if unit_s is None else f"{middle(costs) / unit_s:.2f}"
    cpu = f"{statistics.median(c.cpu_s for c in costs):.2f}"
    return row([name, f"{middle(costs):.2f}", f"{walls[0]:.2f}–{walls[-1]:.2f}", cpu, ratio])


HEAD = head(["what", "s, median", "s, range", "CPU s", "ratio"])


def starting(runs: int) -> list[str]:
    """Measure the help, the imports, and the libraries alone."""
    costs = in_turn(
        {
            "`python -c pass`": [*PYTHON, "-c", "pass"],
            "`import vision`": [*PYTHON, "-c", "import vision"],
            "`track --help`": [*PYTHON, str(HERE.parent / "cli.py"), "--help"],
            "NumPy, SciPy, pandas and xarray alone": [*PYTHON, "-c", FIXED],
            "with what the loop needs of SciPy": [*PYTHON, "-c", f"{FIXED}, scipy.signal, scipy.optimize"],
        },
        runs,
    )
    return ["## Starting", "", *HEAD, *(timed(name, cost) for name, cost in costs.items()), ""]


def raw_films(folder: Path, runs: int) -> list[str]:
    """Compare the programs on a short raw film, and measure a frame's cost from the cache and the disk."""
    short = Film(1200, rows=1200)
    path = made(short, folder)
    commands = {"`track`": ours(short, path)}
    commands |= {name: rival(name, short, path) for name in ("loop", "mean", "sums")}
    costs = in_turn(commands, runs)
    loop_s = middle(costs["loop"])
    lines = ["## A raw film of 1920 × 1200 pixels, strip of 84 rows", ""]
    lines += [f"{short.frames} frames in the page cache (ratio to the loop):", "", *HEAD]
    lines += [*(timed(name, cost, loop_s) for name, cost in costs.items()), ""]
    lines += [
        "`track`, the mean and the sums: seconds for a short and a long film, and from both the cost of one"
    ]
    lines += ["more frame; ratios of `track` to the other two.", ""]
    lines += head(["film", "frames", "s", "ms a frame", "ratios"])
    cached = (Film(2400), Film(19_200))
    on_disk = (short, Film(4800, rows=1200))
    ours_s, fixed_s, cost = _cost_of_a_frame(folder, runs, cached, from_disk=False)
    lines += [cost, _cost_of_a_frame(folder, runs, on_disk, from_disk=True)[2]]
    frame_s = loop_s / short.frames
    at_20000 = frame_s * 20_000 / (fixed_s + ours_s * 20_000)
    lines += [
        "",
        f"From the cache: {fixed_s:.2f} s before the first frame and after the last, {1e3 * ours_s:.3f} ms a "
        f"frame; the loop {1e3 * frame_s:.2f} ms a frame ({frame_s / ours_s:.0f} ×). "
        f"20 000 frames are {at_20000:.0f} × as fast as the loop. The mean is NumPy's, of the film mapped "
        "into memory; the sums of 16-bit numbers are the least that any program must do. Of a mapped film, "
        "the disk delivers rows around the strip as well; `track` reads the strip's rows alone.",
        "",
    ]
    return lines


def _cost_of_a_frame(
    folder: Path, runs: int, films: tuple[Film, Film], *, from_disk: bool
) -> tuple[float, float, str]:
    """Return the seconds of one more frame, those without any frame, and a line of the table."""
    seconds: dict[str, list[float]] = {"`track`": [], "mean": [], "sums": []}
    for film in films:
        path = made(film, folder)
        before = partial(out_of_cache if from_disk else into_cache, path)
        commands = {"`track`": ours(film, path)} | {
            name: rival(name, film, path) for name in ("mean", "sums")
        }
        costs = in_turn(commands, runs, before)
        for name, cost in costs.items():
            seconds[name].append(middle(cost))
    few, many = (film.frames for film in films)
    mine, mean, sums = ((long - short) / (many - few) for short, long in seconds.values())
    took = ", ".join(f"{short:.2f} and {long:.2f}" for short, long in seconds.values())
    a_frame = ", ".join(f"{1e3 * cost:.3f}" for cost in (mine, mean, sums))
    ratios = f"{mine / mean:.2f} and {mine / sums:.2f}"
    where = f"{'on the disk' if from_disk else 'in the cache'}, {films[0].rows} rows high"
    line = row([where, f"{few} and {many}", took, a_frame, ratios])
    return mine, seconds["`track`"][0] - mine * few, line


def codecs(folder: Path, runs: int) -> list[str]:
    """Compare the stage "reading" of `track` on compressed films with OpenCV and the decoder alone."""
    lines = [
        "## Compressed film, 200 frames of 1920 × 1200",
        "",
        "Seconds of reading alone, without imports.",
        "",
        "| codec | `track` | OpenCV and the mean | decoder alone | OpenCV / `track` | `track` / decoder |",
        "|---|---|---|---|---|---|",
    ]
    for container in ("mjpeg", "h264", "ffv1"):
        film = Film(200, rows=1200, container=container)
        path = made(film, folder)
        commands = {"ours": ours(film, path, "--no-report")}
        commands |= {name: rival(name, film, path) for name in ("opencv", "decode")}
        read: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(runs):
            for name, command in commands.items():
                said = process(command).said
                read[name].append(stages(path)["reading"] if name == "ours" else float(said.split()[-1]))
        mine, cv, bare = (statistics.median(read[name]) for name in ("ours", "opencv", "decode"))
        lines.append(row([container, *(f"{s:.2f}" for s in (mine, cv, bare, cv / mine, mine / bare))]))
    return [*lines, ""]


SERIES = {
    "frames": [Film(n) for n in (600, 2400, 9600, 19_200)],
    "columns": [Film(2400, columns=n, sheets=20) for n in (480, 960, 1920, 3840)],
    "rows": [Film(1200, rows=n) for n in (100, 300, 600, 1200)],
    "sheets": [Film(2400, sheets=n) for n in (10, 25, 50, 90)],
}
SHOWN = ("reading", "tracking", "tables", "pictures and report")


def scaling(folder: Path) -> list[str]:
    """Measure each stage against the size of the film, as tables and one figure."""
    lines = ["## Cost against the film's size", ""]
    lines += ["Raw film in the page cache; seconds of each stage, the second of two runs.", ""]
    page = Page(figsize=(9.6, 2.9), layout="constrained")
    for ax, (what, films) in zip(page.subplots(1, 4, sharey=True), SERIES.items(), strict=True):
        sizes, seconds = [], []
        lines += head([what, *SHOWN, "whole command"])
        for film in films:
            path = made(film, folder)
            process(ours(film, path))
            cost = process(ours(film, path))
            parts = stages(path)
            sizes.append(getattr(film, what))
            seconds.append([*(parts[name] for name in SHOWN), cost.wall_s])
            lines.append(row([f"{sizes[-1]:,}".replace(",", " "), *(f"{s:.2f}" for s in seconds[-1])]))
        lines.append("")
        for label, values, mark in zip(
            (*SHOWN, "whole command"), zip(*seconds, strict=True), "osv^D", strict=True
        ):
            ax.plot(sizes, values, marker=mark, markersize=4, label=label)
        ax.set(xscale="log", yscale="log", xlabel=what, ylabel="s" if what == "frames" else "")
        names = [f"{size / 1000:.3g}k" if size >= 1000 else f"{size}" for size in sizes]
        ax.set_xticks(sizes, names, minor=False)
        ax.minorticks_off()
    page.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False)
    page.savefig(HERE / "speed.png", dpi=130)
    return [*lines, "![Seconds of each stage against frames, columns, rows and sheets](speed.png)", ""]


def machine() -> list[str]:
    """Return the machine and the versions used."""
    names = ("numpy", "scipy", "pandas", "xarray", "matplotlib", "opencv-python-headless", "av")
    found = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in names)
    load = ", ".join(f"{value:.2f}" for value in os.getloadavg())
    return [
        f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}, {os.cpu_count()} cores ({platform.machine()}), "
        f"load {load} at the start; Python {platform.python_version()}, {found}. "
        "Commands take turns; medians. The loop is `reports/rivals.py`: OpenCV, `find_peaks`, `polyfit`.",
        "",
    ]


LIMITS = """## What limits what

Raw film and TIFF stacks: the strip's rows are read and nothing else, so the disk, or memory once a film is in
the cache; more cores do not help, a faster disk does. MJPEG: libjpeg-turbo, on all cores; of frames with
restart markers between the rows of blocks, as FFmpeg and many cameras write them, it decodes the strip's rows
alone. H.264 and FFV1: FFmpeg's decoding on all cores; every pixel of every frame must be decoded.
Short films: loading the libraries and drawing, which neither disk nor cores shorten.
"""


def main() -> None:
    """Measure everything and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--folder", type=Path, help="where films are kept for the next time")
    chosen = parser.parse_args()
    folder = Path(chosen.folder or tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lines = ["# Speed", "", *machine(), *starting(chosen.runs), *raw_films(folder, chosen.runs)]
        lines += [*codecs(folder, chosen.runs), *scaling(folder), LIMITS.rstrip()]
        write_report("speed", lines)
    finally:
        if chosen.folder is None:
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
