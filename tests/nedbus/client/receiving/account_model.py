"""A model of a subscription: publishers, an unreliable link and a slow reader, with the invariants of its counts.

`Account` is the interface under test; other receive paths can be tested through an adapter.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Protocol
from unittest import mock

from nedbus import Counts, Mode
from nedbus.client.receiving import Decoder, LayoutLookup, PendingQueue, pending_queue
from nedbus.client.receiving.writer_proxy import WriterProxy
from nedbus.transport import RawSample
from tests.waits import changing_timings

from .raw_samples import INVALID, name_of, raw

UNLIMITED: Final = 100_000
"""More messages than any life of a publisher sends."""


class Setting(NamedTuple):
    """The initial state of a world.

    `keeps`: the size of each publisher's history cache, in messages. `capacity`: of the queue.
    """

    mode: Mode = "every"
    keeps: tuple[int, ...] = (UNLIMITED,)
    capacity: int = UNLIMITED


class Request(NamedTuple):
    """An open retransmission request."""

    handle: object
    publisher: str
    numbers: range


class Account(Protocol):
    """The receive path of one subscription, without I/O. Mode `latest` has no heartbeats and no requests.

    `link`: the link broke, or did so long ago that a new publisher has sent nothing before. `answer`: with `final`, a
    request that these samples do not complete is given up. `read`: the timestamps of one or more messages, and the
    reported losses.
    """

    def __init__(self, setting: Setting) -> None: ...
    def put(self, batch: Sequence[RawSample], *, overflowed: bool) -> None: ...
    def heartbeat(self, key: str, publisher: str, number: int) -> None: ...
    def link(self, *, broken: bool) -> None: ...
    def requests(self) -> list[Request]: ...
    def answer(self, request: Request, samples: Sequence[RawSample], *, final: bool) -> None: ...
    def read(self, *, batch: bool) -> tuple[list[int], int] | None: ...
    @property
    def counts(self) -> Counts: ...
    @property
    def held(self) -> int: ...


class QueueAccount(PendingQueue):
    """The account in PendingQueue, with a fake clock."""

    def __init__(self, setting: Setting) -> None:
        self._now, self._since_link = 0.0, 0.0
        decoder = Decoder(LayoutLookup(lambda _: {}), prefix="nedbus")
        super().__init__(setting.mode, decoder, clock=lambda: self._since_link)  # steps take no time
        self._capacity = mock.patch.object(pending_queue, "CAPACITY", setting.capacity)

    def put(self, batch: Sequence[RawSample], *, overflowed: bool = False) -> None:
        with self._capacity:
            super().put(batch, overflowed=overflowed)

    def heartbeat(self, key: str, publisher: str, number: int) -> None:
        self.on_heartbeat(key, publisher, number)

    def link(self, *, broken: bool) -> None:
        if broken:
            self.on_link()
        else:
            self._since_link += 60.0

    def requests(self) -> list[Request]:
        with changing_timings() as timings:
            timings.retransmit_timeout = 1e6
            self._now += 1.0
            for writer in list(self.counters.requesting):
                self.next_request(writer, self._now)
        asked = [
            (writer, writer.request.requested) for writer in self.counters.requesting if writer.request is not None
        ]
        return [Request(writer, writer.name, numbers) for writer, numbers in asked if numbers is not None]

    def answer(self, request: Request, samples: Sequence[RawSample], *, final: bool) -> None:
        assert isinstance(request.handle, WriterProxy)
        found = {sample.source_info.source_sn: sample for sample in samples if sample.source_info}
        self._now += 1e7 if final else 0.0
        with self._capacity:
            self.on_retransmission(request.handle, found, ended=True, now=self._now)

    @property
    def held(self) -> int:
        return self.counters.held

    def read(self, *, batch: bool) -> tuple[list[int], int] | None:
        if batch:
            found = self.pop_batch()
            return None if found is None else (found.messages["timestamp"].tolist(), found.lost)
        sample = self.pop(rows=False)
        return None if sample is None else ([sample.message.timestamp], sample.lost)


@dataclass(eq=False)
class Life:
    """One life of a publisher; its messages are numbered from 0.

    `known`: the newest number that the reader knows of. `exact`: the reader received its first message. `whole`: that,
    or the reader requested all earlier messages. `given_up`: a request may have been left unanswered.
    """

    index: int
    slot: int
    keeps: int
    sent: int = 0
    known: int = -1
    exact: bool = False
    whole: bool = False
    given_up: bool = False
    invalid: set[int] = field(default_factory=set)
    arrived: set[int] = field(default_factory=set)
    read: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.key, self.name = f"nedbus/{self.slot + 1}/vehicle_local_position", str(self.index)

    def sample(self, number: int) -> RawSample:
        payload = INVALID if number in self.invalid else None
        stamp = self.index * UNLIMITED + number + 1
        return raw(number, timestamp=stamp, key=self.key, publisher=self.name, payload=payload)


class World:
    """Publishers, the link to one reader, and the messages that it read.

    Each public method is a step; positions are taken modulo.
    """

    def __init__(self, setting: Setting, account: Account) -> None:
        self.setting, self.account = setting, account
        self.flight: list[tuple[Life, int]] = []
        self.open: list[Request] = []
        self.intact = True
        self._latest = setting.mode == "latest"
        self._unsettled = self._overflowed = self._slow = False
        self._told = 0
        self._lives = [Life(slot, slot, keeps) for slot, keeps in enumerate(setting.keeps)]
        self._running = list(self._lives)

    def step(self, name: str, *arguments: int) -> None:
        """Take a step, then check the invariants."""
        self.intact = False
        getattr(self, name)(*arguments)
        counts, self.open = self.account.counts, self.account.requests()
        assert counts.received == sum(len(life.read) for life in self._lives)
        assert self._told <= counts.lost
        assert not counts.dropped or self._slow or self._overflowed or self._latest
        assert self._accounted() <= sum(life.known + 1 for life in self._lives)
        self.intact = True

    def publish(self, slot: int, count: int, invalid: int = 0) -> None:
        life = self._running[slot % len(self._running)]
        self.flight += [(life, life.sent + number) for number in range(count)]
        life.sent += count
        life.invalid.update([life.sent - 1] * invalid)

    def restart(self, slot: int) -> None:
        life = self._running[slot % len(self._running)]
        life.keeps, life.given_up = 0, True
        self._running[life.slot] = Life(len(self._lives), life.slot, self.setting.keeps[life.slot])
        self._lives.append(self._running[life.slot])

    def deliver(self, count: int, dropped: int = 0) -> None:
        """Put the next samples; `dropped`: up to this number of the oldest are dropped by a full channel."""
        taken = self._take(0, count)
        del taken[: min(dropped, len(taken) - 1)]
        for life, number in taken:
            if life.known < 0:
                life.exact = number == 0
                life.whole = life.exact or (self._unsettled and not dropped)
            life.known = max(life.known, number)
        self._overflowed |= dropped > 0
        self._note_arrived(taken)
        self.account.put([life.sample(number) for life, number in taken], overflowed=dropped > 0)

    def drop(self, position: int, count: int) -> None:
        self._take(position, count)

    def delay(self, position: int, count: int, twice: int = 0) -> None:
        taken = self._take(position, count)
        self.flight[:0] = taken * twice
        self.flight += taken

    def link(self, broken: int) -> None:
        """Break the link, or advance the time after which a new publisher counts as new."""
        self._unsettled = bool(broken)
        self._take(0, broken * len(self.flight))
        self.account.link(broken=self._unsettled)

    def heartbeat(self, slot: int) -> None:
        life = self._running[slot % len(self._running)]
        if life.sent and not self._latest:
            life.whole |= life.known < 0 and self._unsettled
            life.known = life.sent - 1
            self.account.heartbeat(life.key, name_of(life.name), life.sent - 1)

    def answer(self, position: int, missing: int = 0, final: int = 0) -> None:
        """Reply to a request from the history cache; samples whose bits are set in `missing` are lost."""
        requests = self.account.requests()
        request = requests[position % len(requests)]
        life, numbers = self._lives[int(request.publisher.partition(":")[0])], request.numbers
        assert 0 <= numbers.start < numbers.stop <= life.sent
        kept = [number for number in numbers if life.sent - life.keeps <= number]
        found = [number for place, number in enumerate(kept) if not missing >> place & 1]
        life.given_up |= bool(final) and found != kept
        self._note_arrived((life, number) for number in found)
        self.account.answer(request, [life.sample(number) for number in reversed(found)], final=bool(final))

    def read(self, count: int, batch: int = 0) -> None:
        while count > 0 and (found := self.account.read(batch=bool(batch))) is not None:
            count -= 1
            self._told += found[1]
            for timestamp in found[0]:
                index, number = divmod(timestamp - 1, UNLIMITED)
                life = self._lives[index]
                previous = life.read[-1] if life.read else -1
                assert previous < number, "in order, and nothing twice"
                if life.exact and index == life.slot and not (batch or life.invalid or self._slow or self._overflowed):
                    assert self._latest or found[1] == number - previous - 1, "told by the message behind"
                life.read.append(number)

    def settle(self) -> None:
        """Deliver, reply to and read everything, then publish once more: the next message reports all losses."""
        self._settle()
        for life in self._running:
            self.publish(life.slot, 1)
        self._settle()
        assert self._told == self.account.counts.lost, "each loss is told once"

    def _settle(self) -> None:
        for _ in range(20):
            self.deliver(len(self.flight))
            for life in self._running:
                self.heartbeat(life.slot)
            for request in self.account.requests():
                self.answer(0)
                if request in self.account.requests():
                    self.answer(0, final=1)
            self.read(UNLIMITED)
        assert (self.account.held, self.account.requests()) == (0, []), "nothing is held for ever"
        total, most = self._accounted(), sum(life.known + 1 for life in self._lives)
        least = most - sum(map(self._unknown, self._lives))
        assert least <= total <= most, f"received + lost + dropped + invalid of {least} to {most}: {total}"
        for life in self._lives:
            if self._latest and life.arrived and life in self._running:
                assert max(life.arrived) in {*life.read, *life.invalid}, "the newest is read"
            complete = life.whole and life.keeps == UNLIMITED and not life.given_up
            if complete and not (self._latest or self._slow or self._overflowed):
                assert life.read == [number for number in range(life.known + 1) if number not in life.invalid]

    def _accounted(self) -> int:
        counts = self.account.counts
        return counts.received + counts.lost + counts.dropped + counts.invalid

    def _unknown(self, life: Life) -> int:
        """Return the maximum number of messages sent before the reader heard of this life."""
        return 0 if life.exact else min(life.read, default=life.known + 1)

    def _take(self, position: int, count: int) -> list[tuple[Life, int]]:
        start = position % max(1, len(self.flight))
        taken = self.flight[start : start + count]
        del self.flight[start : start + count]
        return taken

    def _note_arrived(self, arrived: Iterable[tuple[Life, int]]) -> None:
        for life, number in arrived:
            life.arrived.add(number)
        waiting = (number > max(life.read, default=-1) for life in self._lives for number in life.arrived)
        self._slow |= sum(waiting) > self.setting.capacity
