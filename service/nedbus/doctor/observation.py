"""Observation of a network for a few seconds: services, tokens, messages and routers, which the checks evaluate."""

import math
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, TypeVar

import zenoh

from nedbus import Bus, Newest, Session, clock, limits
from nedbus.health import (
    AccountReport,
    Publishers,
    RouterState,
    ServiceStatus,
    SourceStatus,
    WriteVerdict,
    query_routers,
)
from nedbus.rmw_zenoh import (
    PublisherToken,
    px4_publishers_key_expr,
    token_keys,
    translate_zenoh_errors,
)
from nedbus.timings import TIMINGS
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT_TOPIC, Address

T = TypeVar("T")

_POLL: Final = 0.02  # s; also the error of measured delays
_QUERY_TIMEOUT: Final = 1.0  # s
_LIST_TIMEOUT: Final = 4.0  # s for the router to list all streams
_RING: Final = 16_384  # samples buffered per subscription


@dataclass(slots=True)
class Observation:
    """The network as seen by this client, and the scope of the examination.

    `version`: version of this nedbus. `vehicle`: vehicle to check, None for all; `verdict`: its write permission.
    `services`: status of each service; their clocks were read at `asked` +- `error` on this host's clock [Unix, s].
    `alive`: number of publishers by address, from liveliness tokens.
    `ages`: age of the last message by address at the end of the observation [s]; None without a timestamp.
    `delays`: minimum latency by address with messages, from the clocks of both hosts [s]; None without timestamps.
    `errors`: first decoding error by address. `listened`: duration of the observation [s].
    `elsewhere`: nedbus keys under other prefixes. `ros2`: publishers of ROS 2 topics.
    `routers`: routers that disclose their sessions. `accounts`: event reports of services.
    """

    prefix: str
    version: str
    vehicle: str | None
    verdict: WriteVerdict | None = None
    services: list[ServiceStatus] = field(default_factory=list)
    asked: float = 0.0
    error: float = 0.0
    accounts: list[AccountReport] = field(default_factory=list)
    alive: Publishers = field(default_factory=Publishers)
    ages: dict[Address, float | None] = field(default_factory=dict)
    delays: dict[Address, float | None] = field(default_factory=dict)
    errors: dict[Address, str] = field(default_factory=dict)
    elsewhere: set[str] = field(default_factory=set)
    ros2: list[PublisherToken] = field(default_factory=list)
    routers: list[RouterState] = field(default_factory=list)
    listened: float = 0.0

    @property
    def sources(self) -> list[SourceStatus]:
        """The sources of all services."""
        return [source for service in self.services for source in service.sources]

    def observe(self, bus: Bus, session: Session) -> None:
        """Send the queries, and receive messages for at least 3 s; `session`: that of the bus."""
        start = time.monotonic()
        newest = bus.newest(ANY)
        take_others = _subscribe(session, f"**/{DEFAULT_TOPIC}/**")
        self._query(bus, session)
        tokens = token_keys(session, "**/@alive/**", timeout=_QUERY_TIMEOUT)
        own = f"{self.prefix}/"
        self.elsewhere = {key for key in tokens if not key.startswith(("@", own))}
        self._add(newest)
        self.delays = dict.fromkeys(self.delays)  # messages buffered during the queries seem late
        end = max(start + TIMINGS.listen, time.monotonic() + TIMINGS.min_listen)
        while time.monotonic() < end:
            time.sleep(_POLL)
            self._add(newest)
            for sample in take_others():
                key = str(sample.key_expr)
                if not key.startswith(own):
                    _add_key(self.elsewhere, key)
        for address, last in islice(newest.items(), limits.EXAMINED_NAMES):
            if math.isfinite(last.age):
                self.ages[address] = last.age
            else:
                self.ages[address] = None
        self.listened = time.monotonic() - start

    def _query(self, bus: Bus, session: Session) -> None:
        """Ask routers, services and the router's list of publishers."""
        self.routers = query_routers(session, timeout=_QUERY_TIMEOUT)
        before = clock.utc()
        services = bus.services(timeout=_QUERY_TIMEOUT)
        after = clock.utc()
        self.services = services[: limits.EXAMINED_NAMES]
        self.asked = (before + after) / 2
        self.error = (after - before) / 2
        self.accounts = bus.accounts(within=0.0, timeout=_QUERY_TIMEOUT)
        self.alive = bus.publishers(timeout=_LIST_TIMEOUT)
        tokens = token_keys(session, px4_publishers_key_expr(None), timeout=_QUERY_TIMEOUT)
        for token in _parse_each(PublisherToken.parse, tokens):
            if not token.node.startswith("nedbus_"):  # those of nedbus's bridges
                self.ros2.append(token)

    def _add(self, newest: Newest) -> None:
        """Add the messages since the last call: the delay of each stream, and errors."""
        for last in newest.update():
            sample = last.sample
            address = sample.address
            is_known = address in self.delays
            if sample.retained or not (is_known or len(self.delays) < limits.EXAMINED_NAMES):
                continue
            delay = self.delays.get(address)
            if delay is None or (sample.latency is not None and sample.latency < delay):
                delay = sample.latency
            self.delays[address] = delay
        self.errors = dict[Address, str]()
        for address, reason in newest.invalid.items():
            self.delays.setdefault(address, None)
            if address.topic in BY_TOPIC:
                self.errors[address] = reason


def _add_key(keys: set[str], key: str) -> None:
    """Add the key of a message of any prefix, unless it is too long, or there are too many."""
    has_room = len(keys) < limits.EXAMINED_NAMES and len(key) <= limits.PEER_TEXT
    if has_room and key.endswith(f"/{DEFAULT_TOPIC}"):
        keys.add(key)


def _subscribe(session: Session, key_expr: str) -> Callable[[], Iterable[zenoh.Sample]]:
    """Return a function that drains up to one full ring of samples; deleting it ends the subscription."""
    with translate_zenoh_errors():
        subscriber = session.declare_subscriber(key_expr, zenoh.handlers.RingChannel(_RING))
    return lambda: islice(iter(subscriber.handler.try_recv, None), _RING)


def _parse_each(parse: Callable[[str], T], keys: Iterable[str]) -> list[T]:
    parsed = []
    for key in keys:
        with suppress(ValueError):  # AddressError or DecodeError
            parsed.append(parse(key))
    return parsed
