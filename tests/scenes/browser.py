"""A real browser for tests of pages: Debian's Chromium, driven by Playwright."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
REQUIRED = os.environ.get("SHEETVISION_BROWSER") == "required"  # set by .ci/run where Chromium is installed

PATIENCE_MS = 120_000  # on a machine that does much else


@contextmanager
def chromium() -> Iterator[Any]:
    """An open browser. Without one the test is skipped, or fails where .ci/run says that there is one."""
    try:
        from playwright.sync_api import Error, sync_playwright
    except ImportError:
        _without("playwright is not installed: pip install '.[test]'")
    if CHROMIUM is None:
        _without("no chromium on this machine: apt-get install chromium")
    with sync_playwright() as driver:
        options = ["--no-sandbox", "--disable-background-networking", "--disable-gpu"]
        try:
            opened = driver.chromium.launch(executable_path=CHROMIUM, args=options, timeout=PATIENCE_MS)
        except Error as error:
            _without(f"chromium does not start: {error}")
        yield opened
        opened.close()


class Visit:
    """An open page, with everything it complained about or asked for."""

    def __init__(self, browser: Any, address: str, **look: Any) -> None:
        self.context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}} | look)
        self.context.set_default_timeout(PATIENCE_MS)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)


def assert_shut_in(visit: Visit) -> None:
    """The page could not ask the network if it tried."""
    refused = visit.page.evaluate("fetch('http://127.0.0.1:9/').then(() => 'sent', (error) => error.name)")
    assert refused == "TypeError"
    assert any("Content Security Policy" in line for line in visit.complaints)


def _without(reason: str) -> None:
    if REQUIRED:
        pytest.fail(reason)
    pytest.skip(reason)
