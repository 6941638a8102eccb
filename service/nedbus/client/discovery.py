"""Discovery of peers: vehicles, services and their status, layouts, rejected messages. No peer is trusted."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import groupby
from operator import attrgetter
from typing import Annotated, Final

import zenoh
from pydantic import Field, TypeAdapter, ValidationError, ValidatorFunctionWrapHandler, field_validator
from pydantic_core import PydanticUseDefault

from nedbus.client.closing import Finalizer
from nedbus.client.health.stream_health import Health
from nedbus.client.receiving.layout_lookup import Schemas
from nedbus.events import QUESTION, AccountReport, from_json
from nedbus.log_event import about
from nedbus.transport import AliveTokens, RawSample, Session, query, while_open
from nedbus_msgs import (
    ANY,
    Address,
    AddressError,
    Selection,
    address_of_alive_key,
    address_of_rejected_key,
    rejected_key_expr,
    schema_key,
    status_key,
)

_log = logging.getLogger(__name__)

_MAX_FIELDS: Final = 256  # of a layout
_MAX_LAYOUTS: Final = 32  # of an answer; there are five
_MAX_TEXT: Final = 300  # characters of a key that are logged, and of a reason that are kept
_MAX_ANSWER_BYTES: Final = 2**18
_MAX_ACCOUNT_BYTES: Final = 2**20  # of an answer about a thousand vehicles
_MAX_REPORT_BYTES: Final = 2**16
_MAX_MEMORY: Final = 2**28  # bytes of all parsed answers, about: JSON takes up to 32 times its length
_MAX_REPORTS: Final = 1000  # that wait; beyond, the oldest are dropped
_SCHEMA_TIMEOUT: Final = 2.0  # s: time for a busy publisher to answer
_POLL: Final = 0.002  # s between two polls for tokens


class VehicleDirectory:
    """The addresses that are published, from the first query on."""

    def __init__(self, *, prefix: str) -> None:
        self._prefix = prefix
        self._lock = threading.Lock()
        self._addresses: dict[str, Address] = {}  # by the key of the token
        self._tokens: AliveTokens | None = None

    def vehicles(self, session: Session, *, timeout: float) -> dict[str, list[Address]]:
        """Return the addresses of each vehicle, both sorted; the first call waits up to `timeout` seconds."""
        with self._lock:
            if self._tokens is None:
                self._tokens = AliveTokens(session, Selection().alive_key_expr(prefix=self._prefix))
                self._tokens.ask()
            self._take(self._tokens, timeout)
            while self._tokens.is_asking:
                time.sleep(_POLL)
                self._take(self._tokens, timeout)
            self._take(self._tokens, timeout)  # what the subscriber was told before the last answer
            addresses = sorted(self._addresses.values())
        return {vehicle: list(group) for vehicle, group in groupby(addresses, key=attrgetter("vehicle"))}

    def _take(self, tokens: AliveTokens, timeout: float) -> None:
        for key, alive in tokens.take(timeout=timeout):
            if not alive:
                self._addresses.pop(key, None)
                continue
            try:
                self._addresses[key] = address_of_alive_key(key, prefix=self._prefix)
            except AddressError:
                _log.debug("%r: a liveliness token that is not one of nedbus", key[:200])


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """The health of one stream that is published."""

    address: str
    health: Health


class _FromPeer:
    """Fields of an answer from the network: an invalid value becomes the default, and invalid rows are left out."""

    __slots__ = ()

    @field_validator("*", mode="wrap")
    @classmethod
    def _replace_invalid(cls, value: object, validate: ValidatorFunctionWrapHandler) -> object:
        with suppress(ValidationError):
            return validate(value)
        rows: list[object] = []
        for row in value if isinstance(value, list) else ():
            with suppress(ValidationError):
                rows.extend(validate([row]))
        if not rows:
            raise PydanticUseDefault
        return tuple(rows)


@dataclass(frozen=True, slots=True)
class SourceStatus(_FromPeer):
    """The status of one source.

    `state`: starting, waiting, running, retrying, done or failed; empty if the service does not say.
    `published` and `rejected` count messages since the service started; `done` of `total` is this run's progress.
    `lost`: messages that were lost before they reached a live source, as far as it can count; `reboots` of vehicles.
    `stale`: addresses that a live source published, until nothing arrived for 3 s.
    `not_carried`: messages that vehicles publish and this source has no definition of; `silent`: addresses that they
    announce, and of which nothing arrives while others do.
    `rejections`: the number of messages that each rule rejected.
    `retries`: restarts after a failure; `error`: the reason of the last failure.
    `streams`: the health of each stream that is published, of up to 100 of them.
    """

    source: str = ""
    state: str = ""
    addresses: tuple[str, ...] = ()
    stale: tuple[str, ...] = ()
    published: int = 0
    rejected: int = 0
    rejections: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    reboots: int = 0
    done: int = 0
    total: int | None = None
    retries: int = 0
    summary: str = ""
    warnings: tuple[str, ...] = ()
    error: str | None = None
    streams: tuple[StreamStatus, ...] = ()
    not_carried: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()

    @property
    def ended(self) -> bool:
        """True once it will publish no more."""
        return self.state in {"done", "failed"}


@dataclass(frozen=True, slots=True)
class ServiceStatus(_FromPeer):
    """The status of a service, from `bus.services()`.

    `service` is its id; `host` the name of its host, or of its container; `role` "router" or "client".
    Times are seconds since the epoch by its clock.
    `refused`: vehicles that its router's access rules keep from all readers.
    The answer of a peer may be of any version: absent and invalid fields have their defaults.
    """

    service: str = ""
    host: str = ""
    version: str = ""
    started: float = 0.0
    now: float | None = None
    role: str = ""
    endpoints: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    sources: tuple[SourceStatus, ...] = ()


_STATUS: Final = TypeAdapter(ServiceStatus)


@dataclass(slots=True)
class _Field:
    name: str
    type: str


@dataclass(slots=True)
class _Layout:
    wire: int
    fields: Annotated[list[_Field], Field(max_length=_MAX_FIELDS)]


_LAYOUT: Final = TypeAdapter(_Layout)


def find_services(session: Session, *, prefix: str, timeout: float) -> list[ServiceStatus]:
    """Return the status of every nedbus service; answers that would fill the memory are left out."""
    answers = query(session, status_key(ANY, prefix=prefix), timeout=timeout)
    return [
        replace(_STATUS.validate_python(content), service=key.split("/")[-2])
        for key, content in _parse(answers)
        if isinstance(content, dict)
    ]


def find_accounts(session: Session, *, prefix: str, within: float, timeout: float) -> list[AccountReport]:
    """Return the accounts of services of the last `within` seconds; invalid or too large answers are left out."""
    answers = query(session, f"{status_key(ANY, prefix=prefix)}?{QUESTION}={within:g}", timeout=timeout)
    found = (from_json(content) for _, content in _parse(answers, limit=_MAX_ACCOUNT_BYTES))
    return [report for report in found if report is not None]


def find_schemas(messages: Collection[str], *, session: Session, prefix: str) -> Schemas:
    """Ask publishers for the fields of all layouts of these messages; of different answers for one the first counts."""
    found: dict[str, dict[int, dict[str, str]]] = {}
    keys = [schema_key(name, prefix=prefix) for name in messages]
    for key, content in _parse(query(session, *keys, timeout=_SCHEMA_TIMEOUT, newest=False)):
        layouts = content.get("layouts") if isinstance(content, dict) else None
        for layout in layouts[:_MAX_LAYOUTS] if isinstance(layouts, list) else ():
            with suppress(ValidationError):
                parsed = _LAYOUT.validate_python(layout)
                fields = {field.name: field.type for field in parsed.fields}
                if len(fields) == len(parsed.fields):
                    found.setdefault(key.rpartition("/")[2], {}).setdefault(parsed.wire, fields)
    return found


@dataclass(frozen=True, slots=True)
class RejectionReport:
    """A message that a service rejected.

    `received`: when the report arrived here, ns since the epoch.
    `reason`: the service's words, at most 300 characters: a peer wrote them, and may have written anything.
    """

    address: Address
    reason: str
    received: int


class Rejections:
    """The reports that arrive; get one from `bus.rejections()`.

    It is closed when it is no longer referenced, and with the bus.
    """

    def __init__(self, session: Session, *, prefix: str, owner: object) -> None:
        self._prefix = prefix
        self._owner = owner  # keeps the bus open as long as it may be read
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_MAX_REPORTS)
        with while_open():
            subscriber = session.declare_subscriber(rejected_key_expr(prefix=prefix), channel)
        self._handler: zenoh.Handler[zenoh.Sample] = subscriber.handler
        self._finalizer = Finalizer(self, subscriber.undeclare)

    def take(self) -> list[RejectionReport]:
        """Return the reports that have arrived since the last call, at most 1000, without waiting."""
        with while_open():
            samples = list(iter(self._handler.try_recv, None))
        return [report for report in map(self._read, samples) if report is not None]

    def close(self) -> None:
        """End the subscription; a second call does nothing."""
        self._finalizer.close_now()

    def _read(self, sample: zenoh.Sample) -> RejectionReport | None:
        try:
            address = address_of_rejected_key(str(sample.key_expr), prefix=self._prefix)
            content = json.loads(sample.payload.to_bytes()) if len(sample.payload) <= _MAX_REPORT_BYTES else None
        except (AddressError, ValueError, RecursionError):
            return None
        reason = content.get("reason") if isinstance(content, dict) else None
        return RejectionReport(address, str(reason)[:_MAX_TEXT], time.time_ns()) if reason else None


def _parse(answers: Iterable[RawSample], *, limit: int = _MAX_ANSWER_BYTES) -> Iterator[tuple[str, object]]:
    """Yield key and content of the answers that are JSON and fit in memory; one line of the log tells of the others."""
    room, too_large, invalid = _MAX_MEMORY, 0, ""
    for raw in answers:
        key, text = str(raw.key_expr), raw.payload.to_bytes()
        # Memory when it is parsed, at most, about: measured with CPython 3.11.
        size = 4 * len(text) + 150 * text.count(b"{") + 60 * text.count(b"[") + 40 * text.count(b",")
        if len(text) > limit or size > room:
            too_large += 1
            continue
        room -= size
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            invalid = invalid or key
        else:
            yield key, content
    if too_large:
        _log.warning("%d answers are left out: they are too large", too_large, extra=about("incomplete"))
    if invalid:
        extra = about("invalid", reason="no JSON")
        _log.warning("%r: an answer that is not JSON", invalid[:_MAX_TEXT], extra=extra)
