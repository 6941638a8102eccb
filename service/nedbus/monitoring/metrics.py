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

from nedbus import clock, limits
from nedbus.daemon import STATES, Daemon, SourceMeasures
from nedbus.health import SEVERITIES, Health, Histogram, SourceStatus
from nedbus.vehicle_events import EventLog

from .http_server import Page

_COUNTER = core.CounterMetricFamily
_GAUGE = core.GaugeMetricFamily
_HISTOGRAM = core.HistogramMetricFamily
_Row = tuple[Any, ...]  # label values, then a value, or the buckets and the sum of a histogram
_STREAM: Final = ("vehicle", "topic", "source")
_SOURCE: Final = ("source",)
_LOG_STREAM: Final = ("vehicle", "source")

_GROUPS: Final[Sequence[tuple[Any, Sequence[str], Mapping[str, str]]]] = [
    # Services
    (_GAUGE, (), {
        "nedbus_start_time_seconds": "Start time of the service, as Unix time",
    }),
    (_GAUGE, ("role",), {
        "nedbus_sessions": "Open Zenoh sessions of the embedded router, or routers that the client is connected to",
        "nedbus_sessions_max": "Session limit of the embedded router",
    }),
    (_GAUGE, ("vehicle",), {
        "nedbus_vehicle_refused": "1 if the router's access rules block a vehicle's messages, else 0",
    }),
    (_COUNTER, _STREAM, {
        "nedbus_messages_published": "Messages validated and published",
    }),
    (_COUNTER, ("limit",), {
        "nedbus_limit_reached": "Messages ignored, and streams or keys evicted, because of a limit",
    }),
    # Exporters
    (_GAUGE, (), {
        "nedbus_connected": "1 while connected to a router, else 0",
        "nedbus_queue_messages": "Messages queued in the exporter",
    }),
    (_COUNTER, (), {
        "nedbus_messages_dropped": "Messages dropped because the exporter fell behind",
        "nedbus_messages_invalid": "Payloads discarded because they are not valid messages",
    }),
    (_GAUGE, ("router",), {
        "nedbus_router_sessions": "Open Zenoh sessions of a router, by router id",
        "nedbus_router_sessions_max": "Session limit of a router, by router id",
    }),
    (_COUNTER, _STREAM, {
        "nedbus_messages_received": "Valid messages received and read",
    }),
    # Streams
    (_COUNTER, _STREAM, {
        "nedbus_messages_lost": "Messages lost in transit and not recovered",
        "nedbus_time_gaps": "Gaps in PX4 timestamps longer than three usual intervals",
        "nedbus_messages_out_of_order": "Messages with a timestamp before the previous one's",
        "nedbus_reboots": "Reboots detected from PX4 timestamps",
    }),
    (_COUNTER, (*_STREAM, "quantity"), {
        "nedbus_resets": "Estimator resets, by quantity",
    }),
    (_GAUGE, _STREAM, {
        "nedbus_stream_age_seconds": "Seconds since the last message",
        "nedbus_stream_rate_hertz": "Message rate over the last full second",
        "nedbus_stream_usual_rate_hertz": "Usual message rate of the stream",
        "nedbus_stream_jitter_seconds": "Standard deviation of message intervals over the last second",
    }),
    (_GAUGE, (*_STREAM, "flag"), {
        "nedbus_stream_flag_ratio": "Fraction of messages with the flag set over the last second",
    }),
    (_HISTOGRAM, _STREAM, {
        "nedbus_latency_seconds": "Latency from the publisher to this host; assumes synchronized clocks",
    }),
    (_GAUGE, (), {
        "nedbus_streams": "Known streams",
    }),
    # Vehicles
    (_GAUGE, ("vehicle", "state"), {
        "nedbus_vehicle_state": "1 for the current state of a vehicle, 0 for the others",
    }),
    (_GAUGE, ("vehicle", "condition"), {
        "nedbus_vehicle_condition": "1 for each bad or watch condition that is active or occurred in the last minute",
    }),
    (_COUNTER, ("vehicle", "severity"), {
        "nedbus_vehicle_events": "Events of a vehicle, by severity",
    }),
    # Sources
    (_COUNTER, _SOURCE, {
        "nedbus_source_rejected": "Messages rejected by validation and not published",
        "nedbus_source_lost": "Messages lost before they reached the source",
        "nedbus_source_dropped": "Lost messages that this host dropped, because it is overloaded",
        "nedbus_source_restarts": "Restarts of a source after a failure",
    }),
    (_COUNTER, ("source", "rule"), {
        "nedbus_messages_rejected": "Messages rejected by validation and not published, by violated rule",
    }),
    (_GAUGE, _SOURCE, {
        "nedbus_source_overloaded": "1 while this host does not keep up with the link, else 0",
        "nedbus_source_addresses":
            "Addresses of a replay, or those a live source currently publishes; 0 while nothing arrives",
    }),
    (_GAUGE, ("source", "state"), {
        "nedbus_source_state": "1 for the current state of a source, 0 for the others",
    }),
    (_GAUGE, _LOG_STREAM, {
        "nedbus_log_stream_active":
            "1 while a vehicle's messages come from its ULog stream, 0 while converted from MAVLink",
        "nedbus_log_stream_delay_seconds": "Mean age of ULog messages when published",
        "nedbus_log_stream_header_seconds":
            "Transfer time of the last ULog header; the vehicle's own log has a gap of this length",
    }),
    (_COUNTER, _LOG_STREAM, {
        "nedbus_log_stream_bytes": "Bytes received from a vehicle's ULog stream",
        "nedbus_log_stream_gaps": "Sequence gaps in a vehicle's ULog stream",
        "nedbus_log_stream_lost": "Lost LOGGING_DATA messages of a vehicle's ULog stream",
        "nedbus_log_stream_messages_lost": "Estimated number of ULog messages lost in gaps",
        "nedbus_log_stream_undecodable": "ULog messages without a usable definition",
        "nedbus_log_stream_unsaved_bytes": "Bytes that could not be saved, although save= is set",
    }),
    (_HISTOGRAM, _SOURCE, {
        "nedbus_publish_duration_seconds": "Time to validate, encode and send every 16th message",
    }),
]  # fmt: skip
"""Type, labels, and the help text of each metric by name."""

