"""What a run folder holds is written side by side, tables as other programs write them."""

import threading

import h5py
import numpy as np
import pytest
import xarray as xr

from tests.scenes import analysed
from vision.figures import drawing
from vision.pipeline import Analysis, Settings
from vision.run import Origin, provenance, tables, write_run, writing


@pytest.fixture(scope="module")
def found():
    seen = analysed.video_only()
    return Analysis(settings=Settings(), strip=seen.strip, tracks=seen.tracks)


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

    def stopped(*arguments):
        written(*arguments)
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
        if figure.name == "kymograph":
            both.set()
        return pixels

    monkeypatch.setattr(drawing, "render", drawn)
    monkeypatch.setattr(drawing, "write_png", lambda pixels, path: told.append((path.name, both.wait(20))))
    write_run(found, tmp_path / "run", Origin(command="track"), report=False)
    assert told == [("overview.png", True), ("kymograph.png", True)]
