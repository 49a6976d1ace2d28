"""Tracks and profiles of any size, made without tracking."""

import numpy as np
import xarray as xr


def make_tracks(x_px, *, fps=60.0, noise_px=0.01, pitch_px=20.0):
    """Tracks as `track_sheets` returns them, of these positions (frame, sheet)."""
    frames, sheets = x_px.shape
    n_left = sheets // 2
    index = np.arange(sheets)
    side = np.where(index < n_left, -1, 1)
    n = np.where(side < 0, n_left - index, index - n_left + 1)
    both = ("frame", "sheet")
    known = np.isfinite(x_px)
    return xr.Dataset(
        {
            "x_px": (both, x_px),
            "x_err_px": (both, np.where(known, noise_px, np.nan)),
            "flag": (both, np.where(known, "ok", "missing")),
            "x_mean_px": ("sheet", np.nan_to_num(x_px[0])),
            "found": ("sheet", known.mean(axis=0)),
            "fwhm_px": ("sheet", np.full(sheets, 8.0)),
            "snr": ("sheet", np.full(sheets, 100.0)),
            "x_noise_px": ("sheet", np.full(sheets, noise_px)),
        },
        {
            "frame": np.arange(frames),
            "time_s": ("frame", np.arange(frames) / fps),
            "sheet": index,
            "side": ("sheet", side),
            "n": ("sheet", n),
        },
        {
            "ridges": "bright",
            "ridge_fwhm_px": 8.0,
            "pitch_px": pitch_px,
            "profile_noise": 1.0,
            "window_px": 9,
            "sheets": sheets,
            "axis_px": pitch_px * sheets / 2,
            "axis_how": "motion",
            "axis_low_px": 590.0,
            "axis_high_px": 610.0,
            "ridges_dropped": 0,
            "least_margin": 100.0,
            "fit": "sliding",
            "strip_z0": 60,
            "strip_z1": 144,
            "clock_kind": "given",
        },
    )


def make_profile(tracks, width, *, seed=0):
    """A noisy I(x, t) of the tracks' length, as `strip_profile` returns it; without ridges."""
    frames = tracks.sizes["frame"]
    rng = np.random.default_rng(seed)
    block = rng.normal(100, 20, (min(frames, 997), width)).astype(np.float32)
    return xr.DataArray(
        np.resize(block, (frames, width)),
        dims=("frame", "x"),
        coords={
            "frame": np.arange(frames),
            "x": np.arange(width),
            "time_s": tracks["time_s"],
            "status": ("frame", np.full(frames, "ok")),
        },
        attrs={
            "source": "made.avi",
            "depth_bits": 8,
            "strip_z0": 60,
            "strip_z1": 144,
            "strip_how": "given",
            "tilt_deg": 0.1,
            "clock_kind": "given",
            "fps": 60.0,
            "frames_expected": frames,
            "frames_read": frames,
            "frames_lost": 0,
            "frames_blank": 0,
            "frames_corrupt": 0,
            "warnings": "",
        },
    )


def sawtooth(frames, sheets, *, period=50, jump_px=4.0, pitch_px=20.0, noise_px=0.01, seed=0):
    """Positions (frame, sheet): inward creep and outward jumps, larger at the outside."""
    n = np.arange(sheets) - (sheets - 1) / 2
    phase = (np.arange(frames) / period) % 1
    noise = np.random.default_rng(seed).normal(0, noise_px, (frames, sheets))
    middle = pitch_px * sheets / 2
    return middle + n * pitch_px - (phase[:, None] - 0.5) * jump_px * n / n.max() + noise
