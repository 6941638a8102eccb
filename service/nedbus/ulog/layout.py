"""Layouts of logged messages, resolved from the format definitions of a log within size limits."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from nedbus import limits
from nedbus_msgs import BASES, FieldType, decode_text, field_type

BASIC_TYPES: Final[Mapping[str, FieldType]] = {
    "int8_t": field_type("int8"),
    "int16_t": field_type("int16"),
    "int32_t": field_type("int32"),
    "int64_t": field_type("int64"),
    "uint8_t": field_type("uint8"),
    "uint16_t": field_type("uint16"),
    "uint32_t": field_type("uint32"),
    "uint64_t": field_type("uint64"),
    "float": field_type("float32"),
    "double": field_type("float64"),
    "bool": field_type("bool"),
    "char": field_type("char"),
}
"""ULog's basic types, by their C names."""
FIELD: Final = re.compile(r"(\w+)(?:\[(\d{1,9})\])? (\w{1,255});", re.ASCII)
"""One field of a format definition."""
UNSET_BOOLS: Final = "bools of {} whose byte is neither 0 nor 1 are read as true"
"""Warning for a topic with bools that PX4 did not initialize."""

_MESSAGE_BYTES: Final = 65_533  # of one message: msg_size is a uint16, and two bytes are msg_id


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
            index = slice(count, count + kind.values) if kind.is_array else count
            self._indices.append((name, index))
            count += kind.values
            code += f"{offset - end}x{kind.form}"
            end = offset + kind.values * kind.size
            if kind.base == "bool":
                mask = int.from_bytes(b"\xfe" * kind.values)
                self.bool_mask |= mask << 8 * offset
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
        if not wrong:
            return 0
        correct_bytes = wrong.to_bytes(len(payload), "little").count(0)
        return len(payload) - correct_bytes

    @property
    def dtype(self) -> Any:
        """Argument for `numpy.dtype` that describes a payload; a bool is a uint8."""
        types: list[Any] = []
        for _, kind, _ in self.fields:
            if kind.is_text:
                types.append(f"S{kind.size}")
            else:
                code = BASES[kind.base].code.replace("?", "B")
                types.append((f"<{code}", kind.length or ()))
        names = [field.name for field in self.fields]
        offsets = [field.offset for field in self.fields]
        return {"names": names, "formats": types, "offsets": offsets, "itemsize": self.size}


class Formats:
    """The format definitions of a log and their layouts; a hostile format may be recursive, or expand to gigabytes."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._layouts: dict[str, PayloadLayout] = {}
        self._characters = 0
        self._fields = 0  # of all messages, even rejected ones

    def add(self, name: str, text: str) -> None:
        """Store a format definition; raise ValueError if it contradicts an earlier one, or there are too many."""
        if name in self._texts:
            if self._texts[name] != text:
                raise ValueError(f"{name} is defined twice, with different fields")
            return
        self._characters += len(name) + len(text)
        if self._characters > limits.ULOG_FORMATS:
            raise ValueError(
                f"the format definitions have more than {limits.ULOG_FORMATS} characters"
            )
        self._texts[name] = text

    def layout(self, name: str) -> PayloadLayout:
        """Return the layout of a message; raise ValueError if its format is unknown, invalid or too large."""
        if name not in self._layouts:
            if len(self._layouts) == limits.ULOG_LAYOUTS:
                raise ValueError(f"the log has more than {limits.ULOG_LAYOUTS} messages")
            self._layouts[name] = self._resolve(name)
        return self._layouts[name]

    def _resolve(self, name: str) -> PayloadLayout:
        fields: dict[str, PayloadField] = {}
        end = 0  # of the last field
        size = 0  # without trailing padding
        for number, logged in enumerate(self._expand(name), 1):
            self._fields += 1
            if self._fields > limits.ULOG_FIELDS:
                raise ValueError(
                    f"the messages of the log have more than {limits.ULOG_FIELDS} fields"
                )
            offset = end
            end += logged.size
            if number > limits.ULOG_MESSAGE_FIELDS or end > _MESSAGE_BYTES:
                raise ValueError(
                    f"it has more than {limits.ULOG_MESSAGE_FIELDS} fields or {_MESSAGE_BYTES} bytes"
                )
            if not logged.is_trailing_padding:
                size = end
            if logged.is_padding:
                continue
            flat = logged.flat_name
            if flat in fields:
                raise ValueError(f"two fields are called {flat} after flattening nested messages")
            fields[flat] = PayloadField(flat, logged.kind, offset)
        return PayloadLayout(tuple(fields.values()), size, end - size)

    def _expand(self, name: str, prefix: str = "", level: int = 0) -> Iterator[_LoggedField]:
        """Yield the fields of a message one by one, which lets the caller stop at its limits."""
        if level > limits.ULOG_NESTING:
            raise ValueError(f"it nests messages more than {limits.ULOG_NESTING} levels deep")
        if not self._texts.get(name):
            raise ValueError(f"the format of {name} is missing, or has no fields")
        for declaration in FIELD.finditer(self._texts[name]):
            c_type, digits, field_name = declaration.groups()
            path = prefix + field_name
            length = int(digits) if digits else None
            if length == 0:
                raise ValueError(f"the array {path} has length 0")
            if c_type in BASIC_TYPES:
                yield _LoggedField(path, c_type, length)
            elif length is None:
                yield from self._expand(c_type, f"{path}.", level + 1)
            else:
                for index in range(length):
                    yield from self._expand(c_type, f"{path}[{index}].", level + 1)


class _LoggedField(NamedTuple):
    """A field of a basic type; `path`: its name in the log, such as `esc[0].esc_rpm`; `length`: of an array."""

    path: str
    c_type: str
    length: int | None

    @property
    def size(self) -> int:
        """Its size [bytes]."""
        of_element = BASIC_TYPES[self.c_type].size
        if self.length is None:
            return of_element
        return of_element * self.length

    @property
    def kind(self) -> FieldType:
        """PX4's type; ValueError for an array with too many elements."""
        base = BASIC_TYPES[self.c_type]
        if not self.length:
            return base
        name = "char" if self.c_type == "char" else base.base
        return field_type(f"{name}[{self.length}]")

    @property
    def flat_name(self) -> str:
        """The name after flattening, such as `esc_0_esc_rpm`."""
        if "." not in self.path:
            return self.path
        return re.sub(r"\[(\d+)\]", r"_\1", self.path).replace(".", "_")

    @property
    def is_padding(self) -> bool:
        """Whether it only fills up a message, or one that is nested in it."""
        return self.path.rpartition(".")[2].startswith("_padding")

    @property
    def is_trailing_padding(self) -> bool:
        """Whether PX4 does not log it if it is the last field."""
        return self.path.startswith("_padding")
