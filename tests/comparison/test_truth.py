"""Simulated tests of known truth: what compare states of them must hold."""

import numpy as np
import pandas as pd
import pytest

import vision
from tests.scenes.comparison import campaign, events, write_campaign, write_run
from vision.comparison import CompareSettings
from vision.comparison.runs import read_tests
from vision.comparison.trends import find_irregular, find_trends
from vision.models import equations
from vision.sample import Sample

pytestmark = pytest.mark.thorough


def campaigns(folder, seeds):
    for seed in seeds:
        truth = campaign(np.random.default_rng(seed))
        folders, table = write_campaign(folder / str(seed), truth, seed=1000 * seed)
        yield truth, vision.compare(folders, table)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Three campaigns of twelve tests of three samples over V, humidity and age."""
    return list(campaigns(tmp_path_factory.mktemp("campaigns"), (0, 1, 2)))


def deviations(truth, table):
    """Each parameter's deviation from the truth over its stated error."""
    scale = equations.separation_scale_mm(mu=truth["mu"], n_hat_N=truth["n_hat"])
    errors = {
        "N_hat_N": np.hypot(table["N_hat_err_N"], table["N_hat_systematic_N"]),
        "Lambda_hat_mm": np.hypot(table["Lambda_hat_err_mm"], table["Lambda_hat_systematic_mm"]),
    }
    return pd.DataFrame(
        {
            "mu": (table["mu"] - truth["mu"]) / table["mu_err"],
            "T0_N": (table["T0_N"] - truth["t0"]) / table["T0_err_N"],
            "A": (table["A"] - 0.34) / table["A_err"],
            "N_hat_N": (table["N_hat_N"] - truth["n_hat"]) / errors["N_hat_N"],
            "Lambda_hat_mm": (table["Lambda_hat_mm"] - scale) / errors["Lambda_hat_mm"],
        }
    )


def test_every_true_value_lies_within_its_stated_errors(found):
    """A failure means errors that are too small, or so wide that they say nothing."""
    off = pd.concat([deviations(truth, c.table) for truth, c in found])
    within = (off.abs() < 2).mean()
    assert (within >= 0.86).all()  # 36 values each, 95.4 % expected: fewer than 31 is a chance of 2e-3
    assert (off.abs() < 2).to_numpy().mean() > 0.92
    assert off.abs().to_numpy().max() < 4
    rms = np.sqrt((off**2).mean())
    assert rms.between(0.5, 1.5).all()


def test_a_wrong_modulus_shows(found, tmp_path):
    """The check of the truths must be able to fail: Λ̂ with 10 % too much Y_eff is many errors away."""
    truth = found[0][0]
    folders, table = write_campaign(tmp_path, truth)
    wrong = vision.compare(folders, table, modulus_GPa=4.2).table
    assert (deviations(truth, wrong.assign(Lambda_hat_systematic_mm=0.0))["Lambda_hat_mm"].abs() > 2).all()
    assert (wrong["chi2_dof"] > 1.5).mean() > 0.5


def test_the_collapse_reaches_the_noise(found):
    """A failure means that the tests' own Λ̂ leave differences that are no noise, or that none were there."""
    for _, comparison in found:
        c = comparison.collapse
        assert c.rms_after == pytest.approx(c.rms_noise, rel=0.1)
        assert c.rms_before > 4 * c.rms_noise


def test_trends_that_are_there_are_found_with_their_slopes(found):
    """A failure means that ageing or humidity is overlooked, or its size misread."""
    off = []
    for _, comparison in found:
        trends = {(t.quantity, t.predictor): t for t in comparison.trends}
        humid, aged = trends["mu", "RH_percent"], trends["N_hat_N", "n_test"]
        assert humid.claimed
        assert aged.claimed
        assert humid.spearman > 0.9
        assert trends["Lambda_hat_mm", "n_test"].partial_slope < 0 < humid.partial_slope
        assert trends["Lambda_hat_mm", "RH_percent"].partial_slope > 0
        off += [
            (humid.partial_slope - 0.004) / humid.partial_slope_err,
            (aged.partial_slope - 0.012) / aged.partial_slope_err,
        ]
    assert np.abs(off).max() < 3  # with t of 9 degrees of freedom


