"""docs/methods.md states the numbers that the program uses."""

import re
from pathlib import Path

import pytest

from vision.certify.settings import CertifySettings
from vision.comparison import CompareSettings
from vision.deformation import DeformationSettings
from vision.models.single_fits import FitSettings
from vision.numeric import TYPICAL_ROWS
from vision.sheets import TrackingSettings
from vision.shells import ShellSettings
from vision.video.settings import VideoSettings

PAGE = Path(__file__).parents[2] / "docs" / "methods.md"
WORDS = {1: "one", 2: "two", 3: "three", 4: "four", 5: "five", 6: "six", 8: "eight", 9: "nine"}


def word(number):
    """The number as the page writes it."""
    return WORDS.get(number, f"{number:g}")


video, sheets, moved = VideoSettings(), TrackingSettings(), DeformationSettings()
shells, fits, tests, films = ShellSettings(), FitSettings(), CompareSettings(), CertifySettings()
narrow, wide = sheets.standard_widths_px
height, top, slope = sheets.static_scale
least, most, share = sheets.left_behind
STATED = (
    f"exceeds {100 * video.column_gain:g} % and, between eight parts of the columns,"
    f" {word(video.column_sigmas)} standard errors",
    f"is a median of up to {TYPICAL_ROWS} frames",
    f"w is {sheets.standard_window_px} for ridges {narrow:g} to {wide:g} px wide",
    f"seen in {sheets.template_frames} frames, moves by {sheets.template_motion_px:g} px (rms)",
    f"the same motion within {100 * sheets.template_scale:g} %",
    f"if an amplitude exceeds {word(sheets.locking_sigmas)} errors.",
    f"is left (see below), times {sheets.sharpened:g}",
    f"exceeds {100 * sheets.covered_width:g} % and {word(sheets.distortion_sigmas)} times the scatter",
    f"times {height:g} px, {top:g} and {slope:g}, are added",
    f"0 below {100 * sheets.static_floor:g} %; where ridges are wider than {sheets.overlap:g} of their",
    f"within cells of {sheets.texture_length:g} ridge widths",
    rf"the error is ${sheets.texture_shift:g}\,\sigma_r s\,\Delta$",
    f"from {sheets.texture_length:g} ridge widths on, nearly constant",
    f"correlation over all gaps is below −{sheets.second_comb_correlation:g}",
    rf"${sheets.second_comb_shift:g}\,\sigma_r\sqrt{{-q\langle t g\rangle}}$",
    f"correlated by less than −{sheets.second_comb_opposite:g}",
    f"exceed {sheets.second_comb_lopsided:g} times what single sheets",
    rf"at least ${sheets.second_comb_whole:g}\,\sigma_r\sqrt{{-\langle t g\rangle}}$",
    f"ridges narrower than {sheets.second_comb_least_px:g} px",
    f"exceeds {word(sheets.distortion_sigmas)} times its noise in a single frame, as a mean over"
    f" {word(sheets.distortion_frames)} frames",
    f"up to {sheets.distortion_gap} frames between two significant means",
    f"that from noise and {sheets.distortion_floor:g} px",
    f"({sheets.distortion_error:g} for the first difference, {sheets.distortion_slope:g} for the second)",
    f"ridges narrower than {sheets.sampled_well_px:g} px depends",
    f"a step beyond {sheets.slip_sigmas:g} standard deviations",
    f"beyond {sheets.own_excess:g} times the median their own value",
    rf"From $\rho = {sheets.lasting_noise:g}$ a warning",
    rf"contains ${sheets.lag_error:g}\,\rho/(1-\rho)$ times the motion",
    rf"at least ${least:g}\,x_q$",
    rf"at least ${share:g}\,u$, up to ${most:g}\,x_q$",
    f"below {sheets.least_likeness:g} times the square",
    f"by more than {sheets.most_distorted:g} ridge widths (`x_lasting_px`), if this correlation is below"
    f" {sheets.usual_likeness:g}",
    f"{sheets.wide_by_a_gap:g} times as wide as the others",
    f"distorted by {sheets.mark_distorted:g} widths and moves less than {sheets.mark_motion:g} of",
    f"within {sheets.merged_widths:g} ridge widths of it, or the neighbour is {sheets.merged_height:g}"
    f" times as high or {sheets.merged_width:g} times as wide",
    f"less than {sheets.faint_end:g} of its contrast is no sheet if it moves by less than"
    f" {sheets.slow_end:g} of the next",
    f"(correlation below {sheets.along_end:g})",
    f"width (by a factor of {sheets.odd_width:g})",
    f"moves along (correlation {sheets.along_beyond:g})",
    f"the ridge has {sheets.faint_contrast:g} of the contrast. It must be there in {sheets.present_inside:g}"
    f" of the frames, or in {sheets.seldom_beyond:g} if it has {sheets.clear_beyond:g} of the contrast",
    f"by more than {sheets.even_spacing:g} between quartiles",
    f"move by {word(sheets.least_squeeze)} pitches, positions are compared",
    f"less likely by {sheets.anchor_nats:g} nats",
    f"better by {sheets.anchor_nats / 2:g} nats for each",
    rf"> {sheets.doubt:g} \text{{ nats}},$$ where",
    f"is {sheets.false_detection_cost:g} nats for an unpaired ridge",
    rf"> {sheets.part_nats:g} \text{{ nats}}$$ as a mean",
    f"*Valid* for {word(sheets.pattern_sheets)} sheets or more whose brightnesses",
    f"at least {sheets.edge_pitches:g} pitches inside the picture",
    f"(spacings by {sheets.spacing_spread:g} pitches)",
    f"moved by more than {sheets.step_fraction:g} pitches",
    f"where $a_2$ exceeds {word(moved.curvature_errors)} of its errors, in sticks of"
    f" {word(moved.least_curved)} positions",
    f"magnification ({100 * moved.scale_error:g} % of each displacement)",
    f"({100 * moved.locking:g} % of each displacement, `locking`)",
    f"Fewer than {word(moved.least_repeats)} sticks show neither",
    f"{shells.draws} of them are drawn",
    f"contains {100 * shells.certainty:g} % of the draws",
    f"{films.distorted_errors:g} times the usual one and {word(films.neighbour_errors)} times the usual",
    f"films' errors are {films.above_noise:g} times the recording's noise",
    f"differs by {100 * films.alike - 100:g} % from that",
    f"(χ²/dof above {fits.contradicting_chi2:g} and 𝒯0 beyond {fits.largest_offset_N:g} N)",
    f"clear ({word(fits.clear_offset)} of its errors, and larger than 𝒯0)",
    f"a scatter of the drops above {100 * fits.unlike_drops:g} %",
    f"in [−{tests.t0_limit_N:g}, {tests.t0_limit_N:g}] N",
    f"with a χ²/dof above {tests.most_disagreement:g}",
    f"over {tests.smooth_events} events",
    f"if fewer than {100 * tests.change_p:g} % of random orders divide as well",
)


@pytest.mark.parametrize("sentence", STATED)
def test_a_number_is_that_of_its_setting(sentence):
    """A failure means that a setting was changed and the page was not, or that a sentence with its number was
    reworded: change both."""
    assert sentence in re.sub(r"\s+", " ", PAGE.read_text(encoding="utf-8"))
