"""The alignment against all pairings there are: each list of candidates small enough to try every one."""

from itertools import combinations

import numpy as np
import pytest

from vision.sheets import TrackingSettings
from vision.sheets.alignment import Candidates, ExpectedSheets, align, steps_between

COSTS = TrackingSettings()
SHEETS, PITCH = 4, 20.0
REST = 200 + PITCH * np.arange(SHEETS)  # far from the picture's edges


def expected(lists, log_contrast):
    return ExpectedSheets(
        np.broadcast_to(REST, (lists, SHEETS)),
        log_contrast,
        np.full(SHEETS, COSTS.missing_cost),
        PITCH,
        (0.0, 500.0),
    )


def scenes(lists=40, seed=3):
    """Sheets of different brightness, displaced, some missing, some false detections between them."""
    rng = np.random.default_rng(seed)
    contrast = np.log([40.0, 60.0, 50.0, 80.0])
    x, light = np.full((lists, 5), np.nan), np.full((lists, 5), np.nan)
    for row in range(lists):
        seen = rng.random(SHEETS) > 0.15
        false = rng.uniform(180, 280, rng.integers(0, 2))
        place = np.r_[(REST + rng.normal(0, 6))[seen], false]
        bright = np.r_[
            contrast[seen] + rng.normal(0, 0.1, seen.sum()), np.log(rng.uniform(20, 70, len(false)))
        ]
        order = np.argsort(place)
        x[row, : len(place)], light[row, : len(place)] = place[order], bright[order]
    return Candidates(x, light, np.zeros_like(x)), contrast


def cost(candidates, contrast, row, sheets, chosen):
    """Cost of one pairing, by the formulas in the documentation; relative to no pair at all."""
    x, light = candidates.x_px[row], candidates.log_contrast[row]
    count = np.isfinite(x).sum()
    flicker = np.sort(light[:count])[int(0.6 * (count - 1))] - np.quantile(contrast, 0.6)
    total = 0.0
    for n, k in zip(sheets, chosen, strict=True):
        bright = light[k] - flicker
        total += min((bright - contrast[n]) ** 2 / (2 * COSTS.brightness_spread**2), 4)
        moved = abs(x[k] - REST[n]) / PITCH
        total += COSTS.stay_cost / SHEETS * (min((2 * moved) ** 2, 1) + max(moved - 1, 0) / 2)
        total -= COSTS.missing_cost
        total -= COSTS.false_detection_cost * np.clip(np.exp(bright - np.median(contrast)) / 0.5, 0.3, 1)
    further = COSTS.missing_cost - COSTS.covered_cost  # saved for each missing sheet beside another one
    runs = np.diff([-1, *sheets, SHEETS]) - 1
    total -= further * sum(run - 1 for run in runs if run > 1)
    for i in range(1, len(sheets)):
        a, b = sheets[i] - sheets[i - 1], chosen[i] - chosen[i - 1]
        if (a, b) not in steps_between(0):
            return np.inf
        off = abs(x[chosen[i]] - x[chosen[i - 1]] - a * PITCH) / (COSTS.spacing_spread * PITCH * np.sqrt(a))
        near = min(off, 1.5)
        total += min(near * (off - near / 2), COSTS.spacing_limit)
        total += 1.5 * max(off - COSTS.tear_fraction / COSTS.spacing_spread, 0)
    return total


def all_pairings(candidates, contrast, row):
    """(cost, match) of every order-preserving pairing."""
    count = int(np.isfinite(candidates.x_px[row]).sum())
    for size in range(min(SHEETS, count) + 1):
        for sheets in combinations(range(SHEETS), size):
            for chosen in combinations(range(count), size):
                match = np.full(SHEETS, -1)
                match[list(sheets)] = chosen
                yield cost(candidates, contrast, row, sheets, chosen) if size else 0.0, match


def test_the_cheapest_of_all_pairings_is_found_and_its_margin():
    """A failure means that identities, or how certain they are, do not follow from the stated costs."""
    candidates, contrast = scenes()
    result = align(candidates, expected(len(candidates.x_px), contrast))
    several = 0
    for row in range(len(candidates.x_px)):
        tried = list(all_pairings(candidates, contrast, row))
        least, best = min(tried, key=lambda pair: pair[0])
        np.testing.assert_array_equal(result.match[row], best)
        for n in np.flatnonzero(best >= 0):
            k = best[n]
            others = [c for c, m in tried if c < np.inf and m[n] != k and (m[n] >= 0 or (k in m))]
            if others:
                several += 1
                assert result.margin[row, n] == pytest.approx(min(others) - least, abs=1e-9)
        assert np.isnan(result.margin[row, best < 0]).all()
    assert several > 50


def test_an_empty_list_has_no_pairs():
    """A failure means a frame without ridges ends in a traceback or in sheets."""
    nothing = np.full((3, 5), np.nan)
    result = align(Candidates(nothing, nothing, nothing), expected(3, np.log([40.0, 60, 50, 80])))
    assert (result.match == -1).all()


def test_brightness_tells_a_jump_by_a_pitch_that_positions_cannot():
    """A failure means a comb that fills the picture is renumbered by a jump."""
    contrast = np.log([30.0, 60.0, 40.0, 90.0])
    x = REST[None, :3] + 0.0  # the last three sheets, where the first three were
    result = align(Candidates(x, contrast[None, 1:], np.zeros((1, 3))), expected(1, contrast))
    np.testing.assert_array_equal(result.match[0], [-1, 0, 1, 2])
    equal = np.full(SHEETS, contrast.mean())
    result = align(Candidates(x, equal[None, 1:], np.zeros((1, 3))), expected(1, equal))
    np.testing.assert_array_equal(result.match[0], [0, 1, 2, -1])
