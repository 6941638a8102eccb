"""Event detection in samples that end, such as a list of those of a subscription."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from nedbus import limits
from nedbus.errors import ArgumentError
from nedbus.samples import Sample
from nedbus.timeline import Order
from nedbus.vehicle_events import EVENT_TOPICS, EventLog, Times
from nedbus_msgs import Address, is_unix_time

from .events import Checks, FileEvents


@dataclass(slots=True)
class _Received:
    """A sample, as the order of a flight needs it; `time`: when it was received [us]."""

    sample: Sample[Any]
    address: Address
    time: int
    logged: object  # distinguishes the streams
    at: float = 0.0
    error: str | None = None

    @property
    def timestamp(self) -> int:
        return int(self.sample.message.timestamp)


def detect_sample_events(samples: Iterable[Sample[Any]]) -> FileEvents:
    """Detect the events in samples that end; they are put in the order of the vehicles' clocks.

    A retained sample is left out, because its stream may have ended long before the others began. UTC is that of
    `sample.received`, unless this is a time since boot, as in a log without UTC.

    Raises ArgumentError for anything but a sample.
    """
    event_log = EventLog(limits.FILE_EVENTS)
    offsets = dict[str, float]()
    due = 0.0
    checks = Checks(event_log)
    for received in Order[_Received]().arrange(_received(samples)):
        sample = received.sample
        due = received.at
        checks.advance(due)
        event_log.add(
            sample.address,
            sample.message,
            due,
            missing=sample.missing,
            lost=sample.lost,
            source=sample.source,
        )
        if is_unix_time(received.time) and not is_unix_time(received.timestamp):
            offset = (received.time - received.timestamp) / 1e6
            least = offsets.get(sample.vehicle, math.inf)
            offsets[sample.vehicle] = min(offset, least)  # that with the least delay
    checks.end(due)
    event_log.label_first_events()
    return FileEvents(event_log, Times(offsets=offsets), due, ())


def _received(samples: Iterable[Sample[Any]]) -> Iterator[_Received]:
    topics = {*EVENT_TOPICS}
    streams = dict[Address, Address]()
    for sample in samples:
        if not isinstance(sample, Sample):
            raise ArgumentError(
                "source", sample, "a sample; a list of files contains only str and Path"
            )
        if sample.topic in topics and not sample.retained:
            # one object, which identifies the stream
            stream = streams.setdefault(sample.address, sample.address)
            yield _Received(sample, stream, sample.received // 1000, stream)
