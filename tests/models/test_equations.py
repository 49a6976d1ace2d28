"""The paper's equations against its numbers and against themselves."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from vision.models import equations as eq
from vision.sample import PUBLISHED

PAPER = {"mu": 0.89}
STIFFNESS = {"mu": 0.89, "n_hat_N": 0.57, "modulus_GPa": 3.8}
# d, alpha, traction, 0.34 total normal force, N(0), N(1), M_eff, K, dF/K in um: printed digits
TABLE = [
    (13, 8.558, 236.6, 90.3, 8.77, 8.65, 14.12, 4237, 21.3),
    (13.5, 8.241, 175.6, 67.0, 6.39, 6.31, 13.53, 4059, 16.5),
    (13.7, 8.120, 156.8, 59.9, 5.67, 5.59, 13.29, 3986, 15.0),
    (15, 7.417, 81.2, 31.0, 2.80, 2.77, 11.58, 3473, 8.9),
    (17.1, 6.506, 34.9, 13.3, 1.13, 1.11, 8.08, 2423, 5.5),
    (18, 6.181, 25.8, 9.8, 0.81, 0.80, 5.98, 1795, 5.5),
]


@pytest.mark.parametrize("row", TABLE, ids=lambda row: f"d={row[0]}mm")
def test_reference_table_to_its_printed_digits(row):
    """A failure means an equation or a default differs from the paper's."""
    d, alpha, traction, amplitude, n0, n1, m_eff, stiffness, length = row
    d_hat = eq.reduced_separation(d, mu=0.89, n_hat_N=0.57)
    drop, k = eq.stick_slip_amplitude(d, **PAPER), eq.assembly_stiffness(d, **STIFFNESS)
    assert round(float(eq.amplification(d, **PAPER)), 3) == alpha
    assert round(float(eq.traction(d, **PAPER)), 1) == traction
    assert round(float(drop), 1) == amplitude
    assert round(float(eq.normal_force(0, d, **PAPER)), 2) == n0
    assert round(float(eq.normal_force(1, d, **PAPER)), 2) == n1
    assert round(float(eq.effective_sheets(d_hat)), 2) == m_eff
    assert round(float(k)) == stiffness
    assert round(float(1000 * drop / k), 1) == length


def test_separation_scale_and_single_sheet_stiffness():
    """A failure means the scale that collapses the stiffness data is wrong."""
    assert round(float(eq.separation_scale_mm(mu=0.89, n_hat_N=0.57)), 2) == 19.09
    assert round(float(eq.separation_scale_mm(mu=0.82, n_hat_N=0.77)), 2) == 16.96
    assert round(float(eq.separation_scale_mm(mu=0.93, n_hat_N=0.48)), 2) == 20.40
    assert round(float(eq.sheet_stiffness(modulus_GPa=2.5))) == 197


def test_wrong_friction_is_told_apart():
    """The table would not notice a formula that ignores mu; this does: 1 % in mu moves it by 8 %."""
    assert eq.traction(13, mu=0.8989) / eq.traction(13, mu=0.89) == pytest.approx(1.084, abs=0.005)


@pytest.mark.parametrize("d", [0.5, 13.0, 18.0, 1e4])
def test_total_normal_force_is_the_integral_of_eq_2(d):
    """A failure means Eq. 1 and Eq. 2 do not belong to the same model."""
    integral, _ = quad(lambda s: float(eq.normal_force(25 * s, d, mu=0.89)), 0, 1, epsrel=1e-10)
    assert eq.total_normal_force(d, mu=0.89) == pytest.approx(100 * integral, rel=1e-8)


def test_outer_force_vanishes_and_the_typical_value_is_the_papers():
    """The outermost sheet carries nothing; T*/mu is the 0.0034 N that the paper quotes."""
    assert eq.normal_force(25, 13.5, mu=0.89) == 0
    assert abs(PUBLISHED.t_star_N / 0.89 - 0.0034) < 5e-5


