"""σ_x/Λ_st against made tracks with known creep: bias, stated error, flags, and what is refused."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.creeping import PIXEL_UM, Clock, errors, make, measure, profile, relaxing, straight, uniform
from vision.data import MOTION, MotionMetadata, operations_of
from vision.deformation import DeformationSettings
from vision.errors import InputError

NOISE_FREE = {"noise_px": 0.0}


def test_a_noise_free_sweep_gives_its_length_over_root_12():
    """A failure means that the definition itself is wrong: sign, mean, RMS, or the ends of the stick."""
    made = make(profile([10.0, 6.0, 4.0]), frames=30.3, **NOISE_FREE)
    motion = measure(made)
    np.testing.assert_allclose(motion["ratio"], made.ratio, atol=1e-6)
    np.testing.assert_allclose(motion["sweep_um"], made.sweep_px * PIXEL_UM, atol=1e-4)
    np.testing.assert_allclose(motion["sigma_x_corrected_um"] * np.sqrt(12), motion["sweep_um"], atol=1e-4)
    rest = 20.0 * made.tracks["side"] * (made.tracks["n"] - 0.5) + 960
    np.testing.assert_allclose(motion["x_hat_px"] - rest, 0, atol=1e-5)
    assert (motion["flag"] == "ok").all()


CASES = list(itertools.product((0.3, 1.0, 5.0), (8, 25, 100), (0.02, 0.08), (0.0, 0.6)))


@pytest.mark.thorough
@pytest.mark.parametrize(("sweep", "frames", "noise", "rho"), CASES)
def test_the_ratio_is_right_and_so_is_its_error(sweep, frames, noise, rho):
    """A failure means ratios that are off by more than 0.01 on average, or errors that cannot be believed."""
    stick_um = sweep * PIXEL_UM / np.sqrt(12) / 0.15
    made = make(uniform(sweep, stick_um), stick_um=stick_um, frames=frames, noise_px=noise, rho=rho)
    wrong, stated = errors(made, measure(made))
    assert wrong.size == made.ratio.size
    assert abs(wrong.mean()) < 0.01
    assert 0.60 < np.mean(np.abs(wrong) < stated) < 0.75


SLOWING = list(itertools.product((0.2, 1.0), (0.3, 3.0), (25,)))


@pytest.mark.parametrize(("strength", "sweep", "frames"), [*SLOWING, (0.2, 5.0, 12)])
def test_creep_that_slows_down(strength, sweep, frames):
    """A failure means that only straight sweeps are measured rightly: real sticks soften."""
    stick_um = sweep * PIXEL_UM / np.sqrt(12) / 0.15
    ratio = uniform(sweep, stick_um)
    made = make(ratio, stick_um=stick_um, noise_px=0.04, rho=0.5, shape=relaxing(strength), frames=frames)
    wrong, stated = errors(made, measure(made))
    assert abs(wrong.mean()) < 0.01
    assert 0.60 < np.mean(np.abs(wrong) < stated) < 0.75


@pytest.mark.parametrize("late", [-0.02, 0.02])
def test_ends_that_are_wrong_where_creep_slows_down(late):
    """Sticks that begin late lose the fastest creep: more of σ_x than of Λ_st.  A failure means that the
    error of the ends is not in that of σ_x, or not in that of the ratio."""
    made = make(uniform(5.0, 20.0), shape=relaxing(1.0), noise_px=0.05, frames=40)
    stick_s, stick_um = (made.sticks[name] for name in ("t_p_s", "stick_length_um"))
    stick_s = stick_s - made.sticks["t_v_s"]
    sticks = made.sticks.assign(
        t_v_s=made.sticks["t_v_s"] + late * stick_s,
        stick_length_um=(1 - late) * stick_um,
        stick_length_err_um=1.5 * abs(late) * stick_um,
    )
    motion = measure(replace(made, sticks=sticks))
    wrong, stated = errors(made, motion)
    assert np.mean(np.abs(wrong) < stated) > 0.6
    wrong_um = (motion["sigma_x_corrected_um"] - made.ratio * stick_um.to_numpy()[:, None]).to_numpy()
    assert np.mean(np.abs(wrong_um) < motion["sigma_x_err_um"]) > 0.6
    assert np.mean(np.abs(wrong_um) < motion["sigma_x_err_um"] / 2) < 0.3


@pytest.mark.parametrize("frames", [18, 60])
def test_creep_as_the_square_of_time_gives_its_own_rms(frames):
    """A parabola's standard deviation is 2/√45 of its sweep, not 1/√12.  A failure means that what bends a
    sheet's creep is weighted wrongly."""
    made = make(uniform(4.0, 20.0), shape=np.square, noise_px=0.005, frames=frames)
    assert np.median(measure(made)["ratio"] / made.ratio) == pytest.approx(1, abs=5e-4)


