"""Layouts of logged messages, resolved from the format definitions of a log within size limits."""

import re
import struct
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from nedbus_msgs import FieldType, decode_text, field_type

BASIC_TYPES: Final[Mapping[str, FieldType]] = {
    **{
        f"{sign}int{bits}_t": field_type(f"{sign}int{bits}")
        for sign in ("", "u")
        for bits in (8, 16, 32, 64)
    },
    **{
        c: field_type(px4)
        for c, px4 in {
            "float": "float32",
            "double": "float64",
            "bool": "bool",
            "char": "char",
        }.items()
    },
}
"""ULog's basic types, by their C names."""
FIELD: Final = re.compile(r"(\w+)(?:\[(\d{1,9})\])? (\w{1,255});", re.ASCII)
"""One field of a format definition."""
UNSET_BOOLS: Final = "bools of {} whose byte is neither 0 nor 1 are read as true"
"""Warning for a topic with bools that PX4 did not initialize."""

_MAX_FORMATS: Final = 2**20  # characters of all formats; a real log has 50,000
_MAX_LAYOUTS: Final = 500  # a real log has 100, and PX4 300 topics
# fields of all messages, even rejected ones: each costs 45 us; a real log has 1,500
_MAX_ALL_FIELDS: Final = 8192
# fields of one message, including nested fields and padding; a real message has 100
_MAX_FIELDS: Final = 1000
_MAX_SIZE: Final = 65_533  # bytes of one message: msg_size is a uint16, and two bytes are msg_id
_MAX_NESTING: Final = 3  # levels of nested messages; PX4 has one


class PayloadField(NamedTuple):
    """One field of a message; `offset`: position in the payload [bytes]."""

    name: str
    kind: FieldType
    offset: int


class PayloadLayout:
    """The fields of a logged message; `size`: bytes without trailing padding, which PX4 does not log.

    `unpack`: return the values in a payload of at least `size` bytes; each element of an array is a value.
    `bool_mask`: the bits that are 0 if bools are 0 or 1, with the payload read as a little-endian integer.
    """

    def __init__(self, fields: tuple[PayloadField, ...], size: int, padding: int) -> None:
        self.fields = fields
        self.size = size
        self.padding = padding
        # index of each field among the unpacked values
        self._indices: list[tuple[str, int | slice]] = []
        code = "<"
        end = 0
        count = 0
        self.bool_mask = 0
        for name, kind, offset in fields:
            self._indices.append(
                (name, slice(count, count + kind.values) if kind.is_array else count)
            )
            code += f"{offset - end}x{kind.form}"
            end, count = offset + kind.values * kind.size, count + kind.values
            if kind.base == "bool":
                self.bool_mask |= int.from_bytes(b"\xfe" * kind.values) << 8 * offset
        self.unpack = struct.Struct(code).unpack_from

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Decode a payload of at least `size` bytes; values are int, float, bool, str, or tuples of numbers."""
        values = self.unpack(payload)
        fields: dict[str, Any] = {name: values[index] for name, index in self._indices}
        for name, kind, _ in self.fields:
            if kind.is_text:
                fields[name] = decode_text(fields[name])
        return fields

    def has_unset_bools(self, payload: bytes) -> bool:
        """Return whether a bool's byte is neither 0 nor 1."""
        return bool(self.bool_mask and int.from_bytes(payload, "little") & self.bool_mask)

    def count_unset_bools(self, payload: bytes) -> int:
        """Return the number of bools whose byte is neither 0 nor 1, because PX4 did not initialize it."""
        wrong = int.from_bytes(payload, "little") & self.bool_mask
        return len(payload) - wrong.to_bytes(len(payload), "little").count(0) if wrong else 0

    @property
    def dtype(self) -> Any:
        """Argument for `numpy.dtype` that describes a payload; a bool is a uint8."""
        types = [
            f"S{kind.size}"
            if kind.is_text
            else (f"<{kind.form.replace('?', 'B')}"[-1], kind.length or ())
            for _, kind, _ in self.fields
        ]
        names, _, offsets = zip(*self.fields, strict=True)
        return {"names": names, "formats": types, "offsets": offsets, "itemsize": self.size}


class Formats:
    """The format definitions of a log and their layouts; a hostile format may be recursive, or expand to gigabytes."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._layouts: dict[str, PayloadLayout] = {}
        self._free_characters = _MAX_FORMATS
        self._free_fields = _MAX_ALL_FIELDS

    def add(self, name: str, text: str) -> None:
        """Store a format definition; raise ValueError if it contradicts an earlier one, or there are too many."""
        if self._texts.get(name, text) != text:
            raise ValueError(f"{name} is defined twice, with different fields")
        if name not in self._texts:
            self._free_characters -= len(name) + len(text)
            if self._free_characters < 0:
                raise ValueError(f"the format definitions have more than {_MAX_FORMATS} characters")
            self._texts[name] = text

    def layout(self, name: str) -> PayloadLayout:
        """Return the layout of a message; raise ValueError if its format is unknown, invalid or too large."""
        if name not in self._layouts:
            if len(self._layouts) == _MAX_LAYOUTS:
                raise ValueError(f"the log has more than {_MAX_LAYOUTS} messages")
            self._layouts[name] = self._resolve(name)
        return self._layouts[name]

    def _resolve(self, name: str) -> PayloadLayout:
        fields: dict[str, PayloadField] = {}
        offset = size = 0
        for number, (field, c_type, length) in enumerate(self._expand(name), 1):
            base = BASIC_TYPES[c_type]
            start, offset = offset, offset + base.size * (length or 1)
            self._free_fields -= 1
            if self._free_fields < 0:
                raise ValueError(f"the messages of the log have more than {_MAX_ALL_FIELDS} fields")
            if number > _MAX_FIELDS or offset > _MAX_SIZE:
                raise ValueError(f"it has more than {_MAX_FIELDS} fields or {_MAX_SIZE} bytes")
            if not field.rpartition(".")[2].startswith("_padding"):
                flat = (
                    re.sub(r"\[(\d+)\]", r"_\1", field).replace(".", "_") if "." in field else field
                )
                if flat in fields:
                    raise ValueError(
                        f"two fields are called {flat} after flattening nested messages"
                    )
                array = "char" if c_type == "char" else base.base
                fields[flat] = PayloadField(
                    flat, field_type(f"{array}[{length}]") if length else base, start
                )
            size = size if field.startswith("_padding") else offset
        return PayloadLayout(tuple(fields.values()), size, offset - size)

    def _expand(
        self, name: str, prefix: str = "", level: int = 0
    ) -> Iterator[tuple[str, str, int | None]]:
        """Yield name, basic type and length of each field one by one, which lets the caller stop at its limits."""
        if level > _MAX_NESTING:
            raise ValueError(f"it nests messages more than {_MAX_NESTING} levels deep")
        if not self._texts.get(name):
            raise ValueError(f"the format of {name} is missing, or has no fields")
        for found in FIELD.finditer(self._texts[name]):
            kind = found[1]
            field = prefix + found[3]
            length = int(found[2]) if found[2] else None
            if length == 0:
                raise ValueError(f"the array {field} has length 0")
            if kind in BASIC_TYPES:
                yield field, kind, length
                continue
            for index in range(length or 1):
                yield from self._expand(
                    kind, f"{field}." if length is None else f"{field}[{index}].", level + 1
                )
