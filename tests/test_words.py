"""Tables of words are text to whoever reads them, and a byte each until then."""

import pickle

import numpy as np
import pytest
import xarray as xr

from tests.scenes.combs import comb, ridges, strip
from vision.sheets import track_sheets
from vision.words import is_word, word_codes, word_counts, words, words_of_characters

LISTED = ("ok", "missing", "left_out")
CODES = np.random.default_rng(0).integers(0, 3, (5000, 4)).astype(np.uint8)
TEXT = np.array(LISTED)[CODES]


@pytest.fixture
def flags():
    return xr.DataArray(words(CODES, LISTED), dims=("frame", "sheet"), coords={"frame": np.arange(5000)})


def test_the_values_are_text(flags):
    """A failure means that a script that reads flags finds something else."""
    assert flags.dtype == TEXT.dtype
    assert flags.shape == TEXT.shape
    np.testing.assert_array_equal(flags.values, TEXT)
    np.testing.assert_array_equal(np.asarray(flags), TEXT)


@pytest.mark.parametrize(
    "part",
    [np.s_[3], np.s_[:, 1], np.s_[10:20, ::2], np.s_[-1, -1], np.s_[[4, 2], :], np.s_[[4, 2], [0, 3, 1]]],
)
def test_parts_are_those_of_the_text(flags, part):
    """A failure means that flags are those of other positions."""
    rows, sheets = part if isinstance(part, tuple) else (part, slice(None))
    expected = xr.DataArray(TEXT, dims=("frame", "sheet"))[rows, sheets]
    np.testing.assert_array_equal(flags[rows, sheets].values, expected.values)
    np.testing.assert_array_equal(flags.isel(frame=rows).isel(sheet=sheets).values, expected.values)


def test_single_positions_and_masks_are_those_of_the_text(flags):
    """A failure means that a list of positions has the flags of others."""
    at = {"frame": xr.DataArray([7, 2, 2], dims="one"), "sheet": xr.DataArray([0, 3, 1], dims="one")}
    np.testing.assert_array_equal(flags.isel(at).values, TEXT[[7, 2, 2], [0, 3, 1]])
    some = (CODES == 1).any(axis=1)
    np.testing.assert_array_equal(flags[some].values, TEXT[some])
    np.testing.assert_array_equal(flags.sel(frame=slice(5, 9)).values, TEXT[5:10])
    np.testing.assert_array_equal(flags.transpose("sheet", "frame").values, TEXT.T)


def test_they_compare_as_text(flags):
    """A failure means that a selection by flag is empty."""
    np.testing.assert_array_equal((flags == "ok").values, TEXT == "ok")
    np.testing.assert_array_equal((flags != "missing").values, TEXT != "missing")
    np.testing.assert_array_equal(flags.isin(["ok", "left_out"]).values, np.isin(TEXT, ("ok", "left_out")))
    np.testing.assert_array_equal(flags.where(flags == "ok", "no").values, np.where(TEXT == "ok", "ok", "no"))


@pytest.mark.parametrize("deep", [False, True])
def test_copies_and_pickles_are_equal_and_independent(flags, deep):
    """A failure means that a change of a copy changes the tracks, or is lost."""
    copied, stored = flags.copy(deep=deep), pickle.loads(pickle.dumps(flags))
    xr.testing.assert_identical(stored, flags)
    xr.testing.assert_identical(copied, xr.DataArray(TEXT, flags.coords, flags.dims))
    if deep:
        copied[0, 0] = "missing" if TEXT[0, 0] == "ok" else "ok"
        assert flags[0, 0] == TEXT[0, 0]
        assert copied[0, 0] != TEXT[0, 0]


def test_they_can_be_changed(flags):
    """A failure means that a script that sets a flag does not, without a word."""
    flags[3, 1] = "left_out"
    assert flags[3, 1] == "left_out"
    flags.values[4, 2] = "left_out"
    assert flags.values[4, 2] == "left_out"
    flags.loc[{"frame": 5}] = "missing"
    assert (flags.sel(frame=5) == "missing").all()
    assert (np.array([LISTED.index(word) for word in TEXT.ravel()]).reshape(TEXT.shape) == CODES).all()


def test_they_are_found_and_counted(flags):
    """A failure means wrong numbers of missing positions in the summary."""
    np.testing.assert_array_equal(is_word(flags, "ok", "missing"), np.isin(TEXT, ("ok", "missing")))
    assert word_counts(flags) == {word: int((word == TEXT).sum()) for word in sorted(LISTED)}
    text = xr.DataArray(TEXT, dims=("frame", "sheet"))
    assert word_counts(text) == word_counts(flags)
    assert word_counts(flags[:0]) == {}
    assert is_word(flags[:0], "ok").shape == (0, 4)


def test_tracks_are_written_and_tabulated_with_their_flags(tmp_path):
    """A failure means that tracks in pandas or netCDF lack flags."""
    tracks = track_sheets(strip(ridges(comb(60, per_side=8, axis_px=260), width=520)))
    flag = tracks["flag"].values
    table = tracks[["x_px", "flag"]].to_dataframe()
    np.testing.assert_array_equal(table["flag"].to_numpy().reshape(flag.shape), flag)
    plain = tracks[["x_px", "flag", "why"]].drop_attrs()
    plain.to_netcdf(tmp_path / "tracks.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "tracks.nc", engine="h5netcdf") as stored:
        np.testing.assert_array_equal(stored["flag"].values.astype(str), flag)
        np.testing.assert_array_equal(stored["why"].values.astype(str), tracks["why"].values)


def characters(text):
    """Each word as characters, along a further axis."""
    text = np.asarray(text, "S")
    return xr.DataArray(text.view("S1").reshape(*text.shape, text.itemsize))


def test_words_are_read_from_their_characters():
    """A failure means that the flags of a run are others than those that were written."""
    flags = np.array([["ok", "missing", "ok"], ["edge", "ok", ""]])
    read = xr.Variable(("frame", "sheet"), words_of_characters(characters(flags)))
    assert read.values.tolist() == flags.tolist()
    assert read[1, :2].values.tolist() == ["edge", "ok"]


def test_text_that_is_no_table_of_words_is_refused():
    """A failure means that a damaged file gives wrong flags."""
    with pytest.raises((ValueError, OverflowError)):
        words_of_characters(characters([[f"{number}" for number in range(300)]]))


def test_words_are_numbered_as_in_the_list():
    """A failure means that a review shows other flags than the run has."""
    text = xr.DataArray([["ok", "new", "edge"], ["edge", "ok", "other"]], dims=("frame", "sheet"))
    assert word_codes(text, ["missing", "ok", "edge"]).tolist() == [[1, 0, 2], [2, 1, 0]]
    assert word_codes(text[:0], ["ok"]).shape == (0, 3)
