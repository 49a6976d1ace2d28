"""The methods paragraph with the run's own parameters, and what to cite."""

from __future__ import annotations

import math

import vision
from vision.report.results import RunResults

PAPER = (
    "A. Plati, F. Restagno, C. Poulard, Stick-slip dynamics in an interleaved system with self-amplified "
    "friction."
)


def methods(results: RunResults) -> list[str]:
    """Paragraphs that say what was done, every number the one used in this run."""
    return [_video(results), _tracking(results)]


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
        f"The edges of the sheets were recorded at {speed}{scale}, {a['depth_bits']} bits deep. In each of "
        f"{a['frames_read']} frames the intensity was averaged over {rows} rows (rows {a['strip_z0']} to "
        f"{a['strip_z1']}, {'given' if a['strip_how'] == 'given' else 'found from the picture'}) to a "
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
    axis = "given" if t["axis_how"] == "given" else f"found from {t['axis_how']}"
    return (
        f"The {t['sheets']} sheets appear as {t['ridges']} ridges {t['ridge_fwhm_px']:.1f} px wide and "
        f"{t['pitch_px']:.1f} px apart. Their positions x(n,t) were placed {how}; identities were kept "
        "through slips "
        "from the order of the sheets, their spacing and their brightness, and n counts outwards from "
        "the symmetry "
        f"axis at {t['axis_px']:.1f} px ({axis}).{told} The analysis was done with sheetvision "
        f"{vision.__version__}."
    )
