"""Filter for late samples, without synchronized clocks; no I/O."""

from __future__ import annotations

from collections import Counter
from typing import Any, Final

from nedbus import Sample, limits
from nedbus.timings import TIMINGS
from nedbus_msgs import Address
from nedbus_msgs.text import counted

DRIFT: Final = 60 * 10**9
"""Nanoseconds for which the fastest sample is the reference; limited, because the two clocks drift apart."""

_STALLED: Final = 1000  # ns; timestamps closer together come from a stalled clock


class LateFilter:
    """Admit current samples; hold back and count late samples, and retained samples, whose age is unknown."""

    def __init__(self) -> None:
        self._clocks: dict[Address, _PublisherClock] = {}
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
        if sent is None or stamp is None:
            return True
        late = 0
        if not sample.retained:
            clock = self._clocks.get(address)
            session = str(stamp.get_id())  # a restarted publisher may have another clock
            if clock is None or clock.session != session:
                clock = _PublisherClock(session, sent, arrived)
                self._add_clock(address, clock)
            late = clock.lateness(sent, arrived)
            if late <= self._limit:
                return True
        self._held[address] += 1
        self._latest = max(self._latest, late)
        return False

    def _add_clock(self, address: Address, clock: _PublisherClock) -> None:
        if len(self._clocks) >= limits.BRIDGED_STREAMS:
            oldest = next(iter(self._clocks))
            self.forget(oldest)
        self._clocks[address] = clock

    def forget(self, address: Address) -> None:
        """Forget the clock of an address that is no longer published."""
        self._clocks.pop(address, None)

    def report(self) -> str | None:
        """Return a summary of the samples held back since the last report, or None."""
        if not self._held:
            return None
        first, *others = sorted(self._held)
        text = f"held back {counted(self._held.total(), 'old message')} of {first}"
        if others:
            text = f"{text} and {len(others)} more"
        if self._latest:
            text = f"{text}, up to {self._latest / 1e9:.1f} s late"
        self._held.clear()
        self._latest = 0
        return text


class _PublisherClock:
    """Clock offset of one publisher, estimated from timestamps and arrival times [ns]; `session`: the publishing one.

    Arrival time minus timestamp is clock offset plus transit time, and smallest for the fastest sample. The lateness of
    a sample is its excess over this minimum, so clocks need not agree. A clock set back is detected within 2 * DRIFT.
    """

    def __init__(self, session: str, sent: int, arrived: int) -> None:
        self.session = session
        self._sent = sent
        self._arrived = arrived
        # Minima of arrival time minus timestamp: before `_since`, and after it.
        self._before = arrived - sent
        self._smallest = arrived - sent
        self._since = arrived

    def lateness(self, sent: int, arrived: int) -> int:
        """Return the lateness of a sample [ns], and use it as a reference for the next ones."""
        if 0 <= sent - self._sent < _STALLED:
            # Zenoh's timestamps never decrease: after a clock is set back they stall until it catches up.
            elapsed = arrived - self._arrived
            self._before += elapsed
            self._smallest += elapsed
        self._sent = sent
        self._arrived = arrived
        offset = arrived - sent
        if arrived - self._since > DRIFT:
            self._before = self._smallest
            self._smallest = offset
            self._since = arrived
        self._smallest = min(self._smallest, offset)
        return offset - min(self._before, self._smallest)
