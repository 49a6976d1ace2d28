"""Friction of two discs against the truth of synthetic measurements and the publication's numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad

from tests.scenes.single_sheets import DiscTest, disc_record, write_rheocompass, write_rheometer_csv
from vision.errors import InputError
from vision.models.friction import (
    PUBLISHED_FRICTION,
    FrictionSettings,
    disc_friction,
    fit_static_friction,
    friction_of_disc,
    friction_table,
)
from vision.models.rheometer import read_rheometer

TEST = DiscTest()


def one_measurement(tmp_path: Path, test: DiscTest, load: float = 0.5) -> tuple[pd.DataFrame, pd.Series]:
    truth = write_rheometer_csv(tmp_path / "one.csv", test, load_N=load)
    return read_rheometer(tmp_path / "one.csv")[0], truth.iloc[0]


def rotation(test: DiscTest, load: float) -> pd.DataFrame:
    """A record as `read_rheometer` returns it, without a file."""
    time = np.concatenate([np.arange(0, 0.5, 1e-3), np.arange(0.5, 21.0, 0.05)])
    record = disc_record(test, load, time, number=int(100 * load))
    columns = {
        "time_s": time,
        "angle_rad": record["angle_mrad"] / 1000,
        "torque_N_m": record["torque_mN_m"] / 1000,
        "normal_force_N": record["normal_force_N"],
    }
    return pd.DataFrame(columns)


def test_coefficients_lie_within_their_errors(tmp_path: Path) -> None:
    """A failure means μ_s or μ_d is biased, or its error is too small or needlessly large."""
    truth = replace(TEST, loads_N=(0.1, 0.5, 2.0)).truth()
    z_s, z_d = [], []
    for seed in range(20):
        measured = [friction_of_disc(rotation(replace(TEST, seed=seed), load)) for load in truth["N_N"]]
        found = friction_table(measured)
        z_s.append((found["mu_s"] - truth["mu_s"]) / found["mu_s_err"])
        z_d.append((found["mu_d"] - truth["mu_d"]) / found["mu_d_err"])
        assert (found["mu_s_err"] < 0.01 * found["mu_s"]).all()
    static, dynamic = np.concatenate(z_s), np.concatenate(z_d)
    assert 0.7 < np.std(static) < 1.4
    assert abs(np.mean(static)) < 0.5
    assert np.std(dynamic) < 1.3


def test_the_fit_gives_back_the_law(tmp_path: Path) -> None:
    """A failure means a or b, or one of their errors, is wrong from the raw file to the law."""
    write_rheocompass(tmp_path / "r.csv", TEST)
    table = friction_table(map(friction_of_disc, read_rheometer(tmp_path / "r.csv")))
    law = fit_static_friction(table["N_N"], table["mu_s"], table["mu_s_err"])
    assert law.a == pytest.approx(0.507, abs=3 * law.a_err)
    assert law.b_N == pytest.approx(0.143, abs=3 * law.b_err_N)
    assert law.a_err < 0.001
    assert law.correlation < -0.5
    assert law.points == 8


def test_wrong_radius_and_wrong_load_fail(tmp_path: Path) -> None:
    """The tests above must notice settings that are off: μ goes as 1/(R N)."""
    rotation, truth = one_measurement(tmp_path, TEST)
    wrong_radius = friction_of_disc(rotation, radius_mm=20)
    wrong_load = friction_of_disc(rotation, normal_force_N=1.0)
    assert wrong_radius.mu_s == pytest.approx(1.25 * truth["mu_s"], rel=0.01)
    assert wrong_load.mu_d == pytest.approx(0.5 * truth["mu_d"], rel=0.01)


def test_a_mean_from_zero_takes_in_the_peak(tmp_path: Path) -> None:
    """The range of angles matters: over the first degree alone a start at 0 biases μ_d by over 1 %."""
    rotation, _ = one_measurement(tmp_path, replace(TEST, ripple=0.0))
    right = friction_of_disc(rotation, settings=FrictionSettings(dynamic_deg=(0.3, 1.0)))
    wrong = friction_of_disc(rotation, settings=FrictionSettings(dynamic_deg=(0.05, 1.0)))
    assert right.mu_d == pytest.approx(0.44, abs=4 * right.mu_d_err)
    assert wrong.mu_d > 1.03 * 0.44


def test_the_mean_is_over_the_angle_not_the_samples(tmp_path: Path) -> None:
    """A finely sampled start must not weigh more: a mean over samples would be off by the ripple."""
    test = replace(TEST, ripple=0.2, ripple_deg=240.0, fine_s=3.0, end_deg=121.0)
    rotation, truth = one_measurement(tmp_path, test)
    angle = np.degrees(rotation["angle_rad"])
    inside = angle.between(0.3, 120)
    of_samples = disc_friction(rotation["torque_N_m"][inside], normal_force_N=0.5).mean()
    assert abs(of_samples - truth["mu_d"]) > 0.02
    assert friction_of_disc(rotation).mu_d == pytest.approx(truth["mu_d"], abs=1e-3)


def test_a_later_maximum_is_not_the_static_one(tmp_path: Path) -> None:
    """A failure means the global maximum, late in a rotation with growing μ_d, passes for the static peak."""
    rotation, truth = one_measurement(tmp_path, replace(TEST, ripple=0.6, ripple_deg=200.0), load=1.0)
    found = friction_of_disc(rotation)
    curve = disc_friction(rotation["torque_N_m"], normal_force_N=1.0)
    assert curve.max() > 1.15 * truth["mu_s"]
    assert found.mu_s == pytest.approx(truth["mu_s"], abs=4 * found.mu_s_err)
    assert found.peak_deg < 0.2


def test_a_curve_without_a_peak_has_no_static_coefficient(tmp_path: Path) -> None:
    """A failure means a plateau's largest noise is sold as μ_s."""
    flat = replace(TEST, law=replace(PUBLISHED_FRICTION, a=0.44, b_N=1e-9), ripple=0.0)
    rotation, _ = one_measurement(tmp_path, flat)
    found = friction_of_disc(rotation)
    assert np.isnan(found.mu_s)
    assert any("no maximum" in line for line in found.warnings)
    assert found.mu_d == pytest.approx(0.44, abs=4 * found.mu_d_err)


