"""nedbus: PX4 messages, validated with Pydantic, on Zenoh.

import nedbus

with nedbus.connect() as bus:
    for sample in bus.subscribe():
        print(sample.vehicle, sample.message.position)  # north, east and down; None while it is invalid

Further public names are in `nedbus.frames`, `nedbus.health` and `nedbus.errors`.
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
    from nedbus_msgs.messages import *  # noqa: F403 - one class per PX4 message

    from . import errors as errors
    from . import frames as frames
    from . import health as health
    from .client import (
        AsyncBus,
        AsyncPublisher,
        AsyncSubscription,
        Batch,
        Bus,
        Counts,
        Mode,
        Publisher,
        Sample,
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
    from .recording import UtcOffset, addresses_of, align, missing_of, read, utc_of
    from .transport import Session, Tls

__version__ = "0.1.0"

__all__ = [
    "ANY", "DTYPE", "TOPICS", "Address", "AddressError", "ArgumentError", "AsyncBus", "AsyncPublisher",
    "AsyncSubscription", "Batch", "Bus", "ClosedError", "ConfigError", "ConnectError", "Continuous", "Counts",
    "InvalidMessageError", "Message", "MessageArray", "Mode", "NedbusError", "NoDataError", "Provenance", "Publisher",
    "Quantity", "ReceiveError", "ResetTracker", "Row", "Sample", "Selection", "Session", "SourceError", "Subscription",
    "Tls", "Topic", "UtcOffset", "VehicleLocalPosition", "addresses_of", "align", "connect", "connect_async",
    "define_msg", "dtype_of", "mask_invalid", "missing_of", "read", "to_array", "to_message", "utc_of",
]  # fmt: skip

# Imported in this order on first use of a name, for a fast start; only the last two load NumPy.
_MODULES = "nedbus_msgs", "nedbus.errors", "nedbus.transport", "nedbus.client", "nedbus_msgs.arrays", "nedbus.recording"
_SUBMODULES = "errors", "frames", "health"


def __dir__() -> list[str]:
    """Return all public names, for tab completion, including names that are not imported yet."""
    messages = _import_module("nedbus_msgs").MESSAGES
    return sorted({*__all__, *messages, *_SUBMODULES, *(name for name in globals() if name.startswith("__"))})


if not TYPE_CHECKING:  # otherwise type checkers would accept any name

    def __getattr__(name: str) -> object:
        """Import a public name on first use."""
        if name in __all__:
            module = next(each for each in map(_import_module, _MODULES) if hasattr(each, name))
            return globals().setdefault(name, getattr(module, name))
        if name in _SUBMODULES:
            return _import_module(f"{__name__}.{name}")
        if name in _import_module("nedbus_msgs").MESSAGES:
            return getattr(_import_module("nedbus_msgs.messages"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
