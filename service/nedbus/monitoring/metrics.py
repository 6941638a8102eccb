"""Metrics for Prometheus: of a service, of streams and of vehicles, collected at each scrape.

Needs the extra `metrics`. Names and units follow https://prometheus.io/docs/practices/naming/.
Labels: `vehicle`, `topic` as `nedbus list` shows it (estimator_local_position/0), `source` as it was configured.
"""

from __future__ import annotations

import platform
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version as version_of
from itertools import accumulate
from typing import Any, Final

from prometheus_client import ProcessCollector, core, generate_latest
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

_COUNTER, _GAUGE, _HISTOGRAM = core.CounterMetricFamily, core.GaugeMetricFamily, core.HistogramMetricFamily
_STREAM: Final = ("vehicle", "topic", "source")
_SOURCE: Final = ("source",)

METRICS: Final[Mapping[str, tuple[Any, Sequence[str], str]]] = {
    # of a service
    "nedbus_start_time_seconds": (_GAUGE, (), "When the service started"),
    "nedbus_sessions": (_GAUGE, ("role",), "Zenoh sessions at the embedded router, or routers of a client"),
    "nedbus_sessions_max": (_GAUGE, ("role",), "Sessions that the embedded router accepts"),
    "nedbus_vehicle_refused": (
        _GAUGE, ("vehicle",),
        "1 for a vehicle that the access rules of the router keep from everybody, 0 for one that they let through",
    ),
    "nedbus_messages_published": (_COUNTER, _STREAM, "Messages that were validated and published"),
    # of an exporter
    "nedbus_connected": (_GAUGE, (), "1 while there is a link to a router"),
    "nedbus_messages_dropped": (_COUNTER, (), "Messages for which the exporter was too slow"),
    "nedbus_messages_invalid": (_COUNTER, (), "Payloads that were no valid message"),
    "nedbus_queue_messages": (_GAUGE, (), "Messages that wait to be read"),
    "nedbus_router_sessions": (_GAUGE, ("router",), "Zenoh sessions at a router of the network, by its id"),
    "nedbus_router_sessions_max": (_GAUGE, ("router",), "Sessions that a router accepts"),
    "nedbus_messages_received": (_COUNTER, _STREAM, "Messages that arrived here, were valid and were read"),
    # of streams
    "nedbus_messages_lost": (_COUNTER, _STREAM, "Messages that were lost in transit before they came here, for good"),
    "nedbus_time_gaps": (_COUNTER, _STREAM, "Steps of PX4's own time of more than three usual ones"),
    "nedbus_messages_out_of_order": (_COUNTER, _STREAM, "Messages whose time is before that of the one before"),
    "nedbus_reboots": (_COUNTER, _STREAM, "Times that PX4's own time began anew"),
    "nedbus_resets": (_COUNTER, (*_STREAM, "quantity"), "Resets of the estimator, by quantity"),
    "nedbus_stream_age_seconds": (_GAUGE, _STREAM, "Seconds since the last message"),
    "nedbus_stream_rate_hertz": (_GAUGE, _STREAM, "Messages a second, over the last full second"),
    "nedbus_stream_usual_rate_hertz": (_GAUGE, _STREAM, "Messages a second that this stream has had so far"),
    "nedbus_stream_jitter_seconds": (_GAUGE, _STREAM, "Standard deviation of the intervals of the last second"),
    "nedbus_stream_flag_ratio": (
        _GAUGE, (*_STREAM, "flag"), "Share of the messages of the last second with this flag set",
    ),
    "nedbus_latency_seconds": (_HISTOGRAM, _STREAM, "Time from the publisher to here, by the clocks of both hosts"),
    "nedbus_streams": (_GAUGE, (), "Streams that are known"),
    # of vehicles
    "nedbus_vehicle_state": (_GAUGE, ("vehicle", "state"), "1 for the state that a vehicle is in"),
    "nedbus_vehicle_condition": (
        _GAUGE, ("vehicle", "condition"),
        "1 for what holds, or happened in the last minute, and is bad or to be watched",
    ),
    "nedbus_vehicle_events": (_COUNTER, ("vehicle", "severity"), "Events of a vehicle"),
    # of sources
    "nedbus_source_rejected": (_COUNTER, _SOURCE, "Messages that were not published, whatever rule they violate"),
    "nedbus_messages_rejected": (
        _COUNTER, ("source", "rule"), "Messages that were not published, by the rule they violate",
    ),
    "nedbus_source_lost": (_COUNTER, _SOURCE, "Messages that were lost before they reached the source"),
    "nedbus_source_addresses": (
        _GAUGE, _SOURCE, "Addresses of a replay, or those that a live source publishes now: 0 while nothing arrives",
    ),
    "nedbus_source_state": (_GAUGE, ("source", "state"), "1 for the state that a source is in"),
    "nedbus_source_restarts": (_COUNTER, _SOURCE, "Times that a source failed, and began again"),
    "nedbus_publish_duration_seconds": (_HISTOGRAM, _SOURCE, "Time to validate, encode and send a message"),
}  # fmt: skip
"""Each metric by its name: its type, its labels, and its help text."""


