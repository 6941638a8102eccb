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
_COUNTED: Final = frozenset(
    {"delivered", "unsynchronised"}
)  # verdicts of chunks whose loss is counted
_FURTHER: Final = Rejection(
    "further places", f"the limit is {limits.WAITING_REJECTIONS} different rejections at a time"
)


def join_data(items: Iterable[Received | Rejection]) -> list[Received | Rejection]:
    """Join the ULog data of each vehicle as far as it is contiguous; it may overtake other messages."""
    joined = list[Rejection | list[Received]]()
    last_run = dict[int, list[Received]]()  # by vehicle
    for item in items:
        if isinstance(item, Rejection):
            joined.append(item)
            continue
        run = last_run.get(item.system)
        if item.chunk is not None and run is not None and item.continues(run[-1]):
            run.append(item)
            continue
        run = [item]
        joined.append(run)
        if item.chunk is not None:
            last_run[item.system] = run
    return [item if isinstance(item, Rejection) else _join(item) for item in joined]


def _join(run: list[Received]) -> Received:
    """Return one message with the ULog data of all."""
    first = run[0]
    if first.chunk is None or len(run) == 1:
        return first
    chunks = [received.chunk for received in run if received.chunk is not None]
    data = b"".join(chunk.data for chunk in chunks)
    chunk = first.chunk._replace(data=data, offset=_first_record(chunks))
    return first._replace(message=run[-1].message, chunk=chunk, parts=len(run))


def _first_record(chunks: Iterable[Chunk]) -> int:
    """Return the offset of the first record that begins in the joined data, beyond its end if none does."""
    begin = offset = 0
    for chunk in chunks:
        offset = begin + chunk.offset
        begin += len(chunk.data)
        if offset < begin:
            break
    return offset


