"""Observation of a network for a few seconds: services, tokens, messages and routers, which the checks evaluate."""

import time
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Final, TypeVar

import zenoh

from nedbus import client, clock, transport
from nedbus.events import AccountReport
from nedbus.timings import TIMINGS
from nedbus_msgs import BY_TOPIC, DEFAULT_TOPIC, Address, DecodeError, codec_of

T = TypeVar("T")

_POLL: Final = 0.02  # s; also the error of measured delays
_QUERY_TIMEOUT: Final = 1.0  # s
_LIST_TIMEOUT: Final = 4.0  # s for the router to list all streams
_MAX_SERVICES: Final = 20  # peers may claim to be services
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
    `errors`: last decoding error by address. `listened`: duration of the observation [s].
    `elsewhere`: nedbus keys under other prefixes. `ros2`: publishers of ROS 2 topics.
    `routers`: routers that disclose their sessions. `accounts`: event reports of services.
    """

    prefix: str
    version: str
    vehicle: str | None
    verdict: transport.Verdict | None = None
    services: list[client.ServiceStatus] = field(default_factory=list)
    asked: float = 0.0
    error: float = 0.0
    accounts: list[AccountReport] = field(default_factory=list)
    alive: transport.Publishers = field(default_factory=transport.Publishers)
    ages: dict[Address, float | None] = field(default_factory=dict)
    delays: dict[Address, float | None] = field(default_factory=dict)
    errors: dict[Address, str] = field(default_factory=dict)
    elsewhere: set[str] = field(default_factory=set)
    ros2: list[transport.PublisherToken] = field(default_factory=list)
    routers: list[transport.RouterState] = field(default_factory=list)
    listened: float = 0.0

    @property
    def sources(self) -> list[client.SourceStatus]:
        """The sources of all services."""
        return [source for service in self.services for source in service.sources]

    def observe(self, session: transport.Session, open_session: Callable[[], transport.Session]) -> None:
        """Send the queries, and receive messages for at least 3 s; `open_session`: as in FleetTokens."""
        prefix, start = self.prefix, time.monotonic()
        take_messages = _subscribe(session, f"{prefix}/*/**")
        take_others = _subscribe(session, f"**/{DEFAULT_TOPIC}/**")
        self.routers = transport.query_routers(session, timeout=_QUERY_TIMEOUT)
        before = clock.utc()
        self.services = client.find_services(session, prefix=prefix, timeout=_QUERY_TIMEOUT)[:_MAX_SERVICES]
        self.asked, self.error = (before + clock.utc()) / 2, (clock.utc() - before) / 2
        self.accounts = client.find_reports(session, prefix=prefix, within=0.0, timeout=_QUERY_TIMEOUT)
        with closing(transport.VehicleDirectory.of_fleet(open_session, prefix=prefix)) as directory:
            self.alive = directory.publishers(timeout=_LIST_TIMEOUT)
        tokens = transport.token_keys(session, transport.px4_publishers_key_expr(None), timeout=_QUERY_TIMEOUT)
        publishers = _parse_each(transport.PublisherToken.parse, tokens)
        self.ros2 = [token for token in publishers if not token.node.startswith("nedbus_")]  # without nedbus's bridges
        for sample in transport.query(session, f"{prefix}/*/**", timeout=_QUERY_TIMEOUT):
            if (address := self._address_of(str(sample.key_expr))) is not None:
                # several publishers, or a storage, may answer for one key
                self.ages[address] = _least(_age_of(sample), self.ages.get(address))
        queried = clock.utc()
        tokens = transport.token_keys(session, "**/@alive/**", timeout=_QUERY_TIMEOUT)
        others = {key for key in tokens if not key.startswith("@")}
        self._add(take_messages())
        self.delays = dict.fromkeys(self.delays)  # messages buffered during the queries seem late
        end = max(start + TIMINGS.listen, time.monotonic() + TIMINGS.min_listen)
        while time.monotonic() < end:
            time.sleep(_POLL)
            self._add(take_messages())
            keys = (key for sample in take_others() if (key := str(sample.key_expr)).endswith(f"/{DEFAULT_TOPIC}"))
            others.update(islice((key for key in keys if len(key) < _MAX_KEY_LENGTH), max(0, _MAX_KEYS - len(others))))
        self.ages = {each: None if age is None else age + clock.utc() - queried for each, age in self.ages.items()}
        self.listened = time.monotonic() - start
        self.elsewhere = {key for key in others if not key.startswith(f"{prefix}/")}

    def _add(self, samples: Iterable[transport.RawSample]) -> None:
        for sample in samples:
            address = self._address_of(str(sample.key_expr))
            if address is None or (address not in self.delays and len(self.delays) >= _MAX_KEYS):
                continue
            self.delays[address] = _least(_age_of(sample), self.delays.get(address))
            definition = BY_TOPIC.get(address.topic)
            if definition is not None and sample.kind == zenoh.SampleKind.PUT:
                try:
                    codec_of(definition).decode(sample.payload.to_bytes())
                except DecodeError as exc:
                    self.errors[address] = str(exc)

    def _address_of(self, key: str) -> Address | None:
        return next(iter(_parse_each(partial(Address.from_key, prefix=self.prefix), [key])), None)


def _subscribe(session: transport.Session, key_expr: str) -> Callable[[], Iterable[transport.RawSample]]:
    """Return a function that drains up to one full ring of samples; deleting it ends the subscription."""
    with transport.translate_zenoh_errors():
        subscriber = session.declare_subscriber(key_expr, zenoh.handlers.RingChannel(_RING))
    return lambda: islice(iter(subscriber.handler.try_recv, None), _RING)


def _age_of(sample: transport.RawSample) -> float | None:
    """Return the time since a sample's Zenoh timestamp [s]; None without a timestamp."""
    stamp = sample.timestamp
    return None if stamp is None else clock.utc() - stamp.get_time_as_ntp64().as_nanos() / 1e9


def _least(*ages: float | None) -> float | None:
    return min((age for age in ages if age is not None), default=None)


def _parse_each(parse: Callable[[str], T], keys: Iterable[str]) -> list[T]:
    parsed = []
    for key in keys:
        with suppress(ValueError):  # AddressError or DecodeError
            parsed.append(parse(key))
    return parsed
