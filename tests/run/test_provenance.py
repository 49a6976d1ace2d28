"""Checksums of inputs, made while the recording is decoded."""

import errno
import hashlib
import threading
import time

import pytest

from vision.errors import InputError
from vision.run import provenance
from vision.run.provenance import CHUNK_BYTES, described_meanwhile


def test_the_checksum_is_that_of_the_whole_input(tmp_path):
    """A failure means that run.json names another file than the one that was tracked."""
    data = bytes(range(256)) * (CHUNK_BYTES // 200)  # a little over one chunk
    (tmp_path / "a.bin").write_bytes(data)
    with described_meanwhile(tmp_path / "a.bin") as describe:
        facts = describe()
    assert facts["sha256"] == hashlib.sha256(data).hexdigest()
    assert facts["size_bytes"] == len(data)


@pytest.mark.parametrize("given", ["f", "f/*.bin", "*/*.bin"])
def test_folders_and_patterns_are_hashed_as_one(given, tmp_path, monkeypatch):
    """A failure means that a series of images has no checksum, or one that changes with the order."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "f").mkdir()
    for name in "cab":
        (tmp_path / "f" / f"{name}.bin").write_bytes(name.encode())
    with described_meanwhile(tmp_path / given) as describe:
        assert describe()["sha256"] == hashlib.sha256(b"abc").hexdigest()


def test_an_input_that_is_gone_is_told(tmp_path, monkeypatch):
    """A failure means that a drive pulled out in the middle ends in a traceback."""
    (tmp_path / "a.bin").write_bytes(b"a")

    def gone(*arguments, **options):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(provenance, "describe_input", gone)
    with (
        described_meanwhile(tmp_path / "a.bin") as describe,
        pytest.raises(InputError, match=r"a\.bin.*input/output error"),
    ):
        describe()


def test_leaving_early_stops_the_thread(tmp_path):
    """A failure means that Ctrl-C waits until 100 GB are read."""
    (tmp_path / "big.bin").touch()
    with (tmp_path / "big.bin").open("r+b") as file:
        file.truncate(1 << 34)  # 16 GiB that take no room
    before = threading.active_count()
    with described_meanwhile(tmp_path / "big.bin"):
        assert threading.active_count() == before + 1
    until = time.monotonic() + 5
    while threading.active_count() > before and time.monotonic() < until:
        time.sleep(0.01)
    assert threading.active_count() == before
