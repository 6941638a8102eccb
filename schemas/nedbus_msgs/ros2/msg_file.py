"""Parser for PX4's .msg files: fields with types, units, ranges and meanings; errors have line and column."""

import math
import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from typing import Final, NamedTuple

from nedbus_msgs import limits
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
    fields: list[MsgField] = []
    for field in _flatten(_parts(text), "", "", 0):
        if len(fields) == limits.MSG_FIELDS:
            reason = f"more than {limits.MSG_FIELDS} fields, including those of nested messages"
            raise MsgError(1, 1, reason)
        fields.append(field)
    return fields


@lru_cache(256)  # a cached definition keeps its codecs
def define_msg(name: str, text: str) -> Definition[Message]:
    """Define a message from a .msg file, with its `@range` annotations as rules; raise MsgError if it is invalid."""
    fields = read_msg(text)
    rules: list[InRange] = []
    for field in fields:
        try:
            check_field_name(field.name)
            rule = _range_of(field)
        except ValueError as exc:
            raise MsgError(field.line, field.column, str(exc)) from None
        if rule is not None:
            rules.append(rule)
    types = [(field.name, field.type) for field in fields]
    meanings = {field.name: field.comment for field in fields if field.comment}
    try:
        return define(name, types, meanings=meanings, rules=rules)
    except ValueError as exc:
        raise MsgError(1, 1, str(exc)) from None


def hash_of_msg(name: str, text: str, *, literal_char: bool = False) -> str:
    """Return the RIHS01 hash of the type in a .msg file, with nested messages; raise MsgError if it is malformed."""
    messages = _parts(text)
    types: list[tuple[str, list[Mapping[str, object]]]] = []
    nested = sorted(_bases_of(messages) & messages.keys())
    for message in ["", *nested]:
        fields = [_describe(line, messages, literal_char) for line in messages[message].values()]
        types.append((f"{PACKAGE}/{message or name}", fields))
    return type_hash(*types)


def bases_of_msg(text: str) -> set[str]:
    """Return the names of all field types in a .msg file, both base types and nested messages."""
    return _bases_of(_parts(text))


class _Line(NamedTuple):
    """A field as written in the file; `base`: its type without package and array length, such as `[3]`."""

    number: int
    column: int
    base: str
    length: str
    name: str
    comment: str

    @property
    def elements(self) -> int | None:
        """Number of nested messages in an array, 0 if it is no array; None for a length that is no number."""
        if not self.length:
            return 0
        length = _LENGTH.fullmatch(self.length)
        if length:
            return int(length[1])
        return None


_Parts = Mapping[str, Mapping[str, _Line]]


def _bases_of(parts: _Parts) -> set[str]:
    bases: set[str] = set()
    for lines in parts.values():
        bases.update(line.base for line in lines.values())
    return bases


def _parts(text: str) -> _Parts:
    """Return the fields of the message by name under "", and those of nested messages under their names."""
    if len(text) > limits.MSG_FILE:
        reason = f"{len(text)} characters, more than the limit of {limits.MSG_FILE}"
        raise MsgError(1, 1, reason)
    current: dict[str, _Line] = {}
    parts = {"": current}
    for number, text_line in enumerate(_LINE_END.split(text.removeprefix("\ufeff")), 1):
        stripped = text_line.strip()
        if text_line.startswith("MSG: "):
            nested_name = text_line.rpartition("/")[2].strip()
            current = parts.setdefault(nested_name, {})
            continue
        if not stripped or stripped.startswith("#") or text_line.startswith("==="):
            continue
        column = len(text_line) - len(text_line.lstrip()) + 1
        declaration = _FIELD.fullmatch(stripped)
        if declaration is None:
            expected = "expected a field, such as 'float32[4] q  # comment', or a constant"
            raise MsgError(number, column, expected)
        name = declaration["name"]
        if name in current:
            column += declaration.start("name")
            raise MsgError(number, column, f"duplicate field {name!r}")
        without_package = declaration["type"].rpartition("/")[2]
        base, bracket, length = without_package.partition("[")
        if not declaration["equals"]:
            comment = (declaration["comment"] or "").lstrip("# ")
            comment = comment[: limits.MSG_COMMENT].strip()
            current[name] = _Line(number, column, base, bracket + length, name, comment)
        elif base not in BASES and base not in ALIASES and not declaration["text"]:
            raise MsgError(number, column, f"unsupported constant type {base!r}")
    return parts


def _flatten(parts: _Parts, message: str, prefix: str, level: int) -> Iterator[MsgField]:
    for line in parts[message].values():
        name = prefix + line.name
        is_nested = bool(parts.get(line.base)) and level < limits.MSG_NESTING
        if not is_nested or line.elements is None:
            yield MsgField(name, _type_of(line), line.comment, line.number, line.column)
            continue
        prefixes = [f"{name}_{index}_" for index in range(line.elements)] or [f"{name}_"]
        for nested_prefix in prefixes:
            yield from _flatten(parts, line.base, nested_prefix, level + 1)


def _describe(line: _Line, parts: Mapping[str, object], literal_char: bool) -> Mapping[str, object]:
    elements = line.elements
    if line.base in parts and elements is not None:
        return describe_field(line.name, NESTED, elements, f"{PACKAGE}/{line.base}")
    elements = _type_of(line).length or 0
    return describe_field(line.name, TYPE_IDS[literal_char][line.base], elements)


def _type_of(line: _Line) -> FieldType:
    try:
        return field_type(line.base + line.length)
    except ValueError as exc:
        raise MsgError(line.number, line.column, str(exc)) from None


def _range_of(field: MsgField) -> InRange | None:
    annotation = _RANGE.search(field.comment)
    if annotation is None:
        return None
    if not annotation["comma"]:
        raise ValueError(
            f"malformed @range of {field.name}; expected limits, such as [@range 0, 100]"
        )
    if field.type.base == "bool" or field.type.is_text:
        return None
    least = float(annotation[2] or "-inf")
    greatest = float(annotation[4] or "inf")
    is_empty = least > greatest
    if not field.type.is_float:
        lowest, highest = field.type.limits
        first = max(least, lowest)
        last = min(greatest, highest)
        is_empty = first > last or math.ceil(first) > last
    if is_empty:
        raise ValueError(
            f"no number is in the @range of {field.name}, from {least:.9g} to {greatest:.9g}"
        )
    invalid = _INVALID.search(field.comment)
    or_ = None
    if invalid:
        or_ = float(invalid[1])
    return InRange(field.name, least, greatest, or_=or_, is_array=field.type.is_array)
