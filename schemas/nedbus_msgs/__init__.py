"""The contract of nedbus: messages, layouts, topics and wire format; no I/O, no Zenoh."""

from .codecs.cdr import CdrLayout, cdr_layout, decode_with, encode_with, fitting_layout
from .codecs.msgpack import PAYLOAD_LIMIT, Codec, codec_of, describe
from .codecs.records import Encoded, encode_upgraded, record_encoder
from .definitions import DEFAULT, define, definition_of
from .errors import (
    AddressError,
    ArgumentError,
    DecodeError,
    EncodeError,
    InvalidMessageError,
    LayoutError,
    NedbusError,
    UnknownLayoutError,
)
from .messages.vehicle_local_position import (
    DOUBT_FLAGS,
    VehicleLocalPosition,
    describe_flags,
    message_doubts,
)
from .model.declaration import ALL, DEFAULT_TOPIC, RELEASES, Layout, Topic
from .model.definition import (
    BY_TOPIC,
    MESSAGES,
    TOPICS,
    Definition,
    FieldReader,
    Row,
    upgrade_fields,
    upgrade_with,
)
from .model.message import Message
from .model.px4_types import (
    BASES,
    FIRST_UNIX_TIME,
    YEAR_2000,
    FieldType,
    decode_text,
    field_type,
    is_unix_time,
)
from .model.rules import UnitQuaternion
from .provenance import (
    ARDUPILOT,
    OTHER_AUTOPILOT,
    Provenance,
    encoding_of,
    identity_of,
    provenance_of,
    short_hash,
)
from .resets import JUMP_FIELDS, RESET_COUNTERS, Continuous, Quantity, ResetTracker, jump_of
from .ros2.msg_file import MsgError, bases_of_msg, define_msg, hash_of_msg, read_msg
from .ros2.types import (
    dds_type,
    definition_text,
    has_char_hash,
    hash_of,
    message_of_type_hash,
    ros2_type,
    ros2_types,
)
from .topics import (
    ANY,
    DEFAULT_PREFIX,
    RATE,
    REJECTED,
    Address,
    Selection,
    VehicleNames,
    ack_key,
    address_of_alive_key,
    all_status_keys,
    check_max_rate,
    check_prefix,
    check_vehicle,
    get_topic,
    is_vehicle_input,
    parse_status_key,
    prefix_of,
    ros2_topic_of,
    schema_key,
    split_ros2_topic,
    status_key,
    topic_of,
    vehicle_name,
)

__all__ = [
    "ALL", "ANY", "ARDUPILOT", "BASES", "BY_TOPIC", "DEFAULT", "DEFAULT_PREFIX", "DEFAULT_TOPIC", "DOUBT_FLAGS",
    "FIRST_UNIX_TIME", "JUMP_FIELDS", "MESSAGES", "OTHER_AUTOPILOT", "PAYLOAD_LIMIT", "RATE", "REJECTED", "RELEASES",
    "RESET_COUNTERS", "TOPICS", "YEAR_2000", "Address", "AddressError", "ArgumentError", "CdrLayout", "Codec",
    "Continuous", "DecodeError", "Definition", "EncodeError", "Encoded", "FieldReader", "FieldType",
    "InvalidMessageError", "Layout", "LayoutError", "Message", "MsgError", "NedbusError", "Provenance", "Quantity",
    "ResetTracker", "Row", "Selection", "Topic", "UnitQuaternion", "UnknownLayoutError", "VehicleLocalPosition",
    "VehicleNames", "ack_key", "address_of_alive_key", "all_status_keys", "bases_of_msg", "cdr_layout",
    "check_max_rate", "check_prefix", "check_vehicle", "codec_of", "dds_type", "decode_text", "decode_with", "define",
    "define_msg", "definition_of", "definition_text", "describe", "describe_flags", "encode_upgraded", "encode_with",
    "encoding_of", "field_type", "fitting_layout", "get_topic", "has_char_hash", "hash_of", "hash_of_msg",
    "identity_of", "is_unix_time", "is_vehicle_input", "jump_of", "message_doubts", "message_of_type_hash",
    "parse_status_key", "prefix_of", "provenance_of", "read_msg", "record_encoder", "ros2_topic_of", "ros2_type",
    "ros2_types", "schema_key", "short_hash", "split_ros2_topic", "status_key", "topic_of", "upgrade_fields",
    "upgrade_with", "vehicle_name",
]  # fmt: skip
