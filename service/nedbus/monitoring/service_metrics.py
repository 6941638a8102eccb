"""The metrics of a service for Prometheus; needs the extra `metrics`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from nedbus.daemon import STATES, Daemon, SourceMeasures

from .exposition import build_info
from .families import Stream, histogram, is_switched_off, stream_families, vehicle_families

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
        measures = daemon.measures
        sources = _with_names(measures)
        yield build_info(daemon.version)
        yield GaugeMetricFamily("nedbus_start_time_seconds", "When the service started", value=daemon.started)
        sessions = GaugeMetricFamily(
            "nedbus_sessions", "Zenoh sessions at the embedded router, or routers of a client", labels=["role"]
        )
        sessions.add_metric([daemon.role], daemon.sessions)
        yield sessions
        room = GaugeMetricFamily("nedbus_sessions_max", "Sessions that the embedded router accepts", labels=["role"])
        if daemon.max_sessions is not None:
            room.add_metric([daemon.role], daemon.max_sessions)
        yield room
        refused = GaugeMetricFamily(
            "nedbus_vehicle_refused",
            "1 for a vehicle that the access rules of the router keep from everybody, 0 for one that they let through",
            labels=["vehicle"],
        )
        for vehicle, is_refused in daemon.refused.items():
            refused.add_metric([vehicle], is_refused)
        yield refused
        streams = [stream for name, source in sources for stream in _streams(name, source)]
        yield from stream_families(streams, messages=_PUBLISHED)
        yield from vehicle_families(daemon.look(measures), streams)
        yield from _source_families(sources)


def _with_names(sources: Iterable[SourceMeasures]) -> list[tuple[str, SourceMeasures]]:
    """Return each source with its label: two that are configured alike must not be one time series."""
    seen: Counter[str] = Counter()
    named = []
    for measures in sources:
        text = measures.status.source
        seen[text] += 1
        named.append((text if seen[text] == 1 else f"{text} ({seen[text]})", measures))
    return named


def _streams(name: str, measures: SourceMeasures) -> Iterator[Stream]:
    status = measures.status
    stale = frozenset(status.stale)
    for stream in measures.streams:
        vehicle, _, topic = stream.address.partition("/")
        gone = status.ended or (stream.address in stale and is_switched_off(stream.health))
        yield Stream(vehicle, topic, name, stream.health, active=not gone)


def _source_families(sources: Iterable[tuple[str, SourceMeasures]]) -> Iterator[Metric]:
    total = CounterMetricFamily(
        "nedbus_source_rejected", "Messages that were not published, whatever rule they violate", labels=["source"]
    )
    rejected = CounterMetricFamily(
        "nedbus_messages_rejected",
        "Messages that were not published, by the rule they violate",
        labels=["source", "rule"],
    )
    lost = CounterMetricFamily(
        "nedbus_source_lost", "Messages that were lost before they reached the source", labels=["source"]
    )
    addresses = GaugeMetricFamily(
        "nedbus_source_addresses",
        "Addresses of a replay, or those that a live source publishes now: 0 while nothing arrives",
        labels=["source"],
    )
    state = GaugeMetricFamily("nedbus_source_state", "1 for the state that a source is in", labels=["source", "state"])
    restarts = CounterMetricFamily(
        "nedbus_source_restarts", "Times that a source failed, and began again", labels=["source"]
    )
    durations = HistogramMetricFamily(
        "nedbus_publish_duration_seconds", "Time to validate, encode and send a message", labels=["source"]
    )
    for name, measures in sources:
        status = measures.status
        total.add_metric([name], status.rejected)
        for rule, count in status.rejections.items():
            rejected.add_metric([name, rule], count)
        lost.add_metric([name], status.lost)
        addresses.add_metric([name], len(status.addresses))
        for each in STATES:
            state.add_metric([name, each], each == status.state)
        restarts.add_metric([name], status.retries)
        histogram(durations, [name], measures.durations)
    yield from (total, rejected, lost, addresses, state, restarts, durations)
