from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from tests.scenes.films import comb
from vision.errors import InputError
from vision.video import VideoSettings, find_strip, measure_strip, open_video, strip_profile
from vision.video.strip_find import ridge_width_px, tilt_px

DATA = Path(__file__).parents[2] / "../shared/data"
HEIGHT, WIDTH, CLAMP, LABEL = 240, 960, slice(0, 20), slice(205, 230)
SHARP = (60, 180)  # rows between which the scene is in focus


@dataclass(frozen=True)
class Scene:
    """Frames that are already there, as a video."""

    pixels: np.ndarray
    path: Path = Path("scene")
    rotate: int = 0

    @property
    def shape(self):
        return self.pixels.shape[1:]

    def sample(self, count):
        return iter(self.pixels[:count])

    def frames(self):
        return iter(self.pixels)


def scene(*, pitch=20.0, fwhm=7.0, dark=False, tilt_deg=0.0, bow_px=0.0, noise=3.0, defocus=0.25, label=True):
    """Ridges with paper texture, in focus in `SHARP`, under a black clamp and over a striped label."""
    rng = np.random.default_rng(0)
    z, x = np.arange(HEIGHT)[:, None], np.arange(WIDTH)[None]
    width = fwhm / 2.355 + defocus * np.maximum(0, np.maximum(SHARP[0] - z, z - SHARP[1]))
    texture = 1 + 0.1 * rng.standard_normal((HEIGHT, WIDTH))
    bow = bow_px * (x / (WIDTH / 2) - 1) * ((z - np.mean(SHARP)) / 60) ** 2
    frames = []
    for t in range(4):
        place = x - np.tan(np.radians(tilt_deg)) * (z - HEIGHT / 2) - bow - 0.7 * t
        phase = (place + pitch / 2) % pitch - pitch / 2
        ridge = np.exp(-(phase**2) / 2 / width**2) * fwhm / 2.355 / width
        frame = (90 + (-50 if dark else 60) * ridge) * texture * (0.9 + 0.2 * x / WIDTH)
        frame[CLAMP] = 12
        if label:
            frame[LABEL, 100:300] = np.where(x[0, 100:300] // 12 % 2, 250, 5)
        frames.append(np.clip(frame + rng.normal(0, noise, frame.shape), 0, 255).astype(np.uint8))
    return Scene(np.array(frames))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"dark": True},
        {"pitch": 8, "fwhm": 4},
        {"pitch": 40, "fwhm": 14},
        {"noise": 25},
        {"tilt_deg": 0.5},
        {"tilt_deg": -1},
        {"label": False},
    ],
)
def test_rows_in_focus_are_found_and_their_lean_measured(options):
    """Failure: blurred rows, the clamp or the label are averaged in, or the reported tilt is not true."""
    strip = find_strip(scene(**options))
    assert strip.how == "found"
    assert 44 <= strip.rows.start <= 70
    assert 170 <= strip.rows.stop <= 196
    assert abs(strip.tilt_deg - options.get("tilt_deg", 0.0)) < 0.05
    assert strip.clarity > 0.9


@pytest.mark.parametrize("defocus", [0.25, 0.5])
def test_wide_ridges_avoid_clamp_and_label(defocus):
    """Failure: few wide ridges lose against the label's edges."""
    strip = find_strip(scene(pitch=160, fwhm=30, defocus=defocus))
    assert strip.rows.start >= 20
    assert strip.rows.stop <= 205
    assert strip.rows == find_strip(scene(pitch=160, fwhm=30, defocus=defocus, label=False)).rows
    height = strip.rows.stop - strip.rows.start
    assert height > (130 if defocus == 0.25 else 80)
    assert abs(np.tan(np.radians(strip.tilt_deg))) * height < 0.05 * 30  # of six ridges, with texture


def test_bowed_ridges_get_a_lower_strip():
    """Failure: rows where the outer sheets curve away are averaged in and blur the sheets that move most."""
    heights = []
    for bow_px in (0.0, 3.0, 8.0):
        rows = find_strip(scene(bow_px=bow_px, defocus=0.0, label=False)).rows
        assert abs((rows.start + rows.stop) / 2 - 120) < (15 if bow_px else 30)
        heights.append(rows.stop - rows.start)
    assert heights[0] > 210
    assert heights[0] > 1.15 * heights[1] > 1.3 * heights[2]


def test_leaning_too_far_is_reported_and_the_wrong_rows_are_worse():
    """Failure: a lean that smears the ridges goes unsaid; or an upright comb raises a false alarm."""
    leaning = find_strip(scene(tilt_deg=1.5))
    assert "tilted by +1.5" in leaning.warnings[0] or "tilted by +1.4" in leaning.warnings[0]
    assert find_strip(scene()).warnings == ()
    assert find_strip(scene(tilt_deg=0.5)).warnings == ()
    blurred = measure_strip(scene(), slice(186, 204))
    assert blurred.clarity < find_strip(scene()).clarity