def null_table(rng, *, confounded=False, count=12):
    """Twelve tests without trends, or with μ on humidity alone while age goes with humidity."""
    rh = rng.uniform(28, 55, count)
    n_test = rng.uniform(9, 28, count)
    mu = 0.87 + 0.02 * rng.standard_normal(count)
    if confounded:
        n_test = 18 + 0.6 * (rh - 41) + 3 * rng.standard_normal(count)
        mu = mu + 0.004 * (rh - 41)
    error = np.full(count, 0.002)
    return pd.DataFrame(
        {
            "n_test": n_test,
            "RH_percent": rh,
            "mu": mu,
            "mu_err": error,
            "N_hat_N": 0.6 + 0.05 * rng.standard_normal(count),
            "N_hat_err_N": error,
            "Lambda_hat_mm": 19 + 0.5 * rng.standard_normal(count),
            "Lambda_hat_err_mm": 10 * error,
        }
    )


def test_a_trend_that_is_not_there_is_not_claimed():
    """Any claim at all in at most 5 % of draws: 100 draws give fewer than 12 claims (chance 0.5 %)."""
    rng = np.random.default_rng(7)
    settings = CompareSettings(draws=300)
    claims = [any(t.claimed for t in find_trends(null_table(rng), settings)) for _ in range(100)]
    assert sum(claims) < 12


def test_a_trend_through_the_other_predictor_is_not_claimed():
    """A failure means that age is blamed for what humidity does."""
    rng = np.random.default_rng(8)
    settings = CompareSettings(draws=300)
    direct, through, marginal = 0, 0, 0
    for _ in range(40):
        found = find_trends(null_table(rng, confounded=True), settings)
        trends = {(t.quantity, t.predictor): t for t in found}
        through += trends["mu", "n_test"].claimed
        direct += trends["mu", "RH_percent"].claimed
        marginal += trends["mu", "n_test"].p < 0.05
    assert through < 6
    assert direct > through
    assert marginal > 12  # on its own, age does seem to matter: the partial slope is what tells


def test_one_friction_coefficient_for_four_velocities(tmp_path):
    """0.5, 1, 5 and 10 mm/min with offsets of their own give one μ within its error, and A."""
    offsets = (-6.0, 3.0, 8.0, -1.0)
    folders = [
        write_run(tmp_path / f"v{v:g}", events(t0=t0, speed=v, seed=k), speed=v)
        for k, (v, t0) in enumerate(zip((0.5, 1, 5, 10), offsets, strict=True))
    ]
    (joint,) = vision.compare(folders).joint
    assert joint.mu.value == pytest.approx(0.89, abs=3 * joint.mu.error)
    assert joint.mu.error < 0.0005
    assert joint.t0_N == pytest.approx(offsets, abs=0.6)
    assert joint.at_limit == ()
    assert joint.disagreement < 4
    assert joint.amplitude.value == pytest.approx(0.34, abs=3 * joint.amplitude.error)


def measured_wrongly(folder, rng, *, stated):
    """Four tests of one sheet that is 2 % thicker or thinner than told, each with a d0 off by 0.1 mm."""
    folders = []
    errors = {"input_errors": {"thickness_mm": 0.002, "d0_mm": 0.1}} if stated else {}
    true = Sample(thickness_mm=0.1 + 0.002 * rng.standard_normal())
    for k in range(4):
        made = events(sample=true, step=0.15, seed=int(rng.integers(1 << 30)))
        made[["d_v_mm", "d_p_mm"]] += 0.1 * rng.standard_normal()
        folders.append(write_run(folder / str(k), made, models=errors))
    return vision.compare(folders).joint[0]


def test_errors_of_the_geometry_and_of_d0_are_in_that_of_the_joint_mu(tmp_path):
    """A failure means a joint μ that is stated ten times better than thickness and d0 are known."""
    off = {}
    for stated, draws in ((True, 10), (False, 4)):
        rng = np.random.default_rng(5)
        joint = [measured_wrongly(tmp_path / f"{stated}{k}", rng, stated=stated).mu for k in range(draws)]
        total = [np.hypot(one.error, np.nan_to_num(one.systematic_error)) for one in joint]
        off[stated] = np.array([one.value - 0.89 for one in joint]) / total
        if stated:
            shared = np.array([one.systematic_error for one in joint])
            own = np.array([one.error for one in joint])
    assert shared == pytest.approx(0.0178, rel=0.1)  # μ ε is what the peaks give
    assert (own < 0.01).all()  # d0: 0.0067 each, halved by four tests, or the scatter that it leaves
    assert 0.6 < np.sqrt(np.mean(off[True] ** 2)) < 1.6  # 10 draws; few are enough to be wrong
    assert np.sqrt(np.mean(off[False] ** 2)) > 2  # scatter between the tests shows d0, nothing the thickness


