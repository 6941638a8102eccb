"""Layout lookup: ask publishers for message definitions and layouts that are not installed here."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus_msgs import MESSAGES, Codec, DecodeError, Definition, UnknownLayoutError, define, field_type

_log = logging.getLogger(__name__)

_MAX_LAYOUTS: Final = 16  # newer layouts per message
_MAX_MESSAGES: Final = 256  # messages defined by publishers
_MAX_UNKNOWN: Final = 64  # messages and layouts per query
_PAUSES: Final = (0.0, 2.0, 5.0, 10.0, 30.0, 60.0)  # s until the next query, by the number of failed ones in a row
_MAX_TEXT: Final = 300  # logged characters of names sent by a publisher
_JOIN_TIMEOUT: Final = 3.0  # s

Schemas = Mapping[str, Mapping[int, Mapping[str, str]]]
"""Descriptions by publishers: message name to layout number to field name to type."""


class LayoutLookup:
    """Look up unknown messages and layouts with `find`, which queries publishers, in a background thread.

    Messages of an unknown type are invalid until the answer arrives. Receiving threads never wait for it: any peer can
    send unknown messages and leave queries unanswered.
    """

    def __init__(
        self, find: Callable[[Collection[str]], Schemas], *, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._find = find
        self._now = now
        self._newer: dict[str, dict[int, Sequence[str]]] = {}
        self._defined: dict[str, Definition[Any]] = {}
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._unknown: set[tuple[str, int | None]] = set()  # since the last query
        self._failures = 0
        self._next_request = float("-inf")

    def newer(self, definition: Definition[Any]) -> Mapping[int, Sequence[str]]:
        """Return the newer layouts of a message found so far, in the form that `decode` expects."""
        return self._newer.get(definition.name, {})

    def definition(self, name: str) -> Definition[Any]:
        """Return the definition of a message; raise DecodeError and start a lookup if it is unknown."""
        found = MESSAGES.get(name) or self._defined.get(name)
        if found is None:
            self._request(name, None)
            raise DecodeError(f"no publisher has described {name} yet", name)
        return found

    def check(self, codec: Codec[Any], payload: bytes) -> None:
        """Validate a payload; raise DecodeError if it is invalid or of an unknown layout, which starts a lookup."""
        name = codec.definition.name
        try:
            codec.decode(payload, newer=self._newer.get(name))
        except UnknownLayoutError as exc:
            self._request(name, exc.layout)
            raise

    def wait(self) -> None:
        """Wait for lookups in progress, up to 3 s; never call it on a receiving thread."""
        end, last = time.monotonic() + _JOIN_TIMEOUT, None
        while (thread := self._thread) is not last and thread is not None:
            thread.join(max(0.0, end - time.monotonic()))
            last = thread

    def close(self) -> None:
        """Start no more lookups and wait for the one in progress."""
        with self._lock:
            self._closed = True
        self.wait()

    def _request(self, name: str, layout: int | None) -> None:
        with self._lock:
            if len(self._unknown) < _MAX_UNKNOWN:
                self._unknown.add((name, layout))
            self._request_if_due()

    def _request_if_due(self) -> None:
        self._unknown = {each for each in self._unknown if not self._is_known(*each)}  # an answer may have arrived
        if self._unknown and self._now() >= self._next_request and not self._closed:
            self._next_request = float("inf")  # until this query ends
            unknown, self._unknown = self._unknown, set()
            thread = threading.Thread(target=self._run, args=(unknown,), name="nedbus-layouts", daemon=True)
            thread.start()
            self._thread = thread  # started, since `wait` joins it without the lock

    def _is_known(self, name: str, layout: int | None) -> bool:
        return name in self._defined if layout is None else layout in self._newer.get(name, ())

    def _run(self, unknown: Collection[tuple[str, int | None]]) -> None:
        found: Schemas = {}
        added = 0
        try:
            with suppress(NedbusError):  # the session is closed
                found = self._find({name for name, _ in unknown})
            for name, layout in unknown:
                added += self._define(name, found) if layout is None else self._add_layout(name, layout, found)
        finally:
            with self._lock:
                self._failures = 0 if added else min(self._failures + 1, len(_PAUSES) - 1)
                self._next_request = self._now() + _PAUSES[self._failures]
                self._request_if_due()

    def _define(self, name: str, found: Schemas) -> bool:
        """Define a message by the newest layout that a publisher describes."""
        layouts = found.get(name)
        if not layouts or len(self._defined) >= _MAX_MESSAGES:
            return False
        try:
            fields = ((field, field_type(kind)) for field, kind in layouts[max(layouts)].items())
            self._defined[name] = define(name, fields)
        except ValueError as exc:
            _log.warning("%s: invalid description by a peer: %s", name, str(exc)[:_MAX_TEXT], extra=about("invalid"))
            return False
        _log.info("%s is not installed here: using the publisher's description", name, extra=about("described"))
        return True

    def _add_layout(self, name: str, number: int, found: Schemas) -> bool:
        """Add a newer layout of a message."""
        definition, newer = MESSAGES.get(name) or self._defined.get(name), self._newer.get(name, {})
        fields = found.get(name, {}).get(number)
        if definition is None or fields is None or number in newer or len(newer) >= _MAX_LAYOUTS:
            return False
        self._newer[name] = {**newer, number: tuple(fields)}
        ignored = ", ".join(field for field in fields if field not in definition.types)[:_MAX_TEXT] or "nothing"
        extra = about("newer-layout")
        _log.warning("layout %d of %s is newer than this reader; not read: %s", number, name, ignored, extra=extra)
        return True
