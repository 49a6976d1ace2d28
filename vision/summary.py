"""The summary of a run in about ten lines, and warnings that only its tracks or several stages show."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from vision.data import ForceMetadata, StickMetadata, StripMetadata, TrackMetadata, load_unit
from vision.figures.style import both_errors, candidates_text, counted, drift_text, offset_text
from vision.models.equations import effective_sheets
from vision.numeric import Pixels, nan_median, stretches, two_digits
from vision.sample import Sample
from vision.sheets import doubtful_stretches
from vision.sheets.tracks import LOSSY, comb_is_stationary
from vision.systematics import QUANTITIES, SOURCES, Budget, systematic_budget
from vision.video import VideoSettings

if TYPE_CHECKING:
    from vision.clock import Clock
    from vision.figures import Results
    from vision.models import ModelFits
    from vision.shells import ShellSettings


def flag_counts(tracks: xr.Dataset) -> dict[str, int]:
    """Return how often each flag occurs, in alphabetical order."""
    flags = tracks["flag"].values
    ok = flags == "ok"  # most are, and need not be sorted
    names, counts = np.unique(flags[~ok], return_counts=True)
    found = {str(name): int(count) for name, count in zip(names, counts, strict=True)}
    if ok.any():
        found["ok"] = int(ok.sum())
    return dict(sorted(found.items()))


def noise_figures(tracks: xr.Dataset, pixel_size_um: float | None) -> dict[str, float]:
    """Return the median noise of a position: measured, predicted from the pixels, and stated (x_err_px)."""
    measured = float(nan_median(tracks["x_noise_px"].values.ravel()))
    stated = float(nan_median(tracks["x_err_px"].values.ravel()))
    known = "x_predicted_px" in tracks
    predicted = float(nan_median(tracks["x_predicted_px"].values.ravel())) if known else stated
    figures = {"measured_px": measured, "predicted_px": predicted, "stated_px": stated}
    if "x_scatter_px" in tracks and np.isfinite(tracks["x_scatter_px"].values).any():
        figures["scatter_px"] = float(nan_median(tracks["x_scatter_px"].values.ravel()))
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
        "ridges": {"polarity": found.ridges, "fwhm_px": found.ridge_fwhm_px, "pitch_px": found.pitch_px},
        "sheets": {"count": found.sheets, "other_ridges_left_out": found.ridges_dropped},
        "axis": {
            "px": found.axis_px,
            "how": found.axis_how,
            "low_px": found.axis_low_px,
            "high_px": found.axis_high_px,
        },
        "window_px": found.window_px,
        "profile_noise_grey": found.profile_noise,
        "least_identity_margin_nats": found.least_margin,
    }


# --- the lines ----------------------------------------------------------------------------------------------

AXIS_HOW = {"motion": "found from motion", "geometry": "the middle of the ridges in view", "given": "given"}
"""How the symmetry axis is known, in words."""


def summary_lines(results: Results) -> list[str]:
    """Return the summary: sheets, frames, positions, noise and findings of the film, then of the force."""
    return aligned(_lines(results))


def aligned(lines: Iterable[tuple[str, str]]) -> list[str]:
    """Return names and texts as lines, with the texts below each other; "" continues the line above."""
    return [f"{name:<10} {text}" for name, text in lines]


def _lines(results: Results) -> Iterator[tuple[str, str]]:
    """Yield the name and the text of each line of the summary."""
    if results.tracks is not None:
        yield from _tracking_lines(results.tracks, results.pixel_size_um)
    if results.force is not None and results.sticks is not None:
        sizes, lowpass = event_sizes(results.force, results.sticks), lowpass_correction(results.sticks)
        regime = StickMetadata.of(results.sticks).regime
        kind = "stick-slip events" if regime == "stick-slip" else f"events ({regime}, not stick-slip)"
        yield "events", f"{len(results.sticks)} {kind}; {sizes}; {lowpass}"
        yield from (("", note) for note in ForceMetadata.of(results.force).notes)
    if (fits := results.fits) is not None:
        mu, a, n_hat = (both_errors(one) for one in (fits.mu, fits.amplitude, fits.n_hat_N))
        scale, modulus, t0 = (both_errors(one) for one in (fits.scale_mm, fits.modulus_GPa, fits.t0_N))
        yield "models", f"μ {mu}, A {a}, N̂ {n_hat} N"
        yield "", f"Λ̂ {scale} mm, Y_eff {modulus} GPa, 𝒯0 {t0} N"
        yield from (("", note) for note in fits.notes)
    elif reason := results.reasons.get("fits"):
        yield "models", f"none: {reason}"
    if results.clock is not None:
        yield "clocks", _clocks(results.clock)
    if results.shells is not None and results.motion is not None:
        yield "shells", _shells(results.motion, results.shells)
    for k, text in enumerate(_systematic(systematic_budget(results))):
        yield "" if k else "errors", text


def _tracking_lines(tracks: xr.Dataset, pixel_size_um: float | None) -> Iterator[tuple[str, str]]:
    """Yield the lines about a film."""
    strip, found = StripMetadata.of(tracks), TrackMetadata.of(tracks)
    side, flags = tracks["side"].values, flag_counts(tracks)
    noise = noise_figures(tracks, pixel_size_um)
    length = "" if pixel_size_um is None else f" = {noise['measured_um']:.3g} µm"
    tilt = f", tilt {strip.tilt_deg:+.2f}°" if math.isfinite(strip.tilt_deg) else ""
    corrupt = f" ({strip.frames_corrupt} of them corrupt)" if strip.frames_corrupt else ""
    frozen = f", {count} frozen" if (count := flags.get("frozen", 0) // side.size) else ""
    unseen = "; they look alike: a jump by their spacing would be invisible" * (found.sheets_alike == "yes")
    unseen += f"; the {found.ridges_likelier} stripes look more like sheets" * bool(found.ridges_likelier)
    # Compression hides the noise of pixels, so that the error predicted from them means nothing.
    predicted = (
        f"; x_err_px {noise['stated_px']:.4f} px ({strip.codec} hides the noise of pixels)"
        if strip.codec in LOSSY
        else f", {noise['predicted_px']:.4f} px predicted from the pixels"
    )
    axis = f"{found.axis_px:.1f} px ({_axis(found, int(tracks['n'].min()))})"
    ridges = counted(found.sheets, f"{found.ridges} ridge")
    yield (
        "sheets",
        (
            f"{ridges} ({(side < 0).sum()} left, {(side > 0).sum()} right); other ridges ignored: "
            f"{found.ridges_dropped}{unseen}"
        ),
    )
    yield (
        "frames",
        (
            f"{strip.frames_read} of {strip.frames_expected} read; {strip.frames_lost} lost{corrupt}, "
            f"{strip.frames_blank} blank{frozen}"
        ),
    )
    yield "positions", f"{flags.get('ok', 0)} measured; {other_flags(flags)}"
    yield "noise", f"{_noise(noise, length)}{predicted}" if "ok" in flags else "no position measured"
    if doubt := doubt_line(tracks):
        yield "doubtful", doubt
    yield "strip", f"rows {strip.strip_z0}:{strip.strip_z1} ({strip.strip_how}){tilt}"
    if "x_z_px" in tracks:
        yield "heights", heights_line(tracks)
    yield "ridges", ridges_line(found)
    yield "axis", axis if math.isfinite(found.axis_px) else "not known"
    yield "clock", frame_rate_text(strip)
    yield "scale", scale_line(pixel_size_um, strip)


def _noise(noise: Mapping[str, float], length: str) -> str:
    """Return the measured noise as text; it is not known from few or identical frames."""
    parts = []
    if noise["measured_px"] > 0:
        parts.append(f"{noise['measured_px']:.4f} px{length} from frame to frame")
    if noise.get("scatter_px", 0.0) > 0:
        parts.append(f"{noise['scatter_px']:.4f} px between sheets")
    return ", ".join(parts) or "not measured (too few frames that differ)"


def doubt_line(tracks: xr.Dataset) -> str:
    """Return the number of doubtful stretches and the longest three, or "".

    Sheets with the same frames and reason count as one stretch among the longest.
    """
    table = doubtful_stretches(tracks)
    if table.empty:
        return ""
    alike = [rows for _, rows in table.groupby(["first_frame", "last_frame", "why"], sort=False)]
    worst = sorted(alike, key=lambda rows: -int(rows["frames"].sum()))
    longest = [
        f"{_sheet_range(rows['sheet'])} in frames"
        f" {rows['first_frame'].iloc[0]}:{rows['last_frame'].iloc[0] + 1} ({rows['why'].iloc[0]})"
        for rows in worst[:3]
    ]
    return f"{len(table)} stretches; longest: {'; '.join(longest)}"


def _sheet_range(sheets: pd.Series) -> str:
    """Return "sheet 3", or "4 sheets between 3 and 9"."""
    if len(sheets) == 1:
        return f"sheet {sheets.iloc[0]}"
    return f"{len(sheets)} sheets between {sheets.min()} and {sheets.max()}"


def heights_line(tracks: xr.Dataset) -> str:
    """Return the number of strips at different heights, and the tilt of the sheets between the outer two."""
    z = tracks["z"].values
    x_z = tracks["x_z_px"].values
    tilt = nan_median((x_z[..., -1] - x_z[..., 0]).ravel())
    missing = int((np.isfinite(tracks["x_px"].values)[..., None] & ~np.isfinite(x_z)).sum())
    lost = f"; {missing} positions without a fit" if missing else ""
    return (
        f"{len(z)} strips from row {z[0]:.1f} to {z[-1]:.1f}, x_z_px in tracks.nc; sheets are "
        f"tilted by {tilt:+.3f} px between them{lost}"
    )


def ridges_line(found: TrackMetadata) -> str:
    """Return width and spacing of the ridges, and the fit."""
    size = f"{found.ridge_fwhm_px:.1f} px wide" + f", {found.pitch_px:.1f} px apart" * (found.sheets > 1)
    return f"{size}; {found.fit} fit over {found.window_px} px"


def _axis(found: TrackMetadata, innermost: int) -> str:
    how = AXIS_HOW[found.axis_how]
    if found.axis_how == "given":
        unseen = f"; n begins at {innermost}, as {innermost - 1} more sheets fit between it and those in view"
        return how + unseen * (innermost > 1)
    if not math.isfinite(found.axis_low_px):
        return f"{how}; the motion does not show the axis"
    if found.axis_high_px == found.axis_low_px:
        return f"{how}; the motion allows no other gap between sheets"
    return f"{how}; the motion allows {found.axis_low_px:.0f} to {found.axis_high_px:.0f} px"


def frame_rate_text(strip: StripMetadata) -> str:
    """Return the frame rate and its source as text."""
    if not math.isfinite(strip.fps) and strip.clock_kind == "playback":
        return "the file states no frame rate: give the camera's with `fps`"
    kinds: Mapping[str, str] = {
        "playback": " is the file's playback rate: confirm it or give the camera's with `fps`",
        "file": ", from the recording itself",
        "given": ", as given",
    }
    return f"{strip.fps:g} frames/s{kinds[strip.clock_kind]}"


def scale_line(pixel_size_um: float | None, strip: StripMetadata) -> str:
    """Return the pixel size, and the scale in the film's file if it differs or is not used."""
    stated, unused = strip.file_pixel_size_um, strip.file_scale_unused
    how = f" (not used: the film's file states {unused})" if unused else ""
    if pixel_size_um is None:
        return f"px: give `pixel_size_um` for µm{how}"
    if math.isfinite(stated):
        source = "from the film's file" if stated == pixel_size_um else f"the film's file states {stated:g}"
        how = f" ({source})"
    return f"{pixel_size_um:g} µm per px{how}"


