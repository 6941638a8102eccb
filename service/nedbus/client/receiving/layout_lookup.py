"""Layout lookup: query publishers for message definitions and layouts that are not built in."""

import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Annotated, Any, Final

from pydantic import Field, TypeAdapter

from nedbus.client.closing import join_thread
from nedbus.client.discovery import parse_replies
from nedbus.errors import NedbusError, UnknownLayoutError
from nedbus.log_event import about
from nedbus.timings import TIMINGS
from nedbus.transport import MAX_REPLIES, Session, send_query, wait_for_replies
from nedbus_msgs import MESSAGES, Codec, Definition, codec_of, define, field_type, schema_key, short_hash

_log = logging.getLogger(__name__)

_MAX_LAYOUTS: Final = 16  # newer layouts per message
_MAX_FIELDS: Final = 65_536  # of all definitions from publishers; PX4's messages have 15 on average
_IN_USE: Final = 60.0  # s after its last message during which a definition is not evicted
_BASE: Final = 48  # memory of an empty definition, in units of one field
_MAX_UNKNOWN: Final = 64  # messages and layouts per query; as many more may wait for the next one
_MAX_FAILED: Final = 1024  # messages and layouts with a failed query; beyond that the oldest backoff is discarded
_PAUSES: Final = (0.5, 2.0, 5.0, 10.0, 30.0, 60.0)  # s, backoff after failed queries for a message or layout
_QUERY_PAUSE: Final = 0.2  # s between a query without a result and the next one
_MAX_REPLY_FIELDS: Final = 256  # per layout
_MAX_REPLY_LAYOUTS: Final = 32  # per reply; five exist
_MAX_TEXT: Final = 300  # logged characters of names sent by a publisher
_BUDGET_RATE: Final = 0.1  # s of wait budget regained per second; peers cannot make readers wait longer

# Message name, and number of a newer layout or, for a message that is not built in, hash of its definition.
SchemaId = tuple[str, int | str]
Schemas = Mapping[SchemaId, Mapping[str, str]]  # definitions from publishers: field types by name


