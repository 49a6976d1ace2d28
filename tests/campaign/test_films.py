"""Which films: every problem of every row, and films that a camera still writes."""

from __future__ import annotations

import openpyxl
import pytest

from tests.campaign.scenes import films, table
from tests.scenes.comb_video import frames_of, positions, write_video
from vision.campaign.films import FolderWatch, Row, read_campaign, safe_name
from vision.command.campaign import _checker
from vision.command.main import run
from vision.command.options import SETTING_OF
from vision.command.track import run_name
from vision.comparison.runs import _read_table
from vision.errors import InputError

# --- the table ----------------------------------------------------------------------------------------------


def read(path, config=None, awaited=None):
    return read_campaign(
        path, options=list(SETTING_OF), check=_checker(config), name_of=run_name, awaited=awaited
    )


def problems(path):
    return [(p.row, p.column, p.text) for p in read(path)[1]]


def test_a_row_is_a_test_with_its_options_and_its_facts(tmp_path):
    """A failure means that a test is analysed with settings that are not in its row."""
    films(tmp_path, 2)
    (tmp_path / "pull.txt").write_text("0 1\n")
    path = table(
        tmp_path / "tests.csv", ["t0.tif", "t1.tif"], fps=[20, 25], force=["pull.txt", ""], sample="old",
        V_mm_min=[1, 10], RH_percent=["", 43.5], notes='"first, dry"', **{"pixel-size": "0.01mm"},
    )  # fmt: skip
    rows, wrong = read(path)
    assert wrong == ()
    assert [row.name for row in rows] == ["t0", "t1"]
    assert [row.values["fps"] for row in rows] == [20, 25]
    assert rows[0].values["pixel_size"] == 10.0
    assert rows[0].options["force"] == str(tmp_path / "pull.txt")
    assert rows[1].values["force"] is None
    assert rows[1].facts == {"sample": "old", "V_mm_min": 10.0, "RH_percent": 43.5, "notes": "first, dry"}


def test_every_problem_of_every_row_in_one_table(tmp_path, capsys, monkeypatch):
    """A failure means that a table of a hundred rows is mended one error at a time."""
    monkeypatch.chdir(tmp_path)
    films(tmp_path, 3)
    path = tmp_path / "tests.csv"
    path.write_text(
        "film,humdity,fit,window,RH_percent,force,strip\n"
        "t0.tif,40,auto,9,40,,\n"
        "t3.tif,40,gauss,8x,140,no.txt,60:20\n"
        ",,,,,,\n"
        "t1.tif,,,,,,5\n"
        "t0.tif,,paper,11,40,,\n"
        ",,paper,,,,\n"
    )
    assert run(["campaign", "tests.csv"]) == 2
    said = capsys.readouterr().err.splitlines()
    for row, column, word in [
        (1, "humdity", "the nearest is RH_percent"),
        (3, "film", "found no such file; did you mean t2.tif?"),
        (3, "fit", "'gauss'"),
        (3, "window", "'8x'"),
        (3, "RH_percent", "from 0 to 100"),
        (3, "force", "no.txt: expected a file; found no such file; check the path"),
        (3, "strip", "A:B"),
        (5, "strip", "A:B"),
        (6, "film", "also in row 2, with another fit, window; give it in another table"),
        (7, "film", "an empty cell"),
    ]:
        wanted = [line for line in said if line.split()[1:3] == [str(row), column]]
        assert len(wanted) == 1, (row, column)
        assert word in wanted[0], wanted
    assert "10 problems in 5 rows, listed above; nothing was started" in said[-1]
    assert len(said) == 12
    assert not (tmp_path / "tests_campaign").exists()


