"""ULog records, named as in the specification, their readers, and the streams of logged messages."""

import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple

from nedbus import limits
from nedbus_msgs import BASES, BY_TOPIC, TOPICS, Address, Encoded, FieldType, define, record_encoder

from .layout import BASIC_TYPES, FIELD, PayloadLayout

SYNC: Final = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"

_FORMAT = re.compile(rf"([A-Za-z][\w/-]*):((?:{FIELD.pattern})*)", re.ASCII)
_NAME = re.compile(r"[A-Za-z][\w/-]{0,254}", re.ASCII)
_KEY = re.compile(rb"(\w+)(\[\d{1,5}\])? (\S[^\0]*)")

Value = int | float | bool | str | bytes
"""Value of an information message or parameter; arrays of numbers and values of unknown types are bytes."""


class UlogError(ValueError):
    """Raised for data that is not a ULog, or a ULog with unknown incompatible flags."""


class Header(NamedTuple):
    """File header; `timestamp`: start of logging [us]."""

    version: int
    timestamp: int


class Format(NamedTuple):
    """Format definition; `fields`: `uint64_t timestamp;float[3] xyz;`."""

    name: str
    fields: str


class Information(NamedTuple):
    """Information, multi information or default parameter; `continued`: continues the previous value of this key."""

    key: str
    value: Value
    continued: bool = False


class Parameter(NamedTuple):
    """Parameter: an initial value or, after the first subscription, a changed value."""

    key: str
    value: Value


@dataclass(frozen=True, eq=False, slots=True)
class Subscription:
    """Subscription to one instance of a topic; nested fields are flattened, `esc[0].rpm` to `esc_0_rpm`.

    After an unsubscription, the next one to the same topic and instance continues it, even if `message_id` differs.
    """

    message_id: int
    multi_id: int
    name: str
    layout: PayloadLayout


class Unsubscription(NamedTuple):
    """The end of a subscription."""

    message_id: int


class Data(NamedTuple):
    """Logged data message; `payload` has exactly the size of the layout."""

    subscription: Subscription
    payload: bytes


class LoggedText(NamedTuple):
    """Logged string; `level`: 0 (emergency) to 7 (debug); `tag`: source of a tagged string."""

    level: int
    timestamp: int
    text: str
    tag: int | None = None


class Sync(NamedTuple):
    """Synchronization message, logged twice a second."""


class Dropout(NamedTuple):
    """Period in which the logger lost messages; `duration`: in ms."""

    duration: int


class Damage(NamedTuple):
    """Unusable bytes; `is_end`: the log ends inside a record, as after a power loss."""

    reason: str
    is_end: bool = False


_Definition = Format | Information | Parameter
_Logged = Subscription | Unsubscription | Data | LoggedText | Sync | Dropout
Record = Header | _Definition | _Logged | Damage


def read_header(data: bytes) -> Header:
    """Parse the 16-byte file header; raise UlogError for other data."""
    if len(data) < 16 or not data.startswith(b"ULog\x01\x12\x35"):
        raise UlogError(
            "it does not begin with ULog's magic bytes; check that it is a complete PX4 log"
        )
    return Header(data[7], int.from_bytes(data[8:16], "little"))


def read_flags(content: bytes) -> tuple[int, ...]:
    """Return the offsets of appended data; raise UlogError for an unknown incompatible flag, as the format requires."""
    incompatible, *offsets = struct.unpack_from("<8xQ3Q", content.ljust(40, b"\0"))
    if incompatible & ~1:
        raise UlogError(f"it has the unknown incompatible flags {incompatible:#x}; update nedbus")
    if not incompatible:
        return ()
    return tuple(offsets)


def _format(content: bytes) -> Format:
    definition = _FORMAT.fullmatch(content.decode("ascii"))
    if not definition:
        raise ValueError
    return Format(definition[1], definition[2])


def _key_and_value(content: bytes) -> tuple[str, Value]:
    end = 1 + content[0]
    declaration = _KEY.fullmatch(content[1:end])
    value = content[end:]
    if not declaration:
        raise ValueError
    c_type, length, name = declaration.groups()
    key = name.decode()
    kind = BASIC_TYPES.get(c_type.decode())
    if kind is not None and not length:
        (number,) = struct.unpack_from("<" + BASES[kind.base].code, value)
        return key, number
    # PX4 does not always log the length that it declares
    if c_type == b"char":
        return key, value.decode(errors="replace")
    return key, value


def _information(content: bytes) -> Information:
    key, value = _key_and_value(content)
    return Information(key, value)


def _multi_information(content: bytes) -> Information:
    key, value = _key_and_value(content[1:])
    return Information(key, value, continued=bool(content[0]))


def _default_parameter(content: bytes) -> Information:
    return _information(content[1:])  # without the types of the default


def _parameter(content: bytes) -> Parameter:
    key, value = _key_and_value(content)
    return Parameter(key, value)


