"""The summary prints every result with its errors, and nothing that was not measured."""

import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from tests.scenes.analysed import with_force
from tests.scenes.machine_files import SNAKE, written
from vision.clock.clock import Candidate
from vision.data import FlagCounts, StickMetadata, TrackMetadata
from vision.figures.catalogue import FIGURES
from vision.force import read_force
from vision.report.page import budget_table
from vision.report.text import methods, subtitle
from vision.summary import (
    answers,
    force_columns_text,
    lowpass_correction,
    positions_line,
    ridges_line,
    summary_lines,
)


@pytest.mark.parametrize(("sheets", "line"), [(2, "8.0 px wide, 20.0 px apart; "), (1, "8.0 px wide; ")])
def test_a_single_ridge_has_no_spacing(sheets, line):
    """A failure means that the width of the picture is printed as a spacing of sheets."""
    spacing_px = 20.0 if sheets > 1 else float("nan")
    assert line in ridges_line(TrackMetadata(sheets=sheets, ridge_fwhm_px=8.0, spacing_px=spacing_px))


def test_blurred_positions_are_measured():
    """A failure means that positions with a larger error are counted as if they were lost."""
    flags = np.repeat(["ok", "blurred", "missing"], [95, 3, 2])[:, None]
    tracks = xr.Dataset({"flag": (("frame", "sheet"), flags)})
    assert positions_line(FlagCounts(tracks)).text == "98 of 100 measured (3 of them blurred); 2 missing"
    assert positions_line(FlagCounts(tracks.isel(frame=slice(95)))).text == "95 of 95 measured"


def test_the_columns_taken_from_the_force_recording_are_named(tmp_path):
    """A failure means that nobody notices that another column or unit was taken, or that a long name fills
    the screen."""
    path = written(tmp_path, SNAKE)
    test = replace(with_force(), force=read_force(path))
    taken = "test.txt: time = time [s], load = load [mN], displacement = crosshead [cm]; 10 Hz, V 1.2 mm/min"
    assert f"force      {taken}" in summary_lines(test)
    assert f"; force from {taken}" in subtitle(test)
    long = written(tmp_path, SNAKE.replace("load", "load_" + "x" * 80), name="f" * 100 + ".txt")
    line = force_columns_text(read_force(long))
    assert len(line) < 160
    assert "load = load_xxx" in line and "… [mN], displacement = crosshead [cm]; 10 Hz" in line


def test_both_errors_are_printed():
    """A failure means that a statistical error is read as if it were all."""
    lines = summary_lines(with_force())
    models = next(line for line in lines if line.startswith("models"))
    assert models.count("(stat.)") == models.count("(syst.)") == 4


def test_a_parameter_that_is_not_determined_has_no_number():
    """A failure means that somebody copies the value at which a fit stopped, with its tiny error."""
    test = with_force()
    doubtful = replace(test, fits=replace(test.fits, undetermined=("N_hat_N", "Lambda_hat_mm", "Y_eff_GPa")))
    modulus = re.compile(r"3\.(79|80)\d*")
    texts = {
        "summary": lambda of: "\n".join(line for line in summary_lines(of) if "Y_eff" in line),
        "answers": lambda of: " ".join(one.detail for one in answers(of) if "Y_eff" in one.detail),
        "methods": lambda of: methods(of)[-1],
        "figure": lambda of: FIGURES["stiffness"].make(of).caption,
        "budget": lambda of: " ".join(budget_table(of).rows[0]),
    }
    for name, text in texts.items():
        assert modulus.search(text(test)), name
        assert not modulus.search(text(doubtful)), name
        assert "not determined" in text(doubtful), name


def test_an_axis_through_a_sheet_is_said():
    """A failure means that an overlooked sheet, which makes their number odd, is not thought of."""
    test = with_force()
    plain, sheets = axis_line(test.tracks), test.tracks["x_mean_px"].values
    assert "goes through" not in plain
    sheet = int(test.tracks["side"].values.searchsorted(1))
    on_it = test.tracks.assign_attrs(axis_px=float(sheets[sheet]) - 1.0)
    assert f"; it goes through sheet {sheet}, which counts as n = 1 on the right: " in axis_line(on_it)
    assert "goes through" not in axis_line(on_it.assign_attrs(axis_how="given"))  # the user knows


