"""Lengths, seconds and sheets as typed; options from a file."""

import os
from pathlib import Path

import pytest

from vision.command import options
from vision.command.main import run
from vision.command.options import GROUPS, SampleOptions, VideoOptions, option_names
from vision.command.settings import (
    merged,
    parse_duration,
    parse_pair,
    parse_pitch,
    parse_pixel_size,
    parse_scale,
    parse_seconds,
    parse_sheets,
    parse_width,
    parse_with_error,
    settings_of,
)
from vision.errors import InputError, with_options
from vision.pipeline import Settings


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("0.2mm", {"width_um": 200}),
        ("200um", {"width_um": 200}),
        ("200 µm", {"width_um": 200}),  # micro sign
        ("200μm", {"width_um": 200}),  # Greek mu
        ("2e-1 mm", {"width_um": 200}),
        ("20px", {"width_px": 20}),
    ],
)
def test_a_length_is_its_number_times_its_unit(text, meant):
    """A failure means a window a thousand times too wide or too narrow."""
    assert parse_width(text) == pytest.approx(meant)


@pytest.mark.parametrize("text", ["200", "mm", "-1mm", "0px", "1e400px", "1.2.3mm", "20 nm", "", "nan px"])
def test_a_length_without_sense_is_refused(text):
    """A failure means that a unit is guessed."""
    with pytest.raises(InputError, match="--width"):
        parse_width(text)


@pytest.mark.parametrize("text", ["1mm=103px", "103 px = 1 mm", "1000um=103px", "0.05cm=51.5px"])
def test_a_scale_is_its_length_over_its_pixels(text):
    """A failure means a pixel size upside down, or a unit ignored."""
    assert parse_scale(text) == (pytest.approx(1000 / 103), None)


@pytest.mark.parametrize(
    "text",
    ["1mm", "103px", "1=103", "1mm=0px", "1mm=2mm", "1px=2px", "1mm=2px=3px", "", "1mm=103±px", "1±-1mm=9px"],
)
def test_a_scale_without_sense_is_refused(text):
    """A failure means that lengths are scaled by a guess."""
    with pytest.raises(InputError, match="--scale"):
        parse_scale(text)


@pytest.mark.parametrize(
    ("typed", "size", "error"),
    [
        ({"pixel_size": "10±0.1"}, 10, 0.1),
        ({"pixel_size": "10+-0.1um"}, 10, 0.1),
        ({"pixel_size": "0.01 +/- 0.0001 mm/px"}, 10, 0.1),
        ({"scale": "1mm=100±1px"}, 10, 0.1),
        ({"scale": "100px = 1±0.01mm"}, 10, 0.1),
        ({"scale": "1±0.03mm=100±4px"}, 10, 0.5),
        ({"pixel_size": "10"}, 10, None),
    ],
)
def test_a_pixel_size_has_its_error(typed, size, error):
    """A failure means an error of the scale that is refused, or in another unit than its value."""
    read = settings_of(merged(*(group() for group in GROUPS[1:]), VideoOptions(**typed)))
    assert read.pixel_size_um == pytest.approx(size)
    assert read.pixel_size_err_um == (None if error is None else pytest.approx(error))
    assert parse_pitch("0.2±0.002mm") == pytest.approx((200, 2))


@pytest.mark.parametrize("text", ["10±", "±1", "10±20", "10±x", "10±-1", "10px", "10±1±1", "nan", "10 ± inf"])
def test_a_pixel_size_with_a_senseless_error_is_refused(text):
    """A failure means that a typing error becomes a scale."""
    with pytest.raises(InputError, match="--pixel-size"):
        parse_pixel_size(text)


def test_a_pixel_size_typed_goes_before_another_kind_in_the_file(tmp_path):
    """A failure means that a file's pixel size is used though a scale was typed, or both are refused."""
    config = tmp_path / "run.toml"
    config.write_text("pixel-size = '10um'\n")
    options = merged(VideoOptions(scale="1mm=50px"), config=config)
    assert (options["pixel_size"].value, options["pixel_size"].how) == (20, "given")
    assert merged(VideoOptions(), config=config)["pixel_size"].value == 10
    config.write_text("pixel-size = '10um'\npitch = '0.2mm'\n")
    with pytest.raises(InputError, match="one of"):
        merged(VideoOptions(), config=config)


