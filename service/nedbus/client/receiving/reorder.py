"""Reorder: puts the messages of each publisher in order, finds gaps and counts losses; no I/O."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from operator import attrgetter
from typing import Final

from nedbus.transport import entity_name

from .arrival import Arrival, Stream, mark_retained
from .writer_proxy import NUMBERS, Gaps, LossCounters, WriterProxy

MAX_HELD: Final = 131_072
"""Maximum number of messages held back behind gaps, about 90 MB; beyond it, gaps count as lost."""

MAX_REQUESTING: Final = 10_000
"""Publishers with open gaps; beyond that, the heartbeat of an unknown publisher opens none."""

_MAX_WRITERS_OF_KEY: Final = 8  # beyond that the oldest writer without a gap is evicted
_MIN_IN_ORDER: Final = 8  # smaller batches are checked message by message
_SETTLING: Final = 10.0  # s after a link change; a new publisher may have sent messages during the outage
_PAYLOAD: Final = attrgetter("payload")


class Reorder:
    """The writer proxies of a subscription. Not thread-safe.

    Messages in order are appended to `gaps.delivered`.
    With `recovers`, a gap holds back later messages until it is filled; otherwise it counts as lost at once.
    """

    def __init__(self, counters: LossCounters, *, recovers: bool, clock: Callable[[], float]) -> None:
        self.gaps = Gaps()
        self._counters, self._recovers, self._clock = counters, recovers, clock
        self._settling_until = float("-inf")

    def accept(self, arrivals: list[Arrival], *, overflowed: bool) -> None:
        """Accept messages in order of arrival; `overflowed`: the ring was full, and gaps count as dropped."""
        if len(arrivals) >= _MIN_IN_ORDER and self._accept_in_order(arrivals):
            self.gaps.delivered += arrivals
            return
        now, recovers = self._clock(), self._recovers and not overflowed
        for received in arrivals:
            arrival = received
            stream, payload, raw = arrival.stream, arrival.payload, arrival.raw
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
                    self.gaps.delivered.append(arrival)
                continue
            number = info.source_sn
            if number == writer.expected and writer.request is None and payload and not stream.gap:
                writer.expected = (number + 1) % NUMBERS
                self.gaps.delivered.append(arrival)
            else:
                writer.on_sample(number, arrival, recovers=recovers, overflowed=overflowed)
        if self.gaps.held > MAX_HELD:
            self.give_up(MAX_HELD)

    def on_heartbeat(self, stream: Stream, publisher: str, number: int) -> None:
        """Handle a heartbeat: the publisher, known or not, has sent `number`, which should have arrived by now."""
        stream.last_active = self._clock()
        writer = stream.writers.get(publisher)
        if writer is None and len(self.gaps.requesting) < MAX_REQUESTING:
            writer = self._add_writer(stream, publisher, 0 if self._settling else number, history_end=number + 1)
        if writer is not None:
            writer.on_heartbeat(number)

    def on_link_change(self, streams: Iterable[Stream]) -> None:
        """Handle a link that broke or came back."""
        self._settling_until = self._clock() + _SETTLING
        for stream in streams:
            for writer in stream.writers.values():
                writer.unresponsive = False  # perhaps the link was down

    def give_up(self, max_held: int = -1) -> None:
        """Count gaps as lost, largest reorder buffers first, until `max_held` messages are held back; -1: all gaps."""
        for writer in sorted(self.gaps.requesting, key=lambda writer: -len(writer.held)):
            if self.gaps.held > max_held:
                writer.give_up()

    def forget(self, stream: Stream) -> None:
        """Count the gaps of an evicted stream as lost."""
        for writer in stream.writers.values():
            writer.give_up()
        stream.writers.clear()
        stream.writer = None

    def is_settled(self, stream: Stream | None, publisher: str, number: int, *, drained: bool) -> bool:
        """Return True if a message of a publisher has arrived or counts as lost, or none was sent to this reader."""
        writer = stream and stream.writers.get(publisher)
        return writer.is_settled(number) if writer else drained and not self._settling

    @property
    def _settling(self) -> bool:
        """True shortly after a link change, when unknown publishers may have sent messages."""
        return self._clock() < self._settling_until

    def _accept_in_order(self, arrivals: list[Arrival]) -> bool:
        """Advance `expected` and return True if a batch continues the sequence of a key's writer without a gap."""
        stream, info = arrivals[0].stream, arrivals[-1].raw.source_info
        writer = stream.writer
        if writer is None or info is None or writer.request is not None or stream.gap:
            return False
        stop = writer.expected + len(arrivals)
        if info.source_sn != stop - 1 or stop >= NUMBERS or entity_name(info.source_id) != writer.name:
            return False
        if len({id(arrival.stream) for arrival in arrivals}) > 1 or not all(map(_PAYLOAD, arrivals)):
            return False
        infos = [arrival.raw.source_info for arrival in arrivals]
        if [info and info.source_sn for info in infos] != list(range(writer.expected, stop)):
            return False
        writer.expected, stream.last_active = stop, self._clock()
        return True

    def _add_writer(self, stream: Stream, name: str, expected: int, *, history_end: int) -> WriterProxy | None:
        """Add a writer proxy, evicting one without a gap if necessary; None if all writers of the key have gaps."""
        if len(stream.writers) >= _MAX_WRITERS_OF_KEY:
            writers = stream.writers.values()
            first = next((each for each in writers if each is not stream.writer and each.request is None), None)
            if first is None:
                return None
            del stream.writers[first.name]
        writer = WriterProxy(stream, name, expected, self._counters, self.gaps, history_end=history_end)
        stream.writers[name] = writer
        return writer
