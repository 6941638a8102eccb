"""Hold back samples that come late, by their publishers' own clocks; no I/O, and two hosts' clocks are not compared."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from nedbus.client import Sample
from nedbus_msgs import Address

MAX_LATENESS: Final = 10**9
"""Nanoseconds from which on a sample is late: it was recovered after an outage, or waited behind one that was."""

STEADY: Final = 2 * 10**9
"""Nanoseconds after which late samples that do not catch up are current: their publisher's clock was set back."""

DRIFT: Final = 60 * 10**9
"""Nanoseconds for which the fastest sample counts: two clocks drift apart."""

_CATCH_UP: Final = 250_000_000  # ns by which recovered samples get less late meanwhile, and no others
_STANDING: Final = 1000  # ns between two timestamps of a clock that stands


class LateFilter:
    """Admit what is current of each address, and count the rest.

    `last` are the last samples from before: these are held back, as their age is not known.
    """

    def __init__(self, last: Iterable[Sample] = ()) -> None:
        self._last = {sample.address: (_publisher(sample), sample.sent) for sample in last}
        self._clocks: dict[Address, tuple[str, PublisherClock]] = {}
        self._held: dict[Address, int] = {}
        self._latest = 0  # ns that the latest of them was late
        self.held = 0

    def admits(self, sample: Sample, *, arrived: int) -> bool:
        """Return whether a sample is current; `arrived` is in ns of this host's monotonic clock.

        A sample without a timestamp is.
        """
        sent = sample.sent
        if sent is None:
            return True
        publisher, address = _publisher(sample), sample.address
        known, clock = self._clocks.get(address, ("", None))
        if clock is None and (publisher, sent) == self._last.pop(address, None):
            self._hold(address, 0)
            return False
        if clock is None or known != publisher:
            clock = PublisherClock(sent, arrived)
            self._clocks[address] = publisher, clock
        late = clock.lateness(sent, arrived)
        if late <= MAX_LATENESS:
            return True
        self._hold(address, late)
        return False

    def forget(self, address: Address) -> None:
        """Drop what is known of an address that is no longer published."""
        self._clocks.pop(address, None)

    def report(self) -> str | None:
        """Return how many were held back since the last report, None if none were."""
        if not self._held:
            return None
        first, *others = sorted(self._held)
        of = f"{first}" + (f" and {len(others)} others" if others else "")
        by = f", up to {self._latest / 1e9:.1f} s late" if self._latest else ""
        text = f"{of}: messages from before that were held back: {sum(self._held.values())}{by}"
        self._held, self._latest = {}, 0
        return text

    def _hold(self, address: Address, late: int) -> None:
        self.held += 1
        self._held[address] = self._held.get(address, 0) + 1
        self._latest = max(self._latest, late)


class PublisherClock:
    """Follow the clock of one publisher by its timestamps and when they arrived, both in ns.

    The smallest difference of the two is that of the clocks, with the transit of the fastest sample: what a sample
    exceeds it by is how late that sample is, whatever either clock shows.
    """

    def __init__(self, sent: int, arrived: int) -> None:
        self._sent, self._arrived = sent, arrived
        self._late: tuple[int, int] | None = None  # difference and arrival of the first of some that do not catch up
        self._before = self._smallest = 0  # of the time before `_since`, and after it
        self._since = 0
        self._start(arrived - sent, arrived)

    def lateness(self, sent: int, arrived: int) -> int:
        """Return how late a sample is, in ns."""
        if 0 <= sent - self._sent < _STANDING:
            # Zenoh's timestamps never go back: those of a clock that was set back stand until it has caught up.
            self._before += arrived - self._arrived
            self._smallest += arrived - self._arrived
        self._sent, self._arrived = sent, arrived
        offset = arrived - sent
        late = offset - min(self._before, self._smallest)
        if late > MAX_LATENESS:
            if self._late is None or offset < self._late[0] - _CATCH_UP:
                self._late = offset, arrived
            if arrived - self._late[1] < STEADY:
                return late
            self._start(offset, arrived)
            return 0
        self._late = None
        if arrived - self._since > DRIFT:
            self._before, self._smallest, self._since = self._smallest, offset, arrived
        else:
            self._smallest = min(self._smallest, offset)
        return max(0, late)

    def _start(self, offset: int, arrived: int) -> None:
        self._before = self._smallest = offset
        self._since = arrived
        self._late = None


def _publisher(sample: Sample) -> str:
    """Return the session that stamped a sample: another run of a publisher may have another clock."""
    return "" if sample.stamp is None else str(sample.stamp.get_id())
