"""One vehicle's own time: copies, late messages, wraps, wild times, steps and reboots."""

import math
from collections import OrderedDict
from collections.abc import Hashable
from enum import Enum
from typing import Final, NamedTuple

from nedbus import limits
from nedbus_msgs import is_unix_time

REORDER_WINDOW: Final = 1_000_000
"""Step back in time [us] that reordering explains."""

# us by which a time since boot may exceed the time that passed: delays of a link
_MARGIN: Final = 2_000_000
_DOUBT: Final = 1.0  # s without a current message after which one stream is enough
# s without a current message after which another clock counts, possible or not
_OTHER_CLOCK: Final = 10.0
# us by which a second link may be behind; the same time, later, is another boot
_LINK_DELAY: Final = 10_000_000
_UNKNOWN_PAUSE: Final = 60_000_000  # us that may have passed if the arrival time is unknown


class TimeKind(Enum):
    """What the time of a message shows."""

    NEW = "new"
    LATE = "late"
    COPY = "copy"
    WILD = "wild"
    REBOOT = "reboot"
    STEP = "step"


class Reading(NamedTuple):
    """What a message's time shows: its kind, the time on the vehicle's clock [us], and the number of the boot."""

    kind: TimeKind
    time: int
    boot: int


def is_boot_possible(time: int, elapsed: float | None) -> bool:
    """Return whether a vehicle can have booted at `time` [us since boot], if its last message came `elapsed` s ago.

    A vehicle that rebooted cannot be up for longer than the time since its last message. Unix time is no time since
    boot. `elapsed`: None if unknown.
    """
    if is_unix_time(time):
        return False
    return elapsed is None or time <= 1e6 * elapsed + _MARGIN


class RecentTimes:
    """The last times of each stream: `limits.KNOWN_TIMES` of up to `limits.VEHICLE_STREAMS`."""

    def __init__(self) -> None:
        self._times: dict[Hashable, OrderedDict[int, None]] = {}

    def contains(self, stream: Hashable, time: int) -> bool:
        """Return whether a stream had this time."""
        return time in self._times.get(stream, ())

    def add(self, stream: Hashable, time: int) -> None:
        """Add the time of a message."""
        times = self._times.get(stream)
        if times is None:
            if len(self._times) >= limits.VEHICLE_STREAMS:
                return
            times = self._times[stream] = OrderedDict()
        times[time] = None
        if len(times) > limits.KNOWN_TIMES:
            times.popitem(last=False)


