"""The results of a run in words: the lines of the summary, of which the report has some at its top."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.checks import longest_stretches
from vision.data import (
    MEASURED,
    SIDES,
    FlagCounts,
    ForceMetadata,
    StickMetadata,
    StripMetadata,
    TrackMetadata,
    load_unit,
    load_unit_text,
)
from vision.errors import counted
from vision.figures.style import drift_text, matches_text, offset_text
from vision.files import shortened
from vision.force.recording import good_samples
from vision.models.single_fits import SYMBOLS
from vision.numeric import nan_median, two_digits, typical, with_minus
from vision.sample import Sample
from vision.sheets import doubtful_stretches
from vision.sheets.recovery import LONG_GAP, missing_stretches
from vision.systematics import QUANTITIES, SOURCES, Budget, systematic_budget
from vision.video.reader import LOSSY

if TYPE_CHECKING:
    from vision.clock import Clock
    from vision.figures import Results
    from vision.models import ModelFits


def noise_figures(tracks: xr.Dataset, pixel_size_um: float | None) -> dict[str, float]:
    """Return the median noise of a position: measured, predicted from the pixels, and stated (x_err_px)."""
    predicted = "x_predicted_px" if "x_predicted_px" in tracks else "x_err_px"
    columns = {"measured_px": "x_noise_px", "predicted_px": predicted, "stated_px": "x_err_px"}
    if "x_scatter_px" in tracks and np.isfinite(tracks["x_scatter_px"].values).any():
        columns["scatter_px"] = "x_scatter_px"
    figures = {name: typical(tracks[column].values) for name, column in columns.items()}
    if pixel_size_um is not None:
        figures |= {f"{name[:-3]}_um": px * pixel_size_um for name, px in list(figures.items())}
    return figures


def findings(tracks: xr.Dataset) -> dict[str, Any]:
    """Return what was found in the video, for run.json."""
    strip, found = StripMetadata.of(tracks), TrackMetadata.of(tracks)
    return {
        "strip": {
            "z0": strip.strip_z0,
            "z1": strip.strip_z1,
            "how": strip.strip_how,
            "tilt_deg": strip.tilt_deg,
        },
        "clock": {"kind": strip.clock_kind, "fps": strip.fps},
        "ridges": {"polarity": found.ridges, "fwhm_px": found.ridge_fwhm_px, "pitch_px": found.spacing_px},
        "sheets": {"count": found.sheets, "other_ridges_left_out": found.ridges_dropped},
        "axis": {
            "px": found.axis_px,
            "how": found.axis_how,
            "low_px": found.axis_low_px,
            "high_px": found.axis_high_px,
        },
        "window_px": found.window_px,
        "locking": {"subtracted_px": found.locking_px, "left_px": found.locking_err_px},
        "profile_noise_grey": found.profile_noise,
        "least_identity_margin_nats": found.least_margin,
    }


# --- the lines ----------------------------------------------------------------------------------------------

AXIS_HOW = {"motion": "found from motion", "geometry": "the middle of the ridges in view", "given": "given"}
"""How the symmetry axis is known, in words."""


@dataclass(frozen=True)
class Answer:
    """One result in words: a line of a summary, or a box at the top of a page."""

    what: str  # its name; "" for more about the one before
    value: str
    detail: str = ""
    doubt: bool = False  # whether the value may be wrong or incomplete

    @property
    def text(self) -> str:
        """Value and detail."""
        return "; ".join(filter(None, (self.value, self.detail)))


def summary_lines(results: Results, assumed: Sample | None = None) -> list[str]:
    """Return the summary: sheets, frames, positions, noise and findings of the film, then of the force.

    assumed: the sample with which the models were fitted if none was given.
    """
    return aligned((one.what, one.text) for one in summary_items(results, assumed))


def aligned(lines: Iterable[tuple[str, str]]) -> list[str]:
    """Return names and texts as lines, with the texts below each other; "" continues the line above."""
    return [f"{name:<10} {text}" for name, text in lines]


BOXES = {
    "sheets": "sheets tracked",
    "positions": "positions",
    "sticks": "stick phases",
    "shells": "stiff shell",
    "events": "events of the force",
    "clocks": "clocks",
    "models": "friction coefficient",
    "noise": "noise of a position",
    "frames": "frames",
}
"""Lines of the summary that are boxes at the top of the report, the most important first, and their names."""


def answers(results: Results) -> list[Answer]:
    """Return the boxes at the top of the report."""
    named = {one.what: one for one in _findings(results)}
    return [replace(named[name], what=what) for name, what in BOXES.items() if name in named]


def summary_items(results: Results, assumed: Sample | None) -> Iterator[Answer]:
    """Yield each line of `summary_lines`."""
    yield from _findings(results)
    for k, text in enumerate(_systematic(systematic_budget(results))):
        yield Answer("" if k else "errors", text)
    if results.fits is not None:
        yield Answer("sample", _sample(results.fits.sample, results.tracks, assumed=assumed is not None))


def _findings(results: Results) -> Iterator[Answer]:
    """Yield what was found in the film, in the force, and in both."""
    if results.tracks is not None:
        yield from _of_tracks(results.tracks, results.pixel_size_um, results.pixel_size_err_um)
    if results.force is not None:
        yield from _of_force(results.force, results.sticks)
    if (fits := results.fits) is not None:
        yield from _of_fits(fits)
    elif reason := results.reasons.get("fits"):
        yield Answer("models", "none", reason)
    if results.clock is not None:
        yield _clocks(results.clock)
    if results.sticks is not None and results.tracks is not None:
        yield _sticks(results, results.sticks)
    if results.shells is not None and results.motion is not None:
        yield _shells(results, results.motion, results.shells)


def _of_force(force: xr.Dataset, sticks: pd.DataFrame | None) -> Iterator[Answer]:
    """Yield the lines about a force recording and its events."""
    if text := force_columns_text(force):
        yield Answer("force", text)
    if sticks is None:
        return
    facts = StickMetadata.of(sticks)
    regime = facts.regime
    kind = "stick-slip events" if regime == "stick-slip" else f"events ({regime}, not stick-slip)"
    yield Answer(
        "events", f"{len(sticks)} {kind}", f"{event_sizes(force, sticks)}; {lowpass_correction(sticks)}"
    )
    if facts.hum_N:
        hum = f"{facts.hum_Hz:.4g} Hz, {facts.hum_N:.2g} {load_unit_text(force)} rms"
        yield Answer("hum", f"slips are searched without hum of {hum}")
    yield from (Answer("", note) for note in ForceMetadata.of(force).notes)


def _of_fits(fits: ModelFits) -> Iterator[Answer]:
    """Yield the lines about the models fitted to the force recording."""
    shown = {name: f"{symbol} {fits.text(name, unit)}" for name, (symbol, unit) in SYMBOLS.items()}
    detail = ", ".join(shown[name] for name in ("A", "N_hat_N", "Y_eff_GPa"))
    yield Answer("models", shown["mu"], detail)
    more = f"{shown['Lambda_hat_mm']}, {shown['T0_N']}"
    yield from (Answer("", text) for text in (more.replace("𝒯_0", "𝒯0"), *fits.notes))


def _of_tracks(
    tracks: xr.Dataset, pixel_size_um: float | None, pixel_size_err_um: float | None
) -> Iterator[Answer]:
    """Yield the lines about a film."""
    strip, found = StripMetadata.of(tracks), TrackMetadata.of(tracks)
    side, flags = tracks["side"].values, FlagCounts(tracks)
    remarks = [f"other ridges ignored: {found.ridges_dropped}"]
    if found.sheets_alike == "yes":
        remarks.append("they look alike: a jump by their spacing would be invisible")
    if found.ridges_likelier:
        remarks.append(f"the {found.ridges_likelier} stripes look more like sheets")
    sides = ", ".join(f"{(side == which).sum()} {name}" for which, name in SIDES.items())
    ridges = f"{counted(found.sheets, f'{found.ridges} ridge')} ({sides})"
    yield Answer("sheets", ridges, "; ".join(remarks))
    bad = bad_frames(strip, flags.frozen_frames)
    read = f"{strip.frames_read} of {strip.frames_expected} read"
    yield Answer("frames", read, bad or "none lost, blank, corrupt or frozen", doubt=bool(bad))
    yield positions_line(flags)
    if flags.measured:
        yield _noise(tracks, pixel_size_um)
    else:
        yield Answer("noise", "no position measured", doubt=True)
    if len(doubts := doubtful_stretches(tracks)):
        yield Answer("doubtful", f"{len(doubts)} stretches; longest: {longest_stretches(doubts, 'why')}")
    if len(gaps := missing_stretches(tracks)):
        yield Answer("no ridge", f"for {LONG_GAP} frames or more: {longest_stretches(gaps, 'flag')}")
    tilt = f", tilt {with_minus(f'{strip.tilt_deg:+.2f}')}°" if math.isfinite(strip.tilt_deg) else ""
    padding = f", without columns {' and '.join(strip.padding)} (padding)" if strip.padding else ""
    yield Answer("strip", f"rows {strip.strip_z0}:{strip.strip_z1} ({strip.strip_how}){tilt}{padding}")
    if "x_z_px" in tracks:
        yield Answer("heights", heights_line(tracks))
    yield Answer("ridges", ridges_line(found))
    axis = f"{found.axis_px:.1f} px ({_axis(found, int(tracks['n'].min()), one_side=len(set(side)) == 1)})"
    yield Answer("axis", axis + _axis_on_sheet(tracks) if math.isfinite(found.axis_px) else "not known")
    yield Answer("clock", frame_rate_text(strip))
    yield Answer("scale", scale_line(pixel_size_um, pixel_size_err_um, strip))


def bad_frames(strip: StripMetadata, frozen: int = 0) -> str:
    """Return the numbers of lost, blank and frozen frames, "" if there are none."""
    lost = f"lost, {strip.frames_corrupt} of them corrupt" if strip.frames_corrupt else "lost"
    counts = {lost: strip.frames_lost, "blank": strip.frames_blank, "frozen": frozen}
    return ", ".join(f"{count} {name}" for name, count in counts.items() if count)


def _noise(tracks: xr.Dataset, pixel_size_um: float | None) -> Answer:
    """Return the noise of a position, which is not known from few or identical frames."""
    noise, codec = noise_figures(tracks, pixel_size_um), StripMetadata.of(tracks).codec
    measured, predicted = noise["measured_px"], noise["predicted_px"]
    length = "" if pixel_size_um is None else f" = {noise['measured_um']:.3g} µm"
    value = f"{measured:.4f} px{length} from frame to frame"
    hidden = codec in LOSSY  # so that the error predicted from the pixels means nothing
    parts = [
        f"{noise['scatter_px']:.4f} px between sheets" if noise.get("scatter_px", 0.0) > 0 else "",
        f"{codec} hides the noise of pixels" if hidden else f"{predicted:.4f} px predicted from the pixels",
        f"x_err_px {noise['stated_px']:.4f} px",
    ]
    if (locking_px := TrackMetadata.of(tracks).locking_px) > 0:
        parts.append(f"locking to pixels of {locking_px:.3f} px rms subtracted")
    return Answer(
        "noise",
        value if measured > 0 else "not measured (too few frames that differ)",
        ", ".join(filter(None, parts)),
        doubt=not measured > 0 or (not hidden and measured > 3 * predicted),
    )


def heights_line(tracks: xr.Dataset) -> str:
    """Return the number of strips at different heights, and the tilt of the sheets between the outer two."""
    z = tracks["z"].values
    x_z = tracks["x_z_px"].values
    tilt = nan_median((x_z[..., -1] - x_z[..., 0]).ravel())
    missing = int((np.isfinite(tracks["x_px"].values)[..., None] & ~np.isfinite(x_z)).sum())
    lost = f"; {missing} positions without a fit" if missing else ""
    return (
        f"{len(z)} strips from row {z[0]:.1f} to {z[-1]:.1f}, x_z_px in tracks.nc; sheets are "
        f"tilted by {with_minus(f'{tilt:+.3f}')} px between them{lost}"
    )


def ridges_line(found: TrackMetadata) -> str:
    """Return width and spacing of the ridges, and the fit."""
    apart = f", {found.spacing_px:.1f} px apart" if math.isfinite(found.spacing_px) else ""
    return f"{found.ridge_fwhm_px:.1f} px wide{apart}; {found.fit} fit over {found.window_px} px"


def axis_source(found: TrackMetadata) -> str:
    """Return how the axis is known: given, decided by the motion, or the middle of the ridges."""
    if found.axis_how == "geometry" and found.axis_missing:
        seem = "seems" if found.axis_missing == 1 else "seem"
        return f"{AXIS_HOW['geometry']} and {found.axis_missing} that {seem} to be missing"
    if found.axis_how == "motion" and found.axis_open == "yes":
        return "not decided by the motion"
    return AXIS_HOW[found.axis_how]


def _axis(found: TrackMetadata, innermost: int, *, one_side: bool) -> str:
    """Return how the axis is known, and the range that the motion allows, which contains it."""
    how = axis_source(found)
    if found.axis_how == "given":
        if innermost == 1:
            return how
        more = f"{innermost - 1} more sheets fit between it and those in view"
        return f"{how}; n begins at {innermost}, as {more}"
    if not math.isfinite(found.axis_low_px):
        return f"{how}; the motion does not show the axis"
    if found.axis_high_px == found.axis_low_px:
        return f"{how}; the motion allows no other gap between sheets"
    low, high = min(found.axis_low_px, found.axis_px), max(found.axis_high_px, found.axis_px)
    if found.axis_how == "motion" and how != AXIS_HOW["motion"]:
        beyond = "half a spacing beyond the innermost sheet in view; " if one_side else ""
        return f"{beyond}{how}, which allows {low:.1f} to {high:.1f} px"
    return f"{how}; the motion allows {low:.1f} to {high:.1f} px"


def _axis_on_sheet(tracks: xr.Dataset) -> str:
    """Return which sheet the axis goes through, as it does for an odd number of sheets, or "" if none."""
    found = TrackMetadata.of(tracks)
    apart = np.abs(tracks["x_mean_px"].values - found.axis_px)
    if found.axis_how == "given" or not (apart < found.spacing_px / 4).any():
        return ""
    sheet = int(np.nanargmin(apart))
    side, n = SIDES[int(tracks["side"].values[sheet])], int(tracks["n"].values[sheet])
    return (
        f"; it goes through sheet {sheet}, which counts as n = {n} on the {side}: if it should lie between "
        "two sheets, one was overlooked, or one is no sheet (`axis_px`)"
    )


RATE_SOURCES = {
    "playback": "the file's playback rate",
    "file": "from the recording itself",
    "given": "as given",
}
"""Where a frame rate comes from, by the kind of the clock."""


def frame_rate_text(strip: StripMetadata) -> str:
    """Return the frame rate and its source as text."""
    if not math.isfinite(strip.fps) and strip.clock_kind == "playback":
        return "the file states no frame rate: give the camera's with `fps`"
    if strip.clock_file:
        rate = f", about {strip.fps:.4g} frames/s" if math.isfinite(strip.fps) else ""
        return f"from the time stamps in {strip.clock_file}{rate}"
    confirm = ": confirm it or give the camera's with `fps`" if strip.clock_kind == "playback" else ""
    return f"{strip.fps:g} frames/s ({RATE_SOURCES[strip.clock_kind]}){confirm}"


def pixel_size_text(size_um: float, err_um: float | None) -> str:
    """Return a pixel size in µm, with its error if that is known."""
    return f"{size_um:g}" + ("" if err_um is None else f" ± {err_um:.2g}") + " µm"


def scale_line(pixel_size_um: float | None, err_um: float | None, strip: StripMetadata) -> str:
    """Return the pixel size, and the scale in the film's file if it differs or is not used."""
    stated, unused = strip.file_pixel_size_um, strip.file_scale_unused
    how = f" (not used: the film's file states {unused})" if unused else ""
    if pixel_size_um is None:
        return f"px: give `pixel_size_um` for µm{how}"
    if math.isfinite(stated):
        source = "from the film's file" if stated == pixel_size_um else f"the film's file states {stated:g}"
        how = f" ({source})"
    return f"{pixel_size_text(pixel_size_um, err_um)} per px{how}"


