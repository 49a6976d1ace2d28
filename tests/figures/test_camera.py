"""Space-time diagrams and figures of the video: numbers against what they are made from."""

import itertools

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure as Page

from tests.figures.conftest import JUMP_PX, by_label
from tests.scenes.report_data import make_profile, make_tracks, sawtooth
from vision import spacetime
from vision.figures import (
    camera,
    frame_figure,
    kymograph_figure,
    noise_figure,
    pixel_locking_figure,
    space_time_figure,
    tracks_figure,
)
from vision.figures.camera import SlipTimes
from vision.figures.catalogue import overview
from vision.figures.drawing import MOST_LINES, new_figure
from vision.figures.positions import MOST_POINTS
from vision.figures.style import MISSING, ON_GREY
from vision.spacetime import grey_levels, grey_limits


def draw_kymograph(ax, diagram, *, slips_s=None):
    return kymograph_figure([diagram], slips=SlipTimes(slips_s)).plot(ax)


def diagram_of(frames=60, columns=20, *, times=None, **attrs):
    values = np.arange(frames)[:, None] + np.linspace(0, 1, columns)
    return xr.DataArray(
        values.astype(np.float32),
        dims=("frame", "x"),
        coords={
            "frame": np.arange(frames),
            "x": np.arange(200, 200 + columns),
            "time_s": ("frame", np.arange(frames) / 20 if times is None else times),
        },
        attrs={"clock_kind": "given"} | attrs,
    )


WINDOW = {"sheet": "right:23", "sheet_index": 47, "centre_px": 209.5, "follow": 0}


@pytest.fixture
def ax():
    return Page().subplots()