def test_seconds_are_half_open_with_open_ends():
    """A failure means another part of the recording than asked for."""
    assert parse_seconds("40:45.1") == (40, 45.1)
    assert parse_seconds("-1.5:") == (-1.5, None)
    assert parse_seconds(":3") == (None, 3)
    assert parse_seconds(None) is None


@pytest.mark.parametrize("text", ["5", ":", "2:1", "1:1", "a:b", "1:nan", "1:2:3", "inf:"])
def test_seconds_that_are_no_range_are_refused(text):
    """A failure means an empty or a wrong part without a word."""
    with pytest.raises(InputError, match="--time"):
        parse_seconds(text)


def test_sheets_are_sides_and_numbers_or_indices():
    """A failure means another sheet than asked for."""
    assert parse_sheets(["right:23,left:1", " 47 "]) == [("right", 23), ("left", 1), 47]
    assert parse_sheets(()) == []


@pytest.mark.parametrize(
    "text", ["right", "right:", "right:0", "middle:3", "-1", "right:2.5", "right:1,", ""]
)
def test_sheets_that_cannot_be_are_refused(text):
    """A failure means that a typing error picks some sheet."""
    with pytest.raises(InputError, match="--sheet"):
        parse_sheets([text])


@pytest.mark.parametrize("text", ["1.5", "9" * 400, "²", "1e400", "nan", "0x10", "", "-3", "true"])
@pytest.mark.parametrize("option", ["--sheets", "--sheets-per-block"])
def test_a_number_of_sheets_is_whole(option, text, tmp_path, capsys):
    """A failure means that 1.5 sheets become two, or a traceback."""
    (tmp_path / "a.csv").write_text("x")
    assert run([str(tmp_path / "a.csv"), f"{option}={text}", "--out", str(tmp_path / "run")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


WRONG = (
    *("sheets = 1.5", "sheets = true", "sheets = [1]", "sheets = 2026-01-01", "sheets = 1e400", "fps = 'x'"),
    *("rotate = 45", "ridges = 1", "unknown = 1", "sample = 5", "[sample]\nwidth = 'x'", "[sample.a]\nb = 1"),
    *("x = " + "[" * 3000, f"pixel_size = {'9' * 5000}", "fps = ", "\x00", "a = 1\na = 2", "fps = {a = 1}"),
    "t-star = 1\nt_star = 2",
)


@pytest.mark.parametrize("text", WRONG, ids=lambda text: text[:20])
def test_a_file_of_options_is_checked_as_the_command_line_is(text, tmp_path):
    """A failure means a traceback, or a value that is guessed."""
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(InputError, match=r"a\.toml") as caught:
        merged(VideoOptions(), SampleOptions(), config=tmp_path / "a.toml")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_what_must_be_positive_is_said_so(refused):
    """A failure means "expected a number from 5e-324", which nobody reads as above 0."""
    assert "--fps: expected a positive number; found" in refused("film.avi", "--fps=0")


@pytest.mark.parametrize(
    "arguments",
    [
        ["film.avi", "--fps", "59,94"],
        ["film.avi", "--offset=-59,94"],
        ["modulus", "sheet.txt", "--clamp-distance", "59,94"],
        ["friction", "discs.csv", "--radius", "59,94"],
        ["simulate", "made", "--duration", "59,94"],
    ],
)
def test_a_decimal_comma_is_recognised(arguments, tmp_path, capsys):
    """A failure means that users of decimal commas are told of Python's floats."""
    assert run(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert ": expected a number; found '" in line
    assert line.endswith("59,94'; write it with a decimal point: " + "-" * ("=-" in arguments[-1]) + "59.94")
    (tmp_path / "options.toml").write_text("fps = '59,94'")
    with pytest.raises(InputError, match=r"found '59,94'; write it with a decimal point: 59\.94"):
        merged(VideoOptions(), config=tmp_path / "options.toml")


def test_a_number_that_is_none_is_said_so(capsys):
    """A failure means that a word in place of a number is told of Python's floats."""
    assert run(["film.avi", "--fps", "fast"]) == 2
    assert capsys.readouterr().err == "track: --fps: expected a number; found 'fast'\n"
    for option, typed in (("--speed", "1mm/min"), ("--offset", "24 s"), ("--machine-stiffness", "1e5N/mm")):
        assert run(["film.avi", option, typed]) == 2
        advice = "write only the number; track --help lists the options with their units"
        assert f"{option}: expected a number; found '{typed}'; {advice}" in capsys.readouterr().err


def test_a_file_of_options_gives_what_it_says(tmp_path):
    """A failure means that the checks refuse what is right."""
    (tmp_path / "a.toml").write_text(
        "sheets = 50\nfps = 60\nstrip = '6:14'\n[sample]\nsheets-per-block = 25.0\n"
    )
    found = merged(VideoOptions(), SampleOptions(), config=tmp_path / "a.toml")
    assert [found[name].value for name in ("sheets", "fps", "strip", "sheets_per_block")] == [
        50,
        60,
        "6:14",
        25,
    ]


def test_a_file_of_options_may_begin_as_windows_editors_save_it(tmp_path):
    """A failure means that a file is called damaged for a mark that no editor shows."""
    (tmp_path / "a.toml").write_text("sheets = 50", encoding="utf-8-sig")
    assert merged(VideoOptions(), config=tmp_path / "a.toml")["sheets"].value == 50


def test_paths_in_a_file_of_options_are_relative_to_it(tmp_path, monkeypatch):
    """A failure means that a file of options only works from one folder, or takes a file of the same name in
    the working directory for the one beside it."""
    (tmp_path / "setup").mkdir()
    monkeypatch.chdir(tmp_path)
    config = Path("setup/a.toml")
    config.write_text("force = 'f.txt'\ntimestamps = 't.txt'\ncorrections = 'setup/c.toml'\n")
    for name in ("setup/f.txt", "f.txt", "setup/c.toml"):
        Path(name).write_text("")
    found = merged(VideoOptions(), options.TestOptions(), config=config)
    assert found["force"].value == Path("setup/f.txt")
    assert found["timestamps"].value == Path("setup/t.txt")  # there is none
    assert found["corrections"].value == Path("setup/c.toml")  # only from the working directory
    assert merged(options.TestOptions(force=Path("f.txt")), config=config)["force"].value == Path("f.txt")


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("13", (13.0, None)),
        ("13.0±0.1", (13.0, 0.1)),
        ("13.0+-0.1", (13.0, 0.1)),
        ("13.0 +/- 0.1", (13.0, 0.1)),
        ("13mm", (13.0, None)),
        ("13.0±0.1 mm", (13.0, 0.1)),
        ("0", (0.0, None)),
        ("0±0.1", (0.0, 0.1)),
        (None, (None, None)),
    ],
)
def test_a_value_may_carry_its_error(text, meant):
    """A failure means the error of d0 is lost, or read as part of d0."""
    assert parse_with_error(text, "--d0") == meant


@pytest.mark.parametrize(
    "text", ["x", "13±", "-1", "13±-0.1", "nan", "inf", "13±0.1±0.1", "0,1", "13um", "13N", "10±20"]
)
def test_a_value_with_a_senseless_error_is_refused(text):
    """A failure means a typing error becomes a length, or advice with a value of another option."""
    with pytest.raises(InputError, match=r"--thickness: .*; write it in mm with a decimal point"):
        parse_with_error(text, "--thickness")


@pytest.mark.parametrize(
    ("parse", "text", "pointed"),
    [
        (parse_pixel_size, "0,01mm", "0.01mm"),
        (parse_pitch, "0,2mm", "0.2mm"),
        (parse_width, "1,5 px", "1.5 px"),
        (parse_scale, "1,5mm=103,5px", "1.5mm=103.5px"),
        (lambda text: parse_pair(text, "--fit-range", "a range", example="13.2:17"), "13,2:17", "13.2:17"),
        (parse_seconds, "40:45,1", "40:45.1"),
        (lambda text: parse_duration(text, "--force-lowpass"), "0,05", "0.05"),
    ],
)
def test_a_decimal_comma_is_answered_with_the_point(parse, text, pointed):
    """A failure means that who writes 0,2mm is told to write 0.2mm "with its unit"."""
    with pytest.raises(InputError) as caught:
        parse(text)
    assert str(caught.value).endswith(f"write it with a decimal point: {pointed}")


def test_low_pass_and_range_of_the_fit():
    """A failure means auto or a range is misread."""
    read = [parse_duration(text, "--force-lowpass") for text in ("auto", "0", "0.003")]
    assert read == ["auto", 0.0, 0.003]
    assert parse_pair("13.2:17", "--fit-range", "a range", example="13.2:17") == (13.2, 17.0)
    for wrong in ("17:13", "13", "a:b", ":17"):
        with pytest.raises(InputError, match="--fit-range"):
            parse_pair(wrong, "--fit-range", "a range", example="13.2:17")
    for wrong in ("fast", "-1", "nan"):
        with pytest.raises(InputError, match="--force-lowpass"):
            parse_duration(wrong, "--force-lowpass")


def test_options_that_are_not_given_are_the_settings_defaults():
    """A failure means that run.json says another default than the analysis had."""
    assert settings_of(merged(*(group() for group in GROUPS))) == Settings()


def test_a_wrong_option_is_told_before_the_folder_that_exists(tmp_path, refused):
    """A failure means that who adds --overwrite is stopped a second time, by a mistake of the first call."""
    assert "--strip: expected two whole numbers" in refused(
        "film.avi", "--strip", "60-144", "--out", str(tmp_path)
    )


@pytest.mark.parametrize(
    ("argument", "option"),
    [
        ("mu", "--fix-mu"),  # of track, though friction has --mu
        ("clamp_distance_mm", "--clamp-distance"),
        ("radius_mm", "--radius"),
        ("time_s", "--time"),
        ("main_sample", "--main-sample"),
        ("container", "--container"),
        ("executor", "--executor"),
    ],
)
def test_messages_name_the_options_of_every_command(argument, option):
    """A failure means that a message names an argument of the library that nobody can type."""
    assert with_options(f"give `{argument}`", option_names()) == f"give {option}"


@pytest.mark.parametrize("typed", ["--pix", "--pixel"])
def test_an_abbreviated_option_is_recognised(typed, refused):
    """A failure means that who types the first letters of an option is told nothing."""
    assert f"Unknown option: {typed}. Did you mean --pixel-size?" in refused("v.avi", typed, "10")


def test_a_file_whose_name_begins_with_a_hyphen_is_told_from_an_option(tmp_path, monkeypatch, refused):
    """A failure means that nothing says how such a film is given."""
    monkeypatch.chdir(tmp_path)
    Path("-fast.avi").touch()
    assert f"If the file of this name is meant, write .{os.sep}-fast.avi (track --help" in refused(
        "-fast.avi"
    )


@pytest.mark.parametrize(
    ("typed", "meant"), [("--pixl-size", "--pixel-size"), ("--frame", "--frames"), ("--foo", "")]
)
def test_only_an_option_that_is_close_is_suggested(typed, meant, capsys):
    """A failure means that --foo suggests --out."""
    assert run(["v.avi", typed, "10"]) == 2
    suggestion = f" Did you mean {meant}?" if meant else ""
    assert f"Unknown option: {typed}.{suggestion} (track --help" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "advice"),
    [
        (["force"], "track force --help"),
        (["kymograph", "--sheeet", "1", "run"], "track kymograph --help"),
        (["modulus", "a.txt", "b.txt"], "track modulus --help"),
        (["v.avi", "--bandwidth", "10"], "track --help"),
    ],
)
def test_the_help_named_is_that_of_the_command(typed, advice, refused):
    """A failure means that `track force` without a file sends its user to the options of `track`."""
    assert f"{advice} lists the options" in refused(*typed)


@pytest.mark.parametrize(
    ("typed", "meant"), [("preveiw", "preview"), ("compar", "compare"), ("Force", "force")]
)
def test_a_mistyped_command_is_recognised(typed, meant, tmp_path, refused, capsys):
    """A failure means that a typo is taken for a film, which is not there."""
    assert run([typed, "film.avi"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(f"{typed}: expected a command or a video; found neither; did you mean {meant}?")
    assert "did you mean" not in refused("--force", "f.txt", "film.avi")  # options may come first
    (tmp_path / typed).mkdir()  # a folder of images may have such a name
    for name in (typed, "preview.avi"):
        assert "did you mean" not in refused(name)


@pytest.mark.parametrize("option", ["--strip", "--columns", "--frames"])
def test_a_range_that_is_none_gets_an_example(option, capsys):
    """A failure means that a user who types 60-144 has to guess what A:B means."""
    assert run(["film.avi", option, "60-144"]) == 2
    assert capsys.readouterr().err.endswith("found '60-144'; write 60:144\n")
