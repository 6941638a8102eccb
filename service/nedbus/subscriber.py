"""Typed iteration over what arrives, sync and async: the newest of each key, or every sample.

`Intake` decides and does no I/O; `Feed` is the Zenoh side; the two subscriptions differ only in how they wait.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Literal, Self

import zenoh

from nedbus_msgs import Address, AddressError, DecodeError, UnknownLayoutError, VehicleLocalPosition, decode

from .errors import ClosedError, NoDataError
from .session import drain, receive, while_open

_log = logging.getLogger(__name__)

Mode = Literal["latest", "every"]

_RING: Final = 1024  # samples that wait for a `latest` reader
_FIFO: Final = 4096  # samples that wait for an `every` reader; behind it Zenoh holds back, then drops and recovers
_QUEUE: Final = 1024  # samples that a pump takes ahead of an `every` reader
_KEYS: Final = 10_000  # keys that a reader keeps in mind
_LAYOUTS: Final = 16  # unknown layouts that a reader asks for


@dataclass(frozen=True, slots=True)
class Sample:
    """One message that arrived.

    `message`: the validated message.
    `address`: vehicle, topic and instance, also as attributes of their own.
    `received`: when it was taken here, ns since the epoch.
    `sent`: when its publisher sent it, ns since the epoch by the publisher's clock; None if it did not say.
    `lost`: messages of this key that were lost on the way just before this one.
    """

    message: VehicleLocalPosition
    address: Address
    received: int
    sent: int | None
    lost: int = 0

    @property
    def vehicle(self) -> str:
        """The vehicle."""
        return self.address.vehicle

    @property
    def topic(self) -> str:
        """The uORB topic."""
        return self.address.topic

    @property
    def instance(self) -> int | None:
        """The uORB instance, for estimator_local_position."""
        return self.address.instance

    @property
    def latency(self) -> float | None:
        """Seconds from sent to received, None if the publisher did not say; as good as the two hosts' clocks agree."""
        return None if self.sent is None else (self.received - self.sent) / 1e9


@dataclass(frozen=True, slots=True)
class Counts:
    """What became of the messages of a subscription.

    `received`: given to the reader.
    `lost`: gone on the way, and not recovered.
    `dropped`: arrived, but superseded because this reader was slower (mode "latest" only).
    `invalid`: no valid message, or no valid key; the log says once per key why.
    """

    received: int = 0
    lost: int = 0
    dropped: int = 0
    invalid: int = 0


@dataclass(slots=True)
class _Track:
    """Where the sequence of a key stands: its publisher, its last number, and what was lost since the last Sample."""

    source: str
    last: int
    lost: int = 0


