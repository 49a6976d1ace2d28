"""Fits of the paper's models give back what the events were made with."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, lfilter, sosfilt

from tests.scenes.event_tables import PARAMETERS, build_up_of, pulls
from tests.scenes.sawtooth import realistic, recording
from vision.command.options import option_names
from vision.errors import InputError, with_options
from vision.folder import plain
from vision.force import find_stick_slip
from vision.models import FitSettings, ModelFits, equations, fit_models
from vision.sample import PUBLISHED, Sample

TRUTH = {"mu": 0.89, "t0_N": 4.0, "amplitude": 0.34, "n_hat_N": 0.57, "modulus_GPa": 3.8}


MADE = recording(np.arange(10.0), np.arange(10.0), 13 + np.arange(10.0), 1.0)


def fit(made: pd.DataFrame, *sample: Sample, **options: Any) -> ModelFits:
    return fit_models(MADE, made, *sample, **options)


def events(
    *, seed=0, count=200, d1=18.0, mu=0.89, n_hat=0.57, scatter=0.015, jitter=0.07, k_error=0.02
) -> pd.DataFrame:
    """Events whose peaks follow Eq. 1 + 4 N, with the scatter of a real test."""
    rng = np.random.default_rng(seed)
    d = np.linspace(13.05, d1, count)
    k = equations.assembly_stiffness(d, mu=mu, n_hat_N=n_hat, modulus_GPa=3.8)
    drop = 0.34 * equations.total_normal_force(d, mu=mu) * (1 + jitter * rng.standard_normal(count))
    d_p = d + drop / k
    error = k_error * k * rng.uniform(0.5, 1.5, count)
    return pd.DataFrame(
        {
            "d_v_mm": d,
            "d_p_mm": d_p,
            "F_p_N": (equations.traction(d_p, mu=mu) + 4) * (1 + scatter * rng.standard_normal(count)),
            "dF_N": drop,
            "K_N_per_mm": k + error * rng.standard_normal(count),
            "K_err_N_per_mm": error,
            "flag": "ok",
        }
    )


@pytest.mark.thorough
def test_pulls_are_those_of_honest_errors() -> None:
    """A failure means a fitted parameter is biased or its stated error is not its real one."""
    pulls = []
    for seed in range(40):
        fits = fit(events(seed=seed))
        found = {name: getattr(fits, name) for name in TRUTH}
        pulls.append([(found[name].value - true) / found[name].error for name, true in TRUTH.items()])
    pulls_by_name = np.array(pulls)
    assert np.all(np.abs(pulls_by_name.mean(axis=0)) < 0.5)
    spread = pulls_by_name.std(axis=0)
    assert np.all((spread > 0.7) & (spread < 1.35))


def test_exact_events_give_exact_parameters() -> None:
    """A failure means an equation or a unit is wrong, not a matter of noise."""
    fits = fit(events(scatter=0, jitter=0, k_error=1e-9))
    for name, true in TRUTH.items():
        assert getattr(fits, name).value == pytest.approx(true, rel=2e-3), name
    assert fits.scale_mm.value == pytest.approx(19.09, abs=0.02)
    np.testing.assert_allclose(fits.effective_sheets([13.0, 18.0]), [14.12, 5.98], atol=0.03)
    assert fits.bending_mm.value == pytest.approx(3.47, abs=0.05)


def test_wrong_model_shows_in_the_goodness_of_fit() -> None:
    """A failure means χ²/dof says "good" for peaks that do not follow Eq. 1."""
    made = events()
    noise = np.random.default_rng(1).normal(0, 1, len(made))
    straight = made.assign(F_p_N=300 - 15 * (made["d_p_mm"] - 13) + noise)
    assert fit(made).goodness["peaks"].chi2_dof < 1.4
    assert fit(straight).goodness["peaks"].chi2_dof > 5


def test_wrong_geometry_fails() -> None:
    """A failure means the sheets' thickness does not matter to the fit, which it must."""
    fits = fit(events(), Sample(thickness_mm=0.11))
    assert abs(fits.mu.value - 0.89) > 20 * fits.mu.error