def test_a_drifting_normal_force_is_followed(tmp_path: Path) -> None:
    """A failure means N is averaged over a rotation in which it fell by a third."""
    rotation, truth = one_measurement(tmp_path, replace(TEST, normal_drift=0.33))
    found = friction_of_disc(rotation)
    assert found.mu_s == pytest.approx(truth["mu_s"], rel=0.01)
    assert found.mu_d == pytest.approx(truth["mu_d"], rel=0.01)
    untimed = friction_of_disc(rotation.assign(time_s=np.nan))  # some exports have no times
    assert untimed.mu_d == pytest.approx(truth["mu_d"], rel=0.01)
    mean = friction_of_disc(rotation, settings=FrictionSettings(normal_window_s=1000.0))
    assert mean.mu_s > 1.05 * truth["mu_s"]
    empty = rotation["normal_force_N"].where(rotation.index != 50)  # one cell of the export
    holed = friction_of_disc(rotation.assign(normal_force_N=empty))
    assert holed.mu_d_err == pytest.approx(found.mu_d_err, rel=0.02)


def test_a_peak_that_is_not_resolved_is_said(tmp_path: Path) -> None:
    """0.3° take 52 ms at 0.1 rad/s: 50 samples a second leave three, and the maximum falls between them."""
    assert round(1000 * np.radians(0.3) / 0.1) == 52
    rotation, _ = one_measurement(tmp_path, replace(TEST, fine_Hz=50.0, fine_s=1.0))
    found = friction_of_disc(rotation)
    assert any("not resolved" in line for line in found.warnings)


def test_a_short_rotation_is_said_or_refused(tmp_path: Path) -> None:
    """A failure means a mean over 60° passes for one over 120°, or nothing at all for a number."""
    rotation, _ = one_measurement(tmp_path, replace(TEST, end_deg=60.0))
    assert any("ends at 6" in line or "ends at 59" in line for line in friction_of_disc(rotation).warnings)
    with pytest.raises(InputError, match=r"rotation from 0° to 0\.2"):
        friction_of_disc(rotation[rotation["angle_rad"] < np.radians(0.25)])


@pytest.mark.parametrize("load", [None, 0.0, -1.0, np.nan, np.inf])
def test_no_or_a_meaningless_normal_force_is_refused(tmp_path: Path, load: float | None) -> None:
    """A failure means a division by a missing or negative N goes unnoticed."""
    write_rheometer_csv(tmp_path / "n.csv", TEST, load_N=0.5, normal=False)
    (rotation,) = read_rheometer(tmp_path / "n.csv")
    with pytest.raises(InputError, match="normal_force_N"):
        friction_of_disc(rotation, normal_force_N=load)
    assert friction_of_disc(rotation, normal_force_N=0.5).N_err_N == 0


def test_a_normal_force_that_turns_negative_is_refused(tmp_path: Path) -> None:
    """A failure means the plates' separation in the middle of a measurement is averaged away."""
    rotation, _ = one_measurement(tmp_path, replace(TEST, normal_drift=1.3))
    with pytest.raises(InputError, match="compressive"):
        friction_of_disc(rotation)


