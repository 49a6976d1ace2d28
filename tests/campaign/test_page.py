"""index.html: every test's state, whatever its name."""

import re
from html.parser import HTMLParser

import pytest

from tests.campaign.scenes import films, planned
from vision.campaign.page import duration, write_page
from vision.campaign.plan import make_plan
from vision.campaign.states import State, write_state
from vision.campaign.table import Row

HOSTILE = "<script>alert(1)</script> \"'><img src=x onerror=alert(2)> {{7*7}}"


class Elements(HTMLParser):
    """Start tags with their attributes."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))

    def all(self, tag):
        return [attrs for name, attrs in self.found if name == tag]


def page_of(plan, **how):
    write_page(plan, **({"live": False} | how))
    return (plan.out / "index.html").read_text(encoding="utf-8")


def test_every_test_with_state_reason_thumbnail_and_link(tmp_path):
    """A failure means that a failed film looks done, or that its reason or report is not found."""
    plan = planned(tmp_path / "out", films(tmp_path, 4))
    words = ("done", "warnings", "failed")
    for name, word in zip(("t0", "t1", "t2"), words, strict=True):
        key = plan.film(name).key
        state = State(name=name, key=key, state=word, reason=f"why {name}", warnings=("one", "two"))
        write_state(plan.out, state)
    for name in ("t0", "t1"):
        plan.run_of(name).mkdir(parents=True)
        for file in ("run.json", "report.html"):
            (plan.run_of(name) / file).write_text("{}")
    (plan.out / "thumbnails").mkdir()
    (plan.out / "thumbnails" / "t0.png").write_bytes(b"\x89PNG")
    text = page_of(plan)
    for word, count in [("done", 1), ("warnings", 1), ("failed", 1), ("waiting", 1)]:
        assert f"<b>{count}</b> {word}" in text
    links = {link["href"] for link in Elements(text).all("a")}
    assert {"runs/t0/report.html", "runs/t1/report.html", "campaign.csv"} == links
    assert [image["src"] for image in Elements(text).all("img")] == ["data:image/png;base64,iVBORw=="]
    assert "why t2" in text
    lines = (plan.out / "campaign.csv").read_text().splitlines()
    assert lines[0] == "film,state,reason,seconds,run"
    assert [line.split(",")[1] for line in lines[1:]] == [*words, "waiting"]
    assert [line.rpartition(",")[2] for line in lines[1:]] == ["runs/t0", "runs/t1", "", ""]


def test_hostile_names_are_text(tmp_path):
    """A failure means that a film's name or a warning runs a script in the reader's browser."""
    path = films(tmp_path, 1)[0]
    row = Row(row=2, film=str(path), name="x' onmouseover=alert(3) y=#?", facts={"sample": HOSTILE})
    plan = make_plan([row], tmp_path / "out")
    write_state(
        plan.out,
        State(name=row.name, key=plan.films[0].key, state="done", reason=HOSTILE, warnings=(HOSTILE,) * 2),
    )
    plan.run_of(row.name).mkdir(parents=True)
    (plan.run_of(row.name) / "run.json").write_text("{}")
    text = page_of(plan, remarks=(HOSTILE,))
    elements = Elements(text)
    assert elements.all("script") == elements.all("img") == []
    assert not [name for _, attrs in elements.found for name in attrs if name.startswith("on")]
    assert "{{7*7}}" in text
    (link,) = [a["href"] for a in elements.all("a") if a["href"].startswith("runs/")]
    assert re.fullmatch(r"runs/[A-Za-z0-9%._~-]+/overview\.png", link)
    policy = next(
        m["content"] for m in elements.all("meta") if m.get("http-equiv") == "Content-Security-Policy"
    )
    assert policy.startswith("default-src 'none'; style-src 'unsafe-inline'; img-src data:;")
    assert "script" not in policy


@pytest.mark.parametrize("live", [True, False])
def test_the_page_renews_itself_only_while_the_campaign_runs(tmp_path, live):
    """A failure means a page that stands still, or one that reloads for ever."""
    text = page_of(planned(tmp_path / "out", films(tmp_path, 1)), live=live)
    assert bool([m for m in Elements(text).all("meta") if m.get("http-equiv") == "refresh"]) == live
    assert ("computing are left" in text) == live


@pytest.mark.parametrize(("seconds", "said"), [(45, "45 s"), (150, "2 min"), (9000, "2.5 h")])
def test_what_is_left_is_said_in_its_unit(seconds, said):
    """A failure means that who waits for a campaign is told minutes for seconds."""
    assert duration(seconds) == said