def test_freeing_t_star_says_that_it_is_degenerate() -> None:
    """A failure means a user reads μ and T* one by one where only their combination is known."""
    free, fixed = fit(events(), free_t_star=True), fit(events())
    assert free.correlation["mu,T_star_N"] < -0.99
    assert any("degenerate (correlation −0.99" in note for note in free.notes)  # with a minus sign
    assert free.mu.error > 5 * fixed.mu.error
    assert abs(free.t_star_N.value - 0.003) < 4 * free.t_star_N.error


def test_models_json_has_the_agreed_form() -> None:
    """A failure means a script that reads models.json breaks, or it is no valid JSON."""
    content = json.loads(json.dumps(plain(fit(events()).to_json()), allow_nan=False))
    for name in ("mu", "T0_N", "A", "N_hat_N", "Y_eff_GPa", "Lambda_hat_mm"):
        assert set(content[name]) == {"value", "error", "systematic_error"}
        assert content[name]["systematic_error"] >= 0
    assert content["budget"]["d0"]["mu"] is None  # its error was not given
    assert content["budget"]["load_drift"]["mu"] > 0
    assert content["sample"] == asdict(PUBLISHED)
    assert content["events_used"] == 200
    assert content["fit_range_mm"] == [13.05, 18.0]
    assert content["chi2_dof"] == pytest.approx(1, abs=0.2)
    assert not {"fixed", "shells", "T_star_N"} & set(content)
    assert "T_star_N" in fit(events(), free_t_star=True).to_json()


def test_beyond_the_last_stiff_sheet() -> None:
    """A failure means d̂ > 1, which real samples reach, breaks the fit with NaN."""
    fits = fit(events(d1=17.5, n_hat=0.75).query("K_N_per_mm > 0"))
    assert np.isfinite(fits.n_hat_N.value)
    assert fits.effective_sheets(30.0) == 0


def test_flagged_events_do_not_count() -> None:
    """A failure means damaged sticks enter the fits."""
    made = events()
    spoiled = made.assign(F_p_N=made["F_p_N"].where(made.index % 10 > 0, 1e4))
    marked = spoiled.assign(flag=np.where(made.index % 10 > 0, "ok", "gap"))
    assert fit(marked).mu.value == pytest.approx(0.89, abs=0.005)
    assert abs(fit(spoiled).mu.value - 0.89) > 0.02


def test_small_slips_among_large_ones_are_told() -> None:
    """A failure means that A is the mean of unlike slips, without a word."""
    made = events()
    drops = made["dF_N"].where(made.index % 2 > 0, 0.05 * made["dF_N"])
    fits = fit(made.assign(dF_N=drops))
    assert fits.amplitude.value < 0.7 * fit(made).amplitude.value
    assert any("small slips among large ones" in line for line in fits.warnings)
    assert not any("small slips" in line for line in fit(made).warnings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda made: made.head(4), "at least 6 whole events.*4 of 4"),
        (lambda made: made.assign(d_v_mm=made["d_v_mm"] - 13.1), "initial separation with `d0_mm`"),
        (lambda made: made.assign(d_p_mm=made["d_p_mm"] + 50), "between 0 and 57 mm"),
        (
            lambda made: made.assign(d_v_mm=made["d_v_mm"] - 13.05, d_p_mm=made["d_p_mm"] - 13.05),
            "displacement that begins at 0; give the initial separation with `d0_mm`",
        ),
        (lambda made: made.drop(columns="dF_N"), "no dF_N"),
        (lambda made: made.assign(K_N_per_mm=np.nan), "0 of 200; the separation changes by 9 mm: check the"),
        (lambda made: made.assign(flag="gap", K2_N_per_mm=1.0), "0 of 200; most have a flag"),
    ],
)
def test_events_that_cannot_be_fitted_are_refused(change, message: str) -> None:
    """A failure means numbers come out of a fit that has no meaning."""
    with pytest.raises(InputError, match=message):
        fit(change(events()))


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (MADE.assign_attrs(d0_mm=np.nan, separation_from="displacement"), "give `d0_mm`"),
        (MADE.assign(load_N=MADE["load_N"].assign_attrs(units="1")), "a force over a weight"),
    ],
)
def test_recordings_that_cannot_be_fitted_are_refused(force: xr.Dataset, message: str) -> None:
    """A failure means parameters in newton from numbers that are none, or from an unknown separation."""
    with pytest.raises(InputError, match=message):
        fit_models(force, events())