def test_noise_inflates_the_raw_figure():
    """The raw σ_x must read too high on late sticks, or the correction has nothing to correct."""
    made = make(uniform(0.3, 7.7), stick_um=7.7, frames=27, noise_px=0.08)
    motion = measure(made)
    raw = motion["sigma_x_um"] / motion["stick_length_um"] - made.ratio
    assert raw.mean() > 0.03
    assert abs(errors(made, motion)[0].mean()) < 0.005


def test_frames_that_hold_a_slip_are_left_out():
    """A failure means blurred frames are used: with 8 frames a stick they shrink every sweep."""
    made = make(uniform(3.0, 40.0), stick_um=40.0, frames=8, noise_px=0.02)
    careful, careless = measure(made), measure(made, margin_s=-1 / 120)
    assert abs(errors(made, careful)[0].mean()) < 0.002
    assert abs(errors(made, careless)[0].mean()) > 0.01
    assert careful["frames_left_out"].median() >= 1


def test_a_stick_in_which_the_film_shows_a_slip_is_left_out():
    """A failure means that two sticks, between which the force lacks the drop, are measured as one; or that
    a slip timed slightly differently costs the stick before it."""
    made = make(uniform(1.0, 20.0), frames=20)
    whole = measure(made)
    begin, end = (made.sticks[name].to_numpy() for name in ("t_v_s", "t_p_s"))
    inside, beside = 0.5 * (begin + end)[3], end[6] - 0.05 * (end - begin)[6]
    motion = measure(made, Clock(only_video_s=(inside, beside)))
    assert set(whole["event"].to_numpy()) - set(motion["event"].to_numpy()) == {made.sticks["event"][3]}
    with pytest.raises(InputError, match="sheets do not slip"):
        measure(made, Clock(only_video_s=tuple(0.5 * (begin + end))))


def test_a_small_slip_shortly_before_a_large_one_is_no_end_of_the_stick():
    """A failure means that sticks in which the sheets slip are measured, since the slip lies near their end,
    though the film shows both; or that sheets that slip late cost the stick."""
    made = make(uniform(1.0, 20.0), frames=60)
    begin, end = (made.sticks[name].to_numpy()[4] for name in ("t_v_s", "t_p_s"))
    whole = set(measure(made)["event"].to_numpy())
    for before_s, left_out in ((0.1 * (end - begin), {made.sticks["event"][4]}), (0.01, set())):
        motion = measure(made, Clock(only_video_s=(end - before_s,), matched_s=(end + 0.001,)))
        assert whole - set(motion["event"].to_numpy()) == left_out


@pytest.mark.parametrize("late", [-0.1, 0.05, 0.1])
def test_a_clock_wrong_by_part_of_a_stick_moves_no_slip_into_it(late):
    """A failure means that frames of the neighbouring stick, beyond a slip that the film itself shows, are
    fitted as creep: ratios of 0.5 then read 0.3, with errors several times too small."""
    made = make(profile(np.full(12, 10.0)), frames=60, noise_px=0.02)
    late_s = late * float((made.sticks["t_p_s"] - made.sticks["t_v_s"]).mean())
    seen = np.r_[made.sticks["t_v_s"].iloc[0], made.sticks["t_p_s"]] + late_s
    motion = measure(made, Clock(offset_s=5 + late_s, only_video_s=tuple(seen)))
    events = motion["event"].to_numpy()
    assert events.size >= 10
    wrong, stated = errors(replace(made, ratio=made.ratio[events]), motion)
    assert np.abs(wrong).max() < 0.02
    assert np.mean(np.abs(wrong) < stated) > 0.6


def test_sticks_in_which_the_displacement_stands_still_are_left_out():
    """A failure means σ_x over a Λ_st of 0, where the displacement ended before the load."""
    made = make(uniform(1.0, 20.0), frames=20)
    ended = made.sticks["event"] > 3
    length = made.sticks["stick_length_um"].where(~ended, 0)
    sticks = made.sticks.assign(stick_length_um=length, flag=np.where(ended, "falling+still", "ok"))
    motion = measure(replace(made, sticks=sticks))
    assert motion["event"].to_numpy().max() == 3
    with pytest.raises(InputError, match="rests of the machine within all of them"):
        measure(replace(made, sticks=sticks.assign(flag="still")))