def positions_line(flags: FlagCounts) -> Answer:
    """Return how many positions were measured, and how many have which flag of the others."""
    blurred = f" ({flags['blurred']} of them blurred)" if flags["blurred"] else ""
    others = ", ".join(f"{count} {name}" for name, count in flags.items() if name not in MEASURED)
    value = f"{flags.measured} of {flags.total()} measured{blurred}"
    return Answer("positions", value, others, doubt=flags.measured < 0.99 * flags.total())


def force_columns_text(force: xr.Dataset) -> str:
    """Return the name of the force recording, the columns taken from it, its rate and V; "" if not known."""
    facts = ForceMetadata.of(force)
    if not facts.columns:
        return ""
    taken = (re.sub(r"(?<= = ).*(?= \[)", lambda name: shortened(name[0], 24), one) for one in facts.columns)
    step = float(nan_median(np.diff(good_samples(force)["time_s"].values)))
    rate = f"; {1 / step:.4g} Hz" if step > 0 else ""
    pulled = f", V {facts.speed_mm_min:.3g} mm/min" if math.isfinite(facts.speed_mm_min) else ""
    return f"{shortened(Path(facts.source).name, 40)}: {', '.join(taken)}{rate}{pulled}"


def event_sizes(force: xr.Dataset, sticks: pd.DataFrame) -> str:
    """Return the medians of ΔF, Λ_st and K as text, in the unit of the load."""
    middle = sticks.median(numeric_only=True)
    slope = "/mm" if load_unit(force) == "1" else " N/mm"
    sizes = f"median ΔF {middle['dF_N']:.3g} {load_unit_text(force)}"
    if math.isnan(middle["stick_length_um"]):
        return f"{sizes}; lengths and K are unknown without the separation"
    return f"{sizes}, Λ_st {middle['stick_length_um']:.3g} µm, K {middle['K_N_per_mm']:.4g}{slope}"


