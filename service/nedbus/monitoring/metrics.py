"""Prometheus metrics of services, streams and vehicles, collected at each scrape.

Needs the extra `metrics`. Names and units follow https://prometheus.io/docs/practices/naming/.
Labels: `vehicle`, `topic` as shown by `nedbus list` (estimator_local_position/0), `source` as configured.
"""

import platform
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version as version_of
from itertools import accumulate
from typing import Any, Final

from prometheus_client import ProcessCollector, core, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from prometheus_client.registry import Collector

from nedbus import clock
from nedbus.daemon import STATES, Daemon, SourceMeasures
from nedbus.health import SEVERITIES, Health, Histogram, SourceStatus
from nedbus.vehicle_events import EventLog

from .http_server import Page

MAX_STREAMS: Final = 1000
"""Streams exported individually, positions first; the rest are summed as vehicle and topic "other"."""

_COUNTER = core.CounterMetricFamily
_GAUGE = core.GaugeMetricFamily
_HISTOGRAM = core.HistogramMetricFamily
_STREAM: Final = ("vehicle", "topic", "source")
_SOURCE: Final = ("source",)
_LOG_STREAM: Final = ("vehicle", "source")

METRICS: Final[Mapping[str, tuple[Any, Sequence[str], str]]] = {
    # Services
    "nedbus_start_time_seconds": (_GAUGE, (), "Start time of the service, as Unix time"),
    "nedbus_sessions":
        (_GAUGE, ("role",), "Open Zenoh sessions of the embedded router, or routers that the client is connected to"),
    "nedbus_sessions_max": (_GAUGE, ("role",), "Session limit of the embedded router"),
    "nedbus_vehicle_refused":
        (_GAUGE, ("vehicle",), "1 if the router's access rules block a vehicle's messages, else 0"),
    "nedbus_messages_published": (_COUNTER, _STREAM, "Messages validated and published"),
    "nedbus_limit_reached": (_COUNTER, ("limit",), "Messages ignored, and streams or keys evicted, because of a limit"),
    # Exporters
    "nedbus_connected": (_GAUGE, (), "1 while connected to a router, else 0"),
    "nedbus_messages_dropped": (_COUNTER, (), "Messages dropped because the exporter fell behind"),
    "nedbus_messages_invalid": (_COUNTER, (), "Payloads discarded because they are not valid messages"),
    "nedbus_queue_messages": (_GAUGE, (), "Messages queued in the exporter"),
    "nedbus_router_sessions": (_GAUGE, ("router",), "Open Zenoh sessions of a router, by router id"),
    "nedbus_router_sessions_max": (_GAUGE, ("router",), "Session limit of a router, by router id"),
    "nedbus_messages_received": (_COUNTER, _STREAM, "Valid messages received and read"),
    # Streams
    "nedbus_messages_lost": (_COUNTER, _STREAM, "Messages lost in transit and not recovered"),
    "nedbus_time_gaps": (_COUNTER, _STREAM, "Gaps in PX4 timestamps longer than three usual intervals"),
    "nedbus_messages_out_of_order": (_COUNTER, _STREAM, "Messages with a timestamp before the previous one's"),
    "nedbus_reboots": (_COUNTER, _STREAM, "Reboots detected from PX4 timestamps"),
    "nedbus_resets": (_COUNTER, (*_STREAM, "quantity"), "Estimator resets, by quantity"),
    "nedbus_stream_age_seconds": (_GAUGE, _STREAM, "Seconds since the last message"),
    "nedbus_stream_rate_hertz": (_GAUGE, _STREAM, "Message rate over the last full second"),
    "nedbus_stream_usual_rate_hertz": (_GAUGE, _STREAM, "Usual message rate of the stream"),
    "nedbus_stream_jitter_seconds":
        (_GAUGE, _STREAM, "Standard deviation of message intervals over the last second"),
    "nedbus_stream_flag_ratio":
        (_GAUGE, (*_STREAM, "flag"), "Fraction of messages with the flag set over the last second"),
    "nedbus_latency_seconds":
        (_HISTOGRAM, _STREAM, "Latency from the publisher to this host; assumes synchronized clocks"),
    "nedbus_streams": (_GAUGE, (), "Known streams"),
    # Vehicles
    "nedbus_vehicle_state": (_GAUGE, ("vehicle", "state"), "1 for the current state of a vehicle, 0 for the others"),
    "nedbus_vehicle_condition":
        (_GAUGE, ("vehicle", "condition"),
         "1 for each bad or watch condition that is active or occurred in the last minute"),
    "nedbus_vehicle_events": (_COUNTER, ("vehicle", "severity"), "Events of a vehicle, by severity"),
    # Sources
    "nedbus_source_rejected": (_COUNTER, _SOURCE, "Messages rejected by validation and not published"),
    "nedbus_messages_rejected":
        (_COUNTER, ("source", "rule"), "Messages rejected by validation and not published, by violated rule"),
    "nedbus_source_lost": (_COUNTER, _SOURCE, "Messages lost before they reached the source"),
    "nedbus_source_dropped": (_COUNTER, _SOURCE, "Lost messages that this host dropped, because it is overloaded"),
    "nedbus_source_overloaded": (_GAUGE, _SOURCE, "1 while this host does not keep up with the link, else 0"),
    "nedbus_source_addresses":
        (_GAUGE, _SOURCE, "Addresses of a replay, or those a live source currently publishes; 0 while nothing arrives"),
    "nedbus_source_state": (_GAUGE, ("source", "state"), "1 for the current state of a source, 0 for the others"),
    "nedbus_source_restarts": (_COUNTER, _SOURCE, "Restarts of a source after a failure"),
    "nedbus_log_stream_active":
        (_GAUGE, _LOG_STREAM, "1 while a vehicle's messages come from its ULog stream, 0 while converted from MAVLink"),
    "nedbus_log_stream_bytes": (_COUNTER, _LOG_STREAM, "Bytes received from a vehicle's ULog stream"),
    "nedbus_log_stream_gaps": (_COUNTER, _LOG_STREAM, "Sequence gaps in a vehicle's ULog stream"),
    "nedbus_log_stream_lost": (_COUNTER, _LOG_STREAM, "Lost LOGGING_DATA messages of a vehicle's ULog stream"),
    "nedbus_log_stream_messages_lost": (_COUNTER, _LOG_STREAM, "Estimated number of ULog messages lost in gaps"),
    "nedbus_log_stream_undecodable": (_COUNTER, _LOG_STREAM, "ULog messages without a usable definition"),
    "nedbus_log_stream_unsaved_bytes": (_COUNTER, _LOG_STREAM, "Bytes that could not be saved, although save= is set"),
    "nedbus_log_stream_delay_seconds": (_GAUGE, _LOG_STREAM, "Mean age of ULog messages when published"),
    "nedbus_log_stream_header_seconds":
        (_GAUGE, _LOG_STREAM, "Transfer time of the last ULog header; the vehicle's own log has a gap of this length"),
    "nedbus_publish_duration_seconds": (_HISTOGRAM, _SOURCE, "Time to validate, encode and send every 16th message"),
}  # fmt: skip
"""Type, labels and help text of each metric, by name."""


