"""The bus as scripts see it: connect, subscribe, ask, publish; sync and async with the same names."""

from __future__ import annotations

import asyncio
import json
import logging
import weakref
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final, Self

from nedbus_msgs import (
    ANY,
    Address,
    AddressError,
    address_of_alive_key,
    alive_selection,
    schema_key,
    selection,
    status_key,
)

from .errors import ClosedError, NedbusError
from .intake import Intake, Mode, Sample
from .publisher import Outbox, Publisher
from .session import RawSample, Session, Tls, alive_keys, open_client, query
from .settings import load_settings
from .subscriber import AsyncSubscription, Feed, Subscription

_log = logging.getLogger(__name__)
_FIELDS: Final = 256  # fields that a layout may have
_ANSWER_LIMIT: Final = 2**18  # bytes of an answer that is read: nobody on the network is trusted


def connect(
    endpoint: str | Sequence[str] | None = None,
    *,
    timeout: float = 3.0,
    prefix: str | None = None,
    tls_ca: str | Path | None = None,
    tls_certificate: str | Path | None = None,
    tls_key: str | Path | None = None,
    config: str | Path | None = None,
) -> Bus:
    """Connect to a router and return a bus; use it as a context manager, or forget it: it closes itself.

    `endpoint` is Zenoh's, such as tcp/192.168.1.5:7447, or several of which the first that answers is taken; the
    default is NEDBUS_CONNECT, `connect` in nedbus.toml, else tcp/127.0.0.1:7447, where `nedbus serve` listens.
    `timeout` is how long to try, in seconds; later breaks of the link heal by themselves.
    The three `tls_` files are for tls/ endpoints: the authority to trust, and who this client is.
    `config` names a file instead of nedbus.toml.

    Raises ConnectError when nothing answers, ConfigError for a setting that cannot be.
    """
    settings = load_settings(
        config, connect=endpoint, prefix=prefix, tls_ca=tls_ca, tls_certificate=tls_certificate, tls_key=tls_key
    )
    routers, tls = settings.routers, settings.tls
    return Bus(open_client(routers, timeout=timeout, tls=tls), routers=routers, prefix=settings.prefix, tls=tls)


def connect_async(
    endpoint: str | Sequence[str] | None = None,
    *,
    timeout: float = 3.0,
    prefix: str | None = None,
    tls_ca: str | Path | None = None,
    tls_certificate: str | Path | None = None,
    tls_key: str | Path | None = None,
    config: str | Path | None = None,
) -> AsyncBus:
    """Return a bus for asyncio, to be opened with `async with`; arguments and errors are those of `connect`."""
    return AsyncBus(
        lambda: connect(
            endpoint,
            timeout=timeout,
            prefix=prefix,
            tls_ca=tls_ca,
            tls_certificate=tls_certificate,
            tls_key=tls_key,
            config=config,
        )
    )


