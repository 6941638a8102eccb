"""The bus as scripts see it: subscribe, ask, publish; blocking."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from functools import partial
from typing import Self

from nedbus.errors import ClosedError, NedbusError
from nedbus.transport import Session, Tls, open_client, query, require_unforked
from nedbus_msgs import ANY, DEFAULT_TOPIC, PAYLOAD_SIZE, Address, Selection, decode, vehicle_name

from .closing import Finalizer
from .decoder import Decoder
from .discovery import find_layouts, find_services
from .housekeeping import Housekeeping
from .layout_lookup import LayoutLookup
from .publishing.publisher import Publisher
from .publishing.publisher_registry import LIVE, PublisherRegistry
from .publishing.query_server import QueryServer
from .receive_queue import ReceiveQueue
from .rejections import Rejections
from .sample import Mode, Sample
from .subscription import Subscription
from .thinned_queue import ThinnedQueue
from .thinned_subscriber import ThinnedSubscriber
from .vehicle_directory import VehicleDirectory
from .zenoh_subscriber import ZenohSubscriber


class Bus:
    """A connection to a router, from `connect`.

    Topics and vehicles are selected by name, instances by number; "*" and None stand for any; vehicle 7 is "7".
    All methods may be called from any thread; an invalid name raises AddressError, a closed bus ClosedError.
    """

    def __init__(self, session: Session, *, routers: Sequence[str], prefix: str, tls: Tls | None) -> None:
        self.prefix = prefix
        self.routers = tuple(routers)
        self._tls = tls
        self._session = session
        self._queries = QueryServer(session)
        self._housekeeping = Housekeeping()
        self._publishers = PublisherRegistry(session, self._queries, self._housekeeping, prefix=prefix, is_client=True)
        self._directory = VehicleDirectory(session, prefix=prefix)
        self._layouts = LayoutLookup(partial(find_layouts, session, prefix=prefix))
        self._subscribers: weakref.WeakSet[ZenohSubscriber] = weakref.WeakSet()
        close = partial(_close, session, self._queries, self._housekeeping, self._layouts, self._subscribers)
        self._finalizer = Finalizer(self, close)

    @property
    def connected(self) -> bool:
        """Whether there is a link to a router at this moment."""
        self._require_open()
        return bool(self._session.info.routers_zid())

    def subscribe(
        self,
        topic: str = DEFAULT_TOPIC,
        *,
        vehicle: str | int = ANY,
        instance: int | None = None,
        mode: Mode = "latest",
        max_rate: float | None = None,
    ) -> Subscription:
        """Subscribe, and iterate over what arrives: first the last message of each key, if there is one.

        Without a topic it is vehicle_local_position; "*" is all four topics.
        `mode="latest"`: the newest sample of each key wins when this reader is slower than the data.
        `mode="every"`: every sample in order; what the network lost is recovered from the publisher for about 20 s, and
        65,536 samples wait for a slow reader, which loses the oldest beyond.
        Either way `counts` has what was lost, dropped or invalid, and nobody else has to wait.
        `max_rate`: at most so many messages a second of each stream, thinned by its publisher, for links that carry no
        more. It sends 1, 2, 5, 10, 20, 50 or 100 a second, the greatest that is not above; below 1 the rest is thinned
        here. What is left out is neither lost nor dropped.

        Raises ConfigError for a `max_rate` that is no finite number above 0.
        """
        self._require_open()
        return self.subscribe_to(Selection(topic, vehicle_name(vehicle), instance), mode=mode, max_rate=max_rate)

    def subscribe_to(
        self, selection: Selection, *, mode: Mode = "latest", max_rate: float | None = None
    ) -> Subscription:
        """Subscribe to a selection of addresses, as `subscribe` does."""
        receive_queue = self._make_queue(selection, mode, max_rate)
        subscriber = self._open_subscriber(selection, receive_queue)
        return Subscription(subscriber, receive_queue, name=selection.key_expr(prefix=self.prefix), owner=self)

    def latest(
        self, topic: str = DEFAULT_TOPIC, *, vehicle: str | int = ANY, instance: int | None = None, timeout: float = 2.0
    ) -> list[Sample]:
        """Return the last sample of each key, sorted by address; `latency` is then its age.

        Without a topic it is vehicle_local_position; "*" is all four topics.
        It waits for the answers of all publishers, at most `timeout` seconds; what is invalid is left out and logged.
        The answer of a publisher is preferred to that of a storage, whose samples are `stored`.
        """
        self._require_open()
        key_expr = Selection(topic, vehicle_name(vehicle), instance).key_expr(prefix=self.prefix)
        decoder = self._make_decoder()
        newest: dict[Address, Sample] = {}
        answers = query(self._session, key_expr, timeout=timeout, newest=False)
        self._layouts.learn(raw.payload.to_bytes() for raw in answers if len(raw.payload) != PAYLOAD_SIZE)
        for raw in answers:
            for arrival in decoder.admit([raw]):
                sample = decoder.decode(arrival, decode)
                if sample is None:
                    continue
                sample.stored = raw.attachment is None or raw.attachment.to_bytes() != LIVE
                other = newest.get(sample.address)
                if other is None or _rank(sample) > _rank(other):
                    newest[sample.address] = sample
        return sorted(newest.values(), key=lambda sample: sample.address)

    def vehicles(self, *, timeout: float = 2.0) -> dict[str, list[Address]]:
        """Return the vehicles that are published now, and the addresses of each; `latest` has their messages.

        The first call asks, and waits at most `timeout` seconds; from then on the bus follows who comes and goes.
        """
        self._require_open()
        return self._directory.vehicles(timeout=timeout)

    def services(self, *, timeout: float = 2.0) -> list[dict[str, object]]:
        """Return the status of every nedbus service on this network, as it reports it."""
        self._require_open()
        return find_services(self._session, prefix=self.prefix, timeout=timeout)

    def rejections(self) -> Rejections:
        """Follow the reports of messages that services on this network reject from now on."""
        self._require_open()
        return Rejections(self._session, prefix=self.prefix, owner=self)

    def publisher(
        self,
        topic: str,
        *,
        vehicle: str | int,
        instance: int | None = None,
        lossless: bool = False,
        source: str | None = None,
    ) -> Publisher:
        """Return a publisher of one address; raise AddressInUseError if this bus has one already.

        The router knows it then: whoever subscribes from now on gets the last message, be there only one.
        `lossless` is for replays as fast as readers take them: while a reader of mode "every" has more than 2,000
        messages to read, `publish` waits for it, and sends 10 a second meanwhile; `close` waits until they have all.
        `source` is where the messages come from, for `sample.source`: 1 to 32 of a-z 0-9 _ -.
        """
        self._require_open()
        address = Address(vehicle_name(vehicle), topic, instance)
        publisher = self._publishers.publisher(address, lossless=lossless, source=source, owner=self)
        self._publishers.is_alive(address)  # what was declared before an answer came is known to whoever gave it
        return publisher

    def open_session(self, endpoint: str | None = None, *, timeout: float | None = 3.0) -> Session:
        """Open another Zenoh session at the same routers, or at another one; the caller closes it."""
        return open_client([endpoint] if endpoint else self.routers, timeout=timeout, tls=self._tls)

    def close(self) -> None:
        """Close the bus, its subscriptions and its publishers; a second call does nothing.

        Lossless publishers flush before; not so where a `with` block ends by an exception.
        """
        if self._finalizer.alive:
            with suppress(NedbusError):
                self._publishers.flush(each for each in self._publishers.publishers if each.lossless)
        self._finalizer.close_now()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exc: object, *_: object) -> None:
        if exc is None:
            self.close()
        else:
            self._finalizer.close_now()

    def _require_open(self) -> None:
        require_unforked()
        if not self._finalizer.alive:
            raise ClosedError

    def _make_queue(self, selection: Selection, mode: Mode, max_rate: float | None) -> ReceiveQueue:
        """Return the queue of a new subscription; AsyncBus uses it too."""
        self._require_open()
        decoder, name = self._make_decoder(), selection.key_expr(prefix=self.prefix)
        if max_rate is None:
            return ReceiveQueue(mode, decoder, name=name)
        return ThinnedQueue(mode, decoder, max_rate=max_rate, name=name)

    def _open_subscriber(self, selection: Selection, receive_queue: ReceiveQueue) -> ZenohSubscriber:
        """Open Zenoh's side of a subscription; AsyncBus does so in a thread."""
        self._require_open()
        if isinstance(receive_queue, ThinnedQueue):
            subscriber: ZenohSubscriber = ThinnedSubscriber(self._session, selection, receive_queue, prefix=self.prefix)
        else:
            subscriber = ZenohSubscriber(self._session, selection.key_expr(prefix=self.prefix), receive_queue)
        self._subscribers.add(subscriber)
        if not self._finalizer.alive:  # closed meanwhile, by another thread
            subscriber.close()
            raise ClosedError
        return subscriber

    def _make_decoder(self) -> Decoder:
        return Decoder(self._layouts, prefix=self.prefix)


def _rank(sample: Sample) -> tuple[bool, int]:
    """Order samples of one address: those of a publisher are above stored ones, later ones above earlier ones."""
    return not sample.stored, sample.sent or 0


def _close(
    session: Session,
    queries: QueryServer,
    housekeeping: Housekeeping,
    layouts: LayoutLookup,
    subscribers: weakref.WeakSet[ZenohSubscriber],
) -> None:
    with ExitStack() as closing:  # whatever fails, the rest is closed as well
        closing.callback(layouts.close)  # which ends with the session
        closing.callback(session.close)
        closing.callback(housekeeping.close)
        closing.callback(queries.close)
        for subscriber in list(subscribers):
            closing.callback(subscriber.close)
