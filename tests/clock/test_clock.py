"""synchronise(): tracks and a force recording in, one clock or an honest refusal out."""

import json
import re

import numpy as np
import pytest
import xarray as xr

from tests.scenes.slip_trains import as_tracks, sawtooth, slip_sizes, slip_times, sticks_of, tracks
from vision.clock import Clock, force_slips, synchronise, video_slips
from vision.errors import InputError
from vision.experiment import force_recording, preset, with_settings, write_force
from vision.experiment.scene import make_scene, truth_of
from vision.figures.style import offset_text
from vision.folder import plain
from vision.force import find_stick_slip
from vision.force.recording import read_force

STOP_S, OFFSET_S, FRAME_S = 120.0, 31.25, 0.05


@pytest.fixture(scope="module")
def recorded():
    """(tracks, force, sticks) of 70 s of video that starts 31.25 s into a recording of two minutes."""
    rng = np.random.default_rng(0)
    slips = 2.0 + slip_times(rng, 200, period_s=0.61)
    slips = slips[slips < STOP_S - 1]
    seen = tracks(rng, slips[(slips > OFFSET_S) & (slips < OFFSET_S + 70)] - OFFSET_S, stop_s=70.0)
    return seen, sawtooth(rng, slips, stop_s=STOP_S), sticks_of(slips)


def off_s(clock, offset_s=OFFSET_S, at_s=35.0):
    return float(clock.to_force_s(at_s)) - offset_s - at_s


def test_slips_set_the_clock(recorded):
    """A failure means that frames and forces are put together wrongly."""
    clock = synchronise(*recorded)
    assert (clock.status, clock.how, clock.warnings) == ("ok", "events", ())
    assert abs(off_s(clock)) < 3e-3
    assert abs(off_s(clock)) < 4e-3 * clock.error_ms
    assert abs(clock.drift_ppm) < 4 * clock.drift_err_ppm
    assert abs(clock.offset_s - OFFSET_S) < 4 * clock.offset_err_s
    assert 1e-3 * clock.error_ms < clock.offset_err_s < 3e-3
    assert clock.matched > 100
    assert clock.unmatched_video + clock.unmatched_force <= 2
    assert clock.residual_ms == pytest.approx(1e3 * FRAME_S / 4, rel=0.3)
    assert clock.margin > 6


def test_nothing_given_is_changed(recorded):
    """A failure means that a later stage sees altered tracks or events."""
    before = [part.copy(deep=True) for part in recorded]
    synchronise(*recorded)
    xr.testing.assert_identical(before[0], recorded[0])
    xr.testing.assert_identical(before[1], recorded[1])
    assert before[2].equals(recorded[2])


def test_an_offset_that_is_given_decides_and_is_compared(recorded):
    """A failure means that a hardware trigger is overruled, or that a wrong one goes unnoticed."""
    right = synchronise(*recorded, offset_s=OFFSET_S)
    assert (right.offset_s, right.drift_ppm, right.status, right.how) == (OFFSET_S, 0.0, "given", "given")
    assert right.warnings == ()
    assert right.matched > 100
    wrong = synchronise(*recorded, offset_s=OFFSET_S + 0.3)
    assert wrong.offset_s == OFFSET_S + 0.3
    assert "according to the slips the force clock is 31.2" in wrong.warnings[0]


def test_a_given_offset_needs_no_slips(recorded):
    """A failure means that a video of one stick cannot be used with a trigger."""
    seen, force, sticks = recorded
    clock = synchronise(seen.isel(frame=slice(5, 13)), force, sticks, offset_s=OFFSET_S)
    assert clock.status == "given"
    assert clock.matched == 0
    assert np.isnan(clock.residual_ms)


def test_a_given_offset_is_compared_with_few_slips(recorded):
    """A failure means that no slip of a short film is said to match the force at the right offset."""
    seen, force, sticks = recorded
    short = seen.isel(frame=slice(0, 40))  # 2 s, three or four slips
    right, wrong = (synchronise(short, force, sticks, offset_s=OFFSET_S + by) for by in (0.0, 0.25))
    assert 1 <= right.matched < 4
    assert right.unmatched_video == 0
    assert wrong.matched == 0


