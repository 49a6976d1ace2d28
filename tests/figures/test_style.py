"""Colours, readable on their background and in grey print; symbols, numbers with errors, units."""

import numpy as np
import pytest

from tests.scenes.report_data import make_tracks, sawtooth
from vision.errors import counted
from vision.figures.style import (
    DATA,
    MODEL,
    PEAK,
    VALLEY,
    from_zero,
    ordered_inks,
    position_unit,
    sheet_inks,
    time_axis,
    to_html,
    to_mathtext,
    to_unicode,
)
from vision.models import Estimate, both_errors, plus_minus
from vision.numeric import two_digits


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


@pytest.mark.parametrize(
    ("text", "small", "markup", "figure"),
    [
        ("σ_x / Λ_st", "σₓ / Λₛₜ", "σ<sub>x</sub> / Λ<sub>st</sub>", "σₓ / Λₛₜ"),
        ("F − F_v (N)", "F − Fᵥ (N)", "F − F<sub>v</sub> (N)", "F − Fᵥ (N)"),
        (
            "M_eff K_eff",
            "M_eff K_eff",
            "M<sub>eff</sub> K<sub>eff</sub>",
            r"$M_{\mathrm{eff}}$ $K_{\mathrm{eff}}$",
        ),
        ("F_p − 𝒯_0", "Fₚ − 𝒯₀", "F<sub>p</sub> − 𝒯<sub>0</sub>", r"Fₚ − $\mathcal{T}_0$"),
        ("𝒯0 at its limit", "𝒯0 at its limit", "𝒯<sub>0</sub> at its limit", "𝒯0 at its limit"),
        ("tracks_x.csv <b>", "tracks_x.csv <b>", "tracks_x.csv &lt;b&gt;", "tracks_x.csv <b>"),
    ],
)
def test_symbols_are_set_as_in_print(text, small, markup, figure):
    """A failure means underscores in a manuscript's figure, or a file name taken for a symbol."""
    assert (to_unicode(text), str(to_html(text)), to_mathtext(text)) == (small, markup, figure)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.8911, 0.0012, "0.8911 ± 0.0012"),
        (-12.3456, 3.4, "−12.3 ± 3.4"),
        (1234.5, 160, "1234 ± 160"),
        (0.003, float("nan"), "0.003"),
    ],
)
def test_values_have_as_many_digits_as_their_error(value, error, text):
    """A failure means digits that mean nothing, or too few of them."""
    assert plus_minus(Estimate(value, error)) == text


def test_two_digits_have_no_power_of_ten():
    """A failure means errors such as 1.8e+02."""
    numbers = {179.0: "180", 654.3: "650", 1.234e4: "12000", 0.00123: "0.0012", 2.5: "2.5", 0.0: "0"}
    assert {number: two_digits(number) for number in numbers} == numbers


@pytest.mark.parametrize(
    ("value", "error", "systematic", "text"),
    [
        (0.89113, 0.0019, 0.0059, "0.8911 ± 0.0019 (stat.) ± 0.0059 (syst.)"),
        (3.80137, 0.01511, 0.00055, "3.8014 ± 0.0151 (stat.) ± 0.0006 (syst.)"),
        (0.6803, 0.0017, 1.2, "0.680 ± 0.002 (stat.) ± 1.200 (syst.)"),
    ],
)
def test_the_larger_error_limits_the_digits(value, error, systematic, text):
    """A failure means that a small error gives the value digits that the large one takes from it."""
    assert both_errors(Estimate(value, error, systematic)) == text


@pytest.mark.parametrize(
    ("size", "expected"), [(None, (1.0, "px")), (0.5, (0.5, "µm")), (10.0, (0.01, "mm"))]
)
def test_positions_are_in_the_unit_that_suits_the_picture(size, expected):
    """A failure means lengths that are off by a thousand, or an axis of zeros."""
    assert position_unit(size, 400) == expected


def timed(times_s):
    tracks = make_tracks(sawtooth(40, 4))
    return tracks.assign_coords(time_s=("frame", times_s))


def test_a_clock_that_runs_backwards_is_not_an_axis():
    """A failure means that tracks fold over each other."""
    time, label = time_axis(timed(np.r_[np.arange(20.0), np.arange(20.0)]))
    assert (label, time[-1]) == ("frame", 39)


def test_one_repeated_time_does_not_cost_the_clock():
    """A failure means that a single stamp written twice turns seconds into frame numbers."""
    times_s = np.arange(40) / 25
    times_s[11] = times_s[10]
    assert time_axis(timed(times_s))[1] == "t (s)"
    assert time_axis(timed(np.zeros(40)))[1] == "frame"


def test_dollars_in_names_are_no_mathematics():
    """A failure means that a sample called $x$ is drawn as a formula, or ends the drawing."""
    assert to_mathtext(r"$\frac{$") == r"\$\frac{\$"
    assert to_mathtext("5 $ of σ_eff") == r"5 \$ of $σ_{\mathrm{eff}}$"


def test_one_is_not_a_plural():
    """A failure means "1 tests" at the top of a campaign's page."""
    assert [counted(n, "test") for n in (0, 1, 2)] == ["0 tests", "1 test", "2 tests"]


def test_the_axis_of_drops_shows_every_drop_that_is_no_outlier():
    """A failure means that the largest drops of a test lie above the axis, or that an outlier hides all."""
    drops = np.geomspace(90, 10, 600)
    assert from_zero(drops, share=0.98) == pytest.approx((0, 1.15 * 90))
    assert from_zero(np.r_[drops, 900.0], share=0.98)[1] < 150