def _text(content: bytes, tag: int | None = None) -> LoggedText:
    level, timestamp = struct.unpack_from("<BQ", content)
    if not 0x30 <= level <= 0x37 or len(content) > limits.ULOG_TEXT:
        raise ValueError
    text = content[9:].decode(errors="replace")
    return LoggedText(level - 0x30, timestamp, text, tag)


def _tagged_text(content: bytes) -> LoggedText:
    (tag,) = struct.unpack_from("<H", content, 1)
    return _text(content[:1] + content[3:], tag)


def _dropout(content: bytes) -> Dropout:
    (duration,) = struct.unpack_from("<H", content)
    return Dropout(duration)


def _unsubscription(content: bytes) -> Unsubscription:
    (message_id,) = struct.unpack_from("<H", content)
    return Unsubscription(message_id)


def _subscription(content: bytes) -> Subscription:
    multi_id, message_id = struct.unpack_from("<BH", content)
    name = content[3:].decode("ascii")
    if not _NAME.fullmatch(name):
        raise ValueError
    # resolved by the parser
    return Subscription(message_id, multi_id, name, PayloadLayout((), 0, 0))


def _sync(content: bytes) -> Sync:
    if not content.startswith(SYNC):
        raise ValueError
    return Sync()


READERS: Final[Mapping[int, Callable[[bytes], Record]]] = {
    ord("A"): _subscription,
    ord("C"): _tagged_text,
    ord("F"): _format,
    ord("I"): _information,
    ord("L"): _text,
    ord("M"): _multi_information,
    ord("O"): _dropout,
    ord("P"): _parameter,
    ord("Q"): _default_parameter,
    ord("R"): _unsubscription,
    ord("S"): _sync,
}
"""Reader of each record type except data; raises ValueError, LookupError or struct.error.

A subscription is returned without its layout.
"""
EXACT_SIZES: Final[Mapping[int, int]] = {ord("O"): 2, ord("R"): 2, ord("S"): len(SYNC)}
"""Sizes of fixed-size records; a longer record is read, but not considered valid."""


class LoggedStream:
    """Address, message definition and decoder of one subscription.

    The definition is nedbus's own, or else made from the log's format. For a topic without a definition in nedbus, the
    first instance has no instance number: a stream does not announce whether more instances will follow.

    Raises ValueError for a format that cannot be a message, AddressError for an invalid vehicle or topic.
    """

    def __init__(self, vehicle: str, subscription: Subscription) -> None:
        topic = subscription.name
        fields = subscription.layout.fields
        self.subscription = subscription
        self.names = tuple(field.name for field in fields)  # names in the log
        self.definition = BY_TOPIC.get(topic) or _define(
            "".join(part.capitalize() for part in topic.split("_")),
            tuple((field.name, field.kind) for field in fields),
        )
        has_number = TOPICS[topic].instances if topic in TOPICS else subscription.multi_id > 0
        self.address = Address(vehicle, topic, subscription.multi_id if has_number else None)
        self.converted: dict[str, FieldType] = {}
        """Target type of each field whose logged type differs, such as an int32 of PX4 1.9 that is now a uint8."""
        self.timestamp: Callable[[bytes], tuple[int | None]] = self._decode_timestamp
        """Return the timestamp of a message [us], or None if it has none, in a tuple."""
        for name, kind, offset in fields:
            known = self.definition.known_types.get(name, {kind})
            if kind not in known:
                self.converted[name] = self.definition.types.get(name) or next(iter(known))
            elif name == "timestamp":
                self.timestamp = struct.Struct(f"<{offset}xQ").unpack_from
        self.lacking: frozenset[str] = frozenset()
        self.strict_bools: frozenset[str] = frozenset()
        self.head = b""
        self.omitted: dict[str, str] = {}
        """Warnings for fields left out because a value does not fit the target type, by field name."""

    @cached_property
    def encode_valid(self) -> Callable[[bytes], Encoded | None]:
        """A function that validates and encodes a message; it returns None for an invalid one."""
        layout = self.subscription.layout
        types = {name: kind for name, kind, _ in layout.fields}
        return record_encoder(self.definition, types, layout.unpack)

    @property
    def dtype(self) -> Any:
        """Argument for `numpy.dtype` that describes a payload."""
        return self.subscription.layout.dtype

    def _decode_timestamp(self, payload: bytes) -> tuple[int | None]:
        return (self.decode(payload).get("timestamp"),)

    def check(self, _: bytes) -> None:
        """Return None: the parser has checked the size of each message."""

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Decode a message; leave out fields whose value does not fit their target type."""
        fields = self.subscription.layout.decode(payload)
        for name, kind in self.converted.items():
            value = fields.pop(name)
            fitted = kind.fit(value)
            if fitted is not None:
                fields[name] = fitted
            elif name not in self.omitted:
                where = f"{self.subscription.name}.{name} is left out where its value does not fit {kind}"
                self.omitted[name] = f"{where}, such as {value!r:.60}"
        return fields


# shared by all instances and logs, because codecs are cached per definition
_define = lru_cache(256)(define)
