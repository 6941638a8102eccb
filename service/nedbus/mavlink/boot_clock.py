"""Time since boot of a MAVLink vehicle, and detection of its reboots; no I/O, callers pass monotonic time [s]."""

import math
from typing import Any, Final

_MAX_DELAY: Final = 1_000_000  # us by which a message may be older than the newest one
_MAX_DOUBT: Final = 1.0  # s without a current message after which one kind of message is enough


class BootClock:
    """Time since boot of one vehicle, and its reboots, from the `time_boot_ms` of its messages.

    `time_boot_ms` may be the time of an old sample, as in SCALED_PRESSURE while the barometer provides no data, so an
    old message alone does not show a reboot. After a reboot, all kinds of messages are older than their own previous
    one, and none is current. The vehicle has rebooted if that holds for two kinds in a row, or for one kind that is the
    only one, or remains the only one for a second. A time that is further ahead than the vehicle can be counts once
    the next message confirms it.

    `newest`: the vehicle's time [us]; None before the first message.
    """

    def __init__(self) -> None:
        self.newest: int | None = None
        self._arrived = 0.0  # time at which the newest message arrived
        self._ahead = math.inf  # time in the last message, if it was too far ahead [us]
        self._last: dict[str, int] = {}  # time of the last message of each kind [us]
        self._older: dict[str, float] = {}  # kinds that went back in time since the last current message, and when

    def add(self, message: Any, now: float) -> bool:
        """Add a message that arrived at time `now`; return whether it shows that the vehicle has rebooted."""
        ms: int | None = getattr(message, "time_boot_ms", None)
        if ms is None or message.instance_field:  # several sensors, each with its own delay
            return False
        kind, time = message.get_type(), 1000 * ms
        last, self._last[kind] = self._last.get(kind, time), time
        if self.newest is None or time >= self.newest - _MAX_DELAY:
            if self.newest is None or not self._is_wild(time, self.newest, now):
                self.newest, self._arrived = max(time, self.newest or 0), now
                self._older.clear()
            return False
        if time < last - _MAX_DELAY:
            self._older.setdefault(kind, now)
        in_doubt = now - min(self._older.values(), default=now)
        if len(self._older) < min(2, len(self._last)) and in_doubt < _MAX_DOUBT:
            return False
        self.newest, self._arrived, self._last = time, now, {kind: time}
        self._older.clear()
        return True

    def _is_wild(self, time: int, newest: int, now: float) -> bool:
        """Return whether a time is too far ahead, and the message before does not confirm it."""
        is_ahead = time > newest + 1e6 * (now - self._arrived) + _MAX_DELAY
        is_confirmed = time >= self._ahead - _MAX_DELAY
        self._ahead = time if is_ahead else math.inf
        return is_ahead and not is_confirmed

    def confirm(self) -> None:
        """Discard the signs of a reboot, because something else shows that the vehicle continues to run."""
        self._older.clear()
