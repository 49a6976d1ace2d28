"""Exports, read back with the libraries of the programs they are for."""

from __future__ import annotations

import json
import warnings
from typing import get_args

import numpy as np
import openpyxl
import pandas as pd
import pytest
import roifile
import xarray as xr

from vision.errors import InputError
from vision.folder import write_json
from vision.run import export
from vision.run.export import (
    FILES,
    Format,
    export_run,
)
from vision.run.provenance import Parameter
from vision.run.reading import read_run
from vision.run.tables import sheets_table, write_tracks_nc

FRAMES, SIZE_UM = 12, 8.0
NAMES = ["left_2_um", "left_1_um", "right_1_um", "right_2_um"]


def make_tracks():
    """Four sheets; one missing for two frames, one frame lost."""
    rng = np.random.default_rng(3)
    x = np.array([40.0, 60.0, 80.0, 100.0]) + rng.normal(0, 1, (FRAMES, 4)).cumsum(axis=0)
    flag = np.full(x.shape, "ok", "<U8")
    flag[4:6, 1], flag[9] = "missing", "lost"
    x[flag != "ok"] = np.nan
    err = np.where(flag == "ok", 0.02, np.nan)
    one = {name: ("sheet", np.full(4, value)) for name, value in (("fwhm_px", 7.0), ("snr", 90.0))}
    return xr.Dataset(
        {
            "x_px": (("frame", "sheet"), x),
            "x_err_px": (("frame", "sheet"), err),
            "flag": (("frame", "sheet"), flag),
            "x_mean_px": ("sheet", np.nanmean(x, axis=0)),
            "found": ("sheet", (flag == "ok").mean(axis=0)),
            "x_noise_px": ("sheet", np.full(4, 0.02)),
            **one,
        },
        {
            "frame": np.arange(30, 30 + FRAMES),
            "time_s": ("frame", np.arange(30, 30 + FRAMES) / 25),
            "sheet": np.arange(4),
            "side": ("sheet", [-1, -1, 1, 1]),
            "n": ("sheet", [2, 1, 1, 2]),
        },
        {"strip_z0": 10, "strip_z1": 31},
    )


def make_run(folder, *, size=SIZE_UM, force=True):
    folder.mkdir()
    tracks = make_tracks()
    write_tracks_nc(tracks, folder / "tracks.nc", pixel_size_um=size)
    sheets_table(tracks).to_csv(folder / "sheets.csv", index=False)
    if force:
        events = pd.DataFrame({"event": [0, 1], "t_v_s": [1.5, 2.5], "dF_N": [8.25, np.nan]})
        events.assign(flag=["ok", "short"]).to_csv(folder / "events.csv", index=False)
        pd.DataFrame({"event": [0], "ratio": [np.inf]}).to_csv(folder / "deformation.csv", index=False)
        (folder / "clock.json").write_text(json.dumps({"offset_s": 3.5, "status": "ok"}))
    facts = {"command": "track \u00b5", "parameters": {"pixel_size": Parameter(size, "given")}}
    write_json(facts, folder / "run.json")
    return read_run(folder)


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return make_run(tmp_path / "film_tracks")


@pytest.fixture
def truth():
    return make_tracks()


def long(tracks, name):
    return tracks[name].values.ravel()


def check_tables(read, truth):
    """The tables of csv, xlsx and parquet: every row, its unit, its flag."""
    assert list(read) == ["tracks", "positions", "sheets", "events", "deformation", "settings"]
    tracks = read["tracks"]
    assert len(tracks) == 4 * FRAMES
    np.testing.assert_allclose(tracks["x_px"].astype(float), long(truth, "x_px"), atol=1e-4)
    np.testing.assert_allclose(tracks["x_um"].astype(float), SIZE_UM * long(truth, "x_px"), atol=1e-3)
    assert tracks["flag"].tolist() == long(truth, "flag").tolist()
    assert tracks["x_px"].isna().sum() == 6
    wide = read["positions"]
    assert list(wide.columns) == ["frame", "time_s", *NAMES]
    np.testing.assert_allclose(wide[NAMES].astype(float), SIZE_UM * truth["x_px"].values, atol=1e-3)
    np.testing.assert_allclose(wide["time_s"].astype(float), truth["time_s"].values)
    assert len(read["sheets"]) == 4
    assert read["events"]["dF_N"].astype(float)[0] == 8.25
    settings = read["settings"].set_index("name")["value"]
    assert settings["clock.offset_s"] == "3.5"
    assert settings["command"] == "track µ"
    assert settings["parameters.pixel_size.value"] == "8.0"