def load_correction(facts: StickMetadata) -> str:
    """Return how the forces were averaged, or corrected for the load cell's low-pass."""
    if facts.average_s:
        period = f"{_ms(facts.average_s)}, a period of the load cell's ringing"
        return f"averaged twice over {period}, and corrected for what this cuts off"
    if facts.lowpass_s:
        how = "found from the transients after slips" if facts.lowpass_how == "found" else "as given"
        return f"corrected for the load cell's first-order low-pass of {_ms(facts.lowpass_s)} ({how})"
    return "as recorded"


def lowpass_correction(sticks: pd.DataFrame) -> str:
    """Return `load_correction`, and what could be corrected but is not."""
    facts = StickMetadata.of(sticks)
    parts = [f"forces {load_correction(facts)}"]
    if facts.average_s or facts.lowpass_s:
        return parts[0]
    if facts.every > 1:
        parts[0] += f", one sample in {facts.every}: a filter has smoothed those between"
    lowpass = f"a low-pass of {_ms(facts.lowpass_proposed_s)}"
    if facts.lowpass_doubt == "shape":
        parts.append(
            f"the slips suggest {lowpass}, but have a tail without it: another filter, which "
            "`force_lowpass_s` cannot correct"
        )
    elif math.isfinite(facts.lowpass_proposed_s):
        proven = "show" if facts.lowpass_proven else "may show (they differ)"
        parts.append(f"the slips {proven} {lowpass}, which `force_lowpass_s` auto can correct")
    if math.isfinite(facts.ringing_s):
        rate = f"{1 / facts.ringing_s:.3g} Hz"
        parts.append(f"the load oscillates at {rate}, which `force_average_s` auto averages")
    return "; ".join(parts)


