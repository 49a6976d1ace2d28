"""Text of the report page: the methods paragraphs, and what to cite."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import xarray as xr

import vision
from vision.checks import DOUBTFUL, longest_stretches, why_left_out
from vision.clock import Clock
from vision.data import (
    FlagCounts,
    ForceMetadata,
    MotionMetadata,
    StickMetadata,
    StripMetadata,
    TrackMetadata,
    load_unit_text,
    parameters_of,
)
from vision.figures import Results
from vision.figures.style import drift_text, offset_text
from vision.force import ForceSettings
from vision.models import ModelFits
from vision.models.single_fits import has_knees
from vision.sheets.recovery import LONG_GAP, missing_stretches
from vision.summary import (
    RATE_SOURCES,
    axis_source,
    bad_frames,
    force_columns_text,
    load_correction,
    noise_figures,
    pixel_size_text,
)
from vision.systematics import QUANTITIES
from vision.video.reader import LOSSY

CITED = (
    f"sheetvision, version {vision.__version__} (positions of interleaved sheets from video).",
    "A. Plati, F. Restagno, C. Poulard, Stick-slip dynamics in an interleaved system with self-amplified "
    "friction.",
)
"""The program and the publication to cite."""
ANALYSED_WITH = f"The analysis was done with sheetvision {vision.__version__}."


def subtitle(results: Results) -> str:
    """Return a line that describes the recording."""
    taken = "" if results.force is None else force_columns_text(results.force)
    force = f"; force from {taken}" if taken else ""
    if results.strip is None:
        return f"a force recording without a video{force}"
    time = np.asarray(results.strip["time_s"].values, np.float64)
    known = time[np.isfinite(time)]
    span = f" over {known[-1] - known[0]:.4g} s" if known.size > 1 else ""
    size, error = results.pixel_size_um, results.pixel_size_err_um
    scale = "no pixel size given" if size is None else f"{pixel_size_text(size, error)} per px"
    frames, columns = results.strip.sizes["frame"], results.strip.sizes["x"]
    return f"{frames} frames{span}, {columns} columns, {scale}{force}"


# --- the methods paragraphs ---------------------------------------------------------------------------------


def methods(results: Results) -> list[str]:
    """Return paragraphs that describe the analysis, with the numbers used in this run."""
    paragraphs = []
    if results.strip is not None:
        paragraphs.append(_video(results.strip, results.pixel_size_um, results.pixel_size_err_um))
    if results.tracks is not None:
        paragraphs.append(_tracking(results.tracks))
    if results.force is not None and results.sticks is not None:
        paragraphs.append(_stick_phases(results.force, results.sticks))
    if results.clock is not None and results.clock.status != "ambiguous":
        paragraphs.append(_alignment(results.clock))
    if results.motion is not None:
        paragraphs.append(_deformation(results.motion, results.threshold))
    if results.fits is not None:
        paragraphs.append(_models(results.fits))
    return paragraphs


def _video(profile: xr.DataArray, pixel_size_um: float | None, pixel_size_err_um: float | None) -> str:
    strip = StripMetadata.of(profile)
    if not math.isfinite(strip.fps):
        rate = "a frame rate that is not known"
    elif strip.clock_file:
        rate = f"about {strip.fps:.4g} frames per second (with a time stamp each)"
    else:
        rate = f"{strip.fps:.6g} frames per second ({RATE_SOURCES[strip.clock_kind]})"
    scale, unknown = "", " The pixel size is not known."
    if pixel_size_um is not None:
        scale, unknown = f" at {pixel_size_text(pixel_size_um, pixel_size_err_um)} per pixel", ""
    chosen = {"given": "as given", "all rows": "the whole frame"}.get(strip.strip_how, "found automatically")
    tilt = (
        f" The ridges are tilted by {abs(strip.tilt_deg):.2f}°; the mean over the rows does not correct this."
        if math.isfinite(strip.tilt_deg)
        else ""
    )
    bad = f" ({bad})" if (bad := bad_frames(strip)) else ""
    return (
        f"The edges of the sheets were recorded at {rate}{scale}, with {strip.depth_bits} bits per pixel"
        f"{_compression(strip.codec)}.{unknown} In each of {strip.frames_read} frames{bad} the "
        f"intensity was averaged over {strip.strip_z1 - strip.strip_z0} rows (rows {strip.strip_z0} to "
        f"{strip.strip_z1}, {chosen}) to a profile I(x,t).{tilt}"
    )


def _compression(codec: str) -> str:
    """Return how the film is compressed, "" if not known."""
    if not codec:
        return ""
    if codec in LOSSY:
        return f" and lossy compression ({codec}), which alters and can hide the noise"
    return ", uncompressed" if codec in ("uncompressed", "rawvideo", "packed") else f", stored as {codec}"


def _tracking(tracks: xr.Dataset) -> str:
    t = TrackMetadata.of(tracks)
    method = {
        "sliding": "as the centre of the sliding window of {} pixels in which the slope of a least-squares "
        "parabola is zero",
        "paper": "as the vertex of a parabola fitted to {} pixels centred on the brightest pixel",
        "template": "by matching each ridge to its own mean shape over {} pixels",
    }[t.fit].format(t.window_px)
    figures = noise_figures(tracks, None)
    noise, error = figures["measured_px"], figures["stated_px"]
    scatter = (
        f" The positions scatter by {noise:.2g} px from frame to frame (median of the sheets); the random"
        f" error of one is {error:.2g} px (median)."
        if noise > 0
        else ""
    )
    axis = (
        f"n counts outwards from the symmetry axis at {t.axis_px:.1f} px ({axis_source(t)})"
        if math.isfinite(t.axis_px)
        else "the symmetry axis is not known"
    )
    count = t.corrections_applied
    made = "decisions were" if count > 1 else "decision was"
    decisions = f" {count} {made} made manually; see “Manual decisions”." if count else ""
    apart = f" and {t.spacing_px:.1f} px apart" if math.isfinite(t.spacing_px) else ""
    seen = (
        f"The {t.sheets} sheets appear as {t.ridges} ridges {t.ridge_fwhm_px:.1f} px wide{apart}. "
        f"Their positions x(n,t) were measured {method}. The sheets were "
        f"identified through slips by their order, spacing and brightness; {axis}."
        if t.sheets > 1
        else f"One sheet appears as a {t.ridges} ridge {t.ridge_fwhm_px:.1f} px wide. Its positions x(t) "
        f"were measured {method}."
    )
    return f"{seen}{scatter}{_withheld(tracks)}{decisions}"


def _withheld(tracks: xr.Dataset) -> str:
    """Return how many positions were left out or carry a flag, "" if there are none."""
    flags = FlagCounts(tracks)
    total, doubtful = flags.total(), flags.of(DOUBTFUL)
    other = total - flags["ok"] - doubtful
    text = ""
    if doubtful:
        text += f" {doubtful} of {total} positions were left out{why_left_out(flags)}."
    if other:
        where = longest_stretches(missing_stretches(tracks), "flag")
        text += f" {other} of {total} positions are missing or carry another flag (tracks.csv)"
        text += (f"; without a ridge for {LONG_GAP} frames or more: {where}" if where else "") + "."
    return text


def _stick_phases(force: xr.Dataset, sticks: pd.DataFrame) -> str:
    speed = ForceMetadata.of(force).speed_mm_min
    pulled = f" at {speed:.3g} mm/min" if math.isfinite(speed) else ""
    s = StickMetadata.of(sticks)
    source = {
        "noise": "a multiple of the noise",
        "jumps": "larger than most upward jumps of the load, which are no slips",
        "gap": "in a gap of the sizes of the drops above the noise",
        "given": "as given",
    }.get(s.threshold_how, s.threshold_how)
    unit = load_unit_text(force)
    line = "a line with a knee" if s.two_slopes else "a line"
    knees = " The models are fitted to the slope after the knee of each." if has_knees(sticks) else ""
    tuned = parameters_of(sticks, "find_stick_slip").get("settings", {})
    part = f"{100 * tuned.get('line_part', ForceSettings.line_part):.0f} %"
    stiffness = s.machine_stiffness_N_per_mm
    machine = f" d was corrected for a machine of {stiffness:g} N/mm." if math.isfinite(stiffness) else ""
    return (
        f"The traction force was recorded while the blocks were pulled apart{pulled}.{machine} Slips are "
        f"drops at which the lines fitted before and after differ by more than {s.threshold_N:.3g} {unit} "
        f"({source}; the noise is {s.noise_N:.2g} {unit}); {len(sticks)} stick phases were found. Peak and "
        f"valley forces F_p and F_v are those of {line} through the central {part} of each stick "
        "phase, extended to its ends but not beyond the recorded forces, and beside slow slips the recorded "
        f"extremes. The stiffness K is the slope of the central {100 * s.central_part:.0f} %."
        f"{knees} All forces are {load_correction(s)}."
    )


def _alignment(clock: Clock) -> str:
    if clock.status == "given":
        source = {
            "given": "a given offset",
            "video time column": "the camera's times in the force recording",
        }
        how = f"were aligned by {source.get(clock.how, clock.how)}"
    else:
        how = (
            f"were aligned by {clock.matched} slips seen in both (log-likelihood {clock.margin:.0f} above "
            f"the next best alignment, median residual {clock.residual_ms:.2g} ms)"
        )
    return (
        f"The clocks of camera and testing machine {how}: offset {offset_text(clock)}, drift "
        f"{drift_text(clock)}."
    )


def _deformation(motion: xr.Dataset, threshold: float) -> str:
    facts = MotionMetadata.of(motion)
    excluded = ""
    if math.isfinite(facts.margin_s):
        excluded = f", without frames within {1000 * facts.margin_s:.0f} ms of a slip"
    return (
        f"For each of {motion.sizes['event']} stick phases in the video{excluded}, the displacement of a "
        "sheet is δx = x − x̂, where x̂ is its mean position in the stick phase. σ_x is the root mean square "
        f"of δx, {facts.corrected_for}. A sheet counts as stiff if σ_x over the stick length is below "
        f"{threshold:g}."
    )


def _models(fits: ModelFits) -> str:
    sample, (first, last), used = fits.sample, fits.d_mm, fits.goodness["peaks"].points
    results = []
    for name in ("mu", "T0_N", "A", "N_hat_N", "Y_eff_GPa"):
        symbol, unit = QUANTITIES[name]
        equals = "" if name in fits.undetermined else "= "
        results.append(f"{symbol} {equals}{fits.text(name, unit)}")
    lacking = "; the latter without the error of d0, which is not known"
    if "d0_mm" in fits.input_errors:
        lacking = ""
    fitted = " (fitted)" if math.isfinite(fits.t_star_N.error) else ""
    given = [symbol for name, symbol in (("mu", "μ"), ("modulus_GPa", "Y_eff")) if name in fits.held]
    known = f" {' and '.join(given)} {'were' if len(given) > 1 else 'was'} given." if given else ""
    return (
        f"{used} stick phases from d = {first:.2f} to {last:.2f} mm were used. Their "
        "peak forces were fitted with Eq. 1 of the publication and a constant offset 𝒯_0, stick-slip "
        "amplitudes with A times the total normal force, and K with M_eff K_eff, for "
        f"{sample.sheets_per_block} sheets of each block on either side of the axis, "
        f"{sample.thickness_mm:g} mm thick and {sample.width_mm:g} mm wide, "
        f"{sample.length_mm:g} mm from clamp to end, and "
        f"T* = {1000 * fits.t_star_N.value:.3g} mN{fitted}: {', '.join(results)} "
        f"(statistical and systematic errors{lacking}).{known}"
    )
