"""Camera movement against sheets that creep: both sides, one side, unlike sides."""

from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.creeping import (
    PIXEL_UM,
    Clock,
    errors,
    make,
    measure,
    profile,
    relaxing,
    straight,
    uniform,
)
from vision.data import warnings_of
from vision.deformation import DeformationSettings, horizontal_deformation
from vision.deformation.common_mode import BothSides, common_mode_motion
from vision.shells import classify_shells


@pytest.mark.parametrize("movement", [{"drift_px_s": 0.3}, {"vibration_px": 0.15}])
def test_camera_movement_is_taken_off(movement):
    """A failure means that a camera that shakes or drifts passes for sheets that move."""
    made = make(profile(np.full(40, 6.0)), stick_um=10.0, noise_px=0.02, **movement)
    wrong, stated = errors(made, measure(made))
    assert abs(wrong.mean()) < 0.003
    assert 0.60 < np.mean(np.abs(wrong) < stated) < 0.75
    careless, _ = errors(made, measure(made, common_mode=False))
    assert careless.std() > 1.5 * wrong.std()


def at_some_slips(made, share):
    """The made tracks if each sheet slips in only this share of the slips, and creeps on in the others."""
    begin = made.sticks["t_v_s"].to_numpy() - 5
    stick = np.clip(np.searchsorted(begin, made.tracks["time_s"], side="right") - 1, 0, None)
    slips = np.random.default_rng(4).uniform(size=made.sweep_px.shape) < share
    creep, ahead = np.zeros(slips.shape), made.sweep_px
    for event in range(1, len(creep)):
        on = creep[event - 1] + (ahead[event - 1] + ahead[event]) / 2
        creep[event] = np.where(slips[event], 0.0, on)
    inwards = -made.tracks["side"].to_numpy() * creep
    return replace(made, tracks=made.tracks.assign(x_px=made.tracks["x_px"] + inwards[stick]))


def one_side(made, **options):
    """(measured - true ratio, stated error, Dataset) with the right side alone in view."""
    half = made.tracks.sizes["sheet"] // 2
    right = made.tracks.isel(sheet=slice(half, None))
    motion = horizontal_deformation(right, made.sticks, Clock(), pixel_size_um=PIXEL_UM, **options)
    return motion["ratio"].to_numpy() - made.ratio[:, half:], motion["ratio_err"].to_numpy(), motion


@pytest.mark.parametrize("events", [1, 2, 3])
def test_few_sticks_do_not_tell_what_sheets_repeat(events):
    """A failure means errors twice as large in a film of one stick, and sheets that "slip in turn" there."""
    made = [make(profile(np.full(events, 6.0)), stick_um=10.0, noise_px=0.02, seed=k) for k in range(4)]
    motions = [measure(one) for one in made]
    off = [errors(one, motion) for one, motion in zip(made, motions, strict=True)]
    assert 0.60 < np.mean([np.abs(wrong) < stated for wrong, stated in off]) < 0.75
    assert not any(warnings_of(motion) for motion in motions)


KNOCKED = {  # events, knock in px, sheets, shape of the creep, RMS error of σ_x/Λ_st
    "both sides": (11, 1.0, slice(None), straight, 0.02),
    "a hard knock": (11, 5.0, slice(None), straight, 0.02),
    "two sticks": (2, 1.0, slice(None), straight, 0.02),
    "one side": (11, 1.0, slice(25, None), straight, 0.02),
    "two sticks of one side": (2, 1.0, slice(25, None), straight, 0.5),  # the camera's movement is not known
    "creep that slows down": (11, 1.0, slice(None), relaxing(1.5), 0.1),  # half of it was seen
    "no knock": (11, 0.0, slice(None), relaxing(1.5), 0.1),
}


