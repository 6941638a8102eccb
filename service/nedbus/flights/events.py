"""Event detection in logs and recordings, by replaying them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from nedbus.errors import InvalidMessageError
from nedbus.samples import SourceMessage
from nedbus.vehicle_events import EVENT_TOPICS, EventLog, Times

from .merge import MergedFlights
from .readers import ReadOptions

MAX_FILE_EVENTS: Final = 100_000
"""Maximum number of events of a file; beyond it, the oldest are discarded."""

EVENT_OPTIONS: Final = ReadOptions(topics={*EVENT_TOPICS})
"""Options to read the messages from which events are derived."""

_CHECK_INTERVAL: Final = 0.5  # s of flight time between checks for silent streams and settled events
_MAX_CHECKED: Final = 120.0  # s of a pause that are checked; by then all events have settled
_SETTLE_TIME: Final = 10.0  # s after the last message; events that have not settled by then are reported as they are


@dataclass(frozen=True, slots=True)
class FileEvents:
    """Events of complete files; `end`: time of the last message. Times are seconds since the first message."""

    event_log: EventLog
    times: Times
    end: float
    warnings: tuple[str, ...]


def read_file_events(*paths: Path) -> FileEvents:
    """Detect the events in files; raise the errors of `MergedFlights` and its `messages`."""
    event_log, due = EventLog(MAX_FILE_EVENTS), 0.0
    with MergedFlights(paths, EVENT_OPTIONS) as flights:
        for message, _, _ in follow(flights.messages(), event_log, ended=flights.ended):
            due = message.at
        event_log.label_first_events()
        return FileEvents(event_log, times_of(flights), due, flights.warnings)


def times_of(flights: MergedFlights) -> Times:
    """Return the clocks of the vehicles of flights, with remarks on them; reads the files."""
    offsets, remarks = dict[str, float](), dict[str, str]()
    for name, utc in flights.utc.items():
        remark = utc
        if not isinstance(utc, str):
            offsets[name] = utc.offset_us / 1e6
            seconds = utc.corrected_us / 1e6
            remark = f"{utc.source} corrected its UTC by {seconds:+.1f} s in flight" if seconds else ""
        if remark:
            remarks[name] = str(remark)
    return Times(offsets=offsets, remarks=remarks)


def follow(
    messages: Iterable[SourceMessage], event_log: EventLog, *, ended: Collection[str] = ()
) -> Iterator[tuple[SourceMessage, str | None, bytes | None]]:
    """Detect events in a replay; yield each message with its rejection reason or its payload.

    `ended`: vehicles without further messages, which do not count as silent.
    """
    checked = due = 0.0

    def update(time: float) -> None:
        mains = (event_log.vehicles[name].main for name in ended if name in event_log.vehicles)
        event_log.update(time, {main: "ended" for main in mains if main})

    for message in messages:
        if message.dropout:
            event_log.add_dropout(message.address.vehicle, message.dropout, due)
        due, reason, payload = message.at, message.error, None
        if due - checked >= _CHECK_INTERVAL and event_log.vehicles.keys() <= set(ended):
            checked = due  # no vehicle is active between two files
        settled = checked + _MAX_CHECKED
        while due - checked >= _CHECK_INTERVAL:
            checked += _CHECK_INTERVAL
            update(checked)
            if checked >= settled and due - checked > _CHECK_INTERVAL:
                checked = due - _CHECK_INTERVAL  # a long pause changes nothing more
        if reason is None:
            try:
                row, payload, _, missing = message.encode()
                event_log.add(message.address, row, due, missing=missing, source=message.source)
            except InvalidMessageError as exc:
                reason = exc.reason
        if reason is not None:
            event_log.reject(message.address, reason, due)
        yield message, reason, payload
    update(due)
    event_log.settle(due + _SETTLE_TIME)
