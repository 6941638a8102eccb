"""What all pages of metrics have in common; needs the extra `metrics`."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Iterator
from importlib.metadata import version as version_of
from typing import Final

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import InfoMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector
from prometheus_client.utils import floatToGoString

from .http_server import Page

_SUFFIXES: Final = {"counter": "_total", "info": "_info"}  # of the names of metrics, by type
_number: Final[Callable[[float], str]] = floatToGoString  # it has no types of its own


def build_info(version: str) -> Metric:
    """Return what runs here."""
    versions = {"version": version, "python": platform.python_version(), "zenoh": version_of("eclipse-zenoh")}
    return InfoMetricFamily("nedbus_build", "Versions", value=versions)


def metrics_page(collector: Collector) -> Page:
    """Return the metrics of a collector, and of this process."""
    registry = CollectorRegistry()
    registry.register(collector)
    ProcessCollector(registry=registry)
    return Page(200, CONTENT_TYPE_PLAIN_0_0_4, "".join(_lines(registry.collect())).encode())


def _lines(metrics: Iterable[Metric]) -> Iterator[str]:
    """Write what `generate_latest` writes; its checks of names, which are constants here, take most of its time."""
    for metric in metrics:
        name = metric.name + _SUFFIXES.get(metric.type, "")
        yield f"# HELP {name} {metric.documentation}\n"
        yield f"# TYPE {name} {'gauge' if metric.type == 'info' else metric.type}\n"
        for sample in metric.samples:
            labels = ",".join([f'{label}="{_escape(value)}"' for label, value in sorted(sample.labels.items())])
            yield f"{sample.name}{{{labels}}} " if labels else f"{sample.name} "
            yield f"{_number(sample.value)}\n"


def _escape(value: str) -> str:
    return value.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")
