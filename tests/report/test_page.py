"""The page as a file: complete, small, honest about what it lacks, and unable to ask the network."""

import html
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes.analysed import FACTS, Found
from tests.scenes.report_data import make_profile, make_tracks, sawtooth
from vision.data import NOT_SUBTRACTED, changed_settings, record
from vision.figures.catalogue import figures_of
from vision.force import ForceSettings
from vision.models import Estimate
from vision.report import write_report
from vision.report.page import budget_table
from vision.report.text import methods
from vision.summary import answers

LIMIT = 3_000_000


def page_of(results, folder):
    options = {"force": "--force", "pixel_size_um": "--pixel-size"}
    return write_report(folder / "report.html", results, FACTS, options=options).read_text(encoding="utf-8")


def names(results):
    return [figure.name for figure in figures_of(results)]


def test_without_force_the_page_says_what_is_missing(video_only, tmp_path):
    """A failure means an empty figure, or a reader who does not learn why there is none."""
    page = page_of(video_only, tmp_path)
    assert names(video_only) == ["frame", "space_time", "tracks", "outer_inner", "noise", "pixel_locking"]
    assert "no force recording was given (--force)" in page
    assert "no pixel size was given (--pixel-size)" in page
    assert "stiff shell</div>" not in page


def test_the_title_tells_films_of_one_name_apart(pulled, tmp_path):
    """A failure means ten open pages that are all called video.avi."""
    strip = pulled.strip.assign_attrs(source="/data/test 7/video.avi")
    assert "<h1>test 7/video.avi</h1>" in page_of(replace(pulled, strip=strip), tmp_path)


def test_the_size_of_the_shell_has_its_interval(pulled):
    """A failure means a number without an error at the top of the page."""
    (shell,) = (one for one in answers(pulled) if one.what == "stiff shell")
    known = pulled.shells[pulled.shells["stiff_sheets"].notna()].sort_values("d_v_mm").head(6)
    low, size, high = (known[name].median() for name in ("stiff_low", "stiff_sheets", "stiff_high"))
    assert shell.value.startswith(f"{size:g} ({low:g} to {high:g})")


def test_ambiguous_clocks_are_in_doubt_at_the_top(pulled, tmp_path):
    """A failure means that a reader takes an alignment that may be wrong for a result."""
    doubtful = replace(pulled, clock=replace(pulled.clock, status="ambiguous"), motion=None, shells=None)
    page = page_of(doubtful, tmp_path)
    assert re.search(r'class="doubt"><div class="what">clocks</div><div class="value">ambiguous', page)
    assert "The clocks of camera and testing machine were aligned" not in page


def test_stick_phases_in_the_video_are_not_counted_without_a_clock(pulled):
    """A failure means "0 stick phases" where nobody knows how many there are, or no reason why."""
    clock = replace(pulled.clock, status="ambiguous", ambiguity="too few slips in common")
    told = {one.what: one for one in answers(replace(pulled, clock=clock, motion=None, shells=None))}
    phases = told["stick phases"]
    assert phases.value == "not known in the video (clocks ambiguous)" and phases.doubt
    assert f"{len(pulled.sticks)} in the force recording" in phases.detail
    assert "too few slips in common" in told["clocks"].detail
    assert answers(pulled)[2].value == f"{pulled.motion.sizes['event']} in the video"


def test_a_stage_that_could_not_run_is_a_warning(pulled, tmp_path):
    """A failure means "0 stick phases" and a green "No warnings." on the page of a command that failed."""
    reasons = {"clock": "expected at least 4 slips to align the clocks; found 3"}
    refused = replace(pulled, clock=None, motion=None, shells=None, reasons=reasons)
    phases = next(one for one in answers(refused) if one.what == "stick phases")
    assert phases.value == "not known in the video (no common clock)" and phases.doubt
    page = write_report(tmp_path / "report.html", refused, {}).read_text(encoding="utf-8")
    (warned,) = re.findall(r'<div class="warnings".*?</div>', page, re.DOTALL)
    assert "found 3" in warned and "No warnings." not in page


def test_the_clock_is_stated_with_its_errors(pulled, tmp_path):
    """A failure means a drift that is all noise, published as if it were measured."""
    clock = replace(pulled.clock, drift_ppm=231.0, drift_err_ppm=635.0, offset_err_s=0.012)
    page = page_of(replace(pulled, clock=clock), tmp_path)
    assert page.count("231 ± 635 ppm") >= 3  # at the top, in the methods, below the figure
    assert page.count("36.000 ± 0.012 s") >= 3


