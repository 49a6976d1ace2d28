"""What a run folder holds is written side by side, tables as other programs write them."""

from __future__ import annotations

import struct
import threading

import h5py
import numpy as np
import pandas as pd
import pytest
import tifffile
import xarray as xr

from tests.scenes import analysed
from vision.errors import InputError
from vision.figures import drawing
from vision.pipeline import Analysis, Settings, Tuning
from vision.run import provenance, tables, writing
from vision.run.provenance import Origin
from vision.run.tables import (
    frame_step_s,
    read_kymograph_tif,
    stored_kymograph,
    unevenness_s,
    write_kymograph_tif,
    write_space_time_tif,
)
from vision.run.writing import write_run
from vision.shells import ShellSettings


@pytest.fixture(scope="module")
def found():
    seen = analysed.video_only()
    return Analysis(settings=Settings(), strip=seen.strip, tracks=seen.tracks)


def test_the_table_of_the_deformation_has_the_run_s_own_certainty(pulled, tmp_path):
    """A failure means that deformation.csv calls sheets stiff at another certainty than shells.csv."""
    undetermined, usual = [], float(pulled.motion["ratio"].median())
    for certainty in (0.9, 0.9999):
        settings = Settings(threshold=usual, tuning=Tuning(shells=ShellSettings(certainty=certainty)))
        folder = tmp_path / f"{certainty}"
        write_run(Analysis(settings=settings, motion=pulled.motion), folder, Origin(command="track"))
        undetermined.append((pd.read_csv(folder / "deformation.csv")["shell"] == "undetermined").sum())
    assert undetermined[0] < undetermined[1]


def test_tracks_nc_is_not_taken_for_a_strip(found, tmp_path):
    """A failure means that a viewer labels positions as a mean intensity in grey levels."""
    tables.write_tracks_nc(found.tracks, tmp_path / "tracks.nc", pixel_size_um=10.0)
    with xr.open_dataset(tmp_path / "tracks.nc", engine="h5netcdf") as read:
        assert read.attrs["title"] == "positions of sheets, x(n,t)"
        assert not {"long_name", "units"} & set(read.attrs)
        assert read["x_px"].attrs["units"] == "px"


def test_tracks_nc_is_read_back_with_its_text_and_gaps(found, tmp_path):
    """A failure means that MATLAB or ncdump read other dimensions, flags or gaps than were found."""
    heights = found.tracks["x_px"].expand_dims(z=[20.0, 60.0], axis=2)
    tracks = found.tracks.assign(x_at_z_px=heights.assign_attrs(units="px"))
    tables.write_tracks_nc(tracks, tmp_path / "tracks.nc", pixel_size_um=10.0)
    with xr.open_dataset(tmp_path / "tracks.nc", engine="h5netcdf") as read:
        for name, one in tracks.variables.items():
            assert read[name].dims == one.dims, name
            np.testing.assert_array_equal(read[name].values, one.values)
    with h5py.File(tmp_path / "tracks.nc") as file:  # characters, as MATLAB does not read other text
        assert file["flag"].dtype == "S1"
        assert file["flag"].dims[2][0].name == "/flag_length"


def test_attributes_come_back_from_netcdf_as_they_were():
    """A failure means that a film called [1].avi makes a run that cannot be read."""
    attrs = {"source": "[1].avi", "note": '"quoted"', "list": [1, "a"], "plain": "x", "number": 2.0}
    assert tables.attrs_of_netcdf(tables.netcdf_attrs(attrs)) == attrs
    assert tables.netcdf_attrs({"source": "a\udcff.avi"}) == {"source": "a?.avi"}


