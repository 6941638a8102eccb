"""Event detection in logs and recordings, by replaying them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import merge
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import Final, cast

from nedbus import recording
from nedbus.errors import InvalidMessageError, SourceError
from nedbus.events import AIR_DATA, EKF_SELECTOR, EventLog, Times
from nedbus_msgs import TOPICS

from .kinds import parse_source, source_text_of_file
from .options import RecordedOptions
from .source import ReplayRun, ReplaySource, SourceMessage

MAX_FILE_EVENTS: Final = 100_000  # beyond that the oldest are discarded
_LOOKAHEAD: Final = 1000  # messages read to determine the start time of a file
_CHECK_INTERVAL: Final = 0.5  # s of flight time between checks for silent streams and settled events
_SETTLE_TIME: Final = 10.0  # s after the last message; events that have not settled by then are reported as they are


@dataclass(frozen=True, slots=True)
class FileEvents:
    """Events of complete files; `end`: time of the last message. Times are seconds since the first message."""

    event_log: EventLog
    times: Times
    end: float
    warnings: tuple[str, ...]


class _EventOptions(RecordedOptions):
    """Replay options for event detection: all built-in topics, and two other topics."""

    @property
    def chosen_topics(self) -> Collection[str]:
        """The topics to deliver."""
        return {*TOPICS, EKF_SELECTOR, AIR_DATA}


class Flights:
    """The messages of one file, or of several files merged by UTC.

    Vehicles with the same name in several files are named after their files. `ended`: vehicles whose file has ended.

    Raises ConfigError or SourceError if a file cannot be read.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        specs = [replace(parse_source(source_text_of_file(path)), options=_EventOptions()) for path in paths]
        runs = [cast("ReplaySource", spec.open_source(vehicle="1")).open() for spec in specs]
        vehicles = [{address.vehicle for address in run.addresses} for run in runs]
        names = recording.distinct_names(list(zip(paths, vehicles, strict=True)))
        self._files = list(zip(paths, runs, names, strict=True))
        self.ended: set[str] = set()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Damage, omissions and renamed vehicles so far."""
        found = []
        for path, run, names in self._files:
            reason = "here, because several files have a vehicle"
            renamed = [f"vehicle {own} is named {name} {reason} {own}" for own, name in names.items() if own != name]
            found += [f"{path}: {text}" for text in (*renamed, *run.warnings)]
        return tuple(found)

    @cached_property
    def times(self) -> Times:  # lazy, because it loads NumPy
        """The UTC offset of each vehicle for which `find_utc` finds one, and remarks on it."""
        offsets, remarks = dict[str, float](), dict[str, str]()
        for path, own, name in ((path, own, name) for path, _, names in self._files for own, name in names.items()):
            utc = recording.find_utc(path, vehicle=own)
            if not isinstance(utc, str):
                offsets[name] = utc.offset_us / 1e6
                seconds = utc.corrected_us / 1e6
                utc = f"{utc.source} corrected its UTC by {seconds:+.1f} s in flight" if seconds else ""
            if utc:
                remarks[name] = utc
        return Times(offsets=offsets, remarks=remarks)

    def messages(self) -> Iterator[SourceMessage]:
        """Yield the messages in chronological order; raise SourceError if one of several files has no UTC."""
        if len(self._files) == 1:
            return self._files[0][1].messages
        starts = [self._start(*file) for file in self._files]
        files = zip(self._files, starts, strict=True)
        shifted = (self._shift(run, names, start - min(starts)) for (_, run, names), start in files)
        return merge(*shifted, key=attrgetter("due"))

    def _start(self, path: Path, run: ReplayRun, names: Mapping[str, str]) -> float:
        """Return the Unix time of the start of a file [s]."""
        ahead = list(islice(run.messages, _LOOKAHEAD))
        run.messages = chain(ahead, run.messages)
        known = ((each, each.timestamp / 1e6) for each in ahead if not each.error)
        times = ((self.times.utc_of_boot(names[each.address.vehicle], boot), each.due) for each, boot in known)
        found = [utc - due for utc, due in times if utc is not None]
        if not found:
            reason = next(filter(None, map(self.times.remarks.get, names.values())), "no message contains UTC")
            raise SourceError(str(path), f"{reason}, which merging several files requires; read it alone")
        return median(found)

    def _shift(self, run: ReplayRun, names: Mapping[str, str], offset: float) -> Iterator[SourceMessage]:
        for each in run.messages:
            address = replace(each.address, vehicle=names.get(each.address.vehicle, each.address.vehicle))
            yield replace(each, due=each.due + offset, address=address)
        self.ended.update(names.values())


def read_file_events(*paths: Path) -> FileEvents:
    """Detect the events in files; raise the errors of `Flights` and its `messages`."""
    flights, event_log, due = Flights(paths), EventLog(MAX_FILE_EVENTS), 0.0
    for message, _, _ in follow(flights.messages(), event_log, ended=flights.ended):
        due = message.due
    event_log.label_first_events()
    return FileEvents(event_log, flights.times, due, flights.warnings)


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
        due, reason, payload = message.due, message.error, None
        if due - checked >= _CHECK_INTERVAL and event_log.vehicles.keys() <= set(ended):
            checked = due  # no vehicle is active between two files
        while due - checked >= _CHECK_INTERVAL:
            checked += _CHECK_INTERVAL
            update(checked)
        if reason is None:
            try:
                row, payload, _, missing = message.encode()
                event_log.add(message.address, row, due, missing=missing)
            except InvalidMessageError as exc:
                reason = exc.reason
        if reason is not None:
            event_log.reject(message.address, reason, due)
        yield message, reason, payload
    update(due)
    event_log.settle(due + _SETTLE_TIME)