def axis_line(tracks):
    return next(
        line for line in summary_lines(replace(with_force(), tracks=tracks)) if line.startswith("axis")
    )


def test_negative_numbers_have_a_minus_sign():
    """A failure means hyphens beside minus signs in the same ten lines."""
    test = with_force()
    lines = summary_lines(replace(test, tracks=test.tracks.assign_attrs(tilt_deg=-0.7)))
    assert any("tilt −0.70°" in line for line in lines)
    assert not [line for line in lines if re.search(r"[ (]-[\d.]", line)]


def test_the_ratios_of_sheets_have_no_powers_of_ten():
    """A failure means a smallest ratio of 9.3e-05."""
    test = with_force()
    ratio = test.motion["ratio"].copy()
    ratio[:, 0] = 9.3e-5
    lines = summary_lines(replace(test, motion=test.motion.assign(ratio=ratio)))
    (line,) = (line for line in lines if line.startswith("shells"))
    assert "; median σ_x/Λ_st of a sheet 0.000 to " in line


def test_events_of_an_oscillation_are_not_called_stick_slip():
    """A failure means a summary that contradicts the warning below it."""
    found = with_force()
    assert any("stick-slip events" in line for line in summary_lines(found))
    sticks = found.sticks.copy()
    sticks.attrs = {**sticks.attrs, "regime": "oscillation"}
    lines = summary_lines(replace(found, sticks=sticks))
    (line,) = (line for line in lines if line.startswith("events"))
    assert f"{len(sticks)} events (oscillation, not stick-slip)" in line


@pytest.mark.parametrize("lowpass_s", [0.0, 0.012])
def test_hum_is_a_line_of_its_own(lowpass_s):
    """A failure means that hum, which forces contain, is named only where no low-pass is corrected."""
    found = with_force()
    assert not any(line.startswith("hum") for line in summary_lines(found))
    sticks = found.sticks.copy()
    sticks.attrs = {**sticks.attrs, "lowpass_s": lowpass_s, "hum_Hz": 50.0, "hum_N": 0.31}
    lines = summary_lines(replace(found, sticks=sticks))
    (line,) = (line for line in lines if "hum" in line)
    assert line == "hum        slips are searched without hum of 50 Hz, 0.31 N rms"


def test_systematic_errors_are_a_line_each():
    """A failure means numbers that nobody can find in one long line, or no word on what is missing."""
    lines = summary_lines(with_force())
    first = next(k for k, line in enumerate(lines) if line.startswith("errors"))
    place, stiffness, rest, sample = (line[11:] for line in lines[first:])
    assert place.startswith("absolute position of a sheet") and place.count("±") == 1
    assert "systematic" in place and "statistical" in place
    assert stiffness.startswith("K ±") and "N/mm" in stiffness
    assert rest == "not included, since no error is known: compliance of the machine, pixel size, clock"
    assert sample == "M = 25 sheets of 0.1 x 45 x 57 mm (the publication's where not given)"
    assert sum("d0" in line for line in lines) == 1  # the note of the fits


def test_every_fitted_value_and_the_ratio_are_printed():
    """A failure means a result for which the user has to open a table."""
    lines = summary_lines(with_force())
    models = next(k for k, line in enumerate(lines) if line.startswith("models"))
    assert all(f"{name} " in " ".join(lines[models : models + 2]) for name in ("μ", "A", "N̂", "Λ̂", "𝒯0"))
    assert any("median σ_x/Λ_st of a sheet" in line for line in lines if line.startswith("shells"))