METRICS: Final[Mapping[str, tuple[Any, Sequence[str], str]]] = {
    name: (kind, labels, text) for kind, labels, texts in _GROUPS for name, text in texts.items()
}
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


def make_metrics(series: Mapping[str, Iterable[_Row]]) -> Iterator[core.Metric]:
    """Yield the metrics with these names and rows."""
    for name, rows in series.items():
        kind, labels, text = METRICS[name]
        metric = kind(name, text, labels=labels)
        for row in rows:
            metric.add_metric(*row)
        yield metric


def stream_metrics(streams: Sequence[MeasuredStream], *, messages: str) -> Iterator[core.Metric]:
    """Yield the stream metrics; `messages` is the name of the message counter."""
    # Only positions have resets.
    ordered = sorted(streams, key=lambda stream: not stream.health.resets)
    named = ordered[: limits.EXPORTED_STREAMS]
    counted = list(named)
    for stream in ordered[limits.EXPORTED_STREAMS :]:
        _, _, source = stream.labels
        counted.append(replace(stream, labels=("other", "other", source)))
    active = [stream for stream in named if stream.active]
    # A stream without a nominal rate may be silent for long, so its age would trigger alerts.
    regular = [stream for stream in active if stream.health.nominal]
    yield from make_metrics({
        messages: _totals(counted, "messages"),
        "nedbus_messages_lost": _totals(counted, "lost"),
        "nedbus_time_gaps": _totals(counted, "gaps"),
        "nedbus_messages_out_of_order": _totals(counted, "out_of_order"),
        "nedbus_reboots": _totals(counted, "reboots"),
        "nedbus_stream_age_seconds": _measured(regular, "age"),
        "nedbus_stream_rate_hertz": _measured(active, "rate"),
        "nedbus_stream_usual_rate_hertz": _measured(active, "usual_rate"),
        "nedbus_stream_jitter_seconds": _measured(active, "jitter"),
        "nedbus_stream_flag_ratio": _flag_rows(active),
        "nedbus_resets": _reset_rows(named),
        "nedbus_latency_seconds": _latency_rows(named),
        "nedbus_streams": [((), len(streams))],
    })  # fmt: skip


