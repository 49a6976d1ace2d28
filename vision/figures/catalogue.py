"""All figures of a run by name, in reading order, and what is missing in a run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from inspect import signature
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock
from vision.data import STIFF_BELOW, load_unit
from vision.errors import InputError
from vision.figures import camera, force, positions
from vision.figures.figure import Figure
from vision.models import ModelFits
from vision.numeric import Pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, kw_only=True, repr=False)
class Results:
    """Results of one test, from which figures and the report are made. Parts that it lacks are None."""

    strip: xr.DataArray | None = None  # I(x, t)
    tracks: xr.Dataset | None = None  # x(n, t)
    frame: Pixels | None = None  # the first that shows something, (rows, columns)
    force: xr.Dataset | None = None  # the force recording
    sticks: pd.DataFrame | None = None  # its stick-slip events
    fits: ModelFits | None = None  # the models fitted to them
    clock: Clock | None = None  # the camera's against the machine's
    motion: xr.Dataset | None = None  # the deformation of each sheet
    shells: pd.DataFrame | None = None  # the stiff shell
    # By part: why it is None although there are the data that it needs.
    reasons: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()  # those that matter, in the order of the stages, without repetition

    def refused(self) -> list[str]:
        """Return the names of stages up to the shells without a result although they had data.

        Ambiguous clocks, without which there are no deformation and shells, are a warning.
        """
        if self.clock is not None and self.clock.status == "ambiguous":
            return []
        return [name for name in ("sticks", "clock", "motion", "shells") if name in self.reasons]

    @property
    def results(self) -> Results:
        """These results, for figures that are made from others."""
        return self

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel; None if it is unknown, and lengths are in px."""
        return None

    @property
    def pixel_size_err_um(self) -> float | None:
        """Its error; None if it is unknown."""
        return None

    @property
    def unit(self) -> str:
        """Unit of the load, "1" for a force over a weight."""
        return "N" if self.force is None else load_unit(self.force)

    @cached_property
    def slips(self) -> camera.SlipTimes:
        """Slips of the force or, without one or a clock, of the sheets."""
        sticks, clock = self.sticks, self.clock
        if sticks is None or not len(sticks) or clock is None or clock.status == "ambiguous":
            return camera.SlipTimes(camera.common_steps_s(self.tracks), "the sheets' common steps")
        return camera.SlipTimes(np.sort(clock.to_video_s(sticks["t_p_s"].to_numpy(float))))

    @property
    def threshold(self) -> float:
        """σ_x/Λ_st below which a sheet is stiff."""
        return STIFF_BELOW


@dataclass(frozen=True)
class CatalogueEntry:
    """How one figure is made."""

    section: str  # heading in the report; "" for figures that the report lacks
    # Makes the figure, or None if there is nothing to show. Its parameters have the names of parts of the
    # results; those without a default are needed.
    build: Callable[..., Figure | None]
    needs: str = ""  # what else the figure needs (see `_has`)
    paper: str = ""  # number of the corresponding figure of the publication

    def make(self, results: Results, **chosen: Any) -> Figure | None:
        """Return the figure, with the publication's number in its caption; None without its data.

        chosen: arguments of `build` that are no part of the results, such as the event of one stick phase.
        """
        parameters = signature(self.build).parameters
        known = {name: one for name, one in parameters.items() if hasattr(results, name)}
        needed = [name for name, one in known.items() if one.default is one.empty]
        if not all(_has(results, part) for part in filter(None, (*needed, self.needs))):
            return None
        if unknown := [name for name in chosen if name not in parameters or name in known]:
            options = ", ".join(name for name in parameters if name not in known) or "none"
            raise InputError("this figure", f"options that it has ({options})", ", ".join(unknown))
        figure = self.build(**{name: getattr(results, name) for name in known}, **chosen)
        if figure is None or not self.paper:
            return figure
        return replace(figure, caption=f"{figure.caption} Compare figure {self.paper} of the publication.")


def figures_of(results: Results, names: Iterable[str] | None = None) -> list[Figure]:
    """Return the figures of these names, by default those of the report, for which there are data."""
    chosen = [name for name, entry in FIGURES.items() if entry.section] if names is None else names
    return [figure for name in chosen if (figure := FIGURES[name].make(results)) is not None]


