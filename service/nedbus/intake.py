"""What arrived, and what became of it: Samples, Counts, and the Intake that turns raw samples into them.

The Intake decides and counts, without I/O but the look-up of a layout; `subscriber` brings it what arrives, and waits.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, cast, get_args

import zenoh

from nedbus_msgs import (
    FIELD_TYPES,
    PAYLOAD_LIMIT,
    PAYLOAD_SIZE,
    Address,
    AddressError,
    DecodeError,
    Origin,
    Row,
    UnknownLayoutError,
    VehicleLocalPosition,
    decode,
    decode_row,
    origin_of,
)

if TYPE_CHECKING:
    from .batches import Batch

_log = logging.getLogger(__name__)

Mode = Literal["latest", "every"]

_QUEUE: Final = 1024  # samples that a pump takes ahead of an `every` reader
_KEYS: Final = 10_000  # keys that a reader keeps in mind
_LAYOUTS: Final = 16  # unknown layouts that a reader keeps in mind
_ASK_AGAIN: Final = 10.0  # s until a layout that nobody could explain is asked for again
_BATCH: Final = 4096  # messages that a batch has at most
_UNKNOWN: Final = Origin()


@dataclass(slots=True)
class Sample:
    """One message that arrived.

    `message`: the validated message; a Row, which has the same fields, if `rows` was asked for.
    `address`: vehicle, topic and instance, also as attributes of their own.
    `received`: when it was taken here, ns since the epoch.
    `stamp`: Zenoh's timestamp, None if its publisher did not say.
    `lost`: messages of this key that were lost on the way just before this one.
    `origin`: where it comes from, `source` and `missing` also as attributes of their own.
    """

    message: VehicleLocalPosition
    address: Address
    received: int
    stamp: zenoh.Timestamp | None = None
    lost: int = 0
    origin: Origin = _UNKNOWN

    @property
    def sent(self) -> int | None:
        """When its publisher sent it, ns since the epoch by the publisher's clock; None if it did not say."""
        return None if self.stamp is None else self.stamp.get_time_as_ntp64().as_nanos()

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
    def source(self) -> str | None:
        """The kind of source, such as `sim`, `ulog`, `px4-zenoh` or `mavlink`; None if its publisher did not say."""
        return self.origin.source

    @property
    def missing(self) -> frozenset[str]:
        """The fields that the source did not provide; they hold NaN, false or 0."""
        if isinstance(self.message, VehicleLocalPosition):  # of an older layout perhaps, by another encoder
            return self.origin.missing | (FIELD_TYPES.keys() - self.message.model_fields_set)
        return self.origin.missing

    @property
    def latency(self) -> float | None:
        """Seconds from sent to received, None if the publisher did not say; as good as the two hosts' clocks agree."""
        sent = self.sent
        return None if sent is None else (self.received - sent) / 1e9


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


@dataclass(slots=True, eq=False)
class _Track:
    """Where the sequence of one publisher stands: its last number, and what is known to be lost but not yet a gap."""

    last: int
    missed: int = 0


