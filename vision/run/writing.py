"""Write an analysis to a run folder."""

from __future__ import annotations

import shutil
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pandas as pd

from vision.data import (
    FlagCounts,
    ForceMetadata,
    StickMetadata,
    StripMetadata,
    changed_settings,
    operations_of,
)
from vision.errors import InputError
from vision.figures import Figure, save_figures
from vision.figures.catalogue import FIGURES, figures_of, kymograph, not_in_report, overview
from vision.folder import RUN_JSON, keep_others, run_folder, write_csv, write_json
from vision.memory import give_back_freed
from vision.pipeline import Analysis
from vision.report import write_report
from vision.run.provenance import Origin, Parameter, checksum_of
from vision.run.tables import sheets_table, write_kymograph_tif, write_tracks_csv, write_tracks_nc
from vision.sample import PUBLISHED
from vision.sheets import doubtful_stretches
from vision.sheets.corrections import (
    Correction,
    Decisions,
    corrections_text,
    decision_texts,
    ordered,
    read_decisions,
    sheet_names,
)
from vision.sheets.recovery import missing_stretches
from vision.shells import deformation_table
from vision.summary import findings, noise_figures
from vision.systematics import Budget, systematic_budget

FAILURES = "failures.txt"
CORRECTIONS = "corrections.toml"
WRITTEN = frozenset(
    f"{RUN_JSON} {CORRECTIONS} {FAILURES} report.html overview.png kymograph.png kymograph.tif tracks.csv "
    "tracks.nc sheets.csv events.csv models.json clock.json deformation.csv shells.csv force.png figures.npz "
    "first_view.zip".split()
)
"""Names of the files that a run folder holds; others in it are the user's."""
COUNTS = ("expected", "read", "lost", "blank", "corrupt")
# facts about the strip that other entries of run.json hold
ELSEWHERE = {"warnings", "strip_z0", "strip_z1", "strip_how", "tilt_deg", "clock_kind", "clock_file", "fps"}


def write_run(
    analysis: Analysis,
    target: Path,
    origin: Origin,
    *,
    overwrite: bool = False,
    report: bool = True,
    facts: Mapping[str, Any] | None = None,
    decisions: Decisions | None = None,
    further: Sequence[Path] = (),
) -> dict[str, Any]:
    """Write tables, pictures, report.html and run.json of a run, and return the content of run.json.

    target: the run folder; an earlier one is replaced with `overwrite`.  facts: further entries of run.json.
    decisions: those for corrections.toml, by default ``analysis.settings.corrections``; an earlier
    corrections.toml with others is then kept under the name `set_aside`. So are files of the user.
    further: files to copy into the folder.

    Raises: InputError if the folder exists (without `overwrite`) or cannot be written; nothing is left then.
    """
    started = time.perf_counter()
    origin = replace(origin, parameters=origin.parameters | _found_pixel_size(analysis, origin))
    seconds = dict(analysis.seconds)
    give_back_freed()
    with run_folder(target, overwrite=overwrite) as folder:
        failures = dict(analysis.failures)
        with _largest_meanwhile(analysis, folder):
            inputs, budget = origin.describe(), systematic_budget(analysis)
            _write_tables(analysis, folder, origin)
            give_back_freed()
            seconds["tables"] = time.perf_counter() - started
            content = {**run_facts(analysis, origin, inputs, budget), **(facts or {})}
            _write_decisions(analysis, folder, content, decisions)
            for file in further:
                shutil.copyfile(file, folder / file.name)
            seconds["run facts"] = time.perf_counter() - started - seconds["tables"]
            drawn = time.perf_counter()
            _write_figures_and_page(analysis, folder, content, failures, origin, report=report)
            seconds["pictures and report"] = time.perf_counter() - drawn
        if failures:
            text = "\n\n".join(f"{name}\n{details}" for name, details in failures.items())
            (folder / FAILURES).write_text(text, encoding="utf-8", errors="replace")
            content["failures"] = list(failures)
        seconds["total"] = sum(analysis.seconds.values()) + time.perf_counter() - started
        content["seconds"] = seconds
        write_json(content, folder / "run.json")
        keep_others(target, folder, WRITTEN)
        if decisions is None and (name := set_aside(target, analysis.settings.corrections)):
            shutil.copy2(target / CORRECTIONS, folder / name)
    return content


