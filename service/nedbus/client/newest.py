"""The newest message of each stream, with its age and the health of its stream: of a bus, or of any samples."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, ItemsView, Iterable, Iterator, Mapping, ValuesView
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar, overload

from nedbus import clock, limits
from nedbus.errors import ArgumentError, ClosedError, NoDataError
from nedbus.log_event import about
from nedbus.samples import Counts, M_co, Sample
from nedbus.transport import Publishers, require_unforked
from nedbus_msgs import ANY, Address, Message, topic_of

from .health import ABSENT, Health, Histogram, StreamHealth, health_of_last, silence_of
from .receiving import Inbox, Receiver
from .subscription import Subscription

if TYPE_CHECKING:
    from .bus import Bus

_log = logging.getLogger(__name__)

_M = TypeVar("_M", bound=Message)
_NETWORK_INTERVAL: Final = 1.0  # s between two looks at the link and at the list of publishers


@dataclass(slots=True)
class _View:
    """What the messages of a view share: the number of its last update, and the state of the network.

    `ask`: returns whether there is a link, and the publishers; None if both are unknown.
    """

    ask: Callable[[], tuple[bool, Publishers]] | None = None
    number: int = 0
    _asked: float = -math.inf
    _answer: tuple[bool, Publishers] = field(default_factory=lambda: (False, Publishers()))

    def network(self, address: Address) -> tuple[bool, int | None]:
        """Return whether there is a link, and the number of publishers of an address; None if that is unknown."""
        if self.ask is None:
            return True, None
        if time.monotonic() - self._asked > _NETWORK_INTERVAL:
            try:
                self._answer = self.ask()
            except ClosedError:
                self._answer = False, Publishers()
            self._asked = time.monotonic()
        connected, publishers = self._answer
        count = publishers[address]
        if not count and not publishers.complete:
            return connected, None
        return connected, count


@dataclass(slots=True, eq=False)
class NewestMessage(Generic[M_co]):
    """The newest message of a stream; `view[address]` returns one, which follows its stream.

    `sample`: the message with its metadata.
    """

    sample: Sample[M_co]
    _view: _View
    # on the monotonic clock [ns]; a retained message when it was sent, -inf if unknown
    _arrived: float = -math.inf
    _number: int = 0  # of the update in which it arrived
    _measured: StreamHealth | None = None  # None before the first message that is not retained

    @property
    def message(self) -> M_co:
        """The message."""
        return self.sample.message

    @property
    def updated(self) -> bool:
        """True if the message arrived in the last update of its view, or in the last `add` of its Monitor."""
        return self._number == self._view.number

    @property
    def age(self) -> float:
        """Seconds since the message arrived or, if it is retained, since it was sent; infinity if that is unknown."""
        return max(0.0, time.monotonic_ns() - self._arrived) / 1e9

    @property
    def alive(self) -> bool:
        """True while the stream is neither disconnected, gone nor stale, by the rule of `nedbus hz`.

        It is alive for 1 s after a message. Later it is disconnected without a link to the router, gone without a
        publisher, and stale after `health.stale_after`; link and publishers are looked up once per second at most.
        """
        age = self.age
        if age <= ABSENT:
            return True
        connected, publishers = self._view.network(self.sample.address)
        measured = self._measured or StreamHealth(self.sample.topic)
        return (
            silence_of(age, measured.stale_after, publishers=publishers, connected=connected)
            is None
        )

    @property
    def health(self) -> Health:
        """The health of the stream, measured on the messages that its view has received."""
        if self._measured is None:
            return health_of_last(self.sample, age=self.age)
        return self._measured.snapshot()

    def _put(self, sample: Sample[Any], arrived: float) -> None:
        """Replace the message, except by a retained one that is older."""
        if not sample.retained:
            measured = self._measured or StreamHealth(sample.topic)
            missing = sample.provenance.missing
            received = int(arrived)
            latency = sample.latency
            measured.add(
                sample.message,
                received=received,
                latency=latency,
                lost=sample.lost,
                missing=missing,
            )
            self._measured = measured
        elif self._measured is not None or arrived < self._arrived:
            return
        self.sample = sample
        self._arrived = arrived
        self._number = self._view.number


class Monitor(Mapping[Address, NewestMessage[Message]]):
    """The newest message and the health of each stream, from the samples passed to `add`; at most 10,000 streams.

    Beyond that the least recently updated one is evicted. `evicted`: the number of evicted streams.
    A retained sample is shown until the first live one, and not measured. Thread-safe.

    A key is an Address or, if one stream has it, a topic or the class of its message. `monitor[key]` raises KeyError
    before the first message, for which `monitor.get(key)` returns None, and ArgumentError if several streams match.
    """

    def __init__(self) -> None:
        self.evicted = 0
        self._view, self._wanted = _View(), frozenset({ANY})  # topics
        self._lock = threading.Lock()
        self._latest = time.monotonic_ns()  # arrival time of the latest sample [ns]
        self._to_utc = clock.utc_ns() - self._latest  # from the monotonic to the wall clock [ns]
        self._streams: dict[Address, NewestMessage[Any]] = {}  # least recently updated first
        self._by_topic: defaultdict[str, dict[Address, NewestMessage[Any]]] = defaultdict(dict)
        # the streams in the order of their addresses; None after a new or removed one
        self._sorted: dict[Address, NewestMessage[Any]] | None = None

    def add(self, sample: Sample[Message], *, received: int | None = None) -> bool:
        """Add a sample; return False if it is retained. `received`: arrival time [ns], by default on `monotonic_ns`.

        Each call is an update of the view: afterwards, only the stream of this sample is `updated`.
        """
        self._view.number += 1
        self._add(sample, received)
        return not sample.retained

    @overload
    def __getitem__(self, key: type[_M]) -> NewestMessage[_M]: ...
    @overload
    def __getitem__(self, key: Address | str) -> NewestMessage[Message]: ...
    def __getitem__(self, key: Any) -> NewestMessage[Any]:
        with self._lock:
            if isinstance(key, Address):
                return self._streams[key]
            topic = topic_of(key)
            if not self._wanted & {ANY, topic}:
                raise ArgumentError(
                    "topic", topic, f"one of this view: {', '.join(sorted(self._wanted))}"
                )
            streams = self._by_topic.get(topic, {})
            if len(streams) > 1:
                names = ", ".join(map(str, islice(sorted(streams), limits.SHOWN_NAMES)))
                raise ArgumentError(
                    "topic", topic, f"an address, such as {names}", problem="has several streams"
                )
            if streams:
                return streams[next(iter(streams))]
            return self._streams[key]

    @overload  # type: ignore[override] # a class selects the type of the message
    def get(self, key: type[_M], /) -> NewestMessage[_M] | None: ...
    @overload
    def get(self, key: Address | str, /) -> NewestMessage[Message] | None: ...
    def get(self, key: Any, /, default: Any = None) -> Any:
        """Return the newest message of a stream, None before its first; raise ArgumentError like `monitor[key]`."""
        return super().get(key, default)

    def __iter__(self) -> Iterator[Address]:
        return iter(self._copy())

    def values(self) -> ValuesView[NewestMessage[Any]]:
        """Return the newest messages, as they are known now."""
        return self._copy().values()

    def items(self) -> ItemsView[Address, NewestMessage[Any]]:
        """Return the addresses and newest messages, as they are known now."""
        return self._copy().items()

    def __len__(self) -> int:
        return len(self._streams)

    def snapshot(self, now: int | None = None) -> dict[Address, Health]:
        """Return the health of each measured stream, by address, now or at `now` [ns] of the clock used in `add`."""
        with self._lock:
            streams = self._in_order()
        return {
            address: stream._measured.snapshot(now)
            for address, stream in streams.items()
            if stream._measured
        }

    def latencies(self, address: Address) -> Histogram | None:
        """Return the latency histogram of a stream since the start [s]; None if it is not measured."""
        stream = self._streams.get(address)
        if stream is not None and stream._measured is not None:
            return stream._measured.latencies
        return None

    def forget(self, address: Address, *, silence: float = 0.0) -> None:
        """Remove a stream unless it has been silent for less than `silence` s; its next sample starts a new one."""
        with self._lock:
            if address in self._streams and self._streams[address].age >= silence:
                self._remove(address)

    def _add(self, sample: Sample[Any], received: int | None = None) -> NewestMessage[Any]:
        address = sample.address
        with self._lock:
            stream = self._streams.pop(address, None)
            if stream is None:
                if len(self._streams) >= limits.KEYS:
                    self._evict()
                stream = self._by_topic[address.topic][address] = NewestMessage(sample, self._view)
                self._sorted = None
            self._streams[address] = stream
            if received is None:
                stream._put(sample, self._arrival(sample))
            else:
                stream._put(sample, received)
        return stream

    def _in_order(self) -> dict[Address, NewestMessage[Any]]:
        """Return the streams in the order of their addresses; the caller holds the lock."""
        if self._sorted is None:
            self._sorted = {address: self._streams[address] for address in sorted(self._streams)}
        return self._sorted

    def _copy(self) -> dict[Address, NewestMessage[Any]]:
        with self._lock:
            return self._streams.copy()

    def _arrival(self, sample: Sample[Any]) -> float:
        """Return the time on `monotonic_ns` at which a sample arrived or, if it is retained, was sent.

        Samples are read in the order of arrival. One that seems to have arrived before the last one shows a step of the
        wall clock, which is the change of the difference between the two clocks.
        """
        now = time.monotonic_ns()
        utc = clock.utc_ns()
        before = self._to_utc
        if sample.retained:
            if sample.sent is None:
                return -math.inf
            return now - max(0, utc - sample.sent)
        self._to_utc, arrival = utc - now, now - max(0, utc - sample.received)
        if arrival < self._latest:
            arrival += self._to_utc - before
        self._latest = min(now, max(self._latest, arrival))
        return self._latest

    def _evict(self) -> None:
        if not self.evicted:
            text = "more than %d streams: the least recently updated ones are discarded, with their health"
            _log.warning(text, limits.KEYS, extra=about("incomplete"))
        self.evicted += 1
        self._remove(next(iter(self._streams)))

    def _remove(self, address: Address) -> None:
        del self._streams[address], self._by_topic[address.topic][address]
        self._sorted = None
        if not self._by_topic[address.topic]:
            del self._by_topic[address.topic]


class NewestBase(Monitor):
    """The view of a bus, blocking or asynchronous."""

    def __init__(
        self, inbox: Inbox, topics: Iterable[str], ask: Callable[[], tuple[bool, Publishers]]
    ) -> None:
        super().__init__()
        self._inbox = inbox
        self._wanted = frozenset(topics)
        self._view.ask = ask

    @property
    def closed(self) -> bool:
        """True once the view or its bus is closed, or receiving has failed."""
        return self._inbox.ended

    @property
    def counts(self) -> Counts:
        """Received, lost, dropped, invalid and discarded messages so far, as of a subscription in mode "latest"."""
        return self._inbox.counts

    @property
    def invalid(self) -> dict[Address, str]:
        """Why a message of a stream was invalid, for up to 100 streams; `counts.invalid` has the number of messages."""
        return self._inbox.decoder.reasons.copy()

    def _read(self, *samples: Sample[Any]) -> list[NewestMessage[Message]]:
        """Start a new update: add these samples, and those that have arrived; return the streams with news."""
        ended = self._inbox.ended  # before `pop`, as in Subscription
        self._view.number += 1
        popped = (self._inbox.pop() for _ in range(self._inbox.waiting))
        arrived = [*samples, *(sample for sample in popped if sample is not None)]
        if ended and not arrived:
            raise self._inbox.end_error
        # two samples of a stream are one piece of news
        streams = dict.fromkeys(map(self._add, arrived))
        return [stream for stream in streams if stream.updated]


class Newest(NewestBase, AbstractContextManager["Newest"]):
    """View of the newest message of each stream; `bus.newest(...)` returns one. Read it after each `update`.

    It needs no thread unless `update` has a timeout. Call `update` from one thread; any thread may read the messages.
    """

    def __init__(
        self, receiver: Receiver, inbox: Inbox, topics: Iterable[str], *, owner: Bus
    ) -> None:
        super().__init__(inbox, topics, owner._network)
        self._receiver = receiver
        self._subscription = Subscription[Message](receiver, inbox, owner=owner)

    def update(self, timeout: float | None = 0.0) -> list[NewestMessage[Message]]:
        """Read what has arrived, if nothing wait up to `timeout` seconds (None: without limit) for a message.

        Returns the streams with a new message. If the definition of a custom message is being looked up, waits for it.
        Raises ClosedError if the view is closed, ReceiveError if it has failed.
        """
        require_unforked()
        self._receiver.receive()
        news = self._read()
        if not news and timeout != 0:
            with suppress(NoDataError):
                news = self._read(self._subscription.receive(timeout))
        return news

    def close(self) -> None:
        """Close the view; its messages remain. A second call does nothing."""
        self._subscription.close()

    def __exit__(self, *exc: object) -> None:
        self.close()