def test_the_top_of_the_page_has_no_parameter_without_its_error(pulled):
    """A failure means that N̂, A and Y_eff are copied from the page without errors, or with half of them."""
    known = Estimate(0.534, 0.003, 0.004)
    unknown = Estimate(3.42, 0.02)
    fits = replace(pulled.fits, n_hat_N=known, amplitude=known, modulus_GPa=unknown)
    detail = next(one for one in answers(replace(pulled, fits=fits)) if one.value.startswith("μ")).detail
    assert "A 0.5340 ± 0.0030 (stat.) ± 0.0040 (syst.), N̂ 0.5340 ± 0.0030 " in detail
    assert detail.endswith(", Y_eff 3.420 ± 0.020 GPa")


def test_the_methods_compile_in_latex(pulled, tmp_path):
    """A failure means that a manuscript lacks Greek letters, or does not compile for a bare percent sign."""
    block = re.search(r'id="methods-latex" hidden>(.*?)</blockquote>', page_of(pulled, tmp_path), re.DOTALL)
    text = html.unescape(re.sub(r"</?p>", "\n", block[1]))
    assert text.isascii() and text.count("$") % 2 == 0
    assert not re.search(r"(?<!\\)[%&#]", text)
    for formula in (r"$\sigma_{x}$", r"$\hat{N}$ = 0.5", r"$\mathcal{T}_{0}$", r"$F_{\mathrm{p}}$", r"80 \%"):
        assert formula in text


def test_the_answers_are_the_run_s(pulled, tmp_path):
    """A failure means that the top of the page has other numbers than the tables."""
    page = page_of(pulled, tmp_path)
    assert "50 bright ridges (25 left, 25 right)" in page
    assert f'<div class="value">{pulled.motion.sizes["event"]} in the video</div>' in page
    assert "offset 36.0000 s" in page
    assert f"x_err_px {np.nanmedian(pulled.tracks['x_err_px']):.4f} px" in page
    assert re.search(r"μ 0\.8[89]\d* ± 0\.0", page)


def test_methods_name_the_actual_parameters(pulled, tmp_path):
    """A failure means that a paper would be told settings that were not used."""
    text = page_of(pulled, tmp_path).split('id="methods">')[1].split("</blockquote>")[0]
    for part in (
        "60 frames per second",
        "10 µm per pixel",
        "84 rows",
        "over 9 pixels",
        "below 0.1",
        "T* = 3 mN",
    ):
        assert part in text
    other = replace(pulled, tracks=pulled.tracks.assign_attrs(window_px=11, fit="paper"), threshold=0.2)
    text = page_of(other, tmp_path).split('id="methods">')[1].split("</blockquote>")[0]
    assert "fitted to 11 pixels centred on the brightest pixel" in text
    assert "below 0.2" in text


def test_warnings_stand_at_the_top_and_cannot_break_the_page(pulled, tmp_path):
    """A failure means that a file name or warning can inject script, or that a warning is lost."""
    page = page_of(pulled, tmp_path)
    assert "3 frames &lt;/script&gt; lost" in page
    assert "alert(1)</script>" not in page
    assert page.index("Warnings") < page.index("What the camera saw")
    assert "No warnings" not in page


def test_nothing_in_the_page_points_outside(pulled, tmp_path):
    """A failure means that the page asks the network when it is opened."""
    page = re.sub("<script>.*?</script>", "", page_of(pulled, tmp_path), flags=re.DOTALL)
    assert not re.findall(r'(?:src|href|action)\s*=\s*["\'](?!data:)[^"\']', page)
    assert "@import" not in page
    assert "default-src 'none'" in page


def test_parameters_and_command_are_listed(pulled, tmp_path):
    """A failure means that a run cannot be repeated from its report."""
    page = page_of(pulled, tmp_path)
    assert "<td>fit</td><td>sliding</td><td>default</td>" in page
    assert "track test.avi &lt;script&gt;" in page


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("frames", "sheets", "width"), [(100_000, 50, 300), (1500, 200, 4100), (600, 7, 1200)]
)
def test_the_page_stays_under_three_megabytes(tmp_path, frames, sheets, width):
    """A failure means that the report of a long or wide test is too heavy to mail."""
    tracks = make_tracks(sawtooth(frames, sheets))
    frame = np.random.default_rng(0).integers(0, 255, (1200, 1920), dtype=np.uint8)
    results = Found(strip=make_profile(tracks, width), tracks=tracks, frame=frame, pixel_size_um=10.0)
    assert write_report(tmp_path / "report.html", results, {}).stat().st_size < LIMIT


