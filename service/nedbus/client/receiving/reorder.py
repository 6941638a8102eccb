"""Reorder: puts the messages of each publisher in order, finds gaps and counts losses; no I/O."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import zenoh

from nedbus import clock
from nedbus.transport import RawSample, entity_name

from .arrival import NO_LAYOUTS, Arrival, DetachedSample, Stream, detach
from .streams import Streams
from .writer_proxy import NUMBERS, Gaps, LossCounters, WriterProxy

MAX_HELD: Final = 131_072
"""Maximum number of messages held back behind gaps, about 90 MB; beyond it, gaps count as lost."""

MAX_REQUESTING: Final = 10_000
"""Publishers with open gaps; beyond that, the heartbeat of an unknown publisher opens none."""

_MAX_WRITERS_OF_KEY: Final = 8  # beyond that the oldest writer without a gap is evicted
# messages in order on one key, of which only the first and the last sender are compared
_LONG_RUN: Final = 8
# s after a link change; a new publisher may have sent messages during the outage
_SETTLING: Final = 10.0


class Reorder:
    """The writer proxies of a subscription. Not thread-safe.

    Messages in order are appended to `gaps.delivered`.
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
        self._recovers, self._clock = recovers, clock
        self._settling_until = float("-inf")

    def accept(self, batch: Sequence[RawSample], overflowed: bool) -> None:
        """Accept samples in order of arrival; `overflowed`: the ring was full, and gaps count as dropped.

        The message that the writer of a key is expected to send next needs no further checks. Inside a run of such
        messages of one writer the senders are compared at its end.
        """
        known = self._streams.get
        delivered = self.gaps.delivered
        new_arrival = tuple.__new__
        received, now = clock.utc_ns(), self._clock()
        # the writer of the current run, and its messages; in a small batch each is a run
        last, count = None, 0
        has_runs = len(batch) >= _LONG_RUN
        for raw in batch:
            stream, payload = known(str(raw.key_expr)), raw.payload.to_bytes()
            arrival: Arrival | None
            if stream is None or len(payload) != stream.size:
                arrival = self._admit(raw, received)
            else:
                # Without a call of the class, which takes 0.07 us more.
                arrival = new_arrival(
                    Arrival, (stream, payload, raw, stream.codec, 0, received, NO_LAYOUTS)
                )
                writer, info = stream.writer, raw.source_info
                if (
                    writer is not None
                    and info is not None
                    and info.source_sn == writer.expected
                    and writer.request is None
                    and not stream.gap
                    and (
                        writer is last
                        or (
                            (source := info.source_id).eid == writer.eid
                            and source.zid == writer.zid
                        )
                    )
                ):
                    if writer is last:
                        count += 1
                    else:
                        if count > 1:
                            self._check_run(count, now, overflowed)
                        last = writer if has_runs else None
                        count = 1
                        stream.last_active = now
                    writer.expected = (writer.expected + 1) % NUMBERS
                    delivered.append(arrival)
                    continue
            if count > 1:
                self._check_run(count, now, overflowed)
            last, count = None, 0
            if arrival is not None:
                self._accept_one(arrival, now, overflowed)
        if count > 1:
            self._check_run(count, now, overflowed)
        if self.gaps.held > MAX_HELD:
            self.give_up(MAX_HELD)

    def on_heartbeat(self, stream: Stream, publisher: str, number: int) -> None:
        """Handle a heartbeat: the publisher, known or not, has sent `number`, which should have arrived by now."""
        stream.last_active = self._clock()
        writer = stream.writers.get(publisher)
        if writer is None and len(self.gaps.requesting) < MAX_REQUESTING:
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

    def is_settled(
        self, stream: Stream | None, publisher: str, number: int, *, drained: bool
    ) -> bool:
        """Return True if a message of a publisher has arrived or counts as lost, or none was sent to this reader."""
        writer = stream and stream.writers.get(publisher)
        return writer.is_settled(number) if writer else drained and not self._settling

    @property
    def _settling(self) -> bool:
        """True shortly after a link change, when unknown publishers may have sent messages."""
        return self._clock() < self._settling_until

    def _check_run(self, count: int, now: float, overflowed: bool) -> None:
        """Compare the senders of a run, the last `count` messages; if one differs, accept the messages one by one.

        The first sender is known; of a long run, only the last one is compared as well.
        """
        delivered = self.gaps.delivered
        run = delivered[-count:]
        writer = run[0].stream.writer
        compared = run[-1:] if count >= _LONG_RUN else run[1:]
        if writer is None or all(writer.is_sender(arrival.raw.source_info) for arrival in compared):
            return
        del delivered[-count:]
        writer.expected = (writer.expected - count) % NUMBERS
        for arrival in run:
            self._accept_one(arrival, now, overflowed)

    def _accept_one(self, arrival: Arrival, now: float, overflowed: bool) -> None:
        """Accept any message: of a new writer, behind a gap, late, rejected, or without a number."""
        recovers = self._recovers and not overflowed
        stream, raw = arrival.stream, arrival.raw
        info = raw.source_info
        stream.last_active, writer = now, stream.writer
        if info is not None and (writer is None or not writer.is_sender(info)):
            name = entity_name(info.source_id)
            writer = stream.writers.get(name)
            if writer is None:
                first = 0 if recovers and self._settling else info.source_sn
                writer = self._add_writer(stream, name, first, history_end=info.source_sn)
            stream.writer = writer
            if writer is not None:
                # Only replies to queries use BLOCK, such as those to Zenoh's history query; nedbus publishers use DROP.
                is_live = (
                    isinstance(raw, DetachedSample)
                    or raw.congestion_control != zenoh.CongestionControl.BLOCK
                )
                if not is_live and writer.eid is None:
                    arrival = detach(arrival, retained=True)
                writer.zid, writer.eid = info.source_id.zid, info.source_id.eid
        if info is None or writer is None:
            if arrival.payload:
                self.gaps.delivered.append(arrival)
            return
        writer.on_sample(info.source_sn, arrival, recovers=recovers, overflowed=overflowed)

    def _add_writer(
        self, stream: Stream, name: str, expected: int, *, history_end: int
    ) -> WriterProxy | None:
        """Add a writer proxy, evicting one without a gap if necessary; None if all writers of the key have gaps."""
        if len(stream.writers) >= _MAX_WRITERS_OF_KEY:
            writers = stream.writers.values()
            first = next(
                (each for each in writers if each is not stream.writer and each.request is None),
                None,
            )
            if first is None:
                return None
            del stream.writers[first.name]
        writer = WriterProxy(
            stream, name, expected, self._counters, self.gaps, history_end=history_end
        )
        stream.writers[name] = writer
        return writer