@pytest.mark.parametrize(
    ("column", "nearest"),
    [("video", "film"), ("velocity", "V_mm_min"), ("pixelsize", "pixel_size"), ("forse", "force"),
     ("Temperature", "T_C"), ("sheets_per_blok", "sheets_per_block"), ("d_0", "d0")],
)  # fmt: skip
def test_the_nearest_name_of_an_unknown_column(tmp_path, column, nearest):
    """A failure means that a misspelt column is refused without a hint, or with a wrong one."""
    films(tmp_path, 1)
    found = problems(table(tmp_path / "t.csv", ["t0.tif"], **{column: 1}))
    assert [text.endswith(f"the nearest is {nearest}") for _, _, text in found] == [True]


def test_values_are_checked_as_on_the_command_line(tmp_path):
    """Combinations, too: the pixel size has one source."""
    films(tmp_path, 2)
    path = table(tmp_path / "t.csv", ["t0.tif", "t1.tif"], pitch=["0.2mm", ""], pixel_size=["10", "ten"])
    found = problems(path)
    assert [(row, column) for row, column, _ in found] == [(2, ""), (3, "pixel_size")]
    assert "one of --pixel-size, --scale and --pitch" in found[0][2]


def test_the_length_of_a_name_counts_bytes_as_the_disk_does(tmp_path):
    """A failure means a run folder that no disk can hold, or a message with which the name fits already."""
    films(tmp_path, 2)
    ((_, column, text),) = problems(
        table(tmp_path / "t.csv", ["t0.tif", "t1.tif"], name=["é" * 75, "é" * 76])
    )
    assert (column, "at most 150 bytes" in text, "found 152" in text) == ("name", True, True)


def test_semicolons_and_decimal_commas(tmp_path):
    """As a German spreadsheet saves it."""
    films(tmp_path, 1)
    (tmp_path / "t.csv").write_text("\ufefffilm;RH_percent;fps\nt0.tif;43,5;29,97\n", encoding="utf-8")
    rows, wrong = read(tmp_path / "t.csv")
    assert wrong == ()
    assert rows[0].facts["RH_percent"] == 43.5
    assert rows[0].values["fps"] == 29.97


TABLE = [
    ["film", "sample", "RH_percent", "d0", "fit_range", "fps", "pixel_size", "notes"],
    ["t0,1.tif", "feucht für", "43,5", "16,6±0,1", "13,2:17,5", "29,97", "10,5µm", "1,5 mm, dann 3"],
]


@pytest.mark.parametrize("kind", ["cp1252", "utf-16", "xlsx", "numbers.xlsx"])
def test_tables_of_spreadsheets_as_they_are_saved(kind, tmp_path):
    """A failure means that a table must be saved in another form, or that its decimal commas are refused."""
    films(tmp_path, 1)
    (tmp_path / "t0.tif").rename(tmp_path / "t0,1.tif")
    path = tmp_path / f"t.{kind}"
    if kind.endswith("xlsx"):
        book = openpyxl.Workbook()
        sheet = book.create_sheet("tests")  # the first one is empty
        cells = [43.5 if cell == "43,5" and "numbers" in kind else cell for cell in TABLE[1]]
        for row in (TABLE[0], [], cells):
            sheet.append(row)
        book.save(path)
    else:
        path.write_bytes("\r\n".join(map(";".join, TABLE)).encode(kind))
    (row,), wrong = read(path)
    assert wrong == ()
    assert row.row == (3 if kind.endswith("xlsx") else 2)
    assert row.facts == {"sample": "feucht für", "RH_percent": 43.5, "notes": "1,5 mm, dann 3"}
    assert row.film == str(tmp_path / "t0,1.tif")
    assert (row.values["d0"], row.values["fit_range"]) == ("16.6±0.1", "13.2:17.5")
    assert (row.values["fps"], row.values["pixel_size"]) == (29.97, 10.5)
    _, warnings = _read_table(path)[1:]
    assert "fps" in warnings[0]  # the table of `compare` is read alike