def test_inputs_are_left_as_they_were(pulled, tmp_path):
    """A failure means that writing a report changes results that are written after it."""
    tracks, sticks, shells = pulled.tracks.copy(deep=True), pulled.sticks.copy(), pulled.shells.copy()
    page_of(pulled, tmp_path)
    assert tracks.identical(pulled.tracks)
    assert sticks.equals(pulled.sticks)
    assert shells.equals(pulled.shells)


def test_sheets_never_found_and_frames_never_seen_do_not_break_the_page(tmp_path):
    """A failure means no report for exactly those runs that need one most."""
    x = sawtooth(300, 8)
    x[:, 2] = np.nan
    x[100:150] = np.nan
    tracks = make_tracks(x)
    profile = make_profile(tracks, 180)
    profile[100:150] = np.nan
    frame = np.zeros((40, 180), np.uint8)
    page = page_of(Found(strip=profile, tracks=tracks, frame=frame), tmp_path)
    assert re.search(r'class="doubt"><div class="what">positions', page)


def test_a_run_that_found_no_position_at_all_says_so(tmp_path):
    """A failure means a traceback in place of the page that would show what went wrong."""
    tracks = make_tracks(np.full((300, 7), np.nan)).assign_attrs(axis_px=float("nan"))
    tracks = tracks.assign(x_noise_px=("sheet", np.full(7, np.nan)))
    results = Found(strip=make_profile(tracks, 180), tracks=tracks, frame=np.eye(40, 180))
    page = page_of(results, tmp_path)
    assert "not known" in page
    assert re.search(r'class="doubt"><div class="what">positions', page)
    assert "nan" not in page.split('id="methods">')[1].split("</blockquote>")[0]
    for figure in figures_of(results):
        figure.save(tmp_path / f"{figure.name}.png")


def test_a_force_recording_alone_has_its_page(pulled, tmp_path):
    """A failure means that the report takes a video for granted."""
    alone = Found(force=pulled.force, sticks=pulled.sticks, fits=pulled.fits)
    page = page_of(alone, tmp_path)
    assert names(alone) == ["force", "sticks", "force_drop", "stiffness", "stiffness_residuals"]
    assert f'<div class="what">events of the force</div><div class="value">{len(pulled.sticks)}' in page
    assert "no video was given" in page


def test_arguments_are_shown_as_the_command_s_options(video_only, tmp_path):
    """A failure means that a user of the command is told the names of Python arguments."""
    page = page_of(video_only, tmp_path)
    assert "(--force)" in page
    assert "`" not in page.split("<script")[0].split("</style>")[-1]
    bare = write_report(tmp_path / "bare.html", video_only, {}).read_text(encoding="utf-8")
    assert "(pixel_size_um)" in bare


def test_methods_tell_what_this_run_lacks(pulled):
    """A failure means that a paper claims what the run did not have."""
    plain = " ".join(methods(pulled))
    assert "were left out" not in plain
    assert "compression" not in plain
    flags = pulled.tracks["flag"].copy()
    flags[:3, 0] = "doubtful"
    strip = pulled.strip.assign_attrs(codec="h264", tilt_deg=0.7, frames_lost=4, fps=float("nan"))
    text = " ".join(methods(replace(pulled, tracks=pulled.tracks.assign(flag=flags), strip=strip)))
    assert f"3 of {flags.size} positions were left out" in text
    assert "lossy compression (h264)" in text
    assert "tilted by 0.70°" in text
    assert "(4 lost)" in text
    assert "a frame rate that is not known" in text
    text = " ".join(methods(replace(pulled, tracks=pulled.tracks.assign_attrs(sheets=1), pixel_size_um=None)))
    assert "One sheet appears as a " in text
    assert "px apart" not in text
    assert "The pixel size is not known." in text


