"""The boundary of a shell without a threshold."""

import numpy as np

from tests.scenes.shells import ideal
from vision.shells import classify_shells


def test_breakpoint_needs_no_threshold():
    """A failure means that the alternative boundary is not where the creep sets in."""
    n = np.arange(1, 26)
    knees = np.array([4.0, 8.0, 13.5, 20.0])
    ratio = 0.05 + 0.03 * np.maximum(n - knees[:, None], 0)
    shells = classify_shells(
        ideal(ratio + 0.005 * np.random.default_rng(2).standard_normal(ratio.shape), 0.005)
    )
    np.testing.assert_allclose(shells["stiff_breakpoint"], knees, atol=1.0)
    flat = classify_shells(ideal(np.tile(0.3 - 0.005 * n, (3, 1)), 0.005))
    assert flat["stiff_breakpoint"].isna().all()
    noise = classify_shells(ideal(0.1 + 0.02 * np.random.default_rng(3).standard_normal((100, 25)), 0.02))
    assert noise["stiff_breakpoint"].isna().mean() > 0.95
