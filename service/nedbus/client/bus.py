"""The bus as scripts see it: connect, subscribe, ask, publish; blocking."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any, Self

from nedbus.errors import ClosedError, NedbusError
from nedbus.events import AccountReport
from nedbus.settings import Settings, load_settings
from nedbus.transport import Session, Tls, open_client, query, require_unforked
from nedbus_msgs import ANY, DEFAULT_TOPIC, Address, Selection, vehicle_name

from .by_topic import by_topic, last
from .closing import Finalizer
from .discovery import Rejections, ServiceStatus, VehicleDirectory, find_accounts, find_schemas, find_services
from .housekeeping import Housekeeping
from .protocol import LIVE
from .publishing.publisher import Publisher
from .publishing.publisher_registry import PublisherRegistry
from .publishing.query_server import QueryServer
from .receiving import Decoder, LayoutLookup, MaxRateQueue, MaxRateReceiver, PendingQueue, Receiver
from .sample import Mode, Sample
from .subscription import Subscription


class Bus:
    """A connection to a router, from `connect`.

    Topics and vehicles are selected by name, instances by number; "*" and None stand for any; vehicle 7 is "7".
    Without a topic it is vehicle_local_position.
    All methods may be called from any thread; an invalid name raises AddressError, a closed bus ClosedError.
    """

    def __init__(self, session: Session, *, routers: Sequence[str], prefix: str, tls: Tls | None) -> None:
        self.prefix = prefix
        self.routers = tuple(routers)
        self._tls = tls
        self._zenoh = session
        self._housekeeping = Housekeeping()
        self._queries = QueryServer(session)
        self._publishers = PublisherRegistry(session, self._queries, self._housekeeping, prefix=prefix, is_client=True)
        self._directory = VehicleDirectory(prefix=prefix)
        self._layouts = LayoutLookup(partial(find_schemas, session=session, prefix=prefix))
        self._receivers: weakref.WeakSet[Receiver] = weakref.WeakSet()
        closing = ExitStack()  # the last one first; an open query for layouts ends with the session
        for close in (self._layouts.close, session.close, self._housekeeping.close, self._queries.close):
            closing.callback(close)
        closing.callback(_close_all, self._receivers)
        self._finalizer = Finalizer(self, closing.close)

    @property
    def connected(self) -> bool:
        """True while there is a link to a router."""
        return bool(self._session.info.routers_zid())

    @by_topic
    def subscribe(
        self,
        topic: str = DEFAULT_TOPIC,
        *,
        vehicle: str | int = ANY,
        instance: int | None = None,
        mode: Mode = "latest",
        max_rate: float | None = None,
    ) -> Subscription[Any]:
        """Subscribe, and iterate over what arrives: first the last message of each key, if there is one.

        The messages are those of the topic: a VehicleAttitude of "vehicle_attitude"; of "*" they are of all kinds.
        `mode="latest"`: the newest sample of each key wins when this reader is slower than the data.
        `mode="every"`: every sample in order; what the network lost is recovered from the publisher for about 20 s, and
        65,536 samples wait for a slow reader, which loses the oldest beyond.
        Either way `counts` has what was lost, dropped or invalid, and no other reader has to wait.
        `max_rate`: the messages a second of each stream at most, downsampled by its publisher, for slow links.
        The publisher sends 1, 2, 5, 10, 20, 50 or 100 a second, the greatest not above; below 1 this reader thins them
        further. Messages left out are neither lost nor dropped.

        Raises ConfigError for a `max_rate` that is no finite number above 0.
        """
        return self.subscribe_to(Selection(topic, vehicle_name(vehicle), instance), mode=mode, max_rate=max_rate)

    def subscribe_to(
        self, selection: Selection, *, mode: Mode = "latest", max_rate: float | None = None
    ) -> Subscription[Any]:
        """Subscribe to a selection of addresses, as `subscribe` does."""
        pending_queue = self._make_queue(selection, mode, max_rate)
        receiver = self._open_receiver(selection, pending_queue)
        return Subscription(receiver, pending_queue, name=selection.key_expr(prefix=self.prefix), owner=self)

    @last
    def latest(
        self, topic: str = DEFAULT_TOPIC, *, vehicle: str | int = ANY, instance: int | None = None, timeout: float = 2.0
    ) -> list[Sample[Any]]:
        """Return the last sample of each key, sorted by address; `latency` is then its age.

        It waits for the answers of all publishers, at most `timeout` seconds; invalid messages are left out and logged.
        The answer of a publisher is preferred to that of a storage, whose samples are `stored`.
        """
        key_expr = Selection(topic, vehicle_name(vehicle), instance).key_expr(prefix=self.prefix)
        decoder = Decoder(self._layouts, prefix=self.prefix)
        samples: list[Sample[Any]] = []
        answers = query(self._session, key_expr, timeout=timeout, newest=False)
        decoder.learn(answers)
        for raw in answers:
            for arrival in decoder.admit([raw]):
                sample = decoder.decode(arrival, rows=False)
                if sample is not None:
                    sample.stored = raw.attachment is None or raw.attachment.to_bytes() != LIVE
                    samples.append(sample)
        samples.sort(key=lambda sample: (not sample.stored, sample.sent or 0))  # the last one of each address counts
        newest = {sample.address: sample for sample in samples}
        return [newest[address] for address in sorted(newest)]

    def vehicles(self, *, timeout: float = 2.0) -> dict[str, list[Address]]:
        """Return the vehicles that are published now, and the addresses of each; `latest` has their messages.

        The first call asks, and waits at most `timeout` seconds; from then on the bus follows their liveliness tokens.
        """
        return self._directory.vehicles(self._session, timeout=timeout)

    def services(self, *, timeout: float = 2.0) -> list[ServiceStatus]:
        """Return the status of every nedbus service on this network, as it reports it."""
        return find_services(self._session, prefix=self.prefix, timeout=timeout)

    def accounts(self, *, within: float = 600.0, timeout: float = 2.0) -> list[AccountReport]:
        """Return the account of each nedbus service: events of the last `within` seconds, states of vehicles."""
        return find_accounts(self._session, prefix=self.prefix, within=within, timeout=timeout)

    def rejections(self) -> Rejections:
        """Follow the reports of messages that services on this network reject from now on."""
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

        The router knows it then: a reader that subscribes from now on gets the last message, be there only one.
        `lossless` is for replays as fast as readers take them: while a reader of mode "every" has more than 2,000
        messages to read, `publish` waits for it, and sends 10 a second meanwhile; `close` waits until they have all.
        `source` is where the messages come from, for `sample.source`: 1 to 32 of a-z 0-9 _ -.
        """
        self._require_open()
        address = Address(vehicle_name(vehicle), topic, instance)
        publisher = self._publishers.publisher(address, lossless=lossless, source=source, owner=self)
        self._publishers.is_alive(address)  # a router that answers knows all earlier declarations
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

    @property
    def _session(self) -> Session:
        self._require_open()
        return self._zenoh

    def _require_open(self) -> None:
        require_unforked()
        if not self._finalizer.alive:
            raise ClosedError

    def _make_queue(self, selection: Selection, mode: Mode, max_rate: float | None) -> PendingQueue:
        """Return the queue of a new subscription; AsyncBus uses it too."""
        self._require_open()
        decoder, name = Decoder(self._layouts, prefix=self.prefix), selection.key_expr(prefix=self.prefix)
        if max_rate is None:
            return PendingQueue(mode, decoder, name=name)
        return MaxRateQueue(mode, decoder, max_rate=max_rate, name=name)

    def _open_receiver(self, selection: Selection, pending_queue: PendingQueue) -> Receiver:
        """Open Zenoh's side of a subscription; AsyncBus does so in a thread."""
        session, prefix, housekeeping = self._session, self.prefix, self._housekeeping
        receiver: Receiver
        if isinstance(pending_queue, MaxRateQueue):
            receiver = MaxRateReceiver(session, selection, pending_queue, prefix=prefix, housekeeping=housekeeping)
        else:
            receiver = Receiver(session, selection.key_expr(prefix=prefix), pending_queue, housekeeping=housekeeping)
        self._receivers.add(receiver)
        if not self._finalizer.alive:  # closed meanwhile, by another thread
            receiver.close()
            raise ClosedError
        return receiver


