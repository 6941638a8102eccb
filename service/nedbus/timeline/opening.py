"""The first message of a vehicle in a file: the one with which its clock begins."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic

from .track import LATENESS, NEAR, Item, M

# PX4 queues these: the first ones of a log may be from long before it
_QUEUED: Final = ("log_message", "event")


@dataclass(slots=True)
class _Stream(Generic[M]):
    """The first messages of a stream, of which those that are old were left out."""

    items: list[Item[M]]

    @property
    def first(self) -> int:
        return self.items[0].stamp

    @property
    def last(self) -> int:
        return self.items[-1].stamp

    @property
    def is_queued(self) -> bool:
        return self.items[0].message.address.topic in _QUEUED

    @property
    def is_advancing(self) -> bool:
        return self.first < self.last

    def since(self, start: int) -> _Stream[M] | None:
        """Return the part from a timestamp on, None if it does not advance."""
        items = [item for item in self.items if item.stamp >= start]
        part = _Stream(items)
        if items and part.is_advancing:
            return part
        return None

    def drop_old(self) -> None:
        """Leave out a first message that was sent long before the recording of its stream began."""
        if len(self.items) < 2:
            return
        first, second = self.items[:2]
        if _is_old(first, second):
            del self.items[0]


@dataclass(slots=True)
class _Clock(Generic[M]):
    """Streams on one clock, whose periods overlap."""

    streams: list[_Stream[M]]
    end: int

    @property
    def count(self) -> int:
        """Number of messages."""
        return sum(len(stream.items) for stream in self.streams)


def first_of(items: Sequence[Item[M]], start: int) -> Item[M]:
    """Return the message with which the vehicle's clock begins: not an old one, nor one on another clock.

    `start`: when recording began, by the file's header. Old messages come first and once per stream, so streams that
    advance decide, and a header that contradicts them is on another clock.
    """
    streams = _streams_of(items)
    if not streams:
        return items[0]
    advancing = [stream for stream in streams if stream.is_advancing]
    if start:
        parts = [stream.since(start) for stream in streams]
        since_start = [part for part in parts if part is not None]
        advancing = since_start or advancing
    if not advancing:
        return _first_without_clock(streams, start)
    clock = _main_clock(advancing)
    return _earliest(clock.streams)


def _streams_of(items: Iterable[Item[M]]) -> list[_Stream[M]]:
    """Return the streams with timestamps, without those that PX4 queues if there are others."""
    by_stream: dict[Any, list[Item[M]]] = defaultdict(list)
    for item in items:
        if item.stamp:
            by_stream[item.stream].append(item)
    streams = [_Stream(own) for own in by_stream.values()]
    current = [stream for stream in streams if not stream.is_queued]
    streams = current or streams
    for stream in streams:
        stream.drop_old()
    return streams


def _first_without_clock(streams: Sequence[_Stream[M]], start: int) -> Item[M]:
    """Return the first message of streams that do not advance: the earliest since `start`, else that of the file."""
    if start:
        earliest = start - NEAR
        current = [stream for stream in streams if stream.first >= earliest]
        if current:
            return _earliest(current)
    return streams[0].items[0]


def _main_clock(streams: Iterable[_Stream[M]]) -> _Clock[M]:
    """Return the clock of most messages."""
    clocks: list[_Clock[M]] = []
    for stream in sorted(streams, key=lambda stream: stream.first):
        if clocks and stream.first <= clocks[-1].end + LATENESS:
            clock = clocks[-1]
            clock.streams.append(stream)
            clock.end = max(clock.end, stream.last)
        else:
            clocks.append(_Clock([stream], stream.last))
    return max(clocks, key=lambda clock: clock.count)


def _earliest(streams: Collection[_Stream[M]]) -> Item[M]:
    firsts = [stream.items[0] for stream in streams]
    return min(firsts, key=lambda item: item.stamp)


def _is_old(first: Item[M], second: Item[M]) -> bool:
    """Return whether the first message of a stream was sent long before its recording began."""
    if first.log is None or second.log is None:
        return False
    if second.log < first.log:
        return False  # the recorder's clock was set back
    step = second.stamp - first.stamp
    elapsed = second.log - first.log
    return step - elapsed > NEAR
