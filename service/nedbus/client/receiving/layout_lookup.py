"""Layouts that are newer than this reader: which are known by now, and when to ask for those that are not."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Final

from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus_msgs import FIELD_TYPES, DecodeError, UnknownLayoutError, decode

_log = logging.getLogger(__name__)

_MAX_LAYOUTS: Final = 16  # newer layouts that are remembered
_MAX_UNKNOWN: Final = 256  # numbers that are asked for at once
_PAUSES: Final = (0.0, 2.0, 5.0, 10.0, 30.0, 60.0)  # s after a question, by how many explained nothing new
_MAX_TEXT: Final = 300  # characters of names that a publisher wrote
_JOIN: Final = 3.0  # s

Layouts = Mapping[int, Sequence[str]]  # field names, by the number of the layout


class LayoutLookup:
    """Ask publishers, through `find`, for layouts that are not known here: one question for all, in its own thread.

    A message of such a layout is invalid until the answer is there: whoever receives never waits for it, as any peer
    can send messages of unknown layouts, and leave questions unanswered.

    `newer`: the layouts that were found, as `decode` takes them.
    """

    def __init__(self, find: Callable[[], Layouts], *, now: Callable[[], float] = time.monotonic) -> None:
        self.newer: Layouts = {}
        self._find = find
        self._now = now
        self._asking = threading.Lock()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._unknown: set[int] = set()  # numbers of layouts, since the last question
        self._in_vain = 0
        self._next_ask = float("-inf")

    def check(self, payload: bytes) -> None:
        """Decode a payload; raise DecodeError for what is not a message, or of a layout that is not known yet."""
        try:
            decode(payload, newer=self.newer)
        except UnknownLayoutError as exc:
            if len(self._unknown) < _MAX_UNKNOWN:
                self._unknown.add(exc.layout)
            self._ask()
            raise

    def learn(self, payloads: Iterable[bytes]) -> None:
        """Ask for the layouts of these payloads, and wait for the answer: for a thread on which nothing arrives."""
        for payload in payloads:
            with suppress(DecodeError):
                self.check(payload)
        if self._thread is not None:
            self._thread.join(_JOIN)

    def close(self) -> None:
        """Ask no more, and wait for the end of an open question."""
        with self._asking:
            self._closed = True
        if self._thread is not None:
            self._thread.join(_JOIN)

    def _ask(self) -> None:
        with self._asking:
            if self._now() < self._next_ask or self._closed or len(self.newer) >= _MAX_LAYOUTS:
                return
            self._next_ask = float("inf")  # while it is open
            self._thread = threading.Thread(target=self._run, name="nedbus-layouts", daemon=True)
            self._thread.start()

    def _run(self) -> None:
        found: Layouts = {}
        unknown, self._unknown = self._unknown, set()
        try:
            with suppress(NedbusError):  # the session is closed
                found = self._find()
        finally:
            new = [*found.keys() & unknown - self.newer.keys()][: _MAX_LAYOUTS - len(self.newer)]
            self.newer = {**self.newer, **{number: found[number] for number in new}}
            for number in new:
                unread = ", ".join(name for name in found[number] if name not in FIELD_TYPES)[:_MAX_TEXT] or "nothing"
                extra = about("newer-layout")
                _log.warning("layout %d is newer than this reader; not read: %s", number, unread, extra=extra)
            self._in_vain = 0 if new else min(self._in_vain + 1, len(_PAUSES) - 1)
            self._next_ask = self._now() + _PAUSES[self._in_vain]
