"""Reorder: puts the messages of each publisher in order, finds gaps and counts losses; no I/O."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import zenoh

from nedbus import clock, limits
from nedbus.transport import RawSample, entity_name

from .arrival import NO_LAYOUTS, Arrival, DetachedSample, Stream, detach
from .streams import Streams
from .writer_proxy import NUMBERS, Gaps, LossCounters, WriterProxy

# messages in order on one key, of which only the last sender is compared
_LONG_RUN: Final = 8
# s after a link change; a new publisher may have sent messages during the outage
_SETTLING: Final = 10.0


class Reorder:
    """The writer proxies of a subscription. Not thread-safe.

    With `recovers`, a gap holds back later messages until it is filled; otherwise it counts as lost at once.
    `admit`: returns the arrival of a sample of a new stream or of another size; None if it is no message.
    """

    def __init__(
        self,
        streams: Streams,
        admit: Callable[[RawSample, int], Arrival | None],
        counters: LossCounters,
        *,
        recovers: bool,
        clock: Callable[[], float],
    ) -> None:
        self.gaps = Gaps()
        self._streams = streams
        self._admit = admit
        self._counters = counters
        self._recovers = recovers
        self._clock = clock
        self._settling_until = float("-inf")

    def accept(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> list[Arrival]:
        """Accept samples in order of arrival, and return the messages that are in order now.

        `overflowed`: the ring was full, and gaps count as dropped.
        In a large batch, messages of one key with consecutive numbers are a run, whose senders are compared at its end.
        """
        known = self._streams.get
        new_arrival = tuple.__new__
        received = clock.utc_ns()
        now = self._clock()
        has_runs = len(batch) >= _LONG_RUN
        delivered: list[Arrival] = []
        writer: WriterProxy | None = None  # of the last message, if that was the expected one
        expected = 0  # the next number of this writer
        run: list[Arrival] = []  # messages after the last one, with the next numbers
        for raw in batch:
            stream = known(str(raw.key_expr))
            payload = raw.payload.to_bytes()
            arrival: Arrival | None
            if stream is None or len(payload) != stream.size:
                arrival = self._admit(raw, received)
            else:
                # Without a call of the class, which takes 0.07 us more.
                fields = stream, payload, raw, stream.codec, 0, received, NO_LAYOUTS
                arrival = new_arrival(Arrival, fields)
                if writer is not None and stream.writer is writer:
                    info = raw.source_info
                    if info is not None and info.source_sn == expected:
                        run.append(arrival)
                        expected = (expected + 1) % NUMBERS
                        continue
            if writer is not None:
                if run:
                    delivered += self._end_run(writer, run, now, overflowed)
                    run = []
                writer = None
            if arrival is None:
                continue
            expecting = _expecting_writer(arrival)
            if expecting is None:
                delivered += self._accept_one(arrival, now, overflowed)
                continue
            arrival.stream.last_active = now
            expected = (expecting.expected + 1) % NUMBERS
            expecting.expected = expected
            delivered.append(arrival)
            if has_runs:
                writer = expecting
        if run and writer is not None:
            delivered += self._end_run(writer, run, now, overflowed)
        if self.gaps.held > limits.HELD_MESSAGES:
            delivered += self.give_up(limits.HELD_MESSAGES)
        return delivered

    def on_heartbeat(self, stream: Stream, publisher: str, number: int) -> None:
        """Handle a heartbeat: the publisher, known or not, has sent `number`, which should have arrived by now."""
        stream.last_active = self._clock()
        writer = stream.writers.get(publisher)
        if writer is None and len(self.gaps.requesting) < limits.REQUESTING_PUBLISHERS:
            writer = self._add_writer(
                stream, publisher, 0 if self._settling else number, history_end=number + 1
            )
        if writer is not None:
            writer.on_heartbeat(number)

    def on_link_change(self) -> None:
        """Handle a link that broke or came back."""
        self._settling_until = self._clock() + _SETTLING
        for stream in self._streams:
            for writer in stream.writers.values():
                writer.unresponsive = False  # perhaps the link was down

    def give_up(self, max_held: int = -1) -> list[Arrival]:
        """Count gaps as lost, largest reorder buffers first, until `max_held` messages are held back; -1: all gaps.

        Return the messages held back behind them.
        """
        released: list[Arrival] = []
        for writer in sorted(self.gaps.requesting, key=lambda writer: -len(writer.held)):
            if self.gaps.held > max_held:
                released += writer.give_up()
        return released

    def forget(self, stream: Stream) -> list[Arrival]:
        """Count the gaps of an evicted stream as lost, and return the messages held back behind them."""
        released: list[Arrival] = []
        for writer in stream.writers.values():
            released += writer.give_up()
        stream.writers.clear()
        stream.writer = None
        return released

    def is_settled(
        self, stream: Stream | None, publisher: str, number: int, *, drained: bool
    ) -> bool:
        """Return True if a message of a publisher has arrived or counts as lost, or none was sent to this reader."""
        writer = stream and stream.writers.get(publisher)
        if writer:
            return writer.is_settled(number)
        return drained and not self._settling

    @property
    def _settling(self) -> bool:
        """True shortly after a link change, when unknown publishers may have sent messages."""
        return self._clock() < self._settling_until

    def _end_run(
        self, writer: WriterProxy, run: list[Arrival], now: float, overflowed: bool
    ) -> list[Arrival]:
        """Return the messages of a run; if the sender of one differs, accept them one by one.

        The sender of the message before them is known; of a long run, only the last one is compared as well.
        """
        if len(run) >= _LONG_RUN:
            compared = run[-1:]
        else:
            compared = run
        if all(writer.is_sender(arrival.raw.source_info) for arrival in compared):
            writer.expected = (writer.expected + len(run)) % NUMBERS
            return run
        delivered: list[Arrival] = []
        for arrival in run:
            delivered += self._accept_one(arrival, now, overflowed)
        return delivered

    def _accept_one(self, arrival: Arrival, now: float, overflowed: bool) -> list[Arrival]:
        """Accept any message, and return what is in order now."""
        stream = arrival.stream
        raw = arrival.raw
        stream.last_active = now
        writer = stream.writer
        recovers = self._recovers and not overflowed
        info = raw.source_info
        if info is not None and (writer is None or not writer.is_sender(info)):
            name = entity_name(info.source_id)
            writer = stream.writers.get(name)
            if writer is None:
                if recovers and self._settling:
                    first = 0
                else:
                    first = info.source_sn
                writer = self._add_writer(stream, name, first, history_end=info.source_sn)
            stream.writer = writer
            if writer is not None:
                if writer.eid is None and _is_reply(raw):
                    arrival = detach(arrival, retained=True)
                writer.zid = info.source_id.zid
                writer.eid = info.source_id.eid
        if info is None or writer is None:
            if arrival.payload:
                return [arrival]
            return []
        return writer.on_sample(info.source_sn, arrival, recovers=recovers, overflowed=overflowed)

    def _add_writer(
        self, stream: Stream, name: str, expected: int, *, history_end: int
    ) -> WriterProxy | None:
        """Add a writer proxy, evicting one without a gap if necessary; None if all writers of the key have gaps."""
        if len(stream.writers) >= limits.PUBLISHERS_OF_KEY:
            idle = [
                writer
                for writer in stream.writers.values()
                if writer is not stream.writer and writer.request is None
            ]
            if not idle:
                return None
            del stream.writers[idle[0].name]
        writer = WriterProxy(
            stream, name, expected, self._counters, self.gaps, history_end=history_end
        )
        stream.writers[name] = writer
        return writer


def _expecting_writer(arrival: Arrival) -> WriterProxy | None:
    """Return the last publisher of a key if it is expected to send this message next, with no gap open."""
    stream = arrival.stream
    writer = stream.writer
    info = arrival.raw.source_info
    if writer is None or info is None or info.source_sn != writer.expected:
        return None
    if writer.request is not None or stream.gap or not arrival.payload:
        return None
    if writer.is_sender(info):
        return writer
    return None


def _is_reply(raw: RawSample | DetachedSample) -> bool:
    """Return True for a reply to Zenoh's history query: only replies use BLOCK, nedbus publishers use DROP."""
    if isinstance(raw, DetachedSample):
        return False
    return bool(raw.congestion_control == zenoh.CongestionControl.BLOCK)