def test_far_apart_the_traction_is_that_of_flat_sheets():
    """A failure means the series near alpha = 0 does not join the closed form."""
    assert eq.traction(1e9, mu=0.89) == pytest.approx(0.15, rel=1e-6)
    alpha = np.array([0.99e-4, 1.01e-4])
    excess = eq.mean_amplification_excess(alpha)
    assert excess / alpha == pytest.approx([2 / 3, 2 / 3], rel=1e-4)


def test_beyond_the_last_stiff_sheet_stiffness_is_zero_not_nan():
    """d-hat > 1 happens inside the paper's ranges; NaN there would poison every fit."""
    assert eq.effective_sheets([0.5, 1.0, 1.2]).tolist() == pytest.approx([25 * 0.5**0.5, 0, 0])
    assert eq.assembly_stiffness(25.0, **STIFFNESS) == 0


def test_extreme_amplification_stays_finite_and_meaningless_input_is_nan():
    """A fit that strays must not meet an overflow warning (warnings are errors here) or a silent number."""
    assert np.isfinite(eq.traction(1e-3, mu=5.0))
    assert np.isfinite(eq.normal_force(0, 1e-3, mu=5.0))
    assert np.isnan(eq.traction([0.0, -1.0], mu=0.89)).all()
    assert np.isnan(eq.traction(13.0, mu=-0.1))
    assert np.isnan(eq.effective_sheets(np.nan))
    assert eq.normal_force(0, 13.0, mu=0.0) == pytest.approx(
        float(eq.normal_force(0, 13.0, mu=1e-9)), rel=1e-6
    )


def test_vectorised_over_separation_and_sheet():
    """A failure means broadcasting broke: sheets down, separations across."""
    forces = eq.normal_force(np.arange(26)[:, None], np.array([13.0, 15.0, 18.0]), mu=0.89)
    assert forces.shape == (26, 3)
    assert (np.diff(forces, axis=0) < 0).all()
    assert (np.diff(forces[:-1], axis=1) < 0).all()


@pytest.mark.parametrize("side", [1, -1])
def test_normal_force_of_blocks_turned_by_90_degrees(side):
    """A failure means the weight's integral is not the solution of the balance of each sheet."""
    d, weight, alpha = 13.0, eq.sheet_weight_N(), float(eq.amplification(13.0, mu=0.89))

    def balance(n, force):
        return -2 * alpha * n / 25**2 * (force + 0.003 / (2 * 0.89)) - 2 * side * weight

    n = np.arange(24.0, -1, -1)
    solved = solve_ivp(balance, (25.0, 0.0), [0.0], t_eval=n, rtol=1e-10, atol=1e-12)
    found = eq.normal_force_on_edge(n, d, side=side, weight_N=weight, mu=0.89)
    np.testing.assert_allclose(found, solved.y[0], rtol=1e-7)
    assert eq.normal_force_on_edge(25, d, side=side, weight_N=weight, mu=0.89) == pytest.approx(0, abs=1e-12)


def test_weight_of_a_sheet_against_its_adhesion():
    """m_p g is 2.6 mN at 80 g/m², close to T*; it presses one side and parts the other, and cancels in 𝒯."""
    weight = eq.sheet_weight_N()
    assert round(1000 * weight, 1) == 2.6
    n = np.arange(25)
    plain = eq.normal_force(n, 13.0, mu=0.89)
    down, up = (eq.normal_force_on_edge(n, 13.0, side=s, weight_N=weight, mu=0.89) for s in (1, -1))
    np.testing.assert_allclose(down + up, 2 * plain, rtol=1e-10, atol=1e-12)
    assert (down > 4 * plain).all()
    assert (up < 0).all()
    tilted = eq.normal_force_on_edge(n, 13.0, side=-1, weight_N=weight * np.sin(np.radians(10)), mu=0.89)
    assert (tilted > 0).all()  # held upright to 10 degrees, no sheet parts and 𝒯 is as printed
