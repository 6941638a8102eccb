"""CDR codec for all layouts, as in ROS 2, PX4's Zenoh module and rosbag2.

Converts between payloads and fields by name; the model validates the fields.
"""

import struct
from collections.abc import Mapping
from typing import Any, Final

from pydantic import ValidationError

from nedbus_msgs.errors import DecodeError, EncodeError
from nedbus_msgs.model.declaration import Layout, cached_on_owner
from nedbus_msgs.model.definition import Definition
from nedbus_msgs.model.validation import Validation

HEADER: Final = b"\x00\x01\x00\x00"  # XCDR1, little-endian, no options
_PX4_TRAILER: Final = 24  # PX4 sends 4 + sizeof(struct) + 24 bytes, and its struct may be longer than the CDR body


class CdrLayout:
    """CDR form of one layout: the struct of the body, with each field at the next multiple of its alignment.

    `offsets`: payload offset of each field. `zeros`: payload of zeros. `limit`: maximum payload size [bytes].
    `bool_mask`: the bits that must be 0 because bools are 0 or 1, with the payload read as a little-endian integer.
    """

    def __init__(self, layout: Layout) -> None:
        body, size, unpadded, self.bool_mask = "<", 0, 0, 0
        self.offsets: dict[str, int] = {}
        for name, kind in layout.types.items():
            padding = 0 if kind.is_text else -size % kind.size
            body += (f"{padding}x" if padding else "") + kind.form
            self.offsets[name] = len(HEADER) + size + padding
            if kind.base == "bool":
                self.bool_mask |= int.from_bytes(b"\xfe" * kind.values) << 8 * self.offsets[name]
            size += padding + kind.size * kind.values
            unpadded += kind.size * kind.values
        px4_struct = unpadded + -unpadded % 8
        self.limit = len(HEADER) + max(size, px4_struct + _PX4_TRAILER)
        self.body, self.zeros = struct.Struct(body), HEADER + bytes(size)
        self.validation = Validation(layout.types, ())


def decode_with(definition: Definition[Any], payload: bytes, layout: Layout) -> dict[str, object]:
    """Decode a CDR payload to fields by name, in the order of the layout; arrays are tuples.

    Padding and the bytes that PX4 appends are ignored.

    Raises DecodeError for an encapsulation other than little-endian XCDR1, a wrong payload size, or a bool that is
    neither 0 nor 1.
    """
    cdr = cdr_layout(layout)
    min_size = len(cdr.zeros)
    if payload[:2] != HEADER[:2]:
        start = f"starts with {payload[:2].hex(' ')}" if payload else "empty"
        raise DecodeError(f"the payload is not little-endian CDR ({start})", definition.name)
    if not min_size <= len(payload) <= cdr.limit:
        sizes = f"{min_size}" if cdr.limit == min_size else f"{min_size} to {cdr.limit}"
        raise DecodeError(f"{len(payload)} bytes, expected {sizes} for layout {layout.name}", definition.name)
    if wrong := int.from_bytes(payload[:min_size], "little") & cdr.bool_mask:
        offset = ((wrong & -wrong).bit_length() - 1) // 8
        name = next(name for name, first in reversed([*cdr.offsets.items()]) if first <= offset)
        raise DecodeError(f"{name} is {payload[offset]}, not a bool (0 or 1)", definition.name)
    return cdr.validation.by_name(cdr.validation.unflatten(cdr.body.unpack_from(payload, len(HEADER))))


def encode_with(definition: Definition[Any], fields: Mapping[str, object], layout: Layout) -> bytes:
    """Encode the fields of a layout, as returned by `downgrade`, as CDR with zeros for padding.

    float32 fields are rounded to the nearest float32.

    Raises EncodeError for a value that its type cannot hold.
    """
    cdr = cdr_layout(layout)
    row = cdr.validation.values_of(fields)
    try:
        return HEADER + cdr.body.pack(*cdr.validation.flatten(cdr.validation.validate(row)))
    except ValidationError as exc:
        name, problem = list(layout.types)[int(exc.errors()[0]["loc"][0])], "is not of type"
    except OverflowError:
        (name, _), problem = next(cdr.validation.overflows(fields)), "is beyond the range of"
    raise EncodeError(f"{name}={fields[name]!r:.40} {problem} {layout.types[name]}", definition.name)


@cached_on_owner
def cdr_layout(layout: Layout) -> CdrLayout:
    """Return the cached CDR form of a layout."""
    return CdrLayout(layout)
