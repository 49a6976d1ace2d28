"""Angles and bending of single sheets to the printed digits."""

import numpy as np
import pytest

from vision.models.equations import (
    bending_force_N,
    bending_length_mm,
    bending_lengths,
    excess_length_mm,
    largest_inward_displacement_mm,
    mean_excess_length_mm,
    second_moment_mm4,
    sheet_angle_rad,
)
from vision.sample import Sample


def test_angles_to_their_printed_digits() -> None:
    """10.89° at n = 25, d = 13 mm; 7.91° at 18 mm."""
    degrees = np.degrees(sheet_angle_rad(25, [13.0, 18.0]))
    assert [round(float(angle), 2) for angle in degrees] == [10.89, 7.91]


def test_bending_lengths_over_the_ranges() -> None:
    """1.81 to 3.80 mm at N̂ = 0.57 N and 1.56 to 4.14 mm at 0.77 to 0.48 N, each with its n and d."""
    table = bending_lengths()
    middle = table[table["n_hat_N"] == 0.57]
    ends = [
        (part["n"], part["d_mm"], round(part["bending_length_mm"], 2))
        for _, part in middle.iloc[[0, -1]].iterrows()
    ]
    assert ends == [(15, 18, 1.81), (25, 13, 3.80)]
    assert [round(value, 2) for value in table["bending_length_mm"].iloc[[0, -1]]] == [1.56, 4.14]
    assert len(table) == 24


def test_force_and_length_are_inverse() -> None:
    """A failure means λ does not solve N̂ = 3 δ I Y / λ³."""
    lever = bending_length_mm(20, 15.0, n_hat_N=0.57, modulus_GPa=2.5)
    assert bending_force_N(20, 15.0, lever_mm=lever, modulus_GPa=2.5) == pytest.approx(0.57)
    assert second_moment_mm4() == pytest.approx(0.1**3 * 45 / 12)


def test_excess_length() -> None:
    """Mean of √(d² + (nε)²) − d: 0.085 mm at d = 13, between 0.14 and 0.15 % of L."""
    mean = float(mean_excess_length_mm(13.0))
    assert round(mean, 3) == 0.085
    assert 0.0014 < mean / 57 < 0.0015
    assert excess_length_mm(0, 13.0) == 0
    assert mean_excess_length_mm([13.0, 18.0]).shape == (2,)


def test_another_sample_gives_other_numbers() -> None:
    """A failure means ε, W or M of the sample is not used."""
    thick = Sample(sheets_per_block=20, thickness_mm=0.15, width_mm=30.0)
    assert largest_inward_displacement_mm(20, sample=thick) == pytest.approx(3.0)
    assert np.degrees(sheet_angle_rad(20, 13.0, sample=thick)) == pytest.approx(12.995, abs=1e-3)
    ratio = bending_length_mm(20, 13, n_hat_N=1, modulus_GPa=2, sample=thick) / bending_length_mm(
        20, 13, n_hat_N=1, modulus_GPa=2
    )
    assert ratio == pytest.approx(np.sqrt(30 / 45 * 1.5**4))
    assert mean_excess_length_mm(13.0, sample=thick) > 1.3 * mean_excess_length_mm(13.0)