def not_in_report() -> list[str]:
    """Return the names of figures that correspond to the publication's but are not in the report."""
    return [name for name, entry in FIGURES.items() if entry.paper and not entry.section]


def sections_of(figures: Iterable[Figure]) -> list[tuple[str, list[Figure]]]:
    """Return headings with their figures, in reading order."""
    sections: dict[str, list[Figure]] = {}
    for figure in figures:
        if section := FIGURES[figure.name].section:
            sections.setdefault(section, []).append(figure)
    return list(sections.items())


OVERVIEW = {"frame": None, "space_time": 0.45, "tracks": 0.33}  # its panels; height over width, None: its own


def overview(figures: Iterable[Figure]) -> Figure | None:
    """Return a figure of frame, space-time diagram and displacements, taken from these figures."""
    named = {figure.name: figure.panel for figure in figures}
    panels = tuple(
        named[name] if aspect is None else replace(named[name], aspect=aspect)
        for name, aspect in OVERVIEW.items()
        if name in named
    )
    if not panels:
        return None
    return Figure(
        name="overview",
        title="Overview",
        caption=(
            "One frame with the averaged rows and the numbered sheets; intensity I(x,t) of these rows with "
            "the positions x(n,t); each sheet's position less x₀, its median over the frames that the title "
            "names (left blue and dashed, right orange)."
        ),
        panels=panels,
        width_in=camera.page_width_in(named["frame"]) if "frame" in named else 13.0,
    )


def kymograph(figures: Iterable[Figure]) -> Figure | None:
    """Return the space-time diagram of the whole strip without tracks, taken from these figures."""
    panel = next((figure.panel for figure in figures if figure.name == "space_time"), None)
    if panel is None or panel.image is None:
        return None
    whole = (panel.image.left, panel.image.right)
    title = "Space-time diagram of the strip"
    panel = replace(panel, series=(), y_range=whole, title=title, aspect=0.55)
    return panel.figure("kymograph", camera.KYMOGRAPH_CAPTION, width_in=13.0, panel_titles=True)


def _has(r: Results, part: str) -> bool:
    """Tell whether the results have this part and it is not empty; "separation": events with known d."""
    if part == "separation":
        return r.sticks is not None and bool(r.sticks["d_v_mm"].notna().any())
    if part == "events":
        return r.sticks is not None and len(r.sticks) > 0
    if part == "motion":
        return r.motion is not None and r.motion.sizes["event"] > 0
    if part == "shells":
        return r.shells is not None and bool(r.shells["stiff_sheets"].notna().any())
    return getattr(r, part) is not None


_CAMERA = "What the camera saw"
_POSITIONS = "Positions of the sheets"
_TRUST = "Can the positions be trusted?"
_CLOCKS = "The two clocks"
_STICKS = "Stick phases"
_SHELL = "Deformation and the stiff shell"
FIGURES: Mapping[str, CatalogueEntry] = {
    "frame": CatalogueEntry(_CAMERA, camera.frame_figure, paper="7a"),
    "space_time": CatalogueEntry(_CAMERA, camera.space_time_figure),
    "tracks": CatalogueEntry(_POSITIONS, positions.tracks_figure),
    "outer_inner": CatalogueEntry(_POSITIONS, positions.outer_inner_figure),
    "noise": CatalogueEntry(_TRUST, positions.noise_figure),
    "pixel_locking": CatalogueEntry(_TRUST, positions.pixel_locking_figure),
    "force": CatalogueEntry("Traction force", force.force_figure, paper="2"),
    "clocks": CatalogueEntry(_CLOCKS, force.clocks_figure),
    "clock_residuals": CatalogueEntry(_CLOCKS, force.clock_residuals_figure),
    "sticks": CatalogueEntry(_STICKS, force.sticks_figure, "separation", paper="4"),
    "force_drop": CatalogueEntry(_STICKS, force.force_drop_figure, "events", paper="5"),
    "stiffness": CatalogueEntry(_STICKS, force.stiffness_figure, "separation", paper="6"),
    "stiffness_residuals": CatalogueEntry(_STICKS, force.stiffness_residuals_figure, "separation"),
    "stick": CatalogueEntry(_SHELL, positions.stick_figure, paper="7d"),
    "deformation": CatalogueEntry(_SHELL, positions.deformation_figure, paper="8"),
    "shells": CatalogueEntry(_SHELL, positions.shells_figure),
    "force_insets": CatalogueEntry("", force.force_insets_figure, "separation", paper="2"),
    "single_sheets": CatalogueEntry("", camera.single_sheets_figure, paper="7b and c"),
    "mean_deformation": CatalogueEntry("", positions.mean_deformation_figure, paper="8"),
    "intensity": CatalogueEntry("", camera.intensity_figure, paper="12"),
    "overview": CatalogueEntry("", lambda results: overview(figures_of(results, OVERVIEW))),
    "kymograph": CatalogueEntry("", lambda results: kymograph(figures_of(results, ["space_time"]))),
    "force_overview": CatalogueEntry("", force.force_overview_figure),
}
"""Figures by name, in reading order."""


