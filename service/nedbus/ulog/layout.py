"""Layouts of logged messages, resolved from the formats of a log within limits."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, Final, NamedTuple

from nedbus_msgs import BASES, FieldType, field_type

BASIC_TYPES: Final[Mapping[str, FieldType]] = {
    **{f"{sign}int{bits}_t": field_type(f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)},
    "float": field_type("float32"),
    "double": field_type("float64"),
    "bool": field_type("bool"),
    "char": field_type("char"),
}
"""The types that ULog defines, by their names in C."""

MAX_DATA: Final = 65_533
"""Maximum size of a logged message [bytes]: the size of a record is a uint16, and two bytes are the message id."""

_MAX_FORMATS: Final = 2**20  # characters of all formats; those of a real log have 50,000
_MAX_FIELDS: Final = 1000  # of one message, those of nested messages included; real ones have fewer than 100
_MAX_RESOLVED: Final = 2**16  # fields of all messages; those of a real log have 5,000
_MAX_NESTING: Final = 3  # levels of nested messages; PX4 has one
_FIELD = re.compile(r"(\w+)(?:\[(\d{1,9})\])? (\w+);", re.ASCII)
_FIELDS = re.compile(rf"(?:{_FIELD.pattern})*", re.ASCII)
_BOOLS: Final = (False, True, *range(2, 256))  # a byte other than 0 and 1 is left for the model to reject


class PayloadField(NamedTuple):
    """One field of a message, with the name that nedbus gives it and its offset in the payload."""

    name: str
    kind: FieldType
    offset: int


class PayloadLayout:
    """The layout of a logged message without padding.

    Fields of nested messages are prefixed: `esc[0].rpm` of a log is `esc_0_rpm`.
    `size`: bytes of a payload without the padding at its end, which PX4 does not log; `padding`: bytes of that.
    """

    def __init__(self, fields: tuple[PayloadField, ...], size: int, padding: int) -> None:
        self.fields, self.size, self.padding = fields, size, padding

    @cached_property
    def dtype(self) -> Any:
        """The argument of `numpy.dtype` for the type of a payload; a bool is a uint8."""
        codes = {field: "<" + _code(field.kind) for field in self.fields}
        return {
            "names": [field.name for field in self.fields],
            "formats": [(code, (field.kind.length,)) if field.kind.length else code for field, code in codes.items()],
            "offsets": [field.offset for field in self.fields],
            "itemsize": self.size,
        }

    def decode(self, payload: bytes) -> dict[str, object]:
        """Return the fields of a payload of at least `size` bytes: int, float, bool, or tuples of them."""
        values = self._struct.unpack_from(payload)
        fields: dict[str, Any] = {name: values[place] for name, place in self._places}
        for name in self._bools:
            value = fields[name]
            fields[name] = _BOOLS[value] if isinstance(value, int) else tuple(map(_BOOLS.__getitem__, value))
        return fields

    @cached_property
    def _struct(self) -> struct.Struct:
        parts, end = ["<"], 0
        for field in self.fields:
            parts.append(f"{field.offset - end}x{field.kind.count}{_code(field.kind)}")
            end = field.offset + field.kind.count * field.kind.size
        return struct.Struct("".join(parts))

    @cached_property
    def _places(self) -> tuple[tuple[str, int | slice], ...]:
        """The place of each field in the unpacked values."""
        found: list[tuple[str, int | slice]] = []
        start = 0
        for name, kind, _ in self.fields:
            found.append((name, slice(start, start + kind.count) if kind.length else start))
            start += kind.count
        return tuple(found)

    @cached_property
    def _bools(self) -> tuple[str, ...]:
        return tuple(field.name for field in self.fields if field.kind.base == "bool")


class Formats:
    """The formats of a log, and the layouts resolved from them.

    A format is not trusted: it may be recursive, or expand to gigabytes. Sizes are checked before it is expanded.
    """

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._sizes: dict[str, tuple[int, int, int]] = {}  # fields, bytes and levels of each message
        self._layouts: dict[str, PayloadLayout] = {}
        self._length = self._resolved = 0

    def __contains__(self, name: str) -> bool:
        return name in self._texts

    def add(self, name: str, text: str) -> None:
        """Store the format of a message; raise ValueError if it is invalid, or contradicts an earlier one."""
        known = self._texts.get(name)
        if known is not None:
            if known != text:
                raise ValueError(f"a second format of {name} with other fields")
            return
        if self._length + len(name) + len(text) > _MAX_FORMATS:
            raise ValueError(f"the formats have more than {_MAX_FORMATS} characters")
        self._length += len(name) + len(text)
        self._texts[name] = text

    def layout(self, name: str) -> PayloadLayout:
        """Return the layout of a message; raise ValueError if its format is unknown or invalid."""
        if name not in self._layouts:
            count, *_ = self._measure(name, 0)
            if self._resolved + count > _MAX_RESOLVED:
                raise ValueError(f"all messages together have more than {_MAX_RESOLVED} fields")
            self._resolved += count
            self._layouts[name] = self._resolve(name)
        return self._layouts[name]

    def _measure(self, name: str, level: int) -> tuple[int, int, int]:
        """Return the number of fields, of bytes and of nested levels of a message."""
        if name not in self._sizes:
            if level > _MAX_NESTING:
                raise ValueError(f"messages are nested more than {_MAX_NESTING} levels deep, or in a circle")
            if name not in self._texts:
                raise ValueError(f"{name} has no format")
            count = size = levels = 0
            for kind, length, _ in self._parse(name):
                basic = BASIC_TYPES.get(kind)
                inner = (1, basic.size, 0) if basic else self._measure(kind, level + 1)
                count += inner[0] if basic else inner[0] * (length or 1)
                size += inner[1] * (length or 1)
                levels = max(levels, inner[2] + (not basic))
                if length == 0 or count > _MAX_FIELDS or size > MAX_DATA:
                    raise ValueError(f"{name} has an empty array, over {_MAX_FIELDS} fields or over {MAX_DATA} bytes")
            if not count:
                raise ValueError(f"{name} has no fields")
            self._sizes[name] = count, size, levels
        if level + self._sizes[name][2] > _MAX_NESTING:
            raise ValueError(f"messages are nested more than {_MAX_NESTING} levels deep")
        return self._sizes[name]

    def _parse(self, name: str) -> Iterator[tuple[str, int | None, str]]:
        """Yield type, length of the array, and name of each field in a format."""
        for found in _FIELD.finditer(self._texts[name]):
            yield found[1], int(found[2]) if found[2] else None, found[3]

    def _resolve(self, name: str) -> PayloadLayout:
        _, size, _ = self._measure(name, 0)
        fields: list[PayloadField] = []
        padding = 0
        for field, kind, length, offset in self._flatten(name, "", 0):
            if field.startswith("_padding"):
                padding += BASIC_TYPES[kind].size * (length or 1)
                continue
            padding = 0
            if not field.rpartition(".")[2].startswith("_padding"):
                flat = re.sub(r"\[(\d+)\]", r"_\1", field).replace(".", "_")
                fields.append(PayloadField(flat, FieldType(BASIC_TYPES[kind].base, length), offset))
        names = [field.name for field in fields]
        if len(set(names)) < len(names):
            twice = max(names, key=names.count)
            raise ValueError(f"two fields of {name} are called {twice}, including those of nested messages")
        return PayloadLayout(tuple(fields), size - padding, padding)

    def _flatten(self, name: str, prefix: str, offset: int) -> Iterator[tuple[str, str, int | None, int]]:
        """Yield name, type, length and offset of all fields, those of nested messages included."""
        for kind, length, field in self._parse(name):
            if kind in BASIC_TYPES:
                yield prefix + field, kind, length, offset
                offset += BASIC_TYPES[kind].size * (length or 1)
                continue
            for index in range(length or 1):
                inner = f"{prefix}{field}." if length is None else f"{prefix}{field}[{index}]."
                yield from self._flatten(kind, inner, offset)
                offset += self._sizes[kind][1]


def is_format(text: str) -> bool:
    """Return whether a text has the form of the fields of a format."""
    return _FIELDS.fullmatch(text) is not None


def _code(kind: FieldType) -> str:
    """Return the struct format of one value; any byte is read where a bool should be."""
    return "B" if kind.base == "bool" else BASES[kind.base].code