@dataclass(frozen=True, slots=True)
class MeasuredStream:
    """Measurements of one stream, labelled with vehicle, topic and source.

    `active` is False once the source has ended; then only counts are exported, no age or rate.
    """

    labels: tuple[str, ...]
    health: Health
    active: bool = True
    latencies: Histogram | None = None


def metrics_page(metrics: Iterable[core.Metric]) -> Page:
    """Return these metrics, and the metrics of this process, in the Prometheus text format."""

    class Metrics(Collector):
        def collect(self) -> Iterator[core.Metric]:
            yield from metrics
            yield from ProcessCollector(registry=None).collect()

    return Page(200, CONTENT_TYPE_PLAIN_0_0_4, generate_latest(Metrics()))


def build_info(version: str) -> core.Metric:
    """Return the info metric with the versions of nedbus, Python and Zenoh."""
    versions = {
        "version": version,
        "python": platform.python_version(),
        "zenoh": version_of("eclipse-zenoh"),
    }
    return core.InfoMetricFamily("nedbus_build", "Versions", value=versions)


def make_metrics(series: Mapping[str, Iterable[tuple[Any, ...]]]) -> Iterator[core.Metric]:
    """Yield the named metrics; a row has label values, then a value, or the buckets and sum of a histogram."""
    for name, rows in series.items():
        kind, labels, text = METRICS[name]
        metric = kind(name, text, labels=labels)
        for row in rows:
            metric.add_metric(*row)
        yield metric


