"""Time since boot in MAVLink messages; no I/O, callers pass monotonic time [s]."""

from typing import Any, Final

from nedbus.timeline import Reading, VehicleClock
from nedbus_msgs import FIRST_UNIX_TIME

_MODULUS: Final = 1000 << 32  # us until `time_boot_ms` starts from 0 again, after 49.7 days


def new_clock() -> VehicleClock:
    """Return the clock of a vehicle whose messages have `time_boot_ms`."""
    return VehicleClock(_MODULUS)


def time_since_boot(message: Any) -> int | None:
    """Return the `time_usec` of a message [us since boot]; None if it has none, or a Unix time."""
    microseconds: int = getattr(message, "time_usec", 0)
    if 0 < microseconds < FIRST_UNIX_TIME:
        return microseconds
    return None


def read_time(clock: VehicleClock, message: Any, now: float) -> Reading | None:
    """Add a message's `time_boot_ms` to the clock of its vehicle; None if it has none, or shows nothing."""
    ms: int | None = getattr(message, "time_boot_ms", None)
    if ms is None or message.instance_field:  # several sensors, each with its own delay
        return None
    return clock.add(message.get_type(), 1000 * ms, now)