class Bus:
    """A connection to a router, from `connect`.

    Topics, vehicles and instances are chosen by name; "*" and None mean any.
    All methods may be called from any thread; a wrong name raises AddressError, a closed bus ClosedError.
    """

    def __init__(self, session: Session, *, routers: Sequence[str], prefix: str, tls: Tls | None) -> None:
        self.prefix = prefix
        self.routers = tuple(routers)
        self._tls = tls
        self._session = session
        self._outbox = Outbox(session, prefix=prefix)
        self._feeds: weakref.WeakSet[Feed] = weakref.WeakSet()
        self._finalizer = weakref.finalize(self, _close, session, self._outbox, self._feeds)

    @property
    def connected(self) -> bool:
        """Whether there is a link to a router at this moment."""
        self._require_open()
        return bool(self._session.info.routers_zid())

    def subscribe(
        self, topic: str = ANY, *, vehicle: str = ANY, instance: int | None = None, mode: Mode = "latest"
    ) -> Subscription:
        """Subscribe, and iterate over what comes: first the last value of each key, if there is one.

        `mode="latest"`: the newest sample of each key wins when this reader is slower than the data.
        `mode="every"`: every sample in order; what the network lost is recovered from the publisher for about 20 s.
        Either way `counts` tells what was lost, dropped or invalid.

        Raises ConnectError when mode "every" cannot open its session, because the router is away at this moment.
        """
        self._require_open()
        key_expr = selection(topic, vehicle=vehicle, instance=instance, prefix=self.prefix)
        intake = Intake(mode, prefix=self.prefix, find_layout=self._find_layout)
        return Subscription(self._open_feed(key_expr, intake), intake, name=key_expr)

    def latest(
        self, topic: str = ANY, *, vehicle: str = ANY, instance: int | None = None, timeout: float = 2.0
    ) -> list[Sample]:
        """Return the last sample of each key, sorted by address; `latency` is then its age.

        It waits for the answers of all publishers, at most `timeout` seconds; what is invalid is left out and logged.
        """
        self._require_open()
        key_expr = selection(topic, vehicle=vehicle, instance=instance, prefix=self.prefix)
        intake = Intake("latest", prefix=self.prefix, find_layout=self._find_layout)
        samples = (intake.read(raw) for raw in query(self._session, key_expr, timeout=timeout))
        return sorted((sample for sample in samples if sample is not None), key=lambda sample: sample.address)

    def vehicles(self, *, timeout: float = 2.0) -> dict[str, list[Address]]:
        """Return the vehicles that are published now, and the addresses of each; what moves shows in `latest`."""
        self._require_open()
        found: dict[str, list[Address]] = {}
        keys = alive_keys(self._session, alive_selection(prefix=self.prefix), timeout=timeout)
        for key in keys:
            try:
                address = address_of_alive_key(key, prefix=self.prefix)
            except AddressError as exc:
                _log.warning("%s: %s", key, exc)
                continue
            found.setdefault(address.vehicle, []).append(address)
        return found

    def publisher(
        self,
        topic: str,
        *,
        vehicle: str,
        instance: int | None = None,
        lossless: bool = False,
        source: str | None = None,
    ) -> Publisher:
        """Return a publisher of one address; raise AddressInUseError if this bus has one already.

        `lossless` is for replays as fast as readers take them: `publish` then waits for slow readers, `close` until
        they have all of it, and a stuck one holds up all others for 5 s, until it is cut off.
        `source` says where the messages come from, for `sample.source`: 1 to 32 of a-z 0-9 _ -.
        """
        self._require_open()
        return self._outbox.publisher(Address(vehicle, topic, instance), lossless=lossless, source=source, owner=self)

    def join(self, endpoint: str | None = None, *, timeout: float = 3.0) -> Session:
        """Return a Zenoh session of its own at the same routers, or at another one; whoever asks for it closes it."""
        return open_client([endpoint] if endpoint else self.routers, timeout=timeout, tls=self._tls)

    def services(self, *, timeout: float = 2.0) -> list[dict[str, object]]:
        """Return the status of every nedbus service on this network, as it tells it."""
        self._require_open()
        answers = query(self._session, status_key(ANY, prefix=self.prefix), timeout=timeout)
        return [status for raw in answers if isinstance(status := _read_json(raw), dict)]

    def close(self) -> None:
        """Close the bus, its subscriptions and its publishers; a second call does nothing.

        Publishers that lose nothing flush before; not so where a `with` block ends by an exception.
        """
        if self._finalizer.alive:
            with suppress(NedbusError):
                self._outbox.flush(publisher for publisher in self._outbox.publishers if publisher.lossless)
        self._finalizer()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exc: object, *_: object) -> None:
        if exc is None:
            self.close()
        else:
            self._finalizer()

    def _require_open(self) -> None:
        if not self._finalizer.alive:
            raise ClosedError

    def _open_feed(self, key_expr: str, intake: Intake) -> Feed:
        self._require_open()
        if intake.newest_only:
            feed = Feed(self._session, key_expr, intake)
        else:
            own = self.join()
            try:
                feed = Feed(own, key_expr, intake)
            except NedbusError:
                own.close()
                raise
        self._feeds.add(feed)
        if not self._finalizer.alive:  # closed meanwhile, by another thread
            feed.close()
            raise ClosedError
        return feed

    def _find_layout(self, number: int) -> Sequence[str] | None:
        """Ask the publishers for the field names of a layout; None if none knows it."""
        for raw in query(self._session, schema_key(prefix=self.prefix), timeout=0.5, newest=False):
            content = _read_json(raw)
            layouts = content.get("layouts") if isinstance(content, dict) else None
            for layout in layouts if isinstance(layouts, list) else ():
                names = _field_names(layout, number)
                if names is not None:
                    return names
        return None


