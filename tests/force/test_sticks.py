"""Errors of what is measured on each stick, against slips and sticks whose course is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from scipy.signal import butter, lfilter, sosfilt, sosfiltfilt

from tests.force.test_events import matched
from tests.scenes.sawtooth import Test, plain, recording
from vision.errors import InputError
from vision.force import find_stick_slip
from vision.numeric import Floats


def cycles(
    rise: Floats,
    fall: Floats,
    *,
    noise: float,
    along: Callable[[Floats], Floats] = lambda u: u,
    down: Callable[[Floats], Floats] = lambda u: (1 + np.cos(np.pi * u)) / 2,
) -> Test:
    """Sticks of so many samples from 50 to 60 N with the course `along`, and slips with the course `down`."""
    rng = np.random.default_rng(8)
    knots = np.cumsum(np.stack([rise, fall], axis=1))
    begin = np.r_[0.0, knots]
    index = np.arange(knots[-1])
    at = np.searchsorted(knots, index, side="right")
    u = (index - begin[at]) / np.diff(begin)[at]
    load = 50 + 10 * np.where(at % 2 == 0, along(u), down(u)) + noise * rng.standard_normal(u.size)
    sticks = {"t_v_s": begin[2:-1:2] / 100, "t_p_s": begin[3::2] / 100, "F_v_N": 50.0, "F_p_N": 60.0}
    truth = pd.DataFrame(sticks | {"dF_N": 10.0, "stick_length_um": rise[1:] / 6})
    return Test(recording(0.01 * index, load, 13 + index / 6000, 1.0), truth)


def within(events: pd.DataFrame, truth: pd.DataFrame, name: str) -> float:
    """The share of events whose value of this column is within its error."""
    error = events[name.replace("_N", "_err_N").replace("_um", "_err_um")]
    return float(np.mean(np.abs(events[name] - truth[name]) < error))


def uneven_lengths(samples: float, count: int = 60) -> Floats:
    """So many lengths that scatter by a twentieth."""
    return np.asarray(samples * (1 + 0.05 * np.random.default_rng(3).standard_normal(count)), np.float64)


@pytest.mark.parametrize("fall", [30.0, 300.0])
def test_slips_that_no_filter_lengthened_have_no_errors_of_one(fall: float) -> None:
    """A failure means errors of Λ_st as large as the slip, up to half of Λ_st, or of ΔF ten times too large,
    although the noise is white and the slips have the shape of a moving block's."""
    test = cycles(uneven_lengths(600), np.full(60, fall), noise=0.1)
    events, truth = matched(find_stick_slip(test.force), test.truth)
    assert len(events) == 58
    assert within(events, truth, "dF_N") > 0.6
    assert within(events, truth, "stick_length_um") > 0.6
    assert (events["dF_err_N"] < 0.02 * truth["dF_N"]).all()
    assert (events["stick_length_err_um"] < 0.05 * truth["stick_length_um"]).all()


def test_slips_of_a_few_samples_that_no_filter_lengthened() -> None:
    """A failure means an error of Λ_st as large as the slip, 16 times too large."""
    test = cycles(uneven_lengths(300), np.full(60, 5.3), noise=0.03)
    events, truth = matched(find_stick_slip(test.force), test.truth)
    assert len(events) == 58
    for name in ("F_v_N", "F_p_N", "dF_N", "stick_length_um"):
        assert within(events, truth, name) > 0.6, name
    assert (events["stick_length_err_um"] < 1.5 / 6).all()  # of a sample and a half


def test_slips_that_a_sharp_filter_lengthened_keep_the_error_of_it() -> None:
    """A failure means that white noise, which arose after the filter, makes slips count as resolved, although
    the load overshoots: Λ_st is then off by five of its errors."""
    test = cycles(uneven_lengths(300), np.full(60, 0.6), noise=0.0)
    load = sosfilt(butter(4, 0.2, output="sos"), test.force["load_N"] - 50) + 50
    load += 0.05 * np.random.default_rng(1).standard_normal(load.size)
    events, truth = matched(find_stick_slip(test.force.assign(load_N=("time_s", load))), test.truth)
    assert len(events) == 58
    assert within(events, truth, "stick_length_um") > 0.6


@pytest.mark.parametrize("means", [[6], [3, 3, 3]])
def test_slips_that_means_lengthened_keep_the_error_of_them(means: list[int]) -> None:
    """A failure means that white noise, which arose after a moving mean or a decimator, makes slips count as
    resolved: forces are then off by four errors or more, and Λ_st by eight."""
    test = cycles(uneven_lengths(300), np.full(60, 0.6), noise=0.0)
    load = test.force["load_N"].to_numpy()
    for width in means:
        load = np.convolve(np.pad(load, (width - 1, 0), "edge"), np.full(width, 1 / width), "valid")
    load = load + 0.05 * np.random.default_rng(1).standard_normal(load.size)
    events, truth = matched(find_stick_slip(test.force.assign(load_N=("time_s", load))), test.truth)
    assert len(events) == 58
    for name in ("F_v_N", "F_p_N", "dF_N", "stick_length_um"):
        assert within(events, truth, name) > 0.6, name


