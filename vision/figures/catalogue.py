"""Every figure of a run by name, in reading order, and what a run has no figure of."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeGuard

import numpy as np
import pandas as pd
import xarray as xr

from vision.clock import Clock, video_slips
from vision.data import TrackMetadata
from vision.errors import InputError
from vision.figures import deformation, force, publication, video
from vision.figures.figure import Figure
from vision.figures.labels import load_unit
from vision.models import ModelFits
from vision.numeric import Floats, Pixels


class Results(Protocol):
    """What figures and the report are made from; parts that a run does not have are None.

    `vision.analyse` returns such an object.
    """

    @property
    def strip(self) -> xr.DataArray | None:
        """I(x, t), from `strip_profile`."""
        ...

    @property
    def tracks(self) -> xr.Dataset | None:
        """x(n, t), from `track_sheets`."""
        ...

    @property
    def frame(self) -> Pixels | None:
        """One whole frame (rows, columns), any depth."""
        ...

    @property
    def force(self) -> xr.Dataset | None:
        """The force recording, from `read_force`."""
        ...

    @property
    def sticks(self) -> pd.DataFrame | None:
        """Stick-slip events, from `find_stick_slip`."""
        ...

    @property
    def fits(self) -> ModelFits | None:
        """The models, from `fit_models`."""
        ...

    @property
    def clock(self) -> Clock | None:
        """From `synchronise`."""
        ...

    @property
    def motion(self) -> xr.Dataset | None:
        """Deformation of every sheet in every stick phase, from `horizontal_deformation`."""
        ...

    @property
    def shells(self) -> pd.DataFrame | None:
        """One row per event and side, from `classify_shells`."""
        ...

    @property
    def threshold(self) -> float:
        """σ_x over stick length below which a sheet counts as stiff."""
        ...

    @property
    def pixel_size_um(self) -> float | None:
        """µm per pixel; without it lengths are in px."""
        ...

    @property
    def reasons(self) -> Mapping[str, str]:
        """Why a part is None, by its name above."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """What the reader must know."""
        ...


@dataclass(frozen=True)
class CatalogueEntry:
    """How one figure is made.

    Parameters
    ----------
    section
        Heading of the report under which it stands; "" for figures that the report does not show, because
        their panels are figures of their own there.
    build
        The figure of these results; None where they lack what it shows.
    paper
        Number of the publication's figure that it corresponds to, "" for none.
    """

    section: str
    build: Callable[[Results], Figure | None]
    paper: str = ""

    def make(self, results: Results) -> Figure | None:
        """The figure, with the publication's number in its caption; None where the results lack its data."""
        figure = self.build(results)
        if figure is None or not self.paper:
            return figure
        return replace(figure, caption=f"{figure.caption} Compare figure {self.paper} of the publication.")


def figures_of(results: Results) -> list[Figure]:
    """All figures that these results allow, in reading order.

    Those that only put others together, "overview", "kymograph" and "force_overview", are left out.
    """
    made = (entry.make(results) for entry in FIGURES.values() if entry.section)
    return [figure for figure in made if figure is not None]


def publication_figures_of(results: Results) -> list[Figure]:
    """The publication's figures that are not among `figures_of`: no part of the report, drawn by name."""
    entries = [entry for entry in FIGURES.values() if entry.paper and not entry.section]
    made = (entry.make(results) for entry in entries)
    return [figure for figure in made if figure is not None]


def sections_of(figures: Iterable[Figure]) -> list[tuple[str, list[Figure]]]:
    """Headings with their figures, in reading order."""
    sections: dict[str, list[Figure]] = {}
    for figure in figures:
        if section := FIGURES[figure.name].section:
            sections.setdefault(section, []).append(figure)
    return list(sections.items())


def overview(figures: Iterable[Figure]) -> Figure | None:
    """One page to judge a run by: frame, space-time diagram and displacements, of these figures."""
    named = {figure.name: figure.panel for figure in figures}
    aspects = {"frame": None, "space_time": 0.45, "tracks": 0.33}
    panels = tuple(
        named[name] if aspect is None else replace(named[name], aspect=aspect)
        for name, aspect in aspects.items()
        if name in named
    )
    if not panels:
        return None
    return Figure(
        name="overview",
        title="Overview",
        caption=(
            "One frame with the averaged rows and the numbered sheets; intensity I(x,t) of these rows with "
            "the positions x(n,t); each sheet's position less its median (left blue and dashed, right "
            "orange)."
        ),
        panels=panels,
        width_in=13.0,
    )


def kymograph(figures: Iterable[Figure]) -> Figure | None:
    """The space-time diagram of the whole strip without the tracks, of these figures."""
    for figure in figures:
        if figure.name == "space_time" and (image := figure.panel.image) is not None:
            panel = replace(
                figure.panel,
                series=(),
                y_range=(image.left, image.right),
                title="Space-time diagram of the strip",
                aspect=0.55,
            )
            return Figure(
                name="kymograph",
                title=panel.title,
                caption=video.KYMOGRAPH_CAPTION,
                panels=(panel,),
                width_in=13.0,
            )
    return None


