"""The records of a ULog, named by its specification, and the readers of their content."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from nedbus_msgs import BASES

from .layout import BASIC_TYPES, PayloadField, PayloadLayout, is_format

SYNC_MAGIC: Final = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"

_MAX_TEXT: Final = 1024  # bytes of a logged text; PX4 logs at most 127
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_/-]{0,254}")
_KEY = re.compile(rb"(\w+)(\[\d{1,5}\])? (\S[^\0]*)")

Value = int | float | bool | str | bytes
"""Value of an information or a parameter: bytes for an array of numbers."""


class UlogError(ValueError):
    """Raised when bytes are not a ULog, or one that a parser must refuse."""


class Header(NamedTuple):
    """The start of a log; `timestamp`: when logging began [us]."""

    version: int
    timestamp: int


class FlagBits(NamedTuple):
    """Flags of a log; `appended`: offsets of data that were appended after logging ended."""

    compat: bytes
    incompat: bytes
    appended: tuple[int, ...]


class Format(NamedTuple):
    """The fields of a message, as text: `uint64_t timestamp;float[3] xyz;`."""

    name: str
    fields: str


class Information(NamedTuple):
    """A fact about the log."""

    key: str
    value: Value


class MultiInformation(NamedTuple):
    """A part of a longer value; `continued`: it belongs to the preceding value of its key."""

    key: str
    value: Value
    continued: bool


class Parameter(NamedTuple):
    """A parameter; after the first subscription, its new value."""

    key: str
    value: Value


class ParameterDefault(NamedTuple):
    """A default of a parameter; `types`: bit 0 for the system's default, bit 1 for that of the airframe."""

    key: str
    value: Value
    types: int


class Subscription(NamedTuple):
    """One instance of a topic whose data follow under a message id."""

    message_id: int
    multi_id: int
    name: str
    layout: PayloadLayout

    @property
    def fields(self) -> tuple[PayloadField, ...]:
        """The fields of its messages, without padding."""
        return self.layout.fields

    @property
    def size(self) -> int:
        """Bytes of a payload."""
        return self.layout.size

    def decode(self, payload: bytes) -> dict[str, object]:
        """Return the fields of a payload of at least `size` bytes: int, float, bool, or tuples of them."""
        return self.layout.decode(payload)


class Unsubscription(NamedTuple):
    """The end of a subscription."""

    message_id: int


class Data(NamedTuple):
    """One message; `payload` has exactly the size of the subscription."""

    subscription: Subscription
    payload: bytes


class LoggedText(NamedTuple):
    """A text that PX4 printed; `level`: 0 (emergency) to 7 (debug); `tag`: its source, if it has one."""

    level: int
    timestamp: int
    text: str
    tag: int | None = None


class Sync(NamedTuple):
    """A mark that is written twice a second, from which a parser can resume after damage."""


class Dropout(NamedTuple):
    """A time in which the logger lost messages; `duration`: in ms."""

    duration: int


class Damage(NamedTuple):
    """Bytes that are not used; `is_end`: the log ends inside a record, as after a loss of power."""

    reason: str
    offset: int
    size: int
    is_end: bool = False


class Added(NamedTuple):
    """The content of a subscription record, before its format is known."""

    multi_id: int
    message_id: int
    name: str


Record = (
    Header | FlagBits | Format | Information | MultiInformation | Parameter | ParameterDefault | Subscription
    | Unsubscription | Data | LoggedText | Sync | Dropout | Damage
)  # fmt: skip
Content = Record | Added


def read_header(data: bytes) -> Header:
    """Read the 16 bytes before the first record; raise UlogError if they are not those of a ULog."""
    if len(data) < 16 or not data.startswith(b"ULog\x01\x12\x35"):
        raise UlogError("it does not begin with the magic bytes of a ULog")
    return Header(data[7], int.from_bytes(data[8:16], "little"))


def read_flags(content: bytes) -> FlagBits:
    """Read flags; raise UlogError for an unknown incompatible one: the specification requires to refuse the log."""
    compat, incompat, *appended = struct.unpack_from("<8s8s3Q", content)
    if incompat[0] & ~1 or any(incompat[1:]):
        raise UlogError(f"it has unknown incompatible flags ({incompat.hex()}): read it with a newer parser")
    return FlagBits(compat, incompat, tuple(filter(None, appended)) if incompat[0] & 1 else ())


def _format(content: bytes) -> Format:
    name, colon, fields = content.decode("ascii").partition(":")
    if not (colon and _NAME.fullmatch(name) and is_format(fields)):
        raise ValueError("no format")
    return Format(name, fields)


def _key_and_value(content: bytes) -> tuple[str, Value]:
    end = 1 + content[0]
    found = _KEY.fullmatch(content[1:end])
    if found is None:
        raise ValueError("no key")
    kind, value, key = BASIC_TYPES[found[1].decode()], content[end:], found[3].decode()
    if found[2]:  # PX4 does not always log the length that it declares
        return key, value.decode(errors="replace") if found[1] == b"char" else value
    return key, struct.unpack_from("<" + BASES[kind.base].code, value)[0]


def _text(content: bytes, offset: int) -> tuple[int, int, str]:
    """Read level, timestamp and text; `offset`: that of the timestamp."""
    level = content[0] - ord("0")
    if not 0 <= level < 8 or len(content) > offset + 8 + _MAX_TEXT:
        raise ValueError("no logged text")
    return level, struct.unpack_from("<Q", content, offset)[0], content[offset + 8 :].decode(errors="replace")


def _tagged_text(content: bytes) -> LoggedText:
    return LoggedText(*_text(content, 3), struct.unpack_from("<H", content, 1)[0])


def _added(content: bytes) -> Added:
    multi_id, message_id = struct.unpack_from("<BH", content)
    name = content[3:].decode("ascii")
    if not _NAME.fullmatch(name):
        raise ValueError("no name")
    return Added(multi_id, message_id, name)


def _sync(content: bytes) -> Sync:
    if not content.startswith(SYNC_MAGIC):
        raise ValueError("no sync")
    return Sync()


READERS: Final[Mapping[int, Callable[[bytes], Content]]] = {
    ord("A"): _added,
    ord("C"): _tagged_text,
    ord("F"): _format,
    ord("I"): lambda content: Information(*_key_and_value(content)),
    ord("L"): lambda content: LoggedText(*_text(content, 1)),
    ord("M"): lambda content: MultiInformation(*_key_and_value(content[1:]), bool(content[0])),
    ord("O"): lambda content: Dropout(struct.unpack_from("<H", content)[0]),
    ord("P"): lambda content: Parameter(*_key_and_value(content)),
    ord("Q"): lambda content: ParameterDefault(*_key_and_value(content[1:]), content[0]),
    ord("R"): lambda content: Unsubscription(struct.unpack_from("<H", content)[0]),
    ord("S"): _sync,
}
"""Reader of each type of record that has content of its own; raises ValueError, LookupError or struct.error."""

EXACT_SIZES: Final[Mapping[int, int]] = {ord("O"): 2, ord("R"): 2, ord("S"): len(SYNC_MAGIC)}
"""Sizes of records whose content alone tells nothing; with others they are read, but not relied on."""