def test_an_uncertain_clock_keeps_more_frames_away():
    """A failure means that the clock's error is ignored when frames next to a slip are left out."""
    made = make(uniform(1.0, 20.0), frames=20)
    sure = measure(made)
    unsure = measure(made, Clock(residual_ms=17.0))
    assert (unsure["frames_left_out"] >= sure["frames_left_out"] + 1).all()
    shifted = measure(made, Clock(residual_ms=17.0, offset_s=5.015))
    assert abs(errors(made, shifted)[0].mean()) < 0.005


def test_slow_frames_are_not_taken_for_an_uncertain_clock():
    """A failure means that a clock known to a millisecond costs a slow camera frames of short sticks."""
    made = make(uniform(1.0, 20.0, events=20), frames=6, fps=10.0)
    told = replace(Clock(residual_ms=25.0), error_ms=1.0)
    motion = measure(made, told)
    assert motion.attrs["margin_s"] == pytest.approx(0.05 + 0.002)
    assert (motion["flag"] != "few").mean() > 0.9
    untold = measure(made, Clock(residual_ms=25.0))
    assert untold.attrs["margin_s"] == pytest.approx(0.05)


def test_missing_positions_and_lost_frames():
    """A failure means that gaps shift the result or make errors dishonest."""
    made = make(uniform(1.0, 20.0), noise_px=0.05, rho=0.5, missing=0.1, lost=0.1)
    wrong, stated = errors(made, measure(made))
    assert abs(wrong.mean()) < 0.005
    assert 0.60 < np.mean(np.abs(wrong) < stated) < 0.75


def test_fewer_than_four_frames_give_nothing():
    """A failure means that a figure is made up from too few frames, or a good sheet dropped too."""
    made = make(uniform(1.0, 20.0, events=5), frames=20)
    x = made.tracks["x_px"].to_numpy()
    x[:, 2] = np.nan
    x[:26, 4] = np.nan
    motion = measure(made)
    assert (motion["flag"][:, 2] == "few").all()
    assert motion["flag"][0, 4] == "few"
    assert (motion["flag"][2:, 4] == "ok").all()
    few = motion["flag"] == "few"
    for name in ("ratio", "ratio_err", "sigma_x_um", "sigma_x_corrected_um", "sweep_um"):
        assert np.isnan(motion[name].to_numpy()[few]).all()
        assert np.isfinite(motion[name].to_numpy()[~few]).all()
    assert not MotionMetadata.of(motion).warnings
    short = measure(make(uniform(1.0, 20.0, events=5), frames=4))
    assert (short["flag"] == "few").all()
    (line,) = MotionMetadata.of(short).warnings
    assert line.startswith("5 of 5 stick phases are too short for σ_x/Λ_st, with 4 frames in the median")


@pytest.mark.parametrize("seen", [slice(0, 25), slice(25, 50), slice(24, 26), slice(30, 31)])
@pytest.mark.parametrize("fit", ["sliding", "paper"])
def test_few_sheets_and_no_frames(seen, fit):
    """A failure means a traceback, or a figure, where next to nothing is in view."""
    made = make(profile([8.0, 8.0]), frames=20)
    part = replace(made, tracks=made.tracks.isel(sheet=seen).assign_attrs(fit=fit))
    assert (measure(part)["flag"] != "few").all()
    assert (measure(part, margin_s=10.0)["flag"] == "few").all()
    blind = replace(part, tracks=part.tracks.assign(x_px=np.nan * part.tracks["x_px"]))
    assert (measure(blind)["flag"] == "few").all()


def test_sheets_that_do_not_move_at_all():
    """A failure means a division by their creep, which is 0."""
    made = make(profile([8.0, 8.0]), frames=20)
    still = made.tracks.assign(x_px=0 * made.tracks["x_px"] + made.tracks["x_px"][0])
    motion = measure(replace(made, tracks=still))
    np.testing.assert_allclose(motion["sigma_x_corrected_um"], 0, atol=1e-6)
    assert np.isfinite(motion["sigma_x_err_um"]).all()