def _frame(r: Results) -> Figure | None:
    return None if r.frame is None or r.tracks is None else video.frame_figure(r.frame, r.tracks)


def _space_time(r: Results) -> Figure | None:
    if r.strip is None or r.tracks is None:
        return None
    slips_s, slips_from = slip_times(r)
    return video.space_time_figure(
        r.strip, r.tracks, pixel_size_um=r.pixel_size_um, slips_s=slips_s, slips_from=slips_from
    )


def slip_times(r: Results) -> tuple[Floats | None, str]:
    """Times of the slips on the camera's clock, s, and what they are from.

    Those of the force where its clock is sure, else the common outward steps of the sheets; None where
    neither is known: with an axis that was only guessed from the sheets' places, outward is not known.
    """
    if r.sticks is not None and len(r.sticks) and r.clock is not None and r.clock.status != "ambiguous":
        return np.sort(r.clock.to_video_s(r.sticks["t_p_s"].to_numpy(float))), "the force"
    if r.tracks is None:
        return None, ""
    found = TrackMetadata.of(r.tracks)
    if found.axis_how == "geometry" and math.isnan(found.axis_low_px):
        return None, ""
    try:
        return video_slips(r.tracks)["time_s"].to_numpy(float), "the sheets' common steps"
    except InputError:  # too few frames, or none with a time: nothing to mark
        return None, ""


def _tracks(r: Results) -> Figure | None:
    return None if r.tracks is None else video.tracks_figure(r.tracks, pixel_size_um=r.pixel_size_um)


def _outer_inner(r: Results) -> Figure | None:
    return None if r.tracks is None else video.outer_inner_figure(r.tracks, pixel_size_um=r.pixel_size_um)


def _noise(r: Results) -> Figure | None:
    return None if r.tracks is None else video.noise_figure(r.tracks, pixel_size_um=r.pixel_size_um)


def _pixel_locking(r: Results) -> Figure | None:
    return None if r.tracks is None else video.pixel_locking_figure(r.tracks)


def _force(r: Results) -> Figure | None:
    return None if r.force is None else force.force_figure(r.force, r.sticks, r.fits)


def _clocks(r: Results) -> Figure | None:
    if r.force is None or r.tracks is None or r.clock is None:
        return None
    return force.clocks_figure(r.force, r.tracks, r.clock, r.sticks, pixel_size_um=r.pixel_size_um)


def _clock_residuals(r: Results) -> Figure | None:
    if r.force is None or r.tracks is None or r.clock is None or r.sticks is None:
        return None
    return force.clock_residuals_figure(r.force, r.tracks, r.clock, r.sticks)


def _sticks(r: Results) -> Figure | None:
    return None if r.force is None or not _separated(r.sticks) else force.sticks_figure(r.force, r.sticks)


def _force_drop(r: Results) -> Figure | None:
    if r.force is None or not _separated(r.sticks):
        return None
    return force.force_drop_figure(r.sticks, r.fits, unit=load_unit(r.force))


def _stiffness(r: Results) -> Figure | None:
    if r.force is None or not _separated(r.sticks):
        return None
    return force.stiffness_figure(r.sticks, r.fits, unit=load_unit(r.force))


def _stiffness_residuals(r: Results) -> Figure | None:
    if r.force is None or r.fits is None or not _separated(r.sticks):
        return None
    return force.stiffness_residuals_figure(r.sticks, r.fits, unit=load_unit(r.force))


def _stick(r: Results) -> Figure | None:
    if r.tracks is None or r.clock is None or r.motion is None or not r.motion.sizes["event"]:
        return None
    return deformation.stick_figure(r.tracks, r.motion, r.clock)


def _deformation(r: Results) -> Figure | None:
    if r.motion is None or not r.motion.sizes["event"]:
        return None
    return deformation.deformation_figure(r.motion, threshold=r.threshold)


def _shells(r: Results) -> Figure | None:
    if r.shells is None or not r.shells["stiff_sheets"].notna().any():
        return None
    return deformation.shells_figure(r.shells, r.fits)


def _force_insets(r: Results) -> Figure | None:
    if r.force is None or not _separated(r.sticks):
        return None
    return publication.force_insets_figure(r.force, r.sticks, r.fits)


def _single_sheets(r: Results) -> Figure | None:
    slips_s, slips_from = slip_times(r)
    if r.strip is None or r.tracks is None or slips_s is None:
        return None
    return publication.single_sheets_figure(
        r.strip, r.tracks, slips_s, pixel_size_um=r.pixel_size_um, slips_from=slips_from
    )


def _mean_deformation(r: Results) -> Figure | None:
    if r.motion is None or not r.motion.sizes["event"]:
        return None
    return publication.mean_deformation_figure(r.motion, threshold=r.threshold)


