"""Positions and identities beside those of programs that laboratories use on such films.

Run from the checkout, where `pip install '.[bench]'` has installed them: python -m reports.others
Writes reports/others.md.
"""

from __future__ import annotations

import warnings
from importlib.metadata import version

import lumicks.pylake as lk
import numpy as np
import pandas as pd
import trackpy
import xarray as xr
from lumicks.pylake.kymo import _kymo_from_array
from numpy.typing import NDArray
from scipy.signal import find_peaks

from reports.writing import head, row, write_report
from tests.scenes.combs import BACKGROUND, CONTRAST, bound_px, comb, ridges, strip
from vision.sheets.tracks import track_sheets

FRAMES, PITCH_PX, FWHM_PX = 150, 20.0, 8.0
WINDOW_PX = 9  # as wide as a ridge; every program gets it
FILMS = ((0.3, 100.0), (0.7, 100.0), (0.7, 30.0), (1.2, 100.0))  # slip of the outermost in pitches, SNR
Positions = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]
"""Frame, position in pixels and number of the sheet that a program gives it."""


def sheetvision(film: xr.DataArray) -> Positions:
    """Track without any option."""
    x_px = track_sheets(film)["x_px"].values
    frame, sheet = np.nonzero(np.isfinite(x_px))
    return frame, x_px[frame, sheet], sheet


def loop(film: xr.DataArray) -> Positions:
    """Fit parabolas at local maxima, and give each ridge the number of the nearest in the frame before."""
    offsets, half = np.arange(WINDOW_PX) - WINDOW_PX // 2, WINDOW_PX // 2
    found = []
    for n, profile in enumerate(film.values.astype(float)):
        for peak in find_peaks(profile[half:-half], prominence=CONTRAST / 3, distance=half)[0] + half:
            c2, c1, _ = np.polyfit(offsets, profile[peak - half : peak + half + 1], 2)
            found.append((n, peak - c1 / (2 * c2)))
    return _linked(pd.DataFrame(found, columns=["frame", "x"]))


def centre_of_mass(film: xr.DataArray) -> Positions:
    """Let trackpy find and link spots of the profiles."""
    found = [
        trackpy.locate(profile, WINDOW_PX, separation=PITCH_PX / 2, engine="python").assign(frame=n)
        for n, profile in enumerate(film.values.astype(float))
    ]
    return _linked(pd.concat(found))


def _linked(found: pd.DataFrame) -> Positions:
    linked = trackpy.link(found, search_range=PITCH_PX / 2 - 1, memory=2, pos_columns=["x"])
    return linked["frame"].to_numpy(), linked["x"].to_numpy(), linked["particle"].to_numpy()


def _greedy(film: xr.DataArray) -> lk.kymotracker.kymotrack.KymoTrackGroup:
    kymograph = _kymo_from_array(film.values.T.astype(float), "r", line_time_seconds=0.04, pixel_size_um=1.0)
    level = BACKGROUND + CONTRAST / 2
    return lk.track_greedy(kymograph, "red", track_width=float(WINDOW_PX), pixel_threshold=level, window=3)


def pylake_centroid(film: xr.DataArray) -> Positions:
    """Let pylake track the ridges of the kymograph and refine them by their centroids."""
    return _of_tracks(lk.refine_tracks_centroid(_greedy(film), track_width=float(WINDOW_PX)))


def pylake_gaussian(film: xr.DataArray) -> Positions:
    """Let pylake fit Gaussians."""
    how = {"window": WINDOW_PX // 2, "refine_missing_frames": False, "overlap_strategy": "multiple"}
    return _of_tracks(lk.refine_tracks_gaussian(_greedy(film), **how))


def _of_tracks(tracks: lk.kymotracker.kymotrack.KymoTrackGroup) -> Positions:
    frame = np.concatenate([np.asarray(track.time_idx) for track in tracks]).astype(int)
    place = np.concatenate([np.asarray(track.position) for track in tracks])
    return frame, place, np.concatenate([np.full(len(t.time_idx), k) for k, t in enumerate(tracks)])


PROGRAMS = {
    "sheetvision": sheetvision,
    "find_peaks and polyfit, nearest": loop,
    "trackpy, nearest": centre_of_mass,
    "pylake, greedy and centroid": pylake_centroid,
    "pylake, greedy and Gaussian": pylake_gaussian,
}


def score(positions: Positions, truth: NDArray[np.float64]) -> list[str]:
    """Return sheets followed through all frames under one number, positions under the number of another
    sheet, and the RMS error about the sheet's mean error."""
    frame, place, number = positions
    nearest = np.abs(place[:, np.newaxis] - truth[frame]).argmin(axis=1)
    table = pd.DataFrame({"frame": frame, "number": number, "sheet": nearest})
    table["error"] = place - truth[frame, nearest]
    table = table[table["error"].abs() < PITCH_PX / 4].sort_values("frame")
    first = table.groupby("number")["sheet"].transform("first")
    right = table[table["sheet"] == first]
    whole = right.groupby(["sheet", "number"])["frame"].nunique().groupby("sheet").max() == len(truth)
    error = table["error"] - table.groupby("sheet")["error"].transform("mean")
    return [
        f"{whole.sum()} of {truth.shape[1]}",
        f"{100 * np.mean(table['sheet'] != first):.1f} %",
        f"{1e3 * np.sqrt(np.mean(error**2)):.0f}",
    ]


def of_film(slip: float, snr: float) -> list[str]:
    """Return a line of the table for each program."""
    truth = comb(FRAMES, per_side=12, axis_px=300, slip=slip, uneven=0.1)
    film = strip(ridges(truth, width=600, fwhm_px=FWHM_PX), snr=snr)
    return [row([slip, f"{snr:.0f}", name, *score(of(film), truth)]) for name, of in PROGRAMS.items()]


def main() -> None:
    """Measure and write the table."""
    warnings.simplefilter("ignore")
    trackpy.quiet()
    bounds = " and ".join(f"{1e3 * bound_px(FWHM_PX, snr):.0f} (SNR {snr:.0f})" for snr in (100.0, 30.0))
    columns = ["slip (pitches)", "SNR", "program", "sheets whole", "of another sheet", "RMS error (10⁻³ px)"]
    film = f"24 ridges of a pitch of {PITCH_PX:.0f} px and a FWHM of {FWHM_PX:.0f} px, {FRAMES} frames"
    used = f"trackpy {version('trackpy')} and pylake {version('lumicks.pylake')}"
    lines = [
        "# Beside other programs",
        "",
        f"I(x, t) drawn from known positions: {film},",
        "in which the outermost sheets slip five times by so many pitches from one frame to the next, and",
        "those inside by less. The other programs are told the width of a ridge, and half the pitch as the",
        "reach of linking; sheetvision is told nothing.",
        f"{used} find centres of mass of each profile and link them, and",
        "track ridges of the kymograph and refine the tracks. Sheets whole: found in all frames under one",
        "number. Of another sheet: positions under a number that began as another sheet. Errors are",
        f"those about each sheet's mean error; no unbiased fit is below {bounds}.",
        "",
        *head(columns),
        *(line for slip, snr in FILMS for line in of_film(slip, snr)),
    ]
    write_report("others", lines)


if __name__ == "__main__":
    main()
