"""Event detection in logs and recordings, by replaying them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from nedbus import limits
from nedbus.errors import InvalidMessageError
from nedbus.event_history import EventHistory
from nedbus.samples import SourceMessage
from nedbus.timeline import UtcOffset
from nedbus.vehicle_events import EVENT_TOPICS, EventLog, Times, by_vehicle, report_of

from .flight import Extent, Flight, open_messages
from .readers import ReadOptions

EVENT_OPTIONS: Final = ReadOptions(topics={*EVENT_TOPICS})
"""Options to read the messages from which events are derived."""

# s of flight time between checks for silent streams and settled events
_CHECK_INTERVAL: Final = 0.5
_CHECKED_PAUSE: Final = 120.0  # s of a pause that are checked; by then all events have settled
# s after the last message; events that have not settled by then are reported as they are
_SETTLE_TIME: Final = 10.0


@dataclass(frozen=True, slots=True)
class FileEvents:
    """Events of complete files; `end`: time of the last message. Times are seconds since the first message.

    `extents`: begin and end of the file of each vehicle, for several files.
    """

    event_log: EventLog
    times: Times
    end: float
    warnings: tuple[str, ...]
    extents: Mapping[str, Extent] = field(default_factory=dict)

    def history(self) -> EventHistory:
        """Return the retained events and the state of each vehicle at the end."""
        events, total = self.event_log.events_since(0)
        report = report_of(self.event_log, "", "", self.end, within=math.inf)
        reports = by_vehicle([report])
        for name in self.extents.keys() & reports.keys():
            reports[name] = replace(reports[name], now=self.extents[name].end)
        from_start = {}
        for name, vehicle in sorted(self.event_log.vehicles.items()):
            text = vehicle.held_from_start
            if text:
                from_start[name] = text
        return EventHistory(
            events=tuple(sorted(events, key=lambda event: event.time)),
            reports=reports,
            times=self.times,
            from_start=from_start,
            dropped=total - len(events),
            warnings=self.warnings,
            begins={name: extent.begin for name, extent in self.extents.items()},
        )


def read_file_events(*paths: Path) -> FileEvents:
    """Detect the events in files; raise the errors of `nedbus.open` and its samples."""
    event_log = EventLog(limits.FILE_EVENTS)
    with open_messages(paths, EVENT_OPTIONS) as flight:
        for _ in follow_flight(flight, event_log):
            pass
        event_log.label_first_events()
        extents = flight._extents(flight._readers)
        return FileEvents(event_log, times_of(flight), flight.duration, flight.warnings, extents)


def read_flight_events(flight: Flight) -> FileEvents:
    """Detect the events of the selected vehicle in an open flight; raise the errors of its call."""
    event_log = EventLog(limits.FILE_EVENTS)
    ended = set[str]()
    end = 0.0
    readers = flight._open({*EVENT_TOPICS})
    try:
        messages = flight._merge(readers, lambda names: ended.update(names.values()))
        selected = (message for message in messages if flight._selection.matches(message.address))
        for message, _, _ in follow(selected, event_log, ended=ended):
            end = message.at
    finally:
        for reader in readers:
            reader.close()
    event_log.label_first_events()
    extents = flight._extents(readers)
    return FileEvents(event_log, times_of(flight), end, flight.warnings, extents)


def times_of(flight: Flight) -> Times:
    """Return the clocks of the vehicles of a flight, with remarks on them; reads the files."""
    offsets = dict[str, float]()
    remarks = dict[str, str]()
    for name, utc in flight._utc_by_name.items():
        if isinstance(utc, str):
            remark = utc
        else:
            offsets[name] = utc.offset_us / 1e6
            remark = _remark_on(utc)
        if remark:
            remarks[name] = remark
    return Times(offsets=offsets, remarks=remarks)


def _remark_on(utc: UtcOffset) -> str:
    """Return that a source corrected its UTC in flight, "" if it did not."""
    seconds = utc.corrected_us / 1e6
    if not seconds:
        return ""
    return f"{utc.source} corrected its UTC by {seconds:+.1f} s in flight"


def follow_flight(
    flight: Flight, event_log: EventLog
) -> Iterator[tuple[SourceMessage, str | None, bytes | None]]:
    """Detect the events in a flight; yield each message with its rejection reason or its payload."""
    return follow(flight._messages(), event_log, ended=flight._ended)


def follow(
    messages: Iterable[SourceMessage], event_log: EventLog, *, ended: Collection[str] = ()
) -> Iterator[tuple[SourceMessage, str | None, bytes | None]]:
    """Detect events in a replay; yield each message with its rejection reason or its payload.

    `ended`: vehicles without further messages, which do not count as silent.
    """
    checks = Checks(event_log, ended)
    due = 0.0
    for message in messages:
        if message.dropout:
            event_log.add_dropout(message.address.vehicle, message.dropout, due)
        due = message.at
        reason = message.error
        payload = None
        checks.advance(due)
        if reason is None:
            try:
                row, payload, _, missing = message.encode()
                event_log.add(message.address, row, due, missing=missing, source=message.source)
            except InvalidMessageError as exc:
                reason = exc.reason
        if reason is not None:
            event_log.reject(message.address, reason, due)
        yield message, reason, payload
    checks.end(due)


class Checks:
    """Checks of an event log for silence and settled events, twice a second of flight time."""

    def __init__(self, event_log: EventLog, ended: Collection[str] = ()) -> None:
        self._event_log = event_log
        self._ended = ended
        self._checked = 0.0

    def advance(self, due: float) -> None:
        """Check the time before a message, which is due at this time [s]."""
        if due - self._checked < _CHECK_INTERVAL:
            return
        if self._event_log.vehicles.keys() <= set(self._ended):
            self._checked = due  # no vehicle is active between two files
        settled = self._checked + _CHECKED_PAUSE
        while due - self._checked >= _CHECK_INTERVAL:
            self._checked += _CHECK_INTERVAL
            self._update(self._checked)
            if self._checked >= settled and due - self._checked > _CHECK_INTERVAL:
                self._checked = due - _CHECK_INTERVAL  # a long pause changes nothing more

    def end(self, due: float) -> None:
        """Check the time of the last message, and report what has not settled."""
        self._update(due)
        self._event_log.settle(due + _SETTLE_TIME)

    def _update(self, time: float) -> None:
        vehicles = self._event_log.vehicles
        mains = [vehicles[name].main for name in self._ended if name in vehicles]
        states = {main: "ended" for main in mains if main is not None}
        self._event_log.update(time, states)