def shown(ax, time):
    """The colour drawn at this time in the middle of the picture, 0 to 255."""
    canvas = FigureCanvasAgg(ax.figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
    column, row = ax.transData.transform((np.mean(ax.get_xlim()), time)).astype(int)
    return pixels[len(pixels) - 1 - row, column]


def grey_of(value, diagram):
    """The grey in which a value is drawn."""
    low, high = grey_limits(diagram.values)
    return np.full(3, 255 * np.clip((value - low) / (high - low), 0, 1))


def test_axes_are_in_mm_and_s_with_pixels_centred(ax):
    """A failure means that lengths or times read off the picture are wrong, or half a pixel off."""
    diagram = diagram_of(pixel_size_um=80.0)
    draw_kymograph(ax, diagram)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (mm)", "t (s)")
    np.testing.assert_allclose(ax.get_xlim(), (15.96, 17.56))
    np.testing.assert_allclose(ax.get_ylim(), (2.975, -0.025))  # time downwards
    np.testing.assert_allclose(shown(ax, 1.5), grey_of(30.5, diagram), atol=2)
    assert np.abs(shown(ax, 1.5) - grey_of(29.5, diagram)).min() > 3  # a row off would be seen


def test_a_strip_below_a_millimetre_is_in_µm(ax):
    """A failure means an axis of zeros and thousandths."""
    draw_kymograph(ax, diagram_of(pixel_size_um=0.1))
    assert ax.get_xlabel() == "x (µm)"
    np.testing.assert_allclose(ax.get_xlim(), (19.95, 21.95))


@pytest.mark.parametrize(
    ("attrs", "label", "limits"),
    [
        ({}, "x − x₀ (px)", (-10, 10)),
        ({"pixel_size_um": 8.0}, "x − x₀ (µm)", (-80, 80)),
        ({"follow": 1}, "x − x(n,t) (px)", (199.5, 219.5)),
    ],
)
def test_a_window_counts_from_its_sheet(ax, attrs, label, limits):
    """A failure means that the zero or the unit of a panel is not what its label says."""
    draw_kymograph(ax, diagram_of(**WINDOW | attrs))
    assert ax.get_xlabel() == label
    np.testing.assert_allclose(ax.get_xlim(), limits)
    (title, *_) = new_figure(kymograph_figure([diagram_of(**WINDOW | attrs)])).texts
    assert "right, n = 23" in title.get_text()


def test_a_playback_rate_or_no_clock_is_said_on_the_axis(ax):
    """A failure means that a container's rate passes for the camera's."""
    draw_kymograph(ax, diagram_of(clock_kind="playback"))
    assert "playback" in ax.get_ylabel()
    draw_kymograph(ax, diagram_of(times=np.full(60, np.nan)), slips_s=np.array([1.0]))
    assert ax.get_ylabel() == "frame"
    assert not ax.collections  # no slips where there are no seconds


def test_slips_stand_at_their_times_and_only_those_in_view(ax):
    """A failure means marks at the wrong place."""
    draw_kymograph(ax, diagram_of(), slips_s=np.array([-1.0, 0.73, 2.11, 9.0]))
    lines = np.array([segment[:, 1] for segment in ax.collections[0].get_segments()])
    np.testing.assert_allclose(lines, [[0.73, 0.73], [2.11, 2.11]])
    for marks in ax.lines:
        np.testing.assert_allclose(marks.get_ydata(), [0.73, 2.11])


def test_many_slips_do_not_cover_the_picture(ax):
    """A failure means a picture of a whole test hidden behind lines."""
    slips = np.linspace(0, 2.9, MOST_LINES + 1)
    draw_kymograph(ax, diagram_of(), slips_s=slips)
    assert not ax.collections
    assert len(ax.lines[0].get_ydata()) == slips.size


def test_a_gap_in_time_stays_empty(ax):
    """A failure means that rows are stretched over time in which nothing was seen."""
    times = np.arange(60) / 20
    times[30:] += 1.0
    diagram = diagram_of(times=times)
    draw_kymograph(ax, diagram)
    np.testing.assert_allclose(shown(ax, 1.45), grey_of(29.5, diagram), atol=2)
    np.testing.assert_allclose(shown(ax, 2.0), 255 * np.array(to_rgb(MISSING)), atol=1)
    np.testing.assert_allclose(shown(ax, 2.5), grey_of(30.5, diagram), atol=2)


def test_long_recordings_are_averaged_not_thinned(monkeypatch):
    """A failure means that most rows of a long recording are not in the picture at all."""
    monkeypatch.setattr(camera, "MOST_ROWS", 20)
    monkeypatch.setattr(spacetime, "_ROWS_AT_ONCE", 3)
    diagram = diagram_of(60)
    diagram[9:12] = np.nan
    image = kymograph_figure([diagram]).panel.image
    assert image.pixels.shape[0] == 20
    low, high = grey_limits(diagram.values)
    means = image.pixels[:, 0] / 255 * (high - low) + low
    np.testing.assert_allclose(means[[0, 1, 2, 18]], [1, 4, 7, 55], atol=0.2)
    assert image.missing[3].all()
    assert image.missing.sum() == image.pixels.shape[1]


def test_the_picture_says_what_its_marks_are(tmp_path):
    """A failure means marks of unknown origin, or a note on marks that are not there."""
    path, slips = tmp_path / "k.svg", np.array([1.0])
    kymograph_figure([diagram_of(**WINDOW)], slips=SlipTimes(slips, "the sheets")).save(path)
    assert "arrowheads: slips, from the sheets" in path.read_text()
    kymograph_figure([diagram_of(**WINDOW)], slips=SlipTimes(slips[:0])).save(path)
    assert "arrowheads" not in path.read_text()


@pytest.mark.thorough
@pytest.mark.parametrize("panels", [1, 2, 5, 12])
@pytest.mark.parametrize("frames", [1, 2, 60, 3000])
def test_any_number_of_panels_fits(panels, frames):
    """A failure means panels that overlap, or are crushed to nothing."""
    page = (
        kymograph_figure([diagram_of(frames, **WINDOW)] * panels, slips=SlipTimes(np.array([1.0])))
        .plot()
        .figure
    )
    FigureCanvasAgg(page).draw()
    boxes = [ax.get_tightbbox() for ax in page.axes]
    assert all(a.x1 <= b.x0 + 1 for a, b in itertools.pairwise(boxes))
    assert min(ax.get_window_extent().width for ax in page.axes) > 1.5 * page.dpi
    assert all(
        box.x0 >= 0 and box.x1 <= page.bbox.x1 and box.y0 >= 0 and box.y1 <= page.bbox.y1 for box in boxes
    )
    labels = [text.get_window_extent() for ax in page.axes for text in ax.get_xticklabels()]
    assert all(a.x1 <= b.x0 for a, b in itertools.pairwise(labels) if a.y0 == b.y0 and a.x0 < b.x0)


@pytest.mark.parametrize("panels", [1, 3])
def test_the_note_below_a_narrow_window_is_whole(panels):
    """A failure means that the note on grey levels begins outside the picture."""
    window = diagram_of(columns=20, **WINDOW)
    page = kymograph_figure([window] * panels, slips=SlipTimes(np.array([1.0]))).plot().figure
    FigureCanvasAgg(page).draw()
    (note,) = (text for text in page.texts if "black to white" in text.get_text())
    assert "interpolated along x" in note.get_text().replace("\n", " ")
    box = note.get_window_extent()
    assert box.x0 >= 0 and box.y0 >= 0 and box.y1 < page.axes[0].xaxis.label.get_window_extent().y0


def test_panels_share_one_grey_scale():
    """A failure means that brightness cannot be compared between panels."""
    low, high = grey_limits(diagram_of().values, diagram_of().values * 2)
    assert low < 2
    assert high > 100
    assert grey_limits(diagram_of().values * np.nan) == (0, 1)
    one, two = kymograph_figure([diagram_of(), diagram_of() * 2]).panels
    assert int(two.image.pixels[20, 0]) == pytest.approx(2 * int(one.image.pixels[20, 0]), abs=3)


def test_displacements_are_in_the_unit_of_the_label(tracks):
    """A failure means that lengths in the report are off by the pixel size."""
    px, um = (tracks_figure(tracks, pixel_size_um=size) for size in (None, 10.0))
    outer_px, outer_um = by_label(px)["right 5"].y, by_label(um)["right 5"].y
    assert "(px)" in px.panel.y_label
    assert "(µm)" in um.panel.y_label
    assert np.ptp(outer_px) == pytest.approx(JUMP_PX, abs=0.1)
    np.testing.assert_allclose(outer_um, 10 * outer_px)


def test_the_space_time_tracks_are_where_the_ridges_are(tracks):
    """A failure means that tracks are drawn beside their ridges."""
    figure = space_time_figure(make_profile(tracks, 220), tracks, pixel_size_um=10.0)
    np.testing.assert_allclose(by_label(figure)["left 1"].y, tracks["x_px"].values[:, 4] * 0.01)
    assert (figure.panel.image.left, figure.panel.image.right) == pytest.approx((-0.005, 2.195))
    assert figure.panel.image.top == pytest.approx(-0.5 / 60)


def test_long_tests_keep_every_slip_on_the_page():
    """A failure means that slips vanish from x(n,t) of a long test."""
    figure = tracks_figure(make_tracks(sawtooth(100_000, 6, period=4000)))
    outer = by_label(figure)["right 3"].y
    assert len(outer) <= MOST_POINTS
    assert (np.diff(outer) > JUMP_PX / 2).sum() == 24
    assert f"{len(outer) // 2} intervals of the 100000 frames" in figure.caption
    assert "tracks.csv holds every frame" in figure.caption


def test_the_frame_numbers_its_sheets(tracks):
    """A failure means that sheets have another number in the image than in the tables."""
    figure = frame_figure(np.arange(220 * 200).reshape(200, 220) % 255, tracks)
    left, right = figure.panel.series
    assert left.text == ("5", "4", "3", "2", "1")
    assert (left.ink, right.ink) == (ON_GREY[-1], ON_GREY[1])
    assert right.text == ("1", "2", "3", "4", "5")
    np.testing.assert_allclose(right.x, tracks["x_px"].values[0, 5:])
    assert (figure.panel.bands[0].low, figure.panel.bands[0].high) == (59.5, 143.5)


def test_an_axis_that_the_motion_does_not_show_is_called_so(tracks):
    """A failure means a dashed line in the middle of the picture that is taken for a measured axis."""
    for low_px, said in ((np.nan, True), (90.0, False)):
        known = tracks.assign_attrs(axis_how="geometry", axis_low_px=low_px, axis_high_px=low_px + 20)
        figure = frame_figure(np.zeros((200, 220)), known)
        for text in (figure.panel.title, figure.caption):
            assert ("(dashed; the motion does not show it)" in text) == said
            assert ("axis (dashed)" in text) != said


def test_locked_positions_show_in_the_locking_check():
    """A failure means that the report cannot tell a fit that locks to whole pixels."""
    rng = np.random.default_rng(0)
    true = rng.uniform(0, 20, 12) + np.linspace(0, 2.3, 2000)[:, None] + np.arange(12) * 20
    even = pixel_locking_figure(make_tracks(true))
    locked = pixel_locking_figure(make_tracks(true - 0.05 * np.sin(2 * np.pi * true)))

    def errors_off(figure):
        band = figure.panel.bands[0]
        return (by_label(figure)["positions"].y - 1) / ((band.high - 1) / 2)

    assert np.abs(errors_off(even)).max() < 3
    assert errors_off(locked)[[0, -1]].min() > 4
    assert errors_off(locked)[9:11].max() < -3


def test_still_sheets_are_no_sign_of_locking():
    """A failure means that sheets that happen to stand at the same phase are called locked."""
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(0, 400, 10)) + rng.normal(0, 0.01, (5000, 10))
    figure = pixel_locking_figure(make_tracks(x))
    density, band = by_label(figure)["positions"].y, figure.panel.bands[0]
    assert density.min() == 0
    assert band.low == 0
    assert (density < 1 + 1.5 * (band.high - 1)).all()