def _intensity(r: Results) -> Figure | None:
    if r.strip is None or r.tracks is None:
        return None
    return publication.intensity_figure(r.strip, r.tracks, slip_times(r)[0])


def _overview(r: Results) -> Figure | None:
    return overview(figure for make in (_frame, _space_time, _tracks) if (figure := make(r)) is not None)


def _kymograph(r: Results) -> Figure | None:
    if r.strip is None:
        return None
    return video.kymograph_figure([r.strip], pixel_size_um=r.pixel_size_um)


def _force_overview(r: Results) -> Figure | None:
    if r.force is None or r.sticks is None:
        return None
    return force.force_overview_figure(r.force, r.sticks, r.fits)


def _separated(sticks: pd.DataFrame | None) -> TypeGuard[pd.DataFrame]:
    """Whether there are events with a known separation."""
    return sticks is not None and bool(sticks["d_v_mm"].notna().any())


FIGURES: Mapping[str, CatalogueEntry] = {
    "frame": CatalogueEntry("What the camera saw", _frame, "7a"),
    "space_time": CatalogueEntry("What the camera saw", _space_time),
    "tracks": CatalogueEntry("Positions of the sheets", _tracks),
    "outer_inner": CatalogueEntry("Positions of the sheets", _outer_inner),
    "noise": CatalogueEntry("Can the positions be trusted?", _noise),
    "pixel_locking": CatalogueEntry("Can the positions be trusted?", _pixel_locking),
    "force": CatalogueEntry("Traction force", _force, "2"),
    "clocks": CatalogueEntry("The two clocks", _clocks),
    "clock_residuals": CatalogueEntry("The two clocks", _clock_residuals),
    "sticks": CatalogueEntry("Stick phases", _sticks, "4"),
    "force_drop": CatalogueEntry("Stick phases", _force_drop, "5"),
    "stiffness": CatalogueEntry("Stick phases", _stiffness, "6"),
    "stiffness_residuals": CatalogueEntry("Stick phases", _stiffness_residuals),
    "stick": CatalogueEntry("Deformation and the stiff shell", _stick, "7d"),
    "deformation": CatalogueEntry("Deformation and the stiff shell", _deformation, "8"),
    "shells": CatalogueEntry("Deformation and the stiff shell", _shells),
    "force_insets": CatalogueEntry("", _force_insets, "2"),
    "single_sheets": CatalogueEntry("", _single_sheets, "7b and c"),
    "mean_deformation": CatalogueEntry("", _mean_deformation, "8"),
    "intensity": CatalogueEntry("", _intensity, "12"),
    "overview": CatalogueEntry("", _overview),
    "kymograph": CatalogueEntry("", _kymograph),
    "force_overview": CatalogueEntry("", _force_overview),
}
"""Figures by name, in reading order."""


def missing_parts(results: Results) -> list[str]:
    """What cannot be shown and why, one sentence each; arguments stand in backticks."""
    r = results
    return list(_missing_from_video(r)) + list(_missing_from_force(r))


def _missing_from_video(r: Results) -> Iterator[str]:
    if r.tracks is None:
        yield f"Positions: {r.reasons.get('tracks', 'no video was given.')}"
        return
    if r.pixel_size_um is None:
        yield "Lengths in µm: no pixel size was given (`pixel_size_um`)."
    if r.frame is None:
        yield f"An image of one frame: {r.reasons.get('frame', 'none was kept.')}"


def _missing_from_force(r: Results) -> Iterator[str]:
    if r.force is None:
        default = "no force recording was given (`force`)."
        yield f"Stick phases, clocks, deformation and shells: {r.reasons.get('force', default)}"
        return
    if r.sticks is None or not len(r.sticks):
        yield f"Stick phases: {r.reasons.get('sticks', 'none were found in the force recording.')}"
    elif not _separated(r.sticks):
        yield "Stick lengths and stiffness: the separation is not known (`speed_mm_min`, `d0_mm`)."
    if r.fits is None:
        yield f"Model curves: {r.reasons.get('fits', 'the models were not fitted.')}"
    if r.tracks is None:
        return
    if r.clock is None:
        default = "the clocks of camera and testing machine were not matched."
        yield f"Deformation and shells: {r.reasons.get('clock', default)}"
    elif r.motion is None or not r.motion.sizes["event"]:
        default = (
            "the clocks are ambiguous, so no stick phase can be placed in the video (give `offset_s`)."
            if r.clock.status == "ambiguous"
            else "no stick phase was measured inside the video."
        )
        yield f"Deformation and shells: {r.reasons.get('motion', default)}"
    elif r.shells is None or not np.isfinite(r.shells["stiff_sheets"].astype(float)).any():
        default = "too few sheets have a known deformation."
        yield f"Size of the stiff shell: {r.reasons.get('shells', default)}"