def _ms(seconds: float) -> str:
    """Return a time in ms with two digits, or all digits before the point."""
    return f"{1e3 * seconds:.2g} ms" if seconds < 0.1 else f"{1e3 * seconds:.0f} ms"


def _clocks(clock: Clock) -> Answer:
    if clock.status == "ambiguous":
        _, offsets, _ = clock.offsets_at_slips()
        pairs = zip(offsets[1:], clock.candidates[:3], strict=False)
        best = [f"{offset_s:.3f} s ({one.log_likelihood:.1f})" for offset_s, one in pairs]
        likeliest = with_minus(", ".join(best) or f"{clock.offset_s:.3f} s")
        why = f"{clock.ambiguity}; " if clock.ambiguity else ""
        detail = f"{why}possible offsets (log-likelihood) {likeliest}; none is used"
        return Answer("clocks", "ambiguous", detail, doubt=True)
    found = f"{clock.status}: offset {offset_text(clock)}, drift {drift_text(clock)}"
    return Answer("clocks", found, matches_text(clock))


def _sticks(results: Results, sticks: pd.DataFrame) -> Answer:
    """Return how many of the stick phases are in the film."""
    good = (sticks["flag"] == "ok").sum()
    detail = f"of {len(sticks)} in the force recording, {good} of them without a flag"
    motion, clock = results.motion, results.clock
    if motion is None:
        why = ""
        if clock is None:
            why = " (no common clock)"
        elif clock.status == "ambiguous":
            why = " (clocks ambiguous)"
        return Answer("sticks", f"not known in the video{why}", detail, doubt=True)
    inside, short = motion.sizes["event"], int((motion["flag"] == "few").all("sheet").sum())
    too_short = f", {short} of them too short for σ_x/Λ_st" if short else ""
    return Answer("sticks", f"{inside} in the video{too_short}", detail, doubt=inside == 0)