def stream_metrics(streams: Sequence[MeasuredStream], *, messages: str) -> Iterator[core.Metric]:
    """Yield the stream metrics; `messages` is the name of the message counter."""
    # only positions have resets
    streams = sorted(streams, key=lambda stream: not stream.health.resets)
    named = streams[:MAX_STREAMS]
    rest = [
        replace(stream, labels=("other", "other", stream.labels[2]))
        for stream in streams[MAX_STREAMS:]
    ]
    active = [stream for stream in named if stream.active]

    def count(attribute: str) -> Iterable[tuple[tuple[str, ...], int]]:
        totals: Counter[tuple[str, ...]] = Counter()
        for stream in (*named, *rest):
            totals[stream.labels] += getattr(stream.health, attribute)
        return totals.items()

    def measure(
        attribute: str, of: Iterable[MeasuredStream] = active
    ) -> Iterator[tuple[tuple[str, ...], float]]:
        values = ((stream.labels, getattr(stream.health, attribute)) for stream in of)
        return ((labels, value) for labels, value in values if value is not None)

    return make_metrics({
        messages: count("messages"),
        "nedbus_messages_lost": count("lost"),
        "nedbus_time_gaps": count("gaps"),
        "nedbus_messages_out_of_order": count("out_of_order"),
        "nedbus_reboots": count("reboots"),
        # A stream without a nominal rate may be silent for long, so its age would trigger alerts.
        "nedbus_stream_age_seconds": measure("age", [stream for stream in active if stream.health.nominal]),
        "nedbus_stream_rate_hertz": measure("rate"),
        "nedbus_stream_usual_rate_hertz": measure("usual_rate"),
        "nedbus_stream_jitter_seconds": measure("jitter"),
        "nedbus_stream_flag_ratio":
            (((*each.labels, flag), share) for each in active for flag, share in (each.health.flags or {}).items()),
        "nedbus_resets":
            (((*each.labels, quantity), total) for each in named for quantity, total in each.health.resets.items()),
        "nedbus_latency_seconds":
            (_histogram_row(each.labels, each.latencies) for each in named if each.latencies is not None),
        "nedbus_streams": [((), len(streams))],
    })  # fmt: skip


def vehicle_metrics(
    event_log: EventLog, streams: Iterable[MeasuredStream]
) -> Iterator[core.Metric]:
    """Yield the vehicle metrics; a vehicle without an active stream has event counts, but no state."""
    now, vehicles = clock.steady(), list(event_log.vehicles)
    active = {stream.labels[0] for stream in streams if stream.active}
    states = {
        name: event_log.state(name, now) for name in active if name in vehicles or event_log.is_full
    }
    kinds = {
        name: sorted({condition.kind for condition in state.conditions})
        for name, state in states.items()
    }
    yield from make_metrics({
        "nedbus_vehicle_state": [
            ((name, "ok" if severity == "info" else severity), severity == state.severity)
            for name, state in states.items() for severity in SEVERITIES
        ],
        "nedbus_vehicle_condition": [((name, kind), 1) for name in kinds for kind in kinds[name]],
        "nedbus_vehicle_events":
            [((name, severity), event_log.counts[name, severity]) for name in vehicles for severity in SEVERITIES],
    })  # fmt: skip


