"""Space-time diagrams with axes: what stands where."""

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from vision.report.kymograph import (
    EMPTY_COLOUR,
    MOST_LINES,
    draw_kymograph,
    grey_limits,
    write_kymograph_picture,
)

from vision.report import decimate, kymograph


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
    return Figure().subplots()


def shown(ax, time):
    """The colour drawn at this time in the middle of the picture, 0 to 255."""
    canvas = FigureCanvasAgg(ax.figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
    column, row = ax.transData.transform((np.mean(ax.get_xlim()), time)).astype(int)
    return pixels[len(pixels) - 1 - row, column]


def grey_of(value, ax):
    """The grey in which a value is drawn."""
    low, high = ax.images[0].get_clim()
    return np.full(3, 255 * np.clip((value - low) / (high - low), 0, 1))


def test_axes_are_in_mm_and_s_with_pixels_centred(ax):
    """A failure means that lengths or times read off the picture are wrong, or half a pixel off."""
    draw_kymograph(ax, diagram_of(pixel_size_um=80.0))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (mm)", "t (s)")
    np.testing.assert_allclose(ax.get_xlim(), (15.96, 17.56))
    np.testing.assert_allclose(ax.get_ylim(), (2.975, -0.025))  # time downwards
    np.testing.assert_allclose(shown(ax, 1.5), grey_of(30.5, ax), atol=2)
    assert np.abs(shown(ax, 1.5) - grey_of(29.5, ax)).min() > 3  # a row off would be seen


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
    assert "right, n = 23" in ax.get_title(loc="left")


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
    draw_kymograph(ax, diagram_of(times=times))
    np.testing.assert_allclose(shown(ax, 1.45), grey_of(29.5, ax), atol=2)
    np.testing.assert_allclose(shown(ax, 2.0), 255 * np.array(to_rgb(EMPTY_COLOUR)), atol=1)
    np.testing.assert_allclose(shown(ax, 2.5), grey_of(30.5, ax), atol=2)


def test_long_recordings_are_averaged_not_thinned(ax, monkeypatch):
    """A failure means that most rows of a long recording are not in the picture at all."""
    monkeypatch.setattr(kymograph, "MOST_ROWS", 20)
    monkeypatch.setattr(decimate, "_ROWS_AT_ONCE", 3)
    diagram = diagram_of(59)
    diagram[4] = np.nan
    diagram[9:12] = np.nan
    draw_kymograph(ax, diagram)
    rows = np.asarray(ax.images[0].get_array()[:, 0].filled(np.nan))
    assert len(rows) == 20
    np.testing.assert_allclose(rows[[0, 1, 2, 18, 19]], [1, 4, 7, 55, 57.5])
    assert np.isnan(rows[3])


def test_the_picture_says_what_its_marks_are(tmp_path):
    """A failure means marks of unknown origin, or a note on marks that are not there."""
    path, slips = tmp_path / "k.svg", np.array([1.0])
    write_kymograph_picture(path, [diagram_of(**WINDOW)], slips_s=slips, slips_from="the sheets")
    assert "orange: slips, from the sheets" in path.read_text()
    write_kymograph_picture(path, [diagram_of(**WINDOW)], slips_s=slips[:0])
    assert "orange" not in path.read_text()


@pytest.mark.parametrize("panels", [1, 2, 5, 12])
def test_any_number_of_panels_fits(tmp_path, panels):
    """A failure means panels crushed to nothing (the layout warns, and warnings are errors here)."""
    for frames in (1, 2, 60, 3000):
        diagrams = [diagram_of(frames, **WINDOW)] * panels
        write_kymograph_picture(tmp_path / "k.png", diagrams, slips_s=np.array([1.0]))


def test_panels_share_one_grey_scale_and_the_file_s_ending_is_its_kind(tmp_path):
    """A failure means that brightness cannot be compared between panels, or an unreadable file."""
    low, high = grey_limits([diagram_of(), diagram_of() * 2])
    assert low < 2
    assert high > 100
    assert grey_limits([diagram_of() * np.nan]) == (0, 1)
    heads = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}
    for kind, head in heads.items():
        path = tmp_path / f"k.{kind}"
        write_kymograph_picture(path, [diagram_of(**WINDOW)] * 2, slips_s=np.array([1.0]))
        assert path.read_bytes().startswith(head)