@dataclass(slots=True)
class _VehicleQueue:
    """Messages of one vehicle that wait, and what was lost when others were dropped."""

    waiting: deque[Received] = field(default_factory=deque)
    used: float = 0.0  # time spent on its messages [s]
    lost: int = 0  # messages dropped, or lost before those, to report with the next one
    lost_chunks: int = 0
    is_cut: bool = False  # chunks were dropped, and no record has begun since
    is_undefined: bool = False  # the beginning of the stream was dropped

    def drop(self, received: Received) -> None:
        """Count a removed message as lost."""
        self.lost += received.lost + received.parts
        chunk = received.chunk
        if chunk is None:
            return
        self.lost_chunks += chunk.lost
        if chunk.verdict in _COUNTED:
            self.lost_chunks += received.parts
        self.is_cut = True
        if chunk.begins:
            self.is_undefined = True

    def resume(self, received: Received) -> Received:
        """Return the next message, with all losses before it; after a dropped chunk, data begins with a record."""
        lost = self.lost
        self.lost = 0
        chunk = received.chunk
        if chunk is not None and (self.is_cut or chunk.begins):
            return received._replace(lost=received.lost + lost, chunk=self._resume_data(chunk))
        if not lost:
            return received
        return received._replace(lost=received.lost + lost)

    def _resume_data(self, chunk: Chunk) -> Chunk:
        """Return a chunk that begins a stream, or follows a dropped one, as far as it can be decoded."""
        if chunk.begins:
            self.is_undefined = False
        resumed = chunk
        if self.is_undefined:
            resumed = Chunk("no_definitions")
        elif chunk.verdict == "delivered" and chunk.offset < len(chunk.data):
            self.is_cut = False
            resumed = chunk._replace(data=chunk.data[chunk.offset :], offset=0)
        elif chunk.verdict == "delivered":
            resumed = Chunk("unsynchronised", lost=chunk.lost)
        if resumed.verdict not in _COUNTED:
            return resumed
        lost = resumed.lost + self.lost_chunks
        self.lost_chunks = 0
        if resumed.begins:  # what was lost is of an earlier stream
            lost = 0
        return resumed._replace(lost=lost)


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
        self._count = 0
        self._dropped = 0
        self._turn = 0.0  # `used` of the vehicle that is served
        self._load = LinkLoad()
        self._overload_end = 0.0
        self._longest_wait = 0.0

    def put(self, *items: Received | Rejection) -> None:
        """Add messages; drop the oldest ones of the longest queue while there are too many."""
        with self._changed:
            for item in items:
                if isinstance(item, Rejection):
                    self._put_rejection(item)
                else:
                    self._put_message(item)
            self._changed.notify()

    def _put_rejection(self, rejection: Rejection) -> None:
        kept = rejection
        if len(self._rejections) >= limits.WAITING_REJECTIONS and kept not in self._rejections:
            kept = _FURTHER
        self._rejections[kept] += rejection.count

    def _put_message(self, received: Received) -> None:
        vehicle = self._vehicles.get(received.system)
        if vehicle is None:
            vehicle = self._vehicles[received.system] = _VehicleQueue()
        if not vehicle.waiting:  # time in which it had no messages is not owed to it
            vehicle.used = max(vehicle.used, self._turn)
        vehicle.waiting.append(received)
        self._count += received.parts
        while self._count > limits.MAVLINK_WAITING:
            longest = max(self._vehicles.values(), key=lambda queue: len(queue.waiting))
            self._drop(longest, longest.waiting.popleft())

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
            rejections = self._rejections
            self._rejections = Counter()
        for rejection, count in rejections.items():
            yield replace(rejection, count=count)
        now = self._now()
        end = now + _READ_TIME
        for _ in range(_READ_MESSAGES):
            taken = self._take(now)
            wait = 0.0 if taken is None else now - taken[1].time
            load = self._measure(wait, self._dropped + lost_by_host, now)
            if load != self._load:
                self._load = load
                yield load
            if taken is None:
                if self._error is not None:
                    raise self._error
                return
            vehicle, received = taken
            yield received
            before = now
            now = self._now()
            vehicle.used += now - before
            if now > end:
                return

    def _take(self, now: float) -> tuple[_VehicleQueue, Received] | None:
        """Remove the next message of the vehicle that has used the least time; drop those that waited too long."""
        with self._changed:
            while True:
                ready = [vehicle for vehicle in self._vehicles.values() if vehicle.waiting]
                if not ready:
                    return None
                # `min` would take longer for one vehicle, the usual number
                vehicle = ready[0] if len(ready) == 1 else min(ready, key=attrgetter("used"))
                self._turn = vehicle.used
                received = self._take_from(vehicle, now)
                if received is not None:
                    return vehicle, received

    def _take_from(self, vehicle: _VehicleQueue, now: float) -> Received | None:
        """Remove the next message of a vehicle; None if all waited too long, and were dropped."""
        longest = TIMINGS.link_wait
        while vehicle.waiting:
            received = vehicle.waiting.popleft()
            is_fresh = now - received.time <= longest
            if is_fresh or received.message.get_type() == "LOGGING_DATA_ACKED":
                self._count -= received.parts
                return vehicle.resume(received)
            longest = _FRESH
            self._drop(vehicle, received)
        return None

    def _drop(self, vehicle: _VehicleQueue, received: Received) -> None:
        vehicle.drop(received)
        self._count -= received.parts
        self._dropped += received.parts

    def _measure(self, wait: float, dropped: int, now: float) -> LinkLoad:
        """Return the load of the host, given the wait of the next message and the number of dropped ones."""
        if wait > _LATE or dropped > self._load.dropped:
            self._longest_wait = max(wait, self._longest_wait)
            self._overload_end = now + _MEMORY
        elif now < self._overload_end or not self._load.overload:
            return self._load
        if now >= self._overload_end:
            self._longest_wait = 0.0
            return LinkLoad(dropped)
        text = f"host overloaded: messages up to {self._longest_wait:.1f} s late, {dropped} dropped"
        return LinkLoad(dropped, text)
