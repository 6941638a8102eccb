"""The page of the metrics, as a service and an exporter show them."""

from __future__ import annotations

import ast
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import nedbus

from .markdown import cell, code, page, table

_DEADLINE = 60.0


def metrics_page() -> str:
    """Return the page of all metrics of a service with a simulated vehicle, and of an exporter beside it."""
    rows = {family: [code(family), kind, code(labels), cell(text)] for family, kind, labels, text in metrics()}
    return page(
        "Metrics",
        "A service shows them at `/metrics` with `--http`, and `nedbus export` of what a reader sees; "
        "[operating it](../operate.md) says what to do with them.",
        "Those of `process_*` and `python_*` are as every client of Prometheus has them.",
        table(["metric", "kind", "labels", "is"], rows.values()),
    )


def metrics() -> list[tuple[str, str, str, str]]:
    """Return the name, kind, labels and meaning of each metric."""
    from prometheus_client.parser import text_string_to_metric_families  # noqa: PLC0415 - an extra

    labels = dict(_labels())
    found = {}
    for text in _scrape():
        for family in text_string_to_metric_families(text):
            if not family.name.startswith("nedbus_"):
                continue
            name = family.name + "_total" * (family.type == "counter")
            sampled = [name for each in family.samples[:1] for name in each.labels if name != "le"]
            shown = ", ".join(labels.get(family.name) or sampled)
            found[name] = (name, family.type, shown, family.documentation)
    return list(found.values())


def _labels() -> Iterator[tuple[str, list[str]]]:
    """Yield the labels of families that are written out in the code: those of one without a sample yet."""
    for path in Path(nedbus.__path__[0], "monitoring").rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text())):
            if isinstance(call, ast.Call) and ast.unparse(call.func).endswith("MetricFamily"):
                given = {each.arg: each.value for each in call.keywords}
                if call.args and isinstance(call.args[0], ast.Constant) and "labels" in given:
                    names = [each.value for each in ast.walk(given["labels"]) if isinstance(each, ast.Constant)]
                    if not any(isinstance(each, ast.Starred) for each in ast.walk(given["labels"])):
                        yield str(call.args[0].value), [str(name) for name in names]


def _scrape() -> list[str]:
    """Return `/metrics` of a service and of an exporter."""
    router, *pages = (f"127.0.0.1:{_free_port()}" for _ in range(3))
    serve = ["serve", "--source", "sim:?speed=10", "--listen", f"tcp/{router}", "--http", pages[0]]
    with ExitStack() as stack:
        stack.enter_context(_running(*serve))
        nedbus.connect(f"tcp/{router}", timeout=_DEADLINE).close()
        stack.enter_context(_running("export", "--connect", f"tcp/{router}", "--http", pages[1]))
        return [
            _page(where, until)
            for where, until in zip(pages, ("usual_rate_hertz{", "nedbus_latency_seconds_sum{"), strict=True)
        ]


@contextmanager
def _running(*arguments: str) -> Iterator[None]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("NEDBUS_")}
    command = [sys.executable, "-m", "nedbus", "--log-level", "error", *arguments]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(_DEADLINE)


def _page(where: str, until: str) -> str:
    deadline = time.monotonic() + _DEADLINE
    while True:
        try:
            with urllib.request.urlopen(f"http://{where}/metrics", timeout=10) as answer:
                text = str(answer.read().decode())
        except OSError:
            text = ""
        if until in text:
            return text
        if time.monotonic() > deadline:
            raise TimeoutError(where)
        time.sleep(0.1)


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])