def _totals(streams: Iterable[MeasuredStream], attribute: str) -> Iterable[_Row]:
    """Return the sum of a count of the health for each combination of labels."""
    totals = Counter[tuple[str, ...]]()
    for stream in streams:
        totals[stream.labels] += getattr(stream.health, attribute)
    return totals.items()


def _measured(streams: Iterable[MeasuredStream], attribute: str) -> Iterator[_Row]:
    """Yield a value of the health of each stream, unless it is unknown."""
    for stream in streams:
        value = getattr(stream.health, attribute)
        if value is not None:
            yield stream.labels, value


def _flag_rows(streams: Iterable[MeasuredStream]) -> Iterator[_Row]:
    for stream in streams:
        flags = stream.health.flags or {}
        for flag, share in flags.items():
            yield (*stream.labels, flag), share


def _reset_rows(streams: Iterable[MeasuredStream]) -> Iterator[_Row]:
    for stream in streams:
        for quantity, total in stream.health.resets.items():
            yield (*stream.labels, quantity), total


def _latency_rows(streams: Iterable[MeasuredStream]) -> Iterator[_Row]:
    for stream in streams:
        if stream.latencies is not None:
            yield _histogram_row(stream.labels, stream.latencies)


def vehicle_metrics(
    event_log: EventLog, streams: Iterable[MeasuredStream]
) -> Iterator[core.Metric]:
    """Yield the vehicle metrics; a vehicle without an active stream has event counts, but no state."""
    now = clock.steady()
    vehicles = list(event_log.vehicles)
    active = {stream.labels[0] for stream in streams if stream.active}
    states = list[_Row]()
    conditions = list[_Row]()
    for name in active:
        if name not in vehicles and not event_log.is_full:
            continue
        report = event_log.state(name, now)
        for severity in SEVERITIES:
            state = "ok" if severity == "info" else severity
            states.append(((name, state), severity == report.severity))
        kinds = {condition.kind for condition in report.conditions}
        conditions += [((name, kind), 1) for kind in sorted(kinds)]
    events = [
        ((name, severity), event_log.counts[name, severity])
        for name in vehicles
        for severity in SEVERITIES
    ]
    yield from make_metrics({
        "nedbus_vehicle_state": states,
        "nedbus_vehicle_condition": conditions,
        "nedbus_vehicle_events": events,
    })  # fmt: skip


def service_metrics(daemon: Daemon) -> Iterator[core.Metric]:
    """Yield all metrics of a service."""
    sources = _label_sources(daemon.measures)
    limit = daemon.max_sessions
    yield build_info(daemon.version)
    yield from make_metrics({
        "nedbus_start_time_seconds": [((), daemon.started + clock.to_utc())],
        "nedbus_sessions": [((daemon.role,), daemon.sessions)],
        "nedbus_sessions_max": [] if limit is None else [((daemon.role,), limit)],
        "nedbus_vehicle_refused": [((vehicle,), is_refused) for vehicle, is_refused in daemon.refused.items()],
    })  # fmt: skip
    streams = list(_streams_of(sources))
    yield from stream_metrics(streams, messages="nedbus_messages_published")
    event_log = daemon.update_events(list(sources.values()))
    yield from vehicle_metrics(event_log, streams)
    beyond_limit = sum(measures.beyond_limit for measures in sources.values())
    durations = [
        _histogram_row((label,), measures.durations) for label, measures in sources.items()
    ]
    statuses = {label: measures.status for label, measures in sources.items()}
    yield from make_metrics({
        "nedbus_limit_reached": [(("vehicles",), event_log.refused), (("addresses",), beyond_limit)],
        **_source_rows(statuses),
        **_log_stream_rows(statuses),
        "nedbus_publish_duration_seconds": durations,
    })  # fmt: skip


