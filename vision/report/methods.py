"""The methods paragraph with the run's own parameters, and what to cite."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import vision
from vision.report.force_charts import load_unit
from vision.report.numbers import plus_minus, signed
from vision.report.results import RunResults

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from vision.clock import Clock
    from vision.models.fits_result import ModelFits

PAPER = (
    "A. Plati, F. Restagno, C. Poulard, Stick-slip dynamics in an interleaved system with self-amplified "
    "friction."
)


def methods(results: RunResults) -> list[str]:
    """Paragraphs that say what was done, every number the one used in this run."""
    paragraphs = [_video(results), _tracking(results)]
    if results.force is not None and results.sticks is not None:
        paragraphs.append(_stick_phases(results.force, results.sticks))
    if results.clock is not None and results.clock.status != "ambiguous":
        paragraphs.append(_clocks(results.clock))
    if results.motion is not None:
        paragraphs.append(_deformation(results.motion, results.threshold))
    if results.fits is not None:
        paragraphs.append(_models(results.fits))
    return paragraphs


def citation(results: RunResults) -> list[str]:
    """The program and the publication whose method it follows."""
    return [f"sheetvision, version {vision.__version__} (positions of interleaved sheets from video).", PAPER]


def _video(results: RunResults) -> str:
    a = results.profile.attrs
    rate = {
        "playback": "{} frames per second (the file's playback rate)",
        "file": "{} frames per second (the recording's own time stamps)",
        "given": "{} frames per second",
    }[a["clock_kind"]]
    speed = rate.format(f"{a['fps']:.6g}") if math.isfinite(a["fps"]) else "an unknown frame rate"
    scale = "" if results.pixel_size_um is None else f" at {results.pixel_size_um:g} µm per pixel"
    rows = int(a["strip_z1"]) - int(a["strip_z0"])
    return (
        f"The edges of the sheets were recorded at {speed}{scale}, {a['depth_bits']} bits deep. In each "
        f"of {a['frames_read']} frames the intensity was averaged over {rows} rows (rows {a['strip_z0']} "
        f"to {a['strip_z1']}, {'given' if a['strip_how'] == 'given' else 'found from the picture'}) to a "
        "profile I(x,t)."
    )


def _tracking(results: RunResults) -> str:
    t = results.tracks.attrs
    how = {
        "sliding": "where the slope of a least-squares parabola over {} pixels, slid along x, is zero",
        "paper": "at the vertex of a parabola fitted to {} pixels centred on the brightest pixel",
        "template": "by matching each ridge to its own mean shape over {} pixels",
    }[t["fit"]].format(t["window_px"])
    noise = float(results.tracks["x_noise_px"].median())
    told = (
        f" The positions scatter by {noise:.2g} px from frame to frame (median of the sheets)."
        if noise > 0
        else ""
    )
    origin = {
        "given": "given",
        "motion": "found from motion",
        "geometry": "the middle of the ridges in view",
    }[t["axis_how"]]
    axis = f" at {t['axis_px']:.1f} px ({origin})" if math.isfinite(t["axis_px"]) else ""
    return (
        f"The {t['sheets']} sheets appear as {t['ridges']} ridges {t['ridge_fwhm_px']:.1f} px wide and "
        f"{t['pitch_px']:.1f} px apart. Their positions x(n,t) were placed {how}; identities were kept "
        "through slips from the order of the sheets, their spacing and their brightness, and n counts "
        f"outwards from the symmetry axis{axis}.{told} The analysis was done with sheetvision "
        f"{vision.__version__}."
    )


def _stick_phases(force: xr.Dataset, sticks: pd.DataFrame) -> str:
    speed = float(force.attrs.get("speed_mm_min", math.nan))
    pulled = f" at {speed:.3g} mm/min" if math.isfinite(speed) else ""
    facts = sticks.attrs
    how = {
        "noise": "a multiple of the noise",
        "gap": "where the sizes of the drops leave a gap above the noise",
        "given": "as given",
    }[facts["threshold_how"]]
    unit = "of the weight" if load_unit(force) == "1" else load_unit(force)
    return (
        f"The traction force was recorded while the blocks were pulled apart{pulled}. Slips are drops of "
        f"more than {facts['threshold_N']:.3g} {unit} ({how}; the noise is {facts['noise_N']:.2g}), placed "
        f"at the steepest fall; {len(sticks)} stick phases were found. Peak and valley forces F_p and F_v "
        "are those of the line through the central 80 % of each stick, extended to its ends; the "
        f"stiffness K is the slope of the central {100 * facts['central_part']:.0f} %.{_undone(facts)}"
    )


def _undone(facts: Mapping[Any, Any]) -> str:
    if not facts["lowpass_s"]:
        return ""
    how = "seen in the tails of the slips" if facts["lowpass_how"] == "found" else "as given"
    return (
        f" The force chain's response, a first-order low-pass of {1e3 * facts['lowpass_s']:.2g} ms ({how}), "
        "was taken off all of these."
    )


def _clocks(clock: Clock) -> str:
    if clock.status == "given":
        source = {"given": "a given offset", "video time column": "the camera's time kept by the machine"}
        how = f"were aligned by {source.get(clock.how, clock.how)}"
    else:
        how = (
            f"were aligned on {clock.matched} slips seen in both (log-likelihood {clock.margin:.0f} above "
            f"the next alignment, median residual {clock.residual_ms:.2g} ms)"
        )
    return (
        f"The clocks of camera and testing machine {how}: offset {clock.offset_s:.4f} s, drift "
        f"{signed(clock.drift_ppm)} ppm."
    )


def _deformation(motion: xr.Dataset, threshold: float) -> str:
    margin = float(motion.attrs.get("margin_s", math.nan))
    kept = f", frames within {1000 * margin:.0f} ms of a slip left out" if math.isfinite(margin) else ""
    return (
        f"For each of {motion.sizes['event']} stick phases inside the video{kept}, the displacement of a "
        "sheet is δx = x − x̂ with x̂ its mean over the stick, and σ_x its root mean square, with the "
        "camera's noise and what all sheets share taken off. A sheet counts as stiff where σ_x over the "
        f"stick length is below {threshold:g}."
    )


def _models(fits: ModelFits) -> str:
    given = fits.assembly
    return (
        "Peak forces were fitted with Eq. 1 of the publication and a constant offset, stick-slip "
        "amplitudes with A times the total normal force, and K with M_eff K_eff, for "
        f"{given.sheets_per_side} sheets a side {given.thickness_mm:g} mm thick and {given.width_mm:g} mm "
        f"wide, {given.length_mm:g} mm from clamp to end, and T* = {1000 * fits.t_star_N.value:.3g} mN: μ "
        f"= {plus_minus(fits.mu)}, A = "
        f"{plus_minus(fits.amplitude)}, N̂ = "
        f"{plus_minus(fits.n_hat_N)} N, Y_eff = "
        f"{plus_minus(fits.modulus_GPa)} GPa (standard errors)."
    )
