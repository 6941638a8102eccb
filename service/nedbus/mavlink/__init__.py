"""MAVLink of autopilots as PX4 messages, for links and .tlog files: parser, losses, time and fields; no I/O.

Each name imports its module on first use, because pymavlink is optional.
"""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

if TYPE_CHECKING:
    from .boot_time import new_clock, read_time
    from .external_position import (
        AGE_LIMIT,
        FUSION_RATE,
        RATE_LIMIT,
        UNKNOWN_VARIANCE,
        ExternalPosition,
    )
    from .fields import CONVERSIONS, HIGH_LATENCY
    from .log_reassembly import Chunk, Reassembly
    from .parser import Received, new_parser, parse
    from .senders import AUTOPILOT, NO_HEARTBEAT, Senders
    from .sequence import PacketRate, SequenceCounter
    from .vehicle import Vehicle
else:
    _NAMES = {
        "boot_time": "new_clock read_time",
        "external_position": "ExternalPosition AGE_LIMIT FUSION_RATE RATE_LIMIT UNKNOWN_VARIANCE",
        "fields": "CONVERSIONS HIGH_LATENCY", "log_reassembly": "Chunk Reassembly",
        "parser": "Received new_parser parse", "senders": "AUTOPILOT NO_HEARTBEAT Senders",
        "sequence": "PacketRate SequenceCounter", "vehicle": "Vehicle",
    }  # fmt: skip
    _MODULES = {
        name: ("mavlink", module) for module, names in _NAMES.items() for name in names.split()
    }
    __getattr__ = lazy_exports(__name__, _MODULES)
