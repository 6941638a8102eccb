"""A model of a subscription: publishers, an unreliable link and a slow reader, with the invariants of its counts.

`ReceivePath` is the interface under test; other receive paths can be tested through an adapter.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple, Protocol, get_args

from nedbus import Counts, Mode
from nedbus.client.receiving import Decoder, Inbox, LayoutLookup
from nedbus.client.receiving.writer_proxy import WriterProxy
from nedbus.transport import RawSample
from tests.waits import changing_timings

from .raw_samples import INVALID, name_of, raw

Ending = Literal["closed", "drained", "failed"]

UNLIMITED: Final = 100_000
"""More messages than any run of a publisher sends."""


class InitialState(NamedTuple):
    """The initial state of a simulation.

    `caches`: size of each publisher's history cache [messages]. `capacity`: size of the queue [messages].
    """

    mode: Mode = "every"
    caches: tuple[int, ...] = (UNLIMITED,)
    capacity: int = UNLIMITED


class Request(NamedTuple):
    """An open retransmission request."""

    handle: object
    publisher: str
    numbers: range


class ReceivePath(Protocol):
    """The receive path of one subscription, without I/O. Mode `latest` has no heartbeats and no requests.

    `link`: report that the link broke, or that it has been up for so long that an unknown publisher must be new.
    `answer`: pass the samples of a reply; with `final`, requested messages that are not among them are lost.
    `read`: return the timestamps of one or more messages, and the losses that they report.
    `finish`: end reception, as a receiver does.
    """

    def __init__(self, setting: InitialState) -> None: ...
    def put(self, batch: Sequence[RawSample], *, overflowed: bool) -> None: ...
    def heartbeat(self, key: str, publisher: str, number: int) -> None: ...
    def link(self, *, broken: bool) -> None: ...
    def requests(self) -> list[Request]: ...
    def answer(self, request: Request, samples: Sequence[RawSample], *, final: bool) -> None: ...
    def read(self, *, batch: bool) -> tuple[list[int], int] | None: ...
    def finish(self, ending: Ending) -> None: ...
    @property
    def counts(self) -> Counts: ...
    @property
    def held(self) -> int: ...


class InboxReceivePath(Inbox):
    """The receive path of Inbox, with a fake clock."""

    def __init__(self, setting: InitialState) -> None:
        self._now, self._since_link = 0.0, 0.0
        decoder = Decoder(LayoutLookup(lambda _: {}), prefix="nedbus")
        limit = setting.capacity if setting.mode == "every" else None
        # advances between steps
        super().__init__(setting.mode, decoder, limit=limit, clock=lambda: self._since_link)

    def heartbeat(self, key: str, publisher: str, number: int) -> None:
        self.on_heartbeat(key, publisher, number)

    def link(self, *, broken: bool) -> None:
        if broken:
            self.on_link_change()
        else:
            self._since_link += 60.0

    def requests(self) -> list[Request]:
        with changing_timings() as timings:
            timings.retransmit_timeout = 1e6
            self._now += 1.0
            for writer in list(self.gaps.requesting):
                self.next_request(writer, self._now)
        opened = [
            (each, each.request.requested)
            for each in self.gaps.requesting
            if each.request is not None
        ]
        return [
            Request(writer, writer.name, numbers)
            for writer, numbers in opened
            if numbers is not None
        ]

    def answer(self, request: Request, samples: Sequence[RawSample], *, final: bool) -> None:
        assert isinstance(request.handle, WriterProxy)
        found = {sample.source_info.source_sn: sample for sample in samples if sample.source_info}
        self._now += 1e7 if final else 0.0
        self.on_retransmission(request.handle, found, ended=True, now=self._now)

    @property
    def held(self) -> int:
        return self.gaps.held

    def finish(self, ending: Ending) -> None:
        if ending == "closed":
            self.end(discard=True)
        self.give_up()
        self.end("failed" if ending == "failed" else "")

    def read(self, *, batch: bool) -> tuple[list[int], int] | None:
        if batch:
            found = self.pop_batch()
            return None if found is None else (found.messages["timestamp"].tolist(), found.lost)
        sample = self.pop()
        return None if sample is None else ([sample.message.timestamp], sample.lost)


@dataclass(eq=False)
class PublisherRun:
    """One run of a publisher, until its restart; its messages are numbered from 0.

    `known`: the newest number that the reader has seen. `exact`: the reader received the first message. `whole`: it
    received the first message or requested all earlier ones. `given_up`: a request may have been left unanswered.
    """

    index: int
    slot: int
    cache: int
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


class Simulation:
    """Simulation of publishers, the link to one reader, and the messages that it read.

    Each public method is a step; positions wrap around.
    """

    def __init__(self, setting: InitialState, path: ReceivePath) -> None:
        self.setting, self.path = setting, path
        self.in_flight: list[tuple[PublisherRun, int]] = []
        self.open_requests: list[Request] = []
        self.intact = True
        self._latest = setting.mode == "latest"
        self._unsettled = self._overflowed = self._slow = False
        self._reported = 0
        self._runs = [PublisherRun(slot, slot, cache) for slot, cache in enumerate(setting.caches)]
        self._running = list(self._runs)
        # per key, the run whose newest message arrived last
        self._newest: dict[int, PublisherRun] = {}

    def step(self, name: str, *arguments: int) -> None:
        """Run a step, then check the invariants."""
        self.intact = False
        getattr(self, name)(*arguments)
        counts, self.open_requests = self.path.counts, self.path.requests()
        assert counts.received == sum(len(run.read) for run in self._runs)
        assert self._reported <= counts.lost
        assert not counts.dropped or self._slow or self._overflowed or self._latest
        assert self._total() <= sum(run.known + 1 for run in self._runs)
        self.intact = True

    def publish(self, slot: int, count: int, invalid: int = 0) -> None:
        run = self._running[slot % len(self._running)]
        self.in_flight += [(run, run.sent + number) for number in range(count)]
        run.sent += count
        run.invalid.update([run.sent - 1] * invalid)

    def restart(self, slot: int) -> None:
        run = self._running[slot % len(self._running)]
        run.cache, run.given_up = 0, True
        self._running[run.slot] = PublisherRun(
            len(self._runs), run.slot, self.setting.caches[run.slot]
        )
        self._runs.append(self._running[run.slot])

    def deliver(self, count: int, dropped: int = 0) -> None:
        """Deliver the next samples; a full ring drops up to `dropped` of the oldest."""
        taken = self._take(0, count)
        del taken[: min(dropped, len(taken) - 1)]
        for run, number in taken:
            if run.known < 0:
                run.exact = number == 0
                run.whole = run.exact or (self._unsettled and not dropped)
            run.known = max(run.known, number)
        self._overflowed |= dropped > 0
        self._add_arrived(taken)
        self.path.put([run.sample(number) for run, number in taken], overflowed=dropped > 0)

    def drop(self, position: int, count: int) -> None:
        self._take(position, count)

    def delay(self, position: int, count: int, twice: int = 0) -> None:
        taken = self._take(position, count)
        self.in_flight[:0] = taken * twice
        self.in_flight += taken

    def link(self, broken: int) -> None:
        """Break the link, or let so much time pass that unknown publishers count as new."""
        self._unsettled = bool(broken)
        self._take(0, broken * len(self.in_flight))
        self.path.link(broken=self._unsettled)

    def heartbeat(self, slot: int) -> None:
        run = self._running[slot % len(self._running)]
        if run.sent and not self._latest:
            run.whole |= run.known < 0 and self._unsettled
            run.known = run.sent - 1
            self.path.heartbeat(run.key, name_of(run.name), run.sent - 1)

    def answer(self, position: int, missing: int = 0, final: int = 0) -> None:
        """Reply to a request from the history cache, without the samples whose bits are set in `missing`."""
        requests = self.path.requests()
        request = requests[position % len(requests)]
        run, numbers = self._runs[int(request.publisher.partition(":")[0])], request.numbers
        assert 0 <= numbers.start < numbers.stop <= run.sent
        cached = [number for number in numbers if run.sent - run.cache <= number]
        found = [number for bit, number in enumerate(cached) if not missing >> bit & 1]
        run.given_up |= bool(final) and found != cached
        self._add_arrived((run, number) for number in found)
        self.path.answer(
            request, [run.sample(number) for number in reversed(found)], final=bool(final)
        )

    def read(self, count: int, batch: int = 0) -> None:
        while count > 0 and (found := self.path.read(batch=bool(batch))) is not None:
            count -= 1
            self._reported += found[1]
            for timestamp in found[0]:
                index, number = divmod(timestamp - 1, UNLIMITED)
                run = self._runs[index]
                previous = run.read[-1] if run.read else -1
                assert previous < number, "out of order or a duplicate"
                if (
                    run.exact
                    and index == run.slot
                    and self._is_alone(run)
                    and not (batch or run.invalid or self._slow or self._overflowed)
                ):
                    assert self._latest or found[1] == number - previous - 1, (
                        "the next message has another loss"
                    )
                run.read.append(number)

    def _is_alone(self, run: PublisherRun) -> bool:
        """Return whether the reader knows no other run of a publisher, whose loss the next message would report.

        That message may be one that this run held back until a request was answered.
        """
        return not any(
            other.slot == run.slot and other is not run and other.known >= 0 for other in self._runs
        )

    def settle(self) -> None:
        """Deliver, reply to and read everything, then publish once more: the next message reports all losses."""
        self._settle()
        for run in self._running:
            self.publish(run.slot, 1)
        self._settle()
        assert self._reported == self.path.counts.lost, "not every loss is reported once"

    def finish(self, ending: int) -> None:
        """End the subscription: what has been received can be read, or counts as dropped if it is closed."""
        how: Ending = get_args(Ending)[ending]
        read, self._slow = self.path.counts.received, self._slow or how == "closed"
        self.path.finish(how)
        self.read(UNLIMITED, batch=ending % 2)
        assert how != "closed" or self.path.counts.received == read, (
            "messages were read after the end"
        )
        self._check_total()

    def _settle(self) -> None:
        for _ in range(20):
            self.deliver(len(self.in_flight))
            for run in self._running:
                self.heartbeat(run.slot)
            for request in self.path.requests():
                self.answer(0)
                if request in self.path.requests():
                    self.answer(0, final=1)
            self.read(UNLIMITED)
        self._check_total()
        for run in self._runs:
            if self._latest and self._newest.get(run.slot) is run:
                assert max(run.arrived) in {*run.read, *run.invalid}, (
                    "the newest message was not read"
                )
            complete = run.whole and run.cache == UNLIMITED and not run.given_up
            if complete and not (self._latest or self._slow or self._overflowed):
                assert run.read == [
                    number for number in range(run.known + 1) if number not in run.invalid
                ]

    def _check_total(self) -> None:
        assert (self.path.held, self.path.requests()) == (0, []), "messages or requests remain"
        total, most = self._total(), sum(run.known + 1 for run in self._runs)
        least = most - sum(map(self._unknown, self._runs))
        assert least <= total <= most, (
            f"received + lost + dropped + invalid is {total}, not {least} to {most}"
        )

    def _total(self) -> int:
        counts = self.path.counts
        return counts.received + counts.lost + counts.dropped + counts.invalid

    def _unknown(self, run: PublisherRun) -> int:
        """Return the maximum number of messages sent before the reader discovered this run."""
        return 0 if run.exact else min(run.read, default=run.known + 1)

    def _take(self, position: int, count: int) -> list[tuple[PublisherRun, int]]:
        start = position % max(1, len(self.in_flight))
        taken = self.in_flight[start : start + count]
        del self.in_flight[start : start + count]
        return taken

    def _add_arrived(self, arrived: Iterable[tuple[PublisherRun, int]]) -> None:
        for run, number in arrived:
            if number > max(run.arrived, default=-1):
                self._newest[run.slot] = run
            run.arrived.add(number)
        waiting = (
            number > max(run.read, default=-1) for run in self._runs for number in run.arrived
        )
        self._slow |= sum(waiting) > self.setting.capacity