def three_samples(rng, *, apart, slope=0.0):
    """(table, shared): nine tests of three samples whose thickness is known to 2 %; with `apart` each sample
    has its own range of n_test."""
    n_test = np.array([9, 11, 13, 16, 18, 20, 23, 25, 27.0])
    order = np.arange(9) if apart else rng.permutation(9)
    n_test = n_test[order]
    shared = np.kron(np.eye(3), np.ones(3)) * 0.0178
    mu = 0.87 + slope * (n_test - 18) + 0.002 * rng.standard_normal(9) + rng.standard_normal(3) @ shared
    names = {"N_hat_N": np.nan, "N_hat_err_N": 1.0, "Lambda_hat_mm": np.nan, "Lambda_hat_err_mm": 1.0}
    columns = {"n_test": n_test, "RH_percent": rng.uniform(28, 55, 9), "mu": mu, "mu_err": 0.002}
    return pd.DataFrame(columns | names), {"mu": shared}


def test_samples_of_unlike_thickness_make_no_trend():
    """A failure means that an error of the geometry, which a whole sample shares, is taken for ageing."""
    rng, settings = np.random.default_rng(11), CompareSettings(draws=300)
    claims = {True: 0, False: 0}
    for _ in range(60):
        table, shared = three_samples(rng, apart=True)
        for known in claims:
            found = find_trends(table, settings, shared=shared if known else None)
            claims[known] += next(t for t in found if (t.quantity, t.predictor) == ("mu", "n_test")).claimed
    assert claims[True] <= 6
    assert claims[False] > 15


def test_a_trend_within_the_samples_is_claimed_all_the_same():
    """A failure means that the errors of the geometry hide what they cannot have made."""
    rng, settings = np.random.default_rng(12), CompareSettings(draws=300)
    claims = 0
    for _ in range(20):
        table, shared = three_samples(rng, apart=False, slope=0.006)
        found = find_trends(table, settings, shared=shared)
        claims += next(t for t in found if (t.quantity, t.predictor) == ("mu", "n_test")).claimed
    assert claims >= 12


def test_offsets_beyond_the_limit_are_said(tmp_path):
    """A failure means that an offset of 20 N, which no zeroed load cell has, passes unnoticed."""
    folders = [write_run(tmp_path / f"r{k}", events(t0=t0, seed=k)) for k, t0 in enumerate((0.0, 1.0, 20.0))]
    found = vision.compare(folders)
    assert found.joint[0].at_limit == ("r2",)
    assert any(line.startswith("r2: offset") for line in found.warnings)


def test_another_geometry_is_used(tmp_path):
    """A failure means that another laboratory's sample is taken for the publication's."""
    sample = Sample(sheets_per_block=20, thickness_mm=0.15)
    made = events(sample=sample, modulus=3.8)
    folder = write_run(tmp_path / "theirs", made, sample=sample)
    row = vision.compare([folder], modulus_GPa=3.8).table.iloc[0]
    assert row["mu"] == pytest.approx(0.89, abs=4 * row["mu_err"])
    assert row["N_hat_N"] == pytest.approx(0.57, abs=4 * row["N_hat_err_N"])
    assumed = vision.compare([write_run(tmp_path / "ours", made)], modulus_GPa=3.8).table.iloc[0]
    assert abs(assumed["mu"] - 0.89) > 20 * assumed["mu_err"]


def test_the_build_up_is_left_out(tmp_path):
    """Events before the maximum must not bias μ; with them it is many errors off."""
    made = events(d=(13.0, 17.5), seed=3)
    share = 1 - np.exp(-(made["d_p_mm"] - 13.0) / 0.03)
    made["F_p_N"] *= share
    row = vision.compare([write_run(tmp_path / "run", made)]).table.iloc[0]
    assert row["mu"] == pytest.approx(0.89, abs=0.003)
    assert row["events_used"] < row["events"]
    assert "left out" in row["notes"]


