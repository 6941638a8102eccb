"""`nedbus web` with viewers in headless Chromium: python -m benchmarks.web.

Vehicles fly figures of eight. Measured are: the time from the start of `nedbus web` to the first picture with vehicles
on it; then, without a viewer, the share of a core that its reader needs; then, with all viewers, what each adds to
that, its frames a second, what it is sent, and the memory of server and browser for as long as --minutes says.

The bars: a first picture within 3 s, 25 frames a second, a quarter of a core for each viewer, memory at the end within
5 % of that after the first third.
The results are written to build/web.json and, as a table, to the terminal.
"""

from __future__ import annotations

import argparse
import json
import shutil
import socket
import statistics
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from typing import Any, Final

import psutil
from playwright.sync_api import Browser, Page, sync_playwright

from .processes import PATIENCE, ROOT, Process, end, expect, router, start, tell

FLEET: Final = """
import math, sys, time
import numpy as np
import nedbus
from benchmarks.compare.fields import FIELDS
from tests.flights.first_message import FIELD_TYPES, PAYLOAD_SIZE
from tests.flights.first_message import encode_array
vehicles, rate, endpoint = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
messages = np.repeat(nedbus.to_array([nedbus.VehicleLocalPosition(**FIELDS)]), vehicles)
for name in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"):
    messages[name] = True
messages["dead_reckoning"] = False
phases = np.arange(vehicles)
with nedbus.connect(endpoint) as bus:
    publishers = [bus.publisher("vehicle_local_position", vehicle=f"v{number}") for number in range(vehicles)]
    print("ready", flush=True)
    sys.stdin.readline()
    start, tick = time.monotonic(), 0
    while True:
        angles = tick / rate / 5 + phases
        messages["timestamp"] = 10_000_000 + int(tick * 1e6 / rate)
        messages["timestamp_sample"] = messages["timestamp"]
        messages["x"] = 40 * np.sin(angles) + 15 * (phases // 10)
        messages["y"] = 20 * np.sin(2 * angles) + 30 * (phases % 10)
        messages["heading"] = np.arctan2(40 * np.cos(2 * angles), 40 * np.cos(angles))
        payloads = encode_array(messages)
        wait = start + tick / rate - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        for index, publisher in enumerate(publishers):  # this process stands for as many hosts as there are vehicles
            publisher._put(payloads[index * PAYLOAD_SIZE : (index + 1) * PAYLOAD_SIZE], FIELD_TYPES.keys())
        tick += 1
"""
COUNT: Final = """
window.bytes = window.frames_drawn = 0
window.WebSocket = class extends WebSocket {
  constructor(...given) {
    super(...given)
    this.addEventListener("message", event => { window.bytes += event.data.length ?? event.data.byteLength })
  }
}
const draw = () => { window.frames_drawn++; requestAnimationFrame(draw) }
requestAnimationFrame(draw)
"""
SHOWN: Final = """count => [...Bokeh?.documents?.[0]?.all_models ?? []].some(
  model => model.type == "ColumnDataSource" && model.data.shape?.length >= count)"""
READER_ALONE: Final = 15.0  # s for which the reader is measured; as long before, until the first viewer is forgotten
LOOK: Final = 5.0  # s between two looks at memory
GROWTH: Final = 1.05


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=50)
    parser.add_argument("--rate", type=float, default=100.0, help="Hz, of each vehicle")
    parser.add_argument("--viewers", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=1.0)
    given = parser.parse_args()
    found = measure(given.vehicles, given.rate, given.viewers, given.minutes * 60)
    path = ROOT / "build" / "web.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({**vars(given), **found}))
    print(describe(found))