class AsyncBus:
    """The twin of Bus for asyncio, from `connect_async`: the same methods, awaited where they wait."""

    def __init__(self, open_bus: Callable[[], Bus]) -> None:
        self._open_bus = open_bus
        self._bus: Bus | None = None

    @property
    def connected(self) -> bool:
        """Whether there is a link to a router at this moment."""
        return self._opened().connected

    def subscribe(
        self, topic: str = ANY, *, vehicle: str = ANY, instance: int | None = None, mode: Mode = "latest"
    ) -> AsyncSubscription:
        """Subscribe as `Bus.subscribe` does, for `async for`; it opens when it is first waited on."""
        bus = self._opened()
        bus._require_open()
        key_expr = selection(topic, vehicle=vehicle, instance=instance, prefix=bus.prefix)
        intake = Intake(mode, prefix=bus.prefix, find_layout=bus._find_layout)
        return AsyncSubscription(lambda: bus._open_feed(key_expr, intake), intake, name=key_expr)

    async def latest(
        self, topic: str = ANY, *, vehicle: str = ANY, instance: int | None = None, timeout: float = 2.0
    ) -> list[Sample]:
        """Return the last sample of each key as `Bus.latest` does."""
        bus = self._opened()
        return await asyncio.to_thread(bus.latest, topic, vehicle=vehicle, instance=instance, timeout=timeout)

    async def vehicles(self, *, timeout: float = 2.0) -> dict[str, list[Address]]:
        """Return the vehicles that are published now as `Bus.vehicles` does."""
        return await asyncio.to_thread(self._opened().vehicles, timeout=timeout)

    async def publisher(
        self,
        topic: str,
        *,
        vehicle: str,
        instance: int | None = None,
        lossless: bool = False,
        source: str | None = None,
    ) -> Publisher:
        """Return a publisher as `Bus.publisher` does; its `publish` waits only if it is `lossless`."""
        bus = self._opened()
        return await asyncio.to_thread(
            bus.publisher, topic, vehicle=vehicle, instance=instance, lossless=lossless, source=source
        )

    async def services(self, *, timeout: float = 2.0) -> list[dict[str, object]]:
        """Return the status of every nedbus service as `Bus.services` does."""
        return await asyncio.to_thread(self._opened().services, timeout=timeout)

    async def close(self) -> None:
        """Close the bus as `Bus.close` does."""
        if self._bus is not None:
            await asyncio.to_thread(self._bus.close)

    async def __aenter__(self) -> Self:
        self._bus = await asyncio.to_thread(self._open_bus)
        return self

    async def __aexit__(self, *exc: object) -> None:
        if self._bus is not None:
            await asyncio.to_thread(self._bus.__exit__, *exc)

    def _opened(self) -> Bus:
        if self._bus is None:
            raise ClosedError
        return self._bus


def _close(session: Session, outbox: Outbox, feeds: weakref.WeakSet[Feed]) -> None:
    with ExitStack() as closing:  # whatever fails, the rest is closed as well
        closing.callback(session.close)
        closing.callback(outbox.close)
        for feed in list(feeds):
            closing.callback(feed.close)


def _read_json(raw: RawSample) -> object:
    if len(raw.payload) > _ANSWER_LIMIT:
        return None
    try:
        return json.loads(raw.payload.to_bytes())
    except (ValueError, RecursionError):
        _log.warning("%r: an answer that is no JSON", str(raw.key_expr))
        return None


def _field_names(layout: object, number: int) -> Sequence[str] | None:
    """Return the field names of this layout, if it is the one with that number and well formed."""
    if not isinstance(layout, dict) or layout.get("wire") != number or not isinstance(layout.get("fields"), list):
        return None
    named = [field.get("name") for field in layout["fields"] if isinstance(field, dict)]
    names = [name for name in named if isinstance(name, str)]
    return names if len(set(names)) == len(layout["fields"]) <= _FIELDS else None