def test_frozen_frames_are_counted_beside_the_others():
    """A failure means a film of which half is copies, summarised as read in full."""
    found = with_force()
    tracks = found.tracks.copy(deep=True)
    tracks["flag"][3:5] = "frozen"
    (line,) = (line for line in summary_lines(replace(found, tracks=tracks)) if line.startswith("frames"))
    assert line.endswith(" read; 2 frozen")
    (box,) = (box for box in answers(replace(found, tracks=tracks)) if box.what == "frames")
    assert box.detail == "2 frozen" and box.doubt
    assert any("; none lost, blank, corrupt or frozen" in line for line in summary_lines(found))


def test_the_clock_s_errors_are_printed():
    """A failure means a drift that is all noise, printed as if it were measured."""
    found = with_force()
    known = replace(found.clock, offset_s=36.2, offset_err_s=0.0121, drift_ppm=231.2, drift_err_ppm=635.0)
    line = clocks_line(replace(found, clock=known))
    assert "offset 36.200 ± 0.012 s, drift +231 ± 635 ppm" in line
    assert "offset 36.2000 s, drift +231 ppm" in clocks_line(
        replace(found, clock=replace(known, offset_err_s=np.nan, drift_err_ppm=np.nan))
    )


def test_the_drift_of_a_given_offset_is_called_assumed():
    """A failure means that a drift of 0, which nobody measured, is printed as a result."""
    found = with_force()
    given = replace(found.clock, status="given", drift_ppm=0.0, drift_err_ppm=np.nan)
    assert "drift 0 ppm (assumed)" in clocks_line(replace(found, clock=given))
    assert "assumed" not in clocks_line(replace(found, clock=replace(given, status="ok")))


def test_ambiguous_clocks_list_their_candidates():
    """A failure means that a user cannot choose between the offsets that the slips allow."""
    found = with_force()
    three = [
        Candidate(offset_s=s, drift_ppm=0.0, log_likelihood=a, matched=5)
        for s, a in ((36.2, 9.1), (35.7, 8.8), (36.7, 3.0), (37.2, 1.0))
    ]
    clock = replace(found.clock, status="ambiguous", candidates=tuple(three))
    line = clocks_line(replace(found, clock=clock))
    assert "ambiguous" in line and "36.200 s (9.1), 35.700 s (8.8), 36.700 s (3.0)" in line
    assert "37.2" not in line


def clocks_line(found):
    return next(line for line in summary_lines(found) if line.startswith("clocks"))


def test_without_a_position_nothing_is_called_nan():
    """A failure means "nan px" in the summary of a run in which every position is doubtful."""
    found = with_force()
    tracks = found.tracks.copy(deep=True)
    tracks["flag"][:] = "doubtful"
    for name in ("x_px", "x_err_px", "x_noise_px"):
        tracks[name][:] = np.nan
    tracks = tracks.assign_attrs(axis_px=float("nan"), codec="mjpeg")
    lines = summary_lines(replace(found, tracks=tracks))
    assert any(line.split() == ["axis", "not", "known"] for line in lines)
    assert not [line for line in lines if "nan" in line]


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({}, "forces as recorded"),
        ({"lowpass_s": 0.012, "lowpass_how": "given"}, "low-pass of 12 ms (as given)"),
        ({"lowpass_proposed_s": 0.0034, "lowpass_proven": True}, "the slips show a low-pass of 3.4 ms"),
        ({"lowpass_proposed_s": 0.176, "lowpass_proven": True}, "the slips show a low-pass of 176 ms"),
        (
            {"lowpass_proposed_s": 0.0034, "lowpass_doubt": "differs"},
            "may show (they differ) a low-pass of 3.4 ms",
        ),
        (
            {"lowpass_proposed_s": 0.07, "lowpass_doubt": "shape"},
            "suggest a low-pass of 70 ms, but have a tail without it: another filter",
        ),
    ],
)
def test_the_load_cell_s_time_constant_is_said_in_ms(facts, said):
    """A failure means that a correction is hidden, or said to be a thousand times smaller than it is."""
    sticks = pd.DataFrame()
    sticks.attrs |= StickMetadata(**facts).attrs()
    assert said in lowpass_correction(sticks)
