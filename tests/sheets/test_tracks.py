"""What must hold for every recording: symmetries, order, inputs left alone; and strips that are refused."""

import sys
import tracemalloc
from functools import cache

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes.combs import as_strip, comb, ridges, strip
from vision import memory
from vision.checks import consistency_warnings
from vision.data import TRACKS, TrackMetadata, operations_of
from vision.errors import InputError
from vision.memory import table_in_file
from vision.sheets import track_sheets

few = settings(max_examples=8)
seeds = st.integers(0, 7)  # so that every test tries the same recordings, which are tracked once


@cache
def recording(seed: int, frames: int = 60):
    """Twelve to twenty sheets of uneven pitch and brightness, slipping."""
    rng = np.random.default_rng(seed)
    truth = comb(frames, per_side=int(rng.integers(6, 11)), axis_px=260, slip=0.7, uneven=0.08, seed=seed)
    bright = rng.uniform(0.6, 1.4, truth.shape[1])
    return truth, strip(ridges(truth, width=520, contrast=bright), seed=seed)


@cache
def tracked(seed: int):
    """Its tracks; not to be changed, nor is the recording."""
    return track_sheets(recording(seed)[1])


@few
@given(seed=seeds, by=st.integers(1, 25))
def test_a_shift_of_the_picture_shifts_every_position(seed, by):
    """A failure means positions depend on where in the picture a ridge lies."""
    _, picture = recording(seed)
    moved = as_strip(np.pad(picture.values[:, :-by], ((0, 0), (by, 0)), mode="edge"))
    here, there = tracked(seed), track_sheets(moved)
    np.testing.assert_allclose(there.x_px, here.x_px + by, atol=1e-4)
    assert (here.side.values == there.side.values).all()


@few
@given(seed=seeds, origin=st.integers(1, 900))
def test_columns_cut_off_on_the_left_are_counted(seed, origin):
    """A failure means positions with --columns are not those of the whole picture."""
    _, picture = recording(seed)
    cut = as_strip(picture.values, origin=origin)
    np.testing.assert_allclose(track_sheets(cut).x_px, tracked(seed).x_px + origin, atol=1e-9)


@few
@given(seed=seeds)
def test_a_mirror_swaps_the_sides(seed):
    """A failure means left and right are treated differently."""
    _, picture = recording(seed)
    mirrored = as_strip(np.ascontiguousarray(picture.values[:, ::-1]))
    here, there = tracked(seed), track_sheets(mirrored)
    np.testing.assert_allclose(there.x_px.values[:, ::-1], 519 - here.x_px.values, atol=1e-4)
    assert (there.side.values[::-1] == -here.side.values).all()
    assert (there.n.values[::-1] == here.n.values).all()


@few
@given(seed=seeds, gain=st.sampled_from([0.01, 0.5, 2.0, 250.0]), offset=st.sampled_from([-500.0, 0.0, 3e3]))
def test_gain_and_offset_change_only_the_contrast(seed, gain, offset):
    """A failure means thresholds are in grey levels: 8 and 12 bit cameras would give different sheets."""
    _, picture = recording(seed)
    scaled = as_strip((picture.values * gain + offset).astype(np.float32))
    here, there = tracked(seed), track_sheets(scaled)
    rounding = 1e-4 + 1e-5 * abs(offset) / gain / 60  # float32 grey levels on a large offset
    np.testing.assert_allclose(there.x_px, here.x_px, atol=20 * rounding)
    np.testing.assert_allclose(there.attrs["contrast"], here.attrs["contrast"] * gain, rtol=0.05)


@few
@given(seed=seeds)
def test_sheets_stand_in_order_near_the_truth(seed):
    """A failure means two sheets have changed places in some frame."""
    truth, _ = recording(seed)
    tracks = tracked(seed)
    assert tracks.x_px.shape == truth.shape
    assert (np.diff(tracks.x_px.values, axis=1) > 0).all()
    assert np.abs(tracks.x_px.values - truth).max() < 0.3


