"""`track --help`: complete, narrow and quick."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from vision.command.main import HELP, make_app, run
from vision.command.options import SETTING_OF, flag_of
from vision.command.track import run_name
from vision.data import STIFF_BELOW
from vision.sheets.settings import DEFAULT as TRACKING

ROOT = Path(__file__).parents[2]
HEAVY = {"pandas", "xarray", "matplotlib", "scipy", "skimage", "cv2", "av", "tifffile", "h5py"}
COMMANDS = [name for name in make_app() if not name.startswith("-")]
EXAMPLES = [line.strip() for line in HELP.splitlines() if line.startswith("    track ")]


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_help_fits_a_terminal_of_80_columns(command, capsys, monkeypatch):
    """A failure means that help wraps into a mess, or that a command is without words of its own."""
    monkeypatch.setenv("COLUMNS", "80")
    assert run([*command, "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines[2].strip()) > 30


def test_an_option_is_explained_without_line_breaks(capsys, monkeypatch):
    """A failure means that a line break of the source cuts a sentence in two where the terminal is wide."""
    monkeypatch.setenv("COLUMNS", "500")
    assert run(["--help"]) == 0
    assert not re.findall(r"^│ {4,}\S.*", capsys.readouterr().out, re.MULTILINE)


def test_help_and_readme_state_the_numbers_that_hold(capsys, monkeypatch):
    """A failure means that a default was changed, or an option added, and that the words for it were not."""
    monkeypatch.setenv("COLUMNS", "500")
    assert run(["--help"]) == 0
    said, readme = capsys.readouterr().out, (ROOT / "README.md").read_text(encoding="utf-8")
    window, (low, high) = TRACKING.standard_window_px, TRACKING.standard_widths_px
    assert f"{window} if ridges are {low:g} to {high:g} px wide" in said
    assert f"a sheet is stiff; {STIFF_BELOW:g} if not given" in said
    assert f"--window {window}`" in readme and f"--threshold {STIFF_BELOW:g}`" in readme
    assert [option for option in SETTING_OF if flag_of(option) not in readme] == []


def test_help_names_every_option_of_the_contract(capsys):
    """A failure means that a promised option is missing from the help."""
    assert run(["--help"]) == 0
    said = capsys.readouterr().out
    promised = (
        "strip columns sheets ridges axis fit window pixel-size fps timestamps frames rotate config out"
    )
    for option in [*promised.split(), "out", "overwrite", "quiet", "verbose"]:
        assert f"--{option}" in said


def test_help_shows_examples_and_every_command(capsys):
    """A failure means that the examples are swallowed, or that a command is a bare name."""
    assert run(["--help"]) == 0
    said = capsys.readouterr().out
    assert len(EXAMPLES) >= 4
    for example in EXAMPLES:
        assert example in said
    for command in COMMANDS:
        if make_app()[command].show:  # not those for a program, such as the Snakefile
            assert re.search(rf"{command} +[A-Z]\w+", said), command
    assert "NAME_tracks" in said


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_a_command_keeps_its_examples_and_arguments(command, capsys, monkeypatch):
    """A failure means that the parser of docstrings took some for those of another style and dropped them."""
    monkeypatch.setenv("COLUMNS", "500")
    assert run([command, "--help"]) == 0
    said = capsys.readouterr().out
    work = make_app()[command].default_command
    for example in re.findall(r"^ +(track .*)", work.__doc__, re.MULTILINE):
        assert example in said
    for explanation in re.findall(r"^ {8}(\S.*)", work.__doc__.partition("----\n")[2], re.MULTILINE):
        assert explanation.rstrip(".").replace("`", "") in said


def test_the_list_of_commands_has_the_first_line_of_their_help():
    """A failure means that `track --help` says something else of a command than its own help."""
    brief, whole = make_app(brief=True), make_app()
    shown = [name for name in COMMANDS if whole[name].show]
    assert len(shown) > 12
    assert [brief[name].help.splitlines()[0] for name in shown] == [
        whole[name].help.splitlines()[0] for name in shown
    ]


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_have_no_option_that_does_not_exist(example, tmp_path, capsys):
    """A failure means that the first command a reader copies is refused."""
    arguments = shlex.split(example)[1:]
    assert run([str(tmp_path / "none" / Path(arguments[0]).name), *arguments[1:]]) == 2
    assert re.search(r"no such file|found none", capsys.readouterr().err)


def test_help_groups_the_options_by_what_they_are_about(capsys):
    """A failure means that sixty options stand in one list."""
    assert run(["--help"]) == 0
    shown = capsys.readouterr().out
    titles = [
        shown.index(f"─ {name} ─")
        for name in ("Video", "Video with force", "Force recording", "Sample", "Run folder")
    ]
    assert titles == sorted(titles)
    assert titles[0] < shown.index("│ --scale") < titles[1] < shown.index("│ --offset") < titles[2]


def test_help_loads_nothing_heavy():
    """A failure means that `track --help` takes seconds."""
    code = (
        "import sys\n"
        "from vision.command.console import open_closed_streams; open_closed_streams()\n"
        "from vision.command.main import run; run(['--help'])\n"
        f"print(sorted({HEAVY!r} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize(
    ("given", "folder"),
    [
        ("a.b.tif", "a.b_tracks"),
        ("set [1].tif", "set [1]_tracks"),
        ("frames.v2", "frames.v2_tracks"),
        ("frames.v2/*.tif", "frames.v2_tracks"),
        ("frames.v2/cam_*.tif", "cam_tracks"),
        (".", "here_tracks"),
    ],
)
def test_the_run_folder_is_named_after_the_video(given, folder, tmp_path, monkeypatch):
    """A failure means that results go to a folder nobody looks for, such as `_tracks`."""
    place = tmp_path / "here"
    (place / "frames.v2").mkdir(parents=True)
    monkeypatch.chdir(place)
    for file in ("a.b.tif", "set [1].tif", "frames.v2/cam_1.tif"):
        (place / file).touch()
    assert f"{run_name(Path(given))}_tracks" == folder
