"""Space-time diagrams: a comb with known motion, cut as asked; their pictures."""

import numpy as np
import pytest
import xarray as xr
from scipy.special import erf

from vision import space_time
from vision.data import operations_of
from vision.errors import InputError
from vision.spacetime import grey_levels, time_rows

SIGMA_PX = 2.6  # FWHM 6 px, the narrowest ridge in view
FRAMES, SHEETS, PITCH, COLUMNS, ORIGIN = 80, 6, 20.0, 140, 30
TOL_PX = 0.01  # the cubic on the narrowest ridge: 0.003 px


def truth():
    """x (frame, sheet): creep of up to 3 px in 20 frames and a jump back."""
    n = np.arange(SHEETS) - (SHEETS - 1) / 2
    phase = (np.arange(FRAMES) / 20) % 1
    return ORIGIN + 69.3 + n * PITCH - (phase[:, None] - 0.5) * 3.1 * n / n.max()


def strip_of(x, fps=25.0):
    edge = np.arange(COLUMNS + 1) - 0.5 + ORIGIN
    share = erf((edge - x[:, :, None]) / (SIGMA_PX * np.sqrt(2)))
    rows = 40 + 120 * np.diff(share, axis=2).sum(axis=1) / 2 * SIGMA_PX * np.sqrt(2 * np.pi)
    return xr.DataArray(
        rows.astype(np.float32),
        dims=("frame", "x"),
        coords={
            "frame": np.arange(len(x)),
            "x": np.arange(ORIGIN, ORIGIN + COLUMNS),
            "time_s": ("frame", np.arange(len(x)) / fps),
            "status": ("frame", np.full(len(x), "ok")),
        },
        name="intensity",
        attrs={"depth_bits": 8, "source": "comb"},
    )


