"""Layout lookup: query publishers for message definitions and layouts that are not built in, by their hash."""

import logging
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Annotated, Any, Final, NamedTuple

import zenoh
from pydantic import ConfigDict, Field, TypeAdapter

from nedbus import limits
from nedbus.client.closing import join_thread
from nedbus.client.discovery import parse_replies
from nedbus.errors import NedbusError
from nedbus.log_event import UnexpectedErrors, about
from nedbus.timings import TIMINGS
from nedbus.transport import Session, send_query, wait_for_replies
from nedbus_msgs import ANY, MESSAGES, Codec, codec_of, define, field_type, schema_key, short_hash

_log = logging.getLogger(__name__)

_IN_USE: Final = 60.0  # s after its last message during which a definition is not evicted
_BASE: Final = 48  # memory of an empty definition, in units of one field
# s, backoff after failed queries for a definition
_PAUSES: Final = (0.5, 2.0, 5.0, 10.0, 30.0, 60.0)
_QUERY_PAUSE: Final = 0.2  # s between a query without a result and the next one
# s of wait budget regained per second; peers cannot make readers wait longer
_BUDGET_RATE: Final = 0.1
_RETURN: Final = 3.0  # s after the link is up again in which publishers return to the router
_LONGEST_OUTAGE: Final = 6.0  # s for which a reader waits for a definition while the link is down

SchemaId = tuple[str, str]  # message name, and hash of the definition
Schemas = Mapping[SchemaId, Mapping[str, str]]  # definitions from publishers: field types by name


class Sender(NamedTuple):
    """The sender of a message of an unknown definition: its vehicle, and the Zenoh id of its session."""

    vehicle: str = ANY
    session: object = None


_ANYONE: Final = Sender()


@dataclass(slots=True)
class _Known:
    codec: Codec[Any]
    size: int  # memory, in units of one field
    used: float  # monotonic time of the last use [s]


