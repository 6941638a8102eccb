"""An HTTP client for the pages of a service: health, status and metrics."""

from __future__ import annotations

import http.client
from contextlib import closing

from prometheus_client.core import Metric
from prometheus_client.parser import text_string_to_metric_families

from tests.waits import DEADLINE


def read_families(text: str) -> dict[str, Metric]:
    """Return the metric families of a page by name, as Prometheus's client parses them."""
    return {each.name: each for each in text_string_to_metric_families(text)}


class HttpClient:
    """A client of the HTTP server on a port of loopback."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.where = f"127.0.0.1:{port}"

    def request(self, path: str, method: str = "GET", **headers: str) -> tuple[int, str]:
        """Return the status and the body of the response; (0, "") if there is none."""
        with closing(http.client.HTTPConnection(self.where, timeout=DEADLINE)) as connection:
            try:
                connection.request(method, path, headers=headers)
                answer = connection.getresponse()
                return answer.status, answer.read().decode()
            except (ConnectionError, http.client.HTTPException):
                return 0, ""

    def families(self) -> dict[str, Metric]:
        """Return the metric families by name; {} if the server does not respond yet."""
        status, text = self.request("/metrics")
        return read_families(text) if status == 200 else {}

    def values(self, name: str, **labels: str) -> list[float]:
        """Return the values of all series of a metric that have these labels."""
        samples = [
            each
            for family in self.families().values()
            for each in family.samples
            if each.name == name
        ]
        return [each.value for each in samples if labels.items() <= each.labels.items()]