def _shells(results: Results, motion: xr.Dataset, shells: pd.DataFrame) -> Answer:
    """Return the size of the stiff shell, with its interval, in the first and in the last three stick phases
    (medians), and the deformation of the sheets."""
    known = shells[shells["stiff_sheets"].notna()].sort_values("d_v_mm")
    if known.empty:
        return Answer("shells", "not known", "too few sheets with a known deformation", doubt=True)
    ends = known.head(6), known.tail(6)  # three stick phases on two sides
    names = ["stiff_sheets", "stiff_low", "stiff_high"]
    first, last = ("{:.3g} ({:.3g} to {:.3g})".format(*end[names].astype(float).median()) for end in ends)
    d_mm = known["d_v_mm"]
    size = first if first == last else f"{first} → {last}"
    where = f"from d = {d_mm.min():.2f} to {d_mm.max():.2f} mm" if d_mm.notna().any() else "d not known"
    if results.force is not None and ForceMetadata.of(results.force).lacks_d0:
        where = "at separations that are not known"
    ratio = nan_median(motion["ratio"].values)  # of each sheet
    span = f"; median σ_x/Λ_st of a sheet {np.nanmin(ratio):.3f} to {np.nanmax(ratio):.3f}"
    detail = f"σ_x/Λ_st below {results.threshold:g}, {where}{span}"
    return Answer("shells", f"{size} sheets per side", detail)