def other_flags(flags: Mapping[str, int]) -> str:
    """Return how many positions have which flag other than "ok"."""
    return ", ".join(f"{count} {name}" for name, count in flags.items() if name != "ok") or "none missing"


def event_sizes(force: xr.Dataset, sticks: pd.DataFrame) -> str:
    """Return the medians of ΔF, Λ_st and K as text, in the unit of the load."""
    middle = sticks.median(numeric_only=True)
    drop, slope = (" of the weight", "/mm") if load_unit(force) == "1" else (" N", " N/mm")
    sizes = f"median ΔF {middle['dF_N']:.3g}{drop}"
    if math.isnan(middle["stick_length_um"]):
        return f"{sizes}; lengths and K are unknown without the separation"
    return f"{sizes}, Λ_st {middle['stick_length_um']:.3g} µm, K {middle['K_N_per_mm']:.4g}{slope}"


def lowpass_correction(sticks: pd.DataFrame) -> str:
    """Summarise the load-cell low-pass correction."""
    facts = StickMetadata.of(sticks)
    if not facts.lowpass_s:
        proposal = ""
        if math.isfinite(facts.lowpass_proposed_s):
            proven = "show" if facts.lowpass_proven else "may show (they differ)"
            proposal = (
                f"; the slips {proven} a low-pass of {_ms(facts.lowpass_proposed_s)}, which "
                "`lowpass_s` can correct"
            )
        return f"forces as recorded{proposal}"
    return f"corrected for a low-pass of {_ms(facts.lowpass_s)} ({facts.lowpass_how})"


