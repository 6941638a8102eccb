"""Parser of MAVLink bytes: the messages of autopilots, whose fields are decoded when they are read."""

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus.samples import Rejection

from .fields import DECODED, HIGH_LATENCY
from .log_reassembly import Chunk
from .senders import Senders

_SIGNATURE: Final = 13  # bytes
_CHECKSUM: Final = 2  # bytes
_HEADER, _OLD_HEADER = 10, 6  # bytes, of MAVLink 2 and 1
_LOG_HEADER: Final = struct.Struct("<H4B")  # the fields of ULog data before the data


class Received(NamedTuple):
    """A message of an autopilot. `time`: arrival, monotonic [s]; `lost`: messages lost before it; `chunk`: ULog data.

    `sequence`: MAVLink's. A late message, which was counted as lost, has `lost` -1.
    `link`: number of the link of its sender, from 0, or `REPEATED`, by the sequence.
    `parts`: number of messages whose ULog data was joined.
    """

    message: Any
    system: int
    sequence: int
    peer: Any
    time: float
    lost: int = 0
    chunk: Chunk | None = None
    parts: int = 1
    link: int = 0

    def continues(self, before: "Received") -> bool:
        """Return whether this message has ULog data that directly follows the data of an earlier one.

        Acknowledged data is never joined, because it may wait longer.
        """
        one, two = before.chunk, self.chunk
        if (
            one is None
            or two is None
            or two.begins
            or two.lost
            or self.lost
            or self.peer != before.peer
        ):
            return False
        if not one.verdict == two.verdict == "delivered":
            return False
        kinds = before.message.get_type(), self.message.get_type()
        return kinds == ("LOGGING_DATA", "LOGGING_DATA")


def parse(
    parser: Any, data: bytes, name: str, peer: Any, now: float
) -> Iterator[Received | Rejection]:
    """Yield the messages of autopilots in bytes that `peer` sent; `now`: time of arrival.

    The sender is looked at before the checksum: a damaged message of an ignored component is ignored, too.
    """
    senders: Senders = parser.senders
    for message in parser.parse_buffer(data) or ():
        kind, raw = message.get_type(), message.get_msgbuf()
        if kind == "BAD_DATA":
            if not (_is_frame(raw) and senders.ignores(*_ids(raw))):
                yield Rejection(name, f"data that is not MAVLink ({len(raw)} B)")
            continue
        # Only the header of a message can be parsed if the dialect lacks its definition.
        system, component = _ids(raw)
        if not (reason := senders.ignore_reason(message, system, component)):
            sequence = raw[4] if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[2]
            yield Received(message, system, sequence, peer, now)
        elif not ((system and component) or kind.startswith("UNKNOWN")):  # cameras etc. are normal
            yield Rejection(f"{name} system {system} component {component}", reason)


def _ids(frame: bytes) -> tuple[int, int]:
    """Return system and component id of a frame."""
    start = 5 if frame[0] == dialect.PROTOCOL_MARKER_V2 else 3
    return frame[start], frame[start + 1]


def _is_frame(data: bytes) -> bool:
    """Return whether these bytes are as long as the frame that they begin with."""
    if len(data) < _OLD_HEADER + 2:
        return False
    if data[0] == dialect.PROTOCOL_MARKER_V2:
        signature = _SIGNATURE if data[2] & dialect.MAVLINK_IFLAG_SIGNED else 0
        return len(data) == _HEADER + data[1] + 2 + signature
    return data[0] == dialect.PROTOCOL_MARKER_V1 and len(data) == _OLD_HEADER + data[1] + 2


class _Layout(NamedTuple):
    """What the dialect says about a message. `extra`: what its checksum adds; `size`: of the payload.

    `fields`: the function that unpacks each field from a complete payload, and whether it is an array.
    """

    name: str
    extra: bytes
    instance_field: str | None
    size: int
    fields: Mapping[str, tuple[Callable[[bytes], tuple[Any, ...]], bool]]


def _layout_of(message: Any) -> _Layout:
    """Return the layout of a message; without fields, as if the dialect lacked it, if nedbus does not use it."""
    # Pymavlink would raise an AttributeError for absent times, which takes longer than to read present ones.
    fields: dict[str, Any] = {
        "time_boot_ms": (lambda _: (None,), False),
        "time_usec": (lambda _: (0,), False),
    }
    if message.msgname not in DECODED:
        return _Layout(f"UNKNOWN_{message.id}", bytes([message.crc_extra]), None, 0, fields)
    offset = 0
    for name, code, length in zip(
        message.ordered_fieldnames,
        message.native_format.decode()[1:],
        message.array_lengths,
        strict=True,
    ):
        unpack = struct.Struct(f"<{offset}x{length or 1}{'s' if code == 'c' else code}")
        key = f"_{name}_raw" if code == "c" else name  # pymavlink's name of the bytes of a text
        fields[key] = unpack.unpack_from, bool(length) and code != "c"
        offset = unpack.size
    if message.msgname == HIGH_LATENCY:
        fields["time_boot_ms"] = fields["timestamp"]
    return _Layout(
        message.msgname, bytes([message.crc_extra]), message.instance_field, offset, fields
    )