def irregularity(folder, **options):
    return find_irregular(read_tests([write_run(folder, events(step=0.012, **options))]).tests[0])


def test_the_place_where_sticks_turn_irregular(tmp_path):
    """As at V = 10 mm/min in the publication: scatter of 6 % turns into 25 % at 16.2 mm."""
    off, errors = [], []
    for seed in range(12):
        one = irregularity(
            tmp_path / str(seed), irregular_from=16.2, irregular=0.25, jitter=0.06, scatter=0.0, seed=seed
        )
        if one.reason:
            continue
        assert one.before == pytest.approx(0.06, rel=0.25)
        assert one.after == pytest.approx(0.25, rel=0.25)
        off.append(one.change_mm - 16.2)
        errors.append(one.change_err_mm)
    assert len(off) >= 10  # of 12
    assert np.mean(np.abs(off) < 2 * np.array(errors)) >= 0.8
    assert np.max(np.abs(off)) < 0.2


def test_regular_sticks_have_no_change(tmp_path):
    """Neither even scatter nor measuring noise that grows against a falling ΔF is a change."""
    claimed = 0
    for seed in range(30):
        claimed += irregularity(tmp_path / f"even{seed}", seed=seed).reason == ""
    assert claimed <= 2
    rising = 0
    for seed in range(20):
        made = events(step=0.012, jitter=0.02, seed=seed)
        made["dF_N"] += np.random.default_rng(seed).normal(0, 0.6, len(made))
        test = read_tests([write_run(tmp_path / f"noisy{seed}", made)]).tests[0]
        rising += find_irregular(test).reason == ""
    assert rising <= 2


def test_too_few_events_for_a_change(tmp_path):
    """A failure means a change point from a handful of events."""
    test = read_tests([write_run(tmp_path / "short", events(step=0.2))]).tests[0]
    assert "needed" in find_irregular(test).reason


def test_one_scale_for_all_weighs_every_event_alike(tmp_path):
    """Many events of one geometry beside few of another, N̂ 0.5 against 0.7 N.  A failure means that the
    distance before the collapse is that from a scale which no test has most of its events at."""
    thick = Sample(thickness_mm=0.12)
    many = write_run(tmp_path / "many", events(n_hat=0.5, step=0.02, seed=1))
    made = events(n_hat=0.7, step=0.1, seed=2, sample=thick)
    few = write_run(tmp_path / "few", made, sample=thick)
    found = vision.compare([many, few], modulus_GPa=3.8)
    of_each = found.table["Lambda_hat_mm"].to_numpy()
    count = found.collapse.table["run"].value_counts()[["many", "few"]].to_numpy()
    assert count[0] > 3 * count[1] and abs(np.diff(of_each)[0]) > 0.5
    assert found.collapse.common_scale_mm == pytest.approx(np.average(of_each, weights=count), abs=0.02)


def test_of_sticks_with_knees_the_slope_after_the_knee_counts(tmp_path):
    """A failure means that Λ̂ of fast pulls comes from a K that mixes the slopes before and after the knee,
    while the Y_eff of their runs does not."""
    made = events()
    bent = made.assign(
        K_N_per_mm=1.05 * made["K_N_per_mm"],
        K2_N_per_mm=made["K_N_per_mm"],
        K2_err_N_per_mm=made["K_err_N_per_mm"],
    )
    runs = [write_run(tmp_path / name, table) for name, table in (("straight", made), ("bent", bent))]
    scales = [vision.compare([run], modulus_GPa=3.8).table["Lambda_hat_mm"].iloc[0] for run in runs]
    assert scales[1] == pytest.approx(scales[0], rel=1e-9)
    assert scales[0] == pytest.approx(19.09, abs=0.05)


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_a_modulus_from_fast_tests_alone_is_warned_of(speed, tmp_path):
    """A failure means that Λ̂ and N̂ of all tests rest on a Y_eff for which the models do not hold, unsaid."""
    made = events(speed=speed)
    found = vision.compare([write_run(tmp_path / "run", made, speed=speed)])
    assert any("is slow" in line for line in found.warnings) == (speed > 1)
