"""Events of files, an open flight or samples: all at once, or message by message."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from nedbus import limits
from nedbus.errors import ArgumentError
from nedbus.event_history import EventHistory
from nedbus.samples import Sample
from nedbus.vehicle_events import EventLog, Times
from nedbus_msgs import Address

from .events import (
    EVENT_OPTIONS,
    follow_flight,
    read_file_events,
    read_flight_events,
    times_of,
)
from .flight import Flight, open_messages
from .sample_events import detect_sample_events


class ReplayedMessage(NamedTuple):
    """One message of a replay.

    `at`: seconds since the first message, pauses included. `timestamp`: that of the vehicle [us], 0 without one.
    `payload`: the message as msgpack; None if it is invalid. `rejected`: why it is invalid; None if it is not.
    """

    address: Address
    at: float
    timestamp: int
    payload: bytes | None
    rejected: str | None


class EventReplay:
    """The messages of one or more files in chronological order, each after its events are in the `event_log`.

    Iterate over it once, without pauses between the messages; it reads the topics from which events are derived.
    `times`: the clocks of the vehicles; the first use reads the files. `warnings`: damage of the files so far.

    Raises the errors of `nedbus.open`, and SourceError in its iteration.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self.event_log = EventLog(limits.FILE_EVENTS)
        self._flight = open_messages(paths, EVENT_OPTIONS)

    @property
    def times(self) -> Times:
        """Conversions of event times to UTC, with remarks on the clocks of the vehicles."""
        return times_of(self._flight)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Damage of the files so far."""
        return self._flight.warnings

    def __iter__(self) -> Iterator[ReplayedMessage]:
        for message, reason, payload in follow_flight(self._flight, self.event_log):
            timestamp = message.timestamp or 0
            yield ReplayedMessage(message.address, message.at, timestamp, payload, reason)


def detect_events(
    source: str | Path | Sequence[str | Path] | Flight | Iterable[Sample[Any]],
) -> EventHistory:
    """Return the events of a file, of several files, of an open flight, or of samples that end.

    `nedbus.events` does the same, and also follows a bus.

    Raises ArgumentError for another source, and the errors of `nedbus.open` and its samples.
    """
    if isinstance(source, str | Path):
        return read_file_events(Path(source).expanduser()).history()
    if isinstance(source, Flight):
        return read_flight_events(source).history()
    if not isinstance(source, Iterable):
        expected = "a file, several files, an open flight, samples, or a connected bus"
        raise ArgumentError("source", source, expected)
    if isinstance(source, Sequence) and all(isinstance(item, str | Path) for item in source):
        paths = [Path(item).expanduser() for item in source]
        return read_file_events(*paths).history()
    return detect_sample_events(cast("Iterable[Sample[Any]]", source)).history()
