"""Tracking a long film needs little memory beside I(x, t)."""

import tracemalloc

import numpy as np
import pytest

from tests.scenes.combs import as_strip, comb, ridges, strip
from vision.sheets import track_sheets

FRAMES, SHEETS = 20_000, 24  # in shorter films the largest part does not grow with the film
MOST_TABLES = 11.8  # 10.8 here; copies in every stage made 34


@pytest.mark.thorough
def test_tracking_holds_few_tables_of_frames_and_sheets():
    """A failure means that long films fill the memory of a computer that could track them."""
    few = strip(ridges(comb(100, per_side=SHEETS // 2, axis_px=260), width=520)).values
    noise = np.random.default_rng(1).normal(0, 0.3, (FRAMES, few.shape[1])).astype(np.float32)
    film = as_strip(np.tile(few, (FRAMES // len(few), 1)) + noise)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    try:
        tracks = track_sheets(film)
        held, peak = (size - before for size in tracemalloc.get_traced_memory())
    finally:
        tracemalloc.stop()
    table = 8 * FRAMES * SHEETS
    assert tracks.sizes == {"frame": FRAMES, "sheet": SHEETS}
    assert peak / table < MOST_TABLES
    assert held / table < 5
