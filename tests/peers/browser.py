"""A real browser for tests of the web page: the installed Chromium, controlled by Playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qsl, urlsplit

import pytest
from playwright.sync_api import Browser, Error, Page, ViewportSize, sync_playwright

from tests.waits import wait_for

PAGE_TIMEOUT: Final = 60.0  # s; a page is slow on a busy machine
_NAMES: Final = ("chromium", "chromium-browser", "google-chrome")
VEHICLE: Final = ".row[data-do=vehicle]"
"""Selector of the rows of the vehicle list."""
PARTS: Final = ("head", "find", "list", "tool", "map", "time", "why", "nums", "plots", "more")
"""CSS classes of the parts of the page."""
_SOURCE: Final = """name => {
  for (const model of Bokeh.documents[0]?.all_models ?? [])
    if (model.type == "ColumnDataSource" && name in model.data)
      return Object.fromEntries(Object.entries(model.data).map(([key, values]) =>
        [key, Array.from(values, value => typeof value == "number" && isNaN(value) ? "NaN" : value)]))
  return {}
}"""


_ROWS: Final = """rows => rows.map(row => ({
  vehicle: row.dataset.with, grade: row.children[0].className, state: row.children[2].textContent,
  chosen: row.getAttribute("aria-current") == "true",
}))"""
_ALL: Final = """
const all = (root, found = []) => {
  for (const each of root.querySelectorAll("*")) {
    found.push(each)
    if (each.shadowRoot) all(each.shadowRoot, found)
  }
  return found
}
"""
_LAYOUT: Final = f"""names => {{ {_ALL}
  const problems = [], boxes = {{}}, elements = all(document)
  const {{scrollWidth, scrollHeight}} = document.documentElement
  if (scrollWidth > innerWidth) problems.push(`the page is ${{scrollWidth}} wide`)
  if (innerWidth > 800 && scrollHeight > innerHeight) problems.push(`the page is ${{scrollHeight}} high`)
  for (const name of names) {{
    const part = elements.find(each => each.matches(`div.${{name}}`) && each.shadowRoot)
    const box = boxes[name] = part?.getBoundingClientRect()
    if (!box || box.width < 100 || box.height < 16) problems.push(`${{name}} is ${{box?.width}} x ${{box?.height}}`)
    else if (box.left < 0 || box.right > innerWidth + 0.5) problems.push(`${{name}} goes beyond the page`)
    else {{
      const inside = all(part.shadowRoot)
      const isFilled = inside.some(each =>
        each.matches("canvas, input") || (each.matches(".bk-clearfix") && each.innerText.trim()))
      if (!isFilled) problems.push(`${{name}} is empty`)
    }}
  }}
  for (const [name, one] of Object.entries(boxes)) for (const [other, two] of Object.entries(boxes)) {{
    if (name >= other || !one || !two) continue
    const wide = Math.min(one.right, two.right) - Math.max(one.left, two.left)
    const high = Math.min(one.bottom, two.bottom) - Math.max(one.top, two.top)
    if (wide > 1 && high > 1) problems.push(`${{name}} lies on ${{other}} by ${{wide}} x ${{high}}`)
  }}
  return problems
}}"""
_CONTRAST: Final = f"""names => {{ {_ALL}
  const parse = colour => colour.match(/[\\d.]+/g).map(Number)
  const luminance = colour => {{
    const [r, g, b] = colour.map(part => part / 255).map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    return 0.2126 * r + 0.7152 * g + 0.0722 * b
  }}
  const ground = element => {{
    for (let at = element; at; at = at.parentElement ?? at.getRootNode().host) {{
      const colour = parse(getComputedStyle(at).backgroundColor)
      if (colour.length < 4 || colour[3] > 0) return colour.slice(0, 3)
    }}
    return [255, 255, 255]
  }}
  const found = []
  for (const name of names) for (const part of all(document).filter(each => each.matches(`div.${{name}}`)))
    for (const each of part.shadowRoot ? all(part.shadowRoot) : []) {{
      if (each.matches("style") || ![...each.childNodes].some(node => node.nodeType == 3 && node.data.trim())) continue
      const text = parse(getComputedStyle(each).color).slice(0, 3)
      const [high, low] = [luminance(text), luminance(ground(each))].sort((a, b) => b - a)
      found.push([name, each.textContent.trim().slice(0, 30), (high + 0.05) / (low + 0.05)])
    }}
  return found
}}"""
_LABELS: Final = """() => {
  const models = [...Bokeh.documents[0].all_models]
  const figure = models.find(each => each.type == "Figure" && each.match_aspect)
  const view = Bokeh.index.find_one(figure), pen = document.createElement("canvas").getContext("2d")
  if (!view) return []
  pen.font = "11px helvetica"
  const {data} = models.find(each => each.type == "ColumnDataSource" && "label" in each.data)
  return Array.from(data.label, (label, index) => {
    const wide = pen.measureText(label).width, beside = data.offset[index] - (data.align[index] == "right" ? wide : 0)
    const x = view.frame.x_scale.compute(data.east[index]) + beside
    const y = view.frame.y_scale.compute(data.north[index]) - 5
    return [label, x, y, x + wide, y + 11]
  }).filter(each => each[0])
}"""
_CELLS: Final = f"""selector => {{ {_ALL}
  const found = all(document).filter(each => each.matches(selector))
  return found.filter(each => each.matches("td, span") || each.shadowRoot).map(each => [
    each.textContent, each.scrollWidth > each.clientWidth + 1 || each.scrollHeight > each.clientHeight + 1,
    getComputedStyle(each).backgroundAttachment,
  ])
}}"""
_PLACE: Final = """([x, y]) => {
  const figure = [...Bokeh.documents[0].all_models].find(each => each.type == "Figure" && each.match_aspect)
  const view = Bokeh.index.find_one(figure)
  if (!view) return null
  const box = view.el.getBoundingClientRect()
  return [box.x + view.frame.x_scale.compute(x), box.y + view.frame.y_scale.compute(y)]
}"""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Start Chromium for the tests of a module; skip them if it is not installed."""
    path = next(filter(None, map(shutil.which, _NAMES)), None)
    if path is None:
        pytest.skip(f"not installed: {' or '.join(_NAMES)}")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", "--disable-gpu"]
        )
        yield started
        started.close()


