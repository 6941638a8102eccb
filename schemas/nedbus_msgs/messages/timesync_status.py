"""TimesyncStatus: how far a companion's clock is from the vehicle's."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from nedbus_msgs.model.declaration import Topic
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import Int64, Uint8, Uint32, Uint64


class TimesyncStatus(Message):
    """Offset between the clock of a companion or ground station and the vehicle's, as the vehicle measures it.

    Vehicle's time (its `timestamp`) = remote time + estimated_offset.
    Where the other side has Unix time, the offset is negative, and -estimated_offset is when the vehicle booted.
    There is no message unless the other side answers; right after a start the offset may be off by milliseconds.
    """

    TOPICS: ClassVar = (Topic("timesync_status", 10.0, "the MAVLink or DDS module, while a companion answers"),)
    LAYOUTS: ClassVar = {
        "1.13": "*",
    }  # fmt: skip
    ENUMS: ClassVar = {"source_protocol": "SOURCE_PROTOCOL_"}

    SOURCE_PROTOCOL_UNKNOWN: ClassVar = 0
    SOURCE_PROTOCOL_MAVLINK: ClassVar = 1
    SOURCE_PROTOCOL_DDS: ClassVar = 2

    timestamp: Uint64 = Field(description="Time since boot [us]")

    source_protocol: Uint8 = Field(0, description="Protocol: 0 not known, 1 MAVLink, 2 DDS")
    remote_timestamp: Uint64 = Field(0, description="Time of the other side [us]")
    observed_offset: Int64 = Field(0, description="Vehicle's time minus remote time, by this exchange [us]")
    estimated_offset: Int64 = Field(0, description="Vehicle's time minus remote time, filtered [us]")
    round_trip_time: Uint32 = Field(0, description="Time of the exchange, there and back [us]")
