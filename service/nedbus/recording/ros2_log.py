"""PX4's texts as rcl_interfaces/msg/Log, which Foxglove's Log panel and ROS 2 show."""

import struct
from typing import Final

from nedbus_msgs.messages import LogMessage

TYPE: Final = "rcl_interfaces/msg/Log"
DEFINITION: Final = f"""builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
{"=" * 80}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_LEVELS: Final = (50, 50, 50, 40, 30, 20, 20, 10)  # fatal, error, warning, information, debug; by severity


def encode_log(vehicle: str, message: LogMessage, *, time_ns: int) -> bytes:
    """Return the CDR payload of a text of a vehicle, at a time [ns]."""
    seconds = min(time_ns // 10**9, 2**31 - 1)
    body = struct.pack("<iIB", seconds, time_ns % 10**9, _LEVELS[message.severity])
    for part in (vehicle, message.text, "", ""):
        data = part.encode() + b"\0"
        body += bytes(-len(body) % 4) + struct.pack("<I", len(data)) + data
    return b"\0\1\0\0" + body + bytes(-len(body) % 4 + 4)
