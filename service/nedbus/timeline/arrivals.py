"""Arrival times of frames by a recorder's clock, which a user, NTP or a GNSS receiver may set."""

from collections.abc import Callable, Iterable, Iterator
from typing import Final, TypeVar

_SLACK: Final = 1_000_000  # us; a longer step holds if the next record confirms it
_T = TypeVar("_T")


def arrivals(records: Iterable[_T], time_of: Callable[[_T], int]) -> Iterator[tuple[float, _T]]:
    """Yield each record with a monotonic arrival time [s]; steps back take no time, nor does a single wild time [us].

    Only the vehicle's clock tells how much time passed: these times serve as timeouts, and to detect reboots.
    """
    now = 0
    last: int | None = None
    held: _T | None = None
    for record in records:
        if held is not None:
            time = time_of(held)
            is_wild = last is not None and time > last + _SLACK and time > time_of(record) + _SLACK
            if not is_wild:
                if last is not None:
                    now += max(0, time - last)
                last = time
            yield now / 1e6, held
        held = record
    if held is not None:
        time = time_of(held)
        if last is not None and last <= time <= last + _SLACK:
            now += time - last
        yield now / 1e6, held