def _ms(seconds: float) -> str:
    """Return a time in ms with two digits, or all digits before the point."""
    return f"{1e3 * seconds:.2g} ms" if seconds < 0.1 else f"{1e3 * seconds:.0f} ms"


def _clocks(clock: Clock) -> str:
    spread = f" to {clock.residual_ms:.1f} ms" if math.isfinite(clock.residual_ms) else ""
    if clock.status == "ambiguous" and clock.candidates:
        return f"ambiguous: possible offsets (log-likelihood) {candidates_text(clock)}; none is used"
    numbers = {"film": clock.unmatched_video, "force": clock.unmatched_force}
    alone = "".join(f", {count} only in the {name}" for name, count in numbers.items() if count > 0)
    return (
        f"{clock.status}: offset {offset_text(clock)}, drift {drift_text(clock)}, "
        f"{clock.matched} slips matched{spread}{alone}"
    )


def _shells(motion: xr.Dataset, shells: pd.DataFrame) -> str:
    size = shells["stiff_sheets"].dropna().astype(float)
    found = f"{size.median():.0f} ({size.min():.0f} to {size.max():.0f})" if len(size) else "not known"
    if (ratio := nan_median(motion["ratio"].values)).size and np.isfinite(ratio).any():  # of each sheet
        found += f"; median σ_x/Λ_st of a sheet {np.nanmin(ratio):.2g} to {np.nanmax(ratio):.2g}"
    return f"{motion.sizes['event']} stick phases in the video; stiff sheets per side {found}"


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


