"""Layouts that are newer than this reader: which are known by now, and when to ask for an unknown one."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from nedbus.log_event import about
from nedbus_msgs import FIELD_TYPES, UnknownLayoutError, decode

_log = logging.getLogger(__name__)

_MAX_LAYOUTS: Final = 16  # unknown layouts that are remembered
_ASK_AGAIN: Final = 10.0  # s until a layout that no publisher explained is asked for again


FindLayout = Callable[[int], Sequence[str] | None]
"""From the number of a layout to its field names; None if no publisher knows it."""


class LayoutLookup:
    """Ask publishers, through `find`, for the field names of layouts that are not known here; each at most every 10 s.

    `newer`: the field names that were found, by the number of the layout, as `decode` takes them.
    """

    def __init__(self, find: FindLayout, *, now: Callable[[], float] = time.monotonic) -> None:
        self.newer: Mapping[int, Sequence[str]] = {}
        self._find = find
        self._now = now
        self._next_ask: dict[int, float] = {}

    def check(self, payload: bytes) -> None:
        """Decode a payload, asking for its layout if that is unknown; raise DecodeError for what is not a message."""
        try:
            decode(payload, newer=self.newer)
        except UnknownLayoutError as exc:
            self._ask(exc.layout)
            if exc.layout not in self.newer:
                raise

    def _ask(self, layout: int) -> None:
        if layout not in self._next_ask and len(self._next_ask) >= _MAX_LAYOUTS:
            return
        if self._now() < self._next_ask.get(layout, float("-inf")):
            return
        fields = self._find(layout)
        self._next_ask[layout] = self._now() + _ASK_AGAIN
        if fields is not None:
            self.newer = {**self.newer, layout: fields}
            unread = [name for name in fields if name not in FIELD_TYPES]
            names = ", ".join(unread) or "nothing"
            extra = about("newer-layout")
            _log.warning("layout %d is newer than this reader; not read: %s", layout, names, extra=extra)
