"""Inbox: the received messages of a subscription, ordered, counted, and decoded when they are read; no I/O.

Three classes share the work: `Streams` owns the keys, `Reorder` the order and losses of each publisher, `Unread` what
the reader has not read. If the reader is slow, mode `latest` replaces unread messages, and mode `every` drops the
oldest beyond its limit. Either way drops are counted, and neither the session nor other readers are delayed.
"""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final, get_args

from nedbus import clock, limits
from nedbus.errors import ArgumentError, ClosedError, NedbusError, ReceiveError
from nedbus.log_event import about
from nedbus.samples import Counts, Mode, Sample
from nedbus.transport import RawSample
from nedbus_msgs import Address, AddressError, DecodeError

from . import streams
from .arrival import NO_LAYOUTS, Arrival, Stream, detach
from .decoder import WAKE_UP, Decoder
from .reorder import Reorder
from .unread import Unread
from .writer_proxy import LossCounters, WriterProxy

if TYPE_CHECKING:
    from nedbus.samples import Batch

    from .throttle import Throttle

_log = logging.getLogger(__name__)

_SLOW: Final = "the reader is slower than the data, so messages are dropped"


@dataclass(slots=True, eq=False)
class AckRequest:
    """Request to acknowledge that message `number` has arrived or, with `read`, that the application has read it."""

    key: str
    publisher: str
    number: int
    read: bool
    reply: Callable[[], object]  # sends the acknowledgement; called once
    # samples to be read before answering; None until the message has arrived
    read_target: int | None = None