def test_films_of_one_name_need_names(tmp_path):
    """A failure means that one film's run replaces another's."""
    films(tmp_path / "a", 1), films(tmp_path / "b", 1)
    path = table(tmp_path / "t.csv", ["a/t0.tif", "b/t0.tif"])
    assert [(row, column) for row, column, _ in problems(path)] == [(3, "name")]
    rows, wrong = read(table(tmp_path / "t.csv", ["a/t0.tif", "b/t0.tif"], name=["dry", "humid"]))
    assert wrong == ()
    assert [row.name for row in rows] == ["dry", "humid"]


def test_a_folder_of_films_is_read_as_by_track(tmp_path):
    """A failure means that the picture of a preview beside a film is tracked as a film of one frame."""
    films(tmp_path / "day", 1)
    (tmp_path / "day" / "t0.tif").rename(tmp_path / "day" / "pull.avi")
    (tmp_path / "day" / "pull_preview.png").write_bytes(b"")
    (tmp_path / "day" / "raw.avi").mkdir()  # no film
    rows, wrong = read(table(tmp_path / "t.csv", ["day"]))
    assert wrong == ()
    assert (rows[0].film, rows[0].name) == (str(tmp_path / "day" / "pull.avi"), "pull")
    (tmp_path / "day" / "push.avi").write_bytes(b"")
    ((row, column, text),) = problems(tmp_path / "t.csv")
    assert (row, column) == (2, "film")
    assert "expected one film; found 2; name one of them" in text


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "an empty file"),
        (b"film\n", "1 line"),
        (b"film\x00\x01\n", "a binary file"),
        (b'film\n"open', "a quotation mark is never closed"),
    ],
)
def test_what_is_no_table(tmp_path, content, word):
    """A failure means that a file of another kind ends in a traceback, or starts an empty campaign."""
    (tmp_path / "t.csv").write_bytes(content)
    with pytest.raises(InputError, match=word):
        read(tmp_path / "t.csv")


