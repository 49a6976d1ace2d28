"""Overhead of a campaign over the analysis, and the load on the file server.

Run from the checkout: python -m reports.campaign [FILMS]
Writes reports/campaign.md. With FILMS in place of 200 it is quicker (the number is stated).
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from reports.writing import head, row, write_report
from tests.scenes.comb_video import frames_of, positions, write_video

HERE = Path(__file__).parents[1]
PYTHON = [sys.executable, "-P", "-m"]
TRACK = [*PYTHON, "vision.command"]
CONTAINERS = ("raw", "mjpeg", "h264")
FRAMES, FIRST, FPS, COLUMNS, ROWS = 300, 75, 60, 1920, 1200
CORES = (10, 100, 1000)
REPEATS = 3  # the least CPU time counts: other programs only add to it
LINES = {"1 Gbit/s": 0.11e9, "10 Gbit/s": 1.1e9, "100 Gbit/s": 11e9}
TEXT = """
Beside the films each job writes about 25 small files a film (run folder, state, tables) and reads
64 MiB of its inputs again for their fingerprint (of films up to 64 MiB all). Planning reads the
same 64 MiB once, on the machine where the campaign is started, and not again while size and time
stay. The page reads one small file a film, at most every three seconds, and more rarely with
hundreds of films.

**Where the limit lies.** Films are independent, so cores add up until the file server cannot
follow: at the numbers of cores above. Uncompressed films ask most of it although only the strip's
rows are read (here most of the frame; a strip of a tenth of the rows asks for a tenth); compressed
ones are limited by decoding. `--stage` copies the whole film to the node's disk first: worth it for
compressed films on a slow or busy share, not for uncompressed ones, of which it moves every row.
Beyond the file server the limits are the longest single film, which is one job; the pool, which is
one job after all others; and the machine that plans, which opens every film's header.
"""
EMPTY = """
rule films:
    input: expand("{job}.done", job=range(int(config["jobs"])))
rule film:
    output: touch("{job}.done")
    shell: "true"