@pytest.mark.parametrize("share", [0.05, 0.4])
def test_slips_of_one_recording_alone_are_said(share):
    """A failure means that stick phases which the two recordings delimit differently pass in silence, or
    that every missed slip gives a warning."""
    rng = np.random.default_rng(3)
    slips = 2.0 + slip_times(rng, 90, period_s=0.61)
    there = rng.random(len(slips)) >= share
    stop_s = slips[-1] + 1
    film, force = tracks(rng, slips, stop_s=stop_s), sawtooth(rng, slips, stop_s=stop_s)
    fewer_seen = synchronise(tracks(rng, slips[there], stop_s=stop_s), force, sticks_of(slips))
    fewer_drops = synchronise(film, sawtooth(rng, slips[there], stop_s=stop_s), sticks_of(slips[there]))
    assert fewer_seen.status == fewer_drops.status == "ok"
    assert len(fewer_seen.only_video_s) <= 1  # one of 90 may be timed badly
    lost = slips[~there]
    between = lost[(lost > slips[there][0]) & (lost < slips[there][-1])]
    np.testing.assert_allclose(fewer_drops.only_video_s, between, atol=FRAME_S)
    said = "drops of the force match no slip", "slips of the film match no drop"
    for clock, line in zip((fewer_seen, fewer_drops), said, strict=True):
        assert [line in warning for warning in clock.warnings] == [True] * (share > 0.2)


@pytest.mark.parametrize(
    ("begin_s", "stop_s", "jump_s"),
    [(61, 70, 0.0), (61, 70, 0.28), (61, 70, 1.7), (1.75, 12, 0.0), (1.75, 12, 0.35), (1.75, 12, 1.4)],
)
def test_clocks_that_jump_are_not_believed(recorded, begin_s, stop_s, jump_s):
    """Frames are lost without notice: before the last dozen slips of a long film, or after the first three of
    a short one.  A failure means that a clock which holds on one side of them is used for the other, or that
    few missed slips at the end leave a test without a clock."""
    seen, force, sticks = recorded
    time_s = seen["time_s"].to_numpy()
    lost = (time_s > begin_s) & (time_s < begin_s + jump_s) | (time_s > stop_s)
    shown = seen.isel(frame=~lost)
    frames = {name: seen[name].to_numpy()[: shown.sizes["frame"]] for name in ("frame", "time_s")}
    clock = synchronise(shown.assign_coords({n: ("frame", v) for n, v in frames.items()}), force, sticks)
    assert clock.status == ("ambiguous" if jump_s else "ok")