_LAYOUTS: Final[Mapping[int, _Layout]] = {
    number: _layout_of(each) for number, each in dialect.mavlink_map.items()
}
_LOG_DATA: Final = {
    number for number, each in _LAYOUTS.items() if each.name.startswith("LOGGING_DATA")
}


class _Frame:
    """A message with a valid checksum; each field is decoded when it is read, because few are.

    It has pymavlink's attributes, but `time_boot_ms` is None and `time_usec` 0 in a message without them.
    Pymavlink takes 20 us for ULog data, and 8 us for most other messages.
    """

    __slots__ = ("_frame", "_layout", "_number", "_payload")

    def __init__(self, number: int, layout: _Layout, frame: bytes, payload: bytes) -> None:
        self._number = number
        self._layout = layout
        self._frame = frame
        self._payload = payload.ljust(layout.size, b"\0")  # zeros are not sent

    def __getattr__(self, name: str) -> Any:
        if (found := self._layout.fields.get(name)) is None:
            raise AttributeError(name)
        unpack, is_array = found
        values = unpack(self._payload)
        return [*values] if is_array else values[0]

    @property
    def instance_field(self) -> str | None:
        """The field that numbers several sensors, None without one."""
        return self._layout.instance_field

    def get_type(self) -> str:
        """Return the name of the message."""
        return self._layout.name

    def get_msgId(self) -> int:  # noqa: N802 - pymavlink's name
        """Return the number of the message."""
        return self._number

    def get_msgbuf(self) -> bytes:
        """Return the frame."""
        return self._frame

    def get_srcSystem(self) -> int:  # noqa: N802 - pymavlink's name
        """Return the system id of the sender."""
        return self._frame[5 if self._frame[0] == dialect.PROTOCOL_MARKER_V2 else 3]

    def get_srcComponent(self) -> int:  # noqa: N802 - pymavlink's name
        """Return the component id of the sender."""
        return self._frame[6 if self._frame[0] == dialect.PROTOCOL_MARKER_V2 else 4]


class _LogData(_Frame):
    """LOGGING_DATA or LOGGING_DATA_ACKED, of which all fields are read."""

    __slots__ = (
        "data",
        "first_message_offset",
        "length",
        "sequence",
        "target_component",
        "target_system",
    )

    def __init__(self, number: int, layout: _Layout, frame: bytes, payload: bytes) -> None:
        self._number = number
        self._layout = layout
        self._frame = frame
        payload = payload.ljust(_LOG_HEADER.size, b"\0")  # zeros are not sent
        fields = _LOG_HEADER.unpack_from(payload)
        (
            self.sequence,
            self.target_system,
            self.target_component,
            self.length,
            self.first_message_offset,
        ) = fields
        self.data = payload[_LOG_HEADER.size :]


class _Parser(dialect.MAVLink):  # type: ignore[misc] # pymavlink has no types
    """Check the frames of messages without decoding them; read a datagram with one message at once."""

    def parse_buffer(self, data: bytes) -> Any:
        """Return the messages that these bytes complete, None without any."""
        size = len(data) - _HEADER - 2
        if (
            size < 0
            or data[:3] != bytes([dialect.PROTOCOL_MARKER_V2, size % 256, 0])
            or size > 255
            or self.buf_len()
        ):
            return super().parse_buffer(data)
        try:
            return (self.decode(data),)
        except dialect.MAVError as exc:
            return (dialect.MAVLink_bad_data(data, exc.message),)

    def decode(self, msgbuf: bytes | bytearray) -> Any:
        """Return a message; raise MAVError if it is damaged."""
        is_v2 = msgbuf[0] == dialect.PROTOCOL_MARKER_V2
        number = int.from_bytes(msgbuf[7:10], "little") if is_v2 else msgbuf[5]
        if (layout := _LAYOUTS.get(number)) is None:
            return super().decode(bytearray(msgbuf))
        end = len(msgbuf) - _CHECKSUM
        if is_v2 and msgbuf[2] & dialect.MAVLINK_IFLAG_SIGNED:
            end -= _SIGNATURE
        if dialect.x25crc(msgbuf[1:end] + layout.extra).crc != int.from_bytes(
            msgbuf[end : end + _CHECKSUM], "little"
        ):
            raise dialect.MAVError("invalid CRC")
        kind = _LogData if number in _LOG_DATA else _Frame
        return kind(
            number, layout, bytes(msgbuf), bytes(msgbuf[_HEADER if is_v2 else _OLD_HEADER : end])
        )


def new_parser(senders: Senders | None = None) -> Any:
    """Return a parser that reports bytes that are not MAVLink as BAD_DATA.

    `senders`: those on the link so far; None for a new link or file.
    """
    parser = _Parser(None)
    parser.robust_parsing = True
    parser.senders = senders or Senders()
    return parser