def test_after_ctrl_c_nothing_waits_for_the_whole_table(found, tmp_path, monkeypatch):
    """A failure means that an interrupted run of hours of film goes on writing text for seconds."""
    begun, told = threading.Event(), []

    def text(tracks, path, *, pixel_size_um, stop):
        begun.set()
        told.append(stop.wait(20))

    def interrupted(*arguments, **options):
        assert begun.wait(20)
        raise KeyboardInterrupt

    monkeypatch.setattr(writing, "write_tracks_csv", text)
    monkeypatch.setattr(writing, "write_tracks_nc", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_run(found, tmp_path / "run", Origin(command="track"))
    assert told == [True]
    assert not (tmp_path / "run").exists()


def test_a_table_that_is_told_to_stop_ends_with_its_part(found, tmp_path, monkeypatch):
    """A failure means that the text goes on to its end all the same."""
    path, stop = tmp_path / "tracks.csv", threading.Event()
    monkeypatch.setattr(tables, "ROWS_PER_CHUNK", 1)
    written = tables.csv.write_csv

    def stopped(*arguments, **more):
        written(*arguments, **more)
        stop.set()

    monkeypatch.setattr(tables.csv, "write_csv", stopped)
    tables.write_tracks_csv(found.tracks, path, pixel_size_um=None, stop=stop)
    assert len(path.read_text().splitlines()) == 1 + found.tracks.sizes["sheet"]


def test_a_full_disk_under_the_text_fails_the_run(found, tmp_path, monkeypatch):
    """A failure means a run folder without tracks.csv, or with half of it, that looks whole."""

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writing, "write_tracks_csv", full)
    with pytest.raises(ValueError, match="a full disk"):
        write_run(found, tmp_path / "run", Origin(command="track"))
    assert not (tmp_path / "run").exists()


def test_the_times_of_a_run_contain_its_text(found, tmp_path, monkeypatch):
    """A failure means a total in run.json that leaves out what a long tracks.csv takes."""
    drawn, order, draw, write = threading.Event(), [], writing._write_figures_and_page, writing.write_json

    def text(tracks, path, *, pixel_size_um, stop):
        assert drawn.wait(20)
        stop.wait(0.3)
        order.append(path.name)

    def figures(*arguments, **options):
        draw(*arguments, **options)
        drawn.set()

    def facts(content, path):
        order.append(path.name)
        write(content, path)

    monkeypatch.setattr(writing, "write_tracks_csv", text)
    monkeypatch.setattr(writing, "_write_figures_and_page", figures)
    monkeypatch.setattr(writing, "write_json", facts)
    write_run(found, tmp_path / "run", Origin(command="track"), report=False)
    assert order.index("tracks.csv") < order.index("run.json")


def test_inputs_are_read_while_tables_are_written(found, tmp_path, monkeypatch):
    """A failure means that a run stands still for the fingerprint of its film."""
    read = threading.Event()
    monkeypatch.setattr(provenance, "describe_input", lambda path, whole: read.set() or {"path": str(path)})
    monkeypatch.setattr(writing, "_write_tables", lambda *_: told.append(read.wait(20)))
    told = []
    content = write_run(found, tmp_path / "run", Origin(command="track", inputs=[tmp_path]), report=False)
    assert told == [True]
    assert content["inputs"] == [{"path": str(tmp_path)}]


def test_a_picture_is_compressed_while_the_next_is_drawn(found, tmp_path, monkeypatch):
    """A failure means that one core rests while the other compresses."""
    both, told, draw = threading.Event(), [], drawing.render

    def drawn(figure):
        pixels = draw(figure)
        if figure.name != "kymograph":  # the second
            both.set()
        return pixels

    monkeypatch.setattr(drawing, "render", drawn)
    monkeypatch.setattr(drawing, "write_png", lambda pixels, path: told.append((path.name, both.wait(20))))
    write_run(found, tmp_path / "run", Origin(command="track"), report=False)
    assert told == [("kymograph.png", True), ("overview.png", True)]


# --- space-time diagrams as Fiji sees them ------------------------------------------------------------------


def diagram_of(values, *, first_x=100, times=None, bits=8):
    frames = np.arange(40, 40 + len(values))
    return xr.DataArray(
        np.asarray(values, np.float32),
        dims=("frame", "x"),
        coords={
            "frame": frames,
            "x": np.arange(first_x, first_x + values.shape[1]),
            "time_s": ("frame", frames / 50 if times is None else times),
        },
        attrs={"depth_bits": bits},
    )