def service_metrics(daemon: Daemon) -> Iterator[core.Metric]:
    """Yield all metrics of a service."""
    seen, sources = Counter[str](), dict[str, SourceMeasures]()
    # equal sources are numbered, because time series must be unique
    for measures in daemon.measures:
        text = measures.status.source
        seen[text] += 1
        sources[text if seen[text] == 1 else f"{text} ({seen[text]})"] = measures
    yield build_info(daemon.version)
    yield from make_metrics({
        "nedbus_start_time_seconds": [((), daemon.started + clock.to_utc())],
        "nedbus_sessions": [((daemon.role,), daemon.sessions)],
        "nedbus_sessions_max": [] if daemon.max_sessions is None else [((daemon.role,), daemon.max_sessions)],
        "nedbus_vehicle_refused": [((vehicle,), is_refused) for vehicle, is_refused in daemon.refused.items()],
    })  # fmt: skip
    streams = [
        MeasuredStream(
            (*each.address.split("/", 1), label), each.health, active=not measures.status.ended
        )
        for label, measures in sources.items()
        for each in measures.status.streams
    ]
    yield from stream_metrics(streams, messages="nedbus_messages_published")
    event_log = daemon.update_events(list(sources.values()))
    yield from vehicle_metrics(event_log, streams)
    of = {label: measures.status for label, measures in sources.items()}
    addresses = sum(each.beyond_limit for each in sources.values())
    yield from make_metrics({
        "nedbus_limit_reached": [(("vehicles",), event_log.refused), (("addresses",), addresses)],
        "nedbus_source_rejected": [((label,), status.rejected) for label, status in of.items()],
        "nedbus_messages_rejected":
            [((label, rule), count) for label, status in of.items() for rule, count in status.rejections.items()],
        "nedbus_source_lost": [((label,), status.lost) for label, status in of.items()],
        "nedbus_source_dropped": [((label,), status.dropped) for label, status in of.items()],
        "nedbus_source_overloaded": [((label,), bool(status.overload)) for label, status in of.items()],
        "nedbus_source_addresses": [((label,), len(status.addresses)) for label, status in of.items()],
        "nedbus_source_state":
            [((label, state), state == status.state) for label, status in of.items() for state in STATES],
        "nedbus_source_restarts": [((label,), status.retries) for label, status in of.items()],
        **_log_stream_rows(of),
        "nedbus_publish_duration_seconds":
            [_histogram_row((label,), measures.durations) for label, measures in sources.items()],
    })  # fmt: skip


def _log_stream_rows(of: Mapping[str, SourceStatus]) -> dict[str, list[tuple[Any, ...]]]:
    streams = [
        ((each.vehicle, label), each) for label, status in of.items() for each in status.log_streams
    ]
    columns = {
        "bytes": "received",
        "messages_lost": "lost_messages",
        "unsaved_bytes": "unsaved",
    } | {each: each for each in ("gaps", "lost", "undecodable")}
    seconds = {"delay_seconds": "delay", "header_seconds": "header_time"}
    rows: dict[str, list[tuple[Any, ...]]] = {
        f"nedbus_log_stream_{name}": [
            (labels, value)
            for labels, each in streams
            if (value := getattr(each, attribute)) is not None
        ]
        for name, attribute in (columns | seconds).items()
    }
    rows["nedbus_log_stream_active"] = [
        (labels, each.state == "streaming") for labels, each in streams
    ]
    return rows


def _histogram_row(labels: Sequence[str], measured: Histogram) -> tuple[Any, ...]:
    limits = (*map(str, measured.limits), "+Inf")
    return (
        labels,
        list(zip(limits, accumulate(map(float, measured.counts)), strict=True)),
        measured.sum,
    )