def test_a_stick_seen_only_at_its_start_gives_nothing():
    """A failure means that most of a sweep is guessed from the little of it that was seen."""
    made = make(uniform(1.0, 20.0, events=5), frames=40)
    since = 5 + made.tracks["time_s"].to_numpy() - made.sticks["t_v_s"][2]
    gap = (since > 0.25) & (since < 0.7)
    motion = measure(replace(made, tracks=made.tracks.isel(frame=np.flatnonzero(~gap))))
    assert (motion["frames"][2] > 4).all()
    assert (motion["flag"][2] == "few").all()
    assert (motion["flag"][[0, 1, 4]] == "ok").all()


def test_negative_measurements_are_0_and_said_so():
    """A failure means that noise passes for movement of a still sheet."""
    made = make(np.c_[np.zeros((60, 5)), np.full((60, 5), 0.3)], noise_px=0.05)
    motion = measure(made)
    still = motion.sel(sheet=motion["n"] <= 5)
    assert abs(still["ratio_signed"].mean()) < 0.002
    below = still["flag"] == "below_noise"
    assert 0.4 < below.mean() < 0.6
    assert (still["ratio"].to_numpy()[below] == 0).all()
    assert (still["ratio"] >= 0).all()


def test_a_sheet_that_surely_moves_outwards_keeps_its_size():
    """A failure means that a large displacement is reported as none because of its direction."""
    ratio = np.full((10, 10), 0.2)
    ratio[:, 4] = -0.2
    motion = measure(make(ratio, noise_px=0.02))
    outward = motion.sel(sheet=motion["n"] == 5)
    assert (outward["flag"] == "outward").all()
    np.testing.assert_allclose(outward["ratio"], 0.2, atol=0.02)
    assert (outward["sweep_um"] < 0).all()


def test_stale_time_stamps_are_left_out():
    """A failure means that a frame with its neighbour's time bends the creep or stops the fit."""
    made = make(uniform(2.0, 20.0), noise_px=0.02)
    time = made.tracks["time_s"].to_numpy().copy()
    stale = np.arange(5, time.size, 11)
    time[stale] = time[stale - 1]
    time[3] = np.nan
    stamped = replace(made, tracks=made.tracks.assign_coords(time_s=("frame", time)))
    motion = measure(stamped)
    assert motion["frames"].mean() < measure(made)["frames"].mean() - 1
    assert abs(errors(stamped, motion)[0].mean()) < 0.003


def test_only_sticks_inside_the_video_are_rows():
    """A failure means that sticks the camera did not see get figures, or others lose theirs."""
    made = make(uniform(1.0, 20.0, events=12))
    part = replace(made, tracks=made.tracks.isel(frame=slice(60, 200)))
    motion = measure(part)
    time = 5 + part.tracks["time_s"].to_numpy()
    inside = (made.sticks["t_v_s"] > time[0]) & (made.sticks["t_p_s"] < time[-1])
    assert list(motion["event"]) == list(made.sticks["event"][inside])
    np.testing.assert_allclose(motion["d_v_mm"], made.sticks["d_v_mm"][inside])


def test_nothing_given_is_changed():
    """A failure means that a stage writes into its input."""
    made = make(uniform(1.0, 20.0, events=4), missing=0.1)
    tracks, sticks = made.tracks.copy(deep=True), made.sticks.copy()
    measure(made)
    assert tracks.identical(made.tracks)
    assert sticks.equals(made.sticks)


def refused(made, clock=None, **options):
    with pytest.raises(InputError) as problem:
        measure(made, clock, **options)
    assert "\n" not in str(problem.value)
    return str(problem.value)


def test_what_cannot_be_used_is_refused_in_one_line():
    """A failure means a traceback or a guess where the user must be told what to give."""
    made = make(uniform(1.0, 20.0, events=4))
    assert "`pixel_size_um`" in refused(made, pixel_size_um=None)
    assert "`pixel_size_um`" in refused(made, pixel_size_um=-1.0)
    assert "`offset_s`" in refused(made, Clock(status="ambiguous"))
    assert "found too few slips" in refused(made, Clock(status="ambiguous", ambiguity="too few slips"))
    assert "made.avi" in refused(made, Clock(offset_s=500.0))
    assert "`fps`" in refused(
        replace(
            made,
            tracks=made.tracks.assign_coords(time_s=("frame", np.full(made.tracks.sizes["frame"], np.nan))),
        )
    )
    assert "`speed_mm_min`" in refused(replace(made, sticks=made.sticks.assign(stick_length_um=np.nan)))
    assert "no stick phase" in refused(replace(made, sticks=made.sticks.iloc[:0]))