def test_csv_comes_back_with_pandas(run, truth):
    """A failure means numbers, units or flags lost on the way to a spreadsheet or to R."""
    folder = export_run(run, "csv")[0]
    assert folder.name == "film_tracks_csv"
    names = ["tracks", "positions", "sheets", "events", "deformation", "settings"]
    assert {p.name for p in folder.iterdir()} == {f"{name}.csv" for name in names} | {"run.json"}
    check_tables({name: pd.read_csv(folder / f"{name}.csv") for name in names}, truth)


def test_xlsx_comes_back_with_openpyxl(run, truth):
    """A failure means that a workbook is damaged, or its cells are not what was measured."""
    path = export_run(run, "xlsx")[0]
    assert path.name == "film_tracks.xlsx"
    book = openpyxl.load_workbook(path)
    read = {}
    for sheet in book:
        header, *rows = sheet.iter_rows(values_only=True)
        read[sheet.title] = pd.DataFrame(rows, columns=header)
        assert sheet.freeze_panes == "A2"
    check_tables(read, truth)
    assert book["tracks"]["F2"].data_type == "n"  # x_px is a number, no text
    assert book["deformation"]["B2"].value == "inf"  # a number that Excel does not know


def test_parquet_comes_back_with_pyarrow(run, truth):
    """A failure means that types or gaps are lost on the way to pandas, polars or R."""
    parquet = pytest.importorskip("pyarrow.parquet")
    folder = export_run(run, "parquet")[0]
    names = ["tracks", "positions", "sheets", "events", "deformation", "settings"]
    tables = {name: parquet.read_table(folder / f"{name}.parquet") for name in names}
    assert tables["tracks"]["x_px"].null_count == 6  # gaps are null, not NaN
    assert str(tables["tracks"].schema.field("frame").type) == "int64"
    check_tables({name: table.to_pandas() for name, table in tables.items()}, truth)


def test_mat_comes_back_with_scipy(run, truth):
    """A failure means that MATLAB sees transposed matrices, wrong flags or no events."""
    from scipy.io import loadmat

    data = loadmat(export_run(run, "mat")[0])
    np.testing.assert_array_equal(data["x_px"], truth["x_px"].values)
    np.testing.assert_allclose(data["x_um"], SIZE_UM * truth["x_px"].values)
    assert data["time_s"].shape == (FRAMES, 1)
    assert data["side"].tolist() == [[-1, -1, 1, 1]]
    names = [str(cell[0]) for cell in data["flag_names"][0]]
    flags = np.array(names)[data["flag"].astype(int) - 1]  # flag_names{flag}
    np.testing.assert_array_equal(flags, truth["flag"].values)
    assert data["pixel_size_um"].item() == SIZE_UM
    events = data["events"][0, 0]
    np.testing.assert_array_equal(events["dF_N"].ravel(), [8.25, np.nan])
    assert [str(cell[0]) for cell in events["flag"].ravel()] == ["ok", "short"]
    settings = data["settings"][0, 0]
    assert "clock.offset_s" in [str(cell[0]) for cell in settings["name"].ravel()]


def test_positions_in_parts_of_the_strip_are_exported_or_said_to_be_left_out(run, truth, tmp_path):
    """A failure means that x(n, z, t), which was asked for with --strips, is lost without a word."""
    from scipy.io import loadmat

    parts = truth["x_px"].values[..., None] + np.array([0.1, -0.1])
    dims = ("frame", "sheet", "z")
    more = truth.assign(x_z_px=(dims, parts), x_z_err_px=(dims, np.full(parts.shape, 0.03)))
    write_tracks_nc(more.assign_coords(z=[12.0, 26.0]), run.folder / "tracks.nc", pixel_size_um=SIZE_UM)
    with_parts = read_run(run.folder)
    path, left_out = export_run(with_parts, "mat")
    data = loadmat(path)
    np.testing.assert_allclose(data["x_z_px"], parts, atol=1e-4)
    assert data["z"].ravel().tolist() == [12, 26] and not left_out
    assert "tracks.nc" in export_run(with_parts, "csv")[1][0]


