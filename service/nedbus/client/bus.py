"""The blocking API: connect, subscribe, query, publish."""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, overload

from nedbus.errors import ArgumentError, ClosedError, NedbusError, NoDataError
from nedbus.samples import M2, M3, M_co, Mode, Query, Sample, Subscribe
from nedbus.settings import Settings, load_client_settings
from nedbus.transport import (
    Publishers,
    Session,
    Tls,
    VehicleDirectory,
    open_client,
    query,
    require_unforked,
    token_keys,
)
from nedbus_msgs import (
    ANY,
    Address,
    Definition,
    Message,
    Selection,
    VehicleLocalPosition,
    VehicleNames,
    prefix_of,
    topic_of,
    vehicle_name,
)

from .closing import Finalizer
from .discovery import ServiceStatus, Vehicles, find_reports, find_services
from .link import LinkCallback, LinkWatch
from .newest import Newest
from .publishing.publish_permission import PublishPermission
from .publishing.publisher import FLUSH_TIMEOUT, Publisher
from .publishing.publisher_registry import PublisherRegistry
from .publishing.query_server import QueryServer
from .receiving import (
    Decoder,
    Downsampled,
    Inbox,
    LayoutLookup,
    Receiver,
    Throttle,
    find_schemas,
    has_router,
)
from .rejections import Rejections
from .subscription import Subscription

if TYPE_CHECKING:
    from nedbus.event_history import EventHistory
    from nedbus.fusion import Fusion
    from nedbus.vehicle_events import AccountReport, Verdict


