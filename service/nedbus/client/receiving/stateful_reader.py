"""Stateful reader: the writer proxies of a subscription and their loss counters; no I/O."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from operator import itemgetter
from typing import Final

from nedbus.transport import SourceInfo, entity_name
from nedbus_msgs import AddressError

from .decoder import MAX_KEYS, Arrival, Decoder, KeyState
from .writer_proxy import NUMBERS, Account, WriterProxy

MAX_HELD: Final = 131_072
"""Messages held back behind gaps, about 90 MB; beyond, gaps are given up."""

_MAX_WRITERS_OF_KEY: Final = 8  # the oldest one without a gap is evicted
_MIN_BATCH: Final = 8  # smaller batches are checked message by message
_SETTLING: Final = 10.0  # s after a link change; a new publisher may have sent messages during the outage
_PAYLOAD: Final = itemgetter(1)


class StatefulReader:
    """Order the messages of each publisher and count losses; not thread-safe.

    With `recovers`, messages behind a gap are held back until it is filled; otherwise a gap is lost at once.
    """

    def __init__(self, decoder: Decoder, *, recovers: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self.account = Account()
        self.recovers = recovers
        self._decoder = decoder
        self._clock = clock
        self._settling_until = float("-inf")

    @property
    def settling(self) -> bool:
        """True shortly after a link change, while unknown publishers may have sent messages."""
        return self._clock() < self._settling_until

    def on_link(self) -> None:
        """Handle a link that broke or came back."""
        self._settling_until = self._clock() + _SETTLING
        for writer in self.account.requesting:
            writer.unresponsive = False  # perhaps the link was down

    def on_samples(self, arrivals: list[Arrival], *, overflowed: bool) -> list[Arrival]:
        """Return the messages to deliver, each with the losses before it; `overflowed`: the ring was full."""
        if len(arrivals) >= _MIN_BATCH and self._accept_in_order(arrivals):
            return arrivals
        recovers = self.recovers and not overflowed
        delivered: list[Arrival] = []
        for arrival in arrivals:
            stream, payload, raw, _ = arrival
            info, writer = raw.source_info, stream.writer
            if info is not None:
                source = info.source_id
                if writer is None or source.eid != writer.eid or source.zid != writer.zid:  # cheaper than names
                    writer = self._writer_of(stream, info, recovers=recovers)
            if info is None or writer is None:
                if payload:
                    delivered.append(arrival)
                continue
            number = info.source_sn
            if number == writer.expected and writer.request is None and payload and not stream.gap:
                writer.expected = (number + 1) % NUMBERS
                delivered.append(arrival)
            else:
                delivered += writer.on_sample(number, arrival, recovers=recovers, overflowed=overflowed)
        if self.account.held > MAX_HELD:
            delivered += self.give_up(MAX_HELD)
        return delivered

    def on_heartbeat(self, key: str, name: str, number: int) -> None:
        """Handle a heartbeat: the publisher, known or not, has sent `number`, which should have arrived by now."""
        with suppress(AddressError):
            stream = self._decoder.stream(key)
            writer = stream.writers.get(name)
            if writer is None and len(self.account.requesting) < MAX_KEYS:
                writer = self._add_writer(stream, name, 0 if self.settling else number, history_end=number + 1)
            if writer is not None:
                writer.on_heartbeat(number)

    def give_up(self, max_held: int) -> list[Arrival]:
        """Give up gaps until `max_held` messages are held back, largest reorder buffers first; -1 gives up all."""
        delivered: list[Arrival] = []
        for writer in sorted(self.account.requesting, key=lambda writer: -len(writer.held)):
            if self.account.held > max_held:
                delivered += writer.give_up()
        return delivered

    def has(self, key: str, name: str, number: int) -> bool | None:
        """Return True if a message has arrived or counts as lost; None for an unknown publisher."""
        with suppress(AddressError):
            if (writer := self._decoder.stream(key).writers.get(name)) is not None:
                return writer.has(number)
        return None

    def _writer_of(self, stream: KeyState, info: SourceInfo, *, recovers: bool) -> WriterProxy | None:
        """Return the writer proxy of a sample, a new one if needed; None if there is no room for it."""
        name = entity_name(info.source_id)
        writer = stream.writers.get(name)
        if writer is None:
            first = 0 if recovers and self.settling else info.source_sn
            writer = self._add_writer(stream, name, first, history_end=info.source_sn)
        stream.writer = writer
        if writer is not None:
            writer.zid, writer.eid = info.source_id.zid, info.source_id.eid
        return writer

    def _accept_in_order(self, arrivals: list[Arrival]) -> bool:
        """Accept a whole batch if it continues the last publisher of one key without a gap; return whether it does."""
        writer, info = arrivals[0][0].writer, arrivals[-1][2].source_info
        if writer is None or info is None or writer.request is not None or writer.stream.gap:
            return False
        stop = writer.expected + len(arrivals)
        if info.source_sn != stop - 1 or stop >= NUMBERS or entity_name(info.source_id) != writer.name:
            return False
        if len({id(arrival[0]) for arrival in arrivals}) > 1 or not all(map(_PAYLOAD, arrivals)):
            return False
        infos = [raw.source_info for _, _, raw, _ in arrivals]
        if [info and info.source_sn for info in infos] != list(range(writer.expected, stop)):
            return False
        writer.expected = stop
        return True

    def _add_writer(self, stream: KeyState, name: str, expected: int, *, history_end: int) -> WriterProxy | None:
        """Add a writer proxy, evicting one without a gap if necessary; None if all of its key have gaps."""
        if len(stream.writers) >= _MAX_WRITERS_OF_KEY:
            writers = stream.writers.values()
            first = next((each for each in writers if each is not stream.writer and each.request is None), None)
            if first is None:
                return None
            del stream.writers[first.name]
        writer = stream.writers[name] = WriterProxy(stream, name, expected, self.account, history_end=history_end)
        return writer