def connect(
    endpoint: str | Sequence[str] | None = None,
    *,
    timeout: float | None = 3.0,
    prefix: str | None = None,
    tls: Tls | None = None,
    config: str | Path | None = None,
) -> Bus:
    """Connect to a router and return a bus; use it as a context manager, or drop it: it closes itself.

    `endpoint` is Zenoh's, such as tcp/192.168.1.5:7447, or several of which the first that answers is taken.
    Without it, NEDBUS_CONNECT or `connect` in nedbus.toml decides, else it is the router of this host's `nedbus serve`.
    `timeout` is how long to try [s]; None waits until Ctrl-C. Later breaks of the link are reconnected by themselves.
    `tls` is for tls/ endpoints; without it, the settings decide. `config` names a file instead of nedbus.toml.

    Raises ConnectError when nothing answers, ConfigError for an invalid setting.
    """
    return connect_with(load_settings(config, connect=endpoint, prefix=prefix), timeout=timeout, tls=tls)


def connect_with(
    settings: Settings, *, timeout: float | None, tls: Tls | None = None, stop: threading.Event | None = None
) -> Bus:
    """Connect as settings say, with `tls` in place of theirs if it is given; errors are those of `connect`.

    Setting `stop` ends the wait for a router, with ConnectError.
    """
    tls = tls or settings.tls
    session = open_client(settings.routers, timeout=timeout, tls=tls, stop=stop)
    return Bus(session, routers=settings.routers, prefix=settings.prefix, tls=tls)


def _close_all(receivers: Iterable[Receiver]) -> None:
    with ExitStack() as closing:  # if one fails, the others are closed as well
        for receiver in list(receivers):
            closing.callback(receiver.close)
