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
        from playwright.sync_api import sync_playwright
    except ImportError:
        _without("playwright is not installed: pip install '.[test]'")
    if CHROMIUM is None:
        _without("no chromium on this machine: apt-get install chromium")
    with sync_playwright() as driver:
        options = ["--no-sandbox", "--disable-background-networking"]
        opened = driver.chromium.launch(executable_path=CHROMIUM, args=options, timeout=PATIENCE_MS)
        yield opened
        opened.close()


def _without(reason: str) -> None:
    if REQUIRED:
        pytest.fail(reason)
    pytest.skip(reason)