@pytest.mark.parametrize(
    ("length", "load", "message"),
    [
        (1e-3, 1, "events at least 0.1 µm apart"),  # m taken for mm
        (0.1, 100, "sheets of less than 1000 GPa"),  # cm and cN
        (25.4, 1, "between 0 and 57 mm.*units of displacement and load"),
        (1, 1e-3, "offset 𝒯0.*units of displacement and load"),  # kN taken for N
    ],
)
def test_a_wrong_unit_is_named(length: float, load: float, message: str) -> None:
    """A failure means a displacement in metres gives μ to six digits, or a reason that is not the reason."""
    made = events()
    lengths = {name: 13 + length * (made[name] - 13) for name in ("d_v_mm", "d_p_mm")}
    forces = {name: load * made[name] for name in ("F_p_N", "dF_N")}
    stiffness = {name: load / length * made[name] for name in ("K_N_per_mm", "K_err_N_per_mm")}
    with pytest.raises(InputError, match=message):
        fit(made.assign(**lengths, **forces, **stiffness))


def test_doubtful_units_are_said() -> None:
    """A failure means stiffnesses of steel foil pass for paper without a word, or paper's own are doubted."""
    made = events()
    inches = made.assign(K_N_per_mm=25.4 * made["K_N_per_mm"], K_err_N_per_mm=25.4 * made["K_err_N_per_mm"])
    assert any("check the units" in line for line in fit(inches).warnings)
    assert not any("units" in line for line in fit(made).warnings)


def test_a_modulus_of_no_sheet_is_said() -> None:
    """A failure means that a width in cm gives a modulus ten times too large, and nothing says so."""
    (line,) = fit(events(), Sample(width_mm=4.5)).warnings
    assert "Y_eff of 38 GPa" in line and "`width_mm`" in line
    assert fit(events(), Sample(width_mm=4.5), modulus_GPa=38).warnings == fit(events()).warnings == ()


def test_a_friction_of_no_sheet_is_said() -> None:
    """A failure means that half the number of sheets gives μ = 4.3 with an error of 0.2 %, without a word."""
    warnings = fit(events(), Sample(sheets_per_block=12)).warnings
    assert any("μ of" in line and "`sheets_per_block`" in line for line in warnings)
    assert not any("μ of" in line for line in fit(events(), Sample(sheets_per_block=20)).warnings)


def test_centimetres_that_nobody_declared_are_refused() -> None:
    """A failure means μ with a small error from a file that states no unit and whose numbers contradict mm.

    The option that states the unit is named only where the file does not.
    """
    made = events()
    shorter = {name: 13 + 0.1 * (made[name] - 13) for name in ("d_v_mm", "d_p_mm")}
    stiffness = {name: 10 * made[name] for name in ("K_N_per_mm", "K_err_N_per_mm")}
    read = made.assign(**shorter, **stiffness)
    assumed = MADE.assign_attrs(displacement_unit="assumed")
    with pytest.raises(InputError, match=r"in cm it agrees \(μ = 0.89.*displacement=NAME:cm"):
        fit_models(assumed, read)
    with pytest.raises(InputError, match=r"in cm it agrees \(μ = 0.89, 𝒯0 = \S+ N\)$"):
        fit_models(MADE, read)
    for right in (fit_models(assumed, made), fit_models(assumed, made.assign(F_p_N=made["F_p_N"] + 20))):
        assert not any("agrees" in line for line in right.warnings)