def _systematic(budget: Budget) -> list[str]:
    """Return the systematic errors that other lines lack, then the sources whose error is unknown."""
    lines: list[str] = []
    for quantity in ("x_px", "K_N_per_mm", "ratio"):
        name, unit = QUANTITIES[quantity]
        total = budget.total(quantity)
        if quantity in budget.values and math.isfinite(total) and total > 0:
            statistical = budget.statistical[quantity]
            beside = f", {two_digits(statistical)} statistical" if math.isfinite(statistical) else ""
            lines.append(f"{name} ± {two_digits(total)} {unit}".rstrip() + f" systematic{beside}")
    # The sources of x_px are measured: the user cannot give their errors.
    unknown = dict.fromkeys(
        source for quantity in ("Lambda_hat_mm", "K_N_per_mm", "ratio") for source in budget.unknown(quantity)
    )
    # The notes of the fits say that d0 has no error.
    if without := [SOURCES.get(one, one) for one in unknown if one != "d0"]:
        lines.append(f"not included, since no error is known: {', '.join(without)}")
    return lines


def _sample(sample: Sample, tracks: xr.Dataset | None, *, assumed: bool) -> str:
    """Return the sample, and how many ridges the fuller side of the film shows if that differs.

    Whoever gives the thickness alone must see that the other lengths are the publication's.
    """
    size = f"{sample.thickness_mm:g} x {sample.width_mm:g} x {sample.length_mm:g} mm"
    seen = sample.sheets_per_block
    if tracks is not None:
        seen = max(int((tracks["side"].values == side).sum()) for side in (-1, 1))
    unlike = f"; the video shows {seen} per side" if seen != sample.sheets_per_block else ""
    before = "assumed: the publication's, " if assumed else ""
    after = "" if assumed else " (the publication's where not given)"
    return f"{before}M = {sample.sheets_per_block} sheets of {size}{after}{unlike}"