def _found_pixel_size(analysis: Analysis, origin: Origin) -> dict[str, Parameter]:
    """Return the pixel size and its error as found, if they follow from the pitch or from the film's file."""
    stated, size = origin.parameters.get("pixel_size"), analysis.pixel_size_um
    if size is None or (stated is not None and stated.how in ("given", "config")):
        return {}
    error = analysis.pixel_size_err_um
    return {"pixel_size": Parameter(size, "found"), "pixel_size_err": Parameter(error, "found")}


def set_aside(target: Path, corrections: Sequence[Correction], *, undone: bool = True) -> str:
    """Return the name under which a new run keeps the decisions of the run that it replaces.

    It contains the time at which they were written last. "" if there are none, or if all are applied again.
    undone: whether decisions that were undone count, too.
    """
    path = target / CORRECTIONS
    if not path.is_file():
        return ""
    with suppress(InputError):
        earlier = read_decisions(path)
        applied = [one.what for one in corrections]
        if not (undone and earlier.undone) and all(one.what in applied for one in earlier.corrections):
            return ""
    written = datetime.fromtimestamp(path.stat().st_mtime)
    return f"{path.stem}_{written:%Y-%m-%d_%H%M%S}{path.suffix}"


@contextmanager
def results_folder(
    target: Path, facts: Mapping[str, Any], *, started: float, overwrite: bool
) -> Iterator[Path]:
    """Yield a folder for a command's results, write its run.json at the end, and put it in place.

    facts: content of run.json besides the time since `started`, a value of `time.perf_counter`.
    Raises: InputError as `run_folder`.
    """
    with run_folder(target, overwrite=overwrite) as folder:
        yield folder
        write_json({**facts, "seconds": {"total": time.perf_counter() - started}}, folder / "run.json")


def _write_decisions(
    analysis: Analysis, folder: Path, content: Mapping[str, Any], decisions: Decisions | None
) -> None:
    """Write corrections.toml, if there are any decisions."""
    checksum = checksum_of(next(iter(content["inputs"]), {}))
    written = decisions or Decisions(corrections=ordered(analysis.settings.corrections), film=checksum)
    if written.corrections or written.undone:
        (folder / CORRECTIONS).write_text(corrections_text(written), encoding="utf-8")


def _write_figures_and_page(
    analysis: Analysis,
    folder: Path,
    content: dict[str, Any],
    failures: dict[str, str],
    origin: Origin,
    *,
    report: bool,
) -> None:
    """Write figures and page; an unexpected error is added to `failures`, as the tables are complete."""
    try:
        figures = figures_of(analysis)
        give_back_freed()
        with ThreadPoolExecutor(1) as pool:
            written = _write_pictures(analysis, folder, figures, pool)
            if report and analysis.tracks is not None:
                give_back_freed()
                page = folder / "report.html"
                write_report(page, analysis, content, figures=figures, options=origin.options)
            for file in written:
                file.result()
    except OSError:  # a full disk ends the run
        raise
    except Exception:
        failures["pictures and report"] = traceback.format_exc()


def run_facts(
    analysis: Analysis, origin: Origin, inputs: Callable[[], Any], budget: Budget
) -> dict[str, Any]:
    """Return the content of run.json without the timings."""
    facts = origin.facts(inputs)
    if analysis.tracks is not None:
        facts |= _video_facts(analysis)
    if analysis.force is not None:
        facts["force"] = ForceMetadata.of(analysis.force)
        facts["sample"] = analysis.settings.sample or PUBLISHED
    if analysis.sticks is not None:
        unflagged = int((analysis.sticks["flag"] == "ok").sum())
        sticks = asdict(StickMetadata.of(analysis.sticks))
        facts["events"] = {"found": len(analysis.sticks), "without_flag": unflagged, **sticks}
    if analysis.clock is not None:
        facts["clock"] = analysis.clock
    facts["systematic_errors"] = budget.to_json()
    parts = (analysis.tracks, analysis.force, analysis.sticks, analysis.motion, analysis.shells)
    # The data of a late stage name the stages before it as well.
    operations = [operations_of(part) for part in parts if part is not None]
    longest = max(operations, key=len, default=[])
    others = [step for steps in operations for step in steps if step not in longest]
    facts["operations"] = [*longest, *others]
    tuning = analysis.settings.tuning
    changed = {one.name: changed_settings(getattr(tuning, one.name)) for one in fields(tuning)}
    facts["tuning"] = {stage: values for stage, values in changed.items() if values}
    facts |= {"warnings": analysis.warnings, "not_measured": analysis.reasons}
    content: dict[str, Any] = origin.worded(facts)
    return content