def test_slip_from_the_rim_reads_three_quarters() -> None:
    """The caveat: shear ∝ r up to the threshold at the rim gives τ = μ_s N R/2, read as 0.75 μ_s."""
    mu, load, radius = 0.8, 1.3, 0.025
    torque, _ = quad(lambda r: mu * load / (np.pi * radius**2) * (r / radius) * 2 * np.pi * r * r, 0, radius)
    assert torque == pytest.approx(mu * load * radius / 2)
    assert disc_friction(torque, normal_force_N=load) == pytest.approx(0.75 * mu)
    assert disc_friction(2 / 3 * mu * load * radius, normal_force_N=load) == pytest.approx(mu)


def test_publication_numbers() -> None:
    """μ_s from 1.2 to 0.54 over 0.1 to 2 N; thresholds cross at 0.189 N; A/2 ≈ μ_s − μ_d at 0.5 to 1 N."""
    law = PUBLISHED_FRICTION
    assert round(float(law.mu_s(0.1)), 1) == 1.2
    assert round(float(law.mu_s(2.0)), 2) == 0.54
    assert round(law.crossing_N(0.89), 3) == 0.189
    assert law.crossing_N(0.5) == np.inf
    assert float(np.mean(law.mu_s([0.5, 0.75, 1.0]))) == pytest.approx(0.61, abs=0.01)
    assert pytest.approx(0.34 / 2) == 0.61 - 0.44
    assert law.threshold_N(0.0) == pytest.approx(0.507 * 0.143)
    assert np.isposinf(law.mu_s(0.0))


def test_a_constant_coefficient_is_too_large_at_large_loads_and_too_small_at_small_ones() -> None:
    """A failure means the threshold of the law crosses that of a constant coefficient at another load."""
    load = np.geomspace(0.0034, 6.4, 200)
    assert ((0.89 * load > PUBLISHED_FRICTION.threshold_N(load)) == (load > 0.1893)).all()


def test_errors_of_the_law_hold_two_thirds_of_the_truths() -> None:
    """A failure means a_err or b_err is wrong, with or without scatter that the single errors do not know."""
    rng = np.random.default_rng(1)
    load = np.array([0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0] * 2)
    for extra in (0.0, 0.03):
        z = []
        for _ in range(300):
            error = np.full(load.size, 0.01)
            mu = PUBLISHED_FRICTION.mu_s(load) + rng.normal(0, np.hypot(0.01, extra), load.size)
            law = fit_static_friction(load, mu, error)
            z.append([(law.a - 0.507) / law.a_err, (law.b_N - 0.143) / law.b_err_N])
        inside = (np.abs(z) < 1).mean(axis=0)
        assert (inside > 0.60).all()
        assert (inside < 0.78).all()


def test_scatter_beyond_the_errors_scales_them() -> None:
    """A failure means sheets that differ from each other give a law with errors of a single measurement."""
    load = np.array([0.1, 0.3, 0.6, 1.0, 2.0])
    mu = PUBLISHED_FRICTION.mu_s(load) + np.array([0.05, -0.05, 0.05, -0.05, 0.05])
    small, large = (fit_static_friction(load, mu, np.full(5, error)) for error in (0.001, 0.05))
    assert small.chi2_dof > 1000
    assert small.a_err == pytest.approx(large.a_err, rel=0.25)
    bare = fit_static_friction(load, mu)
    assert bare.a_err > 0
    assert np.isnan(bare.chi2_dof)


@pytest.mark.parametrize(
    ("load", "mu"),
    [([], []), ([0.5], [0.6]), ([0.5, 0.5], [0.6, 0.61]), ([0.5, 1.0], [0.6, np.nan]), ([0, 1], [1, 0.6])],
    ids=["none", "one", "one-load", "one-known", "zero-load"],
)
def test_too_little_for_the_law_is_refused(load: list[float], mu: list[float]) -> None:
    """A failure means a law through fewer loads than it has parameters."""
    with pytest.raises(InputError):
        fit_static_friction(load, mu, np.full(len(load), 0.01))


def test_two_loads_give_a_law_without_chi2() -> None:
    """Two points determine a and b exactly; nothing is left to judge the fit by."""
    law = fit_static_friction([0.2, 1.0], PUBLISHED_FRICTION.mu_s([0.2, 1.0]), [0.01, 0.01])
    assert (law.a, law.b_N) == pytest.approx((0.507, 0.143))
    assert np.isnan(law.chi2_dof)
    assert np.isnan(law.chi2_dof)