@pytest.mark.parametrize("content", ["noise", "constant", "stripes along x"])
def test_nothing_to_find(content):
    """Failure: rows are picked out of noise and called a strip."""
    rng = np.random.default_rng(3)
    pixels = {
        "noise": rng.integers(0, 255, (4, 120, 400)),
        "constant": np.full((4, 120, 400), 90),
        "stripes along x": np.broadcast_to(rng.integers(0, 255, (120, 1)), (4, 120, 400)),
    }[content].astype(np.uint8)
    strip = find_strip(Scene(pixels))
    assert (strip.how, strip.rows) == ("all rows", slice(0, 120))
    assert np.isnan(strip.tilt_deg)


@pytest.mark.parametrize("rows", [1, 2, 3, 40])
def test_low_frames(rows):
    """Failure: recordings already cropped to the strip, even to one row, break the search."""
    pixels = scene(label=False).pixels[:, 100 : 100 + rows]
    strip = find_strip(Scene(pixels))
    assert strip.rows.stop - strip.rows.start >= (36 if rows == 40 else min(rows, 2))


@pytest.mark.parametrize("lean", [-0.31, 0.0, 0.07, 0.4])
def test_lean_of_known_shear(lean):
    """Failure: tilt has the wrong sign or size, or slips to the next pitch."""
    x, band = np.arange(500), np.arange(20)[:, None]
    bands = np.cos(2 * np.pi * (x - lean * (band - 9.5)) / 12.5)[None]
    assert abs(tilt_px(bands) - lean) < 0.005


@pytest.mark.parametrize("fwhm", [6, 10, 14, 30])
def test_ridge_width(fwhm):
    """Failure: the warning about leaning ridges measures them against a wrong width."""
    x = np.arange(960)
    profile = np.exp(-(((x % 160) - 80) ** 2) * 4 * np.log(2) / fwhm**2)
    assert abs(ridge_width_px(np.gradient(profile)[None]) - fwhm) < 0.15 * fwhm + 1


def test_given_rows_outside_the_frame():
    """Failure: a strip outside the frame is silently cut to it."""
    with pytest.raises(InputError, match="within 0:240"):
        measure_strip(scene(), slice(200, 260))


@pytest.mark.parametrize("span", [(400, 600), (450, 550), (0, 200)])
def test_a_comb_that_fills_a_fifth_of_the_width_keeps_all_its_rows(span):
    """Failure: the empty width beside the comb decides, and a few rows are taken for a hundred."""
    rng = np.random.default_rng(4)
    x = np.arange(1000)
    ridges = 60 * np.exp(-(((x[:, None] - np.arange(*span, 11)) / 2.2) ** 2) / 2).sum(axis=1)
    frames = 60 + ridges + rng.normal(0, 1, (8, 100, 1000))
    assert find_strip(Scene(frames)).rows == slice(0, 100)


@pytest.mark.skipif(not DATA.exists(), reason="real recordings are not here")
def test_real_recordings():
    """Failure: the strip misses the markers' discs, or runs over the black blot on the striped beam."""
    discs = find_strip(open_video(DATA / "released_markers.avi")).rows
    assert discs.start >= 10
    assert discs.stop <= 38
    beam = strip_profile(open_video(DATA / "striped_beam.cine", rotate=90))
    assert (beam.strip_how, beam.strip_z1 <= 136 or beam.strip_z0 >= 164) == ("found", True)
    assert abs(beam.tilt_deg) < 0.2


def test_pixels_without_a_value_do_not_hide_the_strip(tmp_path):
    """Failure: one NaN in a registered stack, or its empty border, and no strip is found."""
    frames = comb(count=8, rows=60, columns=200).astype(np.float32)
    frames[:, :20] = np.nan
    frames[3, 40, 100] = np.inf
    tifffile.imwrite(tmp_path / "a.tif", frames)
    strip = find_strip(open_video(tmp_path / "a.tif"))
    assert strip.how == "found"
    assert strip.rows.start >= 20
    tifffile.imwrite(tmp_path / "b.tif", np.full_like(frames, np.nan))
    assert find_strip(open_video(tmp_path / "b.tif")).how == "all rows"