def test_peaks_that_do_not_fall_with_separation_are_refused() -> None:
    """A failure means a traceback where the friction coefficient is not determined."""
    made = events()
    rising = made.assign(F_p_N=np.linspace(5, 25, len(made)))
    with pytest.raises(InputError, match=r"events that follow the paper's model.*friction coefficient"):
        fit(rising)


NUMBERS = (
    st.floats(allow_nan=True, allow_infinity=True) | st.floats(0, 100) | st.sampled_from([0.0, 13.0, 57.0])
)
STRANGE = st.integers(6, 12).flatmap(
    lambda count: st.fixed_dictionaries(
        {
            name: st.lists(NUMBERS, min_size=count, max_size=count)
            for name in ("d_v_mm", "d_p_mm", "F_p_N", "dF_N", "K_N_per_mm", "K_err_N_per_mm")
        }
    )
)
POSITIVE = st.integers(6, 12).flatmap(
    lambda count: st.fixed_dictionaries(
        {
            name: st.lists(st.floats(low, high), min_size=count, max_size=count)
            for name, low, high in (
                ("d_v_mm", 1e-3, 56.0),
                ("d_p_mm", 1e-3, 56.0),
                ("F_p_N", -1e3, 1e3),
                ("dF_N", 1e-6, 1e3),
                ("K_N_per_mm", 1e-3, 1e4),
                ("K_err_N_per_mm", 0.0, 1e3),
            )
        }
    )
)


@settings(max_examples=60)
@given(columns=STRANGE | POSITIVE, free_t_star=st.booleans())
def test_strange_events_are_fitted_or_refused(columns: dict[str, list[float]], free_t_star: bool) -> None:
    """A failure means a fit ends in a traceback of SciPy, or in numbers that are not finite."""
    try:
        fits = fit(pd.DataFrame(columns), free_t_star=free_t_star)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        json.dumps(plain(fits.to_json()), allow_nan=False)
        assert np.isfinite([fits.mu.error, fits.n_hat_N.error, fits.modulus_GPa.error]).all()


def built_up(seed: int, length_mm: float, *, count: int = 200) -> pd.DataFrame:
    """Events of a pull whose force builds up over a length."""
    made = events(seed=seed, count=count)
    share = 1 - np.exp(-(made["d_p_mm"] - 13) / length_mm)
    drop = 1 - np.exp(-(made["d_v_mm"] - 13) / length_mm)
    return made.assign(F_p_N=made["F_p_N"] * share, dF_N=made["dF_N"] * drop)


def test_the_build_up_is_left_out_and_counted() -> None:
    """A failure means the first millimetre, which Eq. 1 does not describe, bends every parameter."""
    made = built_up(0, 0.1)
    found = fit(made)
    assert found.mu.value == pytest.approx(0.89, abs=0.001)
    assert found.amplitude.value == pytest.approx(0.34, rel=0.02)
    assert found.left_out["build_up"] > 2
    (note,) = (note for note in found.notes if "build-up" in note)
    assert " 0 later" not in note
    content = found.to_json()
    assert content["fit_range_mm"][0] > 13.1
    assert content["events_used"] + sum(found.left_out.values()) == len(made)
    whole = fit_models(MADE, made, fit_range_mm=(13.0, 18.1))
    assert abs(whole.mu.value - 0.89) > 0.004
    assert whole.goodness["peaks"].chi2_dof > 3
    assert any("does not follow the peaks" in line for line in whole.warnings)