# --- warnings about the tracks ------------------------------------------------------------------------------

DOUBTFUL = {
    "doubtful": "where the identity of the sheet is uncertain",
    "merged": "where a sheet shares a ridge with another or a mark",
}
"""Flags of positions that are left out because they may belong to another sheet, and why."""
PAIR_SPACINGS = 9
"""Smallest number of spacings in which pairs of ridges are looked for: fewer may alternate by chance."""
PAIR_TAIL, PAIR_RATIO = 0.1, 1.5
"""Ridges form pairs if this quantile of the wide spacings exceeds the same quantile from above of the
narrow ones by this ratio. A smaller ratio calls an uneven comb one of pairs, a larger one misses the edges of
thick sheets (`test_two_edges_of_every_sheet_are_said_to_be_pairs`)."""
PAIR_MOTION = 4.0
"""Ridges also form pairs if the spacings beside every second one change by this factor more than that does,
in the median. On 590 films of single sheets the factor is at most 1.2; on films that show two edges of every
sheet it is 12 to 87. A smaller factor calls noise pairs, a larger one misses edges in noisy films."""


def tracking_warnings(tracks: xr.Dataset) -> list[str]:
    """Return warnings about frozen frames, doubtful or missing positions, motion, and overlooked sheets."""
    lines, flags = [], flag_counts(tracks)
    total = max(1, sum(flags.values()))
    if frozen := flags.get("frozen", 0) // tracks.sizes["sheet"]:
        lines.append(f"{frozen} frame(s) are copies of the frame before and have no positions (flag frozen)")
    if uncertain := sum(flags.get(flag, 0) for flag in DOUBTFUL):
        line = f"{uncertain} of {total} positions left out{why_left_out(flags)}"
        # With 0.2 there is no advice if a hand always covers part of the comb and other positions are wrong.
        if uncertain > 0.1 * total:
            jumps = 2 * np.isin(tracks["why"].values, "jump").sum() > uncertain
            line += "; with so many, other positions may also be wrong: " + (
                "film an end of the comb, mark a sheet or film faster, as the comb jumps by unknown pitches"
                if jumps
                else "check where the tracks lie, and exclude what hides the comb with `frames` or `columns`"
            )
        lines.append(line)
    missing = flags.get("missing", 0) + flags.get("edge", 0) + flags.get("unfit", 0)
    if missing > 0.01 * total:  # fewer are the usual gaps at the edges of the picture
        lines.append(f"{missing} of {total} positions missing (flags missing, edge, unfit in tracks.csv)")
    if line := _frames_with_few_sheets(tracks):
        lines.append(line)
    still = "ok" in flags and not (tracks["x_noise_px"].values > 0).any()
    if tracks.sizes["frame"] < 3:
        lines.append(f"only {tracks.sizes['frame']} frame(s): neither motion nor noise can be measured")
    elif tracks.sizes["frame"] >= 10 and still:
        lines.append("all frames are equal: neither motion nor noise can be measured")
    elif tracks.sizes["frame"] >= 20 and "ok" in flags and comb_is_stationary(tracks):
        lines.append(
            "the sheets do not move relative to each other by more than the noise: if they should, the comb"
            " may be a pattern in the background (`rows`, `columns`), or the pull is in other `frames`"
        )
    for change in TrackMetadata.of(tracks).scene_changes:
        frame = change["frame"]
        lines.append(
            f"the picture changes permanently at frame {frame} (all sheets displaced by"
            f" {change['moved_px']:.0f} px, their relative brightnesses changed by"
            f" {100 * change['brightness']:.0f} %): a cut, or the camera or the light was moved; the sheets"
            f" may not be the same as before: give `frames` as 0:{frame} or {frame}:"
        )
    lines += _alike_warning(TrackMetadata.of(tracks))
    lines += _spacing_warning(tracks)
    return lines