class Inbox:
    """The messages of a subscription, from Zenoh's ring to the reader; thread-safe.

    `key_exprs`: what to subscribe to. `limit`: unread messages, None for the default.
    `throttle`: the maximum rate of each stream, if there is one.
    `on_gap` is called, on any thread, when a new gap may be filled by retransmission.
    """

    def __init__(
        self,
        mode: Mode,
        decoder: Decoder,
        *,
        key_exprs: Sequence[str] = (),
        limit: int | None = None,
        throttle: Throttle | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if mode not in get_args(Mode):
            raise ArgumentError("mode", mode, f"one of {', '.join(get_args(Mode))}")
        check_count("limit", limit)
        self.newest_only = mode == "latest"
        self.ended = False
        self._discards = False  # closed: nothing can be read any more
        self._failure = ""  # reason of an end that the user did not cause
        self.on_gap: Callable[[], object] | None = None
        # wakes a reader on an event loop; called on any thread
        self.on_wake: Callable[[], object] | None = None
        self.key_exprs = key_exprs
        self.name = ", ".join(key_exprs)
        self.decoder = decoder
        self.throttle = throttle
        self._warned: set[str] = set()
        self._clock = clock
        self._lock = threading.RLock()  # reentrant, because log handlers may read the counts
        self._tokens: queue.SimpleQueue[None] = queue.SimpleQueue()  # cheaper than a Condition
        self._counters = LossCounters()
        self.streams = streams.Streams(decoder.open, self._on_evict)
        recovers = not self.newest_only
        self._reorder = Reorder(
            self.streams, self._admit, self._counters, recovers=recovers, clock=clock
        )
        self.gaps = self._reorder.gaps
        limit = limit or (limits.KEYS if self.newest_only else limits.UNREAD_MESSAGES)
        more_keys = f"more keys than the limit of {limit:,} have an unread message, so the oldest messages are dropped"
        self._max_before_recovery = limit // 2
        if self.newest_only:
            self._limited = more_keys
        else:
            self._limited = _SLOW
        self._unread = Unread(self._counters, newest_only=self.newest_only, limit=limit)
        # the oldest may go unanswered
        self._ack_requests: deque[AckRequest] = deque(maxlen=limits.ACK_REQUESTS)

    @property
    def counts(self) -> Counts:
        """Received, lost, dropped, invalid and discarded messages so far, and evicted keys."""
        with self._lock:
            of = self._counters
            invalid = self.decoder.invalid
            return Counts(of.received, of.lost, of.dropped, invalid, of.discarded, of.forgotten)

    @property
    def waiting(self) -> int:
        """Number of unread messages."""
        return len(self._unread)

    @property
    def may_recover(self) -> bool:
        """True while at most half of the limit is unread; above it, recovered messages would displace unread ones."""
        return self.waiting <= self._max_before_recovery

    def put(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        """Queue a batch in order of arrival, reject invalid samples and wake the reader.

        `overflowed`: the ring was full; gaps in this batch count as dropped and are not requested again.
        """
        with self._lock:
            opened = self.gaps.opened
            self._queue(self._reorder.accept(batch, overflowed=overflowed))
            has_gap = self.gaps.opened > opened
        if has_gap and self.on_gap is not None:
            self.on_gap()
        if self._tokens.empty():  # like `wake`, inlined
            self._tokens.put(None)
        if self.on_wake is not None:
            self.on_wake()
        if overflowed and not self.newest_only:
            self._warn_once(_SLOW)
        if self._ack_requests:
            self.acknowledge(drained=len(self.key_exprs) <= 1)  # else other rings may have more

    def take(self, sample: RawSample) -> Arrival | None:
        """Accept a sample on the reading thread; return its message if it is the next to be read, for `pop`.

        That is the common case of a paced reader, which so needs no queue. Otherwise queue what is in order, as `put`.
        """
        with self._lock:
            opened = self.gaps.opened
            arrivals = self._reorder.accept([sample])
            is_next = len(arrivals) == 1 and not self._unread and not self._discards
            if is_next and self.throttle is None:
                self._unread.arrived += 1
                taken = self._start_reading(arrivals[0])
            else:
                self._queue(arrivals)
                taken = None
            has_gap = self.gaps.opened > opened
        if taken is None:
            self.wake()  # other readers
        if has_gap and self.on_gap is not None:
            self.on_gap()
        if self._ack_requests:
            self.acknowledge(drained=True)
        return taken

    def put_last(self, batch: Sequence[RawSample]) -> None:
        """Queue the last messages of streams that have delivered none yet; only with a throttle."""
        if self.throttle is None:
            raise ValueError("without a throttle")
        received = clock.utc_ns()
        last: list[Arrival] = []
        with self._lock:
            for raw in batch:
                arrival = self._admit(raw, received)
                if arrival is None or not arrival.payload:
                    continue
                key = self.throttle.key_of(arrival.stream.address)
                stream = self.streams.open(key, self._clock())
                if stream.throttled is None:
                    stream.throttled = self.throttle.new_state()
                if self.throttle.takes_last(stream.throttled, arrival):
                    last.append(detach(arrival, retained=True))
            self._add(last)
        self.wake()

    def has_downsampled(self, address: Address) -> bool:
        """Return True if a downsampled message of a stream has arrived; only with a throttle."""
        if self.throttle is None:
            return False
        with self._lock:
            stream = self.streams.get(self.throttle.key_of(address))
            if stream is None or stream.throttled is None:
                return False
            return stream.throttled.has_arrived

    def on_link_change(self) -> None:
        """Handle a link that broke or came back."""
        with self._lock:
            self._reorder.on_link_change()

    def on_heartbeat(self, key: str, publisher: str, number: int) -> None:
        """Handle a heartbeat: the publisher, known or not, has sent `number`, which should have arrived by now."""
        with self._lock, suppress(AddressError):
            self._reorder.on_heartbeat(self.streams.open(key, self._clock()), publisher, number)

    def next_request(self, writer: WriterProxy, now: float) -> range | None:
        """Return the numbers to request from a publisher now; None if no request is due."""
        with self._lock:
            return writer.next_request(now)

    def on_retransmission(
        self, writer: WriterProxy, answers: Mapping[int, RawSample], *, ended: bool, now: float
    ) -> bool:
        """Queue recovered messages and those held back behind them; return True if there are any."""
        with self._lock:
            received = clock.utc_ns()
            admitted = {number: self._admit(raw, received) for number, raw in answers.items()}
            arrivals = {
                number: arrival for number, arrival in admitted.items() if arrival is not None
            }
            released = writer.on_retransmission(arrivals, ended=ended, now=now)
            self._queue(released)
            return bool(released)

    def give_up(self) -> None:
        """Count all gaps as lost."""
        with self._lock:
            self._queue(self._reorder.give_up())

    def acknowledge(self, *requests: AckRequest, drained: bool) -> None:
        """Add acknowledgement requests, and answer all that are ready.

        `drained`: the ring is empty, so an unknown publisher has sent nothing to this reader.
        """
        with self._lock:
            self._ack_requests += requests
            ready = [
                request
                for request in self._ack_requests
                if self._can_answer(request, drained=drained)
            ]
            for request in ready:
                self._ack_requests.remove(request)
        for request in ready:
            request.reply()

    def end(self, failure: str = "", *, discard: bool = False) -> None:
        """End reception, and answer all acknowledgement requests: readers get what is unread, then the `end_error`.

        `failure`: the reason, unless the user ended it. `discard`: drop what is unread and what may still be put.
        """
        with self._lock:
            if not self.ended:
                self._failure = failure
            self.ended = True
            self._discards |= discard
            if self._discards:
                self._unread.discard()
        self.acknowledge(drained=True)
        self.wake()

    @property
    def end_error(self) -> NedbusError:
        """The error of readers after the end."""
        if self._failure:
            return ReceiveError(self.name, self._failure)
        return ClosedError()

    def wake(self) -> None:
        """Wake one waiting thread, or the next one to wait, and the event loop."""
        if self._tokens.empty():
            self._tokens.put(None)
        if self.on_wake is not None:
            self.on_wake()

    def wait(self, timeout: float | None) -> bool:
        """Wait until a message may be ready or reception has ended; return False after `timeout` seconds."""
        if not (self.waiting or self.ended):
            try:
                self._tokens.get(timeout=timeout)
            except queue.Empty:
                return False
        if self.ended or self.waiting > 1:
            self.wake()  # pass it on: `put` wakes a single thread per batch
        return True

    def pop(self, rows: bool = False, arrival: Arrival | None = None) -> Sample[Any] | None:
        """Return the next sample, None if there is none; invalid ones are counted and skipped.

        `arrival`: the message that `take` returned, which is read before the queue.
        """
        while True:
            if arrival is None:
                with self._lock:  # several threads may read
                    arrival = self._unread.pop()
                    if arrival is None:
                        return None
                    arrival = self._start_reading(arrival)
                if self._ack_requests:
                    self.acknowledge(drained=False)
            if arrival.codec is None:
                [arrival] = self.decoder.define([arrival])
                with self._lock:
                    self._counters.received += 1
            sample = self.decoder.decode(arrival, rows)
            if sample is not None:
                return sample
            with self._lock:
                self._counters.received -= 1
                arrival.stream.unreported += arrival.lost
            arrival = None

    def pop_batch(
        self, max_messages: int | None = None, arrival: Arrival | None = None
    ) -> Batch | None:
        """Return unread messages of one type, up to `max_messages`; None if there are none. `arrival`: as in `pop`."""
        while True:
            counted = 0
            if arrival is not None:
                taken = [arrival]
                losses = {arrival.stream: arrival.lost}
                counted = 0 if arrival.codec is None else 1  # by `_start_reading`
            else:
                with self._lock:
                    taken = self._unread.pop_batch(max_messages) if self._unread else []
                    losses = _take_losses(taken)
                if self._ack_requests:
                    self.acknowledge(drained=False)
                if not taken:
                    return None
            batch = _batch_maker()(taken, self.decoder, lost=sum(losses.values()))
            with self._lock:
                self._counters.received += len(batch) - counted
                if len(batch):
                    return batch
                # the next valid message of each stream reports them
                for stream, lost in losses.items():
                    stream.unreported += lost
            arrival = None

    def _start_reading(self, arrival: Arrival) -> Arrival:
        """Return a message with the losses that its stream has not reported, and count it as received.

        One whose definition is being looked up counts after the wait for it.
        """
        if arrival.codec is not None:
            self._counters.received += 1
        stream = arrival.stream
        if stream.unreported:
            arrival = arrival._replace(lost=arrival.lost + stream.unreported)
            stream.unreported = 0
        return arrival

    def _can_answer(self, request: AckRequest, *, drained: bool) -> bool:
        arrived = self._unread.arrived
        stream = self.streams.get(request.key)
        if request.read_target is None and self._reorder.is_settled(
            stream, request.publisher, request.number, drained=drained
        ):
            if request.read:
                request.read_target = arrived
            else:
                request.read_target = 0
        return self.ended or (
            request.read_target is not None and arrived - self.waiting >= request.read_target
        )

    def _admit(self, raw: RawSample, received: int) -> Arrival | None:
        """Return the arrival of a sample, without its payload if it is rejected; None if its key has no address.

        A payload of the expected size is decoded when it is read. Any other size is checked here: an invalid
        sample must neither displace a valid one nor use much memory.
        """
        key = str(raw.key_expr)
        payload = raw.payload.to_bytes()
        if not payload and raw.encoding == WAKE_UP:
            return None
        stream = None
        try:
            stream = self.streams.open(key, self._clock())
            codec = stream.codec
            newer = NO_LAYOUTS
            if len(payload) != stream.size:
                codec, newer = self.decoder.inspect(stream, payload, raw)
        except (AddressError, DecodeError) as exc:
            self.decoder.reject(key, exc, stream)
            if stream is None:
                return None
            return Arrival(stream, b"", raw, None, 0, received)
        return Arrival(stream, payload, raw, codec, 0, received, newer)

    def _queue(self, arrivals: list[Arrival]) -> None:
        """Make messages readable that pass the throttle."""
        if self.throttle is not None:
            arrivals = self.throttle.passing(arrivals)
        self._add(arrivals)

    def _add(self, arrivals: list[Arrival]) -> None:
        if self._unread.add(arrivals):
            self._warn_once(self._limited)
        if self._discards:
            self._unread.discard()

    def _on_evict(self, stream: Stream, at_limit: bool) -> None:
        self._queue(self._reorder.forget(stream))
        if at_limit:
            self._counters.forgotten += 1
            text = "the least recently active are evicted, and their next gap is not counted"
            self._warn_once(f"there are more than {limits.KEYS:,} keys, so {text}")

    def _warn_once(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            event = "incomplete"
            if "dropped" in text:
                event = "dropped"
            _log.warning("%s: %s", self.name, text, extra=about(event))


def _take_losses(arrivals: Iterable[Arrival]) -> dict[Stream, int]:
    """Return the unreported losses of the streams of these arrivals that have any, and mark them as reported."""
    losses: dict[Stream, int] = {}
    for arrival in arrivals:
        stream = arrival.stream
        lost = arrival.lost + stream.unreported
        if lost:
            losses[stream] = losses.get(stream, 0) + lost
            stream.unreported = 0
    return losses


def check_count(name: str, count: object) -> None:
    """Raise ArgumentError unless `count` is None or an integer above 0."""
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise ArgumentError(name, count, "a number of messages above 0, or None for the default")


def check_timeout(timeout: object) -> None:
    """Raise ArgumentError unless `timeout` is None or a number of seconds."""
    if timeout is None:
        return
    if not isinstance(timeout, int | float) or isinstance(timeout, bool) or math.isnan(timeout):
        raise ArgumentError(
            "timeout", timeout, "a number of seconds, or None to wait without limit"
        )


@cache
def _batch_maker() -> Callable[..., Batch]:
    from .batch import make_batch  # on first use, because NumPy loads slowly

    return make_batch
