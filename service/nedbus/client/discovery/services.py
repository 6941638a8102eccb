"""What others on the network answer and report: status, layouts, rejected messages. Nothing of it is trusted."""

from __future__ import annotations

import json
import logging
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import zenoh

from nedbus.client.closing import Finalizer
from nedbus.client.receiving.layout_lookup import Schemas
from nedbus.events import QUESTION, AccountReport, from_json
from nedbus.log_event import about
from nedbus.transport import RawSample, Session, query, while_open
from nedbus_msgs import ANY, Address, AddressError, address_of_rejected_key, rejected_key_expr, schema_key, status_key

from .service_status import ServiceStatus, parse_status

_log = logging.getLogger(__name__)

_MAX_FIELDS: Final = 256  # of a layout
_MAX_TEXT: Final = 300  # characters of a key that are logged, and of a reason that are kept
_MAX_ANSWER: Final = 2**18  # bytes of an answer that is read
_MAX_ACCOUNT: Final = 2**20  # the same of the account of a thousand vehicles
_MAX_CONTENT: Final = 2**28  # bytes that the status of all services may take up, about: JSON is up to 32 times larger
_MAX_LAYOUTS: Final = 32  # of an answer; there are five
_TIMEOUT: Final = 2.0  # s for this question: a publisher that is busy is not in time for less
_MAX_ANSWERS: Final = 100  # to the question for a message: of many publishers all know the same
_CHANNEL: Final = 1000  # reports that wait; beyond, the oldest are dropped
_MAX_REPORT: Final = 2**16  # bytes of a report that is read


def find_services(session: Session, *, prefix: str, timeout: float, service: str = ANY) -> list[ServiceStatus]:
    """Return the status of every nedbus service, or of one; answers that would fill the memory are left out."""
    answers = query(session, status_key(service, prefix=prefix), timeout=timeout)
    found = [(str(raw.key_expr), parse_status(content)) for raw, content in _parse(_accept(answers))]
    return [replace(status, service=key.split("/")[-2]) for key, status in found if status is not None]


def find_accounts(session: Session, *, prefix: str, within: float, timeout: float) -> list[AccountReport]:
    """Return what services remember of the last seconds; what cannot be parsed, or is too large, is left out."""
    selector = f"{status_key(ANY, prefix=prefix)}?{QUESTION}={within:g}"
    answers = _accept(query(session, selector, timeout=timeout), limit=_MAX_ACCOUNT)
    found = (from_json(content) for _, content in _parse(answers, limit=_MAX_ACCOUNT))
    return [report for report in found if report is not None]


def _accept(answers: Sequence[RawSample], *, limit: int = _MAX_ANSWER) -> list[RawSample]:
    """Return the answers that may be parsed, and log how many would fill the memory."""
    accepted: list[RawSample] = []
    room = _MAX_CONTENT
    for raw in answers:
        text = raw.payload.to_bytes()
        # What it takes up at most when it is parsed, about: measured with CPython 3.11.
        size = 4 * len(text) + 150 * text.count(b"{") + 60 * text.count(b"[") + 40 * text.count(b",")
        if len(text) <= limit and size <= room:
            accepted.append(raw)
            room -= size
    if left_out := len(answers) - len(accepted):
        _log.warning("%d services are left out: their answers are too large", left_out, extra=about("incomplete"))
    return accepted


def find_schemas(messages: Collection[str], *, session: Session, prefix: str) -> Schemas:
    """Ask publishers for the fields of all layouts of these messages; of different answers for one the first counts."""
    found: dict[str, dict[int, dict[str, str]]] = {}
    keys = [schema_key(name, prefix=prefix) for name in messages]
    read: Counter[str] = Counter()
    early: list[RawSample] = []
    for raw in query(session, *keys, timeout=_TIMEOUT, newest=False):
        read[str(raw.key_expr)] += 1
        if read[str(raw.key_expr)] <= _MAX_ANSWERS:
            early.append(raw)
    for raw, content in _parse(early):
        name = str(raw.key_expr).rpartition("/")[2]
        layouts = content.get("layouts") if isinstance(content, dict) else None
        for layout in layouts[:_MAX_LAYOUTS] if isinstance(layouts, list) else ():
            match layout:
                case {"wire": int(number), "fields": list(fields)}:
                    types = {
                        field.get("name"): field.get("type")
                        for field in fields[:_MAX_FIELDS]
                        if isinstance(field, dict)
                    }
                    known = {
                        field: kind for field, kind in types.items() if isinstance(field, str) and isinstance(kind, str)
                    }
                    if len(known) == len(fields):
                        found.setdefault(name, {}).setdefault(number, known)
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
        self._owner = owner  # the bus stays open for as long as somebody may read
        channel: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_CHANNEL)
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
        """Follow them no more; a second call does nothing."""
        self._finalizer.close_now()

    def _read(self, sample: zenoh.Sample) -> RejectionReport | None:
        try:
            address = address_of_rejected_key(str(sample.key_expr), prefix=self._prefix)
            content = json.loads(sample.payload.to_bytes()) if len(sample.payload) <= _MAX_REPORT else None
        except (AddressError, ValueError, RecursionError):
            return None
        reason = content.get("reason") if isinstance(content, dict) else None
        return RejectionReport(address, str(reason)[:_MAX_TEXT], time.time_ns()) if reason else None


def _parse(answers: Iterable[RawSample], *, limit: int = _MAX_ANSWER) -> Iterator[tuple[RawSample, object]]:
    """Yield answers with their content; the first that is not JSON is logged, as a peer may send any number."""
    logged = False
    for raw in answers:
        if len(raw.payload) > limit:
            continue
        try:
            yield raw, json.loads(raw.payload.to_bytes())
        except (ValueError, RecursionError):
            if not logged:
                key = str(raw.key_expr)[:_MAX_TEXT]
                _log.warning("%r: an answer that is not JSON", key, extra=about("invalid", reason="no JSON"))
            logged = True
