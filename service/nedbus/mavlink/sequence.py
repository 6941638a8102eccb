"""Losses between numbered packets; no I/O, callers pass monotonic time [s]."""

from typing import Final

_MODULUS: Final = 256  # of MAVLink's sequence
_FACTOR: Final = 4.0  # times the usual rate; a faster jump of the sequence is a restart of the sender's counter
_MARGIN: Final = 20  # packets that may be lost at once, whatever the rate
_SILENCE: Final = 3.0  # s after which the sequence has no relation to the earlier one
_WINDOW: Final = 10.0  # s over which the rate is measured


class PacketRate:
    """Mean rate at which a sender's packets arrive, over the last 5 to 10 s."""

    def __init__(self) -> None:
        self._count, self._first, self._last = 0.0, 0.0, 0.0

    def add(self, now: float) -> None:
        """Add a packet; lost ones would let wrong losses explain further ones."""
        if not self._count:
            self._first = now
        self._count, self._last = self._count + 1, now
        if now - self._first > _WINDOW:
            self._count, self._first = self._count / 2, (self._first + now) / 2

    def expected(self, now: float) -> float:
        """Return the number of packets that usually arrive in the time since the last one."""
        seconds = self._last - self._first
        return self._count / seconds * max(0.0, now - self._last) if seconds > 0 else 0.0

    def explains(self, lost: int, now: float, *, margin: int = _MARGIN) -> bool:
        """Return whether this number of packets can be lost since the last one; if not, the sender restarted.

        Before the first packet nothing is known, as in a stream that continues that of an earlier process.
        """
        return not self._count or lost <= margin + _FACTOR * self.expected(now)


class SequenceCounter:
    """Count the MAVLink messages of one sender that were lost."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._other: int | None = None  # number in the last packet of another link to the same sender
        self._rate, self._time = PacketRate(), 0.0

    def add(self, sequence: int, now: float) -> int:
        """Return the number of messages lost before this one, -1 if it is late: it was counted as lost."""
        if self._last is None or now - self._time > _SILENCE:
            self._last, self._rate = (sequence - 1) % _MODULUS, PacketRate()
        self._time = now
        step = (sequence - self._last) % _MODULUS
        if step != 1 and self._other is not None and (sequence - self._other) % _MODULUS == 1:
            self._other = sequence
            return 0
        if step > _MODULUS // 2:
            self._other = sequence
        if step > _MODULUS // 2 or not step:  # late, or a duplicate
            return -1 if step else 0
        is_explained = step == 1 or self._rate.explains(step - 1, now)
        if not is_explained:
            self._other = self._last
        self._last = sequence
        lost = step - 1 if is_explained else 0
        self._rate.add(now)
        return lost
