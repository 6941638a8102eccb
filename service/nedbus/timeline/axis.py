"""The axis of a flight: seconds since its first message, for each vehicle as time since boot or Unix time."""

from bisect import bisect_right
from collections import defaultdict
from itertools import pairwise
from operator import attrgetter
from typing import Final, NamedTuple

_NONE: Final[tuple[()]] = ()


class AxisPart(NamedTuple):
    """A part of the axis in which a vehicle's clock runs on: its first place [us], and place minus timestamp [us]."""

    begin: int
    base: int


class Axis:
    """Seconds since the first message, pauses included, and the clocks of the vehicles on it.

    `zero`: the place of the first message [us].
    """

    def __init__(self) -> None:
        self.zero = 0
        self._parts = defaultdict[str, list[AxisPart]](list)

    def add(self, vehicle: str, place: int, stamp: int) -> None:
        """Add a part: a vehicle whose clock begins at a timestamp [us], at a place on the axis [us]."""
        self._parts[vehicle].append(AxisPart(place, place - stamp))

    def boots(self, vehicle: str) -> int:
        """Return the number of parts of a vehicle so far."""
        return len(self._parts.get(vehicle, _NONE))

    def stamp_at(self, vehicle: str, seconds: float) -> int | None:
        """Return the timestamp of a vehicle [us] at a time on the axis; None for an unknown vehicle."""
        parts = self._parts.get(vehicle)
        if not parts:
            return None
        place = self.zero + round(seconds * 1e6)
        following = bisect_right(parts, place, key=attrgetter("begin"))
        number = max(0, following - 1)
        part = parts[number]
        return place - part.base

    def seconds_of(self, vehicle: str, stamp: int) -> float | None:
        """Return the time on the axis of a timestamp of a vehicle [us], the first if several boots have it."""
        parts = self._parts.get(vehicle)
        if not parts:
            return None
        for part, following in pairwise(parts):
            place = part.base + stamp
            if part.begin <= place < following.begin:
                return (place - self.zero) / 1e6
        place = parts[-1].base + stamp
        return (place - self.zero) / 1e6
