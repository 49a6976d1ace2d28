"""Fingerprints of inputs and JSON."""

import errno
import hashlib
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from vision.errors import InputError
from vision.run.provenance import MIB, PARTS, Parameter, describe_input, write_json
from vision.run.tables import attrs_of_netcdf, netcdf_attrs


def test_the_checksum_of_a_small_input_is_that_of_all_of_it(tmp_path):
    """A failure means that run.json names another file than the one that was tracked."""
    data = bytes(range(256)) * (MIB // 200)  # a little over one chunk
    (tmp_path / "a.bin").write_bytes(data)
    facts = describe_input(tmp_path / "a.bin")
    assert facts["sha256"] == hashlib.sha256(data).hexdigest()
    assert facts["size_bytes"] == len(data)


@pytest.mark.parametrize("given", ["f", "f/*.bin", "*/*.bin"])
def test_folders_and_patterns_are_hashed_as_one(given, tmp_path, monkeypatch):
    """A failure means that a series of images has no checksum, or one that changes with the order."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "f").mkdir()
    for name in "cab":
        (tmp_path / "f" / f"{name}.bin").write_bytes(name.encode())
    assert describe_input(Path(given))["sha256"] == hashlib.sha256(b"abc").hexdigest()


def test_a_large_input_has_a_fingerprint_that_sees_its_ends_and_its_size(tmp_path):
    """A failure means that a film that was cut or replaced passes as the one that was tracked."""
    path = tmp_path / "big.bin"
    with path.open("wb") as file:
        file.truncate((PARTS + 40) * MIB)  # takes no room
    plain = describe_input(path)
    assert "sha256" not in plain
    with path.open("r+b") as file:
        file.seek(-1, 2)
        file.write(b"x")
    changed = describe_input(path)
    with path.open("r+b") as file:
        file.truncate((PARTS + 41) * MIB)
    longer = describe_input(path)
    assert len({facts["fingerprint"] for facts in (plain, changed, longer)}) == 3
    assert describe_input(path, whole=True)["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()


def test_an_input_that_is_gone_is_one_line(tmp_path, monkeypatch):
    """A failure means that a drive pulled out in the middle ends in a traceback."""
    (tmp_path / "a.bin").write_bytes(b"a")

    def gone(*arguments, **options):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "open", gone)
    with pytest.raises(InputError, match=r"a\.bin.*input/output error"):
        describe_input(tmp_path / "a.bin")


@dataclass
class Fact:
    value: float


def test_json_is_strict_and_null_where_there_is_no_number(tmp_path):
    """A failure means that other programs cannot read run.json."""
    content = {
        "nan": math.nan,
        "array": np.array([1.0, np.inf]),
        "fact": Fact(np.float64(2)),
        "given": Parameter(slice(1, 2), "given"),
        3: (np.int64(4), True, None, Path("a")),
    }
    write_json(content, tmp_path / "a.json")
    read = json.loads((tmp_path / "a.json").read_text(), parse_constant=pytest.fail)
    assert read == {
        "nan": None,
        "array": [1.0, None],
        "fact": {"value": 2.0},
        "given": {"value": "slice(1, 2, None)", "how": "given"},
        "3": [4, True, None, "a"],
    }


def test_attributes_come_back_from_netcdf_as_they_were():
    """A failure means that a film called [1].avi makes a run that cannot be read."""
    attrs = {"source": "[1].avi", "note": '"quoted"', "list": [1, "a"], "plain": "x", "number": 2.0}
    assert attrs_of_netcdf(netcdf_attrs(attrs)) == attrs
    assert netcdf_attrs({"source": "a\udcff.avi"}) == {"source": "a?.avi"}


def test_many_images_have_one_fingerprint_that_sees_the_first_the_last_and_their_sizes(tmp_path, monkeypatch):
    """A failure means that a folder of 100 000 images is read twice, or that one that was changed passes."""
    monkeypatch.setattr("vision.run.provenance.MIB", 100)
    for n in range(40):
        (tmp_path / f"{n:02d}.bin").write_bytes(bytes([n]) * 333)
    plain = describe_input(tmp_path)
    assert "sha256" not in plain
    assert plain["size_bytes"] == 40 * 333
    seen = {plain["fingerprint"]}
    for n in (0, 39):
        data = (tmp_path / f"{n:02d}.bin").read_bytes()
        (tmp_path / f"{n:02d}.bin").write_bytes(b"x" + data[1:-1] + b"y")
        seen.add(describe_input(tmp_path)["fingerprint"])
    os.truncate(tmp_path / "17.bin", 332)
    seen.add(describe_input(tmp_path)["fingerprint"])
    assert len(seen) == 4
    every = b"".join(file.read_bytes() for file in sorted(tmp_path.iterdir()))
    assert describe_input(tmp_path, whole=True)["sha256"] == hashlib.sha256(every).hexdigest()
