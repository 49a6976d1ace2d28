"""Damaged run folders through the commands that read them: exit status 0, 1 or 2, and soon."""

import contextlib
import io
import json
import os
import shutil
import traceback
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from tests.fuzz.cases import SECONDS, Failure, HangError, alarm
from tests.fuzz.mutations import mutated
from tests.scenes.comb_video import frames_of, write_video
from tests.scenes.comb_video import positions as truth
from tests.scenes.comparison import events, write_run
from vision.command.console import attempt
from vision.command.main import run as track
from vision.command.settings import settings_of_run
from vision.review.session import Session
from vision.run import reading

COMMANDS = {
    "export csv": (["export", "run", "--to", "csv"], 3),
    "export xlsx": (["export", "run", "--to", "xlsx"], 1),
    "export parquet": (["export", "run", "--to", "parquet"], 1),
    "export mat": (["export", "run", "--to", "mat"], 2),
    "export trackpy": (["export", "run", "--to", "trackpy"], 1),
    "figures": (["figures", "run", "--to", "csv"], 3),
    "kymograph": (["kymograph", "run", "--sheet", "right:2", "--width", "30px"], 2),
    "compare": (["compare", "run"], 3),
    "review": (["review", "run"], 3),
    "again": (["run", "--threshold", "0.2", "--no-report", "--out", "again"], 2),
}
TABLES = ("events.csv", "deformation.csv", "shells.csv")
READ = {
    "export": ("run.json", "tracks.nc", *TABLES, "models.json", "clock.json"),
    "figures": ("run.json", "tracks.nc", "figures.npz"),
    "kymograph": ("run.json", "tracks.nc", "kymograph.tif", "clock.json", "events.csv"),
    "compare": ("run.json", *TABLES, "models.json"),
    "review": ("run.json", "tracks.nc", "kymograph.tif", *TABLES, "clock.json"),
    "again": ("run.json", "tracks.nc", "kymograph.tif", "clock.json"),
}
KIND = {".json": "json", ".csv": "text", ".nc": "hdf5", ".tif": "tiff", ".npz": "npz"}
PROCESS_SHARE = 0.02
"""Of the cases that damage tracks.nc, which a process of its own tries first: that takes a second each."""
VALUES = (
    None,
    "",
    "x",
    "=1+1",
    0,
    -1,
    3.5,
    1e308,
    1 << 70,
    True,
    [],
    {},
    [[]],
    {"value": None},
    "nan",
    "9" * 400,
)


def write_seed(place: Path) -> Path:
    """A run folder with every file that a run with a force recording has, quickly made."""
    film = write_video(place / "film.tif", frames_of(truth(frames=40)))
    words = [str(film), "--no-report", "--quiet", "--pixel-size", "10", "--fps", "25"]
    assert track([*words, "--out", str(place / "run")]) == 0
    forced = write_run(place / "force", events(step=0.1, d=(13.2, 15.0)))
    facts = json.loads((place / "run" / "run.json").read_text()) | json.loads(
        (forced / "run.json").read_text()
    )
    (place / "run" / "run.json").write_text(json.dumps(facts))
    for name in ("events.csv", "models.json"):
        shutil.copy(forced / name, place / "run" / name)
    clock = {"offset_s": -10.0, "drift_ppm": 0.0, "residual_ms": 1.0, "matched": 5, "status": "ok"}
    clock |= {"unmatched_video": 0, "unmatched_force": 0, "margin": 40.0, "how": "events"}
    (place / "run" / "clock.json").write_text(json.dumps(clock))
    cells = [(event, sheet) for event in range(5) for sheet in range(8)]
    table = pd.DataFrame(cells, columns=["event", "index"])
    side = np.where(table["index"] < 4, -1, 1)
    table = table.assign(
        side=side, n=1, sigma_x_um=1.0, ratio=0.1, ratio_err=0.01, p_stiff=0.5, shell="stiff"
    )
    table.to_csv(place / "run" / "deformation.csv", index=False)
    shells = pd.DataFrame({"event": range(5), "d_v_mm": 13.0, "side": 1, "stiff_sheets": 2})
    shells = shells.assign(stiff_low=1, stiff_high=3)
    shells.to_csv(place / "run" / "shells.csv", index=False)
    shutil.rmtree(forced)
    return place / "run"


