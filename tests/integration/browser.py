"""A headless Chromium for tests that look at pages as a person does."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

PATIENCE_MS = 240_000.0  # software drawing on a busy machine
# WebGL without a GPU; no sandbox, since containers run as root
ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
]


def chromium() -> str | None:
    """The browser named by AMREPAIR_CHROMIUM, or one of the system's."""
    named = os.environ.get("AMREPAIR_CHROMIUM")
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return named or next(filter(None, map(shutil.which, names)), None)


def why_not() -> str:
    """Why there is no browser here; empty where there is one."""
    if find_spec("playwright") is None:
        return "playwright is not installed"
    if chromium() is None:
        return "no Chromium: install one, or name it in AMREPAIR_CHROMIUM"
    return ""


@contextmanager
def launched() -> Iterator[Any]:
    """A browser, closed at the end."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium(), args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


class Watched:
    """A page with all that it complained of and asked for."""

    def __init__(self, browser: Any, url: str, **context: Any) -> None:
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page = browser.new_page(**context)
        self.page.set_default_timeout(PATIENCE_MS)
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(url)

    def _heard(self, message: Any) -> None:
        if message.type == "error":
            self.complaints.append(message.text)
