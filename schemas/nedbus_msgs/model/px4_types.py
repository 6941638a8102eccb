"""PX4's field types, and declarations of fields and of properties guarded by validity flags."""

import math
import re
import struct
from collections.abc import Callable, Mapping
from functools import cache, cached_property
from typing import Annotated, Any, Final, NamedTuple, TypeVar, cast

from pydantic import Field
from pydantic_core import CoreSchema, core_schema

from nedbus_msgs import limits

_T = TypeVar("_T")

NAN: Final = math.nan
# us since 1970; for scripts that know it from earlier releases
YEAR_2000: Final = 946_684_800_000_000
# us since 1970, 2009-02-13: PX4 sets no clock to an earlier time
FIRST_UNIX_TIME: Final = 1_234_567_890_000_000
_YEAR_2100: Final = 4_102_444_800_000_000


class Base(NamedTuple):
    """A base type: struct format, msgpack tag, id in ROS 2 type descriptions, and default."""

    code: str
    tag: int
    ros2: int
    absent: float | str


BASES: Final[Mapping[str, Base]] = {
    "bool": Base("?", 0xC2, 15, False),
    "int8": Base("b", 0xD0, 2, 0),
    "uint8": Base("B", 0xCC, 3, 0),
    "int16": Base("h", 0xD1, 4, 0),
    "uint16": Base("H", 0xCD, 5, 0),
    "int32": Base("i", 0xD2, 6, 0),
    "uint32": Base("I", 0xCE, 7, 0),
    "int64": Base("q", 0xD3, 8, 0),
    "uint64": Base("Q", 0xCF, 9, 0),
    "float32": Base("f", 0xCA, 10, NAN),
    "float64": Base("d", 0xCB, 11, NAN),
    "char": Base("s", 0xDA, 3, ""),  # only in arrays, which are text; ROS 2 uses uint8
}
# PX4's other names for types of single values
ALIASES: Final[Mapping[str, str]] = {"char": "uint8", "byte": "uint8"}


class FieldType(str):
    """The name of a PX4 field type, such as `float32[4]`, with derived properties; created by `field_type`.

    `base`: the type of one value; `length`: number of elements of an array, None for a single value.
    `is_text`: True for a char array. `char[127]` is a single value, a `str` of at most 127 bytes of UTF-8, which ends
    at the first NUL; bytes that are not UTF-8 become "?".
    `is_array`: True for a type whose value is a tuple. `values`: number of values.
    `form`: the struct format of all values. `size`: size of one value in bytes.
    `is_float`: True for float types, whose values may be NaN. `limits`: minimum and maximum of an integer type.
    `absent`: value of a field that is not provided: NaN, false, 0 or empty text; an array has it in each element.
    """

    def __init__(self, _: str) -> None:
        self.base, _, length = self.rstrip("]").partition("[")
        base = BASES[self.base]
        self.length = int(length) if length else None
        self.is_text = self.base == "char"
        self.is_float = self.base.startswith("float")
        self.is_array = self.length is not None and not self.is_text
        self.form = f"{self.length or 1}{base.code}"
        self.values = 1
        self.absent: object = base.absent
        if self.is_array:
            self.values = int(length)
            self.absent = (base.absent,) * self.values
        self.size = struct.calcsize("<" + self.form) // self.values
        half_range = 2 ** (8 * self.size - 1)
        self.limits = (-half_range, half_range - 1)
        if self.base.startswith("uint"):
            self.limits = (0, 2 * half_range - 1)

    def fit(self, value: Any) -> Any:
        """Convert a value, or a tuple of at most `length` values, to this type; return None if a value would change.

        A shorter tuple is padded with the value for "not provided".
        """
        base = BASES[self.base]
        if self.is_text:
            fits = isinstance(value, str) and len(encode_text(value)) <= self.size
            return value if fits else None
        if self.length is not None:
            if not isinstance(value, tuple) or len(value) > self.length:
                return None
            elements = tuple(map(field_type(self.base).fit, value))
            if None in elements:
                return None
            return elements + (base.absent,) * (self.length - len(value))
        form = f"<{base.code}"
        try:
            if self.is_float or self.base == "bool":
                number = value
            else:
                number = int(value)
            (fitted,) = struct.unpack(form, struct.pack(form, number))
        except (TypeError, ValueError, OverflowError, struct.error):
            return None
        fits = fitted == value or math.isnan(fitted)
        return fitted if fits else None

    @cached_property
    def annotation(self) -> Any:
        """The type annotation of a model's field."""
        value: Any = int
        if self.is_text:
            value = str
        elif self.base == "bool":
            value = bool
        elif self.is_float:
            value = float
        if self.is_array:
            value = tuple[(value,) * self.values]  # type: ignore[misc] # one per value
        return Annotated[value, self, Field(default=self.absent)]

    def core_schema(self, *, from_json: bool) -> CoreSchema:
        """Return Pydantic's schema: integers have limits; with `from_json`, floats may be names such as "NaN"."""
        if self.is_text:
            text = core_schema.str_schema(max_length=self.size)
            return core_schema.no_info_after_validator_function(self._check_text, text)
        if self.length is not None:
            element = field_type(self.base).core_schema(from_json=from_json)
            return core_schema.tuple_positional_schema([element] * self.length)
        if self.base == "bool":
            return core_schema.bool_schema()
        if not self.is_float:
            least, greatest = self.limits
            return core_schema.int_schema(ge=least, le=greatest)
        number = core_schema.float_schema()
        if not from_json:
            return number
        names = core_schema.literal_schema(["NaN", "Infinity", "-Infinity"])
        from_name = core_schema.no_info_after_validator_function(float, names)
        from_json_value = core_schema.union_schema([number, from_name])
        return core_schema.json_or_python_schema(from_json_value, number)

    def _check_text(self, text: str) -> str:
        if len(encode_text(text)) > self.size:
            raise ValueError(f"text exceeds {self.size} bytes of UTF-8")
        return text

    def __get_pydantic_core_schema__(self, source: object, handler: object) -> CoreSchema:
        return self.core_schema(from_json=True)


