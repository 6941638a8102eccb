"""Answers and reports of peers: status, accounts, layouts, rejected messages. Nothing of it is trusted."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, Final

import zenoh
from pydantic import Field, TypeAdapter, ValidationError

from nedbus.client.closing import Finalizer
from nedbus.client.receiving.layout_lookup import Schemas
from nedbus.events import QUESTION, AccountReport, from_json
from nedbus.log_event import about
from nedbus.transport import RawSample, Session, query, while_open
from nedbus_msgs import ANY, Address, AddressError, address_of_rejected_key, rejected_key_expr, schema_key, status_key

from .service_status import ServiceStatus, parse_status

_log = logging.getLogger(__name__)

_MAX_FIELDS: Final = 256  # of a layout
_MAX_LAYOUTS: Final = 32  # of an answer; there are five
_MAX_TEXT: Final = 300  # characters of a key that are logged, and of a reason that are kept
_MAX_ANSWER_BYTES: Final = 2**18
_MAX_ACCOUNT_BYTES: Final = 2**20  # of an answer about a thousand vehicles
_MAX_REPORT_BYTES: Final = 2**16
_MAX_MEMORY: Final = 2**28  # bytes of all parsed answers, about: JSON takes up to 32 times its length
_MAX_REPORTS: Final = 1000  # that wait; beyond, the oldest are dropped
_SCHEMA_TIMEOUT: Final = 2.0  # s: a publisher that is busy is not in time for less


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
    found = [(key, parse_status(content)) for key, content in _parse(answers)]
    return [replace(status, service=key.split("/")[-2]) for key, status in found if status is not None]


def find_accounts(session: Session, *, prefix: str, within: float, timeout: float) -> list[AccountReport]:
    """Return what services remember of the last seconds; what cannot be parsed, or is too large, is left out."""
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
