"""What a run says about itself: ten lines, its warnings, and the facts of run.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vision.run.provenance import Parameter, versions

if TYPE_CHECKING:
    import xarray as xr

MISSING_SHARE = 0.01  # of all positions: more than this missing is a warning that matters


def warnings_that_matter(profile: xr.DataArray, tracks: xr.Dataset) -> list[str]:
    """Warnings that set the exit status to 1: lost, blank or corrupt frames, doubtful identities, many
    missing, sheets perhaps overlooked."""
    lines = [line for line in str(profile.attrs.get("warnings", "")).split("\n") if line]
    flags = flag_counts(tracks)
    total = max(1, sum(flags.values()))
    unsure = flags.get("doubtful", 0) + flags.get("merged", 0)
    if unsure:
        lines.append(f"{unsure} of {total} positions not given because the sheet's identity is in doubt")
    gone = flags.get("missing", 0) + flags.get("edge", 0) + flags.get("unfit", 0)
    if gone > MISSING_SHARE * total:
        lines.append(f"{gone} of {total} positions missing (flags missing, edge, unfit in tracks.csv)")
    if tracks.attrs.get("wide_spacings"):
        where = tracks.attrs["wide_spacings"]
        lines.append(f"sheets may be missing at x = {where}: look there, or give their number (--sheets)")
    return lines


def flag_counts(tracks: xr.Dataset) -> dict[str, int]:
    """How often each flag occurs."""
    names, counts = np.unique(tracks["flag"].values, return_counts=True)
    return {str(name): int(count) for name, count in zip(names, counts, strict=True)}


def findings(profile: xr.DataArray, tracks: xr.Dataset) -> dict[str, Any]:
    """What the program found by itself."""
    a, t = profile.attrs, tracks.attrs
    return {
        "strip": {"z0": a["strip_z0"], "z1": a["strip_z1"], "how": a["strip_how"], "tilt_deg": a["tilt_deg"]},
        "clock": {"kind": a["clock_kind"], "fps": a["fps"]},
        "ridges": {"polarity": t["ridges"], "fwhm_px": t["ridge_fwhm_px"], "pitch_px": t["pitch_px"]},
        "sheets": {"count": t["sheets"], "other_ridges_left_out": t["ridges_dropped"]},
        "axis": {
            "px": t["axis_px"],
            "how": t["axis_how"],
            "low_px": t["axis_low_px"],
            "high_px": t["axis_high_px"],
        },
        "window_px": t["window_px"],
        "profile_noise_grey": t["profile_noise"],
        "least_identity_margin_nats": t["least_margin"],
    }


def run_facts(
    command: str,
    inputs: Sequence[Mapping[str, Any]],
    profile: xr.DataArray,
    tracks: xr.Dataset,
    options: Mapping[str, Parameter],
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """Everything run.json holds.  inputs: from `describe_input`."""
    known = ("frames_expected", "frames_read", "frames_lost", "frames_blank", "frames_corrupt")
    parts = {
        "strip_z0",
        "strip_z1",
        "strip_how",
        "tilt_deg",
        "clock_kind",
        "fps",
        "warnings",
        "units",
        "long_name",
    }
    return {
        "command": command,
        "versions": versions(),
        "parameters": options,
        "found": findings(profile, tracks),
        "inputs": list(inputs),
        "recording": {k: v for k, v in profile.attrs.items() if k not in parts and k not in known},
        "frames": {name.removeprefix("frames_"): profile.attrs[name] for name in known},
        "positions": flag_counts(tracks),
        "noise": noise_figures(tracks, options["pixel_size"].value),
        "warnings": warnings_that_matter(profile, tracks),
        "seconds": dict(seconds),
    }


def noise_figures(tracks: xr.Dataset, pixel_size_um: float | None) -> dict[str, float]:
    """Median over the sheets of the predicted and of the measured noise of a position."""
    measured = _median(tracks["x_noise_px"].values)
    predicted = _median(tracks["x_err_px"].values)
    figures = {"measured_px": measured, "predicted_px": predicted}
    if pixel_size_um is not None:
        figures |= {"measured_um": measured * pixel_size_um, "predicted_um": predicted * pixel_size_um}
    return figures


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def summary_lines(
    target: Path, profile: xr.DataArray, tracks: xr.Dataset, options: Mapping[str, Parameter]
) -> list[str]:
    """Ten lines: sheets, frames, positions, noise, what was found by itself, where the results are."""
    a, t = profile.attrs, tracks.attrs
    side = tracks["side"].values
    size = options["pixel_size"].value
    noise = noise_figures(tracks, size)
    length = "" if size is None else f" = {noise['measured_um']:.3f} µm"
    flags = flag_counts(tracks)
    other = ", ".join(f"{count} {name}" for name, count in flags.items() if name != "ok") or "none missing"
    tilt = "" if not np.isfinite(a["tilt_deg"]) else f", lean {a['tilt_deg']:+.2f}°"
    corrupt = f" ({a['frames_corrupt']} of them corrupt)" if a["frames_corrupt"] else ""
    return [
        f"sheets     {t['sheets']} {t['ridges']} ridges ({(side < 0).sum()} left, {(side > 0).sum()} right)"
        f"; {t['ridges_dropped']} other ridges left out",
        f"frames     {a['frames_read']} of {a['frames_expected']} read; {a['frames_lost']} lost{corrupt}, "
        f"{a['frames_blank']} blank",
        f"positions  {flags.get('ok', 0)} measured; {other}",
        f"noise      {noise['measured_px']:.4f} px{length} measured, "
        f"{noise['predicted_px']:.4f} px predicted",
        f"strip      rows {a['strip_z0']}:{a['strip_z1']} ({a['strip_how']}){tilt}",
        f"ridges     {t['ridge_fwhm_px']:.1f} px wide, {t['pitch_px']:.1f} px apart; {t['fit']} fit over "
        f"{t['window_px']} px",
        f"axis       {t['axis_px']:.1f} px ({_axis(t)})",
        f"clock      {_clock(a)}",
        f"scale      {'px: give --pixel-size for µm' if size is None else f'{size:g} µm per px'}",
        f"results    {target}/ (look at overview.png first)",
    ]


def _axis(attrs: Mapping[str, Any]) -> str:
    if attrs["axis_how"] == "given":
        return "given"
    how = {"motion": "found from motion", "geometry": "the middle of the ridges in view"}[attrs["axis_how"]]
    if not np.isfinite(attrs["axis_low_px"]):
        return f"{how}; no motion to tell it from"
    return f"{how}; motion allows {attrs['axis_low_px']:.0f} to {attrs['axis_high_px']:.0f}"


def _clock(attrs: Mapping[str, Any]) -> str:
    if not np.isfinite(attrs["fps"]) and attrs["clock_kind"] == "playback":
        return "the file holds no frame rate: give the camera's with --fps"
    rate = f"{attrs['fps']:g} frames/s"
    kinds = {
        "playback": f"{rate} is the file's playback rate: confirm it or give the camera's with --fps",
        "file": f"{rate}, from the recording's own time stamps",
        "given": f"{rate}, as given",
    }
    return kinds[attrs["clock_kind"]]