def measure(vehicles: int, rate: float, viewers: int, seconds: float) -> dict[str, Any]:
    """Run the fleet, the server and the viewers, and return what was found."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise SystemExit("there is no chromium here")
    with ExitStack() as closing:
        _, endpoint = closing.enter_context(router())
        fleet = start("-c", FLEET, str(vehicles), str(rate), endpoint)
        closing.callback(end, fleet)
        expect(fleet)
        tell(fleet)
        playwright = closing.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        closing.callback(browser.close)
        begin = time.monotonic()
        web, url = _serve(endpoint)
        closing.callback(end, web)
        served = time.monotonic() - begin
        page = _open(browser, url, 1)
        first = time.monotonic() - begin
        page.wait_for_function(SHOWN, arg=vehicles)
        everybody = time.monotonic() - begin
        page.close()
        server = psutil.Process(web.pid)
        time.sleep(2 * READER_ALONE)  # until its session is forgotten
        alone = _share(server, READER_ALONE)
        pages = [_open(browser, url, vehicles) for _ in range(viewers)]
        looks, cpu, drawn = _look(server, pages, seconds)
    return {
        "served": served,
        "first picture": first,
        "all vehicles": everybody,
        "reader": alone,
        "server": cpu,
        "each viewer": (cpu - alone) / viewers,
        **drawn,
        "looks": looks,
    }


def _serve(endpoint: str) -> tuple[Process, str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    web = start("-m", "nedbus", "web", "--connect", endpoint, "--http", f"127.0.0.1:{port}", quiet=False)
    url = f"http://127.0.0.1:{port}"
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        with suppress(OSError):
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
            return web, url
        time.sleep(0.02)
    raise RuntimeError(f"nedbus web does not answer at {url}")


def _open(browser: Browser, url: str, vehicles: int) -> Page:
    """Open a page of its own, and wait until it lists `vehicles` vehicles."""
    page = browser.new_page(viewport={"width": 1600, "height": 950})
    page.set_default_timeout(PATIENCE * 1e3)
    page.add_init_script(COUNT)
    page.goto(url)
    page.wait_for_function(SHOWN, arg=vehicles)
    return page


def _share(process: psutil.Process, seconds: float) -> float:
    """Return the share of a core that a process needs."""
    before, begin = sum(process.cpu_times()[:2]), time.monotonic()
    time.sleep(seconds)
    return float((sum(process.cpu_times()[:2]) - before) / (time.monotonic() - begin))


def _look(
    server: psutil.Process, pages: Sequence[Page], seconds: float
) -> tuple[list[dict[str, float]], float, dict[str, float]]:
    """Return memory over time [MB], the server's share of a core, and frames and kB a second of the viewers."""
    counted = "[performance.now(), window.frames_drawn, window.bytes]"
    before = [page.evaluate(counted) for page in pages]
    used, begin = sum(server.cpu_times()[:2]), time.monotonic()
    looks: list[dict[str, float]] = []
    while (elapsed := time.monotonic() - begin) < seconds:
        looks.append(
            {
                "time": elapsed,
                "server": server.memory_info().rss / 2**20,
                "browser": sum(_memory(each) for each in psutil.Process().children(recursive=True)),
                "heap": max(page.evaluate("performance.memory.usedJSHeapSize") for page in pages) / 2**20,
            }
        )
        time.sleep(LOOK)
    cpu = float((sum(server.cpu_times()[:2]) - used) / (time.monotonic() - begin))
    after = [page.evaluate(counted) for page in pages]
    rates = [
        [(new - old) / (late[0] - early[0]) * 1e3 for old, new in zip(early[1:], late[1:], strict=True)]
        for early, late in zip(before, after, strict=True)
    ]
    return (
        looks,
        cpu,
        {"frames": min(each[0] for each in rates), "kB": statistics.mean(each[1] for each in rates) / 1e3},
    )


def _memory(process: psutil.Process) -> float:
    """Return the memory of a renderer of the browser that belongs to it alone [MB], 0 of any other process."""
    with suppress(psutil.Error):
        if "--type=renderer" in process.cmdline():
            return float(process.memory_full_info().uss / 2**20)
    return 0.0


def describe(found: dict[str, Any]) -> str:
    """Return the results beside the bars."""
    looks = found["looks"]
    third = max(1, len(looks) // 3)
    lines = [
        f"first picture    {found['first picture']:8.1f} s    {_bar(found['first picture'] < 3)}",
        f"  the page is served after {found['served']:.1f} s, and has all vehicles after {found['all vehicles']:.1f} s",
        f"frames           {found['frames']:8.0f} /s   {_bar(found['frames'] >= 25)}, of the slowest viewer",
        f"each viewer      {found['each viewer']:8.0%} of a core    {_bar(found['each viewer'] < 0.25)}",
        f"  beside {found['reader']:.0%} of the reader alone",
        f"sent             {found['kB']:8.0f} kB/s to each viewer",
    ]
    for name in ("server", "browser", "heap"):
        middle, late = (
            statistics.median(look[name] for look in part)
            for part in (looks[third : 2 * third] or looks, looks[-third:])
        )
        lines.append(f"memory, {name:8} {middle:8.0f} -> {late:.0f} MB    {_bar(late <= GROWTH * middle)}")
    return "\n".join(lines)


def _bar(holds: bool) -> str:
    return "holds" if holds else "MISSED"


if __name__ == "__main__":
    main()
