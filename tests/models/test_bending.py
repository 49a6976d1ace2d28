"""Angles and bending of single sheets to the printed digits."""

import numpy as np
import pytest

from vision.models.equations import bending_length_mm, excess_length_mm, sheet_angle_rad
from vision.sample import Sample


def test_angles_to_their_printed_digits() -> None:
    """10.89° at n = 25, d = 13 mm; 7.91° at 18 mm."""
    degrees = np.degrees(sheet_angle_rad(25, [13.0, 18.0]))
    assert [round(float(angle), 2) for angle in degrees] == [10.89, 7.91]


def test_bending_lengths_over_the_ranges() -> None:
    """1.81 to 3.80 mm at N̂ = 0.57 N and 1.56 to 4.14 mm at 0.77 to 0.48 N, each with its n and d."""
    ends = ((15, 18, 2.0), (25, 13, 3.8))  # n, d, Y_p
    for n_hat, printed in (((0.57, 0.57), (1.81, 3.80)), ((0.77, 0.48), (1.56, 4.14))):
        for (n, d, modulus), force, length in zip(ends, n_hat, printed, strict=True):
            assert round(float(bending_length_mm(n, d, n_hat_N=force, modulus_GPa=modulus)), 2) == length


def test_the_bending_length_solves_the_cantilever() -> None:
    """A failure means λ does not solve N̂ = 3 δ I Y / λ³."""
    lever = bending_length_mm(20, 15.0, n_hat_N=0.57, modulus_GPa=2.5)
    deflection, moment = lever * 20 * 0.1 / 15.0, 0.1**3 * 45 / 12
    assert 3 * deflection * moment * 2500 / lever**3 == pytest.approx(0.57)


def test_excess_length() -> None:
    """Mean of √(d² + (nε)²) − d: 0.085 mm at d = 13, between 0.14 and 0.15 % of L."""
    mean = float(excess_length_mm(np.arange(1, 26), 13.0).mean())
    assert round(mean, 3) == 0.085
    assert 0.0014 < mean / 57 < 0.0015
    assert excess_length_mm(0, 13.0) == 0


def test_another_sample_gives_other_numbers() -> None:
    """A failure means ε, W or M of the sample is not used."""
    thick = Sample(sheets_per_block=20, thickness_mm=0.15, width_mm=30.0)
    assert np.degrees(sheet_angle_rad(20, 13.0, sample=thick)) == pytest.approx(12.995, abs=1e-3)
    ratio = bending_length_mm(20, 13, n_hat_N=1, modulus_GPa=2, sample=thick) / bending_length_mm(
        20, 13, n_hat_N=1, modulus_GPa=2
    )
    assert ratio == pytest.approx(np.sqrt(30 / 45 * 1.5**4))
    assert excess_length_mm(20, 13.0, sample=thick) == pytest.approx(np.hypot(13.0, 3.0) - 13.0)
