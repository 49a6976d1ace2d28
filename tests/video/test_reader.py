import numpy as np
import pytest

from vision.video.reader import Frame, frames_per_block, gather_blocks, luma


def test_single_frames_become_blocks_in_order():
    """Failure: frames are lost between two blocks, cut at the wrong place, or take a neighbour's status."""
    pixels = np.arange(600, dtype=np.uint16)[:, np.newaxis, np.newaxis] + 10 * np.arange(6).reshape(2, 3)
    frames = [Frame(None, "corrupt", 0.1) if n == 400 else Frame(p) for n, p in enumerate(pixels)]
    cut = {"rows": slice(1, 2), "columns": slice(0, 2)}
    first, *others = gather_blocks(frames, start=7, dtype=np.uint16, **cut)
    assert (first.start, first.times_s) == (7, None)
    assert sum(len(block.status) for block in (first, *others)) == 600
    found = np.concatenate([block.pixels for block in (first, *others)])
    assert np.array_equal(np.delete(found, 400, axis=0), np.delete(pixels[:, 1:2, 0:2], 400, axis=0))
    (holder,) = [block for block in others if "corrupt" in block.status]
    place = holder.status.index("corrupt")
    assert holder.start + place == 7 + 400
    assert np.flatnonzero(np.isfinite(holder.times_s)).tolist() == [place]


def test_blocks_stay_small():
    """Failure: memory grows with the size of a frame, or a large frame makes a block of none."""
    assert frames_per_block(1, 1, 1) == 256
    assert frames_per_block(1000, 1000, 2) * 2_000_000 <= 4 << 20
    assert frames_per_block(100_000, 100_000, 2) == 1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_luma_of_grey_is_that_grey(dtype):
    """Failure: grey recordings stored as colour come out brighter or darker."""
    grey = np.arange(240, dtype=dtype).reshape(12, 20)
    assert np.allclose(luma(np.stack([grey] * 4, axis=-1)), grey, rtol=1e-6)
