"""Metrics for Prometheus: of a service, of streams and of vehicles, collected at each scrape.

Needs the extra `metrics`. Names and units follow https://prometheus.io/docs/practices/naming/.
Labels: `vehicle`, `topic` as `nedbus list` shows it (estimator_local_position/0), `source` as it was configured.
"""

from __future__ import annotations

import platform
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version as version_of
from itertools import accumulate
from typing import Any, Final, cast

from prometheus_client import ProcessCollector, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from nedbus.client import Health, Histogram
from nedbus.daemon import STATES, Daemon, SourceMeasures
from nedbus.events import SEVERITIES, Account

from .http_server import Page

MAX_STREAMS: Final = 1000
"""Streams with labels of their own, positions first; counts of the rest are added up as vehicle and topic "other"."""

SWITCHED_OFF: Final = 3600.0
"""Seconds of silence after which a stream without a publisher is not active."""

_STREAM: Final = ("vehicle", "topic", "source")
_COUNTERS: Final = {
    "lost": ("nedbus_messages_lost", "Messages that were lost in transit before they came here, for good"),
    "gaps": ("nedbus_time_gaps", "Steps of PX4's own time of more than three usual ones"),
    "out_of_order": ("nedbus_messages_out_of_order", "Messages whose time is before that of the one before"),
    "reboots": ("nedbus_reboots", "Times that PX4's own time began anew"),
}
_GAUGES: Final = {
    "age": ("nedbus_stream_age_seconds", "Seconds since the last message"),
    "rate": ("nedbus_stream_rate_hertz", "Messages a second, over the last full second"),
    "usual_rate": ("nedbus_stream_usual_rate_hertz", "Messages a second that this stream has had so far"),
    "jitter": ("nedbus_stream_jitter_seconds", "Standard deviation of the intervals of the last second"),
}
_SOURCE_COUNTERS: Final = {
    "rejected": ("nedbus_source_rejected", "Messages that were not published, whatever rule they violate"),
    "lost": ("nedbus_source_lost", "Messages that were lost before they reached the source"),
    "retries": ("nedbus_source_restarts", "Times that a source failed, and began again"),
}


@dataclass(frozen=True, slots=True)
class Stream:
    """The measurements of one stream.

    `active` unless its source has ended, or its vehicle was switched off: then it has counts, and no age or rate.
    """

    vehicle: str
    topic: str
    source: str
    health: Health
    active: bool = True
    latencies: Histogram | None = None

    @property
    def labels(self) -> list[str]:
        """The values of the labels of a stream."""
        return [self.vehicle, self.topic, self.source]


def metrics_page(families: Iterable[Metric]) -> Page:
    """Return metrics, and those of this process, in Prometheus's text format."""

    class Families(Collector):
        def collect(self) -> Iterator[Metric]:
            yield from families
            yield from ProcessCollector(registry=None).collect()

    return Page(200, CONTENT_TYPE_PLAIN_0_0_4, generate_latest(Families()))


def build_info(version: str) -> Metric:
    """Return the versions of nedbus, Python and Zenoh."""
    versions = {"version": version, "python": platform.python_version(), "zenoh": version_of("eclipse-zenoh")}
    return InfoMetricFamily("nedbus_build", "Versions", value=versions)


def is_switched_off(health: Health) -> bool:
    """Return whether a stream without a publisher has been silent long enough to be taken for switched off."""
    return health.age is not None and health.age >= SWITCHED_OFF


def stream_families(streams: Sequence[Stream], *, messages: tuple[str, str]) -> Iterator[Metric]:
    """Yield the metrics of streams; `messages` is the name of the counter of messages, and its help text."""
    streams = sorted(streams, key=lambda stream: not stream.health.resets)  # which only positions have
    named, rest = streams[:MAX_STREAMS], streams[MAX_STREAMS:]
    for attribute, (name, text) in {"messages": messages, **_COUNTERS}.items():
        others: Counter[str] = Counter()
        for stream in rest:
            others[stream.source] += getattr(stream.health, attribute)
        yield _fill(CounterMetricFamily(name, text, labels=_STREAM), [
            *((stream.labels, getattr(stream.health, attribute)) for stream in named),
            *((["other", "other", source], count) for source, count in others.items()),
        ])  # fmt: skip
    active = [stream for stream in named if stream.active]
    for attribute, (name, text) in _GAUGES.items():
        values = [
            (stream.labels, getattr(stream.health, attribute))
            for stream in active
            if stream.health.nominal or attribute != "age"  # without a rate, alerts would take an age for silence
        ]
        yield _fill(GaugeMetricFamily(name, text, labels=_STREAM), (row for row in values if row[1] is not None))
    text = "Share of the messages of the last second with this flag set"
    yield _fill(
        GaugeMetricFamily("nedbus_stream_flag_ratio", text, labels=(*_STREAM, "flag")),
        (([*each.labels, flag], share) for each in active for flag, share in (each.health.flags or {}).items()),
    )
    yield _fill(
        CounterMetricFamily("nedbus_resets", "Resets of the estimator, by quantity", labels=(*_STREAM, "quantity")),
        (([*each.labels, quantity], count) for each in named for quantity, count in each.health.resets.items()),
    )
    latencies = [_histogram_row(each.labels, each.latencies) for each in named if each.latencies is not None]
    if latencies:
        text = "Time from the publisher to here, by the clocks of both hosts"
        yield _fill(HistogramMetricFamily("nedbus_latency_seconds", text, labels=_STREAM), latencies)
    yield GaugeMetricFamily("nedbus_streams", "Streams that are known", value=len(streams))


