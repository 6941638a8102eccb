"""nedbus: PX4's local position estimate, validated, on every host.

import nedbus

with nedbus.connect() as bus:
    for sample in bus.subscribe("vehicle_local_position"):
        print(sample.vehicle, sample.message.x, sample.message.y, sample.message.z)
"""

from nedbus_msgs import Address, VehicleLocalPosition

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
from .intake import Counts, Sample
from .publisher import Publisher
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
    "LayoutError",
    "ListenError",
    "NedbusError",
    "NoDataError",
    "Publisher",
    "Sample",
    "SourceError",
    "Subscription",
    "UnknownLayoutError",
    "VehicleLocalPosition",
    "connect",
    "connect_async",
]
