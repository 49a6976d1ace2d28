"""The answer at the top of the page: what was found, and what to be careful about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.report.results import RunResults
from vision.run.summary import flag_counts, noise_figures, warnings_that_matter


@dataclass(frozen=True)
class Answer:
    """One box at the top. doubt: whether it must not be taken at face value."""

    what: str
    value: str
    detail: str
    doubt: bool = False


def answers(results: RunResults) -> list[Answer]:
    """The boxes, most important first."""
    return [_sheets(results), _noise(results), _frames(results)]


def subtitle(results: RunResults) -> str:
    """What was recorded, in one line."""
    profile = results.profile
    time = np.asarray(profile["time_s"].values, np.float64)
    known = time[np.isfinite(time)]
    span = f" over {known[-1] - known[0]:.4g} s" if known.size > 1 else ""
    scale = "no pixel size given" if results.pixel_size_um is None else f"{results.pixel_size_um:g} µm per px"
    return f"{profile.sizes['frame']} frames{span}, {profile.sizes['x']} columns, {scale}"


def warnings_of(results: RunResults) -> list[str]:
    """Every warning that matters, each once."""
    given = [str(line) for line in results.facts.get("warnings", ())]
    found = warnings_that_matter(results.profile, results.tracks)
    return list(dict.fromkeys([*given, *found]))


def _sheets(results: RunResults) -> Answer:
    tracks = results.tracks
    side, flags = tracks["side"].values, flag_counts(tracks)
    total = max(1, sum(flags.values()))
    ok = flags.get("ok", 0) / total
    return Answer(
        "sheets tracked",
        f"{side.size} ({(side < 0).sum()} left, {(side > 0).sum()} right)",
        f"{percent(ok)} of all positions measured; {tracks.attrs['ridges']} ridges",
        doubt=ok < 0.99,
    )


def _noise(results: RunResults) -> Answer:
    figures = noise_figures(results.tracks, results.pixel_size_um)
    length = "" if results.pixel_size_um is None else f" = {figures['measured_um']:.3g} µm"
    return Answer(
        "noise of a position",
        f"{figures['measured_px']:.2g} px{length}",
        f"median of the sheets, as measured; {figures['predicted_px']:.2g} px expected from the picture",
        doubt=bool(figures["measured_px"] > 3 * figures["predicted_px"]),
    )


def _frames(results: RunResults) -> Answer:
    a = results.profile.attrs
    bad = {name: int(a[f"frames_{name}"]) for name in ("lost", "blank", "corrupt")}
    told = (
        ", ".join(f"{count} {name}" for name, count in bad.items() if count) or "none lost, blank or corrupt"
    )
    return Answer(
        "frames", f"{a['frames_read']} of {a['frames_expected']} read", told, doubt=any(bad.values())
    )


def percent(share: float) -> str:
    """A share as a percentage that does not round 99.96 up to 100."""
    return f"{np.floor(1000 * share) / 10:g} %"