class LayoutLookup:
    """Look up unknown messages and layouts with `find`, which queries publishers, in a background thread.

    Messages of an unknown type are invalid until the answer arrives. Receiving threads never wait for it: any peer can
    send unknown messages and leave queries unanswered.
    """

    def __init__(
        self, find: Callable[[Collection[SchemaId]], Schemas], *, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._find = find
        self._now = now
        self._newer: dict[str, dict[int, Sequence[str]]] = {}
        self._codecs: dict[SchemaId, Codec[Any]] = {}
        self._used: dict[SchemaId, float] = {}  # monotonic time of the last use of each codec [s]
        self._full = False
        self._changed = threading.Condition()  # guards all below
        self._thread: threading.Thread | None = None
        self._closed = False
        self._open: dict[SchemaId, object] = {}  # publisher of each open lookup, queried lookups first
        self._failed: dict[SchemaId, tuple[int, float, object]] = {}  # failures, time of the next query, publisher
        self._wait_budget, self._budget_time = TIMINGS.definition_timeout, float("-inf")  # [s], at the last failed wait

    def newer(self, definition: Definition[Any]) -> Mapping[int, Sequence[str]]:
        """Return the newer layouts of a message found so far, in the form that `decode` expects."""
        return self._newer.get(definition.name, {})

    def codec(self, name: str, identity: str, *, publisher: object = None, wait: bool = False) -> Codec[Any] | None:
        """Return the codec of a message that is not built in; None if unknown, which starts a lookup.

        `publisher`: after a failed lookup, a lookup for another publisher starts at once, without backoff.
        `wait`: wait for a lookup in progress, up to 3 s; never use it on a receiving thread.
        """
        schema_id = name, identity
        codec = self._codecs.get(schema_id)
        if codec is None:
            self._request(schema_id, publisher)
            if wait:
                self.wait(schema_id)
                codec = self._codecs.get(schema_id)
        if codec is not None:
            self._used[schema_id] = self._now()
        return codec

    def check(self, codec: Codec[Any], payload: bytes) -> None:
        """Validate a payload; raise DecodeError if it is invalid or of an unknown layout, which starts a lookup."""
        name = codec.definition.name
        try:
            codec.decode(payload, newer=self._newer.get(name))
        except UnknownLayoutError as exc:
            if MESSAGES.get(name) is codec.definition:  # other messages have a single layout
                self._request((name, exc.layout))
            raise

    def wait(self, schema_id: SchemaId | None = None) -> None:
        """Wait for one lookup or for all, up to 3 s; never call it on a receiving thread."""
        with self._changed:
            start = time.monotonic()
            longest = TIMINGS.definition_timeout
            budget = min(longest, self._wait_budget + _BUDGET_RATE * (start - self._budget_time))
            is_pending = self._open.__len__ if schema_id is None else partial(self._open.__contains__, schema_id)
            self._changed.wait_for(lambda: self._closed or not is_pending(), longest if schema_id is None else budget)
            if schema_id is not None and schema_id not in self._codecs:
                self._budget_time = time.monotonic()
                self._wait_budget = max(0.0, budget - (self._budget_time - start))

    def close(self) -> None:
        """Start no more lookups and wait for the one in progress."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
            thread = self._thread
        if thread is not None:
            join_thread(thread, TIMINGS.definition_timeout)

    def _request(self, schema_id: SchemaId, publisher: object = None) -> None:
        with self._changed:
            _, due, failed = self._failed.get(schema_id, (0, float("-inf"), None))
            is_due = self._now() >= due or publisher != failed
            is_known = schema_id in self._codecs or schema_id[1] in self._newer.get(schema_id[0], ())
            if self._closed or is_known or not is_due or len(self._open) >= 2 * _MAX_UNKNOWN:
                return
            self._open[schema_id] = publisher
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="nedbus-layouts", daemon=True)
                self._thread.start()

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._closed or not self._open:
                    self._thread = None
                    return
                queried = dict(islice(self._open.items(), _MAX_UNKNOWN))
            added: list[SchemaId] = []
            try:
                with suppress(NedbusError):  # the session is closed
                    found = self._find(queried)
                    added = [each for each in queried if each in found and self._add(each, found[each])]
            finally:
                self._finish_query(queried, added)

    def _finish_query(self, queried: Mapping[SchemaId, object], added: Collection[SchemaId]) -> None:
        with self._changed:
            for schema_id, queried_publisher in queried.items():
                publisher = self._open.pop(schema_id)
                failures = self._failed.pop(schema_id, (0,))[0]
                if schema_id not in added and publisher != queried_publisher:
                    self._open[schema_id] = publisher  # this publisher may have appeared after the query
                elif schema_id not in added:
                    pause = _PAUSES[min(failures, len(_PAUSES) - 1)]
                    self._failed[schema_id] = failures + 1, self._now() + pause, publisher
            while len(self._failed) > _MAX_FAILED:
                del self._failed[next(iter(self._failed))]
            self._changed.notify_all()
            if not added:
                self._changed.wait_for(lambda: self._closed, _QUERY_PAUSE)

    def _add(self, schema_id: SchemaId, fields: Mapping[str, str]) -> bool:
        name, which = schema_id
        return self._add_layout(name, which, fields) if isinstance(which, int) else self._define(name, which, fields)

    def _define(self, name: str, identity: str, fields: Mapping[str, str]) -> bool:
        if not self._evict(len(fields) + _BASE):
            if not self._full:
                text = "%s is not decoded, because too many definitions from publishers are in use"
                _log.warning(text, name, extra=about("invalid"))
            self._full = True
            return False
        try:
            definition = define(name, ((field, field_type(kind)) for field, kind in fields.items()))
        except ValueError as exc:
            _log.warning("ignored a peer's definition of %s: %s", name, str(exc)[:_MAX_TEXT], extra=about("invalid"))
            return False
        self._codecs[name, identity], self._used[name, identity] = codec_of(definition), self._now()
        text = "%s is not built in: using the publisher's definition"
        _log.info(text, name, extra=about("runtime_definition", reason=f"hash {identity}"))
        return True

    def _evict(self, size: int) -> bool:
        """Evict unused definitions, least recently used first; return False if that frees too little."""
        known = sorted(self._codecs, key=self._used.__getitem__)
        free = _MAX_FIELDS - sum(len(self._codecs[schema_id].definition.types) + _BASE for schema_id in known)
        for schema_id in known:
            if free >= size or self._now() - self._used[schema_id] < _IN_USE:
                break
            free += len(self._codecs.pop(schema_id).definition.types) + _BASE
            del self._used[schema_id]
        return free >= size

    def _add_layout(self, name: str, number: int, fields: Mapping[str, str]) -> bool:
        definition, newer = MESSAGES[name], self._newer.get(name, {})
        if len(newer) >= _MAX_LAYOUTS:
            return False
        self._newer[name] = {**newer, number: tuple(fields)}
        ignored = ", ".join(field for field in fields if field not in definition.types)[:_MAX_TEXT] or "nothing"
        text = "layout %d of %s is newer than this reader; ignored fields: %s"
        _log.warning(text, number, name, ignored, extra=about("newer_layout"))
        return True


@dataclass(slots=True)
class _Field:
    name: str
    type: str


@dataclass(slots=True)
class _Layout:
    wire: int
    fields: Annotated[list[_Field], Field(max_length=_MAX_REPLY_FIELDS)]


_LAYOUT: Final = TypeAdapter(_Layout)


def find_schemas(ids: Collection[SchemaId], *, session: Session, prefix: str) -> Schemas:
    """Query publishers for the fields of these layouts and definitions; the first reply for each one wins.

    Returns once all are found, without waiting for stopped publishers or bad links.
    """
    found: dict[SchemaId, dict[str, str]] = {}
    keys = {
        schema_key(name, prefix=prefix) + (f"?hash={which}" if isinstance(which, str) else "") for name, which in ids
    }
    queries = [send_query(session, key, timeout=TIMINGS.definition_timeout) for key in keys]
    replies = islice(wait_for_replies(queries), MAX_REPLIES)
    for key, content in parse_replies(reply.ok for reply in replies if reply.ok is not None):
        name = key.rpartition("/")[2]
        layouts = content.get("layouts") if isinstance(content, dict) else None
        for layout in layouts[:_MAX_REPLY_LAYOUTS] if isinstance(layouts, list) else ():
            with suppress(ValueError):
                parsed = _LAYOUT.validate_python(layout)
                fields = {field.name: field.type for field in parsed.fields}
                # Compute the hash from the fields: the peer's own `hash` is untrusted.
                types = {} if name in MESSAGES else {field: field_type(kind) for field, kind in fields.items()}
                which = short_hash(name, types) if types else parsed.wire
                if len(fields) == len(parsed.fields) and (name, which) in ids:
                    found.setdefault((name, which), fields)
        if len(found) == len(ids):
            break
    return found