class Intake:
    """Turn what arrives into Samples, and count; no I/O but the look-up of an unknown layout."""

    def __init__(self, mode: Mode, *, prefix: str, find_layout: Callable[[int], Sequence[str] | None]) -> None:
        self.newest_only = mode == "latest"
        self._prefix = prefix
        self._find_layout = find_layout
        self._newer: dict[int, Sequence[str]] = {}
        self._asked: set[int] = set()
        self._addresses: dict[str, Address] = {}
        self._warned: set[str] = set()
        self._room = threading.Condition()  # also guards what follows: a pump puts, a reader pops
        self._queue: deque[zenoh.Sample] = deque()
        self._newest: dict[str, zenoh.Sample] = {}
        self._misses: deque[zenoh.ext.Miss] = deque()
        self._missed: dict[str, int] = {}  # by source: lost on the way, and not yet found as a gap
        self._tracks: dict[str, _Track] = {}
        self._received = self._lost = self._dropped = self._invalid = 0

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        with self._room:
            self._settle_misses()
        return Counts(self._received, self._lost, self._dropped, self._invalid)

    def miss(self, miss: zenoh.ext.Miss) -> None:
        """Take note of messages that were lost on the way; called on Zenoh's thread, before the next sample."""
        self._misses.append(miss)

    def put(self, batch: Iterable[zenoh.Sample]) -> None:
        """Take in what arrived, in its order."""
        with self._room:
            if self.newest_only:
                for raw in batch:
                    self._put_newest(raw)
            else:
                self._queue.extend(batch)

    def pop(self) -> Sample | None:
        """Return the next sample, None when nothing is left; what is invalid is counted and left out."""
        while True:
            with self._room:
                if self._newest:
                    raw = self._newest.pop(next(iter(self._newest)))
                elif self._queue:
                    raw = self._queue.popleft()
                    if len(self._queue) == _QUEUE // 2:
                        self._room.notify_all()
                    self._follow(str(raw.key_expr), raw)
                else:
                    return None
            sample = self.read(raw)
            if sample is not None:
                self._received += 1
                return sample

    def wait_for_room(self, timeout: float) -> bool:
        """Wait until the reader has worked off enough for more to come; return whether it has."""
        with self._room:
            return self._room.wait_for(lambda: len(self._queue) < _QUEUE, timeout)

    def _put_newest(self, raw: zenoh.Sample) -> None:
        key = str(raw.key_expr)
        self._follow(key, raw)
        if key in self._newest or len(self._newest) >= _KEYS:
            self._dropped += 1
        if key in self._newest or len(self._newest) < _KEYS:
            self._newest[key] = raw

    def read(self, raw: zenoh.Sample) -> Sample | None:
        """Decode and check one sample; None if it is invalid."""
        key = str(raw.key_expr)
        try:
            address = self._addresses.get(key) or self._learn(key)
            if raw.kind != zenoh.SampleKind.PUT:
                raise DecodeError("a delete, which no publisher of ours sends")
            message = self._decode(raw.payload.to_bytes())
        except (AddressError, DecodeError) as exc:
            self._invalid += 1
            self._warn(key, str(exc))
            return None
        lost = 0
        track = self._tracks.get(key)
        if track is not None:
            lost, track.lost = track.lost, 0
        stamp = raw.timestamp
        sent = None if stamp is None else stamp.get_time_as_ntp64().as_nanos()
        return Sample(message, address, time.time_ns(), sent, lost)

    def _learn(self, key: str) -> Address:
        address = Address.from_key(key, prefix=self._prefix)
        if len(self._addresses) < _KEYS:
            self._addresses[key] = address
        return address

    def _decode(self, payload: bytes) -> VehicleLocalPosition:
        try:
            return decode(payload, newer=self._newer)
        except UnknownLayoutError as exc:
            fields = self._ask_for_layout(exc.layout)
            if fields is None:
                raise
            return decode(payload, newer=self._newer)

    def _ask_for_layout(self, layout: int) -> Sequence[str] | None:
        """Learn the field names of a layout from its publisher, once; None if nobody knows it."""
        if layout in self._asked or len(self._asked) >= _LAYOUTS:
            return None
        self._asked.add(layout)
        fields = self._find_layout(layout)
        if fields is not None:
            self._newer[layout] = fields
            unread = [name for name in fields if name not in VehicleLocalPosition.model_fields]
            _log.warning("layout %d is newer than this reader; not read: %s", layout, ", ".join(unread) or "nothing")
        return fields

    def _settle_misses(self) -> None:
        while self._misses:
            miss = self._misses.popleft()
            source = str(miss.source)
            self._lost += miss.nb
            if self.newest_only and (source in self._missed or len(self._missed) < _KEYS):
                self._missed[source] = self._missed.get(source, 0) + miss.nb

    def _follow(self, key: str, raw: zenoh.Sample) -> None:
        """Follow the publisher's sequence; a gap is what was lost on the way, and what this reader's ring dropped."""
        info = raw.source_info
        if info is None:
            return
        track = self._tracks.get(key)
        number = info.source_sn
        if track is not None and number == track.last + 1:
            track.last = number
            return
        source = str(info.source_id)
        if track is None or track.source != source:
            if track is not None or len(self._tracks) < _KEYS:
                self._tracks[key] = _Track(source, number)
            return
        gap = max(0, number - track.last - 1)
        track.last = max(track.last, number)
        if self.newest_only:
            self._settle_misses()
            missed = self._missed.pop(source, 0)
            lost = min(gap, missed)
            if missed > lost:
                self._missed[source] = missed - lost
            self._dropped += gap - lost
            gap = lost
        track.lost += gap

    def _warn(self, key: str, reason: str) -> None:
        if key not in self._warned and len(self._warned) < _KEYS:
            self._warned.add(key)
            _log.warning("%s: %s", key, reason)


