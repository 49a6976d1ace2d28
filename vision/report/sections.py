"""Which figures a run has, in the order in which they are read, and what it has none of."""

from __future__ import annotations

from dataclasses import dataclass

from vision.report.chart import Chart
from vision.report.results import RunResults
from vision.report.sheet_charts import (
    displacement_chart,
    frame_chart,
    locking_chart,
    noise_chart,
    space_time_chart,
)


@dataclass(frozen=True)
class Section:
    """A heading and its figures."""

    title: str
    charts: tuple[Chart, ...]


def sections_of(results: RunResults) -> list[Section]:
    """All sections that have at least one figure."""
    tracks, size = results.tracks, results.pixel_size_um
    seen = () if results.frame is None else (frame_chart(results.frame, tracks),)
    sections = [
        Section(
            "What the camera saw", (*seen, space_time_chart(results.profile, tracks, pixel_size_um=size))
        ),
        Section("The sheets' positions", (displacement_chart(tracks, pixel_size_um=size),)),
        Section(
            "Can the positions be trusted?", (noise_chart(tracks, pixel_size_um=size), locking_chart(tracks))
        ),
    ]
    return [section for section in sections if section.charts]


def missing_parts(results: RunResults) -> list[str]:
    """What the report cannot show and why, one plain sentence each."""
    return list(results.notes)
