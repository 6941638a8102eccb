"""nedbus: PX4's local position estimate, validated, on every host.

import nedbus

with nedbus.connect() as bus:
    for sample in bus.subscribe("vehicle_local_position"):
        print(sample.vehicle, sample.message.x, sample.message.y, sample.message.z)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nedbus_msgs import Address, ResetTracker, Row, VehicleLocalPosition, to_global

    from .bus import AsyncBus, Bus, connect, connect_async
    from .errors import (
        AddressError,
        AddressInUseError,
        ClosedError,
        ConfigError,
        ConnectError,
        DecodeError,
        EncodeError,
        LayoutError,
        ListenError,
        NedbusError,
        NoDataError,
        SourceError,
        UnknownLayoutError,
    )
    from .health import Health, Monitor
    from .intake import Counts, Sample
    from .publisher import Publisher
    from .reading import addresses_of, read
    from .subscriber import AsyncSubscription, Subscription

__version__ = "0.1.0"

__all__ = [
    "Address",
    "AddressError",
    "AddressInUseError",
    "AsyncBus",
    "AsyncSubscription",
    "Bus",
    "ClosedError",
    "ConfigError",
    "ConnectError",
    "Counts",
    "DecodeError",
    "EncodeError",
    "Health",
    "LayoutError",
    "ListenError",
    "Monitor",
    "NedbusError",
    "NoDataError",
    "Publisher",
    "ResetTracker",
    "Row",
    "Sample",
    "SourceError",
    "Subscription",
    "UnknownLayoutError",
    "VehicleLocalPosition",
    "addresses_of",
    "connect",
    "connect_async",
    "read",
    "to_global",
]


def __getattr__(name: str) -> object:
    """Load everything when the first thing is asked for, and nothing before: `nedbus --version` needs nothing."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in {"addresses_of", "read"}:  # NumPy takes longer to load than all the rest
        from . import reading

        return vars(reading)[name]
    import nedbus_msgs

    from . import bus, errors, health, intake, publisher, subscriber

    for module in (nedbus_msgs, bus, errors, health, intake, publisher, subscriber):
        globals().update({each: vars(module)[each] for each in __all__ if each in vars(module)})
    return globals()[name]
