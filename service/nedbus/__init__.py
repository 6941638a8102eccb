"""nedbus: PX4 messages, validated with Pydantic, on Zenoh.

import nedbus

with nedbus.connect() as bus:
    for sample in bus.subscribe():
        print(sample.vehicle, sample.message.position)  # north, east and down; None while it is invalid

Further public names are in `nedbus.frames`, `nedbus.health` and `nedbus.errors`. The reference lists modules for
programs that show events, run a service or manage a fleet, such as `nedbus.vehicle_events` and `nedbus.daemon`.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nedbus_msgs import (
        ANY,
        TOPICS,
        Address,
        Continuous,
        Message,
        Provenance,
        Quantity,
        ResetTracker,
        Row,
        Selection,
        Topic,
        VehicleLocalPosition,
        define_msg,
    )
    from nedbus_msgs.arrays import DTYPE, MessageArray, dtype_of, mask_invalid, to_array, to_message
    from nedbus_msgs.messages import (  # `as`: without it, pyright counts the names as private
        BatteryStatus as BatteryStatus,
        EstimatorStatusFlags as EstimatorStatusFlags,
        FailsafeFlags as FailsafeFlags,
        HomePosition as HomePosition,
        LogMessage as LogMessage,
        SensorGps as SensorGps,
        TimesyncStatus as TimesyncStatus,
        VehicleAttitude as VehicleAttitude,
        VehicleGlobalPosition as VehicleGlobalPosition,
        VehicleLandDetected as VehicleLandDetected,
        VehicleOdometry as VehicleOdometry,
        VehicleStatus as VehicleStatus,
    )

    from . import errors as errors, frames as frames, health as health
    from .client import (
        AsyncBus,
        AsyncNewest,
        AsyncPublisher,
        AsyncSubscription,
        Bus,
        Newest,
        Publisher,
        Subscription,
        connect,
        connect_async,
    )
    from .errors import (
        AddressError,
        ArgumentError,
        ClosedError,
        ConfigError,
        ConnectError,
        InvalidMessageError,
        NedbusError,
        NoDataError,
        ReceiveError,
        SourceError,
    )
    from .event_sources import events, why
    from .flights import (
        Conversion,
        Flight,
        FlightSamples,
        convert_files as convert,
        open_flight as open,  # noqa: A004 - as in nedbus.open(path)
        utc_of,
    )
    from .samples import Batch, Counts, Mode, Sample
    from .tables import addresses_of, align, missing_of, read
    from .timeline import UtcOffset
    from .transport import Session, Tls

__version__ = "0.1.0"

__all__ = [
    "ANY",
    "DTYPE",
    "TOPICS",
    "Address",
    "AddressError",
    "ArgumentError",
    "AsyncBus",
    "AsyncNewest",
    "AsyncPublisher",
    "AsyncSubscription",
    "Batch",
    "Bus",
    "ClosedError",
    "ConfigError",
    "ConnectError",
    "Continuous",
    "Conversion",
    "Counts",
    "Flight",
    "FlightSamples",
    "InvalidMessageError",
    "Message",
    "MessageArray",
    "Mode",
    "NedbusError",
    "Newest",
    "NoDataError",
    "Provenance",
    "Publisher",
    "Quantity",
    "ReceiveError",
    "ResetTracker",
    "Row",
    "Sample",
    "Selection",
    "Session",
    "SourceError",
    "Subscription",
    "Tls",
    "Topic",
    "UtcOffset",
    "VehicleLocalPosition",
    "addresses_of",
    "align",
    "connect",
    "connect_async",
    "convert",
    "define_msg",
    "dtype_of",
    "events",
    "mask_invalid",
    "missing_of",
    "open",
    "read",
    "to_array",
    "to_message",
    "utc_of",
    "why",
]  # fmt: skip

# By module; a module is imported on first use of one of its names: those for files load no Zenoh, and few load NumPy.
_MODULES = {
    "nedbus.samples": "Batch Counts Mode Sample",
    "nedbus.client": "AsyncBus AsyncNewest AsyncPublisher AsyncSubscription Bus Newest Publisher Subscription connect"
    " connect_async",
    "nedbus.event_sources": "events why",
    "nedbus.flights": "Conversion Flight FlightSamples convert open utc_of",
    "nedbus.tables": "addresses_of align missing_of read",
    "nedbus.timeline": "UtcOffset",
    "nedbus.transport": "Session Tls",
    "nedbus_msgs": "ANY TOPICS Address Continuous Message Provenance Quantity ResetTracker Row Selection Topic"
    " VehicleLocalPosition define_msg",
    "nedbus_msgs.arrays": "DTYPE MessageArray dtype_of mask_invalid to_array to_message",
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names.split()}
# that differ from the public name
_NAMES_AT_HOME = {"convert": "convert_files", "open": "open_flight"}
_SUBMODULES = "errors", "frames", "health"


def __dir__() -> list[str]:
    """Return all public names, for tab completion, including names that are not imported yet."""
    messages = _import_module("nedbus_msgs").MESSAGES
    return sorted(
        {*__all__, *messages, *_SUBMODULES, *(name for name in globals() if name.startswith("__"))}
    )


if not TYPE_CHECKING:  # otherwise type checkers would accept any name

    def __getattr__(name: str) -> object:
        """Import a public name on first use."""
        if name in __all__:
            home = _import_module(_HOMES.get(name, "nedbus.errors"))
            return globals().setdefault(name, getattr(home, _NAMES_AT_HOME.get(name, name)))
        if name in _SUBMODULES:
            return _import_module(f"{__name__}.{name}")
        if name in _import_module("nedbus_msgs").MESSAGES:
            return getattr(_import_module("nedbus_msgs.messages"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