def test_methods_tell_whether_common_motion_was_subtracted(pulled):
    """A failure means that σ_x with the camera's motion in it is presented as if it were without."""
    common = "for motion common to all sheets"
    off = replace(pulled, motion=pulled.motion.assign_attrs(camera_movement=NOT_SUBTRACTED))
    for results, subtracted in ((pulled, True), (off, False)):
        caption = next(one for one in figures_of(results) if one.name == "deformation").caption
        assert (common in " ".join(methods(results)), common in caption) == (subtracted, subtracted)


def test_methods_tell_what_was_given_and_corrected(pulled):
    """A failure means that a paper presents a friction coefficient that was typed as one that was fitted."""
    plain = " ".join(methods(pulled))
    assert "given" not in plain.partition("Their peak forces")[2]
    assert "corrected for a machine" not in plain
    span = "from d = {:.2f} to {:.2f} mm were used".format(*pulled.fits.d_mm)
    assert f"{pulled.fits.goodness['peaks'].points} stick phases {span}" in plain
    sticks = pulled.sticks.copy()
    sticks.attrs = {**sticks.attrs, "machine_stiffness_N_per_mm": 1e5}
    t_star = Estimate(0.0031, 0.0002)
    fits = replace(pulled.fits, held=("mu", "modulus_GPa"), t_star_N=t_star)
    text = " ".join(methods(replace(pulled, sticks=sticks, fits=fits)))
    assert "T* = 3.1 mN (fitted)" in text
    assert "μ and Y_eff were given." in text
    assert "d was corrected for a machine of 100000 N/mm." in text


def test_methods_state_the_part_of_the_sticks_that_was_fitted(pulled):
    """A failure means that the page of a run with another `line_part` states that of the default."""
    assert "through the central 80 % of each stick phase" in " ".join(methods(pulled))
    sticks = pulled.sticks.copy()
    sticks.attrs = {**sticks.attrs, "operations": "[]"}
    sticks = record(sticks, "find_stick_slip", settings=changed_settings(ForceSettings(line_part=0.6)))
    text = " ".join(methods(replace(pulled, sticks=sticks)))
    assert "through the central 60 % of each stick phase" in text


def test_methods_tell_that_the_error_of_d0_is_not_known(pulled):
    """A failure means that a paper states systematic errors without the largest source, in silence."""
    known, unknown = (replace(pulled.fits, input_errors=errors) for errors in ({"d0_mm": 0.1}, {}))
    assert "d0" not in " ".join(methods(replace(pulled, fits=known)))
    text = " ".join(methods(replace(pulled, fits=unknown)))
    assert "systematic errors; the latter without the error of d0, which is not known)" in text
    assert re.search(r"the noise is [\d.]+ N\)", text)


def test_systematic_errors_are_a_table_of_the_page(pulled, tmp_path):
    """A failure means that a reader finds statistical errors only."""
    page = page_of(pulled, tmp_path)
    table = page.split("<h2>Systematic errors</h2>")[1].split("</section>")[0]
    for row in ("statistical error", "initial separation d0", "drift of the load cell", "uneven light"):
        assert f"<td>{row}</td>" in table
    assert "<td>not known</td>" in table
    assert "(stat.)" in page and "(syst.)" in page
    budget = budget_table(replace(pulled, clock=replace(pulled.clock, error_ms=0.5)))
    assert dict(zip(budget.heads, budget.rows[-3], strict=True))["σ_x/Λ_st"] == "0"
    total = dict(zip(budget.heads, budget.rows[-1], strict=True))
    assert total["σ_x/Λ_st"] == "not known"  # the clock adds 0, the pixel size nobody knows what
    assert float(total["K in N/mm"]) > 0


def test_doubtful_stretches_are_listed(video_only, tmp_path):
    """A failure means that a reader learns how many positions are withheld, but not which and why."""
    tracks = video_only.tracks.copy(deep=True)
    assert "<h2>Doubtful stretches</h2>" not in page_of(video_only, tmp_path)
    tracks["flag"].values[30:42, 7] = "doubtful"
    tracks["why"].values[30:42, 7] = "hop"
    tracks["flag"].values[20, 9], tracks["why"].values[20, 9] = "doubtful", "hop"
    page = page_of(replace(video_only, tracks=tracks), tmp_path)
    table = page.split("<h2>Doubtful stretches</h2>")[1].split("</section>")[0]
    assert "<td>7</td><td>left</td><td>18</td><td>30\u2060–\u206041</td>" in table
    assert "<td>20</td>" in table
    assert "on another ridge" in table
