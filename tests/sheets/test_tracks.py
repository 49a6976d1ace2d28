"""What must hold for every recording: symmetries, order, inputs left alone."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scenes.combs import as_strip, comb, ridges, strip
from vision.sheets import track_sheets

few = settings(max_examples=8, deadline=None, derandomize=True)
seeds = st.integers(0, 1000)


def recording(seed: int, frames: int = 60):
    """Twelve to twenty sheets of uneven pitch and brightness, slipping."""
    rng = np.random.default_rng(seed)
    truth = comb(frames, per_side=int(rng.integers(6, 11)), axis_px=260, slip=0.7, uneven=0.08, seed=seed)
    bright = rng.uniform(0.6, 1.4, truth.shape[1])
    return truth, strip(ridges(truth, width=520, contrast=bright), seed=seed)


@few
@given(seed=seeds, by=st.integers(1, 25))
def test_a_shift_of_the_picture_shifts_every_position(seed, by):
    """A failure means positions depend on where in the picture a ridge lies."""
    _, picture = recording(seed)
    moved = as_strip(np.pad(picture.values[:, :-by], ((0, 0), (by, 0)), mode="edge"))
    here, there = track_sheets(picture), track_sheets(moved)
    np.testing.assert_allclose(there.x_px, here.x_px + by, atol=1e-4)
    assert (here.side.values == there.side.values).all()


@few
@given(seed=seeds, origin=st.integers(1, 900))
def test_columns_cut_off_on_the_left_are_counted(seed, origin):
    """A failure means positions with --columns are not those of the whole picture."""
    _, picture = recording(seed)
    cut = as_strip(picture.values, origin=origin)
    np.testing.assert_allclose(track_sheets(cut).x_px, track_sheets(picture).x_px + origin, atol=1e-9)


@few
@given(seed=seeds)
def test_a_mirror_swaps_the_sides(seed):
    """A failure means left and right are treated differently."""
    _, picture = recording(seed)
    mirrored = as_strip(np.ascontiguousarray(picture.values[:, ::-1]))
    here, there = track_sheets(picture), track_sheets(mirrored)
    np.testing.assert_allclose(there.x_px.values[:, ::-1], 519 - here.x_px.values, atol=1e-4)
    assert (there.side.values[::-1] == -here.side.values).all()
    assert (there.n.values[::-1] == here.n.values).all()


@few
@given(seed=seeds, gain=st.sampled_from([0.01, 0.5, 2.0, 250.0]), offset=st.sampled_from([-500.0, 0.0, 3e3]))
def test_gain_and_offset_change_only_the_contrast(seed, gain, offset):
    """A failure means thresholds are in grey levels: 8 and 12 bit cameras would give different sheets."""
    _, picture = recording(seed)
    scaled = as_strip((picture.values * gain + offset).astype(np.float32))
    here, there = track_sheets(picture), track_sheets(scaled)
    rounding = 1e-4 + 1e-5 * abs(offset) / gain / 60  # float32 grey levels on a large offset
    np.testing.assert_allclose(there.x_px, here.x_px, atol=20 * rounding)
    np.testing.assert_allclose(there.attrs["contrast"], here.attrs["contrast"] * gain, rtol=0.05)


@few
@given(seed=seeds)
def test_sheets_stand_in_order_near_the_truth(seed):
    """A failure means two sheets have changed places in some frame."""
    truth, picture = recording(seed)
    tracks = track_sheets(picture)
    assert tracks.x_px.shape == truth.shape
    assert (np.diff(tracks.x_px.values, axis=1) > 0).all()
    assert np.abs(tracks.x_px.values - truth).max() < 0.3


@few
@given(seed=seeds)
def test_the_input_is_left_as_it_is_and_the_result_is_the_same_again(seed):
    """A failure means a second call on the same strip may give other numbers."""
    _, picture = recording(seed)
    before = picture.copy(deep=True)
    first, second = track_sheets(picture), track_sheets(picture)
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