class VehicleClock:
    """One vehicle's own time, from the times of its messages on any stream.

    `modulus`: number of microseconds after which its times start again from 0, None if they do not.

    `newest`: the vehicle's time [us]; None before the first message. `boot`: number of the boot, from 0.
    `copies`: number of messages that came twice.

    A message may have the time of an old sample, as SCALED_PRESSURE does while the barometer provides no data, so an
    old message alone shows nothing. After a reboot, all streams are older than their own previous message, and none is
    current. That holds if two streams in a row show it, or one that is the only one, or remains so for a second, and
    if the new time since boot is possible. Other clocks that last for ten seconds count in any case. A time that is
    further ahead than the vehicle can be counts once the next message confirms it.
    """

    def __init__(self, modulus: int | None = None) -> None:
        self.newest: int | None = None
        self.boot = 0
        self.copies = 0
        self._modulus = modulus
        self._arrived: float | None = None  # time at which the newest message arrived
        self._ahead = math.inf  # time in the last message, if it was too far ahead [us]
        self._last: dict[Hashable, int] = {}  # time of the last message of each stream [us]
        # streams that went back since the last current message, and when
        self._older: dict[Hashable, float] = {}
        self._known = RecentTimes()

    def add(self, stream: Hashable, time: int, now: float | None = None) -> Reading:
        """Return what a message shows whose time is `time` [us]; it arrived at `now` [s], None if unknown."""
        if self.newest is None:
            return self._begin(stream, time, now, TimeKind.NEW)
        time = self.unwrap(time, now)
        if self._known.contains(stream, time) and self._is_delay(self.newest - time, now):
            self.copies += 1
            if time >= self.newest - REORDER_WINDOW:
                self._older.clear()  # a current message: the vehicle continues to run
            return Reading(TimeKind.COPY, time, self.boot)
        last = self._last.get(stream, time)
        if stream in self._last or len(self._last) < limits.VEHICLE_STREAMS:
            self._last[stream] = time
        if time >= self.newest - REORDER_WINDOW:
            return self._add_current(stream, time, self.newest, now)
        return self._add_older(stream, time, last, self.newest, now)

    @property
    def is_doubtful(self) -> bool:
        """Whether the last messages look like those of another boot, which is not certain yet."""
        return bool(self._older)

    def confirm(self) -> None:
        """Discard the signs of a reboot, because something else shows that the vehicle continues to run."""
        self._older.clear()

    def _add_current(
        self,
        stream: Hashable,
        time: int,
        newest: int,
        now: float | None,
    ) -> Reading:
        if self._is_wild(time, newest, now):
            return Reading(TimeKind.WILD, time, self.boot)
        is_step = bool(is_unix_time(time)) != bool(is_unix_time(newest))
        self.newest = max(time, newest)
        self._arrived = now
        self._older.clear()
        self._known.add(stream, time)
        return Reading(TimeKind.STEP if is_step else TimeKind.NEW, time, self.boot)

    def _add_older(
        self,
        stream: Hashable,
        time: int,
        last: int,
        newest: int,
        now: float | None,
    ) -> Reading:
        if time < last - REORDER_WINDOW:
            self._older.setdefault(stream, math.inf if now is None else now)
        if self._is_other_clock(time, newest, now):
            if is_unix_time(time):
                kind = TimeKind.STEP
            else:
                kind = TimeKind.REBOOT
            return self._begin(stream, time, now, kind)
        self._known.add(stream, time)
        return Reading(TimeKind.LATE, time, self.boot)

    def _is_other_clock(self, time: int, newest: int, now: float | None) -> bool:
        """Return whether a message older than the newest one, and those before it, are on another clock."""
        doubt = self._doubt(now)
        is_synchronised = bool(is_unix_time(time)) and bool(is_unix_time(newest))
        if not is_synchronised and not is_boot_possible(time, self._elapsed(now)):
            return doubt >= _OTHER_CLOCK
        if not self._older:
            return False
        is_confirmed = len(self._older) >= min(2, len(self._last))
        return is_confirmed or doubt >= _DOUBT

    def _doubt(self, now: float | None) -> float:
        """Return since when streams are older than before, without a current message [s]."""
        if now is None or not self._older:
            return 0.0
        return max(0.0, now - min(self._older.values()))

    def _begin(
        self,
        stream: Hashable,
        time: int,
        now: float | None,
        kind: TimeKind,
    ) -> Reading:
        if kind is TimeKind.REBOOT:
            self.boot += 1
            if self._modulus:
                time %= self._modulus
        self.newest = time
        self._arrived = now
        self._ahead = math.inf
        self._last = {stream: time}
        self._older.clear()
        self._known = RecentTimes()
        self._known.add(stream, time)
        return Reading(kind, time, self.boot)

    def _is_delay(self, late: int, now: float | None) -> bool:
        """Return whether the delay of a link explains a message that is this late [us]."""
        elapsed = self._elapsed(now) or 0.0
        return late + 1e6 * elapsed <= _LINK_DELAY

    def _elapsed(self, now: float | None) -> float | None:
        if now is None or self._arrived is None:
            return None
        return max(0.0, now - self._arrived)

    def unwrap(self, time: int, now: float | None = None) -> int:
        """Return a time with the wraps before it, if it then is one that the vehicle can have."""
        newest = self.newest
        if self._modulus is None or newest is None:
            return time
        elapsed = self._elapsed(now)
        passed: float = _UNKNOWN_PAUSE
        if elapsed is not None:
            passed = 1e6 * elapsed + _MARGIN
        begin = newest - newest % self._modulus
        same = begin + time
        after = begin + self._modulus + time
        before = begin - self._modulus + time
        if after <= newest + passed:
            return after
        if begin and newest - before <= _UNKNOWN_PAUSE:
            return before  # a late message from before the wrap
        is_reboot = same > newest + passed and time <= passed
        if is_reboot or same < newest - _UNKNOWN_PAUSE:
            return time
        return same

    def _is_wild(self, time: int, newest: int, now: float | None) -> bool:
        """Return whether a time is too far ahead, and the message before does not confirm it."""
        elapsed = self._elapsed(now) or 0.0
        passed = 1e6 * elapsed
        is_ahead = time > newest + passed + _UNKNOWN_PAUSE
        is_confirmed = 0 <= time - self._ahead <= _UNKNOWN_PAUSE
        if is_ahead:
            self._ahead = time
        else:
            self._ahead = math.inf
        return is_ahead and not is_confirmed