class Bus(AbstractContextManager["Bus"]):
    """A connection to a router, from `connect`.

    Topics are selected by message class or name, one or several; vehicles by name (7 means "7") or a list of names;
    instances by number. "*" matches any topic or vehicle, None any instance. The default is VehicleLocalPosition on
    vehicle_local_position.
    Thread-safe. Methods raise AddressError for an invalid name, and ClosedError once the bus is closed.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        timeout: float | None,
        tls: Tls | None = None,
        stop: threading.Event | None = None,
    ) -> None:
        self.prefix, self.routers = settings.prefix, settings.routers
        self._tls, prefix = tls or settings.tls, settings.prefix
        self._zenoh = session = open_client(self.routers, timeout=timeout, tls=self._tls, stop=stop)
        self._queries = QueryServer(session)
        permission = PublishPermission.of(session, self.routers, tls=self._tls, prefix=prefix)
        self._publishers = PublisherRegistry(
            session, self._queries, prefix=prefix, is_client=True, permission=permission
        )
        self._reopen = partial(open_client, self.routers, timeout=0.0, tls=self._tls)
        self._directory = VehicleDirectory.of_fleet(self._reopen, Selection(), prefix=prefix)
        self._layouts = LayoutLookup(
            partial(find_schemas, session=session, prefix=prefix),
            is_linked=partial(has_router, session),
        )
        self._receivers: weakref.WeakSet[Receiver] = weakref.WeakSet()
        self._links: list[LinkWatch] = []  # one, created by the first `on_link`
        self._links_lock = threading.Lock()
        # runs in reverse order; closing the session ends an open query for layouts
        closing = ExitStack()
        # not the registry: its publishers reference the bus
        heartbeats = self._publishers.heartbeats
        for close in (
            self._layouts.close,
            self._directory.close,
            session.close,
            heartbeats.close,
            self._queries.close,
        ):
            closing.callback(close)
        closing.callback(_close_all, self._receivers)
        closing.callback(_close_all, self._links)
        self._finalizer = Finalizer(self, closing.close)

    @property
    def closed(self) -> bool:
        """True once the bus is closed."""
        return not self._finalizer.alive

    @property
    def connected(self) -> bool:
        """True if the bus is connected to a router."""
        return has_router(self._session)

    @overload
    def subscribe(
        self, message: type[M_co] = ..., /, *, topic: str = ..., **options: Unpack[Subscribe]
    ) -> Subscription[M_co]: ...
    @overload
    def subscribe(
        self, message: type[M_co], other: type[M2], /, **options: Unpack[Subscribe]
    ) -> Subscription[M_co | M2]: ...
    @overload
    def subscribe(
        self, message: type[M_co], other: type[M2], third: type[M3], /, **options: Unpack[Subscribe]
    ) -> Subscription[M_co | M2 | M3]: ...
    @overload
    def subscribe(
        self, *messages: type[Message] | str, **options: Unpack[Subscribe]
    ) -> Subscription[Message]: ...
    def subscribe(
        self,
        *messages: type[Message] | str,
        topic: str | None = None,
        vehicle: VehicleNames = ANY,
        instance: int | None = None,
        mode: Mode = "latest",
        max_rate: float | None = None,
        limit: int | None = None,
    ) -> Subscription[Any]:
        """Return a subscription to iterate over, which starts with the last message of each key.

        `messages`: message classes such as VehicleAttitude, for typed samples of their first topic or, with one class,
        of `topic`, such as "estimator_attitude"; or names of topics; or "*" for all topics.
        `vehicle`: one or several; each pair of a vehicle and a topic is a subscription of Zenoh.
        `mode="latest"`: only the newest sample of each key, if the reader is slower than the data.
        `mode="every"`: all samples in order. Samples lost on the network are recovered from the publisher, which caches
        about 20 s of topics with a nominal rate, and of others 50 messages (services) or 400 (scripts).
        `limit`: unread samples kept for a slow reader, by default 65,536, or in mode "latest" the newest of 10,000
        keys, in both cases up to 64 MiB of payload; beyond that the oldest are dropped.
        In both modes `counts` reports lost, dropped and invalid samples. A slow reader delays lossless publishers only.
        `max_rate`: messages per second of each stream on average, downsampled by its publisher, for slow links.
        The publisher sends 1, 2, 5, 10, 20, 50 or 100 per second, the highest rate up to `max_rate`. If that is
        below 1, the reader downsamples further. Messages left out by downsampling count as neither lost nor dropped.

        Raises ArgumentError for an invalid `mode` or `limit`, if `max_rate` is not a finite number above 0, and for
        `topic` with several messages.
        """
        selection = select(messages, vehicle, instance, topic)
        inbox = self._make_inbox(selection, mode, max_rate, limit)
        return Subscription(self._open_receiver(inbox), inbox, owner=self)

    def newest(
        self,
        *messages: type[Message] | str,
        vehicle: VehicleNames = ANY,
        instance: int | None = None,
        max_rate: float | None = None,
    ) -> Newest:
        """Return a view of the newest message of each stream, for loops that run at their own rate.

        `view.update()` reads what has arrived; then `view.get(VehicleAttitude)` has the message, its `age`, and whether
        it is `updated` and its stream `alive`. It starts with the last message of each stream.
        Arguments and errors as in `subscribe`.
        """
        selection = select(messages, vehicle, instance)
        inbox = self._make_inbox(selection, "latest", max_rate, None)
        return Newest(self._open_receiver(inbox), inbox, selection.topics, owner=self)

    @overload
    def latest(
        self, message: type[M_co] = ..., /, *, topic: str = ..., **options: Unpack[Query]
    ) -> list[Sample[M_co]]: ...
    @overload
    def latest(
        self, message: type[M_co], other: type[M2], /, **options: Unpack[Query]
    ) -> list[Sample[M_co | M2]]: ...
    @overload
    def latest(
        self, *messages: type[Message] | str, **options: Unpack[Query]
    ) -> list[Sample[Message]]: ...
    def latest(
        self,
        *messages: type[Message] | str,
        topic: str | None = None,
        vehicle: VehicleNames = ANY,
        instance: int | None = None,
        timeout: float = 2.0,
    ) -> list[Sample[Any]]:
        """Query the last sample of each key, sorted by address; `latency` is a sample's age.

        Topics and vehicles as in `subscribe`.

        Waits up to `timeout` seconds for the replies of all publishers; invalid messages are logged and omitted.
        Beyond 10,000 replies or 64 MB, the vehicles that use most of these limits lose samples first.
        A sample from a storage has `stored` set; it is returned only if the publisher does not reply.
        """
        key_exprs = select(messages, vehicle, instance, topic).key_exprs(prefix=self.prefix)
        group_of = partial(_vehicle_of, f"{self.prefix}/")
        answers = query(self._session, *key_exprs, timeout=timeout, group_of=group_of)
        samples = list(Decoder(self._layouts, prefix=self.prefix).read(answers))
        samples.sort(key=lambda sample: (not sample.stored, sample.sent or 0))
        # the last sample of each address wins
        newest = {sample.address: sample for sample in samples}
        return [newest[address] for address in sorted(newest)]

    def vehicles(self, *, timeout: float = 2.0) -> Vehicles:
        """Return the published addresses by vehicle; use `latest` for their messages.

        The first call subscribes to the liveliness tokens of the publishers, and waits up to `timeout` seconds until
        the router has sent them. On timeout it returns the addresses received so far, with `complete` False, and the
        next call waits again.
        """
        publishers = self.publishers(timeout=timeout)
        vehicles = Vehicles()
        for address in sorted(publishers):
            vehicles.setdefault(address.vehicle, []).append(address)
        vehicles.complete = publishers.complete
        return vehicles

    def publishers(self, *, timeout: float = 2.0) -> Publishers:
        """Return the number of publishers of each address: more than one is a conflict. Waits like `vehicles`."""
        self._require_open()
        publishers = self._directory.publishers(timeout=timeout)
        publishers.complete = publishers.complete and self.connected
        return publishers

    def services(self, *, timeout: float = 2.0) -> list[ServiceStatus]:
        """Query the status of all nedbus services on this network."""
        return find_services(self._session, prefix=self.prefix, timeout=timeout)

    def accounts(self, *, within: float = 600.0, timeout: float = 2.0) -> list[AccountReport]:
        """Query the event reports of all nedbus services: events of the last `within` seconds, and vehicle states."""
        return find_reports(self._session, prefix=self.prefix, within=within, timeout=timeout)

    def other_prefixes(self, *, timeout: float = 1.0) -> list[str]:
        """Return the other prefixes under which vehicles are published on this network, sorted.

        For the case that no vehicle is found: a program with another prefix sees none of them.
        """
        keys = token_keys(self._session, "**/@alive/**", timeout=timeout)
        return sorted({prefix_of(key) for key in keys} - {"", self.prefix})

    def history(self, *, within: float = 86_400.0, timeout: float = 2.0) -> EventHistory:
        """Query the events of the last `within` seconds [s] and the vehicle states from all services, as one history.

        Event times are Unix times by the clocks of the services' hosts [s]. A service keeps up to 2,000 events.
        """
        from nedbus.event_history import history_of_services

        return history_of_services(self.accounts(within=within, timeout=timeout))

    def why(self, vehicle: str | int, *, at: str | None = None, timeout: float = 2.0) -> Verdict:
        """Return the verdict on a vehicle from the services' history of the last day: usable or not, and why.

        `at`: the time in question, as in `EventHistory.why`, by default now. `nedbus.why(bus)` has all vehicles.

        Raises NoDataError if no service has data on the vehicle within `timeout` seconds, ArgumentError for `at` if it
        is no time of this data.
        """
        name = vehicle_name(vehicle)
        history = self.history(timeout=timeout)
        if name not in history.vehicles:
            raise NoDataError(f"the event history of vehicle {name}, which services keep,", timeout)
        return history.why(name, at=at)

    def fusion(self, vehicle: str | int, *, duration: float = 2.0) -> Fusion:
        """Return whether PX4 uses the position that is sent into a vehicle, and why not, after `duration` seconds.

        The evidence is in topics of PX4's log stream, such as estimator_aid_src_ev_pos; `missing` lists what lacks.
        Raises NoDataError if no message of the vehicle arrives.
        """
        from nedbus.fusion import FUSION_TOPICS, FusionTracker

        name = vehicle_name(vehicle)
        tracker = FusionTracker()
        end = time.monotonic() + duration
        is_received = False
        with self.subscribe(*FUSION_TOPICS, vehicle=name, mode="every") as subscription:
            while (left := end - time.monotonic()) > 0:
                with suppress(NoDataError):
                    is_received = tracker.add_sample(subscription.receive(left)) or is_received
        if not is_received:
            raise NoDataError(f"{name}: topics {', '.join(FUSION_TOPICS)}", duration)
        positions = [
            position
            for service in self.services()
            for source in service.sources
            for position in source.positions
        ]
        return tracker.fusion(
            name, next((position for position in positions if position.vehicle == name), None)
        )

    def rejections(self) -> Rejections:
        """Subscribe to reports of the messages that services on this network reject."""
        return Rejections(self._session, prefix=self.prefix, owner=self)

    def publisher(
        self,
        message: type[Message] | str,
        *,
        topic: str | None = None,
        vehicle: str | int,
        instance: int | None = None,
        lossless: bool = False,
        source: str | None = None,
        definition: Definition[Any] | None = None,
    ) -> Publisher:
        """Return a publisher for one address; `message` and `topic` as in `subscribe`, but for one topic.

        Returns once the router has processed the declarations, so later subscribers receive the last message.
        `lossless`: flow control for replays at the readers' pace. `publish` slows down to 10 messages per second
        while a reader in mode "every" has more than 2,000 unread messages; `close` waits until the readers have all
        messages.
        `source`: the origin of the messages, shown in `sample.source`; 1 to 32 of the characters a-z 0-9 _ -.
        `definition`: the definition of a custom message, from `define_msg`; readers query it from the publisher.

        Raises AddressInUseError if this bus already has a publisher for the address, RefusedError if the access rules
        of the router do not allow this client's certificate to publish the vehicle.
        """
        self._require_open()
        address = Address(vehicle_name(vehicle), topic_of(message, topic), instance)
        if self._publishers.permission is not None:
            self._publishers.permission.require(address.vehicle)
        if definition is None and not isinstance(message, str):
            definition = message.DEFINITION
        publisher = self._publishers.publisher(
            address, definition, lossless=lossless, source=source, owner=self
        )
        try:
            # This key matches nothing: a session that queries its own token sometimes lists it forever (Zenoh 1.10).
            # usually milliseconds
            token_keys(self._zenoh, f"{self.prefix}/{address.vehicle}/@alive", timeout=2.0)
        except BaseException:  # such as Ctrl-C
            publisher.close(timeout=0.0)
            raise
        return publisher

    def on_link(self, call: Callable[[bool], object]) -> LinkCallback:
        """Call a function with False when the link to the router is lost, and with True when it is up again.

        The calls are made on a separate thread, in order, until the bus, or the object that this method returns, is
        closed.

        Raises ArgumentError if `call` is not a function.
        """
        require_callable(call)
        session = self._session
        with self._links_lock:
            if not self._links:
                self._links.append(LinkWatch(session))
        return self._links[0].add(call)

    def open_session(self, endpoint: str | None = None, *, timeout: float | None = 3.0) -> Session:
        """Open another Zenoh session, to the same routers or to `endpoint`; the caller closes it."""
        endpoints = self.routers
        if endpoint:
            endpoints = (endpoint,)
        return open_client(endpoints, timeout=timeout, tls=self._tls)

    def close(self, timeout: float = FLUSH_TIMEOUT) -> None:
        """Close the bus with its subscriptions and publishers. Idempotent.

        Lossless publishers are flushed first, for at most `timeout` seconds, unless a `with` block ends with an
        exception. Ctrl-C ends the wait and closes the bus.
        """
        try:
            if not self.closed and timeout > 0:
                lossless = [
                    publisher
                    for publisher in tuple(self._publishers.publishers.values())
                    if publisher.lossless
                ]
                with suppress(NedbusError):
                    self._publishers.flush(lossless, timeout=timeout)
        finally:
            self._finalizer.close_now()

    def __exit__(self, exc: object, *_: object) -> None:
        timeout = 0.0
        if exc is None:
            timeout = FLUSH_TIMEOUT
        self.close(timeout)

    @property
    def _session(self) -> Session:
        self._require_open()
        return self._zenoh

    def _network(self) -> tuple[bool, Publishers]:
        """Return whether there is a link, and the publishers known so far; used by the views of the newest messages."""
        return self.connected, self.publishers(timeout=0.0)

    def _require_open(self) -> None:
        require_unforked()
        if self.closed:
            raise ClosedError

    def _make_inbox(
        self, selection: Selection, mode: Mode, max_rate: float | None, limit: int | None
    ) -> Inbox:
        """Return the inbox of a new subscription; also used by AsyncBus."""
        self._require_open()
        decoder = Decoder(self._layouts, prefix=self.prefix)
        if max_rate is None:
            return Inbox(
                mode, decoder, key_exprs=selection.key_exprs(prefix=self.prefix), limit=limit
            )
        throttle = Throttle(max_rate, selection, prefix=self.prefix)
        return Inbox(mode, decoder, key_exprs=throttle.key_exprs, limit=limit, throttle=throttle)

    def _open_receiver(self, inbox: Inbox) -> Receiver:
        """Open the receiver of a subscription; AsyncBus calls this in a thread."""
        session = self._session
        downsampled = None
        if inbox.throttle is not None:
            downsampled = Downsampled(
                session, inbox, inbox.throttle, prefix=self.prefix, open_session=self._reopen
            )
        receiver = Receiver(session, inbox, downsampled)
        self._receivers.add(receiver)
        if self.closed:  # closed by another thread in the meantime
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
    """Connect to a router and return a bus. Use it as a context manager; it also closes when it is garbage-collected.

    `endpoint`: a Zenoh endpoint such as tcp/192.168.1.5:7447, or several; the first one that answers is used.
    The default is NEDBUS_CONNECT, then `connect` in nedbus.toml, then the router of `nedbus serve` on this host.
    `timeout`: seconds to wait for a router; None waits until Ctrl-C. A broken link is reconnected automatically.
    `tls`: files for tls/ endpoints, by default from the settings. `config`: a file to read instead of nedbus.toml.
    With `endpoint`, only `prefix` and the TLS files are read from the file, unless passed as arguments.

    Raises ConnectError if no router answers, ConfigError for an invalid setting.
    """
    return Bus(
        load_client_settings(config, connect=endpoint, prefix=prefix, tls=tls),
        timeout=timeout,
        tls=tls,
    )


def require_callable(call: object) -> None:
    """Raise ArgumentError unless `call` can be called."""
    if not callable(call):
        raise ArgumentError("call", call, "a function that takes True or False")


def select(
    messages: Sequence[type[Message] | str],
    vehicle: VehicleNames,
    instance: int | None,
    topic: str | None = None,
) -> Selection:
    """Return the selection of the arguments of `subscribe`; raise ArgumentError for `topic` with several messages."""
    if topic is not None and len(messages) > 1:
        raise ArgumentError(
            "topic", topic, "None with several messages: pass the names of the topics instead"
        )
    topics = [topic_of(message, topic) for message in messages or (VehicleLocalPosition,)]
    return Selection(topics, vehicle, instance)


def _vehicle_of(start: str, key: str) -> str:
    return key.removeprefix(start).partition("/")[0]


def _close_all(opened: Iterable[Receiver | LinkWatch]) -> None:
    with ExitStack() as closing:  # closes all, even if one fails
        for resource in list(opened):
            closing.callback(resource.close)