@dataclass(slots=True, eq=False)
class _Stream:
    """One key: its address, its only publisher (None for none, or several), what was lost unread; and its origin."""

    address: Address
    track: _Track | None = None
    shared: bool = False
    lost: int = 0
    encoding: zenoh.Encoding | None = None
    origin: Origin = _UNKNOWN


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
        self._streams: dict[str, _Stream] = {}  # by key
        self._warned: set[str] = set()
        self._changed = threading.Condition()
        self._bell: queue.SimpleQueue[None] = queue.SimpleQueue()  # wakes readers, cheaper than a Condition
        self._queue: deque[zenoh.Sample] = deque()
        self._newest: dict[str, zenoh.Sample] = {}
        self._misses: deque[zenoh.ext.Miss] = deque()
        self._tracks: dict[str, _Track] = {}  # by publisher
        self._received = self._lost = self._dropped = self._invalid = 0
        self._told = 0  # of what was lost
        self._full = False  # a pump waits for room

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
        self._ring()

    def end(self) -> None:
        """Tell readers that nothing more comes."""
        with self._changed:
            self.ended = True
            self._changed.notify_all()
        self._ring()

    def wait(self, timeout: float | None) -> bool:
        """Wait until there is something to read, or nothing more can come; return False when neither happened."""
        end = None if timeout is None else time.monotonic() + timeout
        while not (self._queue or self._newest or self.ended):
            try:
                self._bell.get(timeout=None if end is None else max(0.0, end - time.monotonic()))
            except queue.Empty:
                return False
        if self.ended:
            self._ring()  # for others who wait
        return True

    def wait_for_room(self) -> None:
        """Wait until the reader has worked off enough for more to come, or nothing more can come."""
        with self._changed:
            self._full = True  # before the look at the queue, as readers take without the lock
            self._changed.wait_for(lambda: len(self._queue) < _QUEUE or self.ended)
            self._full = False

    def pop(self, read: Callable[..., VehicleLocalPosition] = decode) -> Sample | None:
        """Return the next sample, None when nothing is left; what is invalid is counted and left out."""
        waiting = self._queue
        while True:
            if waiting:
                raw = waiting.popleft()
                if self._full and len(waiting) <= _QUEUE // 2:
                    with self._changed:
                        self._full = False
                        self._changed.notify_all()
                sample = self.read(raw, read, follow=True)
            elif self._newest:
                with self._changed:
                    raw = self._newest.pop(next(iter(self._newest)))
                sample = self.read(raw, read)
            else:
                return None
            if sample is not None:
                self._received += 1
                return sample

    def pop_batch(self) -> Batch | None:
        """Return all that is there, None if that is nothing; what is invalid is counted and left out."""
        from .batches import make_batch

        with self._changed:
            self._settle_misses()
            queue = self._queue
            raw = [*self._newest.values(), *(queue.popleft() for _ in range(min(len(queue), _BATCH)))]
            self._newest.clear()
            self._changed.notify_all()
            # Zenoh's own count of losses is enough here: no single sample is told of them.
            lost, self._told = self._lost - self._told, self._lost
            self._forget_sequences()
        if not raw:
            return None
        keys = [str(sample.key_expr) for sample in raw]
        addresses: dict[str, Address] = {}
        for key in set(keys):
            with suppress(AddressError):  # it is told by whoever judges it
                addresses[key] = (self._streams.get(key) or self._learn(key)).address
        batch = make_batch(raw, keys, addresses, received=time.time_ns(), lost=lost, judge=self._judge)
        self._received += len(batch)
        return batch if len(batch) else None

    def _judge(self, raw: zenoh.Sample) -> Row | None:
        """Return the row of one that is among few, not in our own encoding, or invalid; then it is counted."""
        sample = self.read(raw, decode_row)
        return None if sample is None else cast("Row", sample.message)

    def read(
        self, raw: zenoh.Sample, read: Callable[..., VehicleLocalPosition] = decode, *, follow: bool = False
    ) -> Sample | None:
        """Return the sample of what arrived, None if it is invalid, which is counted and logged."""
        key = str(raw.key_expr)
        stream = self._streams.get(key)
        try:
            if stream is None:
                stream = self._learn(key)
            if follow:
                self._follow(stream, raw)
            payload = raw.payload.to_bytes()
            if not payload and raw.kind == zenoh.SampleKind.DELETE:
                raise DecodeError("a delete, which no publisher of ours sends")
            message = read(payload, newer=self._newer)
        except (AddressError, DecodeError) as exc:
            self._refuse(key, exc)
            return None
        lost, stream.lost = stream.lost, 0
        encoding = raw.encoding
        if encoding != stream.encoding:  # almost always it is the same: comparing is all that it costs
            stream.encoding, stream.origin = encoding, origin_of(str(encoding))
        return Sample(message, stream.address, time.time_ns(), raw.timestamp, lost, stream.origin)

    def screen(self, batch: Iterable[zenoh.Sample]) -> list[zenoh.Sample]:
        """Return what is worth keeping; look up the layouts that are not known here, waiting for publishers' answers.

        What has the size of our own payloads is kept, and judged when it is read.
        Anything else is judged here: it must not take the place of a good sample, nor much memory.
        """
        kept = []
        for raw in batch:
            size = len(raw.payload)
            if size == PAYLOAD_SIZE:
                kept.append(raw)
                continue
            try:
                if size > PAYLOAD_LIMIT:
                    raise DecodeError(f"{size} bytes, more than the {PAYLOAD_LIMIT} that a message can have")
                if raw.kind == zenoh.SampleKind.PUT:
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

    def _ring(self) -> None:
        if self._bell.empty():
            self._bell.put(None)
        self.wake()

    def _learn(self, key: str) -> _Stream:
        stream = _Stream(Address.from_key(key, prefix=self._prefix))
        if len(self._streams) < _KEYS:
            self._streams[key] = stream
        return stream

    def _put_newest(self, raw: zenoh.Sample) -> None:
        key = str(raw.key_expr)
        with suppress(AddressError):  # it is told when it is read
            self._follow(self._streams.get(key) or self._learn(key), raw)
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

    def _follow(self, stream: _Stream, raw: zenoh.Sample) -> None:
        """Follow the publisher's sequence; a gap is what was lost on the way, or what this reader's ring dropped."""
        info = raw.source_info
        if info is None:
            return
        number, track = info.source_sn, stream.track
        if track is not None and number == track.last + 1:
            track.last = number
        else:
            self._follow_jump(stream, str(info.source_id), number)

    def _forget_sequences(self) -> None:
        """Let a reader of batches go on with single samples: what is in between was not lost."""
        if not self.newest_only and self._tracks:
            self._tracks.clear()
            for stream in self._streams.values():
                stream.track = None

    def _follow_jump(self, stream: _Stream, source: str, number: int) -> None:
        track = self._tracks.get(source)
        if track is None:
            track = _Track(number)
            if len(self._tracks) >= _KEYS:
                return
            self._tracks[source] = track
        if not stream.shared:
            stream.shared = stream.track is not None and stream.track is not track
            stream.track = None if stream.shared else track
        gap = max(0, number - track.last - 1)
        track.last = max(track.last, number)
        # A channel that holds back loses nothing: then all of a gap was lost on the way.
        lost = min(gap, track.missed) if self.newest_only else gap
        track.missed -= min(track.missed, lost)
        self._dropped += gap - lost
        stream.lost += lost