@pytest.mark.parametrize(("rise", "slip", "width", "digit"), [(160, 20, 30, 0.05), (300, 40, 60, 0.03)])
def test_rounding_does_not_hide_a_mean_as_long_as_the_slips(
    rise: float, slip: float, width: int, digit: float
) -> None:
    """A failure means that noise which a moving mean smoothed, and rounding made white, makes slips count as
    resolved: F_p, F_v and ΔF are off by ten errors or more, without a word."""
    test = cycles(uneven_lengths(rise), np.full(60, slip), noise=0.05)
    padded = np.pad(test.force["load_N"].to_numpy(), (width // 2, width - width // 2 - 1), "edge")
    load = digit * np.round(np.convolve(padded, np.full(width, 1 / width), "valid") / digit)
    events, truth = matched(find_stick_slip(test.force.assign(load_N=("time_s", load))), test.truth)
    assert len(events) == 58
    for name in ("F_v_N", "F_p_N", "dF_N"):
        assert within(events, truth, name) > 0.6, name


def test_rounding_as_large_as_the_noise_doubts_no_slips() -> None:
    """A failure means errors of ΔF ten times too large, because the last digit is as large as the noise."""
    test = cycles(uneven_lengths(600), np.full(60, 30.0), noise=0.1)
    events = find_stick_slip(test.force.assign(load_N=0.1 * np.round(test.force["load_N"] / 0.1)))
    assert (events["dF_err_N"] < 0.1).all()


def test_a_bend_that_is_not_clear_is_part_of_the_errors() -> None:
    """A failure means that the bend of ten long sticks, of less than four of its errors, is neither corrected
    nor in the errors: F_v and F_p are too high by three of them."""
    test = cycles(
        uneven_lengths(5000, 10), np.full(10, 0.5), noise=0.2, along=lambda u: u + 0.01 * u * (1 - u)
    )
    events = find_stick_slip(test.force)
    assert events.attrs["bend_share"] == 0
    right, truth = matched(events, test.truth)
    for name in ("F_v_N", "F_p_N"):
        z = (right[name] - truth[name]) / right[name.replace("_N", "_err_N")]
        assert np.abs(z).median() < 1.5, name


def test_peaks_that_are_round_in_noise() -> None:
    """A failure means that F_p of a block that creeps before it slips is read from the largest of many noisy
    samples: by four percent of the drop, three of its errors."""

    def creeping(u: Floats, b: float = 0.03) -> Floats:
        x = u * (1 + 2 * b)
        course = x - b * np.logaddexp(0, (x - 1) / b)
        return np.asarray((course - course[0]) / 0.995)

    test = cycles(uneven_lengths(200), np.full(60, 0.5), noise=0.2, along=creeping)
    events, truth = matched(find_stick_slip(test.force), test.truth)
    assert len(events) == 58
    for name in ("F_p_N", "dF_N"):
        assert within(events, truth, name) > 0.6, name


def test_slow_slips_of_three_samples() -> None:
    """A failure means that the highest sample beside a slip of three samples counts as its peak: ΔF is then
    too small by two errors and more."""
    test = cycles(uneven_lengths(12), np.full(60, 2.6), noise=0.03)
    events, truth = matched(find_stick_slip(test.force), test.truth)
    assert len(events) == 58
    assert events["flag"].str.contains("slow").mean() > 0.9
    for name in ("F_v_N", "F_p_N", "dF_N"):
        assert within(events, truth, name) > 0.6, name


def test_slips_that_begin_gradually_are_part_of_the_error_of_the_length() -> None:
    """A failure means that the slips of friction that falls gradually with the speed count as half cosines:
    hardly any Λ_st is within its error."""
    course = np.cumsum(np.r_[0.0, np.exp(6 * np.linspace(0, 1, 400))])
    course = 1 - course / course[-1]
    test = cycles(
        uneven_lengths(1000),
        np.full(60, 80.0),
        noise=0.3,
        down=lambda u: np.interp(u, np.linspace(0, 1, course.size), course),
    )
    events, truth = matched(find_stick_slip(test.force), test.truth)
    assert len(events) == 58
    assert within(events, truth, "stick_length_um") > 0.6
    assert events["stick_length_err_um"].median() < 0.08 * truth["stick_length_um"].median()


def test_sticks_that_begin_steeply_in_noise() -> None:
    """A failure means that F_v is read from the line of the later stick, where noise hides the steep begin of
    single sticks: by a tenth of the drop, three of its errors."""
    test = cycles(
        uneven_lengths(200),
        np.full(60, 0.5),
        noise=0.4,
        along=lambda u: 0.85 * u + 0.15 * (1 - np.exp(-u / 0.06)),
    )
    events, truth = matched(find_stick_slip(test.force), test.truth)
    assert len(events) == 58
    for name in ("F_v_N", "dF_N"):
        assert within(events, truth, name) > 0.6, name
    assert np.abs(events["F_v_N"] - truth["F_v_N"]).median() < 0.5


@pytest.mark.parametrize("lost", [0.01, 0.3])
def test_lost_samples_leave_the_errors_of_what_lengthened_the_slips(lost: float) -> None:
    """A failure means that once any sample is lost, the error of Λ_st of slips behind a moving mean is a
    third of what it should be, or that slips that are interpolated count as longer."""
    test = cycles(uneven_lengths(200), np.full(60, 0.5), noise=0.05)
    load = test.force["load_N"].rolling(time_s=5, center=True, min_periods=1).mean()
    kept = np.flatnonzero(np.random.default_rng(2).random(load.size) > lost)
    whole, found = (
        matched(find_stick_slip(test.force.assign(load_N=load).isel(time_s=rows)), test.truth)[0]
        for rows in (np.arange(load.size), kept)
    )
    assert len(found) == len(whole) == 58
    for name in ("dF_err_N", "stick_length_err_um"):
        assert found[name].median() == pytest.approx(whole[name].median(), rel=0.25)


@pytest.mark.parametrize(("ratio", "noise", "most"), [(1.4, 0.25, 1.2), (1.8, 0.05, 0.15)])
def test_errors_at_the_ends_of_sticks_with_a_knee(ratio: float, noise: float, most: float) -> None:
    """A failure means that F_v and ΔF are off by 2 to 8 % of the drop, ten times their errors, where noise
    hides the knee of single sticks; or that a knee's short first line counts as one through all samples."""
    first = 1 / (0.35 + 0.65 / ratio)
    test = cycles(
        uneven_lengths(600),
        np.full(60, 1.5),
        noise=noise,
        along=lambda u: np.where(u < 0.35, first * u, 1 - first / ratio * (1 - u)),
    )
    events, truth = matched(find_stick_slip(test.force), test.truth)
    assert len(events) == 58
    for name in ("F_v_N", "dF_N"):
        assert within(events, truth, name) > 0.6, name
    assert events["dF_err_N"].median() < most


def test_a_load_that_only_rises_is_said_to_be_another_column() -> None:
    """A failure means that a displacement taken for the load is answered with advice about the threshold."""
    index = np.arange(2000)
    with pytest.raises(InputError, match="without turning back; name its column"):
        find_stick_slip(recording(0.01 * index, 1 + index / 6000, 13 + index / 6000, 1.0))


@pytest.mark.parametrize(
    ("how", "hertz"), [("butterworth", 2.0), ("butterworth", 3.0), ("zero phase", 2.0), ("load cell", 2.8)]
)
def test_a_filter_that_bends_the_sticks_is_part_of_the_error_of_k(how: str, hertz: float) -> None:
    """A failure means K several of its errors from the sample's, where a filter reaches into the sticks."""
    test = plain(sticks=80, samples=160, snr=400, jitter=0.05)
    load = test.force["load_N"].to_numpy()
    rest = load - load[0]
    if how == "butterworth":
        rest = sosfilt(butter(4, hertz, fs=100.0, output="sos"), rest)
    elif how == "zero phase":
        rest = sosfiltfilt(butter(2, hertz, fs=100.0, output="sos"), rest)
    else:  # a load cell with 0.3 of the critical damping, and slips of 18 samples
        angle, decay = 2 * np.pi * hertz / 100, np.exp(-0.3 * 2 * np.pi * hertz / 100)
        poles = [1, -2 * decay * np.cos(np.sqrt(1 - 0.3**2) * angle), decay**2]
        slip = np.hanning(18) / np.hanning(18).sum()
        rest = lfilter([sum(poles)], poles, np.convolve(rest, slip, "same"))
    noise = 0.5 * np.random.default_rng(3).standard_normal(load.size)
    events = find_stick_slip(test.force.assign(load_N=("time_s", load[0] + rest + noise)))
    true = test.truth["K_N_per_mm"].iloc[0]
    off = (events["K_N_per_mm"] - true).abs() / events["K_err_N_per_mm"]
    assert np.mean(off < 1) > 0.6
    assert np.mean(off < 3) > 0.95
    assert events["K_err_N_per_mm"].median() < 0.15 * true