def vehicle_families(account: Account, streams: Iterable[Stream]) -> Iterator[Metric]:
    """Yield the metrics of vehicles; one without an active stream has counts, and no state."""
    now, vehicles = time.time(), list(account.vehicles)
    active = {stream.vehicle for stream in streams if stream.active}
    states = {name: account.state(name, now) for name in vehicles if name in active}
    yield _fill(
        GaugeMetricFamily(
            "nedbus_vehicle_state", "1 for the state that a vehicle is in", labels=("vehicle", "state")
        ),
        (
            ([name, "ok" if severity == "info" else severity], severity == state.severity)
            for name, state in states.items()
            for severity in SEVERITIES
        ),
    )  # fmt: skip
    text = "1 for what holds, or happened in the last minute, and is bad or to be watched"
    kinds = {name: sorted({condition.kind for condition in state.conditions}) for name, state in states.items()}
    yield _fill(
        GaugeMetricFamily("nedbus_vehicle_condition", text, labels=("vehicle", "condition")),
        (([name, kind], 1) for name in kinds for kind in kinds[name]),
    )
    yield _fill(
        CounterMetricFamily("nedbus_vehicle_events", "Events of a vehicle", labels=("vehicle", "severity")),
        (([name, severity], account.counts[name, severity]) for name in vehicles for severity in SEVERITIES),
    )


def service_families(daemon: Daemon) -> Iterator[Metric]:
    """Yield all metrics of a daemon."""
    sources = _by_label(daemon.measures)
    yield build_info(daemon.version)
    yield GaugeMetricFamily("nedbus_start_time_seconds", "When the service started", value=daemon.started)
    text = "Zenoh sessions at the embedded router, or routers of a client"
    yield _fill(GaugeMetricFamily("nedbus_sessions", text, labels=["role"]), [([daemon.role], daemon.sessions)])
    text = "Sessions that the embedded router accepts"
    room = [] if daemon.max_sessions is None else [([daemon.role], daemon.max_sessions)]
    yield _fill(GaugeMetricFamily("nedbus_sessions_max", text, labels=["role"]), room)
    text = "1 for a vehicle that the access rules of the router keep from everybody, 0 for one that they let through"
    yield _fill(
        GaugeMetricFamily("nedbus_vehicle_refused", text, labels=["vehicle"]),
        (([vehicle], is_refused) for vehicle, is_refused in daemon.refused.items()),
    )
    streams = [stream for label, measures in sources.items() for stream in _streams(label, measures)]
    published = "nedbus_messages_published", "Messages that were validated and published"
    yield from stream_families(streams, messages=published)
    yield from vehicle_families(daemon.look(list(sources.values())), streams)
    yield from _source_families(sources)


def _by_label(sources: Iterable[SourceMeasures]) -> dict[str, SourceMeasures]:
    """Return each source by its label: two that are configured alike must not be one time series."""
    seen: Counter[str] = Counter()
    labelled = {}
    for measures in sources:
        text = measures.status.source
        seen[text] += 1
        labelled[text if seen[text] == 1 else f"{text} ({seen[text]})"] = measures
    return labelled


def _streams(source: str, measures: SourceMeasures) -> Iterator[Stream]:
    for stream in measures.streams:
        vehicle, _, topic = stream.address.partition("/")
        is_off = stream.address in measures.status.stale and is_switched_off(stream.health)
        yield Stream(vehicle, topic, source, stream.health, active=not (measures.status.ended or is_off))


def _source_families(sources: Mapping[str, SourceMeasures]) -> Iterator[Metric]:
    statuses = {label: measures.status for label, measures in sources.items()}
    for attribute, (name, text) in _SOURCE_COUNTERS.items():
        rows = [([label], getattr(status, attribute)) for label, status in statuses.items()]
        yield _fill(CounterMetricFamily(name, text, labels=["source"]), rows)
    text = "Messages that were not published, by the rule they violate"
    yield _fill(
        CounterMetricFamily("nedbus_messages_rejected", text, labels=["source", "rule"]),
        (([label, rule], count) for label, status in statuses.items() for rule, count in status.rejections.items()),
    )
    text = "Addresses of a replay, or those that a live source publishes now: 0 while nothing arrives"
    yield _fill(
        GaugeMetricFamily("nedbus_source_addresses", text, labels=["source"]),
        (([label], len(status.addresses)) for label, status in statuses.items()),
    )
    yield _fill(
        GaugeMetricFamily("nedbus_source_state", "1 for the state that a source is in", labels=["source", "state"]),
        (([label, state], state == status.state) for label, status in statuses.items() for state in STATES),
    )
    text = "Time to validate, encode and send a message"
    yield _fill(
        HistogramMetricFamily("nedbus_publish_duration_seconds", text, labels=["source"]),
        (_histogram_row([label], measures.durations) for label, measures in sources.items()),
    )


def _fill(family: Any, rows: Iterable[tuple[Any, ...]]) -> Metric:
    """Add a series for each row: the values of its labels, and its value, or the buckets and the sum of a histogram."""
    for row in rows:
        family.add_metric(*row)
    return cast("Metric", family)


def _histogram_row(labels: Sequence[str], measured: Histogram) -> tuple[Any, ...]:
    limits = (*map(str, measured.limits), "+Inf")
    return labels, list(zip(limits, accumulate(map(float, measured.counts)), strict=True)), measured.sum