class LayoutLookup:
    """Look up unknown definitions with `find`, which queries publishers, in a background thread.

    A message of a newer layout is invalid until the answer arrives; any other unknown message stays in the queue.
    Receiving threads do not wait: any peer can send unknown messages and leave queries unanswered.

    `is_linked`: whether the session has a router. Lookups go on while it has none, and shortly afterwards.
    """

    def __init__(
        self,
        find: Callable[[Mapping[SchemaId, Sender]], Schemas],
        *,
        is_linked: Callable[[], bool] = lambda: True,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._find = find
        self._is_linked = is_linked
        self._now = now
        self._returning_until = float("-inf")  # monotonic time, as of the last outage of the link
        self._known: dict[SchemaId, _Known] = {}
        self._full = False
        self._errors = UnexpectedErrors(
            _log, "unexpected error in a lookup of definitions (logged once)"
        )
        self._changed = threading.Condition()  # guards all below
        self._thread: threading.Thread | None = None
        self._closed = False
        self._open: dict[SchemaId, Sender] = {}  # sender of each open lookup, queried lookups first
        # failures, time of the next query, sender
        self._failed: dict[SchemaId, tuple[int, float, Sender]] = {}
        # [s], at the last failed wait
        self._wait_budget, self._budget_time = TIMINGS.definition_timeout, float("-inf")

    def codec(
        self, name: str, identity: str, *, sender: Sender = _ANYONE, wait: bool = False
    ) -> Codec[Any] | None:
        """Return the codec of the definition with this hash; None if it is unknown, which starts a lookup.

        `sender`: after a failed lookup, a lookup for another sender starts at once, without backoff.
        `wait`: wait for a lookup in progress, as `wait` does; never use it on a receiving thread.
        """
        schema_id = name, identity
        if schema_id not in self._known:
            self._request(schema_id, sender)
            if wait:
                self.wait(schema_id)
        known = self._known.get(schema_id)
        if known is None:
            return None
        known.used = self._now()
        return known.codec

    def wait(self, schema_id: SchemaId | None = None) -> None:
        """Wait for one lookup or for all, up to 3 s, or 6 s for one while the link is down or just up again.

        Never call it on a receiving thread.
        """
        with self._changed:
            start = time.monotonic()
            longest = TIMINGS.definition_timeout
            if schema_id is None:
                self._changed.wait_for(lambda: self._closed or not self._open, longest)
                return
            budget = min(longest, self._wait_budget + _BUDGET_RATE * (start - self._budget_time))
            timeout = budget
            while not self._closed and schema_id in self._open:
                self._note_outage()
                if self._is_returning:
                    timeout = _LONGEST_OUTAGE
                left = start + timeout - time.monotonic()
                if left <= 0:
                    break
                self._changed.wait(min(left, _QUERY_PAUSE))
            if timeout == budget and schema_id not in self._known:
                self._budget_time = time.monotonic()
                self._wait_budget = max(0.0, budget - (self._budget_time - start))

    def _note_outage(self) -> None:
        """Note that the link is down, if it is."""
        if not self._is_linked():
            self._returning_until = time.monotonic() + _RETURN

    @property
    def _is_returning(self) -> bool:
        """Whether the link was down a short time ago: publishers may not have returned to the router yet."""
        return time.monotonic() < self._returning_until

    def close(self) -> None:
        """Start no more lookups and wait for the one in progress."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            thread = self._thread
        if thread is not None:
            join_thread(thread, TIMINGS.definition_timeout)

    def _request(self, schema_id: SchemaId, sender: Sender) -> None:
        with self._changed:
            _, due, failed = self._failed.get(schema_id, (0, float("-inf"), None))
            is_due = self._now() >= due or sender != failed
            if (
                self._closed
                or schema_id in self._known
                or not is_due
                or len(self._open) >= 2 * limits.UNKNOWN_DEFINITIONS
            ):
                return
            self._open[schema_id] = sender
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._run, name="nedbus-layouts", daemon=True
                )
                self._thread.start()

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._closed or not self._open:
                    self._thread = None
                    return
                queried = dict(islice(self._open.items(), limits.UNKNOWN_DEFINITIONS))
            added: list[SchemaId] = []
            self._note_outage()
            with self._errors, suppress(NedbusError):  # the session is closed
                schemas = self._find(queried)
                added = [
                    schema_id
                    for schema_id in queried
                    if schema_id in schemas and self._add(*schema_id, schemas[schema_id])
                ]
            self._finish_query(queried, added)

    def _finish_query(
        self, queried: Mapping[SchemaId, Sender], added: Collection[SchemaId]
    ) -> None:
        with self._changed:
            if not added:
                self._changed.wait_for(lambda: self._closed, _QUERY_PAUSE)
            self._note_outage()  # after the pause, because Zenoh ends a query before it reports a broken link
            for schema_id, queried_sender in queried.items():
                if self._is_returning and schema_id not in added:
                    continue  # asked again
                sender = self._open.pop(schema_id)
                failures = self._failed.pop(schema_id, (0,))[0]
                if schema_id not in added and sender != queried_sender:
                    self._open[schema_id] = sender  # this sender may have appeared after the query
                elif schema_id not in added:
                    pause = _PAUSES[min(failures, len(_PAUSES) - 1)]
                    self._failed[schema_id] = failures + 1, self._now() + pause, sender
            while len(self._failed) > limits.FAILED_DEFINITIONS:
                del self._failed[next(iter(self._failed))]
            self._changed.notify_all()

    def _add(self, name: str, identity: str, fields: Mapping[str, str]) -> bool:
        size = len(fields) + _BASE
        reason = f"hash {identity}"
        if not self._evict(size):
            if not self._full:
                text = "%s is not decoded, because too many definitions from publishers are in use"
                _log.warning(text, name, extra=about("invalid"))
            self._full = True
            return False
        try:
            definition = define(name, ((field, field_type(kind)) for field, kind in fields.items()))
        except ValueError as exc:
            _log.warning(
                "ignored a peer's definition of %s: %s",
                name,
                str(exc)[: limits.PEER_TEXT],
                extra=about("invalid"),
            )
            return False
        self._known[name, identity] = _Known(codec_of(definition), size, self._now())
        if name in MESSAGES:
            unknown = (
                ", ".join(field for field in fields if field not in MESSAGES[name].types)[
                    : limits.PEER_TEXT
                ]
                or "nothing"
            )
            text = "a layout of %s is newer than this reader; ignored fields: %s"
            _log.warning(text, name, unknown, extra=about("newer_layout", reason=reason))
        else:
            _log.debug("%s is not built in: using the publisher's definition, %s", name, reason)
        return True

    def _evict(self, size: int) -> bool:
        """Evict unused definitions, least recently used first; return False if that frees too little."""
        free = limits.DEFINITION_FIELDS - sum(known.size for known in self._known.values())
        for schema_id, known in sorted(self._known.items(), key=lambda item: item[1].used):
            if free >= size or self._now() - known.used < _IN_USE:
                break
            free += self._known.pop(schema_id).size
        return free >= size


@dataclass(slots=True)
class _Field:
    name: str
    type: str


_FIELDS: Final = TypeAdapter(
    Annotated[list[_Field], Field(max_length=limits.LAYOUT_FIELDS)],
    config=ConfigDict(defer_build=True),
)


def has_router(session: Session) -> bool:
    """Return whether a session has a router; True for a closed one."""
    try:
        return bool(session.info.routers_zid())
    except zenoh.ZError:
        return True


def find_schemas(ids: Mapping[SchemaId, Sender], *, session: Session, prefix: str) -> Schemas:
    """Query the vehicle of each sender for the fields of its definition, then all vehicles for those still missing.

    Fields are accepted from any peer, because they must have the requested hash. Returns once all are found, without
    waiting for stopped publishers or bad links.
    """
    schemas: dict[SchemaId, dict[str, str]] = {}
    for to_all in (False, True):
        keys = {
            f"{schema_key(name, vehicle=ANY if to_all else sender.vehicle, prefix=prefix)}?hash={identity}"
            for (name, identity), sender in ids.items()
            if (name, identity) not in schemas
        }
        queries = [send_query(session, key, timeout=TIMINGS.definition_timeout) for key in keys]
        replies = islice(wait_for_replies(queries), limits.REPLIES)
        for key, content in parse_replies(reply.ok for reply in replies if reply.ok is not None):
            schemas |= {
                schema_id: fields
                for schema_id, fields in _parse(key.rpartition("/")[2], content)
                if schema_id in ids
            }
            if len(schemas) == len(ids):
                return schemas
    return schemas


def _parse(name: str, reply: object) -> Iterator[tuple[SchemaId, dict[str, str]]]:
    """Yield the definitions of a reply by the hash of their fields; the hash that the peer states is untrusted."""
    layouts = None
    if isinstance(reply, dict):
        layouts = reply.get("layouts")
    if not isinstance(layouts, list):
        return
    for layout in layouts[: limits.REPLY_LAYOUTS]:
        if not isinstance(layout, dict):
            continue
        with suppress(ValueError):
            parsed = _FIELDS.validate_python(layout.get("fields"))
            fields = {field.name: field.type for field in parsed}
            if len(fields) == len(parsed):
                types = {field: field_type(kind) for field, kind in fields.items()}
                yield (name, short_hash(name, types)), fields