@dataclass(frozen=True, slots=True)
class Stream:
    """The measurements of one stream; `labels`: vehicle, topic and source.

    `active` unless its source has ended, or its vehicle was switched off: then it has counts, and no age or rate.
    """

    labels: tuple[str, str, str]
    health: Health
    active: bool = True
    latencies: Histogram | None = None


def metrics_page(metrics: Iterable[core.Metric]) -> Page:
    """Return metrics, and those of this process, in Prometheus's text format."""

    class Metrics(Collector):
        def collect(self) -> Iterator[core.Metric]:
            yield from metrics
            yield from ProcessCollector(registry=None).collect()

    return Page(200, CONTENT_TYPE_PLAIN_0_0_4, generate_latest(Metrics()))


def build_info(version: str) -> core.Metric:
    """Return the versions of nedbus, Python and Zenoh."""
    versions = {"version": version, "python": platform.python_version(), "zenoh": version_of("eclipse-zenoh")}
    return core.InfoMetricFamily("nedbus_build", "Versions", value=versions)


def make_metrics(series: Mapping[str, Iterable[tuple[Any, ...]]]) -> Iterator[core.Metric]:
    """Yield metrics by name with their series: the values of the labels, and a value, or buckets and sum."""
    for name, rows in series.items():
        kind, labels, text = METRICS[name]
        metric = kind(name, text, labels=labels)
        for row in rows:
            metric.add_metric(*row)
        yield metric


def is_switched_off(health: Health) -> bool:
    """Return whether a stream without a publisher has been silent long enough to be taken for switched off."""
    return health.age is not None and health.age >= SWITCHED_OFF


def stream_metrics(streams: Sequence[Stream], *, messages: str) -> Iterator[core.Metric]:
    """Yield the metrics of streams; `messages` is the name of the counter of messages."""
    streams = sorted(streams, key=lambda stream: not stream.health.resets)  # which only positions have
    named = streams[:MAX_STREAMS]
    rest = [replace(stream, labels=("other", "other", stream.labels[2])) for stream in streams[MAX_STREAMS:]]
    active = [stream for stream in named if stream.active]

    def count(attribute: str) -> Iterable[tuple[tuple[str, ...], int]]:
        totals: Counter[tuple[str, ...]] = Counter()
        for stream in (*named, *rest):
            totals[stream.labels] += getattr(stream.health, attribute)
        return totals.items()

    def measure(attribute: str, of: Iterable[Stream] = active) -> Iterator[tuple[tuple[str, ...], float]]:
        values = ((stream.labels, getattr(stream.health, attribute)) for stream in of)
        return ((labels, value) for labels, value in values if value is not None)

    return make_metrics({
        messages: count("messages"),
        "nedbus_messages_lost": count("lost"),
        "nedbus_time_gaps": count("gaps"),
        "nedbus_messages_out_of_order": count("out_of_order"),
        "nedbus_reboots": count("reboots"),
        # Without a rate, alerts would take an age for silence.
        "nedbus_stream_age_seconds": measure("age", [stream for stream in active if stream.health.nominal]),
        "nedbus_stream_rate_hertz": measure("rate"),
        "nedbus_stream_usual_rate_hertz": measure("usual_rate"),
        "nedbus_stream_jitter_seconds": measure("jitter"),
        "nedbus_stream_flag_ratio": (
            ((*each.labels, flag), share) for each in active for flag, share in (each.health.flags or {}).items()
        ),
        "nedbus_resets": (
            ((*each.labels, quantity), total) for each in named for quantity, total in each.health.resets.items()
        ),
        "nedbus_latency_seconds": (
            _histogram_row(each.labels, each.latencies) for each in named if each.latencies is not None
        ),
        "nedbus_streams": [((), len(streams))],
    })  # fmt: skip