def encode_text(text: str) -> bytes:
    """Encode text as UTF-8 up to its first NUL; raise TypeError if it is not a str."""
    data = str.encode(text, "utf-8", "replace")
    return data.partition(b"\0")[0]


def decode_text(data: bytes) -> str:
    """Decode a char array up to its first NUL; invalid UTF-8 becomes "?", which, unlike U+FFFD, takes one byte."""
    text = data.partition(b"\0")[0].decode(errors="replace")
    return text.replace("\ufffd", "?")


@cache
def field_type(text: str) -> FieldType:
    """Parse the name of a PX4 type.

    Raises ValueError for an unknown base type, or an array with no or too many elements.
    """
    parts = re.fullmatch(r"(\w+)(?:\[(\d{1,9})\])?", text, re.ASCII)
    if parts is None:
        raise ValueError(f"{text!r} is not a type; expected one such as uint8 or float32[4]")
    base, digits = parts.groups()
    is_text = base == "char" and digits
    if not is_text:
        base = ALIASES.get(base, base)
    if base not in BASES:
        raise ValueError(
            f"{base!r} is not a type; expected {', '.join(BASES)}, or an array of fixed length"
        )
    if not digits:
        return FieldType(base)
    length = int(digits)
    if not 0 < length <= limits.ARRAY_ELEMENTS:
        raise ValueError(f"array of {length} elements; expected 1 to {limits.ARRAY_ELEMENTS}")
    return FieldType(f"{base}[{length}]")


def is_unix_time(timestamp_us: Any) -> Any:
    """Return whether a timestamp [us], or each in an array, is Unix time (2009-02-13 to 2100), not time since boot."""
    # `&`, because `and` does not work on arrays
    return (timestamp_us >= FIRST_UNIX_TIME) & (timestamp_us < _YEAR_2100)


def field(meaning: str) -> Any:
    """Declare a field with its unit, frame and meaning; its default is NaN, false or 0."""
    return Field(description=meaning)


def while_valid(make: Callable[..., _T], meaning: str, *flags: str) -> _T | None:
    """Declare a property of models and rows: None while one of its flags is false or not provided.

    `make`: builds the value from the fields that these flags guard, as declared by FiniteWhile.
    """

    def value(message: Any) -> _T | None:
        guarded: list[Any] = []
        for flag in flags:
            if not getattr(message, flag):
                return None
            guarded += [getattr(message, name) for name in message.DEFINITION.flags[flag]]
        return make(*guarded)

    doc = f"{meaning}; None unless {' and '.join(flags)}."
    return cast("_T | None", property(value, doc=doc))


Timestamp = Annotated[int, field_type("uint64")]
"""Type of `timestamp`, the only required field."""
Bool = Annotated[bool, field_type("bool"), Field(default=False)]
Int8 = Annotated[int, field_type("int8"), Field(default=0)]
Int32 = Annotated[int, field_type("int32"), Field(default=0)]
Int64 = Annotated[int, field_type("int64"), Field(default=0)]
Uint8 = Annotated[int, field_type("uint8"), Field(default=0)]
Uint16 = Annotated[int, field_type("uint16"), Field(default=0)]
Uint32 = Annotated[int, field_type("uint32"), Field(default=0)]
Uint64 = Annotated[int, field_type("uint64"), Field(default=0)]
Char127 = Annotated[str, field_type("char[127]"), Field(default="")]
Float64 = Annotated[float, field_type("float64"), Field(default=NAN)]
Float32 = Annotated[float, field_type("float32"), Field(default=NAN)]
Float32x2 = Annotated[tuple[float, float], field_type("float32[2]"), Field(default=(NAN,) * 2)]
Float32x3 = Annotated[
    tuple[float, float, float], field_type("float32[3]"), Field(default=(NAN,) * 3)
]
Float32x4 = Annotated[
    tuple[float, float, float, float], field_type("float32[4]"), Field(default=(NAN,) * 4)
]
Float32x14 = Annotated[tuple[float, ...], field_type("float32[14]"), Field(default=(NAN,) * 14)]