def test_frames_that_cannot_be_decoded_are_no_strip(tmp_path):
    """A failure means a traceback for a file whose pixels are damaged throughout."""
    path = tmp_path / "damaged.tif"
    tifffile.imwrite(path, comb(count=1)[0], compression="jpeg")
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        start, count = page.dataoffsets[0], page.databytecounts[0]
    content = bytearray(path.read_bytes())
    content[start : start + count] = bytes(count)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"damaged\.tif"):
        find_strip(open_video(path))


@pytest.mark.parametrize("rows", [slice(5, 19), slice(62, 76), None])
def test_rows_with_the_time_of_day_are_left_out(rows):
    """Failure: letters that a camera wrote over the picture are taken for sheets and shift those below them.

    Or rows are left out where nothing is written. With the setting out of reach the letters stay in."""
    x, noise = np.arange(1280), np.random.default_rng(1)
    ridges = 40 + 110 * np.exp(-((((x - 150) % 20) - 10) ** 2) / 23) * (abs(x - 650) < 500)
    frames = (ridges + noise.normal(0, 3, (6, 80, 1280))).clip(0, 255).astype(np.uint8)
    if rows is not None:
        for frame in frames:
            cv2.putText(
                frame, "2024-05-12 14:30:05", (8, rows.stop - 1), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 255, 2
            )
    found = find_strip(Scene(frames)).rows
    if rows is None:
        assert found == slice(0, 80)
        return
    assert found.stop <= rows.start or found.start >= rows.stop
    assert found.stop - found.start >= 56
    kept = find_strip(Scene(frames), settings=VideoSettings(label_power=1e9)).rows
    assert kept.start < rows.stop
    assert kept.stop > rows.start


@pytest.mark.parametrize("boxed", [False, True])
@pytest.mark.parametrize("place", [slice(2, 20), slice(41, 59), None])
def test_text_that_is_clearer_than_the_ridges_and_as_wide_as_the_picture_is_left_out(place, boxed):
    """Failure: the rows of a counter, which is far steeper than the sheets, are taken for the strip."""
    x, noise = np.arange(640), np.random.default_rng(2)
    frames = np.empty((8, 60, 640), np.uint8)
    for t, frame in enumerate(frames):
        rows = np.broadcast_to(60 + 50 * np.exp(-((((x - 0.3 * t) % 24) - 12) ** 2) / 23), (60, 640))
        frame[:] = (rows + noise.normal(0, 3, rows.shape)).clip(0, 255)
        if place is not None:
            if boxed:
                frame[place] = 5
            text, where = f"2024-05-12 14:30:05.{t:03d} CAM2", (4, place.stop - 2)
            cv2.putText(frame, text, where, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 250, 2)
    strip = find_strip(Scene(frames))
    if place is None:
        assert (strip.rows, strip.warnings) == (slice(0, 60), ())
        return
    assert strip.rows.stop <= place.start or strip.rows.start >= place.stop
    assert strip.rows.stop - strip.rows.start >= 34
    assert not strip.warnings
    kept = find_strip(Scene(frames), settings=VideoSettings(label_power=1e9)).rows
    assert kept.start < place.stop
    assert kept.stop > place.start
    given = measure_strip(Scene(frames), slice(0, 60))
    assert sum("text or marks" in warning for warning in given.warnings) == 1
    clear = measure_strip(Scene(frames), strip.rows)
    assert clear.warnings == ()


@pytest.mark.parametrize("text", ["12:30", "1 mm"])
@pytest.mark.parametrize("width", [220, 360])
def test_a_short_text_in_a_narrow_picture_is_left_out(width, text):
    """Failure: a few letters, which are in one segment of few, shift the sheets below them."""
    x, noise = np.arange(width), np.random.default_rng(4)
    frames = np.empty((8, 120, width), np.uint8)
    for t, frame in enumerate(frames):
        ridges = 40 + 50 * np.exp(-((((x - 0.3 * t) % 24) - 12) ** 2) / 23)
        frame[:] = (ridges + noise.normal(0, 3, frame.shape)).clip(0, 255)
        cv2.putText(frame, text, (4, 48), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 250, 2)
    assert find_strip(Scene(frames)).rows.start > 48
    assert find_strip(Scene(frames), settings=VideoSettings(few_segments=0)).rows.start < 40


