"""What all pages of metrics have in common; needs the extra `metrics`."""

from __future__ import annotations

import platform
from importlib.metadata import version as version_of

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import InfoMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from .http_server import Page


def build_info(version: str) -> Metric:
    """Return what runs here."""
    versions = {"version": version, "python": platform.python_version(), "zenoh": version_of("eclipse-zenoh")}
    return InfoMetricFamily("nedbus_build", "Versions", value=versions)


def metrics_page(collector: Collector) -> Page:
    """Return the metrics of a collector, and of this process."""
    registry = CollectorRegistry()
    registry.register(collector)
    ProcessCollector(registry=registry)
    return Page(200, CONTENT_TYPE_PLAIN_0_0_4, generate_latest(registry))
