"""Pending queue between receiving and reading: every sample in order, or the newest per key; no I/O.

If the reader is slow, mode `latest` replaces unread samples, and mode `every` queues 65,536 and then drops the oldest.
Either way drops are counted, and no publisher or other reader is delayed.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, get_args

from nedbus.client.sample import Counts, Mode, Sample
from nedbus.errors import ClosedError, NedbusError, ReceiveError
from nedbus.log_event import about
from nedbus.transport import RawSample
from nedbus_msgs import AddressError, identity_of

from .decoder import MAX_KEYS, Arrival, Decoder, encoding_of
from .stateful_reader import StatefulReader
from .writer_proxy import WriterProxy

if TYPE_CHECKING:
    from .batch import Batch

_log = logging.getLogger(__name__)

CAPACITY: Final = 65_536
"""Samples queued in mode `every`, about 45 MB; beyond, the oldest are dropped."""

MAX_ACK_REQUESTS: Final = 1000
"""Pending acknowledgement requests; a well-behaved publisher has one per key."""

_MAX_BATCH: Final = 4096  # messages per batch
_MAX_FRESH: Final = 1024  # samples queued along with Zenoh's receive buffer; later ones are detached from it


@dataclass(slots=True, eq=False)
class AckRequest:
    """Request to acknowledge that message `number` has arrived or, with `read`, that the application has read it.

    `reply` answers it and is called once.
    `read_target`: number of samples to be read before answering; None until the message has arrived.
    """

    key: str
    publisher: str
    number: int
    read: bool
    reply: Callable[[], object]
    read_target: int | None = None


class PendingQueue:
    """Queue delivered messages, decode them on read, and count losses and drops.

    `name` appears in the log. `on_gap` is called, on any thread, when a new gap may be filled by retransmission.
    """

    def __init__(
        self, mode: Mode, decoder: Decoder, *, name: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        if mode not in get_args(Mode):
            raise AddressError("mode", mode, f"one of {', '.join(get_args(Mode))}")
        self.newest_only = mode == "latest"
        self.ended = False
        self._failure = ""  # reason of an end that the user did not cause
        self.on_gap: Callable[[], object] | None = None
        self.on_wake: Callable[[], object] | None = None
        """Called on any thread when a sample may be ready, to wake a reader on an event loop."""
        self.name = name
        self._warned = False
        self._decoder = decoder
        self._lock = threading.Lock()
        self._tokens: queue.SimpleQueue[None] = queue.SimpleQueue()  # cheaper than a Condition
        self._every: deque[Arrival] = deque()
        self._newest: dict[str, Arrival] = {}
        self._reader = StatefulReader(decoder, recovers=not self.newest_only, clock=clock)
        self.account = self._reader.account
        self._ack_requests: deque[AckRequest] = deque(maxlen=MAX_ACK_REQUESTS)  # beyond, the oldest go unanswered
        self._arrived = self._dropped = self._received = 0

    @property
    def counts(self) -> Counts:
        """Received, lost, dropped, invalid and discarded messages so far."""
        with self._lock:
            account, dropped = self.account, self._dropped + self.account.dropped
            return Counts(self._received, account.lost, dropped, self._decoder.invalid, account.discarded)

    @property
    def waiting(self) -> int:
        """Number of unread messages."""
        return len(self._every) or len(self._newest)

    def count_invalid(self, count: int) -> None:
        """Count samples that could not be queued as invalid."""
        self._decoder.count_invalid(count)

    def put(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        """Queue a batch in order of arrival, reject invalid samples and wake the reader.

        `overflowed`: the ring was full; gaps in this batch count as dropped and are not requested again.
        """
        arrivals = self._decoder.admit(batch)
        with self._lock:
            requesting = len(self.account.requesting)
            self._queue(self._reader.on_samples(arrivals, overflowed=overflowed))
            has_gap = len(self.account.requesting) > requesting
        if has_gap and self.on_gap is not None:
            self.on_gap()
        if self._tokens.empty():  # as `wake` does
            self._tokens.put(None)
        if self.on_wake is not None:
            self.on_wake()
        if overflowed:
            self._warn_once()
        if self._ack_requests:
            self.acknowledge(drained=True)

    def on_link(self) -> None:
        """Handle a link that broke or came back."""
        with self._lock:
            self._reader.on_link()

    def on_heartbeat(self, key: str, publisher: str, number: int) -> None:
        """Handle a heartbeat: the publisher has sent `number`, which should have arrived by now."""
        with self._lock:
            self._reader.on_heartbeat(key, publisher, number)

    def next_request(self, writer: WriterProxy, now: float) -> range | None:
        """Return the numbers to request from a publisher now; None if no request is due."""
        with self._lock:
            return writer.next_request(now)

    def on_retransmission(
        self, writer: WriterProxy, found: Mapping[int, RawSample], *, ended: bool, now: float
    ) -> bool:
        """Queue recovered messages and those held back behind them; return True if there are any."""
        arrivals = {number: arrival for number, raw in found.items() for arrival in self._decoder.admit([raw])}
        with self._lock:
            delivered = writer.on_retransmission(arrivals, ended=ended, now=now)
            self._queue(delivered)
        return bool(delivered)

    def give_up(self) -> None:
        """Count all gaps as lost and queue the messages held back."""
        with self._lock:
            self._queue(self._reader.give_up(-1))

    def add(self, request: AckRequest, *, drained: bool) -> None:
        """Add an acknowledgement request, to be answered as soon as possible."""
        with self._lock:
            self._ack_requests.append(request)
        self.acknowledge(drained=drained)

    def acknowledge(self, *, drained: bool) -> None:
        """Answer the acknowledgement requests that are ready.

        `drained`: the ring is empty, so an unknown publisher has sent nothing to this reader.
        """
        with self._lock:
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
                stream, _, _, lost = arrival
                if stream.unreported:
                    lost, stream.unreported = lost + stream.unreported, 0
            if self._ack_requests:
                self.acknowledge(drained=False)
            sample = self._decoder.decode(arrival, rows=rows, lost=lost)
            if sample is not None:
                self._received += 1
                return sample
            stream.unreported += lost

    def pop_batch(self) -> Batch | None:
        """Return the queued messages of one type, up to 4096, None if there are none; invalid ones are counted."""
        from .batch import make_batch

        while True:
            with self._lock:
                taken = self._take_batch()
                lost = sum(lost for _, _, _, lost in taken)
                for stream in {stream for stream, _, _, _ in taken}:
                    lost, stream.unreported = lost + stream.unreported, 0
            if self._ack_requests:
                self.acknowledge(drained=False)
            if not taken:
                return None
            batch = make_batch(taken, self._decoder, lost=lost)
            if len(batch):
                self._received += len(batch)
                return batch
            taken[0][0].unreported += lost

    def _take_batch(self) -> list[Arrival]:
        """Remove the messages of the same type as the first one; the rest stay queued in order."""
        every, newest = self._every, self._newest
        waiting = list(newest.values()) or [every.popleft() for _ in range(min(len(every), _MAX_BATCH))]
        kinds = [stream.message or identity_of(encoding_of(stream, raw)) for stream, _, raw, _ in waiting]
        taken = [arrival for arrival, kind in zip(waiting, kinds, strict=True) if kind == kinds[0]]
        rest = [arrival for arrival, kind in zip(waiting, kinds, strict=True) if kind != kinds[0]]
        if self.newest_only:
            self._newest = {arrival[0].key: arrival for arrival in rest}
        else:
            every.extendleft(reversed(rest))
        return taken

    def _can_answer(self, request: AckRequest, *, drained: bool) -> bool:
        if request.read_target is None:
            has = self._reader.has(request.key, request.publisher, request.number)
            if has or (has is None and drained and not self._reader.settling):
                request.read_target = self._arrived if request.read else 0
        return self.ended or (request.read_target is not None and self._arrived - self.waiting >= request.read_target)

    def _queue(self, arrivals: Sequence[Arrival]) -> None:
        """Queue arrivals, dropping superseded ones and the oldest beyond the capacity."""
        self._arrived += len(arrivals)
        if self.newest_only:
            for arrival in arrivals:
                self._supersede(arrival)
            return
        every = self._every
        every.extend(map(self._decoder.detach, arrivals) if len(every) > _MAX_FRESH else arrivals)
        while len(every) > CAPACITY:
            stream, _, _, lost = every.popleft()
            stream.unreported += lost
            self._dropped += 1
            self._warn_once()

    def _supersede(self, arrival: Arrival) -> None:
        stream, payload, raw, lost = arrival
        waiting = self._newest.get(stream.key)
        if waiting is not None:
            self._dropped += 1
            arrival = stream, payload, raw, lost + waiting[3]
        elif len(self._newest) >= MAX_KEYS:
            self._dropped += 1
            return
        self._newest[stream.key] = arrival

    def _warn_once(self) -> None:
        if not self._warned and not self.newest_only:
            self._warned = True
            extra = about("dropped")
            _log.warning("%s: the reader is slower than the data: messages are dropped", self.name, extra=extra)