@pytest.mark.parametrize("d1", [15.5, 18.0])
@pytest.mark.parametrize("drift_N", [-5.0, 5.0])
def test_a_drift_that_cancels_the_offset_is_in_the_errors(drift_N: float, d1: float) -> None:
    """A failure means μ is off by many of its errors, or most events are left out, where 𝒯0 hides a drift."""
    made = events(d1=d1)
    along = (made["d_p_mm"] - 13) / (d1 - 13)
    fits = fit(made.assign(F_p_N=made["F_p_N"] - 4 - 1.2 * drift_N + drift_N * along))
    mu, t0 = fits.mu, fits.t0_N
    assert abs(mu.value - 0.89) < 2 * np.hypot(mu.error, mu.systematic_error)
    assert abs(t0.value + 1.2 * drift_N) < 2 * np.hypot(t0.error, t0.systematic_error)
    assert fits.goodness["peaks"].points == len(made)
    assert fits.drift_N.value == pytest.approx(drift_N, abs=4 * fits.drift_N.error)
    assert d1 < 18 or any("the load seems to drift by" in line for line in fits.warnings)
    assert not any("drift by" in line for line in fit(made).warnings)


@pytest.mark.parametrize("drift_N", [-4.0, 4.0])
def test_a_drift_too_large_to_fit_with_is_in_the_errors(drift_N: float) -> None:
    """A failure means an error of μ that leaves out the drift that a large 𝒯0 may hide: with it nothing can
    be fitted, but with a part of it."""
    made = events(count=800, d1=17.4).query("d_v_mm > 16.6").reset_index(drop=True)
    along = (made["d_p_mm"] - 16.6) / 0.8
    mu = fit(made.assign(F_p_N=made["F_p_N"] + 4 + drift_N * along)).mu
    assert np.hypot(mu.error, mu.systematic_error) < 0.5
    assert mu.error < abs(mu.value - 0.89) / 10 < 2 * mu.systematic_error / 10


@pytest.mark.thorough
@pytest.mark.parametrize("length_mm", [0.1, 0.4])
def test_errors_hold_with_a_build_up(length_mm: float) -> None:
    """A failure means what is left of the build-up is larger than the stated error."""
    truth = {**TRUTH, "scale_mm": 19.094}
    pulls = []
    for seed in range(20):
        found = fit(built_up(seed, length_mm))
        parts = {name: getattr(found, name) for name in truth}
        pulls.append([(parts[name].value - true) / parts[name].error for name, true in truth.items()])
    assert 0.6 < np.mean(np.abs(pulls) < 1) < 0.8


@pytest.mark.thorough
def test_a_build_up_is_left_out_also_where_neighbouring_peaks_are_alike() -> None:
    """A failure means correlated scatter, in which Eq. 1 fits from no event on, leaves the build-up in."""
    off = []
    for seed in range(30):
        made = events(seed=seed, count=150, scatter=0.0)
        noise = np.random.default_rng(seed).standard_normal(150)
        alike = lfilter([np.sqrt(1 - 0.4**2)], [1, -0.4], noise)
        share = 1 - np.exp(-(made["d_p_mm"] - 13) / 0.3)
        found = fit(made.assign(F_p_N=made["F_p_N"] * share * (1 + 0.015 * alike)))
        off.append((found.mu.value - 0.89) / found.mu.error)
    assert abs(np.mean(off)) < 1.2


@pytest.mark.thorough
def test_stated_errors_hold_the_truth_for_any_sample_and_speed() -> None:
    """68 % intervals over samples, V and build-ups; `reports/coverage.py` does it for 200 tests.

    Bounds are three standard deviations of the count. A failure means errors that are too small, or a bias.
    """
    seeds = range(5, 240, 11)  # every sample, speed and build-up
    found = np.array([list(pulls(seed).values()) for seed in seeds])
    inside = np.mean(np.abs(found) < 1, axis=0)
    spread = np.sqrt(0.68 * 0.32 / len(found))
    assert (np.abs(inside - 0.68) < 3 * spread).all(), dict(zip(PARAMETERS, inside, strict=True))
    assert (np.abs(found.mean(axis=0)) < 4 / np.sqrt(len(found))).all()
    built_up_later = [seed for seed in seeds if build_up_of(seed) >= 0.2]
    wrong = np.array([pulls(seed, fit_range_mm=(13.2, 18.5))["mu"] for seed in built_up_later])
    assert np.mean(np.abs(wrong) < 1) < 0.2