def test_coordinates_of_turned_frames_are_said(run, truth):
    """A failure means tracks that lie across the film in napari, or beside those of trackpy."""
    write_tracks_nc(truth.assign_attrs(rotate=90), run.folder / "tracks.nc", pixel_size_um=SIZE_UM)
    for to in ("trackpy", "napari"):
        assert "turned clockwise by 90 degrees" in export_run(read_run(run.folder), to, overwrite=True)[1][0]
    assert not export_run(read_run(run.folder), "mat", overwrite=True)[1]


def test_the_table_for_trackpy_is_the_truth(run, truth):
    """A failure means a missing column, an empty cell, or the positions of other sheets."""
    table = pd.read_csv(export_run(run, "trackpy")[0])
    assert set(table.columns) >= {"x", "y", "frame", "particle", "ep"}
    assert not table.isna().any(axis=None)
    assert len(table) == 4 * FRAMES - 6
    assert (table["y"] == 20).all()  # rows 10 to 30
    x = truth["x_px"].values
    matrix = table.pivot_table(index="frame", columns="particle", values="x").reindex(truth["frame"].values)
    np.testing.assert_allclose(matrix, x, atol=1e-4)


def test_trackpy_s_functions_take_the_table(run, truth):
    """A failure means that trackpy refuses the table or mixes up sheets and frames."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # trackpy's own, about its imports
        tp = pytest.importorskip("trackpy")
    table, x = pd.read_csv(export_run(run, "trackpy")[0]), truth["x_px"].values
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        drift = tp.compute_drift(table)
        kept = tp.filter_stubs(table, FRAMES - 1)
        msd = tp.imsd(table, mpp=SIZE_UM, fps=25)
    step = np.nanmean(np.diff(x[:9], axis=0), axis=1).cumsum()
    np.testing.assert_allclose(drift["x"].loc[31:38], step, atol=1e-3)
    assert set(kept["particle"]) == {0, 2, 3}  # the sheet that was missing twice is a stub
    first = SIZE_UM**2 * np.nanmean(np.diff(x[:, 0]) ** 2)
    assert msd[0].iloc[0] == pytest.approx(first, rel=1e-3)


def test_napari_s_rules_for_tracks_hold(run, truth):
    """A failure means that napari's tracks layer refuses the array: ids whole, sorted by id and time."""
    table = pd.read_csv(export_run(run, "napari")[0])
    assert list(table.columns) == ["track_id", "t", "y", "x"]
    data = table.to_numpy()
    assert np.isfinite(data).all()
    np.testing.assert_array_equal(data[:, 0], np.round(data[:, 0]))
    order = np.lexsort((data[:, 1], data[:, 0]))
    np.testing.assert_array_equal(order, np.arange(len(data)))
    assert not table.duplicated(["track_id", "t"]).any()
    back = table.pivot_table(index="t", columns="track_id", values="x").reindex(truth["frame"].values)
    np.testing.assert_allclose(back, truth["x_px"].values, atol=1e-4)


def test_imagej_shows_the_tracks_on_the_diagram(tmp_path, monkeypatch, truth):
    """A failure means tracks beside their ridges in Fiji, or a line across frames without a position."""
    monkeypatch.chdir(tmp_path)
    run = make_run(tmp_path / "film_tracks")
    run.parameters["columns"] = Parameter("15:120", "given")  # where kymograph.tif begins
    path = export_run(run, "imagej")[0]
    assert path.name == "film_tracks_rois.zip"
    rois = {roi.name: roi for roi in roifile.roiread(path)}
    assert list(rois) == [
        *("left_2", "left_2_2", "left_1", "left_1_2", "left_1_3"),
        *("right_1", "right_1_2", "right_2", "right_2_2"),
    ]
    assert {roi.roitype for roi in rois.values()} == {roifile.ROI_TYPE.POLYLINE}
    points = np.concatenate([rois[name].coordinates() for name in ("left_1", "left_1_2", "left_1_3")])
    rows = [0, 1, 2, 3, 6, 7, 8, 10, 11]
    np.testing.assert_array_equal(points[:, 1], rows)
    np.testing.assert_allclose(points[:, 0], truth["x_px"].values[rows, 1] - 15, atol=1e-4)


def test_without_a_pixel_size_everything_is_in_px(tmp_path, monkeypatch):
    """A failure means px in columns that say µm."""
    monkeypatch.chdir(tmp_path)
    run = make_run(tmp_path / "film_tracks", size=None, force=False)
    folder = export_run(run, "csv")[0]
    assert "left_2_px" in pd.read_csv(folder / "positions.csv").columns
    assert pd.read_csv(folder / "tracks.csv")["x_um"].isna().all()
    assert not (folder / "events.csv").exists()