def run_cases(cases: int, seed: int, place: Path) -> Iterator[tuple[int, str, Failure | None]]:
    """(number, command and outcome, failure) of each case; case n of a seed is always the same folder."""
    place.mkdir(parents=True, exist_ok=True)
    whole = write_seed(place)
    here, tried = Path.cwd(), reading.try_out
    os.chdir(place)
    weights = np.array([weight for _, weight in COMMANDS.values()]) / sum(w for _, w in COMMANDS.values())
    try:
        for case in range(cases):
            random = np.random.default_rng([seed, case, 1])
            name = list(COMMANDS)[int(random.choice(len(COMMANDS), p=weights))]
            files = READ[name.split()[0]]
            file = files[int(random.integers(len(files)))]
            if file == "tracks.nc" and random.random() > PROCESS_SHARE * len(files):
                file = "run.json"
            work = place / f"{seed}_{case}"
            folder = Path(shutil.copytree(whole, work / "run"))
            damage(folder / file, random)
            damaged = file == "tracks.nc"  # else no process of its own is needed
            reading.try_out = tried if damaged else lambda *_, **__: None
            os.chdir(work)
            ended = one_case(COMMANDS[name][0])
            os.chdir(place)
            escaped = {p.name for p in place.iterdir()} - {work.name, "run", "film.tif"}
            escaped -= {p.name for p in place.iterdir() if p.name.startswith(f"{seed}_")}
            ended = f"files outside: {escaped}" if escaped else ended
            failure = None
            if ended in ("status 0", "status 1", "status 2"):
                shutil.rmtree(work)
            else:
                failure = Failure(case, folder / file, ended)
            yield case, f"{name} {ended.splitlines()[-1]}", failure
    finally:
        reading.try_out = tried
        os.chdir(here)


def one_case(words: list[str]) -> str:
    """ "status N", or what went wrong."""
    said = io.StringIO()
    try:
        with alarm(SECONDS), contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            if words[0] == "review":
                _, status, why = attempt(lambda: opened(Path(words[1])))
                said.write(f"{why}\n" * bool(why))
            else:
                status = track(words)
    except HangError:
        return f"hang: {traceback.format_exc()}\nhang"
    except BaseException:
        return traceback.format_exc()
    if status == 2 and said.getvalue().count("\n") != 1:
        return f"not one line: {said.getvalue()}"
    return f"status {status}" if status in (0, 1, 2) else said.getvalue() or f"status {status}"


def opened(folder: Path) -> None:
    """The run as `track review` opens it, without the server."""
    with Session(folder, settings_of_run(folder)):
        pass


def damage(file: Path, random: np.random.Generator) -> None:
    """Change a file by its structure, or any of its bytes; remove it now and then."""
    kind = KIND[file.suffix]
    if random.random() < 0.03:
        file.unlink()
    elif kind == "json" and random.random() < 0.8:
        file.write_text(json.dumps(changed(json.loads(file.read_text()), random)))
    elif kind == "npz" and random.random() < 0.8:
        with np.load(file) as held:
            arrays = dict(held)
        listed = changed(json.loads(arrays["figures"].tobytes().decode()), random)
        arrays["figures"] = np.frombuffer(json.dumps(listed).encode(), np.uint8)
        np.savez_compressed(file, **arrays)
    else:
        kind = {"json": "text", "npz": "bytes"}.get(kind, kind)
        file.write_bytes(mutated(file.read_bytes(), kind, random))


def changed(content, random: np.random.Generator):
    """The same JSON with one to three of its values, anywhere, replaced or left out."""
    for _ in range(int(random.integers(1, 4))):
        places = list(_places(content))
        if not places:
            return VALUES[int(random.integers(len(VALUES)))]
        holder, key = places[int(random.integers(len(places)))]
        if random.random() < 0.3:
            del holder[key]
        else:
            holder[key] = VALUES[int(random.integers(len(VALUES)))]
    return content


def _places(content):
    """(holder, key) of every value, at any depth."""
    keys = content if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ()
    for key in keys:
        yield content, key
        yield from _places(content[key])
