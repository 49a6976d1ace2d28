"""Lengths, seconds and sheets as typed."""

import pytest

from vision.command.options import (
    VideoOptions,
    merged,
    parse_length,
    parse_scale,
    parse_seconds,
    parse_sheets,
)
from vision.errors import InputError


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
    assert parse_length(text, "--width") == pytest.approx(meant)


@pytest.mark.parametrize("text", ["200", "mm", "-1mm", "0px", "1e400px", "1.2.3mm", "20 nm", "", "nan px"])
def test_a_length_without_sense_is_refused(text):
    """A failure means that a unit is guessed."""
    with pytest.raises(InputError, match="--width"):
        parse_length(text, "--width")


@pytest.mark.parametrize("text", ["1mm=103px", "103 px = 1 mm", "1000um=103px", "0.5mm=51.5px"])
def test_a_scale_is_its_length_over_its_pixels(text):
    """A failure means a pixel size upside down, or a unit ignored."""
    assert parse_scale(text) == pytest.approx(1000 / 103)


@pytest.mark.parametrize(
    "text", ["1mm", "103px", "1=103", "1mm=0px", "1mm=2mm", "1px=2px", "1mm=2px=3px", ""]
)
def test_a_scale_without_sense_is_refused(text):
    """A failure means that lengths are scaled by a guess."""
    with pytest.raises(InputError, match="--scale"):
        parse_scale(text)


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
    assert parse_seconds("40:45.1", "--time") == (40, 45.1)
    assert parse_seconds("-1.5:", "--time") == (-1.5, None)
    assert parse_seconds(":3", "--time") == (None, 3)
    assert parse_seconds(None, "--time") is None


@pytest.mark.parametrize("text", ["5", ":", "2:1", "1:1", "a:b", "1:nan", "1:2:3", "inf:"])
def test_seconds_that_are_no_range_are_refused(text):
    """A failure means an empty or a wrong part without a word."""
    with pytest.raises(InputError, match="--time"):
        parse_seconds(text, "--time")


def test_sheets_are_sides_and_numbers_or_indices():
    """A failure means another sheet than asked for."""
    assert parse_sheets(["right:23,left:1", " 47 "]) == [("right", 23), ("left", 1), 47]
    assert parse_sheets(None) == []


@pytest.mark.parametrize(
    "text", ["right", "right:", "right:0", "middle:3", "-1", "right:2.5", "right:1,", ""]
)
def test_sheets_that_cannot_be_are_refused(text):
    """A failure means that a typing error picks some sheet."""
    with pytest.raises(InputError, match="--sheet"):
        parse_sheets([text])
