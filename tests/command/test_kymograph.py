"""`track kymograph` as typed: files, calibration, slips, messages."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import tifffile
import xarray as xr

from tests.scenes.comb_video import frames_of, positions, write_video
from tests.scenes.undrawn import undrawn
from vision.command import views
from vision.command.main import run
from vision.command.options import VideoOptions, WindowOptions
from vision.figures import Results
from vision.run.reading import read_run

SHEET, COLUMN = ["--sheet", "right:4"], 7  # the outermost on the right


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A video and its run, made once."""
    folder = tmp_path_factory.mktemp("made")
    video = write_video(folder / "comb.tif")
    options = ["--fps", "20", "--pixel-size", "10", "--columns", "10:170", "--quiet"]
    with undrawn():
        assert run([str(video), *options, "--out", str(folder / "comb_tracks")]) == 0
    return folder


@pytest.fixture
def there(made, tmp_path, monkeypatch):
    """A copy of them in the working directory."""
    shutil.copytree(made, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def grey_of(path):
    """Grey levels and calibration by the TIFF's own metadata."""
    with tifffile.TiffFile(path) as file:
        facts, tags, numbers = file.imagej_metadata, file.pages[0].tags, file.asarray()
    size = [1 / np.divide(*tags[name].value) for name in ("XResolution", "YResolution")]
    assert numbers.dtype == np.uint16
    return facts["c0"] + facts["c1"] * numbers, size, (-facts["xorigin"], -facts["yorigin"])


def ridge_px(grey, first):
    """Centre of mass of the ridge in every row, columns of the video."""
    above = np.clip(grey - 60, 0, None)
    return (above * (first + np.arange(grey.shape[1]))).sum(axis=1) / above.sum(axis=1)


def test_a_run_s_sheet_opens_in_fiji_with_its_motion(there, capsys):
    """A failure means that lengths, times or the sheet itself are wrong in Fiji."""
    assert run(["kymograph", "comb_tracks", *SHEET, "--width", "0.2mm", "--time", "0.5:2.5"]) == 0
    folder = Path("comb_tracks_kymograph")
    assert {p.name for p in folder.iterdir()} == {"kymograph_right4.tif", "kymograph.png", "run.json"}
    grey, size, (column, row) = grey_of(folder / "kymograph_right4.tif")
    assert grey.shape == (40, 20)
    assert size == pytest.approx([10, 0.05])
    assert row == pytest.approx(10)
    # noise of the film, and the ridge's flanks cut by the window
    np.testing.assert_allclose(ridge_px(grey, column), positions()[10:50, COLUMN], atol=0.3)
    assert "40 frames x 20 px, 10 µm per px" in capsys.readouterr().out


@pytest.mark.usefixtures("no_picture")
def test_grey_levels_are_those_of_the_run(there):
    """A failure means that intensities change on the way through a run folder."""
    assert run(["kymograph", "comb_tracks", "--columns", "40:100", "--quiet"]) == 0
    grey, _, (column, _) = grey_of("comb_tracks_kymograph/kymograph_strip.tif")
    assert column == 40
    kept = tifffile.imread("comb_tracks/kymograph.tif")[:, 30:90]
    np.testing.assert_allclose(grey, kept, atol=0.51 * 255 / 65534)
    assert np.abs(grey - tifffile.imread("comb_tracks/kymograph.tif")[:, 31:91]).max() > 10


@pytest.mark.usefixtures("no_picture")
def test_a_video_gives_what_its_run_gives(there):
    """A failure means that the two ways to a diagram disagree."""
    options = [*SHEET, "--width", "20px", "--frames", "5:55", "--quiet"]
    assert run(["kymograph", "comb_tracks", *options]) == 0
    reading = ["--fps", "20", "--pixel-size", "10", "--columns", "10:170"]
    assert run(["kymograph", "comb.tif", *options, *reading]) == 0
    from_run = grey_of("comb_tracks_kymograph/kymograph_right4.tif")
    from_video = grey_of("comb_kymograph/kymograph_right4.tif")
    np.testing.assert_array_equal(from_run[0], from_video[0])
    assert from_run[1:] == from_video[1:]


@pytest.mark.usefixtures("no_picture")
def test_following_keeps_the_sheet_in_the_middle(there):
    """A failure means that --follow does nothing."""
    assert run(["kymograph", "comb_tracks", *SHEET, "--width", "19px", "--follow", "--quiet"]) == 0
    grey, _, (column, _) = grey_of("comb_tracks_kymograph/kymograph_right4.tif")
    np.testing.assert_allclose(ridge_px(grey, column), 0, atol=0.06)
    assert np.ptp(positions()[:, COLUMN]) > 3


def test_several_sheets_each_have_a_tiff_and_share_a_picture(there):
    """A failure means that the publication's figure cannot be made in one go."""
    options = ["--sheet", "right:4,left:1", "--sheet", "3", "--picture", "pdf", "--quiet"]
    assert run(["kymograph", "comb_tracks", *options, "--out", "figure"]) == 0
    names = {p.name for p in Path("figure").iterdir()}
    assert names == {"kymograph_right4.tif", "kymograph_left1.tif", "kymograph.pdf", "run.json"}
    same = json.loads(Path("figure/run.json").read_text())["diagrams"]
    assert [d["sheet"] for d in same] == ["right:4", "left:1"]  # index 3 is left:1, drawn once


def test_without_a_pixel_size_the_window_is_one_pitch(there):
    """A failure means a window of a made-up width, or µm without a scale."""
    assert run(["kymograph", "comb.tif", *SHEET, "--quiet"]) == 0
    grey, size, _ = grey_of("comb_kymograph/kymograph_right4.tif")
    assert grey.shape == (60, 20)  # the comb's pitch is 20 px
    assert size[0] == 1


def give_events(folder, status="ok"):
    """Slips of the comb film at 1, 2 and 2.96 s, on a force clock 7 s ahead that runs 1000 ppm fast."""
    slips = np.array([1.0, 2.0, 2.96, 55.0])
    events = pd.DataFrame({"event": range(4), "t_p_s": 7 + slips * 1.001})
    events.assign(t_v_s=events["t_p_s"] - 0.5, stick_length_um=9.0).to_csv(folder / "events.csv", index=False)
    clock = {"offset_s": 7.0, "drift_ppm": 1000.0, "status": status, "how": "events"}
    clock |= {"unmatched_video": 0, "unmatched_force": 0}
    (folder / "clock.json").write_text(json.dumps(clock))
    return slips


@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize(("status", "known"), [("ok", True), ("given", True), ("ambiguous", False)])
def test_slips_are_moved_to_the_video_s_clock_where_it_is_sure(there, status, known, capsys):
    """A failure means slips marked at the wrong time, or by a clock that may be wrong."""
    folder = Path("comb_tracks")
    slips, made = give_events(folder, status), read_run(folder)
    found = Results(sticks=made.table("events"), clock=made.clock).slips.time_s
    if known:
        np.testing.assert_allclose(found, slips, atol=1e-9)
    else:
        assert found is None
    assert run(["kymograph", "comb_tracks"]) == 0
    # without a sure clock the two jumps of the film are seen by the sheets alone
    marked = "3 in the part shown, from the force" if known else "2 in the part shown, from the sheets"
    assert marked in capsys.readouterr().out


@pytest.mark.usefixtures("no_picture")
def test_without_a_force_the_sheets_own_jumps_are_marked(there, capsys):
    """A failure means no marks, or marks at the wrong frames, in a run without force."""
    for part, jumps in (("0:19", 0), ("0:22", 1), ("0:60", 2), ("22:38", 0), ("42:60", 0)):
        assert run(["kymograph", "comb_tracks", "--frames", part, "--overwrite"]) == 0
        assert f"{jumps} in the part shown, from the sheets" in capsys.readouterr().out
    assert run(["kymograph", "comb.tif"]) == 0
    assert "not known" in capsys.readouterr().out  # no sheet asked for, so none tracked


@pytest.mark.usefixtures("no_picture")
def test_jumps_are_not_marked_where_outward_is_a_guess(there, capsys):
    """A failure means marks in a recording whose sheets need not move outwards at all."""
    still = np.repeat(positions()[:1], 60, axis=0)
    write_video(there / "still.tif", frames_of(still))
    assert run(["kymograph", "still.tif", *SHEET, "--fps", "20"]) == 1  # with a warning: nothing moves
    assert "not known" in capsys.readouterr().out
    kept = " ".join(json.loads(Path("still_kymograph/run.json").read_text())["warnings"])
    assert ("--frames" in kept, "`" in kept) == (True, False), kept
    assert run(["kymograph", "still.tif", *SHEET, "--fps", "20", "--axis", "90", "--overwrite"]) == 1
    assert "0 in the part shown" in capsys.readouterr().out


@pytest.mark.usefixtures("no_picture")
def test_run_json_traces_the_diagram_back(there):
    """A failure means that a figure in a paper cannot be made again."""
    assert run(["kymograph", "comb_tracks", *SHEET, "--quiet"]) == 0
    facts = json.loads(Path("comb_tracks_kymograph/run.json").read_text())
    assert facts["parameters"]["sheet"] == {"value": ["right:4"], "how": "given"}
    assert facts["parameters"]["follow"]["how"] == "default"
    assert {Path(i["path"]).name for i in facts["inputs"]} == {"kymograph.tif", "tracks.nc"}
    assert facts["diagrams"][0]["frames"] == [0, 59]
    assert facts["diagrams"][0]["s_per_row"] == pytest.approx(0.05)


@pytest.mark.usefixtures("no_picture")
def test_a_lost_frame_is_empty_and_sets_the_exit_status(there, capsys):
    """A failure means that a lost frame passes for a black one, or goes unnoticed."""
    pixels = frames_of(positions())
    pixels[30] = 255
    write_video(there / "blank.tif", pixels)
    assert run(["kymograph", "blank.tif", "--quiet"]) == 1
    assert "blank" in capsys.readouterr().err
    numbers = tifffile.imread("blank_kymograph/kymograph_strip.tif")
    assert (numbers == 0).all(axis=1).nonzero()[0].tolist() == [30]
    assert run(["blank.tif", "--quiet"]) == 1
    capsys.readouterr()
    assert run(["kymograph", "blank_tracks", *SHEET, "--quiet"]) == 1
    assert "1 of 60 frames shown are empty" in capsys.readouterr().err


@pytest.mark.usefixtures("no_picture")
def test_frames_without_the_sheet_are_counted(there, capsys):
    """A failure means that a window around a guessed place passes for a measured one."""
    with xr.open_dataset("comb_tracks/tracks.nc", engine="h5netcdf") as data:
        tracks = data.load()
    tracks["x_px"][20:23, COLUMN] = np.nan
    tracks.to_netcdf("comb_tracks/tracks.nc", engine="h5netcdf")
    assert run(["kymograph", "comb_tracks", *SHEET, "--quiet"]) == 1
    assert "right:4: not found in 3 of 60" in capsys.readouterr().err


def test_uneven_times_are_said(there, capsys):
    """A failure means a wrong time axis in Fiji without a word."""
    times = np.arange(60) / 20
    times[40:] += 0.7
    Path("stamps.txt").write_text("\n".join(map(str, times)))
    assert run(["kymograph", "comb.tif", "--timestamps", "stamps.txt", "--quiet"]) == 1
    assert "uneven: the TIFF's time axis is off by up to 0.7 s" in capsys.readouterr().err


RUN = "comb_tracks"
BAD = {
    "no such file": (["nothing.avi"], "nothing.avi"),
    "no run and no images": (["empty"], "empty"),
    "no such sheet": ([RUN, "--sheet", "right:9"], "right:1 to right:4"),
    "sheet without a number": ([RUN, "--sheet", "right"], "'right'"),
    "sheet zero": ([RUN, "--sheet", "left:0"], "'left:0'"),
    "width without a unit": ([RUN, *SHEET, "--width", "200"], "'200'"),
    "width in inches": ([RUN, *SHEET, "--width", "1in"], "'1in'"),
    "no width at all": ([RUN, *SHEET, "--width", "0mm"], "'0mm'"),
    "wider than the strip": ([RUN, *SHEET, "--width", "9mm"], "1 to 160 px"),
    "width without a sheet": ([RUN, "--width", "0.2mm"], "--width"),
    "follow without a sheet": ([RUN, "--follow"], "--follow"),
    "µm without a scale": (["comb.tif", *SHEET, "--width", "0.2mm"], "--pixel-size"),
    "time is no range": ([RUN, "--time", "5"], "--time"),
    "time backwards": ([RUN, "--time", "2:1"], "--time"),
    "time outside": ([RUN, "--time", "50:60"], "2.95 s"),
    "frames outside": ([RUN, "--frames", "60:70"], "frames 0 to 59"),
    "frames are no range": ([RUN, "--frames", "x"], "--frames"),
    "columns outside": ([RUN, "--columns", "400:500"], "10:170"),
    "a run is not read again": ([RUN, "--fps", "30"], "--fps"),
    "negative pixel size": ([RUN, "--pixel-size", "-1"], "--pixel-size"),
    "damaged tracks": (["broken"], "tracks.nc"),
    "damaged diagram": (["cut"], "kymograph.tif"),
    "a diagram of other tracks": (["other"], "kymograph.tif"),
    "damaged facts": (["odd"], "run.json"),
    "events without times": (["timeless"], "events.csv"),
    "run of a force alone": (["force"], "tracks.nc"),
}


def test_a_width_without_a_scale_is_refused_before_the_film_is_read(there, monkeypatch, refused):
    """A failure means that a long film is tracked first, only to say that a pixel size was needed."""

    def read(*arguments, **options):
        raise AssertionError("the film was read")

    monkeypatch.setattr(views, "_from_video", read)
    assert "mm needs --pixel-size" in refused("kymograph", "comb.tif", *SHEET, "--width", "0.2mm")
    with pytest.raises(AssertionError, match="the film was read"):
        views.kymograph(
            there / "comb.tif",
            WindowOptions(sheet=("right:4",), width="0.2mm"),
            VideoOptions(pixel_size="10"),
        )


@pytest.fixture
def damaged(there):
    """Run folders with one damaged file each."""
    (there / "empty").mkdir()
    for name in ("broken", "cut", "other", "odd", "timeless", "force"):
        shutil.copytree(there / RUN, there / name)
    (there / "broken" / "tracks.nc").write_bytes(b"nothing of the kind")
    whole = (there / "cut" / "kymograph.tif").read_bytes()
    (there / "cut" / "kymograph.tif").write_bytes(whole[: len(whole) // 2])
    tifffile.imwrite(there / "other" / "kymograph.tif", np.zeros((7, 160), np.float32))
    (there / "odd" / "run.json").write_text("{")
    (there / "timeless" / "events.csv").write_text("event\n1\n")
    (there / "force" / "tracks.nc").unlink()
    return there


@pytest.mark.thorough
@pytest.mark.parametrize("case", BAD)
def test_bad_input_ends_in_one_line_and_status_2(case, damaged, refused):
    """A failure means a traceback, a silent guess or half a result for bad input."""
    arguments, named = BAD[case]
    assert named in refused("kymograph", *arguments)


@pytest.mark.usefixtures("no_picture")
def test_earlier_diagrams_and_the_run_itself_are_kept(there, refused, capsys):
    """A failure means that results are overwritten."""
    assert run(["kymograph", RUN, "--quiet"]) == 0
    assert "--overwrite" in refused("kymograph", RUN, "--quiet")
    assert run(["kymograph", RUN, "--quiet", "--frames", "0:9", "--overwrite"]) == 0
    assert tifffile.imread("comb_tracks_kymograph/kymograph_strip.tif").shape[0] == 9
    capsys.readouterr()
    assert "another run" in refused("kymograph", RUN, "--quiet", "--out", RUN, "--overwrite")
    assert Path(RUN, "tracks.csv").exists()