def test_the_noise_of_each_sheet_is_that_of_the_tables(tracks):
    """A failure means that noise is shown for the wrong sheet or in the wrong unit."""
    tracks = tracks.assign(x_noise_px=("sheet", np.arange(10) / 100))
    figure = noise_figure(tracks, pixel_size_um=10.0)
    measured = by_label(figure)["from frame to frame"]
    assert measured.x.tolist() == [-5, -4, -3, -2, -1, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(measured.y, np.arange(10) / 10)


def test_a_recording_without_clock_counts_frames(tracks):
    """A failure means that a report claims seconds that nobody measured."""
    unknown = tracks.assign_coords(time_s=("frame", np.full(1000, np.nan)))
    figure = tracks_figure(unknown)
    assert figure.panel.x_label == "frame"
    assert figure.panel.series[0].x[-1] == 999
    playback = tracks.assign_attrs(clock_kind="playback")
    assert "playback" in tracks_figure(playback).panel.x_label


def test_the_outline_encloses_the_columns_of_the_strip(tracks):
    """A failure means that a picture shows as evaluated what `--columns` left out."""
    frame, strip = np.zeros((60, 220)), diagram_of(frames=2, columns=15)
    (band,) = frame_figure(frame, tracks, strip=strip).panel.bands
    assert band.across == (199.5, 214.5)
    (outline,) = frame_figure(frame, tracks, strip=strip).plot().patches
    assert (outline.get_x(), outline.get_width()) == (199.5, 15.0)
    (whole,) = frame_figure(frame, tracks).plot().patches
    assert (whole.get_x(), whole.get_width()) == (-0.5, 220.0)


@pytest.mark.parametrize(("rows", "square"), [(4, False), (200, True), (900, False)])
def test_a_frame_keeps_its_shape_unless_nothing_could_be_seen(tracks, rows, square):
    """A failure means a frame that is stretched without a word, or one too flat or too narrow to see."""
    figure = frame_figure(np.zeros((rows, 220)), tracks.assign_attrs(strip_z0=0, strip_z1=rows))
    assert figure.panel.square_pixels == square
    assert all(
        (("x" if rows > 220 else "z") + " stretched" in text) != square
        for text in (figure.panel.title, figure.caption)
    )
    ax = figure.plot()
    ax.figure.draw_without_rendering()
    if square:
        a, b = ax.transData.transform([(0, 0), (100, 100)])
        assert abs(b - a) == pytest.approx(abs(b - a)[0], rel=1e-6)


@pytest.mark.parametrize(("first_row", "numbers_z"), [(0, -0.5), (4, -0.5), (100, 99.5)])
def test_numbers_never_cover_the_edge_of_the_picture(tracks, first_row, numbers_z):
    """A failure means that numbers hide the rows between the picture's edge and the strip."""
    figure = frame_figure(np.zeros((200, 220)), tracks.assign_attrs(strip_z0=first_row, strip_z1=200))
    assert {series.text_y for series in figure.panel.series} == {numbers_z}
    ax = figure.plot()
    ax.figure.draw_without_rendering()
    edge = ax.transData.transform((0, -0.5))[1]
    boxes = [text.get_window_extent() for text in ax.texts]
    assert boxes
    assert all(box.y0 >= edge or box.y1 <= edge for box in boxes)
    assert all(box.y1 <= ax.get_window_extent().y1 for box in boxes)


def test_indices_are_numbered_from_0(tracks):
    """A failure means that every second index is shown from 1 on, so that the first sheet has no number."""
    crowded = make_tracks(sawtooth(10, 50, pitch_px=8.0), pitch_px=8.0)
    crowded = crowded.assign_attrs(strip_z0=0, strip_z1=30)
    ax = frame_figure(np.zeros((30, 400)), crowded, axis=False).plot()
    shown = sorted(int(text.get_text()) for text in ax.texts)
    assert shown[0] == 0
    assert len(set(np.diff(shown[:-1]))) == 1
    assert shown[-1] == crowded.sizes["sheet"] - 1  # the outermost has its number, too
    assert shown[1] > 1


def test_a_window_is_interpolated_between_its_pixels():
    """A failure means that a window of 20 px shows squares, which hide motion of half a pixel; or that the
    picture is another than that of the pixels."""
    x = np.arange(200, 220)
    at = 209.5 + np.linspace(-1, 1, 60)[:, None]
    values = 100 * np.exp(-((x - at) ** 2) / 18)
    values[30] = np.nan
    diagram = diagram_of(columns=20, **WINDOW).copy(data=values.astype(np.float32))
    image = kymograph_figure([diagram]).panel.image
    assert image.pixels.shape == (60, 240)
    assert (image.left, image.right) == (-10.0, 10.0)
    assert image.missing[30].all() and image.missing.sum() == 240
    fine = 199.5 + (np.arange(240) + 0.5) / 12
    expected = grey_levels(100 * np.exp(-((fine - at) ** 2) / 18), image.black, image.white)
    inside = (fine > 200) & (fine < 219)
    difference = np.abs(image.pixels.astype(int) - expected)[:, inside][np.arange(60) != 30]
    assert difference.max() <= 3
    assert image.scale.endswith(", interpolated along x")
    whole = kymograph_figure([diagram_of(columns=20)])
    assert whole.panel.image.pixels.shape == (60, 20)
    assert "interpolated" not in whole.panel.image.scale
    assert "Interpolated" not in whole.caption


@pytest.mark.parametrize("pitch", [20.0, 8.0])
def test_the_numbers_of_sheets_stand_beside_the_axis(pitch):
    """A failure means "1|" where the axis crosses a number, or a side without its first number."""
    tracks = make_tracks(sawtooth(10, 50, pitch_px=pitch), pitch_px=pitch)
    tracks = tracks.assign_attrs(strip_z0=0, strip_z1=30)
    ax = frame_figure(np.zeros((30, int(50 * pitch))), tracks).plot()
    ax.figure.draw_without_rendering()
    axis = ax.transData.transform((tracks.attrs["axis_px"], 0))[0]
    boxes = [(text.get_text(), text.get_window_extent()) for text in ax.texts]
    assert all(box.x1 < axis or axis < box.x0 for _, box in boxes)
    assert [box.x1 < axis for text, box in boxes if text == "1"] == [True, False]
    np.testing.assert_array_equal(ax.get_yticks(), [0, 29])  # both ends of a flat frame


def test_the_outermost_sheets_and_one_on_the_axis_have_their_numbers():
    """A failure means that the reader has to count the last sheets, or misses that of an odd number."""
    tracks = make_tracks(sawtooth(10, 31, pitch_px=20.0), pitch_px=20.0)
    middle = float(tracks["x_px"].values[0, 15])
    side, n = np.repeat([-1, 1], [15, 16]), np.r_[15:0:-1, 1:17]
    for beside in (-0.1, 0.1):
        there = tracks.assign_attrs(strip_z0=0, strip_z1=30, axis_px=middle + beside)
        there = there.assign_coords(side=("sheet", side), n=("sheet", n))
        ax = frame_figure(np.zeros((30, 660)), there).plot()
        shown = sorted(int(text.get_text()) for text in ax.texts)
        assert shown.count(1) == 2
        assert shown[-2:] == [15, 16]


def test_one_definition_of_displacement(tracks):
    """A failure means that overview.png and the report subtract different things."""
    x = tracks["x_px"].values.copy()
    x[0, 3] += 500  # which moves a mean, not a median
    tracks = make_tracks(x)
    strip = make_profile(tracks, 220)
    figures = [space_time_figure(strip, tracks), tracks_figure(tracks)]
    assert overview(figures).panels[-1].series is figures[1].panel.series
    np.testing.assert_allclose(figures[1].panel.series[3].y, x[:, 3] - np.median(x[:20, 3]))
