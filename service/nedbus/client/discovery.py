"""Queries for vehicles, services and event reports; peers are untrusted."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING

from pydantic import TypeAdapter
from pydantic_core import to_json

from nedbus import limits
from nedbus.client.health import Health
from nedbus.errors import AddressError
from nedbus.log_event import about
from nedbus.samples import LogStreamStatus, PositionStatus, UntrustedReply
from nedbus.transport import RawSample, Session, query
from nedbus_msgs import Address, all_status_keys, parse_status_key

if TYPE_CHECKING:
    from nedbus.vehicle_events import AccountReport

_log = logging.getLogger(__name__)


class Vehicles(dict[str, list[Address]]):
    """The published addresses by vehicle.

    `complete`: False without a router, until the router has listed all addresses, if there are over 10,000, and while
    a vehicle is left out because it has over 1,000 publishers' tokens.
    """

    complete = True


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """The health of one published stream."""

    address: str
    health: Health


@dataclass(frozen=True, slots=True)
class SourceStatus(UntrustedReply):
    """The status of one source.

    `state`: starting, waiting, running, retrying, done or failed; empty if not reported.
    `published`, `rejected`: messages since the service started. `done`, `total`: progress of this run,
    in messages, or in bytes of a log.
    `lost`: messages lost before a live source that detects losses published them, with `log_streams` an estimate.
    `dropped`: those of them that its host dropped. `overload`: how the host does not keep up, "" if it does.
    `reboots`: reboots of vehicles. `copies`: messages left out because they came before, as over a second link.
    `stale`: addresses of a live source without a message for 3 s.
    `not_carried`: names of vehicles' messages for which this source has no definition. `silent`: addresses that a
    vehicle announces without sending messages, while messages of its other topics arrive.
    `rejections`: the number of rejected messages by rule.
    `retries`: restarts after a failure. `error`: the reason of the last failure.
    `streams`: the health of the first 100 published streams. `log_streams`: the ULog stream of each vehicle.
    `positions`: what is sent into vehicles.
    """

    source: str = ""
    state: str = ""
    addresses: tuple[str, ...] = ()
    stale: tuple[str, ...] = ()
    published: int = 0
    rejected: int = 0
    rejections: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    dropped: int = 0
    overload: str = ""
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
    log_streams: tuple[LogStreamStatus, ...] = ()
    positions: tuple[PositionStatus, ...] = ()
    copies: int = 0

    @property
    def vehicles(self) -> set[str]:
        """The vehicles that this status names."""
        addresses = (
            *self.addresses,
            *self.stale,
            *self.silent,
            *(stream.address for stream in self.streams),
        )
        vehicles = {_vehicle_of(address) for address in addresses}
        vehicles.update(log_stream.vehicle for log_stream in self.log_streams)
        return vehicles

    def about(self, vehicle: str, *, refused: Collection[str]) -> SourceStatus:
        """Return what this status says about one vehicle, and which streams it has of the `refused` ones."""

        def is_about(address: str) -> bool:
            return _vehicle_of(address) == vehicle

        def is_named(address: str) -> bool:
            return is_about(address) or _vehicle_of(address) in refused

        return replace(
            self,
            addresses=tuple(filter(is_named, self.addresses)),
            stale=tuple(filter(is_about, self.stale)),
            silent=tuple(filter(is_about, self.silent)),
            streams=tuple(stream for stream in self.streams if is_named(stream.address)),
            log_streams=tuple(
                log_stream for log_stream in self.log_streams if log_stream.vehicle == vehicle
            ),
            positions=tuple(position for position in self.positions if position.vehicle == vehicle),
        )

    @property
    def ended(self) -> bool:
        """True if the source will not publish again."""
        return self.state in {"done", "failed"}


@dataclass(frozen=True, slots=True)
class ServiceStatus(UntrustedReply):
    """The status of a service, from `bus.services()`.

    `service`: its id. `host`: the name of its host or container. `role`: "router" or "client".
    `vehicle`: the vehicle whose key this status has; it contains nothing about other vehicles. A service has one
    status for each of its vehicles. Empty for an older service, whose key names no vehicle: only its id, host and
    version are shown, because any vehicle's certificate could have written the rest.
    `started`, `now`: seconds since the epoch by its clock.
    `refused`: vehicles whose messages the access rules of its router drop.
    Services may have any version: absent and invalid fields get their defaults.
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
    vehicle: str = ""

    @property
    def is_outdated(self) -> bool:
        """True for an older service, whose reports are not used because its key names no vehicle."""
        return not self.vehicle

    def about(self, vehicle: str) -> ServiceStatus:
        """Return what this status says about one vehicle, and about sources without a vehicle.

        Addresses and streams of vehicles that the router refuses are kept, because no other key can name them:
        `own_streams` leaves them out.
        """
        sources: list[SourceStatus] = []
        others: list[SourceStatus] = []
        for source in self.sources:
            part = source.about(vehicle, refused=self.refused)
            if not source.vehicles or vehicle in source.vehicles:
                sources.append(part)
            elif part.vehicles:
                others.append(part)
        return replace(self, vehicle=vehicle, sources=(*sources, *others))

    @property
    def own_streams(self) -> list[StreamStatus]:
        """The streams of its vehicle: what it says about those of others decides nothing."""
        streams = [stream for source in self.sources for stream in source.streams]
        return [stream for stream in streams if _vehicle_of(stream.address) == self.vehicle]

    def split(self, _: int) -> list[ServiceStatus]:
        """Split into one status per source, or omit the stream health of the only one; return [] if neither applies."""
        if len(self.sources) > 1:
            return [replace(self, sources=(source,)) for source in self.sources]
        return [
            replace(self, sources=(replace(source, streams=()),))
            for source in self.sources
            if source.streams
        ]