def test_films_that_are_still_to_come(tmp_path, monkeypatch):
    """While a folder is watched, its films need not be there; those elsewhere must."""
    path = table(tmp_path / "t.csv", ["cam/t0.tif", "t1.tif"], force=["cam/f.txt", "f.txt"])
    (tmp_path / "cam").mkdir()
    assert [(p.row, p.column) for p in read(path, awaited=tmp_path / "cam")[1]] == [(3, "film"), (3, "force")]
    assert len(read(path)[1]) == 4
    for name in ("a.avi", "b.avi"):  # the folder itself names no single film, nor does an empty cell
        (tmp_path / "cam" / name).touch()
    path = table(tmp_path / "u.csv", ["cam", ""], name=["one", "two"])
    monkeypatch.chdir(tmp_path)
    for awaited in (tmp_path / "cam", tmp_path):
        assert [(p.row, p.column) for p in read(path, awaited=awaited)[1]] == [(2, "film"), (3, "film")]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ([], "a table of tests, or a folder to watch"),
        (["t.csv", "--cores", "0"], "--cores: expected a number from 1"),
        (["t.csv", "--idle", "nan", "--watch", "."], "--idle"),
        (["t.csv", "--executor", "pbs"], "local"),
        (["t.csv", "--profile", "gone"], "--profile: expected a folder with a Snakemake profile"),
        (["t.csv", "--config", "gone.toml"], "gone.toml"),
        (["t.csv", "--watch", "gone"], "a folder to watch"),
        (["gone.csv"], "gone.csv: expected a CSV or Excel table with a column film"),
        (["t.csv", "--out", "t.csv"], "found a file"),
    ],
)
def test_bad_arguments_end_in_one_line(tmp_path, monkeypatch, capsys, arguments, word):
    """A failure means that a wrong argument is found only after a folder was made, or is a traceback."""
    monkeypatch.chdir(tmp_path)
    films(tmp_path, 1)
    table(tmp_path / "t.csv", ["t0.tif"], fps=20)
    assert run(["campaign", *arguments]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert word in said[0]
    assert not list(tmp_path.glob("*_campaign"))


def test_names_are_one_part_of_a_path_and_one_line():
    """A failure means that the name of a film leads out of the folder of the runs."""
    assert safe_name("a/b\\c\n<d>:e") == "a_b_c__d__e"
    assert safe_name("..") == "film"


# --- a folder that is watched -------------------------------------------------------------------------------


class Clock:
    """Seconds that a test sets."""

    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def complete(watch):
    return [film.name for film in watch.films() if watch.complete(film)]


def test_a_film_is_taken_when_it_stands_still(tmp_path, clock):
    """A failure means that half a film is analysed, or that a film is never taken."""
    watch = FolderWatch(tmp_path, clock)
    whole = write_video(tmp_path / "whole.tif", frames_of(positions(30))).read_bytes()
    film = tmp_path / "film.tif"
    film.write_bytes(whole[:20_000])
    (tmp_path / "notes.txt").write_text("no film")
    (tmp_path / ".hidden.tif").write_bytes(whole)
    assert complete(watch) == []
    clock.now = 8.0
    film.write_bytes(whole[:40_000])  # the camera goes on
    assert complete(watch) == []
    clock.now = 11.0
    assert complete(watch) == ["whole.tif"]
    film.write_bytes(whole)
    assert complete(watch) == ["whole.tif"]
    clock.now = 30.0
    assert complete(watch) == ["film.tif", "whole.tif"]


def test_a_cut_film_is_taken_in_the_end(tmp_path, clock):
    """The camera's computer failed: nobody will finish this film, and it should be named."""
    watch = FolderWatch(tmp_path, clock)
    content = write_video(tmp_path / "t.tif", frames_of(positions(30))).read_bytes()
    (tmp_path / "t.tif").write_bytes(content[:30_000])
    assert complete(watch) == []
    clock.now = 300.0
    assert complete(watch) == []  # it stands still, but its pages are not all there
    clock.now = 601.0
    assert complete(watch) == ["t.tif"]


def test_two_files_of_one_recording_come_together(tmp_path, clock):
    """A failure means that frames are analysed before the file that says what they are has come."""
    watch = FolderWatch(tmp_path, clock)
    (tmp_path / "p.mraw").write_bytes(bytes(100))
    clock.now = 700.0
    assert complete(watch) == []


def test_rows_wait_for_all_their_files(tmp_path, clock):
    """A failure means that a film is analysed without the force recording that its row names."""
    watch = FolderWatch(tmp_path, clock)
    film = write_video(tmp_path / "t.tif", frames_of(positions(30)))
    for name in ("t.tiff", "other.tif"):
        (tmp_path / name).write_bytes(film.read_bytes())
    row = Row(row=2, film=str(film), name="t", options={"force": str(tmp_path / "t.txt")})

    def new(path):
        return Row(row=0, film=str(path), name=path.stem)

    def names():
        return sorted(ready.name for ready in watch.rows([row], new))

    assert names() == []
    clock.now = 20.0
    assert names() == ["other", "t.tiff"]  # "t" is the row's
    (tmp_path / "t.txt").write_text("0 1\n")
    assert names() == ["other", "t.tiff"]
    clock.now = 40.0
    assert names() == ["other", "t", "t.tiff"]


@pytest.mark.thorough
def test_a_wrong_table_is_told_in_few_lines(tmp_path, capsys):
    """A failure means thousands of lines for a table that is no campaign, or that has many wrong rows."""
    path = tmp_path / "tracks.csv"
    path.write_text("frame,x_px\n" + "0,1\n" * 5000)
    assert run(["campaign", str(path), "--dry-run"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "expected a column film" in line
    path.write_text("film\n" + "".join(f"gone{k}.avi\n" for k in range(25)))
    assert run(["campaign", str(path), "--dry-run"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 13
    assert lines[-2].endswith("and 15 more")