def missing_parts(results: Results) -> list[str]:
    """Return what cannot be shown and why, one sentence each, with arguments in backticks."""
    return [*_missing_from_video(results), *_missing_from_force(results)]


def _missing_from_video(r: Results) -> Iterator[str]:
    if r.tracks is None:
        yield f"Positions: {r.reasons.get('tracks', 'no video was given.')}"
        return
    if r.pixel_size_um is None:
        yield "Lengths in µm: no pixel size was given (`pixel_size_um`)."
    if r.frame is None:
        yield f"An image of one frame: {r.reasons.get('frame', 'none was stored.')}"


def _missing_from_force(r: Results) -> Iterator[str]:
    if r.force is None:
        default = "no force recording was given (`force`)."
        yield f"Stick phases, clocks, deformation and shells: {r.reasons.get('force', default)}"
        return
    if r.sticks is None or not len(r.sticks):
        yield f"Stick phases: {r.reasons.get('sticks', 'none were found in the force recording.')}"
    elif not _has(r, "separation"):
        yield "Stick lengths and stiffness: the separation is not known (`speed_mm_min`, `d0_mm`)."
    if r.fits is None:
        yield f"Model curves: {r.reasons.get('fits', 'the models were not fitted.')}"
    if r.tracks is None:
        return
    if r.clock is None:
        default = "the clocks of camera and testing machine were not matched."
        yield f"Deformation and shells: {r.reasons.get('clock', default)}"
    elif not _has(r, "motion"):
        reason = r.reasons.get("motion", "no stick phase was measured in the video.")
        if r.clock.status == "ambiguous":
            reason = "the time of stick phases in the video is unknown, as the clocks are ambiguous."
        yield f"Deformation and shells: {reason}"
    elif not _has(r, "shells"):
        default = "too few sheets have a known deformation."
        yield f"Size of the stiff shell: {r.reasons.get('shells', default)}"


class Plots:
    """Functions that draw the figures of some results: ``plot.NAME(ax=None)``.

    Some take more: ``plot.stick(event=37)``, ``plot.deformation(events=[37, 60])``. Several tests on the same
    axes: ``plot.NAME(ax, label="test 2", color="C3")``.
    """

    def __init__(self, results: Results) -> None:
        self._results = results

    def __getattr__(self, name: str) -> Callable[..., Axes]:
        if name not in FIGURES:
            raise AttributeError(f"no figure '{name}'; there are {', '.join(FIGURES)}")

        def draw(ax: Axes | None = None, *, label: str = "", color: str | None = None, **chosen: Any) -> Axes:
            return figure_named(self._results, name, **chosen).plot(ax, label=label, color=color)

        return draw

    def __dir__(self) -> list[str]:
        return list(FIGURES)

    def __repr__(self) -> str:
        return f"plot.NAME(ax=None) with a NAME of {', '.join(FIGURES)}"


def figure_named(results: Results, name: str, **chosen: Any) -> Figure:
    """Return a figure by its name.

    chosen: its options, see `CatalogueEntry.make`.  Raises: InputError if the results lack its data.
    """
    figure = FIGURES[name].make(results, **chosen)
    if figure is None:
        reasons = "; ".join(results.reasons.values())
        raise InputError(f"the figure {name}", "an analysis that has its data", reasons or "one without")
    return figure