"""


@dataclass(frozen=True)
class Cost:
    """Costs of a process and its children."""

    cpu_s: float
    wall_s: float
    read_mb: float
    memory_mb: float


def cost(command: list[str], folder: Path, evict: Path | None = None) -> Cost:
    """Run a command; the file `evict` is removed from the cache first."""
    if evict is not None:
        with evict.open("rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    environment = os.environ | {"PYTHONPATH": str(HERE)}
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    nowhere = subprocess.DEVNULL
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=nowhere, stderr=nowhere)
    _, _, own = os.wait4(process.pid, 0)
    process.returncode = 0
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - started
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(cpu, wall, (after.ru_inblock - before.ru_inblock) * 512 / 1e6, own.ru_maxrss / 1e3)


def short_films(folder: Path, count: int) -> list[str]:
    """Measure the overhead of a campaign of short films over single calls."""
    names = [f"t{k}.tif" for k in range(count)]
    for k, name in enumerate(names):
        write_video(folder / name, frames_of(positions(60), seed=k))
    (folder / "tests.csv").write_text("film,fps\n" + "".join(f"{name},20\n" for name in names))
    single = min(  # of several, as other programs only add to it
        cost([*TRACK, name, "--fps", "20", "--out", f"single/{name}"], folder).cpu_s for name in names[:5]
    )
    campaign = cost([*TRACK, "campaign", "tests.csv", "--out", "out"], folder)
    again = cost([*TRACK, "campaign", "tests.csv", "--out", "out"], folder)
    done = len(list((folder / "out" / "runs").glob("*/run.json")))
    started = cost([*TRACK, "campaign-job", "out/plan.json", "none"], folder)
    cores = os.cpu_count() or 1
    share, clock = campaign.cpu_s / count / single, campaign.wall_s / (count * single / cores)
    return [
        f"{done} of {count} films of 60 frames of 180 × 12 px on {cores} cores, all figures CPU time:",
        "",
        *head(["what", "s"]),
        f"| one film by `track`, a process for it alone | {single:.2f} |",
        f"| {count} films one by one | {count * single:.0f} |",
        f"| {count} films as a campaign, pool included | {campaign.cpu_s:.0f} |",
        f"| a film of the campaign | {campaign.cpu_s / count:.2f} |",
        f"| **campaign over single calls** (at most 1.1 wanted) | **{share:.2f}** |",
        f"| the same campaign again, nothing to do | {again.cpu_s:.1f} |",
        f"| start of a job's process, before its first film | {started.cpu_s:.1f} |",
        "",
        f"By the clock the campaign took {campaign.wall_s:.0f} s ({clock:.2f} of the single calls' CPU time "
        f"over the cores) on a machine that others used too (load average {os.getloadavg()[1]:.0f}). The "
        "start of Python and of the libraries is most of a short film's time, so a job takes several films.",
    ]


def scheduler(folder: Path) -> list[str]:
    """Measure the overhead of Snakemake for a job."""
    (folder / "Snakefile").write_text(EMPTY)
    spent = {}
    for jobs in (10, 210):
        command = [*PYTHON, "snakemake", "-c", "2", "--scheduler", "greedy", "--drop-metadata"]
        spent[jobs] = cost([*command, "--config", f"jobs={jobs}"], folder).cpu_s
        for file in folder.glob("*.done"):
            file.unlink()
    each = (spent[210] - spent[10]) / 200
    start = spent[10] - 10 * each
    return [
        f"Snakemake takes {start:.1f} s to start and {1000 * each:.0f} ms for each job; on a cluster each "
        "job starts it twice more on the node (the batch job and its step), so that a job of one short film "
        f"would cost {2 * start:.0f} s beside the film. Jobs there last a minute where films are enough."
    ]


def file_server(folder: Path) -> tuple[list[str], dict[str, float]]:
    """Measure what one core reads of each kind of film, and how that scales."""
    rows, rates = [], {}
    for container in CONTAINERS:
        where = folder / container
        camera = {"duration_s": FRAMES / FPS, "fps": FPS, "height": ROWS, "width": COLUMNS}
        size = [word for name, value in camera.items() for word in ("--set", f"camera.{name}={value}")]
        cost([*TRACK, "simulate", str(where), *size, "--container", container], folder)
        video = next(where.glob("video.*"))
        few, all_ = (
            min(
                (cost(_part(video, stop), folder, evict=video) for _ in range(REPEATS)),
                key=attrgetter("cpu_s"),
            )
            for stop in (FIRST, FRAMES)
        )
        mega = (FRAMES - FIRST) * COLUMNS / 1e6
        per_frame = (all_.cpu_s - few.cpu_s) / (FRAMES - FIRST)
        read = video.stat().st_size / FRAMES / 1e6
        # a compressed film is read whole, and as small a one for its fingerprint already
        reads = (all_.read_mb - few.read_mb) / (FRAMES - FIRST) if container == "raw" else read
        rates[container] = reads / per_frame
        rows.append(
            f"| {container} | {read:.3f} | {reads:.3f} | {1000 * per_frame:.1f} | {rates[container]:.0f} | "
            f"{(all_.cpu_s - few.cpu_s) / mega:.2f} | {(all_.memory_mb - few.memory_mb) / mega:.0f} | "
            f"{few.memory_mb:.0f} |"
        )
        video.unlink()
    top = [
        f"Films of {FRAMES} frames of {COLUMNS} × {ROWS} px, read from disk and not from memory; the "
        "difference between the whole film and its first quarter, so without start, figures and fingerprint:",
        "",
        "| film | MB/frame in the file | MB/frame read | CPU ms/frame | MB/s a core | s per million I(x,t) | "
        "MB per million I(x,t) | MB for the first quarter |",
        "|---|---|---|---|---|---|---|---|",
    ]
    return [*top, *rows], rates


def _part(video: Path, stop: int) -> list[str]:
    """Track the first frames of a film."""
    return [*TRACK, str(video), "--frames", f"0:{stop}", "--out", "run", "--overwrite"]


def _short(number: float) -> str:
    return f"{number:.0f}" if number >= 10 else f"{number:.2g}"


def needs(rates: dict[str, float]) -> list[str]:
    """Return what the file server must deliver, and its limit."""
    fed_by = [f"cores that {name} feeds" for name in LINES]
    table = head(["film", *(f"{cores} cores" for cores in CORES), *fed_by])
    for container, rate in rates.items():
        needed = [f"{_short(rate * cores / 1000)} GB/s" for cores in CORES]
        fed = [_short(speed / 1e6 / rate) if rate > 0 else "–" for speed in LINES.values()]
        table.append(row([container, *needed, *fed]))
    return [*table, "", *TEXT.strip().splitlines()]


def main() -> None:
    """Measure everything."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parts = [*short_films(_made(folder / "short"), count), "", *scheduler(_made(folder / "empty"))]
        write(parts, *file_server(_made(folder / "films")))


def write(parts: list[str], server: list[str], rates: dict[str, float]) -> None:
    """Write the report from its parts."""
    text = [
        "# Campaigns: overhead and what the file server must deliver",
        "",
        "## Overhead",
        "",
        *parts,
        "",
        "## One core and the file server",
        "",
        *server,
        "",
        "## 10, 100, 1000 cores",
        "",
        *needs(rates),
    ]
    write_report("campaign", text)


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


if __name__ == "__main__":
    main()
