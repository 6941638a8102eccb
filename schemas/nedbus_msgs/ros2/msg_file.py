"""Parser for PX4's .msg files: fields with types, units, ranges and meanings; errors have line and column."""

import math
import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from itertools import islice
from typing import Final, NamedTuple

from nedbus_msgs.definitions import check_field_name, define
from nedbus_msgs.model.definition import Definition
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import ALIASES, BASES, FieldType, field_type
from nedbus_msgs.model.rules import InRange

from .types import NESTED, PACKAGE, TYPE_IDS, describe_field, type_hash

# Possessive quantifiers: a comment may have 200,000 spaces or digits.
_NUMBER: Final = r"[-+]?(?:(?:\d++\.?\d*+|\.\d++)(?:[eE][-+]?\d++)?|inf)"
_VALUE: Final = (
    rf"(?:{_NUMBER}|[-+]?0[xXbBoO][\da-fA-F]++|nan|[Tt]rue|[Ff]alse|\"[^\"]*+\"|'[^']*+')"
)
_FIELD = re.compile(
    r"(?P<type>(?P<text>w?string(?=\s))|[^\s#=]+)\s+(?P<name>[^\s#=]{1,255})(?:(?:\s*(?P<equals>=)\s*|\s+)"
    rf"(?:{_VALUE}|\[(?:\s*+{_VALUE}\s*+(?:,|(?=\])))*+\s*+\]|(?(text)[^#]*|(?!))))?\s*(?P<comment>#.*)?"
)
"""A field, with or without a default value, or a constant; a string may have no quotes."""
_LINE_END = re.compile(r"\r\n?|\n")  # not U+2028 or form feed, which may occur in a comment
_LENGTH = re.compile(r"\[([1-9]\d{0,2})\]")  # length of an array of nested messages
# such as 1, pi, -1 (Left)
_LIMIT: Final = rf"\s*+(?:({_NUMBER})|[-+]?[A-Za-z]\w*+)?\s*+(?:\([^()]*+\)\s*+)?"
_RANGE = re.compile(rf"(\[)?@range(?![A-Za-z_])(?:\s{_LIMIT}(?P<comma>,){_LIMIT}(?(1)\]))?")
_INVALID = re.compile(rf"@invalid\s++({_NUMBER})")
_MAX_FIELDS: Final = 1000  # including nested ones; the limit of a message is lower
_MAX_NESTING: Final = 3  # levels of nested messages; PX4 has one
_MAX_LENGTH: Final = 2**18  # characters per file; PX4's longest has 20,000
_MAX_COMMENT: Final = 2000  # characters; the rest is cut off


class MsgError(ValueError):
    """Raised for text that is not a valid .msg file; `line` and `column` count from 1."""

    def __init__(self, line: int, column: int, reason: str) -> None:
        super().__init__(f"line {line}, column {column}: {reason}")
        self.line = line
        self.column = column


class MsgField(NamedTuple):
    """One field of a .msg file, with its comment."""

    name: str
    type: FieldType
    comment: str
    line: int
    column: int


def read_msg(text: str) -> list[MsgField]:
    """Return the fields of a .msg file in order, without constants; raise MsgError if it is malformed.

    Nested messages follow as in ROS 2 and MCAP, each after a line of = and a line `MSG: package/Name`. Their fields are
    flattened into the message: `current_lat`, `esc_0_esc_rpm`.
    """
    fields = list(islice(_flatten(_parts(text), "", "", 0), _MAX_FIELDS + 1))
    if len(fields) > _MAX_FIELDS:
        raise MsgError(1, 1, f"more than {_MAX_FIELDS} fields, including those of nested messages")
    return fields


@lru_cache(256)  # a cached definition keeps its codecs
def define_msg(name: str, text: str) -> Definition[Message]:
    """Define a message from a .msg file, with its `@range` annotations as rules; raise MsgError if it is invalid."""
    fields, rules = read_msg(text), []
    for field in fields:
        try:
            check_field_name(field.name)
            rules.append(_range_of(field))
        except ValueError as exc:
            raise MsgError(field.line, field.column, str(exc)) from None
    try:
        types = ((field.name, field.type) for field in fields)
        meanings = {field.name: field.comment for field in fields if field.comment}
        return define(name, types, meanings=meanings, rules=list(filter(None, rules)))
    except ValueError as exc:
        raise MsgError(1, 1, str(exc)) from None


