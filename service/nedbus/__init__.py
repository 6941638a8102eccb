"""nedbus: PX4's local position estimate, validated, on every host.

import nedbus

with nedbus.connect() as bus:
    for sample in bus.subscribe():
        print(sample.vehicle, sample.message.x, sample.message.y, sample.message.z)
"""

from __future__ import annotations

from importlib import import_module as _import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nedbus_msgs import (
        ANY,
        TOPICS,
        Address,
        Continuous,
        GlobalPosition,
        MapProjection,
        Message,
        Provenance,
        Quantity,
        ResetTracker,
        Row,
        Selection,
        Topic,
        Vector,
        VehicleLocalPosition,
        define_msg,
        enu_to_ned,
        flu_to_frd,
        frd_to_flu,
        ned_to_enu,
        quaternion_enu_to_ned,
        quaternion_ned_to_enu,
        to_global,
        to_local,
        variances_enu_to_ned,
        variances_ned_to_enu,
        yaw_enu_to_ned,
        yaw_ned_to_enu,
    )
    from nedbus_msgs.arrays import DTYPE, MessageArray, dtype_of, to_array, to_message
    from nedbus_msgs.messages import *  # noqa: F403 - each by its name

    from .client import (
        AsyncBus,
        AsyncPublisher,
        AsyncSubscription,
        Batch,
        Bus,
        Counts,
        Health,
        Histogram,
        LogStreamStatus,
        Mode,
        Monitor,
        Publisher,
        Publishers,
        RejectionReport,
        Rejections,
        Sample,
        ServiceStatus,
        SourceStatus,
        StreamHealth,
        StreamStatus,
        Subscription,
        Vehicles,
        connect,
        connect_async,
    )
    from .errors import (
        AddressError,
        AddressInUseError,
        ArgumentError,
        ClosedError,
        ConfigError,
        ConnectError,
        DecodeError,
        EncodeError,
        ForkError,
        InvalidMessageError,
        LayoutError,
        ListenError,
        NedbusError,
        NoDataError,
        OutputError,
        PkiError,
        ReceiveError,
        SourceError,
        UnknownLayoutError,
    )
    from .events import AccountReport, Condition, Event, VehicleReport
    from .recording import UtcOffset, addresses_of, align, missing_of, read, utc_of
    from .transport import Session, Tls

__version__ = "0.1.0"

__all__ = [
    "ANY", "DTYPE", "TOPICS", "AccountReport", "Address", "AddressError", "AddressInUseError", "ArgumentError",
    "AsyncBus",
    "AsyncPublisher", "AsyncSubscription", "Batch", "Bus", "ClosedError", "Condition", "ConfigError", "ConnectError",
    "Continuous", "Counts", "DecodeError", "EncodeError", "Event", "ForkError", "GlobalPosition", "Health", "Histogram",
    "InvalidMessageError", "LayoutError", "ListenError", "LogStreamStatus", "MapProjection", "Message", "MessageArray",
    "Mode", "Monitor", "NedbusError", "NoDataError", "OutputError", "PkiError", "Provenance", "Publisher",
    "Publishers", "Quantity", "ReceiveError", "RejectionReport", "Rejections", "ResetTracker", "Row", "Sample",
    "Selection", "ServiceStatus", "Session", "SourceError", "SourceStatus", "StreamHealth", "StreamStatus",
    "Subscription", "Tls", "Topic", "UnknownLayoutError", "UtcOffset", "Vector", "VehicleLocalPosition",
    "VehicleReport", "Vehicles", "addresses_of", "align", "connect", "connect_async", "define_msg", "dtype_of",
    "enu_to_ned", "flu_to_frd", "frd_to_flu", "missing_of", "ned_to_enu", "quaternion_enu_to_ned",
    "quaternion_ned_to_enu", "read", "to_array", "to_global", "to_local", "to_message", "utc_of",
    "variances_enu_to_ned", "variances_ned_to_enu", "yaw_enu_to_ned", "yaw_ned_to_enu",
]  # fmt: skip

# Imported on first use of a name: `nedbus --version` needs none of them, and only the last two load NumPy.
_MODULES = (
    "nedbus_msgs", "nedbus.errors", "nedbus.transport", "nedbus.events", "nedbus.client", "nedbus_msgs.arrays",
    "nedbus.recording",
)  # fmt: skip


def __dir__() -> list[str]:
    """Return the public names, loaded or not, for completion."""
    return [*__all__, *(name for name in globals() if name.startswith("__"))]


if not TYPE_CHECKING:  # otherwise type checkers would accept any name

    def __getattr__(name: str) -> object:
        """Import the module of a public name on first use."""
        if name in __all__:
            module = next(each for each in map(_import_module, _MODULES) if name in each.__all__)
            return globals().setdefault(name, getattr(module, name))
        if name in _import_module("nedbus_msgs").MESSAGES:
            return getattr(_import_module("nedbus_msgs.messages"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
