"""Reassembly of PX4's ULog stream from LOGGING_DATA and LOGGING_DATA_ACKED; no I/O, callers pass monotonic time [s]."""

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

from .sequence import PacketRate

_MAGIC: Final = b"ULog\x01\x12\x35"  # the first bytes of a ULog file
_DATA_BYTES: Final = 249  # bytes of `data` in a message
_NO_RECORD_BEGINS: Final = 255  # first_message_offset
_MODULUS: Final = 2**16  # modulus of the sequence
_NEWER_STEP: Final = 2**15  # a larger sequence step means a duplicate
_MARGIN: Final = 100  # messages that may be lost at once; PX4 loses up to 65 in a burst
# s of messages that a full buffer on the way may drop without a visible pause
_BUFFERED: Final = 1.0
_OLD_RUN: Final = 256  # consecutive old sequence numbers that mean a gap of more than _NEWER_STEP

Verdict = Literal["delivered", "duplicate", "malformed", "unsynchronised", "no_definitions"]
"""Classification of a message.

`delivered`: its bytes are part of the stream; after a gap, only the bytes from its first record on.
`duplicate`: retransmitted or late; a late message was counted as lost, and its bytes are discarded.
`malformed`: `length` is above 249, or first_message_offset is beyond the data; it is counted as lost.
`unsynchronised`: no record begins in it, after a gap.
`no_definitions`: the stream was joined midway, so it cannot be decoded; its losses are not counted.
"""


class Chunk(NamedTuple):
    """Result of one LOGGING_DATA or LOGGING_DATA_ACKED.

    `data`: bytes for the ULog parser; empty unless `verdict` is `delivered`.
    `begins`: a new stream, which needs a new parser, begins with `data`.
    `lost`: number of messages lost before this one; if time and rate cannot explain it, the counter restarted: 1.
    After a loss the parser must discard its partial record before `data`.
    `offset`: of the first record that begins in `data`, beyond its end if none does.
    """

    verdict: Verdict
    data: bytes = b""
    begins: bool = False
    lost: int = 0
    offset: int = 0


class Reassembly:
    """Reassemble the successive ULog streams of one vehicle since its boot.

    After a reboot create a new instance, because the header may have the same bytes as before.
    A lost message contains at most 249 bytes; each gap loses at least one ULog record.
    """

    def __init__(self) -> None:
        self._old_next = self._old_run = 0
        # data of the first message, to distinguish its retransmission from a new stream
        self._first = b""
        self._last: int | None = None  # last sequence; None before the first stream
        self._synchronised = False
        self._rate = PacketRate()

    @property
    def is_new(self) -> bool:
        """True before the first stream."""
        return self._last is None

    def resume(self, sequence: int) -> None:
        """Continue a stream whose last known message has this sequence; the next record begins a contiguous part."""
        self._last, self._synchronised = sequence, False

    def add(
        self,
        sequence: int,
        length: int,
        first_message_offset: int,
        data: Sequence[int],
        now: float | None = None,
    ) -> Chunk:
        """Add the next message; `data` may lack trailing zeros, which MAVLink 2 does not transmit.

        `now`: time of arrival [s]; without it, each loss is taken as the sequence shows it.
        """
        content = bytes(data[:length]).ljust(length, b"\0")
        if length > _DATA_BYTES or (
            first_message_offset >= length and first_message_offset != _NO_RECORD_BEGINS
        ):
            return Chunk("malformed")
        if sequence == 0 and content.startswith(_MAGIC) and content != self._first:
            self._first = content
            self._last = 0
            self._synchronised = True
            self._old_run = 0
            self._rate = PacketRate()
            self._rate.add(now or 0.0)
            return Chunk("delivered", content, begins=True)
        if self._last is None:
            return Chunk("no_definitions")
        step = (sequence - self._last) % _MODULUS
        if step == 0 or (step > _NEWER_STEP and not self._is_ahead(sequence)):
            return Chunk("duplicate")
        self._last = sequence
        self._old_run = 0
        lost = step - 1
        if now is not None:
            if lost:
                lost += _MODULUS * max(0, round((self._rate.expected(now) - lost) / _MODULUS))
                lost = lost if self._rate.explains(lost, now + _BUFFERED, margin=_MARGIN) else 1
            self._rate.add(now)
        is_contiguous = self._synchronised and not lost
        self._synchronised = is_contiguous or first_message_offset != _NO_RECORD_BEGINS
        skipped = 0 if is_contiguous else min(first_message_offset, len(content))
        verdict: Verdict = "delivered" if self._synchronised else "unsynchronised"
        offset = first_message_offset - skipped if self._synchronised else 0
        return Chunk(verdict, content[skipped:], lost=lost, offset=offset)

    def _is_ahead(self, sequence: int) -> bool:
        """Return whether a run of old sequence numbers shows a gap of more than 32,768 messages."""
        self._old_run = self._old_run + 1 if sequence == self._old_next else 1
        self._old_next = (sequence + 1) % _MODULUS
        return self._old_run >= _OLD_RUN
