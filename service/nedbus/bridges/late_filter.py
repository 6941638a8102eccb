"""Hold back samples that arrive late, by their publishers' own clocks; no I/O, and hosts are not compared."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Final

from nedbus.client import Sample
from nedbus_msgs import Address

MAX_LATENESS: Final = 10**9
"""Nanoseconds from which on a sample is late: it was recovered after an outage, or waited behind one that was."""

DRIFT: Final = 60 * 10**9
"""Nanoseconds for which the fastest sample counts: two clocks drift apart."""

_STANDING: Final = 1000  # ns between two timestamps of a clock that stands


class LateFilter:
    """Admit the current samples of each address, and count the rest.

    `last`: the last samples from before; they are held back, as their age is not known.
    """

    def __init__(self, last: Iterable[Sample] = ()) -> None:
        self._last = {sample.address: (_publisher(sample), sample.sent) for sample in last}
        self._clocks: dict[Address, tuple[str, PublisherClock]] = {}
        self._held = Counter[Address]()
        self._latest = 0  # ns that the latest of them was late

    def admits(self, sample: Sample, *, arrived: int) -> bool:
        """Return True for a current sample, and for one without a timestamp.

        `arrived` is in ns of this host's monotonic clock.
        """
        sent, address, publisher, late = sample.sent, sample.address, _publisher(sample), 0
        if sent is None:
            return True
        known, clock = self._clocks.get(address, ("", None))
        if clock is not None or (publisher, sent) != self._last.pop(address, None):
            if clock is None or known != publisher:
                clock = PublisherClock(sent, arrived)
                self._clocks[address] = publisher, clock
            late = clock.lateness(sent, arrived)
            if late <= MAX_LATENESS:
                return True
        self._held[address] += 1
        self._latest = max(self._latest, late)
        return False

    def forget(self, address: Address) -> None:
        """Forget the clock of an address that is no longer published."""
        self._clocks.pop(address, None)

    def report(self) -> str | None:
        """Return the number of samples held back since the last report, None if there were none."""
        if not self._held:
            return None
        first, *others = sorted(self._held)
        of = f"{first}" + (f" and {len(others)} others" if others else "")
        by = f", up to {self._latest / 1e9:.1f} s late" if self._latest else ""
        text = f"{of}: messages from before that were held back: {self._held.total()}{by}"
        self._held.clear()
        self._latest = 0
        return text


class PublisherClock:
    """Follow the clock of one publisher by its timestamps and their arrival, both in ns.

    The smallest difference of the two is that of the clocks, with the transit of the fastest sample; a sample is late
    by the difference to that, whatever either clock shows. A clock that is set back is known after two DRIFT.
    """

    def __init__(self, sent: int, arrived: int) -> None:
        self._sent, self._arrived = sent, arrived
        self._before = self._smallest = arrived - sent  # of the time before `_since`, and after it
        self._since = arrived

    def lateness(self, sent: int, arrived: int) -> int:
        """Return the lateness of a sample, in ns."""
        if 0 <= sent - self._sent < _STANDING:
            # Zenoh's timestamps never go back: those of a clock that was set back stand until it has caught up.
            self._before += arrived - self._arrived
            self._smallest += arrived - self._arrived
        self._sent, self._arrived = sent, arrived
        offset = arrived - sent
        if arrived - self._since > DRIFT:
            self._before, self._smallest, self._since = self._smallest, offset, arrived
        self._smallest = min(self._smallest, offset)
        return offset - min(self._before, self._smallest)


def _publisher(sample: Sample) -> str:
    """Return the session that stamped a sample: another run of a publisher may have another clock."""
    return "" if sample.stamp is None else str(sample.stamp.get_id())