@few
@given(seed=seeds)
def test_the_input_is_left_as_it_is_and_the_result_is_the_same_again(seed):
    """A failure means a second call on the same strip may give other numbers."""
    _, picture = recording(seed)
    before = picture.copy(deep=True)
    first, second = tracked(seed), track_sheets(picture)
    assert picture.identical(before)
    assert first.identical(second)


@few
@given(seed=seeds)
def test_negative_film_gives_the_same_sheets(seed):
    """A failure means dark ridges are tracked differently from bright ones."""
    _, picture = recording(seed)
    negative = as_strip((255 - picture.values).astype(np.float32))
    here, there = track_sheets(picture, ridges="bright"), track_sheets(negative, ridges="dark")
    np.testing.assert_allclose(there.x_px, here.x_px, atol=1e-4)


def test_sizes_of_blocks_and_number_of_threads_change_nothing(monkeypatch):
    """A failure means that positions depend on the machine, or on where blocks of a film begin."""
    picture = recording(3, frames=300)[1]
    expected = track_sheets(picture)
    monkeypatch.setattr(memory.row_parts, "__defaults__", (37,))
    sizes = {"FRAMES_PER_BLOCK", "AT_ONCE", "RIDGES_AT_ONCE", "FRAMES_AT_ONCE", "TRIPLES_AT_ONCE"}
    changed = set()
    for name, module in list(sys.modules.items()):
        if name == "vision.numeric" or name.startswith("vision.sheets."):
            for size in sizes & vars(module).keys():
                monkeypatch.setattr(module, size, 29)
                changed.add(size)
            if "in_two_threads" in vars(module):
                monkeypatch.setattr(
                    module, "in_two_threads", lambda work, items: [work(item) for item in items]
                )
    assert changed == sizes
    found = track_sheets(picture)
    for name in ("flag", "why", "side", "n"):
        assert (found[name].values == expected[name].values).all()
    for name in ("x_px", "x_err_px", "fwhm_px", "x_noise_px", "x_scatter_px", "x_expected_px"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, err_msg=name)


@pytest.mark.parametrize("spacing", [20.37, 24.61])
def test_the_spacing_is_that_of_the_sheets(spacing):
    """A failure means a spacing in whole pixels; one ridge has none."""
    x = 40 + np.tile(spacing * np.arange(12), (40, 1))
    facts = TrackMetadata.of(track_sheets(strip(ridges(x, width=400))))
    assert facts.spacing_px == pytest.approx(spacing, abs=0.02)
    alone = track_sheets(strip(ridges(x[:, 4:5], width=400)))
    assert np.isnan(TrackMetadata.of(alone).spacing_px)


def test_what_comes_out_is_as_declared():
    """A failure means that a later stage refuses the tracks, or that units and facts are lost on the way."""
    _, picture = recording(1)
    tracks = track_sheets(picture.assign_attrs(strip_z0=60, warnings=["two frames lost"]), axis_px=260.0)
    TRACKS.check(tracks)
    always = {name for name, declared in TRACKS.variables.items() if "z" not in declared.dims}
    assert always <= set(tracks.variables)  # positions along z are there with strips of their own only
    assert tracks["x_err_px"].attrs["units"] == "px"
    facts = TrackMetadata.of(tracks)
    assert (facts.fit, facts.window_px, facts.sheets) == ("sliding", 9, tracks.sizes["sheet"])
    assert (facts.axis_px, facts.axis_how) == (260.0, "given")
    assert tracks.attrs["strip_z0"] == 60 and tracks.attrs["warnings"] == ["two frames lost"]
    last = operations_of(tracks)[-1]
    assert last["operation"] == "track_sheets" and last["parameters"]["axis_px"] == 260.0


