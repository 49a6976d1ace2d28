"""overview.png, whatever the recording."""

import itertools

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from vision.report.axes import position_unit, time_axis
from vision.report.kymograph import draw_kymograph
from vision.report.overview import draw_displacements, draw_frame, write_overview


def scene(*, sheets=7, frames=40, rows=60, columns=400, times_s=None, nothing_found=False):
    """A frame, its strip I(x, t) and its tracks: a comb that opens and closes."""
    n = np.arange(sheets) - (sheets - 1) / 2
    t = np.arange(frames)
    x_px = columns / 2 + n * (columns - 20) / sheets + 2 * np.sin(t / 5)[:, None] * n / max(1, n.max())
    if nothing_found:
        x_px[:] = np.nan
    ridges = np.exp(-((np.arange(columns) - np.nan_to_num(x_px)[:, :, None]) ** 2) / 8).sum(axis=1)
    profile = np.asarray(50 + 100 * ridges, np.float32)
    clock = {"time_s": ("frame", t / 25 if times_s is None else times_s), "frame": t}
    attrs = {"strip_z0": rows // 3, "strip_z1": rows // 2, "clock_kind": "given", "axis_px": columns / 2}
    strip = xr.DataArray(profile, dims=("frame", "x"), coords=clock | {"x": np.arange(columns)}, attrs=attrs)
    who = {
        "sheet": np.arange(sheets),
        "side": ("sheet", np.where(n < 0, -1, 1)),
        "n": ("sheet", np.abs(np.floor(np.where(n < 0, n, n + 1))).astype(int)),
    }
    tracks = xr.Dataset({"x_px": (("frame", "sheet"), x_px)}, coords=clock | who, attrs=attrs)
    return np.broadcast_to(profile[:1], (rows, columns)).astype(np.uint8), strip, tracks


@pytest.mark.parametrize(
    "options",
    [
        {"sheets": 1},
        {"sheets": 200, "columns": 1920, "frames": 5},
        {"frames": 1},
        {"frames": 2, "columns": 12, "sheets": 2},
        {"frames": 9000, "sheets": 2},
        {"rows": 4},
        {"rows": 1200},
        {"times_s": np.full(40, np.nan)},
        {"times_s": np.r_[np.arange(20.0), np.arange(20.0)]},
        {"nothing_found": True},
    ],
)
def test_any_recording_has_a_picture(options, tmp_path):
    """A failure means that a run's tables are lost because its picture cannot be drawn."""
    frame, strip, tracks = scene(**options)
    write_overview(tmp_path / "overview.png", frame, strip, tracks, pixel_size_um=10.0)
    assert (tmp_path / "overview.png").stat().st_size > 10_000


def test_blank_frames_do_not_spoil_the_greys(tmp_path):
    """A failure means a black picture, or none, where every row that is drawn is missing."""
    frame, strip, tracks = scene()
    strip[:] = np.nan
    write_overview(tmp_path / "overview.png", frame, strip, tracks, pixel_size_um=None)


@pytest.mark.parametrize("sheets", [7, 50, 200])
def test_no_two_sheet_numbers_overlap(sheets):
    """A failure means that the numbers 1 and 1 at the centre read as 11."""
    frame, strip, tracks = scene(sheets=sheets, columns=1920, frames=3)
    figure = Figure(figsize=(13, 3), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    ax = draw_frame(figure.subplots(), frame, strip, tracks)
    canvas.draw()
    boxes = sorted((label.get_window_extent() for label in ax.texts), key=lambda box: box.x0)
    assert len(boxes) >= min(sheets, 20)
    assert all(a.x1 <= b.x0 for a, b in itertools.pairwise(boxes))


def test_tracks_lie_on_their_ridges_also_after_a_gap():
    """A failure means that after lost frames, or in mm, the tracks lie beside the ridges they belong to."""
    times_s = np.arange(40) / 25
    times_s[20:] += 2.0
    _, strip, tracks = scene(times_s=times_s)
    ax = draw_kymograph(Figure().subplots(), strip.assign_attrs(pixel_size_um=10.0), tracks=tracks)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (mm)", "t (s)")
    np.testing.assert_allclose([line.get_xdata() for line in ax.lines], tracks["x_px"].values.T / 100)
    assert all(np.array_equal(line.get_ydata(), times_s) for line in ax.lines)


def test_the_legend_hides_no_line():
    """A failure means that the highest peaks disappear behind the legend."""
    _, _, tracks = scene()
    figure = Figure(figsize=(13, 5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    ax = draw_displacements(figure.subplots(), tracks, pixel_size_um=None)
    canvas.draw()
    assert ax.get_legend().get_window_extent().y0 >= ax.get_window_extent().y1
    assert next(text.get_text() for text in ax.get_legend().get_texts()) == "left, n = 1 (dark) to 3 (bright)"


def test_a_single_frame_is_seen_as_dots():
    """A failure means that the positions of a single picture are drawn as nothing."""
    _, strip, tracks = scene(frames=1)
    ax = draw_kymograph(Figure().subplots(), strip, tracks=tracks)
    assert all(line.get_marker() == "o" for line in ax.lines)


def test_a_clock_that_runs_backwards_is_not_an_axis():
    """A failure means that tracks fold over each other."""
    _, strip, _ = scene(times_s=np.r_[np.arange(20.0), np.arange(20.0)])
    time, label = time_axis(strip)
    assert (label, time[-1]) == ("frame", 39)


def test_one_repeated_time_does_not_cost_the_clock():
    """A failure means that a single stamp written twice turns seconds into frame numbers."""
    times_s = np.arange(40) / 25
    times_s[11] = times_s[10]
    _, strip, tracks = scene(times_s=times_s)
    assert time_axis(strip)[1] == "t (s)"
    assert time_axis(scene(times_s=np.zeros(40))[1])[1] == "frame"
    ax = draw_kymograph(Figure().subplots(), strip, tracks=tracks)
    FigureCanvasAgg(ax.figure).draw()


@pytest.mark.parametrize(
    ("size", "expected"), [(None, (1.0, "px")), (0.5, (0.5, "µm")), (10.0, (0.01, "mm"))]
)
def test_positions_are_in_the_unit_that_suits_the_picture(size, expected):
    """A failure means lengths that are off by a thousand, or an axis of zeros."""
    assert position_unit(size, 400) == expected