def why_left_out(flags: Mapping[str, int]) -> str:
    """Return why positions are left out, with the number for each reason if there are several."""
    counts = {why: flags[flag] for flag, why in DOUBTFUL.items() if flags.get(flag)}
    if len(counts) == 1:
        return f" {next(iter(counts))}"
    return ": " + ", ".join(f"{count} {why}" for why, count in counts.items())


def _frames_with_few_sheets(tracks: xr.Dataset) -> str:
    """Return a warning if fewer than half of the sheets are found in ten or more successive frames, or ""."""
    flags = tracks["flag"].values
    read = ~np.isin(flags, ("frozen", "blank", "corrupt", "lost")).all(axis=1)
    few = read & (np.isin(flags, ("missing", "edge", "unfit")).mean(axis=1) > 0.5)
    _, first, stop = stretches(few[:, None])
    if not len(first) or (stop - first).max() < 10:
        return ""
    longest = int(np.argmax(stop - first))
    number = tracks["frame"].values
    where = f"{number[first[longest]]}:{number[stop[longest] - 1] + 1}"
    return (
        f"fewer than half of the sheets are found in {few.sum()} frames (the longest run is {where}): another"
        " scene, or something in front of the sheets? exclude these frames with `frames`"
    )


def _alike_warning(facts: TrackMetadata) -> list[str]:
    """Warn of large steps of a comb of equal sheets: it may have moved by another number of spacings."""
    if not facts.large_steps:
        return []
    named = ", ".join(map(str, facts.large_steps[:5])) + " …" * (len(facts.large_steps) > 5)
    return [
        "the sheets look alike and neither end of the comb is in view: displacements of the whole comb may be"
        f" wrong by multiples of the spacing ({facts.pitch_px:.1f} px) after its large steps before frame(s)"
        f" {named}: film an end of the comb, or mark a sheet"
    ]