def hash_of_msg(name: str, text: str, *, literal_char: bool = False) -> str:
    """Return the RIHS01 hash of the type in a .msg file, with nested messages; raise MsgError if it is malformed."""
    parts = _parts(text)
    types = {
        part: [_describe(line, parts, literal_char) for line in lines.values()]
        for part, lines in parts.items()
    }
    used = sorted({line.base for lines in parts.values() for line in lines.values()} & parts.keys())
    return type_hash(*((f"{PACKAGE}/{each or name}", types[each]) for each in ["", *used]))


def bases_of_msg(text: str) -> set[str]:
    """Return the names of all field types in a .msg file, both base types and nested messages."""
    return {line.base for lines in _parts(text).values() for line in lines.values()}


class _Line(NamedTuple):
    """A field as written in the file; `base`: its type without the array length."""

    number: int
    column: int
    base: str
    length: str
    name: str
    comment: str


_Parts = Mapping[str, Mapping[str, _Line]]


def _parts(text: str) -> _Parts:
    """Return the fields of the message by name under "", and those of nested messages under their names."""
    if len(text) > _MAX_LENGTH:
        raise MsgError(1, 1, f"{len(text)} characters, more than the limit of {_MAX_LENGTH}")
    current: dict[str, _Line] = {}
    parts = {"": current}
    for number, line in enumerate(_LINE_END.split(text.removeprefix("\ufeff")), 1):
        start = len(line) - len(line.lstrip())
        if line.startswith("MSG: "):
            current = parts.setdefault(line.rpartition("/")[2].strip(), {})
        elif line.strip() and line[start] != "#" and not line.startswith("==="):
            found = _FIELD.fullmatch(line.strip())
            if found is None:
                raise MsgError(
                    number,
                    start + 1,
                    "expected a field, such as 'float32[4] q  # comment', or a constant",
                )
            base, bracket, length = found["type"].rpartition("/")[2].partition("[")
            name, comment = (
                found["name"],
                (found["comment"] or "").lstrip("# ")[:_MAX_COMMENT].strip(),
            )
            if name in current:
                raise MsgError(number, start + 1 + found.start("name"), f"duplicate field {name!r}")
            if not found["equals"]:
                current[name] = _Line(number, start + 1, base, bracket + length, name, comment)
            elif base not in BASES and base not in ALIASES and not found["text"]:
                raise MsgError(number, start + 1, f"unsupported constant type {base!r}")
    return parts


def _flatten(parts: _Parts, message: str, prefix: str, level: int) -> Iterator[MsgField]:
    for line in parts[message].values():
        count = _LENGTH.fullmatch(line.length)
        if parts.get(line.base) and level < _MAX_NESTING and (count or not line.length):
            for index in range(int(count[1])) if count else [None]:
                inner = f"{prefix}{line.name}_"
                if index is not None:
                    inner += f"{index}_"
                yield from _flatten(parts, line.base, inner, level + 1)
            continue
        yield MsgField(prefix + line.name, _type_of(line), line.comment, line.number, line.column)


def _describe(line: _Line, parts: Mapping[str, object], literal_char: bool) -> Mapping[str, object]:
    count = _LENGTH.fullmatch(line.length)
    if line.base in parts and (count or not line.length):
        return describe_field(
            line.name, NESTED, int(count[1]) if count else 0, f"{PACKAGE}/{line.base}"
        )
    length = _type_of(line).length or 0
    return describe_field(line.name, TYPE_IDS[literal_char][line.base], length)


def _type_of(line: _Line) -> FieldType:
    try:
        return field_type(line.base + line.length)
    except ValueError as exc:
        raise MsgError(line.number, line.column, str(exc)) from None


def _range_of(field: MsgField) -> InRange | None:
    found, invalid = _RANGE.search(field.comment), _INVALID.search(field.comment)
    if found and not found["comma"]:
        raise ValueError(
            f"malformed @range of {field.name}; expected limits, such as [@range 0, 100]"
        )
    if found is None or field.type.base == "bool" or field.type.is_text:
        return None
    least = float(found[2] or "-inf")
    greatest = float(found[4] or "inf")
    or_ = float(invalid[1]) if invalid else None
    lowest, highest = (-math.inf, math.inf) if field.type.is_float else field.type.limits
    first, last = max(least, lowest), min(greatest, highest)
    if first > last or (not field.type.is_float and math.ceil(first) > last):
        raise ValueError(
            f"no number is in the @range of {field.name}, from {least:.9g} to {greatest:.9g}"
        )
    return InRange(field.name, least, greatest, or_=or_, is_array=field.type.is_array)
