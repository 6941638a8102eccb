"""Parser of MAVLink bytes: the messages of autopilots, whose fields are decoded when they are read."""

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus.samples import Rejection

from .fields import DECODED, HIGH_LATENCY
from .log_reassembly import Chunk
from .senders import Senders

_V1: Final[int] = dialect.PROTOCOL_MARKER_V1
_V2: Final[int] = dialect.PROTOCOL_MARKER_V2
_SIGNED: Final[int] = dialect.MAVLINK_IFLAG_SIGNED
_SIGNATURE: Final = 13  # bytes
_CHECKSUM: Final = 2  # bytes
_HEADER: Final = 10  # bytes, of MAVLink 2
_OLD_HEADER: Final = 6  # bytes, of MAVLink 1
_LONGEST_PAYLOAD: Final = 255  # bytes
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
        chunk = self.chunk
        earlier = before.chunk
        if chunk is None or earlier is None or self.peer != before.peer:
            return False
        if chunk.begins or chunk.lost or self.lost:
            return False
        if not chunk.verdict == earlier.verdict == "delivered":
            return False
        kinds = {before.message.get_type(), self.message.get_type()}
        return kinds == {"LOGGING_DATA"}


def parse(
    parser: Any, data: bytes, name: str, peer: Any, now: float
) -> Iterator[Received | Rejection]:
    """Yield the messages of autopilots in bytes that `peer` sent; `now`: time of arrival.

    The sender is looked at before the checksum: a damaged message of an ignored component is ignored, too.
    """
    senders: Senders = parser.senders
    for message in parser.parse_buffer(data) or ():
        raw = message.get_msgbuf()
        kind = message.get_type()
        if kind == "BAD_DATA":
            if not (_is_frame(raw) and senders.ignores(*_ids(raw))):
                yield Rejection(name, f"data that is not MAVLink ({len(raw)} B)")
            continue
        system, component = _ids(raw)
        reason = senders.ignore_reason(message, system, component)
        if not reason:
            sequence = raw[4] if raw[0] == _V2 else raw[2]
            yield Received(message, system, sequence, peer, now)
            continue
        # Other components, such as cameras, are normal, and so are messages that the dialect lacks.
        is_normal = (system and component) or kind.startswith("UNKNOWN")
        if not is_normal:
            yield Rejection(f"{name} system {system} component {component}", reason)


def _ids(frame: bytes) -> tuple[int, int]:
    """Return system and component id of a frame."""
    if frame[0] == _V2:
        return frame[5], frame[6]
    return frame[3], frame[4]


def _is_frame(data: bytes) -> bool:
    """Return whether these bytes are as long as the frame that they begin with."""
    if len(data) < _OLD_HEADER + _CHECKSUM:
        return False
    length = data[1] + _CHECKSUM
    if data[0] == _V1:
        return len(data) == _OLD_HEADER + length
    if data[0] != _V2:
        return False
    if data[2] & _SIGNED:
        length += _SIGNATURE
    return len(data) == _HEADER + length


class _Field(NamedTuple):
    """How to read a field: `unpack`: from a complete payload; the first value, unless it is an array."""

    unpack: Callable[[bytes], tuple[Any, ...]]
    is_array: bool = False


class _Layout(NamedTuple):
    """What the dialect says about a message. `extra`: what its checksum adds; `size`: of the payload [bytes]."""

    name: str
    extra: bytes
    instance_field: str | None
    size: int
    fields: Mapping[str, _Field]


