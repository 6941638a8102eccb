"""What is seen of a network in a few seconds: services, tokens, streams, routers; judged elsewhere."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Final

from nedbus.client import ServiceStatus, find_accounts, find_services
from nedbus.events import AccountReport
from nedbus.transport import (
    PublisherToken,
    RouterState,
    Session,
    alive_keys,
    ask_routers,
    follow_heartbeats,
    px4_publishers_key_expr,
    query,
)
from nedbus_msgs import (
    DEFAULT_TOPIC,
    Address,
    AddressError,
    DecodeError,
    address_of_alive_key,
    alive_key_expr,
)

from .traffic import Stream, Traffic

LISTEN: Final = 3.0
"""Seconds for which the doctor listens, unless it is told otherwise."""

_LEAST: Final = 1.0  # s of them after all questions, for what is measured at its arrival

_TICK: Final = 0.02  # s until what arrived is looked at: it makes a message look that much older
_TIMEOUT: Final = 1.0  # s of a query
_MAX_TIME: Final = 1e11  # s since the epoch that a service may say it is
_CLOCKS: Final = 2.0  # s after which no further service is asked for its clock
_MAX_KEYS: Final = 10_000  # whose publishers are told apart
_MAX_SERVICES: Final = 20  # that are looked at: any peer may claim to be a service


@dataclass(frozen=True, slots=True)
class Service:
    """The status of a service as it reports it, and what its clock says: ahead of ours by `offset` +- `error` [s]."""

    status: ServiceStatus
    offset: float | None = None
    error: float = 0.0


@dataclass(slots=True)
class Observation:
    """What was seen.

    `alive`: addresses with a liveliness token; `ages`: of the last message that a publisher answers with [s].
    `streams`: what arrived, by key; `publishers`: those whose heartbeats came, by key.
    `elsewhere`: keys of nedbus under other prefixes; `ros2`: publishers of ROS 2's keys.
    `routers`: those that tell this client of their sessions; `listened`: for how long streams were [s].
    `accounts`: what services remember of vehicles.
    """

    prefix: str
    services: list[Service] = field(default_factory=list)
    accounts: list[AccountReport] = field(default_factory=list)
    alive: list[Address] = field(default_factory=list)
    ages: dict[Address, float | None] = field(default_factory=dict)
    streams: dict[str, Stream] = field(default_factory=dict)
    publishers: dict[str, set[str]] = field(default_factory=dict)
    elsewhere: set[str] = field(default_factory=set)
    ros2: list[PublisherToken] = field(default_factory=list)
    routers: list[RouterState] = field(default_factory=list)
    listened: float = 0.0


def observe(session: Session, *, prefix: str, listen: float) -> Observation:
    """Listen and ask, for little more than `listen` seconds."""
    seen = Observation(prefix)
    start = time.monotonic()
    end = start + listen
    with ExitStack() as closing:
        here, anywhere = (
            Traffic(session, key_expr, prefix=prefix) for key_expr in (f"{prefix}/*/**", f"**/{DEFAULT_TOPIC}/**")
        )
        closing.callback(here.close)
        closing.callback(anywhere.close)
        take_heartbeats, end_heartbeats = follow_heartbeats(session, f"{prefix}/*/**")
        closing.callback(end_heartbeats)
        seen.routers = ask_routers(session, timeout=_TIMEOUT)
        for status in find_services(session, prefix=prefix, timeout=_TIMEOUT)[:_MAX_SERVICES]:
            in_time = time.monotonic() < start + _CLOCKS
            seen.services.append(_with_clock(session, prefix, status) if in_time else Service(status))
        seen.accounts = find_accounts(session, prefix=prefix, within=0.0, timeout=_TIMEOUT)
        seen.alive = _alive(session, prefix)
        seen.ros2 = _ros2_publishers(session)
        seen.ages = _ages(session, prefix)
        seen.elsewhere = {
            key
            for key in alive_keys(session, "**/@alive/**", timeout=_TIMEOUT)
            if not key.startswith(f"{prefix}/") and not key.startswith("@")
        }
        here.take()
        for stream in here.streams.values():
            stream.delay = None  # these have waited for the queries above, and are older than they look
        end = max(end, time.monotonic() + _LEAST)
        while time.monotonic() < end:
            time.sleep(_TICK)
            here.take()
            anywhere.take()
            for key, publisher in take_heartbeats():
                if key in seen.publishers or len(seen.publishers) < _MAX_KEYS:
                    seen.publishers.setdefault(key, set()).add(publisher)
    seen.streams = here.streams
    seen.listened = time.monotonic() - start
    seen.elsewhere |= {
        key for key in anywhere.streams if not key.startswith(f"{prefix}/") and key.endswith(f"/{DEFAULT_TOPIC}")
    }
    return seen


def _with_clock(session: Session, prefix: str, status: ServiceStatus) -> Service:
    """Ask a service alone, so that the round trip is its own; its clock was read in the middle of it."""
    before = time.time()
    answers = find_services(session, prefix=prefix, timeout=_TIMEOUT, service=status.service)
    after = time.time()
    now = answers[0].now if answers else None
    if now is None or not abs(now) < _MAX_TIME:  # nor is NaN
        return Service(status)
    return Service(answers[0], now - (before + after) / 2, (after - before) / 2)


def _alive(session: Session, prefix: str) -> list[Address]:
    addresses = []
    for key in alive_keys(session, alive_key_expr(prefix=prefix), timeout=_TIMEOUT):
        try:
            addresses.append(address_of_alive_key(key, prefix=prefix))
        except AddressError:
            continue
    return addresses


def _ros2_publishers(session: Session) -> list[PublisherToken]:
    """Return the publishers of ROS 2's keys with this message, other than our own bridge."""
    found = []
    for text in alive_keys(session, px4_publishers_key_expr(None), timeout=_TIMEOUT):
        try:
            token = PublisherToken.parse(text)
        except DecodeError:
            continue
        if not token.node.startswith("nedbus_"):
            found.append(token)
    return found


def _ages(session: Session, prefix: str) -> dict[Address, float | None]:
    """Return how old the last message of each address is that is still answered with; None without a timestamp."""
    ages: dict[Address, float | None] = {}
    for answer in query(session, f"{prefix}/*/**", timeout=_TIMEOUT):
        try:
            address = Address.from_key(str(answer.key_expr), prefix=prefix)
        except AddressError:
            continue
        stamp = answer.timestamp
        ages[address] = None if stamp is None else time.time() - stamp.get_time_as_ntp64().as_nanos() / 1e9
    return ages
