"""Typed iteration over what arrives, sync and async: the newest of each key, or every sample.

`Feed` is the Zenoh side, with a thread that pumps what arrives into an `Intake`; that one decides and counts, without
I/O; the two subscriptions differ only in how they wait for it.
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
import weakref
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Literal, Self, get_args

import zenoh

from nedbus_msgs import (
    PAYLOAD_LIMIT,
    PAYLOAD_SIZE,
    Address,
    AddressError,
    DecodeError,
    UnknownLayoutError,
    VehicleLocalPosition,
    decode,
)

from .errors import ClosedError, NoDataError
from .session import receive, while_open

_log = logging.getLogger(__name__)

Mode = Literal["latest", "every"]

_RING: Final = 4096  # samples that wait for the pump of a `latest` reader
_FIFO: Final = 4096  # samples that wait for the pump of an `every` reader; then Zenoh holds back, drops and recovers
_QUEUE: Final = 1024  # samples that a pump takes ahead of an `every` reader
_KEYS: Final = 10_000  # keys that a reader keeps in mind
_LAYOUTS: Final = 16  # unknown layouts that a reader keeps in mind
_ASK_AGAIN: Final = 10.0  # s until a layout that nobody could explain is asked for again
_TURNS: Final = 64  # samples after which an asyncio reader gives way to others


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
    """Where the sequence of one publisher stands: its last number, and what is known to be lost but not yet a gap."""

    last: int
    missed: int = 0


class Intake:
    """Hold what arrived until it is read, turn it into Samples, and count; no I/O but the look-up of a layout.

    A pump puts, a reader takes; both hold the lock only to move references.
    """

    def __init__(self, mode: Mode, *, prefix: str, find_layout: Callable[[int], Sequence[str] | None]) -> None:
        if mode not in get_args(Mode):
            raise AddressError("mode", mode, f"one of {', '.join(get_args(Mode))}")
        self.newest_only = mode == "latest"
        self.ended = False
        self.wake: Callable[[], object] = lambda: None
        self._prefix = prefix
        self._find_layout = find_layout
        self._newer: dict[int, Sequence[str]] = {}
        self._asked: dict[int, float] = {}
        self._addresses: dict[str, Address] = {}
        self._warned: set[str] = set()
        self._changed = threading.Condition()
        self._queue: deque[zenoh.Sample] = deque()
        self._newest: dict[str, zenoh.Sample] = {}
        self._misses: deque[zenoh.ext.Miss] = deque()
        self._tracks: dict[str, _Track] = {}  # by publisher
        self._single: dict[str, _Track | None] = {}  # by key: its publisher, None once there were several
        self._lost_before: dict[str, int] = {}  # by key: lost since the last sample that was read
        self._received = self._lost = self._dropped = self._invalid = 0

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        with self._changed:
            self._settle_misses()
            return Counts(self._received, self._lost, self._dropped, self._invalid)

    def miss(self, miss: zenoh.ext.Miss) -> None:
        """Take note of messages that were lost on the way; called on Zenoh's thread, before the next sample."""
        self._misses.append(miss)

    def put(self, batch: Sequence[zenoh.Sample]) -> None:
        """Take in what arrived, in its order."""
        with self._changed:
            self._settle_misses()
            if self.newest_only:
                for raw in batch:
                    self._put_newest(raw)
            else:
                self._queue.extend(batch)
            self._changed.notify_all()
        self.wake()

    def end(self) -> None:
        """Tell readers that nothing more comes."""
        with self._changed:
            self.ended = True
            self._changed.notify_all()
        self.wake()

    def wait(self, timeout: float | None) -> bool:
        """Wait until there is something to read, or nothing more can come; return False when neither happened."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._queue or self._newest or self.ended), timeout)

    def wait_for_room(self) -> None:
        """Wait until the reader has worked off enough for more to come, or nothing more can come."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._queue) < _QUEUE or self.ended)

    def pop(self) -> Sample | None:
        """Return the next sample, None when nothing is left; what is invalid is counted and left out."""
        while True:
            with self._changed:
                if self._newest:
                    key = next(iter(self._newest))
                    raw = self._newest.pop(key)
                elif self._queue:
                    raw = self._queue.popleft()
                    key = str(raw.key_expr)
                    self._follow(key, raw)
                    if len(self._queue) == _QUEUE // 2:
                        self._changed.notify_all()
                else:
                    return None
            sample = self.read(raw)
            if sample is not None:
                self._received += 1
                return sample

    def read(self, raw: zenoh.Sample) -> Sample | None:
        """Decode and check one sample; None if it is invalid."""
        key = str(raw.key_expr)
        try:
            address = self._addresses.get(key) or self._learn(key)
            if raw.kind != zenoh.SampleKind.PUT:
                raise DecodeError("a delete, which no publisher of ours sends")
            message = decode(raw.payload.to_bytes(), newer=self._newer)
        except (AddressError, DecodeError) as exc:
            self._refuse(key, exc)
            return None
        lost = self._lost_before.pop(key, 0) if self._lost_before else 0
        stamp = raw.timestamp
        sent = None if stamp is None else stamp.get_time_as_ntp64().as_nanos()
        return Sample(message, address, time.time_ns(), sent, lost)

    def screen(self, batch: Iterable[zenoh.Sample]) -> list[zenoh.Sample]:
        """Return what is worth keeping; look up the layouts that are not known here, waiting for publishers' answers.

        What has the size of our own payloads is kept, and judged when it is read.
        Anything else is judged here: it must not take the place of a good sample, nor much memory.
        """
        kept = []
        for raw in batch:
            size = len(raw.payload)
            try:
                if size > PAYLOAD_LIMIT:
                    raise DecodeError(f"{size} bytes, more than the {PAYLOAD_LIMIT} that a message can have")
                if size != PAYLOAD_SIZE and raw.kind == zenoh.SampleKind.PUT:
                    self._try(raw.payload.to_bytes())
            except DecodeError as exc:
                self._refuse(str(raw.key_expr), exc)
            else:
                kept.append(raw)
        return kept

    def _try(self, payload: bytes) -> None:
        try:
            decode(payload, newer=self._newer)
        except UnknownLayoutError as exc:
            self._ask_for_layout(exc.layout)
            if exc.layout not in self._newer:
                raise

    def _refuse(self, key: str, error: Exception) -> None:
        with self._changed:
            self._invalid += 1
        if key not in self._warned and len(self._warned) < _KEYS:
            self._warned.add(key)
            _log.warning("%r: %s", key, error)

    def _ask_for_layout(self, layout: int) -> None:
        now = time.monotonic()
        if now < self._asked.get(layout, 0.0) or (layout not in self._asked and len(self._asked) >= _LAYOUTS):
            return
        fields = self._find_layout(layout)
        self._asked[layout] = time.monotonic() + _ASK_AGAIN
        if fields is not None:
            self._newer[layout] = fields
            unread = [name for name in fields if name not in VehicleLocalPosition.model_fields]
            _log.warning("layout %d is newer than this reader; not read: %s", layout, ", ".join(unread) or "nothing")

    def _learn(self, key: str) -> Address:
        address = Address.from_key(key, prefix=self._prefix)
        if len(self._addresses) < _KEYS:
            self._addresses[key] = address
        return address

    def _put_newest(self, raw: zenoh.Sample) -> None:
        key = str(raw.key_expr)
        self._follow(key, raw)
        if key in self._newest or len(self._newest) >= _KEYS:
            self._dropped += 1
        if key in self._newest or len(self._newest) < _KEYS:
            self._newest[key] = raw

    def _settle_misses(self) -> None:
        while self._misses:
            miss = self._misses.popleft()
            self._lost += miss.nb
            track = self._tracks.get(str(miss.source))
            if track is not None:
                track.missed += miss.nb

    def _follow(self, key: str, raw: zenoh.Sample) -> None:
        """Follow the publisher's sequence; a gap is what was lost on the way, or what this reader's ring dropped."""
        info = raw.source_info
        if info is None:
            return
        number = info.source_sn
        track = self._single.get(key)
        if track is not None and number == track.last + 1:
            track.last = number
            return
        source = str(info.source_id)
        track = self._tracks.get(source)
        if track is None:
            track = _Track(number)
            if len(self._tracks) >= _KEYS:
                return
            self._tracks[source] = track
        if key in self._single or len(self._single) < _KEYS:
            self._single[key] = track if self._single.get(key, track) is track else None
        gap = max(0, number - track.last - 1)
        track.last = max(track.last, number)
        # A channel that holds back loses nothing: then all of a gap was lost on the way.
        lost = min(gap, track.missed) if self.newest_only else gap
        track.missed -= min(track.missed, lost)
        self._dropped += gap - lost
        if lost and (key in self._lost_before or len(self._lost_before) < _KEYS):
            self._lost_before[key] = self._lost_before.get(key, 0) + lost


