"""The metrics of a service for Prometheus; needs the extra `metrics`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from nedbus.daemon import STATES, Daemon, SourceMeasures

from .exposition import build_info
from .families import Stream, histogram, stream_families

_PUBLISHED = "nedbus_messages_published", "Messages that were validated and published"


class ServiceCollector(Collector):
    """Collect the metrics of a daemon when they are asked for: nothing is done for them while it publishes."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon

    def describe(self) -> Iterable[Metric]:
        """Return nothing: what there is depends on the sources."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        daemon = self._daemon
        status, sources = daemon.status, daemon.measures
        yield build_info(status.version)
        yield GaugeMetricFamily("nedbus_start_time_seconds", "When the service started", value=status.started)
        sessions = GaugeMetricFamily(
            "nedbus_sessions", "Zenoh sessions at the embedded router, or routers of a client", labels=["role"]
        )
        sessions.add_metric([status.role], daemon.sessions)
        yield sessions
        streams = [stream for source in sources for stream in _streams(source)]
        yield from stream_families(streams, messages=_PUBLISHED)
        yield from _source_families(sources)


def _streams(measures: SourceMeasures) -> Iterator[Stream]:
    status = measures.status
    for stream in measures.streams:
        vehicle, _, topic = stream.address.partition("/")
        yield Stream(vehicle, topic, status.source, stream.health, active=not status.ended)


def _source_families(sources: Iterable[SourceMeasures]) -> Iterator[Metric]:
    rejected = CounterMetricFamily(
        "nedbus_messages_rejected",
        "Messages that were not published, by the rule they violate",
        labels=["source", "rule"],
    )
    lost = CounterMetricFamily(
        "nedbus_source_lost", "Messages that were lost before they reached the source", labels=["source"]
    )
    state = GaugeMetricFamily("nedbus_source_state", "1 for the state that a source is in", labels=["source", "state"])
    restarts = CounterMetricFamily(
        "nedbus_source_restarts", "Times that a source failed, and began again", labels=["source"]
    )
    durations = HistogramMetricFamily(
        "nedbus_publish_duration_seconds", "Time to validate, encode and send a message", labels=["source"]
    )
    for measures in sources:
        status = measures.status
        name = status.source
        for rule, count in status.rejections.items():
            rejected.add_metric([name, rule], count)
        lost.add_metric([name], status.lost)
        for each in STATES:
            state.add_metric([name, each], each == status.state)
        restarts.add_metric([name], status.retries)
        histogram(durations, [name], measures.durations)
    yield from (rejected, lost, state, restarts, durations)
