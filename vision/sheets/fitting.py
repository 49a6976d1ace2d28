"""Fits for whole tables of sheets: window, blocks of frames, both cores."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.sheets.comb import Comb
from vision.sheets.subpixel import Fit, Starts, paper_vertex, sliding_vertex, template_shift

Doubles = NDArray[np.float64]
FitName = Literal["sliding", "paper", "template"]

STANDARD_WINDOW_PX = 9
STANDARD_WIDTHS_PX = (6.0, 14.0)  # ridges that the publication's window suits
WINDOW_PER_WIDTH = 1.4  # the parabola's best window: wider takes in the flanks, narrower the noise
FRAMES_PER_BLOCK = 512


def choose_window(comb: Comb, asked: int | Literal["auto"] | None) -> int:
    """Fit window in px, odd: as asked; 9 where ridges are 6–14 px wide; else 1.4 times their width, at least
    5.

    Raises: InputError for an even window, one below 3, or one that takes in the neighbouring ridges.
    """
    if isinstance(asked, int):
        if asked < 3 or asked % 2 == 0:
            raise InputError(
                "--window", "an odd number of pixels, 3 or more", str(asked), "try --window auto"
            )
        if asked > comb.pitch_px:
            near = f"a window no wider than the ridges' spacing, {comb.pitch_px:.0f} px"
            raise InputError("--window", near, str(asked), "try --window auto")
        return asked
    if asked is None and STANDARD_WIDTHS_PX[0] <= comb.fwhm_px <= STANDARD_WIDTHS_PX[1]:
        return STANDARD_WINDOW_PX
    widest = max(5.0, 0.9 * comb.pitch_px)
    return 2 * round((min(max(5.0, WINDOW_PER_WIDTH * comb.fwhm_px), widest) - 1) / 2) + 1


def fit_sheets(
    bright: NDArray[np.float32], start_px: Doubles, *, fit: FitName, window_px: int, comb: Comb
) -> tuple[Doubles, Doubles]:
    """Positions and their error per grey level of noise, both (frame, N), NaN where start_px is.

    Args: bright, profile with bright ridges (frame, x); start_px, whole pixels (frame, N).
    """
    x, err = np.full(start_px.shape, np.nan), np.full(start_px.shape, np.nan)

    def run(rows: slice) -> None:
        known = np.isfinite(start_px[rows])
        frame, sheet = np.nonzero(known)
        starts = Starts(frame, start_px[rows][known].astype(np.int64))
        done = _one_block(bright[rows], starts, fit, window_px, comb)
        x[rows][frame, sheet], err[rows][frame, sheet] = done

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(run, [slice(i, i + FRAMES_PER_BLOCK) for i in range(0, len(bright), FRAMES_PER_BLOCK)]))
    return _matched(bright, x, comb) if fit == "template" else (x, err)


def _one_block(profile: NDArray[np.float32], starts: Starts, fit: FitName, window_px: int, comb: Comb) -> Fit:
    if fit == "paper":
        return paper_vertex(profile, starts, window_px=window_px, search_px=max(2, round(comb.fwhm_px / 2)))
    return sliding_vertex(profile, starts, window_px=window_px)


def locking_error(
    x_px: Doubles, bright: NDArray[np.float32], start_px: Doubles, window_px: int, comb: Comb
) -> Doubles:
    """How far positions of the paper's fit lie from where the sliding slope is zero, px, (frame, N), 0 where
    unknown.

    The paper's fit locks to whole pixels by more than the noise; this is that error, as the recording itself
    shows it.
    """
    free, _ = fit_sheets(bright, start_px, fit="sliding", window_px=window_px, comb=comb)
    return np.nan_to_num(np.abs(x_px - free), nan=0.0)


def _matched(bright: NDArray[np.float32], x: Doubles, comb: Comb) -> tuple[Doubles, Doubles]:
    """Positions against each sheet's own mean shape, from those of the sliding window."""
    known = np.isfinite(x)
    frame, sheet = np.nonzero(known)
    half = max(3, round(min(0.9 * comb.fwhm_px, 0.5 * comb.pitch_px)))
    done = template_shift(
        bright, Starts(frame, np.rint(x[known]).astype(np.int64)), sheet, x[known], half_px=half
    )
    out, err = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
    out[known], err[known] = done
    return out, err