def as_imagej_sees(path):
    """Grey levels, and the places of the first pixel and size of a pixel, as ImageJ computes them."""
    with tifffile.TiffFile(path) as file:
        facts, tags = file.imagej_metadata, file.pages[0].tags
        numbers = file.asarray()
    width = 1 / np.divide(*tags["XResolution"].value)
    height = 1 / np.divide(*tags["YResolution"].value)
    grey = facts["c0"] + facts["c1"] * numbers.astype(float)  # "cf" 0: a straight line
    corner = (-facts["xorigin"] * width, -facts["yorigin"] * height)
    return numbers, grey, corner, (width, height), facts


@pytest.mark.parametrize(("bits", "top"), [(8, 255), (12, 4095), (16, 65535)])
def test_grey_levels_come_back_to_a_thousandth_of_the_range_s_step(tmp_path, bits, top):
    """A failure means that intensities measured in Fiji are wrong."""
    values = np.random.default_rng(1).uniform(0, top, (30, 20))
    values[0, :2] = 0, top
    write_space_time_tif(diagram_of(values, bits=bits), tmp_path / "k.tif", pixel_size_um=None)
    numbers, grey, _, _, facts = as_imagej_sees(tmp_path / "k.tif")
    assert numbers.dtype == np.uint16
    assert facts["cf"] == 0
    np.testing.assert_allclose(grey, values, atol=0.51 * top / 65534)
    assert np.abs(numbers - values).max() > 1 or bits == 16  # uncalibrated numbers are something else


def test_a_float_recording_keeps_its_own_range(tmp_path):
    """A failure means that a recording in floats is cut off or flattened."""
    values = np.linspace(-3, 0.5, 600).reshape(30, 20)
    write_space_time_tif(diagram_of(values, bits=32), tmp_path / "k.tif", pixel_size_um=None)
    grey = as_imagej_sees(tmp_path / "k.tif")[1]
    np.testing.assert_allclose(grey, values, atol=0.51 * 3.5 / 65534)


def test_what_is_not_there_is_zero_and_nothing_else_is(tmp_path):
    """A failure means that a lost frame looks like a black one."""
    values = np.zeros((30, 20))
    values[7] = np.nan
    write_space_time_tif(diagram_of(values), tmp_path / "k.tif", pixel_size_um=None)
    numbers = as_imagej_sees(tmp_path / "k.tif")[0]
    assert (numbers == 0).all(axis=1).nonzero()[0].tolist() == [7]
    assert np.delete(numbers, 7, axis=0).min() == 1


@pytest.mark.parametrize("write", [write_space_time_tif, write_kymograph_tif])
def test_pixels_are_µm_and_s_and_the_corner_is_where_it_was(tmp_path, write):
    """A failure means wrong lengths, speeds or times in Fiji."""
    write(diagram_of(np.ones((30, 20))), tmp_path / "k.tif", pixel_size_um=8.5)
    with tifffile.TiffFile(tmp_path / "k.tif") as file:
        facts, tags = file.imagej_metadata, file.pages[0].tags
        assert (facts["unit"], facts["yunit"]) == ("micron", "sec")
        assert np.divide(*tags["XResolution"].value) == pytest.approx(1 / 8.5)
        assert np.divide(*tags["YResolution"].value) == pytest.approx(50)
        assert -facts["xorigin"] * 8.5 == pytest.approx(850)  # column 100
        assert -facts["yorigin"] / 50 == pytest.approx(0.8)  # frame 40


def test_without_scale_or_clock_the_units_say_so(tmp_path):
    """A failure means that pixels pass for µm, or frames for seconds."""
    timeless = diagram_of(np.ones((30, 20)), times=np.full(30, np.nan))
    write_space_time_tif(timeless, tmp_path / "k.tif", pixel_size_um=None)
    _, _, corner, size, facts = as_imagej_sees(tmp_path / "k.tif")
    assert (facts["unit"], facts["yunit"]) == ("pixel", "frame")
    assert corner == (100, 40)
    assert size == (1, 1)


def test_many_rows_are_written_as_few(tmp_path, monkeypatch):
    """A failure means that blocks are lost or written twice in long recordings."""
    values = np.random.default_rng(2).uniform(0, 255, (30, 20))
    write_space_time_tif(diagram_of(values), tmp_path / "once.tif", pixel_size_um=None)
    monkeypatch.setattr(tables, "ROWS", 7)
    write_space_time_tif(diagram_of(values), tmp_path / "blocks.tif", pixel_size_um=None)
    np.testing.assert_array_equal(
        tifffile.imread(tmp_path / "once.tif"), tifffile.imread(tmp_path / "blocks.tif")
    )