class Cell(NamedTuple):
    """An element: its text, whether the text is clipped, and its CSS background-attachment."""

    text: str
    is_cut: bool
    layers: str


class Tab:
    """A browser tab with the page, its requests, and the errors in its console."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.requested: list[str] = []
        self.console_errors: list[str] = []
        page.set_default_timeout(PAGE_TIMEOUT * 1e3)
        page.on("request", lambda request: self.requested.append(request.url))
        page.on("websocket", lambda socket: self.requested.append(socket.url))
        page.on("pageerror", lambda error: self.console_errors.append(str(error)))
        page.on(
            "console",
            lambda line: self.console_errors.append(line.text) if line.type == "error" else None,
        )

    def open(self, url: str) -> None:
        """Load the page and wait until it is drawn."""
        self.page.goto(url)
        self.page.locator(".bk-Figure canvas").first.wait_for()

    def source(self, name: str) -> dict[str, list[Any]]:
        """Return the data of the first Bokeh data source with a column of this name; {} if there is none yet."""
        found: dict[str, list[Any]] = self.page.evaluate(_SOURCE, name)
        return found

    def rows(self, name: str) -> list[dict[str, Any]]:
        """Return the data of `source` as rows."""
        columns = self.source(name)
        return [
            dict(zip(columns, values, strict=True))
            for values in zip(*columns.values(), strict=True)
        ]

    @property
    def listed(self) -> list[dict[str, Any]]:
        """Rows of the vehicle list in order: vehicle, grade, state and selection; empty while the page loads."""
        try:
            found: list[dict[str, Any]] = self.page.locator(VEHICLE).evaluate_all(_ROWS)
        except Error as exc:
            if "because of a navigation" not in str(exc):
                raise
            return []
        return found

    @property
    def states(self) -> dict[str, str]:
        """States in the vehicle list, by vehicle."""
        return {row["vehicle"]: row["state"] for row in self.listed}

    @property
    def chosen(self) -> list[str]:
        return [row["vehicle"] for row in self.listed if row["chosen"]]

    @property
    def marks(self) -> dict[str, dict[str, Any]]:
        """Markers on the map, by vehicle."""
        return {row["name"]: row for row in self.rows("shape")}

    @property
    def query(self) -> dict[str, str]:
        """Parameters of the query string of the page's URL."""
        return dict(parse_qsl(urlsplit(self.url).query))

    @property
    def url(self) -> str:
        """URL in the address bar; Playwright's own property may be outdated."""
        return str(self.page.evaluate("location.href"))

    def panel(self, name: str) -> str:
        """Return the visible text of a panel."""
        return self.page.locator(f"div.{name} .bk-clearfix").first.inner_text()

    def cells(self, selector: str) -> list[Cell]:
        """Return the page parts, table cells and spans that match a selector."""
        return [Cell(*each) for each in self.page.evaluate(_CELLS, selector)]

    def layout_problems(self) -> list[str]:
        """Return the layout problems of all parts: empty, outside the page, or overlapping."""
        found: list[str] = self.page.evaluate(_LAYOUT, list(PARTS))
        return found

    def contrasts(self, *names: str) -> list[tuple[str, str, float]]:
        """Return each text of these parts with its contrast ratio to the background."""
        return [
            (name, text, value) for name, text, value in self.page.evaluate(_CONTRAST, list(names))
        ]

    def labels(self) -> list[tuple[str, float, float, float, float]]:
        """Return the labels on the map: text, left, top, right and bottom [pixels]."""
        return [
            (text, left, top, right, low)
            for text, left, top, right, low in self.page.evaluate(_LABELS)
        ]

    def tap(self, east: float, north: float) -> None:
        """Click on the map at this position [m]."""
        pixel = self.page.evaluate(_PLACE, [east, north])
        if pixel is not None:
            self.page.mouse.click(*pixel)

    def shows(self, text: str) -> bool:
        """Return whether this text is visible."""
        return any(each.is_visible() for each in self.page.get_by_text(text).all())

    def wait_for_text(self, text: str) -> None:
        wait_for(lambda: self.shows(text), what=f"the page to show {text!r}", seconds=PAGE_TIMEOUT)


@contextmanager
def open_tabs(browser: Browser, *, allow_console_errors: bool = False) -> Iterator[Any]:
    """Yield a function that opens tabs; at the end assert that no request left this host and no console has an error.

    `allow_console_errors`: needed if a server is stopped, which every browser logs as an error.
    """
    tabs: list[Tab] = []
    contexts = []

    def make(*, width: int = 800, height: int = 560, is_mobile: bool = False) -> Tab:
        size: ViewportSize = {"width": width, "height": height}  # small: less to draw
        context = browser.new_context(viewport=size, is_mobile=is_mobile)
        contexts.append(context)
        tabs.append(Tab(context.new_page()))
        return tabs[-1]

    try:
        yield make
        for tab in tabs:
            hosts = {
                urlsplit(url).hostname
                for url in tab.requested
                if not url.startswith(("data:", "blob:"))
            }
            assert hosts <= {"127.0.0.1"}
            assert allow_console_errors or not tab.console_errors, tab.console_errors
    finally:
        for context in contexts:
            context.close()
