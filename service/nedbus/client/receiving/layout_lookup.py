"""Lookup of messages and layouts that have no file here: publishers describe them."""

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

_MAX_LAYOUTS: Final = 16  # newer layouts of a message, and messages without a file here that are remembered
_MAX_MESSAGES: Final = 256
_MAX_UNKNOWN: Final = 64  # that are asked for at once
_PAUSES: Final = (0.0, 2.0, 5.0, 10.0, 30.0, 60.0)  # s after a question, by the number of those in vain
_MAX_TEXT: Final = 300  # characters of names that a publisher wrote
_JOIN_TIMEOUT: Final = 3.0  # s

Schemas = Mapping[str, Mapping[int, Mapping[str, str]]]
"""Types of fields by name, by the number of their layout, by the message, as publishers know them."""


class LayoutLookup:
    """Ask publishers, through `find`, for messages that are not known here, by name, in a thread of its own.

    Such a message is invalid until the answer is there: a thread that receives never waits for it, as any peer can
    send unknown messages, and leave questions unanswered.
    """

    def __init__(
        self, find: Callable[[Collection[str]], Schemas], *, now: Callable[[], float] = time.monotonic
    ) -> None:
        self._find = find
        self._now = now
        self._newer: dict[str, dict[int, Sequence[str]]] = {}
        self._defined: dict[str, Definition[Any]] = {}
        self._asking = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._unknown: set[tuple[str, int | None]] = set()  # since the last question
        self._in_vain = 0
        self._next_ask = float("-inf")

    def newer(self, definition: Definition[Any]) -> Mapping[int, Sequence[str]]:
        """Return the layouts of a message that were found, as `decode` takes them."""
        return self._newer.get(definition.name, {})

    def definition(self, name: str) -> Definition[Any]:
        """Return a message by its name; raise DecodeError for one that is not known yet."""
        found = MESSAGES.get(name) or self._defined.get(name)
        if found is None:
            self._ask(name, None)
            raise DecodeError(f"no publisher has described a {name} so far", name)
        return found

    def check(self, codec: Codec[Any], payload: bytes) -> None:
        """Decode a payload; raise DecodeError for what is not a message, or of a layout that is not known yet."""
        name = codec.definition.name
        try:
            codec.decode(payload, newer=self._newer.get(name))
        except UnknownLayoutError as exc:
            self._ask(name, exc.layout)
            raise

    def wait(self) -> None:
        """Wait for the answers to open questions: not for a thread that receives."""
        end, last = time.monotonic() + _JOIN_TIMEOUT, None
        while (thread := self._thread) is not last and thread is not None:
            thread.join(max(0.0, end - time.monotonic()))
            last = thread

    def close(self) -> None:
        """Ask no more, and wait for the end of an open question."""
        with self._asking:
            self._closed = True
        self.wait()

    def _ask(self, name: str, layout: int | None) -> None:
        with self._asking:
            if len(self._unknown) < _MAX_UNKNOWN:
                self._unknown.add((name, layout))
            self._ask_if_due()

    def _ask_if_due(self) -> None:
        self._unknown = {each for each in self._unknown if not self._is_known(*each)}  # meanwhile, perhaps
        if self._unknown and self._now() >= self._next_ask and not self._closed:
            self._next_ask = float("inf")  # while it is open
            unknown, self._unknown = self._unknown, set()
            self._thread = threading.Thread(target=self._run, args=(unknown,), name="nedbus-layouts", daemon=True)
            self._thread.start()

    def _is_known(self, name: str, layout: int | None) -> bool:
        return name in self._defined if layout is None else layout in self._newer.get(name, ())

    def _run(self, unknown: Collection[tuple[str, int | None]]) -> None:
        found: Schemas = {}
        learnt = 0
        try:
            with suppress(NedbusError):  # the session is closed
                found = self._find({name for name, _ in unknown})
            for name, layout in unknown:
                learnt += self._define(name, found) if layout is None else self._add(name, layout, found)
        finally:
            with self._asking:
                self._in_vain = 0 if learnt else min(self._in_vain + 1, len(_PAUSES) - 1)
                self._next_ask = self._now() + _PAUSES[self._in_vain]
                self._ask_if_due()

    def _define(self, name: str, found: Schemas) -> bool:
        """Define a message as a publisher describes it, by its newest layout."""
        layouts = found.get(name)
        if not layouts or len(self._defined) >= _MAX_MESSAGES:
            return False
        try:
            fields = ((field, field_type(kind)) for field, kind in layouts[max(layouts)].items())
            self._defined[name] = define(name, fields)
        except ValueError as exc:
            _log.warning("%s: a publisher describes no message: %s", name, str(exc)[:_MAX_TEXT], extra=about("invalid"))
            return False
        _log.info("%s has no file here: it is read as its publisher describes it", name, extra=about("described"))
        return True

    def _add(self, name: str, number: int, found: Schemas) -> bool:
        """Add a newer layout of a message."""
        definition, newer = MESSAGES.get(name) or self._defined.get(name), self._newer.get(name, {})
        fields = found.get(name, {}).get(number)
        if definition is None or fields is None or number in newer or len(newer) >= _MAX_LAYOUTS:
            return False
        self._newer[name] = {**newer, number: tuple(fields)}
        unread = ", ".join(field for field in fields if field not in definition.types)[:_MAX_TEXT] or "nothing"
        extra = about("newer-layout")
        _log.warning("layout %d of %s is newer than this reader; not read: %s", number, name, unread, extra=extra)
        return True
