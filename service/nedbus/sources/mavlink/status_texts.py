"""Joins the chunks of STATUSTEXT to whole texts; no I/O, no clock."""

from __future__ import annotations

from collections import deque
from typing import Any, Final, NamedTuple

from nedbus.ulog import to_statement
from nedbus_msgs import decode_text

_TIMEOUT: Final = 2.0  # s for the rest of a text, which is published without it then
_CHUNK: Final = 50  # bytes; a shorter one is the last
_MAX_WAITING: Final = 100  # texts
_MAX_BYTES: Final = 500
_DEBUG: Final = 7


class _Chunks(NamedTuple):
    severity: int
    number: int
    data: bytes
    next: int
    time: float


class StatusTexts:
    """The texts of one vehicle."""

    def __init__(self) -> None:
        self._open: _Chunks | None = None
        self._waiting: deque[dict[str, object]] = deque(maxlen=_MAX_WAITING)

    def add(self, message: Any, now: float) -> None:
        """Take a STATUSTEXT; chunks that are missing leave "..."."""
        data, number, sequence = message._text_raw, message.id, message.chunk_seq  # noqa: SLF001 - `text` is ASCII only
        known, severity = self._open, min(message.severity, _DEBUG)
        if known and (known.number != number or sequence < known.next or known.severity != severity):
            self._finish()
            known = None
        begin, expected = (known.data, known.next) if known else (b"", 0)
        gap = b"" if sequence == expected else b"..."
        text = (begin + gap + data.partition(b"\0")[0])[:_MAX_BYTES]
        self._open = _Chunks(severity, number, text, sequence + 1, now)
        if not number or len(data) < _CHUNK or b"\0" in data:
            self._finish()

    def take(self, now: float) -> dict[str, object]:
        """Return severity and text of the next statement; nothing if none is complete or timed out."""
        if self._open and now - self._open.time > _TIMEOUT:
            self._finish("...")
        return self._waiting.popleft() if self._waiting else {}

    def _finish(self, end: str = "") -> None:
        if self._open:
            text = to_statement(decode_text(self._open.data) + end)
            self._waiting.append({"severity": self._open.severity, "text": text})
        self._open = None
