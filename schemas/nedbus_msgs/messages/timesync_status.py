"""TimesyncStatus: offset of a companion's clock to the vehicle's."""

from nedbus_msgs.model import Layout, Message, Topic
from nedbus_msgs.model.px4_types import Int64, Uint8, Uint32, Uint64, field


class TimesyncStatus(Message):
    """Offset between the clock of a companion or ground station and the vehicle's, as the vehicle measures it.

    Vehicle's time (its `timestamp`) = remote time + estimated_offset.
    If the other side uses Unix time, the offset is negative, and -estimated_offset is the time of the vehicle's boot.
    There are no messages unless the other side answers; just after a start, the offset may be wrong by milliseconds.
    """

    TOPICS = (Topic("timesync_status", 10.0, "the MAVLink or DDS module, while a companion answers"),)
    LAYOUTS = (Layout("1.13", "*"),)

    SOURCE_PROTOCOL_UNKNOWN, SOURCE_PROTOCOL_MAVLINK, SOURCE_PROTOCOL_DDS = range(3)

    source_protocol: Uint8 = field("Protocol: 0 not known, 1 MAVLink, 2 DDS")
    remote_timestamp: Uint64 = field("Time of the other side [us]")
    observed_offset: Int64 = field("Vehicle's time minus remote time, by this exchange [us]")
    estimated_offset: Int64 = field("Vehicle's time minus remote time, filtered [us]")
    round_trip_time: Uint32 = field("Time of the exchange, there and back [us]")
