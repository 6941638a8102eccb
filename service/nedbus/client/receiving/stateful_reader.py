"""All remote publishers of a subscription, and the one account of their messages. Pure, without I/O."""

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
"""Messages that are held back behind gaps, some 90 MB; beyond, gaps are given up."""

_MAX_WRITERS_OF_KEY: Final = 8  # publishers that are remembered of one key; of more the first is forgotten
_MIN_BATCH: Final = 8  # messages from which on a check of all together pays
_UNSETTLED: Final = 10.0  # s after a link broke or came back in which a new publisher may have sent something before
_PAYLOAD: Final = itemgetter(1)


class StatefulReader:
    """Put the messages of each publisher in order, and count those that are missing. Not thread-safe.

    With `recovers`, messages after a gap are held back until it is filled; else the missing ones are lost.
    """

    def __init__(self, decoder: Decoder, *, recovers: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self.account = Account()
        self.recovers = recovers
        self._decoder = decoder
        self._clock = clock
        self._unsettled_until = float("-inf")

    @property
    def unsettled(self) -> bool:
        """True while unknown publishers may have sent messages."""
        return self._clock() < self._unsettled_until

    def on_link(self) -> None:
        """Note that a link broke or came back."""
        self._unsettled_until = self._clock() + _UNSETTLED
        for writer in self.account.requesting:
            writer.silent = False  # it could not answer, perhaps

    def on_samples(self, arrivals: list[Arrival], *, overflowed: bool) -> list[Arrival]:
        """Return what can be delivered, each with what was lost before it; `overflowed`: from a ring that was full."""
        if len(arrivals) >= _MIN_BATCH and self._in_order(arrivals):
            return arrivals
        recovers = self.recovers and not overflowed
        delivered: list[Arrival] = []
        for arrival in arrivals:
            stream, payload, raw, _ = arrival
            info, writer = raw.source_info, stream.writer
            if info is not None:
                source = info.source_id
                if writer is None or source.eid != writer.eid or source.zid != writer.zid:  # cheaper than its name
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
        """Note that a publisher, perhaps an unknown one, has sent a message that should have arrived by now."""
        with suppress(AddressError):
            stream = self._decoder.stream(key)
            writer = stream.writers.get(name)
            if writer is None and len(self.account.requesting) < MAX_KEYS:
                writer = self._add_writer(stream, name, 0 if self.unsettled else number, uncertain=number + 1)
            if writer is not None:
                writer.on_heartbeat(number)

    def give_up(self, max_held: int) -> list[Arrival]:
        """Give up gaps, those with most messages behind them first, until `max_held` are held back; -1 for all gaps."""
        delivered: list[Arrival] = []
        for writer in sorted(self.account.requesting, key=lambda writer: -len(writer.held)):
            if self.account.held > max_held:
                delivered += writer.give_up()
        return delivered

    def has(self, key: str, name: str, number: int) -> bool | None:
        """Return whether a message has arrived, or is known to be lost; None if its publisher is not known."""
        with suppress(AddressError):
            if (writer := self._decoder.stream(key).writers.get(name)) is not None:
                return writer.has(number)
        return None

    def _writer_of(self, stream: KeyState, info: SourceInfo, *, recovers: bool) -> WriterProxy | None:
        """Return the publisher of a sample; None if it is not remembered."""
        name = entity_name(info.source_id)
        writer = stream.writers.get(name)
        if writer is None:
            first = 0 if recovers and self.unsettled else info.source_sn
            writer = self._add_writer(stream, name, first, uncertain=info.source_sn)
        stream.writer = writer
        if writer is not None:
            writer.zid, writer.eid = info.source_id.zid, info.source_id.eid
        return writer

    def _in_order(self, arrivals: list[Arrival]) -> bool:
        """Return whether all follow each other, of the last publisher of one key, and note that."""
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

    def _add_writer(self, stream: KeyState, name: str, expected: int, *, uncertain: int) -> WriterProxy | None:
        """Remember a publisher; None if there are too many on its key of which something is missing."""
        if len(stream.writers) >= _MAX_WRITERS_OF_KEY:
            writers = stream.writers.values()
            first = next((each for each in writers if each is not stream.writer and each.request is None), None)
            if first is None:
                return None
            del stream.writers[first.name]
        writer = stream.writers[name] = WriterProxy(stream, name, expected, self.account, uncertain=uncertain)
        return writer