class Feed:
    """The Zenoh side of one subscription: a channel, the listener for losses, and a thread that waits if asked for.

    An `every` subscription has a session of its own: its channel holds back when it is full, and so would everything
    else on that session.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, intake: Intake) -> None:
        every = not intake.newest_only
        self.ended = False
        self._closed = False
        self._intake = intake
        self._session = session if every else None
        self._lock = threading.Lock()
        self._pump: threading.Thread | None = None
        channel: zenoh.handlers.FifoChannel[zenoh.Sample] | zenoh.handlers.RingChannel[zenoh.Sample]
        channel = zenoh.handlers.FifoChannel(_FIFO) if every else zenoh.handlers.RingChannel(_RING)
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None) if every else None
        # No late-publisher detection: after a router's restart its history query would win over recovery.
        history = zenoh.ext.HistoryConfig(max_samples=1)
        with while_open():
            self._subscriber = zenoh.ext.declare_advanced_subscriber(
                session, key_expr, channel, history=history, recovery=recovery
            )
            self._misses = self._subscriber.sample_miss_listener(zenoh.handlers.Callback(intake.miss, indirect=False))
        # The handler is asked, never the subscriber: a receive on that one would keep it from being undeclared.
        self._handler: zenoh.Handler[zenoh.Sample] = self._subscriber.handler

    @property
    def pumped(self) -> bool:
        """Whether a thread puts what arrives into the intake."""
        return self._pump is not None

    def wait(self) -> bool:
        """Wait for samples and put them into the intake; return False, and set `ended`, when no more can come."""
        batch = receive(self._handler)
        self._intake.put(batch)
        self.ended = not batch
        return bool(batch)

    def take(self) -> None:
        """Put the samples that are there into the intake."""
        self._intake.put(drain(self._handler))

    def start_pump(self, wake: Callable[[], object]) -> None:
        """Start a thread that puts what arrives into the intake and calls `wake` each time, and once at the end."""
        self._pump = threading.Thread(target=self._run_pump, args=(wake,), name="nedbus-pump", daemon=True)
        self._pump.start()

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = self.ended = True
        # A full channel holds Zenoh's thread, which holds the lock that undeclaring needs: somebody must go on reading.
        reader = threading.Thread(target=self._discard, name="nedbus-discard", daemon=True)
        reader.start()
        self._misses.undeclare()
        self._subscriber.undeclare()
        if self._session is not None:
            self._session.close()
        for thread in (reader, self._pump):
            if thread is not None and thread is not threading.current_thread():
                thread.join(1.0)

    def _discard(self) -> None:
        while receive(self._handler):
            pass

    def _run_pump(self, wake: Callable[[], object]) -> None:
        while self.wait():
            wake()
            while not self._closed and not self._intake.wait_for_room(0.1):
                pass
        wake()


class Subscription:
    """Iterate over the samples of a subscription; get one from `bus.subscribe(...)`.

    Iteration waits for the next sample and ends when the subscription or the bus is closed.
    Forgetting it closes it, and so does the end of the process.
    """

    def __init__(self, feed: Feed, intake: Intake, *, name: str) -> None:
        self.name = name
        self._feed = feed
        self._intake = intake
        self._arrival = threading.Event()
        self._finalizer = weakref.finalize(self, feed.close)

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        return self._intake.counts

    def receive(self, timeout: float | None = None) -> Sample:
        """Wait for the next sample and return it.

        Raises NoDataError when none came within `timeout` seconds, ClosedError when the subscription is closed.
        """
        if timeout is not None and not self._feed.pumped:
            self._feed.start_pump(self._arrival.set)
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            self._arrival.clear()
            if self._intake.newest_only and not self._feed.pumped:
                self._feed.take()
            sample = self._intake.pop()
            if sample is not None:
                return sample
            if self._feed.ended:
                raise ClosedError
            if not self._feed.pumped:
                self._feed.wait()
            elif not self._arrival.wait(None if deadline is None else max(0.0, deadline - time.monotonic())):
                raise NoDataError(self.name, timeout or 0.0)

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        self._finalizer()

    def __iter__(self) -> Iterator[Sample]:
        return self

    def __next__(self) -> Sample:
        try:
            return self.receive()
        except ClosedError:
            raise StopIteration from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class AsyncSubscription:
    """Iterate over the samples of a subscription from asyncio; get one from `bus.subscribe(...)`.

    The twin of Subscription, with `async for`, `await receive()` and `await close()`; it opens at its first use.
    """

    def __init__(self, open_feed: Callable[[], Feed], intake: Intake, *, name: str) -> None:
        self.name = name
        self._open_feed = open_feed
        self._intake = intake
        self._feed: Feed | None = None
        self._finalizer: Callable[[], object] = lambda: None
        self._opening = asyncio.Lock()
        self._arrival = asyncio.Event()
        self._turns = 0

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        return self._intake.counts

    async def receive(self, timeout: float | None = None) -> Sample:
        """Wait for the next sample and return it.

        Raises NoDataError when none came within `timeout` seconds, ClosedError when the subscription is closed.
        """
        feed = await self._open()
        try:
            async with asyncio.timeout(timeout):
                while True:
                    self._arrival.clear()
                    sample = self._intake.pop()
                    if sample is not None:
                        await self._let_others_run()
                        return sample
                    if feed.ended:
                        raise ClosedError
                    await self._arrival.wait()
        except TimeoutError:
            raise NoDataError(self.name, timeout or 0.0) from None

    async def close(self) -> None:
        """End the subscription; a second call does nothing."""
        await asyncio.to_thread(self._finalizer)

    def __aiter__(self) -> AsyncIterator[Sample]:
        return self

    async def __anext__(self) -> Sample:
        try:
            return await self.receive()
        except ClosedError:
            raise StopAsyncIteration from None

    async def __aenter__(self) -> Self:
        await self._open()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def _open(self) -> Feed:
        async with self._opening:
            if self._feed is None:
                self._feed = await asyncio.to_thread(self._open_feed)
                self._finalizer = weakref.finalize(self, self._feed.close)
                self._feed.start_pump(_waker(asyncio.get_running_loop(), self._arrival))
        return self._feed

    async def _let_others_run(self) -> None:
        """Give way to the loop now and then: a reader that always finds a sample would never do so."""
        self._turns += 1
        if self._turns % 64 == 0:
            await asyncio.sleep(0)


def _waker(loop: asyncio.AbstractEventLoop, arrival: asyncio.Event) -> Callable[[], None]:
    """Return a function for any thread that wakes the reader; it does not keep the subscription alive."""

    def wake() -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody waits any more
            loop.call_soon_threadsafe(arrival.set)

    return wake