def _label_sources(all_measures: Iterable[SourceMeasures]) -> dict[str, SourceMeasures]:
    """Return the measures of sources by label; equal sources are numbered, because time series must be unique."""
    numbers = Counter[str]()
    sources = dict[str, SourceMeasures]()
    for measures in all_measures:
        label = measures.status.source
        numbers[label] += 1
        if numbers[label] > 1:
            label = f"{label} ({numbers[label]})"
        sources[label] = measures
    return sources


def _streams_of(sources: Mapping[str, SourceMeasures]) -> Iterator[MeasuredStream]:
    """Yield the streams of all sources."""
    for label, measures in sources.items():
        is_active = not measures.status.ended
        for stream in measures.status.streams:
            vehicle, topic = stream.address.split("/", 1)
            yield MeasuredStream((vehicle, topic, label), stream.health, active=is_active)


def _source_rows(statuses: Mapping[str, SourceStatus]) -> dict[str, list[_Row]]:
    """Return the rows of the metrics of sources."""
    rejections = list[_Row]()
    states = list[_Row]()
    for label, status in statuses.items():
        rejections += [((label, rule), count) for rule, count in status.rejections.items()]
        states += [((label, state), state == status.state) for state in STATES]
    items = statuses.items()
    return {
        "nedbus_source_rejected": [((label,), status.rejected) for label, status in items],
        "nedbus_messages_rejected": rejections,
        "nedbus_source_lost": [((label,), status.lost) for label, status in items],
        "nedbus_source_dropped": [((label,), status.dropped) for label, status in items],
        "nedbus_source_overloaded": [((label,), bool(status.overload)) for label, status in items],
        "nedbus_source_addresses": [((label,), len(status.addresses)) for label, status in items],
        "nedbus_source_state": states,
        "nedbus_source_restarts": [((label,), status.retries) for label, status in items],
    }


_LOG_STREAM_VALUES: Final[Mapping[str, str]] = {
    "bytes": "received", "gaps": "gaps", "lost": "lost", "messages_lost": "lost_messages", "undecodable": "undecodable",
    "unsaved_bytes": "unsaved", "delay_seconds": "delay", "header_seconds": "header_time",
}  # fmt: skip
"""The attribute of a LogStreamStatus, by the end of the name of its metric."""


def _log_stream_rows(statuses: Mapping[str, SourceStatus]) -> dict[str, list[_Row]]:
    """Return the rows of the metrics of ULog streams; a value that is unknown has no row."""
    rows = {f"nedbus_log_stream_{name}": list[_Row]() for name in _LOG_STREAM_VALUES}
    active = list[_Row]()
    for label, status in statuses.items():
        for log in status.log_streams:
            labels = (log.vehicle, label)
            active.append((labels, log.state == "streaming"))
            for name, attribute in _LOG_STREAM_VALUES.items():
                value = getattr(log, attribute)
                if value is not None:
                    rows[f"nedbus_log_stream_{name}"].append((labels, value))
    return {**rows, "nedbus_log_stream_active": active}


def _histogram_row(labels: Sequence[str], measured: Histogram) -> _Row:
    """Return labels, cumulative buckets as Prometheus counts them, and the sum."""
    bounds = [*map(str, measured.limits), "+Inf"]
    totals = accumulate(map(float, measured.counts))
    return labels, list(zip(bounds, totals, strict=True)), measured.sum