def _video_facts(analysis: Analysis) -> dict[str, Any]:
    tracks = analysis.tracks
    assert tracks is not None
    recording = asdict(StripMetadata.of(tracks))
    frames = {name: recording.pop(f"frames_{name}") for name in COUNTS}
    corrections = ordered(analysis.settings.corrections)
    names = sheet_names(tracks["side"].values, tracks["n"].values)
    return {
        "found": findings(tracks),
        "recording": {name: value for name, value in recording.items() if name not in ELSEWHERE},
        "frames": frames,
        "positions": FlagCounts(tracks),
        "noise": noise_figures(tracks, analysis.pixel_size_um),
        "doubtful_stretches": doubtful_stretches(tracks).astype(object).to_dict("records"),
        "missing_stretches": missing_stretches(tracks).astype(object).to_dict("records"),
        "corrections": [
            asdict(one) | {"text": text}
            for one, text in zip(corrections, decision_texts(corrections, names), strict=True)
        ],
    }


def _tables_of(analysis: Analysis) -> dict[str, pd.DataFrame]:
    """Return the tables that an analysis has, but that of all positions, by their names in a run folder."""
    tracks, motion = analysis.tracks, analysis.motion
    how: dict[str, Any] = {"threshold": analysis.threshold, "settings": analysis.settings.tuning.shells}
    tables = {
        "sheets": None if tracks is None else sheets_table(tracks),
        "events": analysis.sticks,
        "deformation": None if motion is None else deformation_table(motion, **how),
        "shells": analysis.shells,
    }
    return {name: table for name, table in tables.items() if table is not None}


def _write_tables(analysis: Analysis, folder: Path, origin: Origin) -> None:
    if analysis.tracks is not None:
        write_tracks_nc(analysis.tracks, folder / "tracks.nc", pixel_size_um=analysis.pixel_size_um)
    for name, table in _tables_of(analysis).items():
        write_csv(table, folder / f"{name}.csv", digits=None if name == "sheets" else 9)
    if analysis.fits is not None:
        write_json(origin.worded(analysis.fits.to_json()), folder / "models.json")
    elif "fits" in analysis.reasons:
        write_json(origin.worded({"reason": analysis.reasons["fits"]}), folder / "models.json")
    if analysis.clock is not None:
        write_json(origin.worded(analysis.clock), folder / "clock.json")


@contextmanager
def _largest_meanwhile(analysis: Analysis, folder: Path) -> Iterator[None]:
    """Write tracks.csv and kymograph.tif, the largest files, in a thread while the others are written."""
    if analysis.tracks is None or analysis.strip is None:
        yield
        return
    size, stop = analysis.pixel_size_um, threading.Event()
    with ThreadPoolExecutor(1) as pool:
        to: dict[str, Any] = {"pixel_size_um": size, "stop": stop}
        text = pool.submit(write_tracks_csv, analysis.tracks, folder / "tracks.csv", **to)
        picture = pool.submit(write_kymograph_tif, analysis.strip, folder / "kymograph.tif", **to)
        try:
            yield
            text.result()
            picture.result()
        finally:
            stop.set()  # Ctrl-C does not wait for complete files


def _write_pictures(
    analysis: Analysis, folder: Path, figures: Sequence[Figure], pool: Executor
) -> list[Future[Any]]:
    """Write figures.npz, overview.png and kymograph.png (without a video force.png); return what to wait for.
    Pictures are drawn here, and compressed in the thread of `pool` while others are drawn: in half the
    time."""
    from vision.figures import drawing  # loads matplotlib

    stored = [*figures, *figures_of(analysis, not_in_report())]
    written: list[Future[Any]] = [pool.submit(save_figures, folder / "figures.npz", stored)]
    if analysis.tracks is None:
        pictures = {"force.png": FIGURES["force_overview"].make(analysis)}
    else:
        # the larger one last, so that it is not still held to be compressed while the other is drawn
        pictures = {"kymograph.png": kymograph(figures), "overview.png": overview(figures)}
    for file, figure in pictures.items():
        if figure is not None:
            written.append(pool.submit(drawing.write_png, drawing.render(figure), folder / file))
            give_back_freed()
    return written
