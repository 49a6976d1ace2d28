"""Which figures a run has, in the order in which they are read, and what it has none of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from vision.report import force_charts, sheet_charts, shell_charts
from vision.report.chart import Chart
from vision.report.results import RunResults


@dataclass(frozen=True)
class Section:
    """A heading and its figures."""

    title: str
    charts: tuple[Chart, ...]


def sections_of(results: RunResults) -> list[Section]:
    """All sections that have at least one figure."""
    parts = {
        "What the camera saw": _pictures,
        "The sheets' positions": _positions,
        "Can the positions be trusted?": _trust,
        "The pull": _pull,
        "The two clocks": _clocks,
        "Stick phases": _sticks,
        "Deformation and the stiff shell": _deformation,
    }
    sections = [Section(title, tuple(charts(results))) for title, charts in parts.items()]
    return [section for section in sections if section.charts]


def charts_of(sections: Sequence[Section]) -> list[Chart]:
    """All figures, in the order of reading."""
    return [chart for section in sections for chart in section.charts]


def _pictures(r: RunResults) -> Iterator[Chart]:
    if r.frame is not None:
        yield sheet_charts.frame_chart(r.frame, r.tracks)
    yield sheet_charts.space_time_chart(r.profile, r.tracks, pixel_size_um=r.pixel_size_um)


def _positions(r: RunResults) -> Iterator[Chart]:
    yield sheet_charts.displacement_chart(r.tracks, pixel_size_um=r.pixel_size_um)


def _trust(r: RunResults) -> Iterator[Chart]:
    yield sheet_charts.noise_chart(r.tracks, pixel_size_um=r.pixel_size_um)
    yield sheet_charts.locking_chart(r.tracks)


def _pull(r: RunResults) -> Iterator[Chart]:
    if r.force is not None:
        yield force_charts.pull_chart(r.force, r.sticks, r.fits)


def _clocks(r: RunResults) -> Iterator[Chart]:
    if r.force is not None and r.clock is not None:
        yield force_charts.clock_chart(r.force, r.tracks, r.clock, r.sticks, pixel_size_um=r.pixel_size_um)


def _sticks(r: RunResults) -> Iterator[Chart]:
    if r.force is None or r.sticks is None or not r.sticks["d_v_mm"].notna().any():
        return
    yield force_charts.sticks_chart(r.force, r.sticks)
    unit = force_charts.load_unit(r.force)
    yield force_charts.drops_chart(r.sticks, r.fits, unit=unit)
    yield force_charts.stiffness_chart(r.sticks, r.fits, unit=unit)


def _deformation(r: RunResults) -> Iterator[Chart]:
    if r.motion is not None and r.clock is not None and r.motion.sizes["event"]:
        yield shell_charts.stick_chart(r.tracks, r.motion, r.clock)
        yield shell_charts.ratio_chart(r.motion, threshold=r.threshold)
    if r.shells is not None and r.shells["stiff_sheets"].notna().any():
        yield shell_charts.shells_chart(r.shells, r.fits)


def missing_parts(results: RunResults) -> list[str]:
    """What the report cannot show and why, one plain sentence each."""
    r = results
    lines = []
    if r.pixel_size_um is None:
        lines.append("Lengths in µm: no pixel size was given (--pixel-size).")
    if r.frame is None:
        lines.append("A picture of one frame: none was kept.")
    if r.force is None:
        lines.append("Stick phases, clocks, deformation and shells: no force recording was given (--force).")
        return [*lines, *r.notes]
    if r.sticks is None or not len(r.sticks):
        lines.append("Stick phases: none were found in the force recording.")
    elif not r.sticks["d_v_mm"].notna().any():
        lines.append("Stick lengths and stiffness: the separation is not known (--speed, --d0).")
    if r.fits is None:
        lines.append("Model curves: the models were not fitted.")
    lines += _missing_motion(r)
    return [*lines, *r.notes]


def _missing_motion(r: RunResults) -> list[str]:
    if r.clock is None:
        return ["Deformation and shells: the clocks of camera and testing machine were not matched."]
    if r.clock.status == "ambiguous":
        return [
            "Deformation and shells: the clocks are ambiguous, so no stick phase can be placed in the video "
            "(--offset)."
        ]
    if r.motion is None or not r.motion.sizes["event"]:
        return ["Deformation and shells: no stick phase was measured inside the video."]
    if r.shells is None or not r.shells["stiff_sheets"].notna().any():
        return ["Size of the stiff shell: too few sheets have a known deformation."]
    return []