def vehicle_metrics(account: Account, streams: Iterable[Stream]) -> Iterator[core.Metric]:
    """Yield the metrics of vehicles; one without an active stream has counts, and no state."""
    now, vehicles = time.time(), list(account.vehicles)
    active = {stream.labels[0] for stream in streams if stream.active}
    states = {name: account.state(name, now) for name in vehicles if name in active}
    kinds = {name: sorted({condition.kind for condition in state.conditions}) for name, state in states.items()}
    yield from make_metrics({
        "nedbus_vehicle_state": [
            ((name, "ok" if severity == "info" else severity), severity == state.severity)
            for name, state in states.items() for severity in SEVERITIES
        ],
        "nedbus_vehicle_condition": [((name, kind), 1) for name in kinds for kind in kinds[name]],
        "nedbus_vehicle_events": [
            ((name, severity), account.counts[name, severity]) for name in vehicles for severity in SEVERITIES
        ],
    })  # fmt: skip


def service_metrics(daemon: Daemon) -> Iterator[core.Metric]:
    """Yield all metrics of a daemon."""
    sources = _by_label(daemon.measures)
    yield build_info(daemon.version)
    yield from make_metrics({
        "nedbus_start_time_seconds": [((), daemon.started)],
        "nedbus_sessions": [((daemon.role,), daemon.sessions)],
        "nedbus_sessions_max": [] if daemon.max_sessions is None else [((daemon.role,), daemon.max_sessions)],
        "nedbus_vehicle_refused": [((vehicle,), is_refused) for vehicle, is_refused in daemon.refused.items()],
    })  # fmt: skip
    streams = [stream for label, measures in sources.items() for stream in _streams(label, measures)]
    yield from stream_metrics(streams, messages="nedbus_messages_published")
    yield from vehicle_metrics(daemon.look(list(sources.values())), streams)
    of = {label: measures.status for label, measures in sources.items()}
    yield from make_metrics({
        "nedbus_source_rejected": [((label,), status.rejected) for label, status in of.items()],
        "nedbus_messages_rejected": [
            ((label, rule), count) for label, status in of.items() for rule, count in status.rejections.items()
        ],
        "nedbus_source_lost": [((label,), status.lost) for label, status in of.items()],
        "nedbus_source_addresses": [((label,), len(status.addresses)) for label, status in of.items()],
        "nedbus_source_state": [
            ((label, state), state == status.state) for label, status in of.items() for state in STATES
        ],
        "nedbus_source_restarts": [((label,), status.retries) for label, status in of.items()],
        "nedbus_publish_duration_seconds": [
            _histogram_row((label,), measures.durations) for label, measures in sources.items()
        ],
    })  # fmt: skip


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
        yield Stream((vehicle, topic, source), stream.health, active=not (measures.status.ended or is_off))


def _histogram_row(labels: Sequence[str], measured: Histogram) -> tuple[Any, ...]:
    limits = (*map(str, measured.limits), "+Inf")
    return labels, list(zip(limits, accumulate(map(float, measured.counts)), strict=True)), measured.sum
