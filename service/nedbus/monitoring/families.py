"""Metrics of streams and sources for Prometheus, made when they are asked for; needs the extra `metrics`.

Names and units follow https://prometheus.io/docs/practices/naming/.
Labels: `vehicle`, `topic` as `nedbus list` shows it (estimator_local_position/0), `source` as it was configured.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric

from nedbus.client import Health, Histogram
from nedbus.events import SEVERITIES, Account

MAX_STREAMS: Final = 1000
"""Streams with labels of their own, positions first; what the rest counts is added up as vehicle and topic "other"."""

SWITCHED_OFF: Final = 3600.0
"""Seconds of silence after which a stream that nobody publishes any more is not active."""

_OTHER: Final = ("other", "other")
_STREAM: Final = ("vehicle", "topic", "source")
_COUNTS: Final = {
    "lost": ("nedbus_messages_lost", "Messages that were lost in transit before they came here, for good"),
    "gaps": ("nedbus_time_gaps", "Steps of PX4's own time of more than three usual ones"),
    "out_of_order": ("nedbus_messages_out_of_order", "Messages whose time is before that of the one before"),
    "reboots": ("nedbus_reboots", "Times that PX4's own time began anew"),
}
_MEASURES: Final = {
    "age": ("nedbus_stream_age_seconds", "Seconds since the last message"),
    "rate": ("nedbus_stream_rate_hertz", "Messages a second, over the last full second"),
    "usual_rate": ("nedbus_stream_usual_rate_hertz", "Messages a second that this stream has had so far"),
    "jitter": ("nedbus_stream_jitter_seconds", "Standard deviation of the intervals of the last second"),
}


@dataclass(frozen=True, slots=True)
class Stream:
    """One stream as it is measured.

    `active` unless its source has ended, or its vehicle was switched off: then it has counts, and no age or rate.
    """

    vehicle: str
    topic: str
    source: str
    health: Health
    active: bool = True
    latencies: Histogram | None = None


def is_switched_off(health: Health) -> bool:
    """Return whether a stream that nobody publishes any more has been silent for so long that nobody expects it."""
    return health.age is not None and health.age >= SWITCHED_OFF


def stream_families(streams: Sequence[Stream], *, messages: tuple[str, str]) -> Iterator[Metric]:
    """Yield the metrics of streams; `messages` is the name of the counter of messages, and what it counts."""
    streams = sorted(streams, key=lambda stream: not stream.health.resets)  # which only positions have
    named, rest = streams[:MAX_STREAMS], streams[MAX_STREAMS:]
    for attribute, (name, text) in {"messages": messages, **_COUNTS}.items():
        counts = CounterMetricFamily(name, text, labels=_STREAM)
        for stream in named:
            counts.add_metric([stream.vehicle, stream.topic, stream.source], getattr(stream.health, attribute))
        others: Counter[str] = Counter()
        for stream in rest:
            others[stream.source] += getattr(stream.health, attribute)
        for source, count in others.items():
            counts.add_metric([*_OTHER, source], count)
        yield counts
    for attribute, (name, text) in _MEASURES.items():
        measures = GaugeMetricFamily(name, text, labels=_STREAM)
        for stream in named:
            value = getattr(stream.health, attribute)
            # Of what has no rate an age says nothing: alerts would take it for silence.
            if value is not None and stream.active and (stream.health.nominal or attribute != "age"):
                measures.add_metric([stream.vehicle, stream.topic, stream.source], value)
        yield measures
    yield from _flags(named)
    yield from _latencies(named)
    yield GaugeMetricFamily("nedbus_streams", "Streams that are known", value=len(streams))


def vehicle_families(account: Account, streams: Iterable[Stream]) -> Iterator[Metric]:
    """Yield the metrics of vehicles; one without an active stream has counts, and no state."""
    active, now = {stream.vehicle for stream in streams if stream.active}, time.time()
    state = GaugeMetricFamily(
        "nedbus_vehicle_state", "1 for the state that a vehicle is in", labels=("vehicle", "state")
    )
    condition = GaugeMetricFamily(
        "nedbus_vehicle_condition",
        "1 for what holds, or happened in the last minute, and is bad or to be watched",
        labels=("vehicle", "condition"),
    )
    events = CounterMetricFamily("nedbus_vehicle_events", "Events of a vehicle", labels=("vehicle", "severity"))
    for name in list(account.vehicles):
        if name in active:
            known = account.state(name, now)
            for severity in SEVERITIES:
                state.add_metric([name, "ok" if severity == "info" else severity], severity == known.severity)
            for kind in sorted({each.kind for each in known.conditions}):
                condition.add_metric([name, kind], 1)
        for severity in SEVERITIES:
            events.add_metric([name, severity], account.counts[name, severity])
    yield from (state, condition, events)


def histogram(family: HistogramMetricFamily, labels: Sequence[str], measured: Histogram) -> None:
    """Add a histogram to a family."""
    total, buckets = 0, []
    for limit, count in zip((*map(str, measured.limits), "+Inf"), measured.counts, strict=True):
        total += count
        buckets.append((limit, float(total)))
    family.add_metric(labels, buckets, measured.sum)


def _flags(streams: Iterable[Stream]) -> Iterator[Metric]:
    flags = GaugeMetricFamily(
        "nedbus_stream_flag_ratio",
        "Share of the messages of the last second with this flag set",
        labels=(*_STREAM, "flag"),
    )
    resets = CounterMetricFamily("nedbus_resets", "Resets of the estimator, by quantity", labels=(*_STREAM, "quantity"))
    for stream in streams:
        labels = [stream.vehicle, stream.topic, stream.source]
        if stream.active:
            for flag, share in (stream.health.flags or {}).items():
                flags.add_metric([*labels, flag], share)
        for quantity, count in stream.health.resets.items():
            resets.add_metric([*labels, quantity], count)
    yield flags
    yield resets


def _latencies(streams: Iterable[Stream]) -> Iterator[Metric]:
    measured = [stream for stream in streams if stream.latencies is not None]
    if not measured:
        return
    family = HistogramMetricFamily(
        "nedbus_latency_seconds",
        "Time from the publisher to here, by the clocks of both hosts",
        labels=_STREAM,
    )
    for stream in measured:
        if stream.latencies is not None:
            histogram(family, [stream.vehicle, stream.topic, stream.source], stream.latencies)
    yield family
