"""TimesyncStatus: clock offset between a vehicle and its companion."""

from nedbus_msgs.model import Layout, Message, Topic
from nedbus_msgs.model.px4_types import Int64, Uint8, Uint32, Uint64, field


class TimesyncStatus(Message):
    """Clock offset between the vehicle and a companion or ground station, measured by the vehicle.

    Vehicle time (its `timestamp`) = remote time + estimated_offset.
    If the remote side uses Unix time, the offset is negative, and -estimated_offset is the vehicle's boot time.
    It is published only while the remote side responds; just after a start the offset may be off by milliseconds.
    """

    TOPICS = (
        Topic("timesync_status", 10.0, "the MAVLink or DDS module, while a companion responds"),
    )
    LAYOUTS = (Layout("1.13", "*"),)

    SOURCE_PROTOCOL_UNKNOWN, SOURCE_PROTOCOL_MAVLINK, SOURCE_PROTOCOL_DDS = range(3)

    source_protocol: Uint8 = field("Protocol: 0 unknown, 1 MAVLink, 2 DDS")
    remote_timestamp: Uint64 = field("Remote time [us]")
    observed_offset: Int64 = field("Vehicle time minus remote time, in this exchange [us]")
    estimated_offset: Int64 = field("Vehicle time minus remote time, filtered [us]")
    round_trip_time: Uint32 = field("Round-trip time of this exchange [us]")
