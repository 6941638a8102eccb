"""CDR codec for all layouts, as in ROS 2, PX4's Zenoh module and rosbag2.

Converts between payloads and fields by name; the model validates the fields.
"""

import struct
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Final

from pydantic import ValidationError

from nedbus_msgs.errors import DecodeError, EncodeError, InvalidMessageError
from nedbus_msgs.model.declaration import RELEASES, Layout, cached_on_owner
from nedbus_msgs.model.definition import Definition
from nedbus_msgs.model.validation import Validation

from .records import encode_upgraded

HEADER: Final = b"\x00\x01\x00\x00"  # XCDR1, little-endian, no options
_ALIGNMENT: Final = 4  # bytes to which writers may pad a payload
# PX4 sends 4 + sizeof(struct) + 24 bytes, and its struct may be longer than the CDR body
_PX4_TRAILER: Final = 24


class CdrLayout:
    """CDR form of one layout: the struct of the body, with each field at the next multiple of its alignment.

    `offsets`: payload offset of each field. `zeros`: payload of zeros. `limit`: maximum payload size [bytes].
    `bool_mask`: the bits that must be 0 because bools are 0 or 1, with the payload read as a little-endian integer.
    """

    def __init__(self, layout: Layout) -> None:
        body = "<"
        size = 0
        unpadded = 0
        self.bool_mask = 0
        self.offsets: dict[str, int] = {}
        for name, kind in layout.types.items():
            if kind.is_text:
                padding = 0
            else:
                padding = -size % kind.size
            if padding:
                body += f"{padding}x"
            body += kind.form
            offset = len(HEADER) + size + padding
            self.offsets[name] = offset
            if kind.base == "bool":
                mask = int.from_bytes(b"\xfe" * kind.values)
                self.bool_mask |= mask << 8 * offset
            bytes_of_values = kind.size * kind.values
            size += padding + bytes_of_values
            unpadded += bytes_of_values
        px4_struct = unpadded + -unpadded % 8  # to the next multiple of 8
        self.limit = len(HEADER) + max(size, px4_struct + _PX4_TRAILER)
        self.body = struct.Struct(body)
        self.zeros = HEADER + bytes(size)
        self.size = len(self.zeros)
        self.name = layout.name
        self.validation = Validation(layout.types, ())

    def check(self, payload: bytes) -> str | None:
        """Return why a payload does not have this form, None if it has."""
        size = self.size
        if payload[:2] != HEADER[:2]:
            start = f"starts with {payload[:2].hex(' ')}" if payload else "empty"
            return f"the payload is not little-endian CDR ({start})"
        if not size <= len(payload) <= self.limit:
            if self.limit == size:
                sizes = f"{size}"
            else:
                sizes = f"{size} to {self.limit}"
            return f"{len(payload)} bytes, expected {sizes} for layout {self.name}"
        wrong = int.from_bytes(payload[:size], "little") & self.bool_mask
        if wrong:
            lowest_bit = (wrong & -wrong).bit_length() - 1
            offset = lowest_bit // 8
            before = [name for name, first in self.offsets.items() if first <= offset]
            return f"{before[-1]} is {payload[offset]}, not a bool (0 or 1)"
        return None


def decode_with(definition: Definition[Any], payload: bytes, layout: Layout) -> dict[str, object]:
    """Decode a CDR payload to fields by name, in the order of the layout; arrays are tuples.

    Padding and the bytes that PX4 appends are ignored.

    Raises DecodeError for an encapsulation other than little-endian XCDR1, a wrong payload size, or a bool that is
    neither 0 nor 1.
    """
    cdr = cdr_layout(layout)
    reason = cdr.check(payload)
    if reason:
        raise DecodeError(f"{reason}{_explain_size(definition, payload, layout)}", definition.name)
    values = cdr.body.unpack_from(payload, len(HEADER))
    return cdr.validation.by_name(cdr.validation.unflatten(values))


def fitting_layout(definition: Definition[Any], payload: bytes) -> Layout | None:
    """Return the only layout of a message whose size and rules a payload fits; None without one.

    A payload has the size of the layout, or else that with the bytes that PX4 appends.
    """
    exact: list[Layout] = []
    with_trailer: list[Layout] = []
    for layout in definition.layouts.values():
        cdr = cdr_layout(layout)
        if 0 <= len(payload) - cdr.size < _ALIGNMENT:
            exact.append(layout)
        if len(payload) == cdr.limit:
            with_trailer.append(layout)
    fitting: list[Layout] = []
    for layout in exact or with_trailer:
        if not cdr_layout(layout).check(payload):
            with suppress(InvalidMessageError):
                encode_upgraded(definition, decode_with(definition, payload, layout))
                fitting.append(layout)
    if len(fitting) == 1:
        return fitting[0]
    return None


def _explain_size(definition: Definition[Any], payload: bytes, layout: Layout) -> str:
    """Return what a payload of the wrong size is, and the remedy; "" if it fits no other layout."""
    fits = fitting_layout(definition, payload)
    if fits is None or fits is layout:
        return ""
    version = f"{fits.name}, a development version of PX4"
    branch = "the vehicle's version"
    if fits.name in RELEASES:
        version = f"PX4 {fits.name}"
        branch = f"release/{fits.name}"
    return (
        f"; they fit the layout of {version}: the vehicle's px4_msgs differ,"
        f" rebuild px4_msgs at {branch}"
    )


def encode_with(definition: Definition[Any], fields: Mapping[str, object], layout: Layout) -> bytes:
    """Encode the fields of a layout, as returned by `downgrade`, as CDR with zeros for padding.

    float32 fields are rounded to the nearest float32.

    Raises EncodeError for a value that its type cannot hold.
    """
    cdr = cdr_layout(layout)
    row = cdr.validation.values_of(fields)
    try:
        values = cdr.validation.flatten(cdr.validation.validate(row))
        return HEADER + cdr.body.pack(*values)
    except ValidationError as exc:
        position = int(exc.errors()[0]["loc"][0])
        name = list(layout.types)[position]
        problem = "is not of type"
    except OverflowError:
        name, _ = next(cdr.validation.overflows(fields))
        problem = "is beyond the range of"
    raise EncodeError(
        f"{name}={fields[name]!r:.40} {problem} {layout.types[name]}", definition.name
    )


@cached_on_owner
def cdr_layout(layout: Layout) -> CdrLayout:
    """Return the cached CDR form of a layout."""
    return CdrLayout(layout)