def _layout_of(message: Any) -> _Layout:
    """Return the layout of a message; without fields, as if the dialect lacked it, if nedbus does not use it."""
    name = message.msgname
    extra = bytes([message.crc_extra])
    # Pymavlink would raise an AttributeError for absent times, which takes longer than to read present ones.
    fields = {"time_boot_ms": _Field(lambda _: (None,)), "time_usec": _Field(lambda _: (0,))}
    if name not in DECODED:
        return _Layout(f"UNKNOWN_{message.id}", extra, None, 0, fields)
    offset = 0
    codes = message.native_format.decode()[1:]
    lengths = message.array_lengths
    for field, code, length in zip(message.ordered_fieldnames, codes, lengths, strict=True):
        if code == "c":
            reader = struct.Struct(f"<{offset}x{length}s")
            # pymavlink's name of the bytes of a text
            fields[f"_{field}_raw"] = _Field(reader.unpack_from)
        else:
            reader = struct.Struct(f"<{offset}x{length or 1}{code}")
            fields[field] = _Field(reader.unpack_from, is_array=length > 0)
        offset = reader.size
    if name == HIGH_LATENCY:
        fields["time_boot_ms"] = fields["timestamp"]
    return _Layout(name, extra, message.instance_field, offset, fields)


_LAYOUTS: Final[Mapping[int, _Layout]] = {
    number: _layout_of(message) for number, message in dialect.mavlink_map.items()
}
_LOG_DATA: Final = {
    number for number, layout in _LAYOUTS.items() if layout.name.startswith("LOGGING_DATA")
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
        field = self._layout.fields.get(name)
        if field is None:
            raise AttributeError(name)
        values = field.unpack(self._payload)
        if field.is_array:
            return [*values]
        return values[0]

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
        return _ids(self._frame)[0]

    def get_srcComponent(self) -> int:  # noqa: N802 - pymavlink's name
        """Return the component id of the sender."""
        return _ids(self._frame)[1]


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
        super().__init__(number, layout, frame, b"")
        payload = payload.ljust(_LOG_HEADER.size, b"\0")  # zeros are not sent
        (
            self.sequence,
            self.target_system,
            self.target_component,
            self.length,
            self.first_message_offset,
        ) = _LOG_HEADER.unpack_from(payload)
        self.data = payload[_LOG_HEADER.size :]


class _Parser(dialect.MAVLink):  # type: ignore[misc] # pymavlink has no types
    """Check the frames of messages without decoding them; read a datagram with one message at once."""

    def parse_buffer(self, data: bytes) -> Any:
        """Return the messages that these bytes complete, None without any."""
        if self.buf_len() or not _is_unsigned_frame(data):
            return super().parse_buffer(data)
        try:
            return (self.decode(data),)
        except dialect.MAVError as exc:
            return (dialect.MAVLink_bad_data(data, exc.message),)

    def decode(self, msgbuf: bytes | bytearray) -> Any:
        """Return a message; raise MAVError if it is damaged."""
        header = _OLD_HEADER
        number = msgbuf[5]
        end = len(msgbuf) - _CHECKSUM
        if msgbuf[0] == _V2:
            header = _HEADER
            number = int.from_bytes(msgbuf[7:10], "little")
            if msgbuf[2] & _SIGNED:
                end -= _SIGNATURE
        layout = _LAYOUTS.get(number)
        if layout is None:
            return super().decode(bytearray(msgbuf))
        checksum = int.from_bytes(msgbuf[end : end + _CHECKSUM], "little")
        if checksum != dialect.x25crc(msgbuf[1:end] + layout.extra).crc:
            raise dialect.MAVError("invalid CRC")
        kind = _LogData if number in _LOG_DATA else _Frame
        return kind(number, layout, bytes(msgbuf), bytes(msgbuf[header:end]))


def _is_unsigned_frame(data: bytes) -> bool:
    """Return whether these bytes are one frame of MAVLink 2 without a signature, as in most datagrams."""
    size = len(data) - _HEADER - _CHECKSUM
    return 0 <= size <= _LONGEST_PAYLOAD and data[:3] == bytes((_V2, size, 0))


def new_parser(senders: Senders | None = None) -> Any:
    """Return a parser that reports bytes that are not MAVLink as BAD_DATA.

    `senders`: those on the link so far; None for a new link or file.
    """
    parser = _Parser(None)
    parser.robust_parsing = True
    parser.senders = senders or Senders()
    return parser
