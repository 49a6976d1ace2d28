"""How well a certificate predicts the errors that a recording truly has.

Run from the checkout: python -m reports.certify
Writes reports/certify.md.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

from tests.scenes.degraded import CODECS, DEGRADATIONS, SCENE, clean
from vision.certify import CertifySettings, certify
from vision.certify.encoder import read_encoder
from vision.data import StripMetadata
from vision.experiment import preset, profiles, with_settings
from vision.numeric import Floats
from vision.sheets import FitName, track_sheets
from vision.video import open_video, strip_profile

SEEDS = (31, 32, 33)
FULL_WELLS = (20000, 4000, 1000)
WIDTHS_PX = (6, 8, 11)
FITS: tuple[FitName, ...] = ("sliding", "template", "paper")
SETTINGS = CertifySettings(films=1, largest_jump=1.0)


def ratio(
    strip: xr.DataArray, truth_px: Floats, fit: FitName = "sliding", film: Path | None = None
) -> tuple[float, float, bool]:
    """Return the RMS error of displacements, px, the predicted one over it, and whether it is uncertain."""
    tracks = track_sheets(strip, fit=fit)
    error = np.where(tracks["flag"].values == "ok", tracks["x_px"].values, np.nan) - truth_px
    error[np.abs(error) > 0.5 * np.median(np.diff(truth_px[0]))] = (
        np.nan
    )  # wrong identities are counted in degraded.md
    actual = float(np.sqrt(np.nanmean((error - np.nanmean(error, axis=0)) ** 2)))
    facts = StripMetadata.of(strip)
    rows, columns = (facts.strip_z0, facts.strip_z1), (0, strip.sizes["x"])
    encoder = None if film is None else read_encoder(film, rows, columns)
    found = certify(strip, tracks, encoder=encoder, settings=SETTINGS)
    return actual, found.error_px / actual, found.uncertain


def drawn_rows() -> list[str]:
    """Return a line of the table for each width and noise of the ridges, with every fit."""
    rows = []
    for width in WIDTHS_PX:
        for well in FULL_WELLS:
            changes = {**SCENE, "optics.fwhm_px": width, "camera.full_well_e": well}
            films = [profiles(with_settings(preset("paper", seed=seed), changes)) for seed in SEEDS]
            cells = []
            for fit in FITS:
                found = [ratio(strip, truth["x_px"].values, fit) for strip, truth in films]
                cells.append(_cell(found))
            rows.append(f"| {width} | {well} | " + " | ".join(cells) + " |")
    return rows


def filmed_rows() -> list[str]:
    """Return a line of the table for each codec and each degradation."""
    rows = []
    cases = [(name, clean, name) for name in CODECS]
    cases += [(name, DEGRADATIONS[name], "FFV1") for name in DEGRADATIONS if name != "none"]
    cases += [("vibration, H.264 crf 23", DEGRADATIONS["vibration"], "H.264 crf 23")]
    for name, make, codec in cases:
        found = []
        for seed in SEEDS:
            film = make(seed)
            with tempfile.TemporaryDirectory() as folder:
                path = CODECS[codec](Path(folder), film.pixels)
                strip = strip_profile(open_video(path))
                frames = min(len(film.truth_px), strip.sizes["frame"])
                middle = np.nanmedian(track_sheets(strip)["x_px"].values, axis=0)
                sheet = np.argmin(np.abs(middle[:, None] - np.median(film.truth_px, axis=0)), axis=1)
                part = strip.isel(frame=slice(0, frames))
                found.append(ratio(part, film.truth_px[:frames][:, sheet], film=path))
        rows.append(f"| {name} | {_cell(found)} |")
    return rows


def _cell(found: list[tuple[float, float, bool]]) -> str:
    actual = np.sqrt(np.mean([error**2 for error, _, _ in found]))
    shares = (f"{'~ ' if bound else ''}{share:.2f}" for _, share, bound in found)
    return f"{1e3 * actual:.1f}: " + ", ".join(shares)


def main() -> None:
    """Measure and write the tables."""
    lines = [
        "# Certificates against the truth",
        "",
        "Actual RMS error of displacements in thousandths of a pixel, then the error that `track certify`",
        f"predicts over the actual one, for seeds {', '.join(map(str, SEEDS))}. Wanted: 0.85 to 1.15.",
        "Films of 120 frames with 26 sheets as in degraded.md; the certificate sees the film, not the truth.",
        "",
        "| FWHM (px) | full well (e⁻) | " + " | ".join(FITS) + " |",
        "|---" * (2 + len(FITS)) + "|",
        *drawn_rows(),
        "",
        "Written to files and read back, sliding fit:",
        "",
        "| film | actual: predicted / actual |",
        "|---|---|",
        *filmed_rows(),
        "",
        "The errors are those of positions called ok. Films of codecs that carry content from frame to",
        "frame are encoded again with the settings of the recording. Frozen, dropped and repeated frames",
        "and steps of the brightness are in the films where the recording has them. Dirt, a highlight or a",
        "hand that distorts ridges is in the films, too, as far as the run detected it. The true position",
        "is then known only from the sheets around, and the certificate calls its number approximate (~).",
        "",
        "Made by `python -m reports.certify`.",
    ]
    text = "\n".join(lines) + "\n"
    (Path(__file__).parent / "certify.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
