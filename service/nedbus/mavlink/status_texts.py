"""STATUSTEXT messages of one vehicle: chunks joined, copies left out; no I/O, callers pass monotonic time [s]."""

from collections import Counter, deque
from typing import Any, Final, NamedTuple

from nedbus import limits
from nedbus.ulog import to_log_text
from nedbus_msgs import decode_text

_WINDOW: Final = 10.0  # s; a second link that is later delivers its texts again
_CHUNK_TIMEOUT: Final = 2.0  # s for the next chunk of a text; then it ends with "..."
_CHUNK: Final = 50  # bytes; a shorter chunk is the last
_DEBUG: Final = 7  # the last severity
_GAP: Final = "..."  # in place of missing chunks


class _Delivery(NamedTuple):
    time: float
    link: int
    text: tuple[int, int, bytes]  # severity, number of the chunk, and its bytes


class TextCopies:
    """The STATUSTEXT messages of one vehicle in the last seconds, by link.

    The links of a vehicle carry the same texts, under sequence numbers and chunk ids of their own. A text that comes
    over one link for the second time is new, unless another link has delivered it twice.
    """

    def __init__(self) -> None:
        self._recent: deque[_Delivery] = deque(maxlen=limits.MAVLINK_TEXTS)

    def add(self, message: Any, link: int, now: float) -> bool:
        """Add a text that came over a link; return whether it is a copy of one from another link."""
        recent = self._recent
        while recent and now - recent[0].time > _WINDOW:
            recent.popleft()
        text = (message.severity, message.chunk_seq, _raw_text(message))
        recent.append(_Delivery(now, link, text))
        deliveries = Counter(earlier.link for earlier in recent if earlier.text == text)
        own = deliveries.pop(link)
        return own <= max(deliveries.values(), default=0)


class StatusTexts:
    """Join the STATUSTEXT chunks of one vehicle; complete texts wait until they are taken."""

    def __init__(self) -> None:
        self._waiting: deque[dict[str, object]] = deque(maxlen=limits.MAVLINK_TEXTS)
        # the incomplete text
        self._severity = 0
        self._id = 0
        self._data = b""
        self._next = 0  # number of its next chunk; 0 if there is none
        self._time = 0.0  # of its last chunk

    def add(self, message: Any, now: float) -> None:
        """Add a STATUSTEXT; a missing chunk becomes "..."."""
        severity = min(message.severity, _DEBUG)
        if self._next and not self._continues(severity, message.id, message.chunk_seq):
            self._finish(_GAP)
        if message.chunk_seq > self._next:
            self._data += _GAP.encode()
        chunk, _, _ = _raw_text(message).partition(b"\0")
        self._data += chunk  # of at most 256 chunks
        self._severity = severity
        self._id = message.id
        self._next = message.chunk_seq + 1
        self._time = now
        has_more = message.id and len(chunk) == _CHUNK
        if not has_more:
            self._finish()

    def pop(self, now: float) -> dict[str, object]:
        """Remove the next text that is complete or has timed out; return its fields, or {} if there is none."""
        if self._next and now - self._time > _CHUNK_TIMEOUT:
            self._finish(_GAP)
        if not self._waiting:
            return {}
        return self._waiting.popleft()

    def _continues(self, severity: int, text_id: int, chunk: int) -> bool:
        return severity == self._severity and text_id == self._id and chunk >= self._next

    def _finish(self, end: str = "") -> None:
        text = to_log_text(decode_text(self._data) + end)
        self._waiting.append({"severity": self._severity, "text": text})
        self._data = b""
        self._next = 0


def _raw_text(message: Any) -> bytes:
    """Return the bytes of a text, because pymavlink's `text` is ASCII only."""
    raw: bytes = message._text_raw  # noqa: SLF001 - pymavlink has no public name
    return raw
