"""Joins the chunks of STATUSTEXT to whole texts; no I/O, no clock."""

from collections import deque
from typing import Any, Final

from nedbus.ulog import to_statement
from nedbus_msgs import decode_text

_TIMEOUT: Final = 2.0  # s for the next chunk; then the text ends with "..."
_CHUNK: Final = 50  # bytes; a shorter one is the last
_MAX_WAITING: Final = 100  # texts
_MAX_BYTES: Final = 500
_DEBUG: Final = 7


class StatusTexts:
    """The texts of one vehicle, as severity and text."""

    def __init__(self) -> None:
        self._of = (0, 0)  # severity and id of the text that is not complete
        self._data, self._next, self._time = b"", 0, 0.0
        self._waiting: deque[dict[str, object]] = deque(maxlen=_MAX_WAITING)

    def add(self, message: Any, now: float) -> None:
        """Take a STATUSTEXT; chunks that are missing leave "..."."""
        data, sequence = message._text_raw, message.chunk_seq  # noqa: SLF001 - `text` is ASCII only
        of = min(message.severity, _DEBUG), message.id
        if self._next and (self._of != of or sequence < self._next):
            self._finish("...")
        gap = b"..." if sequence > self._next else b""
        self._data = (self._data + gap + data.partition(b"\0")[0])[:_MAX_BYTES]
        self._of, self._next, self._time = of, sequence + 1, now
        if not message.id or len(data) < _CHUNK or b"\0" in data:
            self._finish()

    def take(self, now: float) -> dict[str, object]:
        """Return severity and text of the next statement; nothing if none is complete or timed out."""
        if self._next and now - self._time > _TIMEOUT:
            self._finish("...")
        return self._waiting.popleft() if self._waiting else {}

    def _finish(self, end: str = "") -> None:
        self._waiting.append({"severity": self._of[0], "text": to_statement(decode_text(self._data) + end)})
        self._data, self._next = b"", 0
