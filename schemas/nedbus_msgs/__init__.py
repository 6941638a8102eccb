"""The contract of nedbus: the message, its layouts, its topics and its wire format; no I/O, no Zenoh."""

from .cdr import decode_cdr, encode_cdr
from .errors import AddressError, DecodeError, EncodeError, LayoutError, NedbusError, UnknownLayoutError
from .layouts import CURRENT, LAYOUTS, WIRE_LAYOUTS, Layout, downgrade, find_layout, upgrade
from .origin import Origin, encoding_of, origin_of
from .position import FIELD_TYPES, VehicleLocalPosition
from .ros2_types import ROS2_TYPE, ROS2_TYPES, dds_type, layout_of_type_hash, type_hash
from .rows import Row
from .schema import json_schema, layout_table
from .topics import (
    ANY,
    DEFAULT_PREFIX,
    ENCODING,
    TOPICS,
    Address,
    Topic,
    address_of_alive_key,
    alive_selection,
    check_prefix,
    check_vehicle,
    get_topic,
    schema_key,
    selection,
    status_key,
)
from .wire import PAYLOAD_LIMIT, PAYLOAD_SIZE, decode, decode_row, describe, encode, encode_fields, encode_row

__all__ = [
    "ANY",
    "CURRENT",
    "DEFAULT_PREFIX",
    "ENCODING",
    "FIELD_TYPES",
    "LAYOUTS",
    "PAYLOAD_LIMIT",
    "PAYLOAD_SIZE",
    "ROS2_TYPE",
    "ROS2_TYPES",
    "TOPICS",
    "WIRE_LAYOUTS",
    "Address",
    "AddressError",
    "DecodeError",
    "EncodeError",
    "Layout",
    "LayoutError",
    "NedbusError",
    "Origin",
    "Row",
    "Topic",
    "UnknownLayoutError",
    "VehicleLocalPosition",
    "address_of_alive_key",
    "alive_selection",
    "check_prefix",
    "check_vehicle",
    "dds_type",
    "decode",
    "decode_cdr",
    "decode_row",
    "describe",
    "downgrade",
    "encode",
    "encode_cdr",
    "encode_fields",
    "encode_row",
    "encoding_of",
    "find_layout",
    "get_topic",
    "json_schema",
    "layout_of_type_hash",
    "layout_table",
    "origin_of",
    "schema_key",
    "selection",
    "status_key",
    "type_hash",
    "upgrade",
]