@pytest.mark.thorough
def test_the_scale_does_not_depend_on_friction() -> None:
    """A failure means the error of μ enters Λ̂, in which it cancels, and makes it twice too large."""
    made = events(scatter=0, jitter=0, k_error=1e-9)
    scales = [fit_models(MADE, made, mu=mu).scale_mm.value for mu in (0.85, 0.89, 0.95)]
    np.testing.assert_allclose(scales, 19.094, atol=0.001)
    assert np.ptp(scales) < 1e-5
    noisy = [fit_models(MADE, events(seed=1), mu=mu).scale_mm.value for mu in np.linspace(0.85, 0.95, 5)]
    assert np.ptp(noisy) < 1e-5
    assert abs(noisy[0] - 19.094) > 0.005  # other data, another Λ̂: its digits are those of the noise
    found = fit_models(MADE, made, mu=0.85)
    assert found.mu.value == 0.85
    assert found.held == ("mu",)
    assert found.n_hat_N.value != pytest.approx(0.57, rel=0.05)


def test_a_stiffness_that_does_not_fall_is_said() -> None:
    """A failure means that Λ̂ and N̂ stand in a table to many digits though K(d) does not determine them."""
    made = events()
    rising = fit(made.assign(K_N_per_mm=4300 + 100 * (made["d_v_mm"] - 13)))
    assert any("not determined" in line for line in rising.warnings)
    for name in ("N_hat_N", "Y_eff_GPa", "Lambda_hat_mm"):
        assert name in rising.undetermined
        assert rising.named()[name].error >= 0.9 * rising.named()[name].value, name
    assert np.isfinite(rising.n_hat_N.value)
    assert rising.effective_sheets(18.0) > 24
    assert not any("not determined" in line for line in fit(made).warnings)
    assert fit(made).undetermined == ()
    given = fit_models(MADE, made.assign(K_N_per_mm=4300.0), modulus_GPa=2.0)  # too small for this K
    assert (given.modulus_GPa.value, given.modulus_GPa.error) == (2.0, 0.0)
    assert any("Λ̂ and N̂ are not determined" in line for line in given.warnings)
    assert {"Lambda_hat_mm", "N_hat_N", "Y_eff_GPa"} <= set(rising.undetermined)
    assert rising.to_json()["undetermined"] == rising.undetermined
    assert "Y_eff_GPa" not in given.undetermined  # it is known
    assert rising._repr_html_().count("not determined") >= 3


@pytest.mark.parametrize("step_mm", [0.002, 0.008])
def test_steps_of_the_displacement_are_in_the_errors(step_mm: float) -> None:
    """A failure means N̂ off by 11 of its errors where a stick is two steps of the displacement long."""
    made = realistic(d1=15.5, noise=0.05, softening=0.0, tau=0.0)
    coarse = made.force.assign(d_mm=np.floor(made.force["d_mm"] / step_mm) * step_mm)
    sticks = find_stick_slip(coarse)
    smooth = find_stick_slip(made.force)
    assert len(sticks) == len(smooth)
    z = (sticks["K_N_per_mm"] - smooth["K_N_per_mm"]) / sticks["K_err_N_per_mm"]
    assert np.nanmedian(np.abs(z)) < 1
    found = fit_models(coarse, sticks)
    assert found.budget["steps"]["N_hat_N"] > 0
    assert "steps" not in fit_models(made.force, smooth).budget
    for name, truth in (("N_hat_N", 0.57), ("Y_eff_GPa", 3.8)):
        one = found.named()[name]
        assert abs(one.value - truth) < 3 * np.hypot(one.error, one.systematic_error), name