def with_video_time(force, *, rate=0.999958, first_s=8.0853, every=7):
    """The column as MTS writes it: repeated until the next frame arrives."""
    video = rate * force["time_s"].to_numpy() + first_s
    stale = video[np.arange(len(video)) // every * every]
    return force.assign(video_time_s=("time_s", stale))


@pytest.mark.parametrize("rate", [1.003, 1.012, 0.985])
def test_a_wrong_frame_rate_is_said(recorded, rate):
    """A failure means that a rate wrong by 0.3 % passes in silence, or one wrong by 1 % for another test."""
    seen, force, sticks = recorded
    film = seen.assign_coords(time_s=seen["time_s"] * rate).assign_attrs(fps=20 / rate)
    try:
        clock = synchronise(film, force, sticks)
    except InputError as error:
        told = str(error)
    else:
        assert (clock.status == "ok") == (rate == 1.003)
        (told,) = clock.warnings
    assert "`fps`" in told
    found, given = re.search(r"agree at ([\d.]+) frames/s instead of ([\d.]+)", told).groups()
    assert float(given) == pytest.approx(20 / rate, rel=1e-4)
    assert float(found) == pytest.approx(20, rel=2e-4)


@pytest.mark.parametrize("rate", [1.0092, 0.9926])
def test_even_slips_at_a_wrong_frame_rate(rate):
    """A failure means that an alignment wrong by one slip is believed, as another rate makes up for it."""
    rng = np.random.default_rng(0)
    slips = 3 + slip_times(rng, 38, period_s=1.1, jitter=0.0, trend=-0.008)
    start_s, stop_s = slips[5] + 0.4, slips[31] + 0.3
    shown = slips[(slips > start_s) & (slips < stop_s)] - start_s
    film = tracks(rng, shown, stop_s=shown[-1] + 0.4, frame_s=0.025)
    film = film.assign_coords(time_s=film["time_s"] * rate)
    clock = synchronise(film, sawtooth(rng, slips, stop_s=slips[-1] + 1), sticks_of(slips))
    assert clock.status == "ambiguous"


@pytest.mark.parametrize("stamps", [True, False])
def test_few_slips_of_frames_with_time_stamps_set_the_clock(stamps):
    """Ten slips that fit as well at another frame rate.  A failure means that time stamps are not believed,
    or that a rate is believed which may be wrong."""
    rng = np.random.default_rng(0)
    slips = 17 + slip_times(rng, 20, period_s=1.0, jitter=0.03)
    shown = slips[4:14] - 20
    film = tracks(rng, shown, stop_s=shown[-1] + 0.4, frame_s=FRAME_S)
    film = film.assign_attrs(fps=20.0, clock_file="times.txt" if stamps else "")
    clock = synchronise(film, sawtooth(rng, slips, stop_s=slips[-1] + 1), sticks_of(slips))
    assert off_s(clock, 20, shown.mean()) == pytest.approx(0, abs=0.01)
    assert clock.status == ("ok" if stamps else "ambiguous")
    if not stamps:
        (told,) = clock.warnings
        assert re.search(r"fit nearly as well at [\d.]+ frames/s instead of 20; give `timestamps`", told)


def test_another_test_suggests_no_frame_rate(recorded):
    """A failure means that a film that does not belong to the force is said to do so at another rate."""
    _, force, sticks = recorded
    for seed in (11, 12, 13):
        rng = np.random.default_rng(seed)
        clock = synchronise(tracks(rng, slip_times(rng, 110, period_s=0.61), stop_s=70.0), force, sticks)
        assert clock.status == "ambiguous"
        assert "frames/s" not in clock.warnings[0]


def test_a_column_of_video_times_decides(recorded):
    """A failure means that the machine's own note of the camera's clock is not used, or read backwards."""
    seen, force, sticks = recorded
    later = seen.assign_coords(time_s=seen["time_s"] + OFFSET_S + 8.0853)
    clock = synchronise(later, with_video_time(force), sticks)
    assert (clock.status, clock.how) == ("given", "video time column")
    assert clock.offset_s == pytest.approx(-8.0853 / 0.999958, abs=1e-4)
    assert clock.drift_ppm == pytest.approx(42.0, abs=0.5)
    assert clock.warnings == ()


def test_outliers_in_the_column_do_not_matter(recorded):
    """A failure means that a few bad rows tilt the clock."""
    seen, force, sticks = recorded
    column = with_video_time(force)
    bad = column["video_time_s"].to_numpy().copy()
    bad[100:130], bad[5000:5003] = np.nan, 1e4
    later = seen.assign_coords(time_s=seen["time_s"] + OFFSET_S + 8.0853)
    clock = synchronise(later, column.assign(video_time_s=("time_s", bad)), sticks)
    assert clock.drift_ppm == pytest.approx(42.0, abs=1)


def test_a_column_that_is_no_clock_is_passed_over_and_said(recorded):
    """A failure means that a constant or foreign column sets the clocks."""
    seen, force, sticks = recorded
    constant = with_video_time(force, rate=0.0)
    restarts = with_video_time(force, every=400)  # the camera is started again with 12 of its frames to come
    video_s = restarts["video_time_s"].to_numpy()
    again = video_s > np.unique(video_s)[-12]
    restarted = np.where(again, video_s - video_s[again].min(), np.where(video_s > 30, np.nan, 90 + video_s))
    for column in (constant, restarts.assign(video_time_s=("time_s", restarted))):
        clock = synchronise(seen, column, sticks)
        assert clock.how == "events"
        assert "not usable" in clock.warnings[0]


@pytest.mark.parametrize("offset_s", [-100.0, 500.0])
def test_a_video_outside_the_recording_is_one_clear_line(recorded, offset_s):
    """A failure means a traceback or empty tables where a wrong file was given."""
    with pytest.raises(
        InputError, match="`offset_s`: expected a video within the force recording, 0 to 119"
    ) as e:
        synchronise(*recorded, offset_s=offset_s)
    assert "\n" not in str(e.value)


def test_a_recording_of_another_part_is_not_believed(recorded):
    """A failure means that a video without overlap gets a clock."""
    seen, force, sticks = recorded
    early = sticks.iloc[:40]
    early.attrs |= sticks.attrs
    clock = synchronise(seen, force.isel(time_s=force["time_s"] < 26), early)
    assert clock.status == "ambiguous"
    assert "slips in common" in clock.warnings[0]


def test_even_slips_are_ambiguous_with_candidates():
    """A failure means that a shift by one slip is chosen by chance and called certain."""
    rng = np.random.default_rng(1)
    slips = np.arange(2.0, STOP_S - 1, 0.613)
    seen = tracks(rng, slips[(slips > 30) & (slips < 60)] - 30, stop_s=30.0)
    clock = synchronise(seen, sawtooth(rng, slips, stop_s=STOP_S), sticks_of(slips))
    assert clock.status == "ambiguous"
    assert "ambiguous" in clock.warnings[0]
    assert "too few" not in clock.ambiguity and clock.ambiguity in clock.warnings[0]
    assert len(clock.candidates) > 1
    steps = np.diff(np.sort([c.offset_s for c in clock.candidates]))
    np.testing.assert_allclose(steps / 0.613, np.rint(steps / 0.613), atol=0.1)


def test_too_few_slips_are_refused(recorded):
    """A failure means a clock from nothing, or a traceback."""
    seen, force, sticks = recorded
    with pytest.raises(InputError, match=r"film\.avi: expected at least 4 slips.*`offset_s`"):
        synchronise(seen.isel(frame=slice(0, 25)), force, sticks)
    with pytest.raises(InputError, match="expected at least 4 slips"):
        synchronise(seen, force, sticks.iloc[:0])


def test_a_film_that_runs_backwards_is_named(recorded):
    """A failure means that a film saved in the opposite order, or numbered from an axis on its other side, is
    said to have no slips."""
    film, force, sticks = recorded
    with pytest.raises(InputError, match=r"found 0, and \d+ jumps of the sheets inwards; check"):
        synchronise(film.assign_coords(side=-film["side"]), force, sticks)


def test_three_slips_are_refused(recorded):
    """A failure means that three sticks of a video are laid anywhere in the recording."""
    with pytest.raises(InputError, match="expected at least 4 slips to align the clocks; found 3"):
        synchronise(first_slips(recorded[0], 3), *recorded[1:])


@pytest.mark.parametrize("slips", [4, 5])
def test_very_short_videos_are_ambiguous(recorded, slips):
    """A failure means that a few sticks of a video are laid anywhere in the recording."""
    clock = synchronise(first_slips(recorded[0], slips), *recorded[1:])
    assert clock.status == "ambiguous"
    assert f"too few slips in common ({slips}, at least 6 needed)" in clock.warnings[0]
    assert clock.ambiguity in clock.warnings[0]


def first_slips(seen, slips):
    return seen.isel(frame=slice(0, int((0.3 + 0.61 * slips) / FRAME_S)))


def test_a_force_clock_may_start_anywhere(recorded):
    """A failure means that a machine that counts from when it was switched on cannot be used."""
    seen, force, sticks = recorded
    late = sticks.assign(t_v_s=sticks["t_v_s"] + 7000, t_p_s=sticks["t_p_s"] + 7000)
    late.attrs["first_slip_s"] = sticks.attrs["first_slip_s"] + 7000
    clock = synchronise(seen, force.assign_coords(time_s=force["time_s"] + 7000), late)
    assert clock.status == "ok"
    assert abs(off_s(clock, OFFSET_S + 7000)) < 3e-3


def test_a_quarter_of_the_frames_may_be_lost_and_the_force_cover_less_than_the_video(recorded):
    """A failure means that a full disk, or a force recording that was stopped early, costs the clocks."""
    seen, force, sticks = recorded
    kept = np.flatnonzero(np.random.default_rng(3).random(seen.sizes["frame"]) >= 0.25)
    early = sticks[sticks["t_p_s"] < 70]
    early.attrs |= sticks.attrs
    clock = synchronise(seen.isel(frame=kept), force.isel(time_s=force["time_s"] < 70.2), early)
    assert clock.status == "ok"
    assert abs(off_s(clock, at_s=20.0)) < FRAME_S / 6


def test_a_playback_rate_is_said(recorded):
    """A failure means that a file's nominal rate passes for the camera's clock without a word."""
    seen, force, sticks = recorded
    clock = synchronise(seen.assign_attrs(clock_kind="playback"), force, sticks)
    assert "`fps`" in clock.warnings[0]


def test_stamps_since_1970_have_an_offset_that_can_be_used(recorded):
    """A failure means that an offset is said as −1790407921 ± 1163844 s, which gives none to --offset."""
    seen, force, sticks = recorded
    late = 1.79e9
    clock = synchronise(seen.assign_coords(time_s=seen.time_s + late), force, sticks)
    at, offsets, _ = clock.offsets_at_slips()
    assert late < at < late + 70 and len(offsets) == 1 + len(clock.candidates)
    assert abs(offsets[0] + late - OFFSET_S) < 4e-3 * clock.error_ms
    assert "−1789999968.7" in offset_text(clock) and f"at video time {at} s" in offset_text(clock)
    assert (
        abs(
            off_s(
                synchronise(
                    seen.assign_coords(time_s=seen.time_s + late), force, sticks, offset_s=offsets[0]
                ),
                OFFSET_S - late,
                late + 35,
            )
        )
        < 3e-3
    )
    assert synchronise(*recorded).offsets_at_slips()[0] == 0


def test_json_has_the_agreed_names(recorded):
    """A failure means that scripts outside cannot read clock.json."""
    written = json.loads(json.dumps(plain(synchronise(*recorded)), allow_nan=False))
    names = {"offset_s", "drift_ppm", "residual_ms", "matched", "unmatched_video", "unmatched_force"}
    assert names | {"margin", "status"} <= set(written)
    given = plain(synchronise(*recorded, offset_s=OFFSET_S))
    assert given["margin"] is None
    assert given["status"] == "given"


def test_there_and_back():
    """A failure means that times on the two clocks do not belong together."""
    clock = Clock(
        offset_s=12.0,
        drift_ppm=3000.0,
        residual_ms=1.0,
        matched=9,
        unmatched_video=0,
        unmatched_force=0,
        margin=9.0,
        status="ok",
        how="events",
    )
    np.testing.assert_allclose(clock.to_force_s([0.0, 10.0, np.nan]), [12.0, 22.03, np.nan])
    np.testing.assert_allclose(clock.to_video_s(clock.to_force_s([0.0, 10.0])), [0.0, 10.0], atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "changes", "allowed_s"),
    [
        ("paper", {}, 0.002),
        ("paper", {"camera.fps": 20, "camera.duration_s": 60}, 0.004),
        ("late", {}, 0.002),
        ("fast", {}, 0.002),
        ("hostile", {"camera.duration_s": 40}, 0.013),  # its sheets slip up to 20 ms after one another
    ],
)
def test_simulated_tests_with_physics(name, changes, allowed_s, tmp_path):
    """A failure means that what works on bare trains does not on a whole test."""
    experiment = with_settings(preset(name), changes)
    scene = make_scene(experiment)
    truth = truth_of(scene)
    write_force(tmp_path / "f.txt", force_recording(experiment, scene.pull), experiment.force_file)
    force = read_force(tmp_path / "f.txt")
    rng = np.random.default_rng(2)
    x = truth["x_px"].values + 0.05 * rng.standard_normal(truth["x_px"].shape)
    seen = as_tracks(x, truth["stamp_s"].values, truth["side"].values, truth["n"].values, 0.05)
    clock = synchronise(seen, force, find_stick_slip(force))
    middle = float(truth["time_s"].mean())
    clocks = experiment.clocks
    error = clock.to_force_s(middle) - clocks.offset_s - (1 + 1e-6 * clocks.drift_ppm) * middle
    assert clock.status == "ok"
    assert abs(error) < allowed_s
    assert clock.drift_ppm == pytest.approx(clocks.drift_ppm, abs=4 * clock.drift_err_ppm + 20)


