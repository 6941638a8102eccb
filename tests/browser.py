"""A real browser for tests of the page: the Chromium of this machine, driven by playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from tests.waits import wait_for

PATIENCE: Final = 60.0  # s: a page takes its time where other programs use the processor
_NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
_SOURCE: Final = """name => {
  for (const model of Bokeh.documents[0]?.all_models ?? [])
    if (model.type == "ColumnDataSource" && name in model.data)
      return Object.fromEntries(Object.entries(model.data).map(([key, values]) =>
        [key, Array.from(values, value => typeof value == "number" && isNaN(value) ? "NaN" : value)]))
  return {}
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Start a Chromium for the tests of a module; skip them where there is none."""
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip(f"there is no {' or '.join(_NAMES)} here")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield started
        started.close()


class Tab:
    """One page: what it shows, what it asked for, and what it complained about."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.requested: list[str] = []
        self.complaints: list[str] = []
        page.set_default_timeout(PATIENCE * 1e3)
        page.on("request", lambda request: self.requested.append(request.url))
        page.on("websocket", lambda socket: self.requested.append(socket.url))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)

    def open(self, url: str) -> None:
        """Load the page, and wait for its first picture."""
        self.page.goto(url)
        self.page.locator(".bk-Figure canvas").first.wait_for()

    def source(self, name: str) -> dict[str, list[Any]]:
        """Return the data of the first source in the page that has a column of this name; {} before it is there."""
        found: dict[str, list[Any]] = self.page.evaluate(_SOURCE, name)
        return found

    def rows(self, name: str) -> list[dict[str, Any]]:
        """Return the same as rows."""
        columns = self.source(name)
        return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]

    @property
    def streams(self) -> list[dict[str, Any]]:
        """The rows of the table."""
        return self.rows("what is wrong")

    @property
    def states(self) -> dict[str, str]:
        """The states in the table by vehicle, where each has one stream."""
        return {row["vehicle"]: row["state"] for row in self.streams}

    @property
    def marks(self) -> dict[str, dict[str, Any]]:
        """The markers on the map, by vehicle."""
        return {row["label"].partition(" ")[0]: row for row in self.rows("shape")}

    def shows(self, text: str) -> bool:
        """Tell whether a person sees this text."""
        return any(each.is_visible() for each in self.page.get_by_text(text).all())

    def wait_for_text(self, text: str) -> None:
        wait_for(lambda: self.shows(text), what=f"the page to say {text!r}", seconds=PATIENCE)


@contextmanager
def open_tabs(browser: Browser, *, may_complain: bool = False) -> Iterator[Any]:
    """Give a function that opens tabs; at the end no request has left this host, and no console has an error.

    `may_complain`: a server that is away is an error in the console of every browser.
    """
    tabs: list[Tab] = []
    contexts = []

    def make(*, width: int = 800, height: int = 560) -> Tab:
        context = browser.new_context(viewport={"width": width, "height": height})  # small: less to draw
        contexts.append(context)
        tabs.append(Tab(context.new_page()))
        return tabs[-1]

    try:
        yield make
        for tab in tabs:
            hosts = {urlsplit(url).hostname for url in tab.requested if not url.startswith(("data:", "blob:"))}
            assert hosts <= {"127.0.0.1"}
            assert may_complain or not tab.complaints, tab.complaints
    finally:
        for context in contexts:
            context.close()
