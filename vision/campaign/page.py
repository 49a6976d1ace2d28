"""index.html of a campaign: every test's state on one page, rewritten whole while it runs."""

from __future__ import annotations

import base64
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pandas as pd
from jinja2 import Environment, StrictUndefined

from vision.campaign.plan import Plan, PlannedFilm
from vision.campaign.states import FINISHED, State
from vision.run import whole_file
from vision.run.tables import write_table

PAGE = "index.html"
WORDS = ("failed", "partial", "warnings", "running", "waiting", "done")

TEMPLATE = Path(__file__).with_name("index.html.jinja")
SHOWN = {
    "sample": "sample",
    "V_mm_min": "V (mm/min)",
    "n_test": "tests before",
    "RH_percent": "RH (%)",
    "T_C": "T (°C)",
}


def page_age(out: Path) -> float:
    """Seconds since index.html was written; infinite for never."""
    try:
        return time.time() - (out / PAGE).stat().st_mtime
    except OSError:
        return float("inf")


def write_page(plan: Plan, *, live: bool, remarks: tuple[str, ...] = ()) -> list[State]:
    """Write index.html and campaign.csv from the films' states.

    Parameters
    ----------
    plan
        The campaign's.
    live
        Whether the page renews itself.
    remarks
        Lines above the table.

    Returns
    -------
    The states, in the plan's order.

    Raises
    ------
    InputError
        Where they cannot be written.
    """
    states = [plan.state(film) for film in plan.films]
    counts = Counter(str(state.state) for state in states)
    facts = [name for name in SHOWN if any(name in film.facts for film in plan.films)]
    left = sum(
        film.seconds
        for film, state in zip(plan.films, states, strict=True)
        if state.state in ("waiting", "running")
    )
    text = (
        Environment(autoescape=True, undefined=StrictUndefined)
        .from_string(TEMPLATE.read_text(encoding="utf-8"))
        .render(
            title=plan.out.name,
            live=live,
            refresh=10,  # seconds
            now=time.strftime("%Y-%m-%d %H:%M:%S"),
            ended=len(states) - counts["waiting"] - counts["running"],
            counts=[(word, counts[word]) for word in WORDS if counts[word]],
            left=duration(left) if live and left else "",
            pool=(plan.out / "pool" / "report.html").is_file(),
            remarks=remarks,
            facts=[SHOWN[name] for name in facts],
            films=[_row(plan, film, state, facts) for film, state in zip(plan.films, states, strict=True)],
        )
    )
    with whole_file(plan.out / PAGE) as path:
        path.write_text(text, encoding="utf-8", errors="replace")
    _write_csv(plan, states)
    return states


def _write_csv(plan: Plan, states: Sequence[State]) -> None:
    """campaign.csv: film, state, reason, seconds, run."""
    rows = [
        {
            "film": film.film,
            "state": state.state,
            "reason": state.reason,
            "seconds": round(state.seconds, 3),
            "run": f"runs/{film.name}" if (plan.run_of(film.name) / "run.json").is_file() else "",
        }
        for film, state in zip(plan.films, states, strict=True)
    ]
    with whole_file(plan.out / "campaign.csv") as path:
        write_table(pd.DataFrame(rows, columns=["film", "state", "reason", "seconds", "run"]), path)


def _row(plan: Plan, film: PlannedFilm, state: State, facts: list[str]) -> dict[str, Any]:
    run = plan.run_of(film.name)
    known = state.state in FINISHED and (run / "run.json").is_file()
    page = "report.html" if (run / "report.html").is_file() else "overview.png"
    return {
        "state": state.state,
        "name": film.name,
        "file": Path(film.film).name,
        "link": f"runs/{quote(film.name, safe='')}/{page}" if known else "",
        "picture": _data_uri(plan.out / "thumbnails" / f"{film.name}.png") if known else "",
        "facts": [_shown(film.facts.get(name)) for name in facts],
        "frames": film.frames or "",
        "seconds": f"{state.seconds:.1f}" if state.seconds else "",
        "warnings": state.warnings,
        "reason": state.reason or (film.doubt if state.state == "waiting" else ""),
    }


def _shown(fact: Any) -> str:
    return "" if fact is None else f"{fact:g}" if isinstance(fact, float) else str(fact)


def _data_uri(path: Path) -> str:
    try:
        return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
    except OSError:
        return ""


def duration(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