@pytest.fixture(scope="module")
def uneven_sizes():
    """(slips, sizes) of two minutes of nearly even slips of different sizes."""
    rng = np.random.default_rng(7)
    slips = 2.0 + slip_times(rng, 200, period_s=0.61, jitter=0.01)
    slips = slips[slips < 119]
    return slips, slip_sizes(rng, len(slips))


def test_both_instruments_measure_the_sizes(uneven_sizes):
    """A failure means that what is compared is not the size of the slips."""
    slips, size = uneven_sizes
    rng = np.random.default_rng(8)
    seen = video_slips(tracks(rng, slips, stop_s=120.0, sizes=size, missing=0.0))
    assert len(seen) == len(slips)
    inner = slice(1, -1)  # the first and last drop are not known
    assert np.corrcoef(seen["step_px"][inner], size[inner])[0, 1] > 0.95
    drops = force_slips(sawtooth(rng, slips, stop_s=120.0, sizes=size), sticks_of(slips, sizes=size))[
        "drop_N"
    ]
    following = np.r_[size[1:], size[-1]]  # a stick's rise, before the slip and after it
    np.testing.assert_allclose(drops[inner], 30 * (0.75 * size + 0.25 * following)[inner], rtol=1e-9)
    assert np.isnan(drops.iloc[[0, -1]]).all()