def _counted(tracks: xr.Dataset) -> bool:
    """Return whether the number of sheets was given."""
    return any(step["parameters"].get("sheets") for step in tracks.attrs.get("operations", ()))


def _spacing_warning(tracks: xr.Dataset) -> list[str]:
    """Warn of ridges in pairs, which keep their distance or whose narrow and wide spacings alternate, or of
    missing sheets; no pairs are reported if the number of sheets was given."""
    apart = np.diff(tracks["x_px"].values, axis=1)
    spacing = nan_median(apart)
    if np.isfinite(spacing).sum() >= PAIR_SPACINGS and not _counted(tracks):
        least = nan_median(tracks["x_err_px"].values.ravel())
        change = np.fmax(np.sqrt(nan_median((apart - spacing) ** 2)), least)
        beside = np.pad(change, 1, constant_values=np.nan)
        ratio = np.fmin(beside[:-2], beside[2:]) / change
        keep_distance = max(nan_median(ratio[k::2]) for k in (0, 1)) > PAIR_MOTION
        narrow, wide = sorted((spacing[0::2], spacing[1::2]), key=nan_median)
        alternate = np.nanquantile(wide, PAIR_TAIL) > PAIR_RATIO * np.nanquantile(narrow, 1 - PAIR_TAIL)
        if alternate or keep_distance:
            how = f"spacings of {nan_median(narrow):.0f} and {nan_median(wide):.0f} px alternate"
            return [
                f"the ridges form pairs: {how if alternate else 'only every second spacing changes'}; if each"
                " pair is the two edges of one sheet, n and the stiff shell count edges, two for each sheet;"
                f" if not, give `sheets` as {len(spacing) + 1}"
            ]
    if places := TrackMetadata.of(tracks).wide_spacings:
        return [
            f"sheets may be missing at x = {', '.join(places)}; n of all sheets further out would then be too"
            " small: check these positions (dirt, faint sheets), or give the number of sheets (`sheets`)"
        ]
    return []


def overexposure(frame: Pixels, rows: slice, settings: VideoSettings) -> list[str]:
    """Return a warning if many of the averaged pixels are saturated, so that ridges have flat tops.

    A saturated pixel is one within 0.4 % of the 99.9 % quantile, as a camera of 12 bits in a file of 16, or a
    codec's white, saturates below the largest value that the file could hold.
    """
    pixels = frame[rows]
    top = float(np.quantile(pixels, 0.999))
    share = float((np.abs(pixels.astype(np.float32) - top) <= top / 255).mean())
    if share < settings.overexposed or top < settings.few_levels:
        return []
    return [
        f"{100 * share:.0f} % of the averaged pixels are as bright as the brightest ({top:.0f}): overexposed."
        " Ridges have flat tops and x_err_px may be too small: film with less light"
    ]


# --- warnings about results that contradict each other ------------------------------------------------------

UNLIKELY_SPACING = 10.0
"""Ratio of the sheets' spacing to two thicknesses, or its inverse, above which the pixel size is questioned.
A wrong unit changes the ratio by 1000; sheets that bulge, or of which only every second one is seen, by 2
to 4. A smaller ratio warns of the latter, a larger one overlooks factors of 10."""
LEAST_SPACING_UM = 1.0
"""Spacing below which the pixel size is questioned though the sheets' thickness is not known: mm taken for µm
make the spacing of paper less than this, which light hardly resolves. Discs of a muscle are 1.8 µm apart."""