def _vehicle_of(address: str) -> str:
    return address.partition("/")[0]


@cache
def _status_type() -> TypeAdapter[ServiceStatus]:
    """Return the validation of a reply; Pydantic takes 20 ms to compile it, so it waits for the first reply."""
    return TypeAdapter(ServiceStatus)


def find_services(session: Session, *, prefix: str, timeout: float) -> list[ServiceStatus]:
    """Query the status of all nedbus services, as `bus.services`, over a session from `bus.open_session`.

    Large replies then do not delay the messages of the bus. Ignores oversized replies, and what a service says of
    other vehicles than that of the key.

    The list begins with one status of each vehicle and ends with older services. A program that shows only its
    beginning thus leaves out no vehicle because another one claims many services.
    """
    statuses: dict[tuple[str | None, str], ServiceStatus] = {}
    for vehicle, service, content in _find(
        session, all_status_keys(prefix=prefix), prefix=prefix, timeout=timeout
    ):
        if not isinstance(content, dict):
            continue
        given = _status_type().validate_python(content)
        if vehicle is None:
            statuses[vehicle, service] = ServiceStatus(
                service=service, host=given.host, version=given.version
            )
            continue
        part = replace(given.about(vehicle), service=service)
        known = statuses.get((vehicle, service))
        if known is None:
            sources = part.sources
        else:
            sources = (*known.sources, *part.sources)
        statuses[vehicle, service] = replace(part, sources=sources)
    known_of = Counter[str]()
    ranked: list[tuple[bool, int, ServiceStatus]] = []
    for status in statuses.values():
        ranked.append((status.is_outdated, known_of[status.vehicle], status))
        known_of[status.vehicle] += 1
    ranked.sort(key=lambda rank: rank[:2])
    return [status for _, _, status in ranked]


def find_reports(
    session: Session, *, prefix: str, within: float, timeout: float
) -> list[AccountReport]:
    """Query all services for their event reports of the last `within` seconds, one report per vehicle and service.

    Ignores invalid and oversized replies, and statements about other vehicles than that of the key.
    """
    from nedbus.vehicle_events import ACCOUNT_PARAMETER, from_json, joined

    selector = f"{all_status_keys(prefix=prefix)}?{ACCOUNT_PARAMETER}={within:g}"
    parts: dict[tuple[str, str], list[AccountReport]] = {}
    for vehicle, service, content in _find(session, selector, prefix=prefix, timeout=timeout):
        part = from_json(content)
        if vehicle is not None and part is not None:
            parts.setdefault((vehicle, service), []).append(
                replace(part.about(vehicle), service=service)
            )
    return list(map(joined, parts.values()))


def _find(
    session: Session, selector: str, *, prefix: str, timeout: float
) -> Iterator[tuple[str | None, str, object]]:
    """Yield vehicle, service and content of each reply on a status key.

    Beyond the limits of a query, the vehicle with the most replies loses some of them; no other vehicle does.
    """

    def vehicle_of(key: str) -> str:
        with suppress(AddressError):
            vehicle, _ = parse_status_key(key, prefix=prefix)
            if vehicle is not None:
                return vehicle
        return ""  # any vehicle may write such keys, so they share the part of one

    for key, content in parse_replies(
        query(session, selector, timeout=timeout, group_of=vehicle_of)
    ):
        try:
            vehicle, service = parse_status_key(key, prefix=prefix)
        except AddressError:
            _log.debug("%r: ignored a status with an invalid key", key[: limits.PEER_TEXT])
        else:
            yield vehicle, service, content


def reply_parts(report: AccountReport | ServiceStatus) -> Iterator[bytes]:
    """Yield a report in JSON parts small enough for readers, which join them; log and omit an oversized part."""
    content = to_json(report, inf_nan_mode="constants")
    if len(content) <= limits.REPLY_BYTES:
        yield content
    elif parts := report.split(5 * len(content) // (4 * limits.REPLY_BYTES) + 1):
        for part in parts:
            yield from reply_parts(part)
    else:
        text = "omitted %d bytes of a reply, because readers accept at most %d per part: use fewer or shorter names"
        _log.warning(text, len(content), limits.REPLY_BYTES, extra=about("incomplete"))


def parse_replies(replies: Iterable[RawSample]) -> Iterator[tuple[str, object]]:
    """Yield key and content of JSON replies within the memory limit; log the discarded ones, one line per reason."""
    free = limits.REPLY_MEMORY
    oversized = 0
    invalid = ""
    for raw in replies:
        key = str(raw.key_expr)
        text = raw.payload.to_bytes()
        # Upper bound of the memory of a parsed reply, measured with CPython 3.11.
        size = (
            4 * len(text) + 150 * text.count(b"{") + 60 * text.count(b"[") + 40 * text.count(b",")
        )
        if len(text) > limits.REPLY_BYTES or size > free:
            oversized += 1
            continue
        free -= size
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):
            invalid = invalid or key[: limits.PEER_TEXT]
        else:
            yield key, content
    if oversized:
        warning = "ignored replies over %d bytes or over the memory limit (%d in total): the result is incomplete"
        _log.warning(warning, limits.REPLY_BYTES, oversized, extra=about("incomplete"))
    if invalid:
        _log.warning(
            "%r: ignored a reply that is not JSON",
            invalid,
            extra=about("invalid", reason="not JSON"),
        )
