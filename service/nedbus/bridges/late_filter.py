"""Filter for late samples, without synchronized clocks; no I/O."""

from collections import Counter
from typing import Any, Final

from nedbus import Sample
from nedbus.timings import TIMINGS
from nedbus_msgs import Address

DRIFT: Final = 60 * 10**9
"""Nanoseconds for which the fastest sample is the reference; limited, because the two clocks drift apart."""

_MAX_CLOCKS: Final = 10_000  # addresses with a clock; beyond that the oldest is forgotten
_STALLED: Final = 1000  # ns; timestamps closer together come from a stalled clock


class LateFilter:
    """Admit current samples; hold back and count late samples, and retained samples, whose age is unknown."""

    def __init__(self) -> None:
        # id of the publishing session, and its clock
        self._clocks: dict[Address, tuple[str, _PublisherClock]] = {}
        self._held = Counter[Address]()
        self._latest = 0  # ns; maximum lateness of the samples held back
        self._limit = round(1e9 * TIMINGS.lateness)  # ns

    def admits(self, sample: Sample[Any], *, arrived: int) -> bool:
        """Return whether a sample is current; a sample without a timestamp counts as current.

        `arrived`: arrival time on this host's monotonic clock [ns].
        """
        sent = sample.sent
        stamp = sample.stamp
        address = sample.address
        late = 0
        if sent is None or stamp is None:
            return True
        if not sample.retained:
            session = str(stamp.get_id())  # a restarted publisher may have another clock
            if self._clocks.get(address, ("",))[0] != session:
                if len(self._clocks) >= _MAX_CLOCKS:
                    self.forget(next(iter(self._clocks)))
                self._clocks[address] = session, _PublisherClock(sent, arrived)
            late = self._clocks[address][1].lateness(sent, arrived)
            if late <= self._limit:
                return True
        self._held[address] += 1
        self._latest = max(self._latest, late)
        return False

    def forget(self, address: Address) -> None:
        """Forget the clock of an address that is no longer published."""
        self._clocks.pop(address, None)

    def report(self) -> str | None:
        """Return a summary of the samples held back since the last report, or None."""
        if not self._held:
            return None
        first, *others = sorted(self._held)
        addresses = f"{first} and {len(others)} more" if others else f"{first}"
        lateness = f", up to {self._latest / 1e9:.1f} s late" if self._latest else ""
        count = self._held.total()
        text = f"held back {count} old message{'s' if count > 1 else ''} of {addresses}{lateness}"
        self._held.clear()
        self._latest = 0
        return text


class _PublisherClock:
    """Clock offset of one publisher, estimated from timestamps and arrival times [ns].

    Arrival time minus timestamp is clock offset plus transit time, and smallest for the fastest sample. The lateness of
    a sample is its excess over this minimum, so clocks need not agree. A clock set back is detected within 2 * DRIFT.
    """

    def __init__(self, sent: int, arrived: int) -> None:
        self._sent, self._arrived = sent, arrived
        self._before = self._smallest = arrived - sent  # minima before and after `_since`
        self._since = arrived

    def lateness(self, sent: int, arrived: int) -> int:
        if 0 <= sent - self._sent < _STALLED:
            # Zenoh's timestamps never decrease: after a clock is set back they stall until it catches up.
            self._before += arrived - self._arrived
            self._smallest += arrived - self._arrived
        self._sent, self._arrived = sent, arrived
        offset = arrived - sent
        if arrived - self._since > DRIFT:
            self._before = self._smallest
            self._smallest = offset
            self._since = arrived
        self._smallest = min(self._smallest, offset)
        return offset - min(self._before, self._smallest)