def ridges_per_side(tracks: xr.Dataset) -> int:
    """Return the number of ridges on the side of the axis that shows more."""
    return max((int((tracks["side"].values == side).sum()) for side in (-1, 1)), default=0)


def consistency_warnings(
    tracks: xr.Dataset,
    sample: Sample | None = None,
    *,
    assumed: Sample | None = None,
    pixel_size_um: float | None = None,
) -> list[str]:
    """Return warnings about findings that contradict each other, each with what to do about it.

    sample: the given sample, which is compared with the ridges per side and their spacing.
    assumed: the sample that is assumed if none was given.
    """
    found, used, most = TrackMetadata.of(tracks), sample or assumed, int(tracks["n"].max())
    lines = _comb_warnings(tracks, found)
    one_side = len(np.unique(tracks["side"].values)) == 1
    if used is not None and one_side and found.axis_how != "given" and most < used.sheets_per_block:
        lines.append(
            f"only {most} of {used.sheets_per_block} sheets of one side are in view, and n counts from the"
            " innermost of them: if others lie between it and the axis, n and the stiff shell are too small"
            " by their number: give `axis_px`"
        )
    left, right = (int((tracks["side"].values == side).sum()) for side in (-1, 1))
    fewer, more = sorted((left, right))
    one_lacks = used is not None and more == used.sheets_per_block and 1 <= more - fewer <= 2
    if one_lacks and not _counted(tracks):
        lines.append(
            f"{left} sheets on the left but {right} on the right: if one is overlooked, n of those beyond it"
            " is too small: look for a wide spacing or a sheet outside the picture, or give the number of"
            " sheets in view (`sheets`)"
        )
    spacing = math.nan if pixel_size_um is None else found.pitch_px * pixel_size_um / 1000
    if used is None and 1000 * spacing < LEAST_SPACING_UM:
        lines.append(
            f"with this pixel size, the sheets are {1000 * spacing:.2g} µm apart, closer than paper is thick:"
            " check `pixel_size_um` (µm)"
        )
    ratio = math.nan if used is None else spacing / (2 * used.thickness_mm)
    if used is not None and (ratio <= 1 / UNLIKELY_SPACING or ratio >= UNLIKELY_SPACING):
        lines.append(
            f"with this pixel size, sheets {used.thickness_mm:g} mm thick are {spacing:.3g} mm apart: check"
            " `pixel_size_um` (µm)"
        )
    if used is not None and most > used.sheets_per_block:
        how = "given" if sample is not None else "assumed"
        lines.append(
            f"{used.sheets_per_block} sheets per block and side {how}, but n reaches {most}: check"
            " `sheets_per_block`, `axis_px` and `sheets`"
        )
    return lines


def _comb_warnings(tracks: xr.Dataset, found: TrackMetadata) -> list[str]:
    """Warn of further or doubtful ridges of the comb, and of an axis that the motion excludes."""
    lines = []
    if found.ridges_beyond:
        lines.append(
            f"{found.ridges_beyond} more ridges continue the comb of the {found.sheets} sheets and would"
            f" change every n: give `sheets` as {found.sheets + found.ridges_beyond} or leave it out"
        )
    snr, share = tracks["snr"].values, tracks["found"].values
    weak = np.flatnonzero((snr < 0.1 * nan_median(snr)) | (share < 0.25))
    if len(weak) and found.sheets > 1:
        which = ", ".join(map(str, weak[:6])) + " …" * (len(weak) > 6)
        lines.append(
            f"{len(weak)} of {found.sheets} sheets (index {which}) may be something else (little contrast, or"
            " found in few frames): restrict `columns` or give `sheets`"
        )
    if not _motion_allows_axis(tracks, found):
        lines.append(
            f"the axis at {found.axis_px:.0f} px is outside the range that the motion allows"
            f" ({found.axis_low_px:.0f} to {found.axis_high_px:.0f} px): check `axis_px`, and whether both"
            " sides are in view"
        )
    return lines


