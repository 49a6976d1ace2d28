"""run.json names the files that were read, by their content."""

from __future__ import annotations

import errno
import hashlib
import os
import time
from concurrent.futures import CancelledError
from pathlib import Path

import pytest

from vision.errors import InputError
from vision.run.provenance import MIB, PARTS, Checksums, describe_input


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


def test_checksums_beside_the_reading_are_those_of_the_whole_files(tmp_path):
    """A failure means that --checksum names other files than those that were read."""
    files = [tmp_path / "a.bin", tmp_path / "b.bin"]
    for k, file in enumerate(files):
        file.write_bytes(bytes([k]) * (3 * MIB + 17))
    with Checksums(files) as sums:
        progress = sums.following(None)
        for done in range(5):
            progress(done, 5)
        found = sums.found()
    assert found == {file: describe_input(file, whole=True) for file in files}


class Watched(Checksums):
    """Keeps what was read whenever it looks at the film's place."""

    read = 0

    def _wait(self, done, size):
        self.read = done
        super()._wait(done, size)


def test_checksums_do_not_run_ahead_of_the_film(tmp_path, monkeypatch):
    """A failure means that a film larger than the memory is read from the disk twice."""
    monkeypatch.setattr("vision.run.provenance.AHEAD_BYTES", MIB)
    file = tmp_path / "a.bin"
    file.write_bytes(bytes(20 * MIB))
    with Watched([file]) as sums:
        for share, expected in ((0, 2), (25, 7), (50, 12)):  # the film's place, one MiB, and where it waits
            sums.following(None)(share, 100)
            until = time.monotonic() + 120
            while sums.read < expected * MIB and time.monotonic() < until:
                time.sleep(0.01)
            time.sleep(0.05)
            assert sums.read == expected * MIB
        assert sums.found()[file]["size_bytes"] == 20 * MIB
    assert sums.read == 20 * MIB


def test_an_input_that_cannot_be_read_for_its_checksum_is_one_line(tmp_path, monkeypatch):
    """A failure means that the thread's error is lost, and a run without a checksum passes for whole."""

    def gone(*arguments, **options):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("vision.run.provenance._parts", gone)
    with Checksums([tmp_path]) as sums, pytest.raises(InputError, match="input/output error"):
        sums.found()


def test_a_run_that_fails_does_not_wait_for_its_checksum(tmp_path, monkeypatch):
    """A failure means that Ctrl-C, or the next film, waits until 100 GB are read."""
    monkeypatch.setattr("vision.run.provenance.AHEAD_BYTES", 0)
    (tmp_path / "a.bin").write_bytes(bytes(20 * MIB))
    with Checksums([tmp_path / "a.bin"]) as sums:
        pass
    with pytest.raises(CancelledError):
        sums._found.result(5)
