"""Texts that came before over another link; no I/O, callers pass monotonic time [s]."""

from collections import Counter, deque
from typing import Any, Final

_WINDOW: Final = 10.0  # s; a second link that is later delivers its texts again
_MEMORY: Final = 256  # texts in that time


class TextCopies:
    """The STATUSTEXT messages of one vehicle in the last seconds, by link.

    The links of a vehicle carry the same texts, under sequence numbers and chunk ids of their own. A text that comes
    over one link for the second time is new, unless another link has delivered it twice.
    """

    def __init__(self) -> None:
        # time, text and link
        self._recent: deque[tuple[float, tuple[int, int, bytes], int]] = deque(maxlen=_MEMORY)

    def add(self, message: Any, link: int, now: float) -> bool:
        """Add a text that came over a link; return whether it is a copy of one from another link."""
        recent = self._recent
        while recent and now - recent[0][0] > _WINDOW:
            recent.popleft()
        raw = message._text_raw  # noqa: SLF001 - `text` is ASCII only
        text = message.severity, message.chunk_seq, raw
        deliveries = Counter(other for _, earlier, other in recent if earlier == text)
        recent.append((now, text, link))
        own = deliveries.pop(link, 0) + 1
        return own <= max(deliveries.values(), default=0)
