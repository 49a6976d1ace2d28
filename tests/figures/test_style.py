"""Colours: readable on their background, in order, also in grey print."""

import numpy as np
import pytest

from tests.scenes.report_data import make_tracks, sawtooth
from vision.figures.style import DATA, MODEL, PEAK, VALLEY, ordered_inks, sheet_inks


def luminance(colour):
    rgb = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("ink", [DATA, PEAK, VALLEY, MODEL])
def test_inks_can_be_read_on_their_background(ink):
    """A failure means curves that vanish on paper or on a dark screen (contrast below 3)."""
    assert 1.05 / (luminance(ink[0]) + 0.05) > 3
    assert (luminance(ink[1]) + 0.05) / (luminance("#1d2024") + 0.05) > 3


def test_an_ordered_set_keeps_its_order_in_grey():
    """A failure means that grey print cannot tell the first stick from the last."""
    for background in (0, 1):
        grey = [luminance(ink[background]) for ink in ordered_inks(5)]
        assert (np.diff(grey) > 0.02).all()
    assert len(ordered_inks(1)) == 1


def test_sheets_are_blue_on_the_left_and_orange_on_the_right():
    """A failure means that the sides cannot be told apart, or that the tone says nothing about n."""
    inks = sheet_inks(make_tracks(sawtooth(3, 10)))
    blue = [int(light[5:7], 16) > int(light[1:3], 16) for light, _ in inks]
    assert blue == [True] * 5 + [False] * 5
    right = [luminance(light) for light, _ in inks[5:]]
    assert (np.diff(right) > 0).all()
