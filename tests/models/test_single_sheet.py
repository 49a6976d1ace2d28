"""Equations of one sheet or contact against the paper's numbers."""

import numpy as np
import pytest

from vision.models import single_sheet as one


def test_bending_length_over_the_papers_ranges():
    """n 15-25, d 13-18 mm, Y 2-3.8 GPa give 1.81-3.80 mm at N-hat 0.57 N and 1.56-4.14 mm at 0.77-0.48 N."""
    low = {"n": 15, "d_mm": 18, "modulus_GPa": 2.0}
    high = {"n": 25, "d_mm": 13, "modulus_GPa": 3.8}
    assert round(float(one.bending_length_mm(**low, n_hat_N=0.57)), 2) == 1.81
    assert round(float(one.bending_length_mm(**high, n_hat_N=0.57)), 2) == 3.80
    assert round(float(one.bending_length_mm(**low, n_hat_N=0.77)), 2) == 1.56
    assert round(float(one.bending_length_mm(**high, n_hat_N=0.48)), 2) == 4.14


def test_static_friction_spans_the_measured_values():
    """1.2 at 0.1 N down to 0.54 at 2 N, as measured on the rheometer."""
    assert one.static_friction([0.1, 2.0]) == pytest.approx([1.23, 0.543], abs=0.005)
    assert np.isposinf(one.static_friction(0.0))


def test_rheometer_friction_inverts_the_torque_of_a_disc():
    """Torque of uniform pressure on a disc is 2/3 mu N R."""
    assert one.rheometer_friction(2 / 3 * 0.6 * 1.5 * 25, load_N=1.5) == pytest.approx(0.6)


def test_modulus_from_slope_and_offset_agree_on_a_made_up_strip():
    """Both are k L0 / (eps W) when the free length is the clamp distance; a 2.5 GPa strip of 16.8 mm."""
    k = 2500 * 0.1 * 45 / 16.8
    assert one.modulus_from_slope(k, length_mm=16.8) == pytest.approx(2.5)
    assert one.modulus_from_offset(-k * 16.8) == pytest.approx(2.5)


def test_spring_block_obeys_its_equation_of_motion():
    """Integrating the slip numerically must give the same drop and slip time as the formulas."""
    m, k, w, mu_s, mu_d, v = 2.0, 50.0, 30.0, 0.6, 0.45, 1e-4
    cycle = one.spring_block(
        mass_kg=m, stiffness_N_per_mm=k, load_N=w, mu_static=mu_s, mu_dynamic=mu_d, speed_mm_s=v
    )
    dt, position, speed, time = 1e-7, 0.0, 0.0, 0.0
    start = mu_s * w / (1000 * k)
    while speed >= 0:
        speed += dt * (1000 * k * (start - position) - mu_d * w) / m
        position += dt * speed
        time += dt
    assert cycle.slip_time_s == pytest.approx(time, rel=1e-3)
    assert cycle.force_drop_N == pytest.approx(1000 * k * position, rel=1e-3)
    assert cycle.lowest_elongation_mm == pytest.approx(1000 * (start - position), rel=1e-3)
    assert cycle.stick_time_s == pytest.approx(cycle.force_drop_N / (k * v))
    assert cycle.slow


def test_angle_and_bound_on_inward_displacement():
    """The outermost sheet leans by arctan(2.5/13) and can move in by at most 2.5 mm."""
    assert np.degrees(one.sheet_angle_rad(25, 13)) == pytest.approx(10.886, abs=1e-3)
    assert one.largest_inward_displacement_mm(25) == pytest.approx(2.5)
