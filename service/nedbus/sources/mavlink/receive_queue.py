"""Received messages that wait for the source: one queue per vehicle, bounded in time and number, served in turn."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from operator import attrgetter
from threading import Condition
from typing import Final

from nedbus import limits
from nedbus.mavlink import Chunk, Received
from nedbus.sources.source import LinkLoad, Rejection
from nedbus.timings import TIMINGS

# s; of the messages behind one that waited too long, those that waited longer are dropped, too
_FRESH: Final = 0.2
_LATE: Final = 0.5  # s; a longer wait means that the host is overloaded
_MEMORY: Final = 5.0  # s without a late or dropped message until the overload has ended
_READ_MESSAGES: Final = 100  # messages per call of `read`
_READ_TIME: Final = 0.1  # s per call of `read`
_FURTHER: Final = Rejection(
    "further places", f"the limit is {limits.WAITING_REJECTIONS} different rejections at a time"
)


def join_data(items: Iterable[Received | Rejection]) -> list[Received | Rejection]:
    """Join the ULog data of each vehicle as far as it is contiguous; it may overtake other messages."""
    # last run by vehicle
    found, runs = list[Received | Rejection | list[Received]](), dict[int, list[Received]]()
    for item in items:
        if isinstance(item, Rejection) or item.chunk is None:
            found.append(item)
        elif item.system in runs and item.continues(runs[item.system][-1]):
            runs[item.system].append(item)
        else:
            found.append(run := [item])
            runs[item.system] = run
    return [_joined(each) if isinstance(each, list) else each for each in found]


def _joined(run: list[Received]) -> Received:
    """Return one message with the ULog data of all."""
    first, chunks = run[0], [each.chunk for each in run if each.chunk is not None]
    if len(run) == 1:
        return first
    offset = begin = 0
    for chunk in chunks:
        offset, begin = begin + chunk.offset, begin + len(chunk.data)
        if offset < begin:  # a record begins in this one
            break
    data = b"".join(chunk.data for chunk in chunks)
    return first._replace(
        message=run[-1].message, chunk=chunks[0]._replace(data=data, offset=offset), parts=len(run)
    )


@dataclass(slots=True)
class _VehicleQueue:
    """Messages of one vehicle. `used`: time spent on them [s]; `lost`, `cut`: as if dropped messages were lost."""

    waiting: deque[Received] = field(default_factory=deque)
    used: float = 0.0
    lost: int = 0  # messages dropped, or lost before those, to report with the next one
    lost_chunks: int = 0
    is_cut: bool = False  # chunks were dropped, and no record has begun since
    is_undefined: bool = False  # the beginning of the stream was dropped

    def drop(self, received: Received) -> None:
        """Count a removed message as lost."""
        chunk = received.chunk
        self.lost += received.lost + received.parts
        if chunk is not None:
            self.lost_chunks += chunk.lost
            if chunk.verdict in ("delivered", "unsynchronised"):
                self.lost_chunks += received.parts
            self.is_cut = True
            self.is_undefined = self.is_undefined or chunk.begins

    def resume(self, received: Received) -> Received:
        """Return the next message, with all losses before it; after a dropped chunk, data begins with a record."""
        chunk = received.chunk
        lost, self.lost = received.lost + self.lost, 0
        if chunk is None or not (self.is_cut or chunk.begins):
            return received._replace(lost=lost) if lost != received.lost else received
        self.is_undefined = self.is_undefined and not chunk.begins
        is_delivered = chunk.verdict == "delivered" and not self.is_undefined
        if is_delivered and chunk.offset < len(chunk.data):
            self.is_cut, chunk = False, chunk._replace(data=chunk.data[chunk.offset :], offset=0)
        elif is_delivered:
            chunk = Chunk("unsynchronised", lost=chunk.lost)
        elif self.is_undefined:
            chunk = Chunk("no_definitions")
        if chunk.verdict in ("delivered", "unsynchronised"):
            chunk = chunk._replace(lost=0 if chunk.begins else chunk.lost + self.lost_chunks)
            self.lost_chunks = 0
        return received._replace(lost=lost, chunk=chunk)


class ReceiveQueue:
    """Hand over messages between two threads: `put` and `fail` on that of the link, all else on that of the source.

    Each vehicle gets an equal share of the source's time, so one that needs much of it delays only itself.
    Acknowledged ULog data, which contains the definitions, may wait longer than other messages.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._changed = Condition()
        self._vehicles: dict[int, _VehicleQueue] = {}
        self._rejections: Counter[Rejection] = Counter()
        self._error: BaseException | None = None
        self._count = self._dropped = 0
        self._turn = 0.0  # `used` of the vehicle that is served
        self._load = LinkLoad()
        self._overload_end = 0.0
        self._longest_wait = 0.0

    def put(self, *items: Received | Rejection) -> None:
        """Add messages; drop the oldest ones of the longest queue while there are too many."""
        with self._changed:
            for item in items:
                if isinstance(item, Rejection):
                    is_known = (
                        item in self._rejections
                        or len(self._rejections) < limits.WAITING_REJECTIONS
                    )
                    self._rejections[item if is_known else _FURTHER] += item.count
                    continue
                vehicle = self._vehicles.setdefault(item.system, _VehicleQueue())
                if not vehicle.waiting:  # time in which it had no messages is not owed to it
                    vehicle.used = max(vehicle.used, self._turn)
                vehicle.waiting.append(item)
                self._count += item.parts
                while self._count > limits.MAVLINK_WAITING:
                    longest = max(self._vehicles.values(), key=lambda each: len(each.waiting))
                    self._drop(longest, longest.waiting.popleft())
            self._changed.notify()

    def fail(self, error: BaseException) -> None:
        """Let `read` raise an error once all messages have been read."""
        with self._changed:
            self._error = error
            self._changed.notify()

    def read(
        self, timeout: float, *, lost_by_host: int
    ) -> Iterator[Received | Rejection | LinkLoad]:
        """Yield messages for a short time, and before them changes of the load; wait up to `timeout` for the first.

        `lost_by_host`: datagrams that the operating system has dropped.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._count or self._rejections or self._error, timeout)
            rejections, self._rejections = self._rejections, Counter()
        for rejection, count in rejections.items():
            yield replace(rejection, count=count)
        start = now = self._now()
        for _ in range(_READ_MESSAGES):
            vehicle, received = self._take(now)
            load = self._measure(
                0.0 if received is None else now - received.time, lost_by_host, now
            )
            if load != self._load:
                self._load = load
                yield load
            if vehicle is None or received is None:
                if self._error is not None:
                    raise self._error
                return
            yield received
            before, now = now, self._now()
            vehicle.used += now - before
            if now - start > _READ_TIME:
                return

    def _take(self, now: float) -> tuple[_VehicleQueue | None, Received | None]:
        """Remove the next message of the vehicle that has used the least time; drop those that waited too long."""
        with self._changed:
            while ready := [each for each in self._vehicles.values() if each.waiting]:
                vehicle = ready[0] if len(ready) == 1 else min(ready, key=attrgetter("used"))
                limit = TIMINGS.link_wait
                self._turn = vehicle.used
                while vehicle.waiting:
                    received = vehicle.waiting.popleft()
                    if (
                        now - received.time <= limit
                        or received.message.get_type() == "LOGGING_DATA_ACKED"
                    ):
                        self._count -= received.parts
                        return vehicle, vehicle.resume(received)
                    limit = _FRESH
                    self._drop(vehicle, received)
        return None, None

    def _drop(self, vehicle: _VehicleQueue, received: Received) -> None:
        vehicle.drop(received)
        self._count, self._dropped = self._count - received.parts, self._dropped + received.parts

    def _measure(self, wait: float, lost_by_host: int, now: float) -> LinkLoad:
        """Return the load of the host, given the wait of the next message."""
        dropped = self._dropped + lost_by_host
        if wait > _LATE or dropped > self._load.dropped:
            self._longest_wait, self._overload_end = max(wait, self._longest_wait), now + _MEMORY
        elif now < self._overload_end or not (self._load.overload or dropped != self._load.dropped):
            return self._load
        if now >= self._overload_end:
            self._longest_wait = 0.0
            return LinkLoad(dropped)
        text = f"host overloaded: messages up to {self._longest_wait:.1f} s late, {dropped} dropped"
        return LinkLoad(dropped, text)
