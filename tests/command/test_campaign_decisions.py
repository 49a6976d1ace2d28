"""Decisions of a review in a campaign's folder, when the films are tracked again with other settings."""

from dataclasses import replace
from functools import partial

import pytest

from tests.campaign.scenes import films, rows
from vision.campaign.jobs import run_job
from vision.campaign.plan import make_plan, write_plan
from vision.command.campaign import _track_film
from vision.command.main import run
from vision.run.reading import read_run

DECISIONS = """
[[axis]]
x_px = 300.5

[[leave_out]]
sheet = 3
frames = "5:20"
"""


def track(tmp_path, paths, **options):
    """Track the films with these options as Snakemake does; return the first run and its warnings."""
    tests = [replace(row, options=options) for row in rows(paths, **options)]
    plan = make_plan(tests, tmp_path / "out", report=False)
    write_plan(plan)
    (name,) = plan.jobs
    assert run_job(plan, name, partial(_track_film, plan)) == 0
    run = read_run(plan.run_of("t0"))
    return run, run.facts["warnings"]


@pytest.fixture
def corrected(tmp_path, without_pictures):
    """A campaign of one film, whose run was corrected in its folder."""
    paths = films(tmp_path, 1)
    first, _ = track(tmp_path, paths, fps="20", pixel_size="10")
    (tmp_path / "decisions.toml").write_text(DECISIONS, encoding="utf-8")
    given = ["--corrections", str(tmp_path / "decisions.toml"), "--overwrite", "--no-report", "--quiet"]
    assert run([str(first.folder), *given]) in (0, 1)
    assert len(read_run(first.folder).applied) == 2
    return tmp_path, paths


@pytest.mark.parametrize("option", [{"pixel_size": "9"}, {"fps": "25"}, {"threshold": "0.2"}])
def test_decisions_are_kept_where_they_still_hold(corrected, option):
    """A failure means that a new scale for all films undoes every decision that was made about them."""
    after, warnings = track(*corrected, **{"fps": "20", "pixel_size": "10"} | option)
    assert [one.kind for one in after.applied] == ["axis", "leave_out"]
    assert set(after.tracks["flag"].values[5:20, 3].tolist()) == {"left_out"}
    assert not any("decisions" in line for line in warnings)
    assert not list(after.folder.glob("corrections_*.toml"))


@pytest.mark.parametrize("option", [{"strip": "4:12"}, {"frames": "2:30"}])
def test_decisions_about_other_sheets_are_set_aside_and_named(corrected, option):
    """A failure means that a decision about one sheet is applied to another, or is lost."""
    after, warnings = track(*corrected, fps="20", pixel_size="10", **option)
    (kept,) = after.folder.glob("corrections_*.toml")
    assert after.applied == []
    assert any(str(kept) in line for line in warnings)


def test_decisions_about_another_film_are_set_aside(corrected):
    """A failure means that decisions are applied to a film that was exchanged under the same name."""
    tmp_path, paths = corrected
    other = films(tmp_path / "other", 2)[1]
    paths[0].write_bytes(other.read_bytes())
    after, warnings = track(tmp_path, paths, fps="20", pixel_size="10")
    assert after.applied == []
    assert any("not applied" in line for line in warnings)


def test_what_was_undone_is_no_decision_that_is_missed(corrected):
    """A failure means that a campaign warns of decisions that the user took back."""
    tmp_path, paths = corrected
    file = tmp_path / "out" / "runs" / "t0" / "corrections.toml"
    undone = '\n[[undone]]\nkind = "leave_out"\nsheet = 5\nframes = "5:20"\n'
    file.write_text(file.read_text(encoding="utf-8") + undone, encoding="utf-8")
    after, warnings = track(tmp_path, paths, fps="20", pixel_size="9")
    assert len(after.applied) == 2
    assert not any("decisions" in line for line in warnings)
    assert len(list(after.folder.glob("corrections_*.toml"))) == 1  # kept beside the run all the same
