"""2000 damaged files of a fixed seed; any number by hand: python -m tests.fuzz --cases N --seed S."""

import logging
import warnings

import numpy as np
import pytest

from tests.fuzz import runs
from tests.fuzz.cases import one_case, read, run_cases
from tests.fuzz.mutations import mutated, places
from tests.fuzz.seeds import write_seeds

RUNS = 40
PARTS, CASES = 4, 500  # so that they share the cores


@pytest.fixture(autouse=True)
def quiet():
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the command ignores them too
        yield


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(PARTS))
def test_a_damaged_file_is_read_or_refused(seed, tmp_path):
    """A failure means that a damaged file ends in a traceback, a hang, or takes all memory."""
    failures = [failure for _, _, failure in run_cases(CASES, seed, tmp_path) if failure]
    assert not failures, "\n".join(f"{f.file}: {f.what}" for f in failures[:3])


@pytest.mark.thorough
def test_a_damaged_run_folder_is_read_or_refused(tmp_path):
    """A failure means that a run folder from elsewhere ends a command in a traceback, or writes outside."""
    outcomes, failures = [], []
    for _, outcome, failure in runs.run_cases(RUNS, 1, tmp_path / "runs"):
        outcomes.append(outcome)
        failures += [failure] if failure else []
    assert not failures, "\n".join(f"{f.file}: {f.what}" for f in failures[:3])
    assert len({outcome for outcome in outcomes if "status 0" in outcome}) > 5  # damage that is read
    assert len({outcome for outcome in outcomes if "status 2" in outcome}) > 3


def test_the_files_it_starts_from_are_whole(tmp_path):
    """A failure means that cases are refused for what the seed lacks, and try nothing."""
    for kind, files in write_seeds(tmp_path).items():
        for file in files:
            read(file.parent if kind == "images" else file, kind)


def test_structure_is_found_and_changed(tmp_path):
    """A failure means that the mutations only flip pixels, which no reader minds."""
    for kind, files in write_seeds(tmp_path).items():
        for file in files:
            data = file.read_bytes()
            if kind not in ("bytes", "text", "times", "photron", "xlsx"):
                assert len(places(data, kind)) >= 8, file
            changed = [mutated(data, kind, np.random.default_rng(n)) != data for n in range(20)]
            assert sum(changed) >= 15, file


@pytest.mark.posix
def test_a_failure_is_noticed(tmp_path, monkeypatch):
    """The check must see tracebacks and hangs, or it proves nothing."""
    file = tmp_path / "a.txt"
    file.write_text("")
    monkeypatch.setattr("tests.fuzz.cases.read", lambda file, kind: {}["none"])
    assert "KeyError" in one_case(file, "text")
    monkeypatch.setattr("tests.fuzz.cases.SECONDS", 1)
    monkeypatch.setattr("tests.fuzz.cases.read", lambda file, kind: [0 for _ in iter(int, 1)])
    assert "hang" in one_case(file, "text")
    monkeypatch.setattr("tests.fuzz.cases.MEMORY_BYTES", 1 << 10)
    monkeypatch.setattr("tests.fuzz.cases.read", lambda file, kind: None)
    assert "MiB" in one_case(file, "text")