def tracks_of(x):
    side = np.repeat([-1, 1], SHEETS // 2)
    n = np.array([3, 2, 1, 1, 2, 3])
    both = ("frame", "sheet")
    return xr.Dataset(
        {
            "x_px": (both, x),
            "x_err_px": (both, np.full(x.shape, 0.01)),
            "flag": (both, np.where(np.isfinite(x), "ok", "missing")),
        },
        {
            "frame": np.arange(len(x)),
            "time_s": ("frame", np.arange(len(x)) / 25.0),
            "sheet": np.arange(SHEETS),
            "side": ("sheet", side),
            "n": ("sheet", n),
        },
        {"fit": "sliding"},
    )


@pytest.fixture(scope="module")
def comb():
    x = truth()
    return strip_of(x), tracks_of(x), x


def centre_of_mass(diagram):
    """The ridge's place in every row, in the diagram's own x."""
    above = np.clip(diagram.values - 60, 0, None)
    return (above * diagram["x"].values).sum(axis=1) / above.sum(axis=1)


def test_the_whole_strip_is_the_strip_itself(comb):
    """A failure means that a diagram without a window shows something else than the recording."""
    strip, _, _ = comb
    whole = space_time(strip)
    np.testing.assert_array_equal(whole.values, strip.values)
    np.testing.assert_array_equal(whole["x"], strip["x"])


@pytest.mark.parametrize(("sheet", "index"), [(("right", 3), 5), (("left", 1), 2), (5, 5), (0, 0)])
def test_a_fixed_window_holds_the_recording_s_own_pixels_around_the_right_sheet(comb, sheet, index):
    """A failure means another sheet, shifted columns, or values that were resampled."""
    strip, tracks, x = comb
    window = space_time(strip, around=tracks, sheet=sheet, width_px=16)
    assert window.shape == (FRAMES, 16)
    assert abs(window["x"].values.mean() - np.median(x[:, index])) <= 0.5
    np.testing.assert_array_equal(window.values, strip.sel(x=window["x"]).values)
    # the window cuts the ridge's flanks, which bends its centre of mass a little
    np.testing.assert_allclose(centre_of_mass(window), x[:, index], atol=0.3)
    wrong = (index + 1) % SHEETS
    assert np.abs(centre_of_mass(window) - x[:, wrong]).min() > 10


def test_a_width_in_um_is_turned_with_the_pixel_size(comb):
    """A failure means that 0.2 mm on the page is not 0.2 mm on the sample."""
    strip, tracks, _ = comb
    window = space_time(strip, around=tracks, sheet=("right", 1), width_um=200, pixel_size_um=10)
    assert window.sizes["x"] == 20
    assert window.attrs["pixel_size_um"] == 10
    last = operations_of(window)[-1]
    assert last["operation"] == "space_time" and last["parameters"]["width_um"] == 200
    half = space_time(strip, around=tracks, sheet=("right", 1), width_um=200, pixel_size_um=20)
    assert half.sizes["x"] == 10


def test_a_window_that_follows_keeps_the_sheet_at_zero(comb):
    """A failure means that the moving window lags, locks to whole pixels or loses the sheet.

    A fixed window shows the motion of several px; one moved by whole pixels leaves up to half a pixel.
    """
    strip, tracks, x = comb
    options = {"around": tracks, "sheet": ("right", 3), "width_px": 19}
    assert np.abs(centre_of_mass(space_time(strip, **options, follow=True))).max() < TOL_PX
    fixed = space_time(strip, **options)
    assert np.abs(centre_of_mass(fixed) - x[:, 5].mean()).max() > 1
    whole = tracks.assign(x_px=tracks["x_px"].round())
    locked = space_time(strip, **options | {"around": whole}, follow=True)
    assert np.abs(centre_of_mass(locked)).max() > 10 * TOL_PX


def test_a_following_window_moves_straight_over_frames_without_the_sheet(comb):
    """A failure means that one missing position makes the window jump or leaves a hole."""
    strip, tracks, _ = comb
    gone = tracks.copy(deep=True)
    gone["x_px"][7:10, 5] = np.nan
    window = space_time(strip, around=gone, sheet=("right", 3), width_px=19, follow=True)
    assert np.isnan(window["x_sheet_px"].values[7:10]).all()
    assert np.abs(centre_of_mass(window)).max() < TOL_PX  # the motion is straight there
    assert np.isnan(tracks["x_px"].values).sum() == 0


def test_the_part_asked_for_is_half_open_in_frames_and_seconds(comb):
    """A failure means that the diagram starts or ends a frame off."""
    strip, tracks, _ = comb
    assert space_time(strip, frames=slice(10, 30))["frame"].values.tolist() == list(range(10, 30))
    assert space_time(strip, time_s=(0.4, 1.2))["frame"].values.tolist() == list(range(10, 30))
    assert space_time(strip, time_s=(None, 0.4)).sizes["frame"] == 10
    both = space_time(strip, frames=slice(20, None), time_s=(0.4, 1.2))
    assert both["frame"].values.tolist() == list(range(20, 30))
    window = space_time(strip, around=tracks, sheet=0, width_px=10, frames=slice(10, 30))
    np.testing.assert_array_equal(window["time_s"], strip["time_s"][10:30])


def test_a_window_over_the_edge_is_empty_there_and_keeps_its_width(comb):
    """A failure means that panels side by side have different scales, or wrapped columns."""
    strip, tracks, _ = comb
    for follow in (False, True):
        window = space_time(strip, around=tracks, sheet=0, width_px=61, follow=follow)
        outside = window["x"].values + (window["x_sheet_px"].values[:, None] if follow else 0) < ORIGIN
        np.testing.assert_array_equal(np.isnan(window.values), np.broadcast_to(outside, window.shape))
        assert outside.any()


def test_frames_that_are_not_there_stay_empty(comb):
    """A failure means that a lost frame is drawn as if it had been seen."""
    strip, tracks, _ = comb
    lost = strip.copy()
    lost[12] = np.nan
    gone = tracks.copy(deep=True)
    gone["x_px"][12] = np.nan
    for follow in (False, True):
        window = space_time(lost, around=gone, sheet=3, width_px=15, follow=follow)
        assert np.isnan(window.values).all(axis=1).nonzero()[0].tolist() == [12]


def test_nothing_given_is_changed(comb):
    """A failure means that drawing a picture alters the data it was drawn from."""
    strip, tracks, _ = comb
    before, positions = strip.copy(deep=True), tracks.copy(deep=True)
    window = space_time(strip, around=tracks, sheet=3, width_px=15)
    window[:] = 0
    xr.testing.assert_identical(strip, before)
    xr.testing.assert_identical(tracks, positions)


BAD = {
    "no such sheet": ({"sheet": ("right", 9), "width_px": 9}, "right:1 to right:3"),
    "a sheet of the command": (
        {"sheet": "right:3", "width_px": 9},
        r"\('right', 23\), or an index",
    ),
    "no such side": ({"sheet": ("middle", 1), "width_px": 9}, "middle:1"),
    "index outside": ({"sheet": 6, "width_px": 9}, "index 0 to 5"),
    "no width": ({"sheet": 1}, "neither"),
    "two widths": ({"sheet": 1, "width_px": 9, "width_um": 90}, "both"),
    "µm without a scale": ({"sheet": 1, "width_um": 90}, "pixel_size_um"),
    "negative width": ({"sheet": 1, "width_px": -3}, "1 to 140 px"),
    "NaN width": ({"sheet": 1, "width_px": float("nan")}, "1 to 140 px"),
    "wider than the strip": ({"sheet": 1, "width_px": 141}, "1 to 140 px"),
    "frames outside": ({"frames": slice(80, 90), "around": None}, "frames 0 to 79"),
    "time outside": ({"time_s": (9.0, 10.0), "around": None}, "3.16 s"),
    "window without a sheet": ({"width_px": 9}, "sheet"),
    "sheet without tracks": ({"sheet": 1, "width_px": 9, "around": None}, "`around`"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_the_recording_does_not_have_is_said(comb, case):
    """A failure means a wrong or empty picture instead of a clear line."""
    strip, tracks, _ = comb
    options, named = BAD[case]
    with pytest.raises(InputError, match=named):
        space_time(strip, **{"around": tracks} | options)


def test_seconds_of_a_recording_without_a_clock_are_refused(comb):
    """A failure means that frame numbers are taken for seconds."""
    strip, _, _ = comb
    timeless = strip.assign_coords(time_s=("frame", np.full(FRAMES, np.nan)))
    with pytest.raises(InputError, match="without a clock"):
        space_time(timeless, time_s=(0, 1))


def test_a_sheet_never_seen_has_no_window(comb):
    """A failure means a window at a place where nothing was measured."""
    strip, tracks, _ = comb
    gone = tracks.copy(deep=True)
    gone["x_px"][:, 2] = np.nan
    with pytest.raises(InputError, match="left:1"):
        space_time(strip, around=gone, sheet=2, width_px=9)


def test_means_would_lose_that_slip():
    """The plain way to thin a record fails here, so the test above is not empty."""
    y = np.zeros(100_000)
    y[54_321] = 5.0
    assert y.reshape(1000, -1).mean(axis=1).max() < 0.1


def test_picture_rows_are_means_of_their_frames():
    """A failure means that the space-time diagram shows other grey values than the strip."""
    values = np.random.default_rng(2).normal(100, 10, (6400, 7)).astype(np.float32)
    rows, edges = time_rows(values, np.arange(6400) / 60, most=200)
    assert rows.shape == (200, 7)
    assert len(edges) == 201
    direct = values[: 32 * 199].reshape(199, 32, 7).mean(axis=1)
    # the first row may take one frame more or less than the plain split does
    np.testing.assert_allclose(rows[5:190].mean(axis=0), direct[5:190].mean(axis=0), rtol=5e-3)
    assert np.isfinite(rows).all()


def test_every_frame_has_its_own_row_while_there_is_room():
    """A failure means that frames are shifted or merged without need."""
    values = np.arange(50, dtype=np.float32)[:, None] * np.ones((1, 3), np.float32)
    rows, _ = time_rows(values, np.arange(50) * 0.04, most=1200)
    np.testing.assert_array_equal(rows, values)


def test_lost_frames_leave_their_rows_empty():
    """A failure means that frames which do not exist are shown as if they did."""
    values = np.ones((100, 2), np.float32)
    values[40:50] = np.nan
    rows, _ = time_rows(values, np.arange(100.0), most=1200)
    assert np.isnan(rows[40:50]).all()
    assert np.isfinite(rows[np.r_[0:40, 50:100]]).all()


def test_a_pause_of_the_camera_keeps_the_time_scale():
    """A failure means that the tracks do not lie on their ridges after a pause in the recording."""
    time = np.r_[np.arange(100.0), 200 + np.arange(100.0)]
    values = np.r_[np.zeros((100, 1)), np.ones((100, 1))].astype(np.float32)
    rows, edges = time_rows(values, time, most=150)
    centre = (edges[:-1] + edges[1:]) / 2
    assert (rows[(centre > 203)] == 1).all()
    assert (rows[(centre < 97)] == 0).all()
    assert np.isnan(rows[(centre > 110) & (centre < 190)]).all()


def test_grey_levels_span_black_to_white():
    """A failure means a picture without contrast, or unknown pixels shown as black."""
    grey = grey_levels(np.array([0.0, 50.0, 100.0, 200.0, np.nan]), 0.0, 100.0)
    assert grey.tolist() == [0, 128, 255, 255, 128]
