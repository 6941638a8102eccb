"""Debian's Prometheus for tests: `promtool`, and a running server to query."""

from __future__ import annotations

import json
import os
import shutil
import urllib.request
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

import pytest

from tests.peers.ports import free_port
from tests.peers.processes import Process, Start
from tests.waits import wait_for

PACKAGING: Final = Path(__file__).parents[2] / "packaging"
ALERTS: Final = PACKAGING / "prometheus" / "alerts.yml"
# `start` starts Python; this script opens a file as stdin and replaces itself with another program.
_EXEC_SCRIPT: Final = (
    "import os, sys; "
    "os.dup2(os.open(sys.argv[1], os.O_RDONLY), 0); os.execv(sys.argv[2], sys.argv[2:])"
)


def find_program(name: str) -> str:
    """Return the path of `prometheus` or `promtool`; skip the test if it is not installed."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"no {name}: apt-get install --no-install-recommends prometheus")
    return path


def start_promtool(start: Start, *arguments: str, stdin: Path | str = os.devnull) -> Process:
    """Start promtool with a file as its stdin; `start` kills it at the end of the test."""
    return start("-c", _EXEC_SCRIPT, os.fspath(stdin), find_program("promtool"), *arguments)


class Prometheus:
    """A Prometheus server that scrapes and evaluates rules every second; `start` kills it at the end of the test."""

    def __init__(self, start: Start, folder: Path, rules: str, jobs: dict[str, list[str]]) -> None:
        program = find_program("prometheus")
        (folder / "alerts.yml").write_text(rules)
        scraped = [
            {"job_name": job, "static_configs": [{"targets": targets}]}
            for job, targets in jobs.items()
        ]
        every = {"scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s"}
        config = folder / "prometheus.yml"  # JSON is YAML
        config.write_text(
            json.dumps({"global": every, "rule_files": ["alerts.yml"], "scrape_configs": scraped})
        )
        self._url = f"http://127.0.0.1:{free_port()}"
        self.process = start(
            "-c", _EXEC_SCRIPT, os.devnull, program,
            f"--config.file={config}", f"--storage.tsdb.path={folder / 'data'}",
            f"--web.listen-address={self._url.removeprefix('http://')}", "--log.level=warn",
        )  # fmt: skip
        wait_for(self._is_ready, what=f"Prometheus: {self.process.err}")

    def alerts(self, name: str, **labels: str) -> list[dict[str, str]]:
        """Return the labels of the alert's firing instances that have these labels."""
        firing = [
            each["labels"]
            for each in self._get("/api/v1/alerts")["alerts"]
            if each["state"] == "firing"
        ]
        return [each for each in firing if {"alertname": name, **labels}.items() <= each.items()]

    def annotations(self) -> list[str]:
        """Return the annotations of all alerts, including pending ones."""
        return [
            text
            for each in self._get("/api/v1/alerts")["alerts"]
            for text in each["annotations"].values()
        ]

    def query(self, expression: str) -> list[tuple[dict[str, str], float]]:
        """Return the labels and the current value of each series of an expression."""
        result = self._get(f"/api/v1/query?query={quote(expression)}")["result"]
        return [(each["metric"], float(each["value"][1])) for each in result]

    def scrape_errors(self) -> dict[str, str]:
        """Return the last scrape error of each target by address; "" if there was none."""
        targets = self._get("/api/v1/targets")["activeTargets"]
        return {each["labels"]["instance"]: each["lastError"] for each in targets}

    def _is_ready(self) -> bool:
        try:
            urllib.request.urlopen(f"{self._url}/-/ready", timeout=5).close()  # noqa: S310 - http, on loopback
        except OSError:
            return False
        return True

    def _get(self, path: str) -> Any:
        with urllib.request.urlopen(f"{self._url}{path}", timeout=10) as answer:  # noqa: S310 - http, on loopback
            return json.load(answer)["data"]