def _motion_allows_axis(tracks: xr.Dataset, found: TrackMetadata) -> bool:
    """Return whether the axis is where the motion of the sheets allows it, or nothing is known of that.

    It lies between two sheets, half a pitch from both, and sheets may be unevenly spaced. With one side in
    view, it may lie anywhere beyond its end.
    """
    if not (math.isfinite(found.axis_low_px) and math.isfinite(found.axis_high_px)):
        return True
    slack, x_px = 0.75 * found.pitch_px, nan_median(tracks["x_px"].values)
    first, last = np.nanmin(x_px, initial=math.inf), np.nanmax(x_px, initial=-math.inf)
    low = -math.inf if found.axis_low_px <= first else found.axis_low_px - slack
    high = math.inf if found.axis_high_px >= last else found.axis_high_px + slack
    return bool(low <= found.axis_px <= high)


def shells_against_fits(
    shells: pd.DataFrame | None, fits: ModelFits | None, settings: ShellSettings
) -> list[str]:
    """Return a warning if M_eff of the fits contradicts the stiff shells that the video shows.

    An M_eff from k to k + 1 predicts k stiff sheets. A side on which all sheets in view are stiff gives no
    upper limit. Only the statistical error of Λ̂ is used, as an error of d0 shifts d and Λ̂ alike.
    """
    if shells is None or fits is None:
        return []
    known = shells[shells["stiff_sheets"].notna()]
    if len(known) < 3:  # so few may contradict by chance
        return []
    d_mm, scale = known["d_v_mm"].to_numpy(float), fits.scale_mm
    beyond = settings.fit_sigma * scale.error
    least, most = (
        effective_sheets(d_mm / max(scale.value + sign * beyond, 1e-9), sample=fits.sample)
        for sign in (-1, 1)
    )
    low, high = known["stiff_low"].to_numpy(float), known["stiff_high"].to_numpy(float)
    in_view = high < known["sheets_known"].to_numpy(float)
    outside = (most < low) | (in_view & (least >= high + 1))
    if outside.mean() <= settings.contradicted_share:
        return []
    fitted = np.median(fits.effective_sheets(d_mm[outside]))
    shell = f"{np.median(low[outside]):.0f} to {np.median(high[outside]):.0f} sheets"
    return [
        f"M_eff of the fits ({fitted:.1f}) lies outside the stiff shell's interval ({shell}) in"
        f" {outside.sum()} of {len(known)} stick phases and sides:"
        " check `d0_mm`, `pixel_size_um`, `axis_px`, the sample's geometry, `sheets_per_block` and"
        " `threshold`"
    ]


def unlike_sides(shells: pd.DataFrame | None, settings: ShellSettings) -> list[str]:
    """Return a warning if the stiff shells of the two sides differ by more than their errors.

    A difference of one sheet is not reported: sheets differ, and an axis one sheet aside makes it two.
    """
    if shells is None or shells["side"].nunique() < 2:
        return []
    names = ["stiff_sheets", "stiff_low", "stiff_high"]
    known = shells.dropna(subset="stiff_sheets").set_index("event")
    left, right = (known.loc[known["side"] == side, names].astype(float) for side in (-1, 1))
    left, right = left.align(right, join="inner", axis=0)
    one_larger = [
        ((one["stiff_low"] > other["stiff_high"]) & (one["stiff_sheets"] > other["stiff_sheets"] + 1)).sum()
        for one, other in ((left, right), (right, left))
    ]
    if len(left) < 3 or max(one_larger) <= settings.contradicted_share * len(left):
        return []
    sizes = (side["stiff_sheets"].median() for side in (left, right))
    return [
        "the stiff shell has {:.0f} sheets on the left but {:.0f} on the right".format(*sizes)
        + f" in {max(one_larger)} of {len(left)} stick phases: check `axis_px` and whether each sheet has a"
        " number, unless the sample is not symmetric"
    ]