@pytest.mark.parametrize("case", KNOCKED)
def test_sheets_hidden_before_or_after_a_knock(case):
    """A failure means that a sheet which is hidden for part of a stick, in which the camera is knocked, has a
    σ_x/Λ_st of many times its own with a small error and no flag."""
    events, knock_px, sheets, shape, rms = KNOCKED[case]
    off = []
    for seed in range(16):
        made = make(profile(np.full(events, 8.0)), noise_px=0.03, shape=shape, seed=seed)
        rng, tracks = np.random.default_rng(seed), made.tracks
        x, time = tracks["x_px"].values.copy(), tracks["time_s"].values
        start, stop = made.sticks.loc[events // 2, ["t_v_s", "t_p_s"]] - 5
        at = start + (stop - start) * rng.uniform(0.3, 0.7)
        x += knock_px * (time > at)[:, None]
        part = (time > start) & (time < stop) & ((time < at) if seed % 2 else (time > at))
        hidden = rng.choice(np.arange(50)[sheets], 3, replace=False)
        x[np.ix_(part, hidden)] = np.nan
        seen = tracks.assign(x_px=(tracks["x_px"].dims, x)).isel(sheet=sheets)
        motion = horizontal_deformation(seen, made.sticks, Clock(), pixel_size_um=PIXEL_UM)
        found = motion.isel(event=events // 2).sel(sheet=hidden)
        wrong = found["ratio"] - made.ratio[events // 2, hidden]
        off += list(zip(wrong.values, found["ratio_err"].values, strict=True))
    wrong, stated = np.array([pair for pair in off if np.isfinite(pair).all()]).T
    assert wrong.size >= 12
    assert np.mean(np.abs(wrong) < stated) > 0.55
    assert (np.abs(wrong) < 4 * stated).all()
    assert np.sqrt(np.mean(wrong**2)) < rms


def test_one_side_in_view_tells_drift_from_creep():
    """A failure means that a camera that drifts, or shakes, passes for sheets that all creep one way."""
    made = make(profile(np.full(40, 6.0)), stick_um=10.0, noise_px=0.02, vibration_px=0.1, drift_px_s=0.1)
    wrong, stated, motion = one_side(made)
    assert abs(wrong.mean()) < 0.003
    assert 0.60 < np.mean(np.abs(wrong) < stated) < 0.78
    assert (
        motion.attrs["camera_movement"] == "vibration subtracted, and the part of drift that one side shows"
    )
    assert measure(made).attrs["camera_movement"] == "vibration and drift subtracted"
    careless, _, _ = one_side(made, common_mode=False)
    assert abs(careless.mean()) > 0.01


def test_one_side_with_sheets_that_skip_slips():
    """A failure means that their wandering passes for movement of the camera, or widens all errors."""
    made = at_some_slips(make(profile(np.full(40, 8.0)), noise_px=0.02), 0.5)
    wrong, stated, motion = one_side(made)
    assert np.abs(motion["drift_um"]).max() < 0.06 * np.median(made.sweep_px.max(axis=1)) * PIXEL_UM
    assert 0.60 < np.mean(np.abs(wrong) < stated) < 0.85


def test_one_side_before_a_camera_that_moves_at_every_slip():
    """What it does there passes for drift within the sticks, which nothing on one side contradicts.

    A failure means that σ_x/Λ_st is wrong by many of its errors, and the shell's interval misses the truth.
    """
    made = make(profile(np.full(40, 8.0)), noise_px=0.02, seed=1)
    hops_px = np.cumsum(np.random.default_rng(6).normal(0, 0.7, 40))
    stick = np.searchsorted(made.sticks["t_v_s"], 5 + made.tracks["time_s"], side="right") - 1
    made.tracks["x_px"] = made.tracks["x_px"] + hops_px[np.maximum(stick, 0)][:, None]
    wrong, stated, motion = one_side(made)
    assert np.mean(np.abs(wrong) < stated) > 0.5
    assert np.abs(wrong / stated).max() < 4
    shells = classify_shells(motion)
    truth = (made.ratio[:, 25:] < 0.1).sum(axis=1)
    assert np.mean((shells["stiff_low"] <= truth) & (truth <= shells["stiff_high"])) > 0.8


def test_one_side_before_a_camera_that_vibrates_in_step_with_the_slips():
    """Four vibrations a stick drift alike in dozens of sticks. A failure means that this passes for creep of
    all sheets, with an error that does not hold it."""
    made = make(profile(np.full(80, 6.0)), frames=10.0, noise_px=0.02, jitter=0.0)
    shake_px = 0.2 * np.sin(2 * np.pi * 24.04 * made.tracks["time_s"])
    made.tracks["x_px"] = made.tracks["x_px"] + shake_px
    wrong, stated, _ = one_side(made)
    assert np.mean(np.abs(wrong) < stated) > 0.6
    assert np.mean(np.abs(wrong) < 2 * stated) > 0.9
    settings = DeformationSettings(innermost_share=np.nan)
    blind, careless, _ = one_side(made, settings=settings)
    assert np.mean(np.abs(blind) < careless) < 0.4


def test_one_side_with_sheets_that_are_seldom_seen():
    """A failure means that a sheet seen in two sticks says how the camera drifts: σ_x/Λ_st of 5 with an error
    of 0.02."""
    made = make(profile(np.full(40, 6.0)), frames=9.0, noise_px=0.02)
    rng = np.random.default_rng(2)
    seen = np.ones(made.tracks["x_px"].shape, bool)
    for sheet in (28, 33, 41, 44):
        seen[:, sheet] = rng.random(len(seen)) < 0.15
    made.tracks["x_px"] = made.tracks["x_px"].where(seen)
    wrong, stated, _ = one_side(made)
    known = np.isfinite(wrong)
    assert np.abs(wrong[known]).max() < 0.1
    assert 0.62 < np.mean(np.abs(wrong[known]) < stated[known]) < 0.80


def test_one_side_in_noise_shows_a_camera_that_sways():
    """The creep of the sheets differs by four times its noise. A failure means that this is taken for too
    little to show a camera that sways by more, which then passes for creep of all sheets."""
    made = make(profile(np.full(20, 6.0)), stick_um=10.0, noise_px=0.15)
    made.tracks["x_px"] = made.tracks["x_px"] + 0.3 * np.sin(2 * np.pi * 1.7 * made.tracks["time_s"])
    wrong, stated, _ = one_side(made)
    assert np.sqrt(np.mean(wrong**2)) < 0.05
    assert np.mean(np.abs(wrong) < stated) > 0.6
    careless, _, _ = one_side(made, settings=DeformationSettings(one_side_contrast=25.0))
    assert np.sqrt(np.mean(careless**2)) > 0.1


def test_one_side_that_creeps_alike_says_nothing_of_drift():
    """A failure means that a drift is invented from sheets that all do the same, or errors ignore it."""
    made = make(uniform(1.0, 20.0, events=20), noise_px=0.02, vibration_px=0.1)
    wrong, stated, motion = one_side(made)
    assert (motion["drift_um"] == 0).all()
    assert np.mean(np.abs(wrong) < stated) > 0.60


@pytest.mark.parametrize("overlooked", [1, 3, 12])
def test_an_overlooked_sheet(overlooked):
    """A failure means that pairs of unlike sheets make all of them pass for moved by the camera."""
    made = make(profile(np.full(30, 8.0)), noise_px=0.01)
    side, n = made.tracks["side"], made.tracks["n"]
    kept = np.flatnonzero(~((side == 1) & (n == overlooked)).to_numpy())
    shifted = (n - ((side == 1) & (n > overlooked)).astype(int)).isel(sheet=kept)
    tracks = made.tracks.isel(sheet=kept).assign_coords(n=("sheet", shifted.to_numpy()))
    motion = horizontal_deformation(tracks, made.sticks, Clock(), pixel_size_um=PIXEL_UM)
    wrong = motion["ratio_signed"].to_numpy() - made.ratio[:, kept]
    assert np.abs(wrong.mean(axis=0)).max() < 0.001
    assert 0.60 < np.mean(np.abs(wrong) < motion["ratio_err"].to_numpy()) < 0.75


def test_six_sheets_are_enough():
    """A failure means that errors forget how much of six sheets' noise goes into what they have in common."""
    made = make(uniform(1.0, 20.0, events=300, sheets=3), noise_px=0.05, vibration_px=0.1)
    motion = measure(made)
    wrong, stated = errors(made, motion)
    assert motion["noise_um"].mean() / PIXEL_UM == pytest.approx(0.05, rel=0.03)
    assert np.sqrt(np.mean((wrong / stated) ** 2)) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("noise_px", [0.02, 0.05])
def test_sides_that_differ_before_a_still_camera_are_not_biased(noise_px):
    """left = 0.8 × right: 0.002 to 0.005 too much of one side and too little of the other, once.

    A failure means that a difference of the sides passes for movement of the camera.
    """
    made = make(profile(np.full(30, 8.0)), noise_px=noise_px)
    left = (made.tracks["side"] < 0).to_numpy()
    rest = 20.0 * made.tracks["side"] * (made.tracks["n"] - 0.5) + 960
    x = made.tracks["x_px"].where(~left, rest + 0.8 * (made.tracks["x_px"] - rest))
    motion = horizontal_deformation(made.tracks.assign(x_px=x), made.sticks, Clock(), pixel_size_um=PIXEL_UM)
    wrong = motion["ratio_signed"].to_numpy() - made.ratio * np.where(left, 0.8, 1.0)
    assert abs(wrong[:, left].mean()) < 0.0005
    assert abs(wrong[:, ~left].mean()) < 0.0005
    assert 0.60 < np.mean(np.abs(wrong) < motion["ratio_err"].to_numpy()) < 0.75


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_shells_that_differ_between_the_sides(share):
    """8 stiff sheets left and 16 right.  A failure means that what the inner sheets differ by passes for
    movement of the camera, with errors that do not know."""
    left, right = (
        at_some_slips(make(profile(np.full(30, m)), noise_px=0.02, seed=3), share) for m in (8.0, 16.0)
    )
    of_right = (left.tracks["side"] > 0).to_numpy()
    tracks = left.tracks.assign(x_px=left.tracks["x_px"].where(~of_right, right.tracks["x_px"]))
    motion = horizontal_deformation(tracks, left.sticks, Clock(), pixel_size_um=PIXEL_UM)
    wrong = motion["ratio_signed"].to_numpy() - np.where(of_right, right.ratio, left.ratio)
    assert np.abs(wrong.mean(axis=0)).max() < 0.007
    assert 0.60 < np.mean(np.abs(wrong) < motion["ratio_err"].to_numpy()) < 0.80


def test_paper_that_settles_is_in_the_errors():
    """Paper relaxes: every sheet has its own steady movement.  A failure means that it passes for movement of
    the camera, or for creep, with errors that do not know it, or that nobody is told."""
    made = make(profile(np.full(30, 8.0)), noise_px=0.02)
    rate = np.random.default_rng(1).normal(0, 0.06, made.tracks.sizes["sheet"])  # px/s to the right
    moved = made.tracks["x_px"] + made.tracks["time_s"].to_numpy()[:, None] * rate
    motion = horizontal_deformation(
        made.tracks.assign(x_px=moved), made.sticks, Clock(), pixel_size_um=PIXEL_UM
    )
    length_s = (made.sticks["t_p_s"] - made.sticks["t_v_s"]).to_numpy()[:, None]
    sweep_um = PIXEL_UM * length_s * -made.tracks["side"].to_numpy() * rate
    own = sweep_um / np.sqrt(12) / made.sticks["stick_length_um"].to_numpy()[:, None]
    off = (motion["ratio_signed"].to_numpy() - made.ratio) / motion["ratio_err"].to_numpy()
    moved_off = off - own / motion["ratio_err"].to_numpy()
    assert 0.8 < np.sqrt(np.mean(off**2)) < 1.1  # the creep
    assert np.sqrt(np.mean(moved_off**2)) < 1.0  # the creep with the settling
    assert "sheets move steadily" in motion.attrs["warnings"][0]


@pytest.mark.parametrize("made_of", [{"noise_px": 0.005}, {"shape": relaxing(2.0), "jitter": 0.2}])
def test_shells_and_sticks_that_change_do_not_breathe(made_of):
    """A failure means errors that are far too large, with a warning, where sheets creep as they should."""
    made = make(profile(np.linspace(14, 4, 40)), frames=30, **({"noise_px": 0.03} | made_of))
    wrong, stated = errors(made, motion := measure(made))
    assert motion.attrs["warnings"] == []
    assert np.sqrt(np.mean((wrong / stated) ** 2)) > 0.5


def test_sheets_that_slip_in_turn_are_in_the_errors():
    """The outermost sheets slip with the force, the innermost a quarter of a stick later.  A failure means
    that a slip within the stick shrinks the creep by more than the error, or that nobody is told."""
    frames = 40
    made = make(profile(np.full(40, 8.0)), noise_px=0.02, frames=frames)
    late = np.rint(frames / 4 * (1 - made.tracks["n"].to_numpy() / 25)).astype(int)
    frame = np.maximum(np.arange(made.tracks.sizes["frame"])[:, None] - late, 0)
    x_px = np.take_along_axis(made.tracks["x_px"].to_numpy(), frame, axis=0)
    made.tracks["x_px"] = made.tracks["x_px"].dims, x_px
    motion = measure(made)
    creep = made.ratio * (1 - late / frames)  # within the stick
    off = np.abs(motion["ratio_signed"].to_numpy() - creep) / motion["ratio_err"].to_numpy()
    assert np.mean(off < 1) > 0.85
    assert np.mean(off < 2) > 0.95
    assert "sheets bend alike in every stick" in motion.attrs["warnings"][0]


def test_the_bends_of_few_sticks_may_be_noise():
    """A failure means that a short film of quiet sheets is said to show slips in turn."""
    films = [measure(make(profile(np.full(3, 6.0)), noise_px=0.02, seed=seed)) for seed in range(4)]
    assert [film.attrs["warnings"] for film in films] == [[]] * 4


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_good_sheets_get_no_warning_of_their_own_movement(share):
    """Also sheets that skip slips.  A failure means a warning that names what the film does not show."""
    made = at_some_slips(make(profile(np.linspace(6, 14, 40)), noise_px=0.02, drift_px_s=0.1), share)
    assert measure(made).attrs["warnings"] == []


@pytest.mark.parametrize("pairs", [3, 5, 10])
def test_few_pairs_whose_sheets_move_by_themselves(pairs):
    """A failure means that the innermost pair, which the drift follows, passes for one that never moves by
    itself: of three pairs, a fifth of the errors hold."""
    rng = np.random.default_rng(pairs)
    held = []
    for _ in range(40):
        creep = np.linspace(0.2, 2, pairs) * rng.uniform(0.7, 1.3, (60, 1))
        drift = 0.3 * rng.standard_normal((60, 1))
        middle = drift + 0.1 * rng.standard_normal(creep.shape)
        noise = 0.03 * rng.standard_normal((60, 2 * pairs))
        at = np.arange(pairs)
        both = BothSides(at, at + pairs, np.zeros((60, 2 * pairs)), 3)
        found = both.drift(np.hstack([middle + creep, middle - creep]) + noise, 0 * noise + 0.03, slow=False)
        held.append(np.mean(np.abs(found.value - drift[:, 0]) < found.error))
    assert 0.6 < np.mean(held) < 0.75


def test_a_camera_that_bends_with_every_stick_and_springs_back():
    """A failure means that movement of the camera is left in, as it leaves the sheets where they were."""
    made = make(profile(np.full(30, 8.0)), noise_px=0.02)
    begin, end = (made.sticks[name].to_numpy() for name in ("t_v_s", "t_p_s"))
    time_s = 5 + made.tracks["time_s"].to_numpy()
    stick = np.clip(np.searchsorted(begin, time_s) - 1, 0, 29)
    bent_px = 0.5 * (time_s - begin[stick]) / (end - begin)[stick]
    made.tracks["x_px"] = made.tracks["x_px"] + bent_px[:, None]
    wrong, stated = errors(made, measure(made))
    assert abs(wrong.std() - stated.mean()) < 0.2 * stated.mean()
    assert measure(made)["drift_um"].median() == pytest.approx(5.0, abs=0.3)


def test_a_book_that_slides_is_in_the_errors():
    """Every second sheet moves steadily to the right.  A failure means that this passes for its creep."""
    made = make(profile(np.full(40, 6.0)), noise_px=0.02)
    slides = made.tracks["sheet"] % 2 == 0
    moved = made.tracks["x_px"] + 0.1 * slides * made.tracks["time_s"]
    motion = horizontal_deformation(
        made.tracks.assign(x_px=moved), made.sticks, Clock(), pixel_size_um=PIXEL_UM
    )
    off = (motion["ratio_signed"].to_numpy() - made.ratio) / motion["ratio_err"].to_numpy()
    assert 0.7 < np.sqrt(np.mean(off**2)) < 1.2


def test_sides_that_differ_are_not_made_alike():
    """A failure means that a left side that creeps half as much again is averaged with the right one."""
    made = make(profile(np.full(30, 8.0)), noise_px=0.02)
    left = (made.tracks["side"] < 0).to_numpy()
    rest = 20.0 * made.tracks["side"] * (made.tracks["n"] - 0.5) + 960
    x = made.tracks["x_px"].where(~left, rest + 1.5 * (made.tracks["x_px"] - rest))
    motion = horizontal_deformation(made.tracks.assign(x_px=x), made.sticks, Clock(), pixel_size_um=PIXEL_UM)
    truth = made.ratio * np.where(left, 1.5, 1.0)
    wrong = motion["ratio"].to_numpy() - truth
    assert np.abs(wrong.mean(axis=0)).max() < 0.01
    late = 5 + made.tracks["time_s"].to_numpy() > made.sticks["t_v_s"][7] + 0.2
    x[:, 6] += np.where(late, 6.0, 0.0)
    jumped = horizontal_deformation(made.tracks.assign(x_px=x), made.sticks, Clock(), pixel_size_um=PIXEL_UM)
    np.testing.assert_allclose(jumped["ratio_err"][20:, 8:], motion["ratio_err"][20:, 8:], rtol=0.02)


def test_common_movement_of_quiet_and_noisy_sheets():
    """A failure means that a noisy sheet, or one that jumps, shakes all others, or too few sheets do."""
    rng = np.random.default_rng(2)
    spread = np.r_[np.full(11, 0.02), 0.5]
    shake = 0.1 * rng.standard_normal(400)
    residual = shake[:, None] + spread * rng.standard_normal((400, 12))
    residual[100:110, 3] += 50.0
    found, _ = common_mode_motion(residual, DeformationSettings())
    assert np.std(found - shake) < 0.02
    assert np.abs(found - shake)[100:110].max() < 0.05
    few, _ = common_mode_motion(residual[:, :4], DeformationSettings())
    np.testing.assert_array_equal(few, 0)


def test_noise_that_goes_with_the_common_movement():
    """A failure means that the noise of few sheets is understated by what their mean takes from each."""
    noise = 0.05 * np.random.default_rng(3).standard_normal((4000, 6))
    settings = DeformationSettings()
    motion, factor = common_mode_motion(noise, settings)
    left = noise - motion[:, None]
    regained = left.var(axis=0) * factor
    np.testing.assert_allclose(regained, 0.05**2, rtol=0.1)
    np.testing.assert_array_equal(common_mode_motion(noise[:, :3], settings)[1], 1)


@pytest.mark.parametrize("shift", [-1, 0, 2])
def test_pairs_where_the_sides_are_numbered_unlike(shift):
    """A failure means that an axis between the wrong sheets makes pairs of unlike ones."""
    n_left, n_right = np.arange(12, 0, -1), np.arange(1, 13)
    side = np.r_[np.full(12, -1), np.ones(12, int)]
    middle = 20.0 * np.r_[-n_left, n_right][None] * np.ones((6, 1))
    slope = np.r_[(n_left + shift) ** 2, -(n_right**2)] * 0.01 * np.linspace(1, 2, 6)[:, None]
    still = np.zeros_like(slope)
    pairs = BothSides.of(side, np.r_[n_left, n_right], middle, slope, still, DeformationSettings())
    np.testing.assert_allclose(slope[:, pairs.left] + slope[:, pairs.right], 0, atol=1e-12)
