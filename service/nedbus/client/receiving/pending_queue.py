"""Pending queue between receiving and reading: the streams of a subscription and their unread messages; no I/O.

If the reader is slow, mode `latest` replaces unread samples, and mode `every` queues 65,536 and then drops the oldest.
Either way drops are counted, and neither the session nor other readers are delayed.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from heapq import heappop, heappush, heapreplace
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, get_args

from nedbus import clock
from nedbus.errors import ArgumentError, ClosedError, NedbusError, ReceiveError
from nedbus.log_event import about
from nedbus.samples import Counts, Mode, Sample
from nedbus.transport import RawSample, entity_name
from nedbus_msgs import AddressError, DecodeError, identity_of

from .decoder import WAKE_UP, Arrival, Decoder, KeyState, detach, encoding_of, mark_retained
from .writer_proxy import NUMBERS, LossCounters, WriterProxy

if TYPE_CHECKING:
    from nedbus.samples import Batch

_log = logging.getLogger(__name__)

CAPACITY: Final = 65_536
"""Samples queued in mode `every`, about 45 MB; beyond that the oldest are dropped."""

MAX_KEYS: Final = 10_000
"""Keys tracked by a reader, to bound its memory; beyond that the least recently active are evicted and counted."""

MAX_SILENCE: Final = 600.0
"""Seconds without a message or heartbeat after which a key is evicted, if there are more than KEPT_KEYS."""

KEPT_KEYS: Final = 1_000
"""Keys kept however long they are silent, to count the losses of a long outage."""

MAX_HELD: Final = 131_072
"""Maximum number of messages held back behind gaps, about 90 MB; beyond it, gaps count as lost."""

MAX_ACK_REQUESTS: Final = 1000
"""Pending acknowledgement requests; a well-behaved publisher has one per key."""

_MAX_BATCH: Final = 4096  # messages per batch
_MAX_FRESH: Final = 1024  # samples queued with Zenoh's receive buffer; later ones are detached from it
_MAX_WRITERS_OF_KEY: Final = 8  # beyond that the oldest writer without a gap is evicted
_MIN_IN_ORDER: Final = 8  # smaller batches are checked message by message
_SETTLING: Final = 10.0  # s after a link change; a new publisher may have sent messages during the outage
_PAYLOAD: Final = itemgetter(1)
_SLOW: Final = "the reader is slower than the data, so messages are dropped"


@dataclass(slots=True, eq=False)
class AckRequest:
    """Request to acknowledge that message `number` has arrived or, with `read`, that the application has read it."""

    key: str
    publisher: str
    number: int
    read: bool
    reply: Callable[[], object]  # sends the acknowledgement; called once
    read_target: int | None = None  # samples to be read before answering; None until the message has arrived


class PendingQueue:
    """Order the messages of each publisher, count losses and drops, and decode messages when they are read.

    It owns the state of all streams: key states, writer proxies, counters and unread messages, guarded by one lock.
    In mode `every`, a gap holds back later messages until it is filled; in mode `latest`, it counts as lost at once.
    `name`: the key expression. `on_gap` is called, on any thread, when a new gap may be filled by retransmission.
    """

    def __init__(
        self, mode: Mode, decoder: Decoder, *, name: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        if mode not in get_args(Mode):
            raise ArgumentError("mode", mode, f"one of {', '.join(get_args(Mode))}")
        self.newest_only, self.ended = mode == "latest", False
        self._failure = ""  # reason of an end that the user did not cause
        self.on_gap: Callable[[], object] | None = None
        self.on_wake: Callable[[], object] | None = None  # wakes a reader on an event loop; called on any thread
        self.name, self.counters = name, LossCounters()
        self._warned: set[str] = set()
        self.decoder, self._clock = decoder, clock
        self._lock = threading.RLock()  # reentrant, because log handlers may read the counts
        self._tokens: queue.SimpleQueue[None] = queue.SimpleQueue()  # cheaper than a Condition
        self._streams: dict[str, KeyState] = {}
        self._by_activity: list[tuple[float, str]] = []  # heap: each key, with a time at which it was active
        self._settling_until = float("-inf")
        self._every: deque[Arrival] = deque()
        self._newest: dict[str, Arrival] = {}
        self._ack_requests: deque[AckRequest] = deque(maxlen=MAX_ACK_REQUESTS)  # the oldest may go unanswered
        self._arrived = self._received = 0

    @property
    def counts(self) -> Counts:
        """Received, lost, dropped, invalid and discarded messages so far, and evicted keys."""
        with self._lock:
            each, invalid = self.counters, self.decoder.invalid
            return Counts(self._received, each.lost, each.dropped, invalid, each.discarded, each.forgotten)

    @property
    def waiting(self) -> int:
        """Number of unread messages."""
        return len(self._every) or len(self._newest)

    def put(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        """Queue a batch in order of arrival, reject invalid samples and wake the reader.

        `overflowed`: the ring was full; gaps in this batch count as dropped and are not requested again.
        """
        with self._lock:
            opened = self.counters.opened
            self._accept(self._admit(batch), overflowed=overflowed)
            has_gap = self.counters.opened > opened
        if has_gap and self.on_gap is not None:
            self.on_gap()
        if self._tokens.empty():  # like `wake`, inlined
            self._tokens.put(None)
        if self.on_wake is not None:
            self.on_wake()
        if overflowed and not self.newest_only:
            self._warn_once(_SLOW)
        if self._ack_requests:
            self.acknowledge(drained=True)

    def on_link_change(self) -> None:
        """Handle a link that broke or came back."""
        with self._lock:
            self._settling_until = self._clock() + _SETTLING
            for stream in self._streams.values():
                for writer in stream.writers.values():
                    writer.unresponsive = False  # perhaps the link was down

    def on_heartbeat(self, key: str, publisher: str, number: int) -> None:
        """Handle a heartbeat: the publisher, known or not, has sent `number`, which should have arrived by now."""
        with self._lock, suppress(AddressError):
            stream = self._stream(key)
            stream.last_active = self._clock()
            writer = stream.writers.get(publisher)
            if writer is None and len(self.counters.requesting) < MAX_KEYS:
                writer = self._add_writer(stream, publisher, 0 if self._settling else number, history_end=number + 1)
            if writer is not None:
                writer.on_heartbeat(number)

    def next_request(self, writer: WriterProxy, now: float) -> range | None:
        """Return the numbers to request from a publisher now; None if no request is due."""
        with self._lock:
            return writer.next_request(now)

    def on_retransmission(
        self, writer: WriterProxy, found: Mapping[int, RawSample], *, ended: bool, now: float
    ) -> bool:
        """Queue recovered messages and those held back behind them; return True if there are any."""
        with self._lock:
            arrivals = {number: arrival for number, raw in found.items() for arrival in self._admit([raw])}
            writer.on_retransmission(arrivals, ended=ended, now=now)
            return self._queue() > 0

    def give_up(self, max_held: int = -1) -> None:
        """Count gaps as lost, largest reorder buffers first, until `max_held` messages are held back; -1: all gaps."""
        with self._lock:
            for writer in sorted(self.counters.requesting, key=lambda writer: -len(writer.held)):
                if self.counters.held > max_held:
                    writer.give_up()
            self._queue()

    def acknowledge(self, *requests: AckRequest, drained: bool) -> None:
        """Add acknowledgement requests, and answer all that are ready.

        `drained`: the ring is empty, so an unknown publisher has sent nothing to this reader.
        """
        with self._lock:
            self._ack_requests += requests
            ready = [request for request in self._ack_requests if self._can_answer(request, drained=drained)]
            for request in ready:
                self._ack_requests.remove(request)
        for request in ready:
            request.reply()

    def end(self, failure: str = "") -> None:
        """End the queue: readers get the `end_error`, and all acknowledgement requests are answered.

        `failure`: the reason, unless the user closed the subscription.
        """
        if not self.ended:
            self._failure = failure
        self.ended = True
        self.acknowledge(drained=True)
        self.wake()

    @property
    def end_error(self) -> NedbusError:
        """The error of readers after the end."""
        return ReceiveError(self.name, self._failure) if self._failure else ClosedError()

    def wake(self) -> None:
        """Wake one waiting thread, or the next one to wait, and the event loop."""
        if self._tokens.empty():
            self._tokens.put(None)
        if self.on_wake is not None:
            self.on_wake()

    def wait(self, timeout: float | None) -> bool:
        """Wait until a sample may be ready or the queue has ended; return False after `timeout` seconds."""
        if not (self.waiting or self.ended):
            try:
                self._tokens.get(timeout=timeout)
            except queue.Empty:
                return False
        if self.ended or self.waiting > 1:
            self.wake()  # pass it on: `put` wakes a single thread per batch
        return True

    def pop(self, *, rows: bool = False) -> Sample[Any] | None:
        """Return the next sample, None if the queue is empty; invalid ones are counted and skipped."""
        while True:
            with self._lock:  # several threads may read
                if self._every:
                    arrival = self._every.popleft()
                elif self._newest:
                    arrival = self._newest.pop(next(iter(self._newest)))
                else:
                    return None
                stream, _, _, lost, _ = arrival
                if stream.unreported:
                    lost, stream.unreported = lost + stream.unreported, 0
            if self._ack_requests:
                self.acknowledge(drained=False)
            sample = self.decoder.decode(arrival, rows=rows, lost=lost)
            with self._lock:
                if sample is not None:
                    self._received += 1
                    return sample
                stream.unreported += lost

    def pop_batch(self) -> Batch | None:
        """Return unread messages of one type, up to 4096 in mode `every`; None if there are none."""
        from .batch import make_batch

        while True:
            with self._lock:
                taken = self._take_batch()
                lost = sum(lost for _, _, _, lost, _ in taken)
                for stream in {stream for stream, *_ in taken}:
                    lost, stream.unreported = lost + stream.unreported, 0
            if self._ack_requests:
                self.acknowledge(drained=False)
            if not taken:
                return None
            batch = make_batch(taken, self.decoder, lost=lost)
            with self._lock:
                if len(batch):
                    self._received += len(batch)
                    return batch
                taken[0][0].unreported += lost

    def _take_batch(self) -> list[Arrival]:
        """Remove the messages of the same type as the first one; the rest stay queued in order."""
        every, newest = self._every, self._newest
        waiting = list(newest.values()) or [every.popleft() for _ in range(min(len(every), _MAX_BATCH))]
        kinds = [stream.codec or identity_of(encoding_of(stream, raw)) for stream, _, raw, _, _ in waiting]
        taken = [arrival for arrival, kind in zip(waiting, kinds, strict=True) if kind == kinds[0]]
        rest = [arrival for arrival, kind in zip(waiting, kinds, strict=True) if kind != kinds[0]]
        if self.newest_only:
            self._newest = {arrival[0].key: arrival for arrival in rest}
        else:
            every.extendleft(reversed(rest))
        return taken

    @property
    def _settling(self) -> bool:
        """True shortly after a link change, when unknown publishers may have sent messages."""
        return self._clock() < self._settling_until

    def _can_answer(self, request: AckRequest, *, drained: bool) -> bool:
        if request.read_target is None:
            stream = self._streams.get(request.key)
            writer = stream and stream.writers.get(request.publisher)
            if writer.is_settled(request.number) if writer else drained and not self._settling:
                request.read_target = self._arrived if request.read else 0
        return self.ended or (request.read_target is not None and self._arrived - self.waiting >= request.read_target)

    # Streams

    def _stream(self, key: str) -> KeyState:
        """Return the state of a key, a new one if needed; raise AddressError if the key has no address."""
        stream = self._streams.get(key)
        if stream is None:
            stream = self.decoder.open(key)
            now = stream.last_active = self._clock()
            self._evict(now)
            self._streams[key] = stream
            heappush(self._by_activity, (now, key))
        return stream

    def _evict(self, now: float) -> None:
        """Evict silent keys above KEPT_KEYS, and the least recently active at MAX_KEYS; keys with requests are last."""
        order = self._by_activity
        while len(order) >= MAX_KEYS or (len(order) >= KEPT_KEYS and order[0][0] < now - MAX_SILENCE):
            since, key = order[0]
            stream = self._streams[key]
            if any(writer.request for writer in stream.writers.values()):
                stream.last_active = now
            if since < stream.last_active:
                heapreplace(order, (stream.last_active, key))
                continue
            heappop(order)
            del self._streams[key]
            for writer in stream.writers.values():
                writer.give_up()
            stream.writers.clear()
            stream.writer = None
            if since >= now - MAX_SILENCE:
                self.counters.forgotten += 1
                text = "the least recently active are evicted, and their next gap is not counted"
                self._warn_once(f"there are more than {MAX_KEYS:,} keys, so {text}")

    def _admit(self, batch: Sequence[RawSample]) -> list[Arrival]:
        """Return the arrivals of a batch, with 0 losses each; rejected ones keep their number but lose the payload.

        A payload of the expected size is decoded when it is read. Any other size is checked here: an invalid
        sample must neither displace a valid one nor use much memory.
        """
        admitted: list[Arrival] = []
        known, received = self._streams.get, clock.utc_ns()
        for raw in batch:
            key = str(raw.key_expr)
            stream = known(key)
            payload = raw.payload.to_bytes()
            if stream is None or len(payload) != stream.size:
                if raw.encoding == WAKE_UP:
                    continue
                try:
                    stream = stream or self._stream(key)
                    if len(payload) != stream.size:
                        self.decoder.inspect(stream, payload, raw)
                except (AddressError, DecodeError) as exc:
                    self.decoder.reject(key, exc, stream)
                    if stream is None:
                        continue
                    payload = b""
            admitted.append((stream, payload, raw, 0, received))
        return admitted

    def _accept(self, arrivals: list[Arrival], *, overflowed: bool) -> None:
        """Order arrivals, count gaps and queue what can be delivered; `overflowed`: the ring was full."""
        if len(arrivals) >= _MIN_IN_ORDER and self._accept_in_order(arrivals):
            self.counters.delivered += arrivals
            self._queue()
            return
        now, recovers = self._clock(), not (self.newest_only or overflowed)
        delivered = self.counters.delivered
        for admitted in arrivals:
            stream, payload, raw, _, _ = arrival = admitted
            stream.last_active = now
            info, writer = raw.source_info, stream.writer
            if info is not None:
                source = info.source_id
                if writer is None or source.eid != writer.eid or source.zid != writer.zid:  # cheaper than names
                    name = entity_name(source)
                    writer = stream.writers.get(name)
                    if writer is None:
                        first = 0 if recovers and self._settling else info.source_sn
                        writer = self._add_writer(stream, name, first, history_end=info.source_sn)
                    stream.writer = writer
                    if writer is not None:
                        arrival = arrival if writer.eid is not None else mark_retained(arrival)
                        writer.zid, writer.eid = source.zid, source.eid
            if info is None or writer is None:
                if payload:
                    delivered.append(arrival)
                continue
            number = info.source_sn
            if number == writer.expected and writer.request is None and payload and not stream.gap:
                writer.expected = (number + 1) % NUMBERS
                delivered.append(arrival)
            else:
                writer.on_sample(number, arrival, recovers=recovers, overflowed=overflowed)
        if self.counters.held > MAX_HELD:
            self.give_up(MAX_HELD)
        self._queue()

    def _accept_in_order(self, arrivals: list[Arrival]) -> bool:
        """Advance `expected` and return True if a batch continues the sequence of a key's writer without a gap."""
        stream, info = arrivals[0][0], arrivals[-1][2].source_info
        writer = stream.writer
        if writer is None or info is None or writer.request is not None or stream.gap:
            return False
        stop = writer.expected + len(arrivals)
        if info.source_sn != stop - 1 or stop >= NUMBERS or entity_name(info.source_id) != writer.name:
            return False
        if len({id(arrival[0]) for arrival in arrivals}) > 1 or not all(map(_PAYLOAD, arrivals)):
            return False
        infos = [raw.source_info for _, _, raw, _, _ in arrivals]
        if [info and info.source_sn for info in infos] != list(range(writer.expected, stop)):
            return False
        writer.expected, stream.last_active = stop, self._clock()
        return True

    def _add_writer(self, stream: KeyState, name: str, expected: int, *, history_end: int) -> WriterProxy | None:
        """Add a writer proxy, evicting one without a gap if necessary; None if all writers of the key have gaps."""
        if len(stream.writers) >= _MAX_WRITERS_OF_KEY:
            writers = stream.writers.values()
            first = next((each for each in writers if each is not stream.writer and each.request is None), None)
            if first is None:
                return None
            del stream.writers[first.name]
        writer = stream.writers[name] = WriterProxy(stream, name, expected, self.counters, history_end=history_end)
        return writer

    # Unread messages

    def _queue(self) -> int:
        """Queue delivered messages and return their count; drop superseded ones and, above the capacity, the oldest."""
        arrivals, self.counters.delivered = self.counters.delivered, []
        self._arrived += len(arrivals)
        if self.newest_only:
            for arrival in arrivals:
                stream, payload, raw, lost, received = arrival
                if (waiting := self._newest.get(stream.key)) is not None:
                    self.counters.dropped += 1
                    self._newest[stream.key] = stream, payload, raw, lost + waiting[3], received
                    continue
                if len(self._newest) >= MAX_KEYS:
                    self._drop(self._newest.pop(next(iter(self._newest))))
                self._newest[stream.key] = arrival
            return len(arrivals)
        every = self._every
        every.extend(map(detach, arrivals) if len(every) > _MAX_FRESH else arrivals)
        while len(every) > CAPACITY:
            self._drop(every.popleft())
            self._warn_once(_SLOW)
        return len(arrivals)

    def _drop(self, arrival: Arrival) -> None:
        stream, _, _, lost, _ = arrival
        stream.unreported += lost
        self.counters.dropped += 1

    def _warn_once(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            _log.warning("%s: %s", self.name, text, extra=about("dropped" if text == _SLOW else "incomplete"))