def test_given_modulus_and_range_are_used() -> None:
    """A failure means an option of the fit is ignored."""
    found = fit_models(MADE, events(), modulus_GPa=4.0, fit_range_mm=(13.2, 17.0))
    assert (found.modulus_GPa.value, found.modulus_GPa.error) == (4.0, 0.0)
    assert 13.2 <= found.d_mm[0] < 13.3
    assert 16.9 < found.d_mm[1] <= 17.0
    assert found.left_out["outside"] > 20
    with pytest.raises(InputError, match="`fit_range_mm`"):
        fit_models(MADE, events(), fit_range_mm=(20.0, 21.0))
    with pytest.raises(InputError, match="`mu`"):
        fit_models(MADE, events(), mu=-1.0)
    with pytest.raises(InputError, match="check `mu` and"):  # in per cent
        fit_models(MADE, events(), mu=89.0)


def test_another_sample() -> None:
    """A failure means the geometry is not that of the sample, as with 20 sheets of 0.15 mm."""
    sample = Sample(sheets_per_block=20, thickness_mm=0.15)
    d = np.linspace(13.05, 18, 150)
    rng = np.random.default_rng(4)
    k = equations.assembly_stiffness(d, mu=0.89, n_hat_N=0.57, modulus_GPa=3.8, sample=sample)
    made = pd.DataFrame(
        {
            "d_v_mm": d,
            "d_p_mm": d + 0.01,
            "F_p_N": equations.traction(d + 0.01, mu=0.89, sample=sample)
            * (1 + 0.01 * rng.standard_normal(150)),
            "dF_N": 0.34 * equations.total_normal_force(d, mu=0.89, sample=sample),
            "K_N_per_mm": k,
            "K_err_N_per_mm": 0.01 * k,
        }
    )
    found = fit(made, sample)
    assert found.mu.value == pytest.approx(0.89, abs=4 * found.mu.error)
    assert found.modulus_GPa.value == pytest.approx(3.8, rel=0.01)
    wrong = fit(made)
    assert abs(wrong.mu.value - 0.89) > 0.03
    assert abs(wrong.modulus_GPa.value - 3.8) > 0.5


@pytest.mark.thorough
def test_a_geometry_that_contradicts_the_peaks_is_refused() -> None:
    """A failure means μ = 0.128 ± 0.001 and 𝒯0 = −1e45 N from sheets told to be 10 mm thick."""
    with pytest.raises(InputError, match="an offset 𝒯0 of"):
        fit(events(), Sample(thickness_mm=10.0))


def test_what_limits_the_result_is_said() -> None:
    """A failure means an impossible offset, or a model outside its range of V, is printed as a finding."""
    made, offset = events(), "statistical errors from 0, as where the load cell's zero"
    assert not fit(made).warnings  # 4 N of 68 N: a zero that drifted
    assert any(offset in note for note in fit(made).notes)
    large = made.assign(F_p_N=made["F_p_N"] + 4)  # d0 is wrong by some mm, and no error contains it
    (warning,) = fit(large).warnings
    assert offset in warning and "give `d0_err_mm`" in warning
    stated = fit_models(MADE.assign_attrs(d0_err_mm=3.0), large)
    assert not stated.warnings
    assert any(offset in note for note in stated.notes)
    true_zero = fit(made.assign(F_p_N=made["F_p_N"] - 4))
    assert not any("errors from 0" in line for line in (*true_zero.notes, *true_zero.warnings))
    high = fit(made.assign(F_p_N=made["F_p_N"] + 20))
    assert any("𝒯0 = 2" in line for line in high.warnings)
    short = fit(made.assign(F_p_N=made["F_p_N"] + 20).iloc[:8])
    assert short.t0_N.error > 5
    assert not short.warnings
    fast = fit_models(MADE.assign_attrs(speed_mm_min=10.0), made)
    assert any("V ≤ 1 mm/min" in note for note in fast.notes)
    assert not any("V ≤ 1 mm/min" in note for note in fit(made).notes)


