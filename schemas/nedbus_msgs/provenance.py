"""Message type and provenance in the Zenoh encoding: the source, and the fields that it does not provide.

    application/msgpack;px4_msgs/VehicleLocalPosition;source=mavlink;missing=fffff00000000
    application/msgpack;px4_msgs/WheelEncoders;hash=0123456789abcdef0123456789abcdef;source=ulog

`hash` identifies the definition: builds of PX4 may differ (see `short_hash`). Only the layouts that every version of
nedbus has, those of the first version, omit it.
`missing` is a hexadecimal mask with one bit per field in PX4's order, the lowest for `timestamp`; omitted if 0.
Encoding and parsing are cached, because almost all messages of a publisher have the same encoding.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, cast

from .errors import ArgumentError
from .model.declaration import Layout, cached_on_owner
from .model.definition import MESSAGES, Definition
from .model.px4_types import FieldType
from .ros2.types import PACKAGE, hash_of

_SOURCE = re.compile(r"[a-z0-9_-]{1,32}")
_IDENTITY = re.compile(
    r"application/msgpack;px4_msgs/([A-Z][A-Za-z0-9]{0,63});hash=([0-9a-f]{32})(?:;.*)?"
)
# Number of the newest layout that needs no hash, because the first version has it. Never add to this table: readers
# find the fields of any other layout by its hash.
_WITHOUT_HASH: Final[Mapping[str, int]] = {
    "BatteryStatus": 0, "EstimatorStatusFlags": 0, "FailsafeFlags": 0, "HomePosition": 0, "SensorGps": 0,
    "TimesyncStatus": 0, "VehicleAttitude": 0, "VehicleGlobalPosition": 0, "VehicleLandDetected": 0,
    "VehicleLocalPosition": 1, "VehicleOdometry": 0, "VehicleStatus": 0,
}  # fmt: skip


ARDUPILOT: Final = "mavlink-ardupilot"
"""The source of a log message whose author is ArduPilot, over MAVLink."""

OTHER_AUTOPILOT: Final = "mavlink-autopilot"
"""The source of a log message whose author is an autopilot other than PX4 and ArduPilot, over MAVLink."""


@dataclass(frozen=True, slots=True)
class Provenance:
    """The origin of a message, as reported by its publisher.

    `source`: the kind of source, such as `sim`, `ulog`, `px4-zenoh` or `mavlink`; None if unknown.
    `missing`: the fields that the source does not provide; they hold NaN, false or 0.

    Raises ArgumentError for a source that is not 1 to 32 characters of a-z 0-9 _ -.
    """

    source: str | None = None
    missing: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if self.source is not None and not _SOURCE.fullmatch(self.source):
            raise ArgumentError("source", self.source, "1 to 32 of a-z 0-9 _ -")


@cached_on_owner
def encoding_of(
    definition: Definition[Any], source: str | None, provided: frozenset[str] | None = None
) -> str:
    """Return the Zenoh encoding for a source that provides these fields; None means all fields."""
    parts = [f"application/msgpack;px4_msgs/{definition.name}"]
    if not _has_first_layout(definition):
        parts.append(f"hash={short_hash(definition.name, definition.types)}")
    if source is not None:
        parts.append(f"source={source}")
    mask = 0
    if provided is not None:
        for index, name in enumerate(definition.names):
            if name not in provided:
                mask |= 1 << index
    if mask:
        parts.append(f"missing={mask:x}")
    return ";".join(parts)


def _has_first_layout(definition: Definition[Any]) -> bool:
    """Return whether every version of nedbus has this layout."""
    if MESSAGES.get(definition.name) is not definition:
        return False
    newest_known = _WITHOUT_HASH.get(definition.name, -1)
    return cast("int", definition.current.wire) <= newest_known


def short_hash(name: str, types: Mapping[str, FieldType]) -> str:
    """Return the first 32 hex digits (128 bits) of the RIHS01 hash of a message with these fields."""
    digits = hash_of(Layout("", types=types), f"{PACKAGE}/{name}").removeprefix("RIHS01_")
    return digits[:32]


@lru_cache(1024)
def identity_of(encoding: str) -> tuple[str, str] | None:
    """Return the message name and hash from an encoding; None if it has no hash."""
    identity = _IDENTITY.fullmatch(encoding)
    if identity is None:
        return None
    return identity[1], identity[2]


@cached_on_owner
def provenance_of(definition: Definition[Any], encoding: str) -> Provenance:
    """Parse the provenance in an encoding; unknown or invalid parts, perhaps of other programs, are ignored."""
    parts: dict[str, str] = {}
    for part in encoding.split(";")[2:]:
        name, _, value = part.partition("=")
        parts[name] = value
    source = parts.get("source")
    if source is not None and not _SOURCE.fullmatch(source):
        source = None
    digits = math.ceil(len(definition.names) / 4)
    missing = re.fullmatch(f"[0-9a-f]{{1,{digits}}}", parts.get("missing", ""))
    mask = 0
    if missing:
        mask = int(missing[0], 16)
    fields = frozenset(name for index, name in enumerate(definition.names) if mask >> index & 1)
    return Provenance(source, fields)