def test_more_than_fiji_s_tiff_holds_is_refused(tmp_path, monkeypatch):
    """A failure means a file that Fiji cannot open."""
    monkeypatch.setattr(tables, "IMAGEJ_BYTES", 1000)
    with pytest.raises(InputError, match="time_s"):
        write_space_time_tif(diagram_of(np.ones((30, 20))), tmp_path / "k.tif", pixel_size_um=None)
    assert not (tmp_path / "k.tif").exists()


def test_a_strip_that_fiji_s_tiff_cannot_hold_is_a_plain_tiff(tmp_path, monkeypatch):
    """A failure means that the diagram of a long test is cut off, or refused after hours."""
    values = np.random.default_rng(3).uniform(0, 255, (30, 20)).astype(np.float32)
    for limit in (2400, 2399):
        monkeypatch.setattr(tables, "IMAGEJ_BYTES", limit)
        write_kymograph_tif(diagram_of(values), tmp_path / "k.tif", pixel_size_um=None)
        with tifffile.TiffFile(tmp_path / "k.tif") as file:
            assert (file.is_imagej, file.is_bigtiff) == (limit == 2400, limit == 2399)
            np.testing.assert_array_equal(file.asarray(), values)


def test_seconds_per_row_survive_rounded_stamps_and_gaps():
    """A failure means a time axis that is stretched: by 2 % for 60 Hz stamps rounded to ms."""
    rounded = np.round(np.arange(600) / 60, 3)
    assert np.median(np.diff(rounded)) != pytest.approx(1 / 60, rel=0.01)
    assert frame_step_s(rounded) == pytest.approx(1 / 60, rel=1e-4)
    gap = np.r_[np.arange(300), np.arange(900, 1200)] / 60
    assert frame_step_s(gap) == pytest.approx(1 / 60, rel=1e-6)
    assert frame_step_s(np.full(5, np.nan)) == 1
    assert frame_step_s(np.array([2.0])) == 1


def test_times_that_an_even_axis_cannot_show_are_noticed():
    """A failure means that Fiji's seconds are wrong and nobody says so."""
    even = np.arange(600) / 60
    assert unevenness_s(even) == 0
    assert unevenness_s(np.round(even, 3)) == 0
    assert unevenness_s(np.r_[even[:300], even[300:] + 0.5]) == pytest.approx(0.5, rel=1e-3)
    late = np.where(np.arange(600) == 300, 1 / 60, 0.0)
    assert unevenness_s(even + 0.3 * late) == 0
    assert unevenness_s(even + 0.8 * late) == pytest.approx(0.8 / 60, rel=0.02)
    assert unevenness_s(np.full(5, np.nan)) == 0


def test_a_diagram_of_a_whole_test_is_read_back(tmp_path):
    """A failure means that a long film's run cannot be reviewed: 60 000 frames are more pixels than a frame
    may have."""
    path = tmp_path / "kymograph.tif"
    tifffile.memmap(path, shape=(60_000, 1_800), dtype=np.float32, photometric="minisblack").flush()
    assert stored_kymograph(path)[2] == (60_000, 1_800)


@pytest.mark.parametrize("damage", ["no columns", "many widths"])
def test_a_diagram_of_a_senseless_width_is_damaged(tmp_path, damage):
    """A failure means that a damaged file ends in a traceback."""
    path = tmp_path / "kymograph.tif"
    tifffile.imwrite(path, np.ones((4, 6), np.float32))
    with tifffile.TiffFile(path) as tif:
        tag = tif.pages.first.tags["ImageWidth"]
        count, value = (1, 0) if damage == "no columns" else (9, 0)
    content = bytearray(path.read_bytes())
    content[tag.offset + 4 : tag.offset + 12] = struct.pack("<II", count, value)
    path.write_bytes(content)
    with pytest.raises(InputError, match="space-time diagram"):
        read_kymograph_tif(path, 4)