def test_tracks_without_metadata_and_sticks_without_forces_suffice():
    """A failure means that positions measured elsewhere cannot be used, or that attributes are believed."""
    made = make(uniform(1.0, 20.0, events=4))
    bare = replace(made, tracks=made.tracks.drop_attrs().drop_vars("x_err_px"))
    assert np.isfinite(measure(bare)["ratio"]).all()
    other = replace(made, tracks=made.tracks.assign_attrs(pixel_size_um=99.0))
    assert measure(other)["ratio"].equals(measure(made)["ratio"])
    np.testing.assert_allclose(measure(made, pixel_size_um=20.0)["ratio"], 2 * measure(made)["ratio"])


def test_what_is_returned_is_declared_and_says_how_it_was_made():
    """A failure means a variable without declaration or units, or parameters that are not recorded."""
    motion = measure(make(uniform(1.0, 20.0, events=4)))
    MOTION.check(motion)
    assert set(motion.variables) - set(MOTION.variables) == {"sheet"}
    for name in motion.data_vars:
        assert motion[name].attrs == MOTION[name].attrs
        assert motion[name].dims == MOTION[name].dims
    facts = MotionMetadata.of(motion)
    assert (facts.source, facts.pixel_size_um) == ("made.avi", PIXEL_UM)
    (entry,) = operations_of(motion)
    assert entry["operation"] == "horizontal_deformation"
    assert entry["parameters"]["margin_s"] == facts.margin_s


def test_settings_reach_the_measurement():
    """A failure means that a setting is accepted and ignored."""
    made = make(uniform(1.0, 20.0, events=5), frames=40)
    since = 5 + made.tracks["time_s"].to_numpy() - made.sticks["t_v_s"][2]
    gap = (since > 0.25) & (since < 0.7)
    part = replace(made, tracks=made.tracks.isel(frame=np.flatnonzero(~gap)))
    assert (measure(part)["flag"][2] == "few").all()
    less = measure(part, settings=DeformationSettings(least_cover=0.2))
    assert (less["flag"][2] != "few").all()
    assert operations_of(less)[-1]["parameters"]["settings"] == {"least_cover": 0.2}


def test_a_stick_without_length_has_no_ratio():
    """A failure means that an unknown stick length gives a figure, or takes others with it."""
    made = make(uniform(1.0, 20.0, events=4))
    made.sticks.loc[1, "stick_length_um"] = np.nan
    motion = measure(made)
    assert (motion["flag"][1] == "no_length").all()
    assert np.isnan(motion["ratio"][1]).all()
    assert np.isfinite(motion["sigma_x_corrected_um"]).all()
    assert np.isfinite(motion["ratio"][[0, 2, 3]]).all()


def test_misplaced_ends_of_sticks_are_no_error_of_the_ratio():
    """10 ms, 2 % of a stick, at either end.  A failure means that errors hold nearly all truths of the sheets
    that move most."""
    made = make(profile(np.full(40, 8.0)), noise_px=0.02)
    rng, speed = (
        np.random.default_rng(5),
        made.sticks["stick_length_um"] / np.diff(made.sticks[["t_v_s", "t_p_s"]])[:, 0],
    )
    made.sticks["t_v_s"] += np.abs(rng.normal(0, 0.01, 40))
    made.sticks["t_p_s"] -= np.abs(rng.normal(0, 0.01, 40))
    made.sticks["stick_length_um"] = speed * np.diff(made.sticks[["t_v_s", "t_p_s"]])[:, 0]
    made.sticks["stick_length_err_um"] = speed * 0.014
    wrong, stated = errors(made, measure(made))
    assert 0.62 < np.mean(np.abs(wrong) < stated) < 0.74


def test_error_of_the_stick_length_counts_where_it_is_known():
    """A failure means that an uncertain stick length passes for a certain one."""
    made = make(uniform(5.0, 20.0, events=4), noise_px=0.02, shape=straight)
    made.sticks["stick_length_err_um"] = 0.1 * made.sticks["stick_length_um"]
    motion = measure(made)
    np.testing.assert_allclose(motion["ratio_err"] / motion["ratio"], 0.1, rtol=0.05)
