"""Accuracy of the subpixel fits against the best possible one.

Run from the checkout: python -m reports.accuracy
Writes reports/accuracy.md.
"""

from __future__ import annotations

import numpy as np

from reports.writing import head, row, write_report
from tests.scenes.combs import bound_px, ridges, strip
from vision.sheets.tracks import track_sheets

FRAMES, SNR, PITCH_PX = 2000, 100.0, 20.0
WIDTHS_PX = (6.0, 8.0, 10.0, 12.0, 14.0)
FITS = ("sliding", "template", "paper")


def drifting(frames: int) -> np.ndarray:
    """Return the positions (frame, 9) of an even comb that moves by three pixels."""
    return 120 + PITCH_PX * np.arange(9) + np.linspace(0, 3, frames)[:, None]


def of_width(fwhm_px: float) -> str:
    """Return bound, RMS error over the bound, and locking of each fit, as a line of the table."""
    truth = drifting(FRAMES)
    light = ridges(truth, width=420, fwhm_px=fwhm_px)
    cells = [f"{fwhm_px:.0f}", f"{1e3 * bound_px(fwhm_px, SNR):.1f}"]
    for fit in FITS:
        noisy = track_sheets(strip(light, snr=SNR), fit=fit, window_px=9)["x_px"].values
        clean = track_sheets(strip(light, snr=1e7), fit=fit, window_px=9)["x_px"].values
        inner = slice(1, -1)  # the outermost have a neighbour on one side only
        error = np.sqrt(np.nanmean((noisy - truth)[:, inner] ** 2))
        locking = np.nanmedian(np.ptp((clean - truth)[:, inner], axis=0))
        cells.append(f"{1e3 * error:.0f} ({error / bound_px(fwhm_px, SNR):.2f})")
        cells.append(f"{1e3 * locking:.1f}")
    return row(cells)


def main() -> None:
    """Measure and write the table."""
    columns = [name for fit in FITS for name in (fit, "its locking")]
    lines = [
        "# Accuracy of positions",
        "",
        f"RMS error in thousandths of a pixel; profile SNR {SNR:.0f}, pitch {PITCH_PX:.0f} px, window 9 px;",
        "in brackets its ratio to the Cramér–Rao bound (1/SNR) √(2σ_r/√π); and the locking to whole pixels,",
        f"peak to peak, without noise. {FRAMES} frames of seven sheets that cross three pixels.",
        "",
        *head(["FWHM (px)", "bound", *columns]),
        *map(of_width, WIDTHS_PX),
    ]
    write_report("accuracy", lines)


if __name__ == "__main__":
    main()
