"""The wording of invalid input."""

import pickle
import re

import pytest

from vision.errors import InputError, check_within, known_as, reason_of


def test_a_renamed_argument_is_renamed_in_every_part():
    """A failure means that a campaign or a rheometer's file names an argument that the user cannot give."""
    with pytest.raises(InputError) as caught, known_as(columns="force_columns"):
        raise InputError("`columns`", "a column", "none", "give `columns` and `speed_mm_min`")
    wanted = "expected a column; found none; give `force_columns` and `speed_mm_min`"
    assert caught.value.problem == wanted
    assert str(caught.value) == f"`force_columns`: {wanted}"
    assert caught.value.is_of_argument


@pytest.mark.parametrize(
    ("value", "found"), [(50.0, "50.0"), (1.5, "1.5"), (0, "0"), ("50", "the text '50'")]
)
def test_a_number_that_is_not_whole_is_shown_as_such(value, found):
    """A failure means that 50.0 is refused with "expected a whole number; found 50"."""
    with pytest.raises(InputError, match=f"found {re.escape(found)}$"):
        check_within("a whole number from 1", 1, 99, whole=True, sheets=value)


def test_an_error_is_the_same_in_another_process():
    """A failure means that an error of a child process cannot be raised in this one."""
    error = InputError("film.avi", "frames", "none,\nat all", "look at it")
    error.advice = "film again"
    there = pickle.loads(pickle.dumps(error))
    assert str(there) == str(error) == "film.avi: expected frames; found none, at all; film again"
    assert not there.is_of_argument


def test_an_error_of_the_system_is_its_reason_alone():
    """A failure means that messages name a file twice, or state the number of an error."""
    assert reason_of(PermissionError(13, "Permission denied", "film.avi")) == "permission denied"
    assert reason_of(ValueError("embedded null byte")) == "embedded null byte"
