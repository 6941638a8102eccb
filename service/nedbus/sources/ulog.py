"""Replay a PX4 .ulg log while reading it: all topic instances in logged order, paced by timestamps."""

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Final

from nedbus.recording import UlogReader
from nedbus.ulog import LOG_MESSAGE, LoggedStream
from nedbus_msgs import ALL, DEFAULT, Address

from .options import RecordedOptions
from .source import ReplayRun, SourceMessage

_LOOKAHEAD: Final = 1000  # messages read when a log is opened, for the initial list of addresses
_MAX_STEP: Final = 1_000_000  # us; a longer step must be confirmed by the next message
_MAX_GAP: Final = 60_000_000  # us; a longer step is skipped
_MAX_BEHIND: Final = 1000  # consecutive messages more than _MAX_GAP behind the clock, after which the clock is set back


def open_ulog(file: str, options: RecordedOptions, default_vehicle: str) -> ReplayRun:
    """Read the start of a log; raise SourceError if it is not a ULog file or has none of the requested topics."""
    path = Path(file).expanduser()
    reader = UlogReader(path, topics=options.chosen_topics, vehicle=options.vehicle, default_vehicle=default_vehicle)
    run = ReplayRun(iter(()), {}, None, "", position=0)
    messages = _read(reader, run, path, options)
    ahead = list(islice(messages, _LOOKAHEAD))
    run.messages = (message for part in (ahead, messages) for message in part)  # a generator, which can be closed
    run.total, run.boot_utc = path.stat().st_size, reader.boot_utc
    streams = list(reader.streams.values())
    layouts = " and ".join(sorted({_layout_name(each) for each in streams if each.definition is DEFAULT}))
    layout = f", layout {layouts}" if layouts else ""
    run.summary = f"vehicle {streams[0].address.vehicle}{layout}, {run.total / 1e6:.1f} MB"
    run.warnings = run.warnings or tuple(_warnings_of(reader))
    return run


def _read(reader: UlogReader, run: ReplayRun, path: Path, options: RecordedOptions) -> Iterator[SourceMessage]:
    """Yield the messages of a log, and update its run."""
    clock, begun = _Clock(), set[LoggedStream]()
    for due, stream, payload in clock.pace(reader):
        run.position, address, definition = reader.position, stream.address, stream.definition
        if stream not in begun:
            begun.add(stream)
            run.addresses[address] = definition
        dropout, reader.dropout = reader.dropout, 0.0
        given = stream.decode(payload) if stream.converted else None  # warns at once if fields are left out
        yield SourceMessage(due, address, given, 0, False, None, definition, None, dropout, stream, payload)
    warnings = _warnings_of(reader)
    for address, count in clock.unordered.items():
        warnings.append(f"timestamps of {address} are out of order ({count}); the order of the log is kept")
    warnings += options.absent_from({address.topic for address in reader.streams}, "this log")
    if clock.gaps:
        warnings.append(f"skipped gaps of more than {_MAX_GAP // 1e6:.0f} s in the timestamps ({clock.gaps})")
    run.warnings = tuple(warnings)
    if reader.damaged:
        run.damage = f"{path}: some messages are lost to damage; {'; '.join(reader.warnings)}"


class _Clock:
    """Replay clock: follows the timestamps of a log from the start of logging, and ignores outliers."""

    def __init__(self) -> None:
        self.gaps = 0  # steps that were too long, and skipped
        self.unordered: Counter[Address] = Counter()  # timestamps out of order
        self._now = self._due = self._behind = 0  # us; messages
        self._is_running = False

    def pace(self, reader: UlogReader) -> Iterator[tuple[float, LoggedStream, bytes]]:
        """Yield due time [s since the start], stream and payload of each message; due times never decrease."""
        newest: dict[LoggedStream, int] = {}
        held: tuple[int, LoggedStream, bytes] | None = None
        for stream, payload in reader.messages():
            (timestamp,) = stream.timestamp(payload)
            time = timestamp or 0
            self._now = self._now or reader.start
            if time < newest.get(stream, 0) and stream.subscription is not LOG_MESSAGE:  # PX4 queues log messages
                self.unordered[stream.address] += 1
            newest[stream] = time
            if held is not None:
                if time >= held[0] - _MAX_STEP:
                    self._follow(held[0])
                yield self._due / 1e6, *held[1:]
                held = None
            step = time - self._now
            if step > _MAX_STEP:
                held = time, stream, payload
                continue
            if step >= 0 and self._is_running:
                self._due, self._now, self._behind = self._due + step, time, 0
            else:
                self._follow(time)
            yield self._due / 1e6, stream, payload
        if held is not None:
            if held[0] <= self._now + _MAX_GAP:
                self._follow(held[0])
            elif self._is_running:
                self.unordered[held[1].address] += 1
            yield self._due / 1e6, *held[1:]

    def _follow(self, time: int) -> None:
        """Advance to a timestamp; go back only if the clock is far ahead of many consecutive messages."""
        step = time - self._now
        self._behind = self._behind + 1 if step < -_MAX_GAP else 0
        if step < 0 and self._behind < _MAX_BEHIND:
            return
        if step > _MAX_GAP and self._is_running:
            self.gaps += 1
        elif self._is_running:
            self._due += max(0, step)
        self._now, self._is_running = time, True


def _warnings_of(reader: UlogReader) -> list[str]:
    warnings = reader.warnings
    for stream in reader.streams.values():
        unknown = sorted(set(stream.names) - stream.definition.known_types.keys())
        if unknown and _is_newer(stream):
            warnings.append(f"left out unknown fields of {stream.address} ({', '.join(unknown)}); update nedbus")
    return warnings


def _is_newer(stream: LoggedStream) -> bool:
    """Return whether a stream has all fields of the newest known layout, as in a log newer than nedbus."""
    newest = [layout for layout in stream.definition.layouts.values() if layout.name != ALL][-1]
    return newest.types.keys() <= set(stream.names)


def _layout_name(stream: LoggedStream) -> str:
    layout = stream.definition.find_layout(stream.names)
    return layout.name if layout else "newer than 1.16" if _is_newer(stream) else "1.12 or older"
