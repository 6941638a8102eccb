"""Observation of a network for a few seconds: services, tokens, messages and routers, which the checks evaluate."""

import math
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from typing import Final, TypeVar

import zenoh

from nedbus import Bus, Newest, Session, clock
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
# peers may claim to be services; a service has one status for each vehicle
_MAX_SERVICES: Final = 100
_MAX_KEYS: Final = 2000
_MAX_KEY_LENGTH: Final = 1024
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
        prefix, start = self.prefix, time.monotonic()
        newest = bus.newest(ANY)
        take_others = _subscribe(session, f"**/{DEFAULT_TOPIC}/**")
        self.routers = query_routers(session, timeout=_QUERY_TIMEOUT)
        before = clock.utc()
        self.services = bus.services(timeout=_QUERY_TIMEOUT)[:_MAX_SERVICES]
        self.asked, self.error = (before + clock.utc()) / 2, (clock.utc() - before) / 2
        self.accounts = bus.accounts(within=0.0, timeout=_QUERY_TIMEOUT)
        self.alive = bus.publishers(timeout=_LIST_TIMEOUT)
        tokens = token_keys(session, px4_publishers_key_expr(None), timeout=_QUERY_TIMEOUT)
        publishers = _parse_each(PublisherToken.parse, tokens)
        # without nedbus's bridges
        self.ros2 = [token for token in publishers if not token.node.startswith("nedbus_")]
        tokens = token_keys(session, "**/@alive/**", timeout=_QUERY_TIMEOUT)
        others = {key for key in tokens if not key.startswith("@")}
        self._add(newest)
        self.delays = dict.fromkeys(self.delays)  # messages buffered during the queries seem late
        end = max(start + TIMINGS.listen, time.monotonic() + TIMINGS.min_listen)
        while time.monotonic() < end:
            time.sleep(_POLL)
            self._add(newest)
            keys = (
                key
                for sample in take_others()
                if (key := str(sample.key_expr)).endswith(f"/{DEFAULT_TOPIC}")
            )
            others.update(
                islice(
                    (key for key in keys if len(key) < _MAX_KEY_LENGTH),
                    max(0, _MAX_KEYS - len(others)),
                )
            )
        ages = islice(((address, each.age) for address, each in newest.items()), _MAX_KEYS)
        self.ages = {address: age if math.isfinite(age) else None for address, age in ages}
        self.listened = time.monotonic() - start
        self.elsewhere = {key for key in others if not key.startswith(f"{prefix}/")}

    def _add(self, newest: Newest) -> None:
        for each in newest.update():
            address = each.sample.address
            if not each.sample.retained and (
                address in self.delays or len(self.delays) < _MAX_KEYS
            ):
                known = (self.delays.get(address), each.sample.latency)
                self.delays[address] = min(
                    (delay for delay in known if delay is not None), default=None
                )
        self.errors = {
            address: reason
            for address, reason in newest.invalid.items()
            if address.topic in BY_TOPIC
        }
        self.delays |= {address: None for address in newest.invalid if address not in self.delays}


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