def test_the_error_of_d0_is_systematic() -> None:
    """A failure means ±0.1 mm in d0, which moves μ by far more than its error, is not in the result."""
    made = events()
    found = fit_models(MADE.assign_attrs(d0_err_mm=0.1), made, geometry_err={"thickness_mm": 0.002})
    moved = fit_models(MADE, made.assign(d_v_mm=made["d_v_mm"] + 0.1, d_p_mm=made["d_p_mm"] + 0.1))
    (note,) = (line for line in fit(made).notes if "systematic errors do not include the error of d0" in line)
    assert "`d0_err_mm`" in note and "--d0 with its error" in with_options(note, option_names())
    assert not any("the error of d0" in line for line in found.notes)
    part = found.budget["d0"]["mu"]
    assert part == pytest.approx(abs(moved.mu.value - fit(made).mu.value), rel=0.1)
    assert part > 10 * found.mu.error
    assert found.mu.systematic_error >= np.hypot(part, found.budget["thickness_mm"]["mu"])
    assert found.budget["thickness_mm"]["mu"] == pytest.approx(0.89 * 0.02, rel=0.1)
    assert set(found.to_json()["budget"]) == {"d0", "load_drift", "thickness_mm"}


@pytest.mark.thorough
@pytest.mark.parametrize("hertz", [3.0, 4.0, 5.0])
def test_a_filter_that_settles_within_the_sticks_is_an_error_of_the_scale(hertz: float) -> None:
    """A failure means Λ̂ off by several of its errors, since what a filter leaves of a slip tilts short sticks
    more than long ones."""
    made = realistic(tau=0.0, noise=0.1, d1=14.2, softening=0.0)
    load = made.force["load_N"].to_numpy()
    found = []
    for filtered in (load, sosfilt(butter(2, hertz, fs=200.0, output="sos"), load)):
        force = made.force.assign(load_N=("time_s", filtered))
        events = find_stick_slip(force)
        # The filter rounds the valleys, but leaves no jumps upward; the last slip it delays to the end.
        late = events["t_p_s"].to_numpy() - made.truth["t_p_s"].to_numpy()[: len(events)]
        assert len(made.truth) - len(events) <= 1 and np.abs(late).max() < 0.2
        found.append(fit_models(force, events).scale_mm)
    sharp, blurred = found
    off = abs(blurred.value - sharp.value)
    assert off > 2 * np.hypot(blurred.error, sharp.error)
    assert off < 2 * np.hypot(blurred.error, blurred.systematic_error)
    assert blurred.systematic_error < 0.1 * blurred.value


def test_a_wrong_d0_is_a_warning_with_a_next_step() -> None:
    """A failure means that a third of the events is left out, and μ 7 % too large, without a word."""
    right = events(count=400, d1=18.0, scatter=0.004)
    wrong = right.assign(d_v_mm=right["d_v_mm"] + 1, d_p_mm=right["d_p_mm"] + 1)
    assert not fit(right).warnings
    found = fit(wrong)
    assert abs(found.mu.value - 0.89) > 10 * found.mu.error
    assert any("check `d0_mm`" in line for line in found.warnings)


def test_settings_reach_the_fits() -> None:
    """A failure means that `tuning.fits` stops somewhere on the way."""
    made = events(count=200, scatter=0.01)
    assert not fit(made).warnings
    strict = FitSettings(unlike_drops=0.001, most_unfitted=0.25, largest_scale=1.001)
    lines = fit(made, settings=strict).warnings
    assert any("the drops scatter" in line for line in lines)
    assert any("K does not fall with d" in line for line in lines)
    with pytest.raises(InputError, match="at least 1000 whole events"):
        fit(made, settings=FitSettings(least_events=1000))