def test_a_run_of_a_force_alone_exports_its_events(tmp_path, monkeypatch):
    """A failure means that `track force` results cannot leave the folder."""
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "pull_force")
    (tmp_path / "pull_force" / "tracks.nc").unlink()
    run = read_run(tmp_path / "pull_force")
    folder = export_run(run, "csv")[0]
    assert {p.stem for p in folder.iterdir()} == {"events", "deformation", "settings", "run"}
    from scipy.io import loadmat

    assert "events" in loadmat(export_run(run, "mat")[0])
    with pytest.raises(InputError, match=r"tracks\.nc"):
        export_run(run, "trackpy")
    assert not list(tmp_path.glob("*trackpy*"))


def test_a_table_too_long_for_a_worksheet_is_said(run, monkeypatch):
    """A failure means rows cut off without a word."""
    monkeypatch.setattr(export, "EXCEL_ROWS", 40)
    target, notes = export_run(run, "xlsx")
    assert "tracks: 48 rows" in notes[0]
    assert "tracks" not in openpyxl.load_workbook(target).sheetnames
    monkeypatch.setattr(export, "EXCEL_ROWS", 11)
    with pytest.raises(InputError, match="parquet"):
        export_run(run, "xlsx", overwrite=True)
    assert openpyxl.load_workbook(target).sheetnames  # the earlier one stands


def test_long_tables_are_written_in_parts(run, truth, monkeypatch):
    """A failure means rows lost or doubled between the parts of a long table."""
    monkeypatch.setattr(export, "CELL_ROWS_AT_ONCE", 7)
    rows = list(openpyxl.load_workbook(export_run(run, "xlsx")[0])["tracks"].values)[1:]
    assert [row[0] for row in rows] == np.repeat(truth["frame"].values, 4).tolist()


@pytest.mark.parametrize("to", get_args(Format))
def test_an_export_never_touches_what_is_there(run, to, tmp_path):
    """A failure means that an export destroys a run, an earlier export or another file."""
    first = export_run(run, to)[0]
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(InputError, match="overwrite"):
        export_run(run, to)
    with pytest.raises(InputError, match="outside the run"):
        export_run(run, to, out=run.folder / "tracks.csv", overwrite=True)
    with pytest.raises(InputError, match="run"):
        export_run(run, to, out=run.folder, overwrite=True)
    make_run(tmp_path / "other_tracks")
    with pytest.raises(InputError, match=r"another run|a folder"):
        export_run(run, to, out=tmp_path / "other_tracks", overwrite=True)
    assert {p: p.read_bytes() for p in before} == before
    assert export_run(run, to, overwrite=True)[0] == first
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize("to", FILES)
def test_a_failed_export_leaves_nothing(run, to, tmp_path, monkeypatch):
    """A failure means half a file that looks whole, or a traceback when the disk is full."""
    full = OSError(28, "No space left on device")

    def write(*_, **__):
        raise full

    monkeypatch.setitem(FILES, to, (FILES[to][0], write))
    with pytest.raises(InputError, match="a full disk"):
        export_run(run, to)
    assert [p.name for p in tmp_path.iterdir()] == ["film_tracks"]


@pytest.mark.parametrize("cell", ['=HYPERLINK("http://x")', "+1+1", "-x", "@SUM(A1)", " =1", "\t=1", "\r=1"])
def test_text_that_a_spreadsheet_would_run_is_quoted(cell, run, monkeypatch):
    """A failure means that the name of a film becomes a live formula in someone's spreadsheet."""
    table = pd.DataFrame({"name": [cell, "-1.5", "plain"], "x_px": [-1.0, 2.0, 3.0]})
    monkeypatch.setattr(export, "all_tables", lambda run: {"settings": table})
    back = pd.read_csv(export_run(run, "csv")[0] / "settings.csv", dtype=str)
    assert back["name"][0].startswith("'")
    assert back["name"].tolist()[1:] == ["-1.5", "plain"]
    assert back["x_px"].astype(float).tolist() == [-1, 2, 3]
    rows = list(openpyxl.load_workbook(export_run(run, "xlsx")[0])["settings"].rows)
    assert rows[1][0].data_type == "s"
    assert str(rows[1][0].value).startswith("'")
    assert rows[1][1].value == -1
