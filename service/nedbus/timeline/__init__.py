"""Time: the clocks of vehicles, the order of messages, the axis of a flight, the pace of a replay; no I/O.

`VehicleClock` follows the own time of one vehicle. `add(stream, time, now)` returns what a message's time shows:

| kind | meaning | `time` |
|---|---|---|
| NEW | the vehicle's clock goes on, or a message is a little late | since boot, without the wrap of 32 bits |
| LATE | older than the newest message by more than a second, as over a second, slower link | the same |
| COPY | this stream had this time: the message came twice | the same |
| WILD | no message confirms this time | as received |
| REBOOT | the vehicle rebooted; `boot` is the number of the new one | since the new boot |
| STEP | a synchronised (Unix) time was set: no reboot | as received |

`RebootDetector` tells a reboot from the times of streams without a common order, as on a bus.

Of these, `__all__` is public: what a script that analyses messages needs to convert times and to find reboots.
"""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .arrivals import arrivals
from .pace import SKIPPED_PAUSE, Pace
from .reboots import RebootDetector, RebootSign
from .utc_offset import UTC_COLUMNS, UtcOffset, provides_utc, to_unix_ns, unix_seconds, utc_text
from .vehicle_clock import (
    REORDER_WINDOW,
    Reading,
    RecentTimes,
    TimeKind,
    VehicleClock,
    is_boot_possible,
)

if TYPE_CHECKING:
    from .axis import Axis
    from .order import Order
    from .utc_estimate import UtcEstimate, to_datetime64
else:
    # NumPy is slow to import, and only readers of files need the axis and the order.
    __getattr__ = lazy_exports(
        __name__,
        {
            "Axis": ("", "axis"),
            "Order": ("", "order"),
            "UtcEstimate": ("", "utc_estimate"),
            "to_datetime64": ("", "utc_estimate"),
        },
    )

__all__ = [
    "REORDER_WINDOW",
    "RebootDetector",
    "RebootSign",
    "UtcOffset",
    "provides_utc",
    "to_datetime64",
    "unix_seconds",
]