@pytest.mark.parametrize("codec", ["mjpeg", "rawvideo"])
def test_errors_are_no_smaller_than_the_scatter(codec):
    """A failure means that error bars are too small where compression hides the noise of the pixels, or where
    something else than that noise moves the ridges from frame to frame."""
    truth = comb(120, per_side=8, axis_px=260, slip=0.0)
    shaken = truth + np.random.default_rng(1).normal(0, 0.05, truth.shape)  # an artefact of 0.05 px
    tracks = track_sheets(strip(ridges(shaken, width=520), snr=1000).assign_attrs(codec=codec))
    stated = float(np.median(tracks["x_err_px"]))
    assert 0.04 < stated < 0.06


@pytest.mark.parametrize("lacking", ["time_s", "frame"])
def test_a_strip_that_lacks_something_is_refused_by_name(lacking):
    """A failure means a KeyError in the middle of the work."""
    _, picture = recording(1)
    assert f"no {lacking}" in refusal(picture.drop_vars(lacking))


def test_frames_without_a_picture_have_no_say_in_which_ridges_are_sheets():
    """A failure means that a film whose lamp is off, or that is damaged, for most of it is refused."""
    _, picture = recording(1)
    lit = picture.sizes["frame"] // 5
    dark = picture.drop_vars("status").copy()
    dark[lit:] = np.nan
    tracks = track_sheets(dark)
    flag = tracks["flag"].values
    assert (flag[:lit] == "ok").mean() > 0.99
    assert (flag[lit:] == "blank").all()
    assert not any("found in few frames" in line for line in consistency_warnings(tracks))


def test_a_strip_made_by_hand_needs_no_name_and_no_status():
    """A failure means that arrays of one's own cannot be tracked in a notebook."""
    truth, picture = recording(1)
    bare = picture.drop_vars("status").rename(None).copy()
    bare[5] = np.nan
    tracks = track_sheets(bare)
    assert (tracks["flag"].values[5] == "blank").all()
    assert (np.delete(tracks["flag"].values, 5, axis=0) == "ok").all()
    assert np.nanmax(np.abs(tracks["x_px"].values - truth)) < 0.3


@pytest.mark.parametrize("other", ["film.avi", None, pd.DataFrame()])
def test_the_result_of_another_stage_is_refused(other):
    """A failure means that a notebook ends in an AttributeError that names nothing to pass."""
    assert "expected what `vision.strip_profile` returns" in refusal(other)


def test_dimensions_in_another_order_are_refused():
    """A failure means that x and t are exchanged without a word."""
    _, picture = recording(1)
    turned: xr.DataArray = picture.transpose("x", "frame")
    assert "dimensions" in refusal(turned)