def test_the_few_rows_beside_text_over_most_of_the_picture_are_the_strip():
    """Failure: letters over seven tenths of the rows stay in the strip and shift the sheets below them."""
    x, noise = np.arange(700), np.random.default_rng(3)
    ridges = 60 + 25 * np.exp(-((((x - 3) % 24) - 12) ** 2) / 23)
    letters = np.zeros((200, 700), np.uint8)
    for line in range(11):
        cv2.putText(letters, "2024-05-12 14:30:05", (20, 12 + 13 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.42, 255)
    frames = np.where(letters > 100, 230, ridges + noise.normal(0, 3, (8, 200, 700))).clip(0, 255)
    strip = find_strip(Scene(frames.astype(np.uint8)))
    assert strip.rows.start >= np.flatnonzero(letters.any(axis=1))[-1]
    assert strip.rows.stop - strip.rows.start >= 40
    assert strip.warnings == ()


@pytest.mark.parametrize("first", [0, 60])
def test_a_ruler_is_no_comb(first):
    """Failure: the ticks of a ruler below or above the comb, clearer than its ridges, are tracked for it.

    With the setting out of reach they are, and so is a comb that stands still, unless the ruler is lower."""
    x, noise = np.arange(1280), np.random.default_rng(1)
    frames = np.empty((8, 140, 1280), np.uint8)
    comb, ruler = (slice(0, 60), slice(80, 140)) if first == 0 else (slice(60, 140), slice(0, 50))
    for t, frame in enumerate(frames):
        rows = np.full((140, 1280), 180.0)
        rows[comb] = 40 + 110 * np.exp(-((((x - 0.5 * t) % 20) - 10) ** 2) / 23) * (abs(x - 640) < 500)
        rows[ruler, x % 12 < 3] = 20
        frame[:] = (rows + noise.normal(0, 3, rows.shape)).clip(0, 255)
    within = find_strip(Scene(frames)).rows
    assert comb.start - 2 <= within.start < within.stop <= comb.stop + 2
    assert within.stop - within.start > 40
    unmoved = find_strip(Scene(frames), settings=VideoSettings(moving_change=2.0))
    for still in (unmoved, find_strip(Scene(frames[:1]))):
        taken = ruler if first == 0 else comb
        assert still.rows.start >= taken.start - 2
        assert still.rows.stop <= taken.stop + 2


@pytest.mark.parametrize("noise", [1.0, 8.0])
def test_level_ridges(noise):
    """Failure: sheets that move along y are measured as if they stood upright, and nothing is said; or ridges
    that stand upright, with a clamp and a label, are said to lie level."""
    upright = scene(noise=noise)
    level = Scene(upright.pixels.transpose(0, 2, 1), rotate=90)
    assert find_strip(upright).warnings == ()
    assert "give `rotate` 0" in find_strip(level).warnings[-1]
    quiet = VideoSettings(max_level=1e9)
    assert not any("rotate" in warning for warning in find_strip(level, settings=quiet).warnings)


@pytest.mark.thorough
@pytest.mark.parametrize("height", [120, 480])
@pytest.mark.parametrize("first", range(40, 50))
def test_a_comb_between_dark_margins_is_not_said_to_lie_level(first, height):
    """Failure: the edges between a clear comb and what is above and below it count as horizontal ridges."""
    scale = height // 120
    ridges = 100 + 20 * np.exp(-((np.arange(1200) % 20 - 10.0) ** 2) / 2 / 3**2)
    frames = np.random.default_rng(1).normal(10, 1, (6, height, 1200))
    frames[:, scale * first : scale * (first + 30)] += ridges
    found = find_strip(Scene(frames.clip(0, 255).astype(np.uint8)))
    assert found.how == "found"
    assert found.warnings == ()


@pytest.mark.parametrize("kind", ["wide", "dead rows"])
def test_upright_ridges_are_not_said_to_lie_level(kind):
    """Failure: sheets so wide that their texture is steeper than they are, or rows of a sensor that do not
    work, are said to lie level."""
    rng, x = np.random.default_rng(1), np.arange(1280)
    pitch, fwhm = (300, 100) if kind == "wide" else (20, 8)
    ridges = 40 + 110 * np.exp(-((((x - 640) % pitch) - pitch / 2) ** 2) / 2 / (fwhm / 2.355) ** 2)
    texture = np.repeat(rng.normal(0, 6 if kind == "wide" else 1, (80, 80)), 16, axis=1)
    frames = ridges + texture + rng.normal(0, 0.5, (6, 80, 1280))
    if kind == "dead rows":
        frames[:, [10, 23, 24, 37, 60]] = 0
    found = find_strip(Scene(frames.clip(0, 255).astype(np.uint8)))
    assert not any("rotate" in told for told in found.warnings)


@pytest.mark.skipif(not DATA.exists(), reason="real recordings are not here")
@pytest.mark.parametrize("name", ["striped_beam.cine", "two_bands.cih", "sarcomeres.avi"])
def test_real_recordings_that_move_along_y(name):
    """Failure: the first run of a film that has to be turned does not say so."""
    assert "give `rotate` 90" in find_strip(open_video(DATA / name)).warnings[-1]
    assert not any("rotate" in told for told in find_strip(open_video(DATA / name, rotate=90)).warnings)