def test_a_short_video_of_nearly_even_slips_is_placed_by_their_sizes(uneven_sizes):
    """A failure means that the sizes are measured but not used."""
    slips, size = uneven_sizes
    inside = (slips > 31.25) & (slips < 75)
    status = {}
    for name, at_camera in {"seen": size[inside], "not seen": None}.items():
        rng = np.random.default_rng(9)
        seen = tracks(rng, slips[inside] - 31.25, stop_s=43.75, sizes=at_camera)
        force = sawtooth(rng, slips, stop_s=120.0, sizes=size)
        clock = synchronise(seen, force, sticks_of(slips, sizes=size))
        status[name] = clock.status
        if clock.status == "ok":
            assert abs(float(clock.to_force_s(20.0)) - 51.25) < FRAME_S / 3
    assert status == {"seen": "ok", "not seen": "ambiguous"}


def test_slips_in_gaps_do_not_set_the_clock():
    """Ten gaps lie about slips, and the clock is told from the others.  A failure means that the middle of a
    gap is taken for the time of the slip, or its length for the delay of the low-pass."""
    off = []
    for seed in (1, 7, 9, 19):
        rng = np.random.default_rng(seed)
        slips = 3.0 + np.r_[0, slip_times(rng, 40, period_s=0.61)]
        film = tracks(rng, slips, stop_s=slips[-1] + 1)
        force = sawtooth(rng, slips, stop_s=slips[-1] + 1)
        middle = rng.choice(slips, 10, replace=False) + rng.uniform(-0.04, 0.04, 10)
        lost = (np.abs(force["time_s"].to_numpy()[:, None] - middle) < 0.075).any(axis=1)
        broken = force.isel(time_s=~lost)
        clock = synchronise(film, broken, sticks_of(slips))
        assert clock.status == "ok"
        off.append(1e3 * off_s(clock, 0.0, 15.0) / clock.error_ms)
        assert len(force_slips(broken, sticks_of(slips))) == 31
    assert np.max(np.abs(off)) < 3