def refusal(picture, **options):
    """The message, which must be one line that names the recording."""
    with pytest.raises(InputError) as caught:
        track_sheets(picture, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert "expected" in message and "found" in message
    return message


def grey(level, frames=20, columns=200):
    return np.full((frames, columns), level, np.float32)


@pytest.mark.parametrize(
    "turned",
    [
        lambda one: one.T,
        lambda one: one[:, ::2],
        lambda one: one[:, ::-1],
        lambda one: one[::-1],
        lambda one: one.assign_coords(frame=np.zeros(one.sizes["frame"], int)),
        lambda one: one[:0],
    ],
    ids=["x first", "every other column", "mirrored", "backwards", "one number", "no frames"],
)
def test_an_array_that_is_not_in_order_is_refused(turned):
    """A failure means positions at half of their columns, without a word, or a traceback."""
    own = strip(ridges(comb(6)), seed=3).rename(None)
    with pytest.raises(InputError, match="the strip: expected I"):
        track_sheets(turned(own))


def test_constant_picture():
    """A failure means a covered lens ends in a traceback or in sheets."""
    assert "scene.avi: expected a picture with ridges; found a constant one" in refusal(as_strip(grey(80)))


def test_noise_alone():
    """A failure means noise is tracked as sheets."""
    assert "expected upright ridges" in refusal(strip(np.zeros((40, 400)), snr=20))


def test_a_slope_of_light_alone():
    """A failure means uneven light is tracked as sheets."""
    fall = np.broadcast_to(np.linspace(0, 2, 400), (40, 400))
    assert "ridge" in refusal(strip(fall, snr=100))


def test_fewer_ridges_than_asked():
    """A failure means sheets are invented to reach the number asked for."""
    picture = strip(ridges(comb(40, per_side=4, axis_px=150), width=300))
    message = refusal(picture, sheets=12)
    assert "12 ridges" in message and "found 8" in message


def test_no_usable_frame():
    """A failure means a recording of corrupt frames ends in a traceback."""
    assert "at least one usable frame" in refusal(as_strip(grey(np.nan)))


def test_too_few_columns():
    """A failure means a strip cut too narrow ends in a traceback."""
    for columns, expected in ((0, "found no columns"), (5, "at least 8 columns")):
        assert expected in refusal(as_strip(grey(80, columns=columns)))


def test_axis_outside_the_picture_on_the_wrong_scale():
    """A failure means an axis typed in µm instead of px numbers every sheet wrongly without a word."""
    picture = strip(ridges(comb(40, per_side=4, axis_px=150), width=300))
    assert "axis" in refusal(picture, axis_px=1e6)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_a_few_frames_are_enough_for_positions(frames):
    """One frame gives positions, and no error made up: a failure means short clips crash or warn."""
    truth = comb(frames, per_side=4, axis_px=150)
    tracks = track_sheets(strip(ridges(truth, width=300)))
    assert np.abs(tracks.x_px.values - truth).max() < 0.2
    assert np.isfinite(tracks.x_err_px.values).all()
    assert np.isnan(tracks.x_noise_px.values).all()


# --- memory -------------------------------------------------------------------------------------------------


FRAMES, SHEETS = 20_000, 24  # in shorter films the largest part does not grow with the film
MOST_TABLES = {"memory": 11.5, "file": 5.0}  # 11.3 and 4.7 here; copies in every stage made 34


@pytest.mark.thorough
@pytest.mark.parametrize("where", MOST_TABLES)
def test_tracking_holds_few_tables_of_frames_and_sheets(where, tmp_path):
    """A failure means that long films fill the memory of a computer that could track them. Where the strip is
    in a temporary file, so are most tables."""
    few = strip(ridges(comb(100, per_side=SHEETS // 2, axis_px=260), width=520)).values
    noise = np.random.default_rng(1).normal(0, 0.3, (FRAMES, few.shape[1])).astype(np.float32)
    film = as_strip(np.tile(few, (FRAMES // len(few), 1)) + noise)
    if where == "file":
        values = table_in_file(film.shape, tmp_path)
        values[:] = film.values
        film = film.copy(data=values)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    try:
        tracks = track_sheets(film)
        held, peak = (size - before for size in tracemalloc.get_traced_memory())
    finally:
        tracemalloc.stop()
    table = 8 * FRAMES * SHEETS
    assert tracks.sizes == {"frame": FRAMES, "sheet": SHEETS}
    assert peak / table < MOST_TABLES[where]
    assert held / table < 5


@pytest.mark.parametrize("grey", [0.9, 1.4])
def test_a_ridge_cut_by_what_hides_the_next_has_no_position(grey):
    """A hand moves over the comb and stays.  A failure means the edge of the hand, or what is left of a ridge
    beside it, passes as the position of a sheet."""
    truth = comb(240, per_side=12, axis_px=300)
    picture = ridges(truth, width=600, contrast=np.exp(0.2 * np.sin(2.5 * np.arange(24))))
    x, texture = np.arange(600), 0.03 * np.sin(np.arange(600) / 3.1)
    for frame in range(90, 200):
        end = min(6.0 * (frame - 90) + 40, 420.0)
        hand = 1 / (1 + np.exp((np.abs(x - end + 70) - 70) / 1.2))
        picture[frame] = picture[frame] * (1 - hand) + hand * (grey + texture)
    tracks = track_sheets(strip(picture))
    ok = (tracks.flag == "ok").values
    off = np.where(ok, tracks.x_px.values - truth, np.nan)
    assert np.nanmax(np.abs(off)) < 0.5
    assert ok.mean() > 0.8