class Feed:
    """The Zenoh side of one subscription: a channel, the listener for losses, and the thread that empties it.

    An `every` subscription has a session of its own: its channel holds back when it is full, and so would everything
    else on that session. The feed closes it.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, intake: Intake) -> None:
        every = not intake.newest_only
        self._intake = intake
        self._session = session if every else None
        self._closing = threading.Lock()
        self._closed = False
        channel: zenoh.handlers.FifoChannel[zenoh.Sample] | zenoh.handlers.RingChannel[zenoh.Sample]
        channel = zenoh.handlers.FifoChannel(_FIFO) if every else zenoh.handlers.RingChannel(_RING)
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None) if every else None
        # No late-publisher detection: after a router's restart its history query would win over recovery.
        history = zenoh.ext.HistoryConfig(max_samples=1)
        with while_open(session):
            self._subscriber = zenoh.ext.declare_advanced_subscriber(
                session, key_expr, channel, history=history, recovery=recovery
            )
            self._misses = self._subscriber.sample_miss_listener(zenoh.handlers.Callback(intake.miss, indirect=False))
        # The handler is asked, never the subscriber: a receive on that one would keep it from being undeclared.
        self._handler: zenoh.Handler[zenoh.Sample] = self._subscriber.handler
        self._pump = threading.Thread(target=self._run, name="nedbus-pump", daemon=True)
        self._pump.start()

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        with self._closing:
            if self._closed:
                return
            self._closed = True
        self._intake.end()
        # A full channel holds Zenoh's thread, which holds the lock that undeclaring needs: meanwhile the pump goes on.
        self._misses.undeclare()
        self._subscriber.undeclare()
        if self._session is not None:
            self._session.close()
        self._pump.join(1.0)

    def _run(self) -> None:
        while batch := receive(self._handler):
            if not self._intake.ended:
                self._intake.put(self._intake.screen(batch))
                self._intake.wait_for_room()
        self._intake.end()


class Subscription:
    """Iterate over the samples of a subscription; get one from `bus.subscribe(...)`.

    Iteration waits for the next sample and ends when the subscription or the bus is closed.
    Forgetting it closes it, and so does the end of the process.
    """

    def __init__(self, feed: Feed, intake: Intake, *, name: str) -> None:
        self.name = name
        self._intake = intake
        self._finalizer = weakref.finalize(self, feed.close)

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        return self._intake.counts

    def receive(self, timeout: float | None = None) -> Sample:
        """Wait for the next sample and return it.

        Raises NoDataError when none came within `timeout` seconds, ClosedError when the subscription is closed.
        """
        deadline = None if timeout is None or timeout == math.inf else time.monotonic() + timeout
        while True:
            if self._intake.ended:
                raise ClosedError
            sample = self._intake.pop()
            if sample is not None:
                return sample
            if not self._intake.wait(None if deadline is None else max(0.0, deadline - time.monotonic())):
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

    The twin of Subscription, with `async for`, `await receive()` and `await close()`; it opens at its first use, and
    belongs to the event loop of that moment.
    """

    def __init__(self, open_feed: Callable[[], Feed], intake: Intake, *, name: str) -> None:
        self.name = name
        self._open_feed = open_feed
        self._intake = intake
        self._finalizer: Callable[[], object] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
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
        await self._open()
        self._turns += 1
        if self._turns % _TURNS == 0:
            await asyncio.sleep(0)  # a reader that always finds a sample would never give way
        try:
            async with asyncio.timeout(timeout):
                while True:
                    self._arrival.clear()
                    if self._intake.ended:
                        raise ClosedError
                    sample = self._intake.pop()
                    if sample is not None:
                        return sample
                    await self._arrival.wait()
        except TimeoutError:
            raise NoDataError(self.name, timeout or 0.0) from None

    async def close(self) -> None:
        """End the subscription; a second call does nothing."""
        async with self._opening:
            self._intake.end()
            if self._finalizer is not None:
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

    async def _open(self) -> None:
        loop = asyncio.get_running_loop()
        if self._loop is None:
            await self._open_in(loop)
        elif self._loop is not loop:
            raise RuntimeError(f"the subscription to {self.name} belongs to another event loop: subscribe in this one")

    async def _open_in(self, loop: asyncio.AbstractEventLoop) -> None:
        async with self._opening:
            if self._loop is not None or self._intake.ended:
                return
            self._intake.wake = _waker(loop, self._arrival)
            feed = await asyncio.to_thread(self._open_feed)
            self._finalizer = weakref.finalize(self, feed.close)
            self._loop = loop


def _waker(loop: asyncio.AbstractEventLoop, arrival: asyncio.Event) -> Callable[[], None]:
    """Return a function for any thread that wakes the reader; it does not keep the subscription alive."""

    def wake() -> None:
        with suppress(RuntimeError):  # the loop is closed: nobody waits any more
            loop.call_soon_threadsafe(arrival.set)

    return wake
