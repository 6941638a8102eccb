"""Parser of MAVLink bytes: the messages of autopilots, and a decoder that skips what nedbus does not use."""

import struct
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus.samples import Rejection

from .fields import DECODED
from .log_reassembly import Chunk
from .senders import ignore_reason

_SIGNATURE: Final = 13  # bytes
_HEADER: Final = 10  # bytes
_LOG_HEADER: Final = struct.Struct("<H4B")  # the fields before the data
_LOG_DATA: Final[Mapping[int, str]] = {
    number: each.msgname for number, each in dialect.mavlink_map.items() if each.msgname.startswith("LOGGING_DATA")
}
_CHECKED: Final = {  # by number of each message whose payload is not parsed: what its checksum adds
    number: bytes([each.crc_extra])
    for number, each in dialect.mavlink_map.items()
    if each.msgname not in DECODED or number in _LOG_DATA
}


class Received(NamedTuple):
    """A message of an autopilot. `time`: arrival, monotonic [s]; `lost`: messages lost before it; `chunk`: ULog data.

    `sequence`: MAVLink's. A late message, which was counted as lost, has `lost` -1.
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

    def continues(self, before: "Received") -> bool:
        """Return whether this message has ULog data that directly follows the data of an earlier one.

        Acknowledged data is never joined, because it may wait longer.
        """
        one, two = before.chunk, self.chunk
        if one is None or two is None or two.begins or two.lost or self.lost or self.peer != before.peer:
            return False
        if not one.verdict == two.verdict == "delivered":
            return False
        kinds = before.message.get_type(), self.message.get_type()
        return kinds == ("LOGGING_DATA", "LOGGING_DATA")


def parse(parser: Any, data: bytes, name: str, peer: Any, now: float) -> Iterator[Received | Rejection]:
    """Yield the messages of autopilots in bytes that `peer` sent; `now`: time of arrival."""
    for message in parser.parse_buffer(data) or []:
        kind, raw = message.get_type(), message.get_msgbuf()
        if kind == "BAD_DATA":
            yield Rejection(name, f"data that is not MAVLink ({len(raw)} B)")
            continue
        # Only the header of a message can be parsed if the dialect lacks its definition.
        sequence, system, component = raw[4:7] if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[2:5]
        reason = ignore_reason(system, component)
        if not reason:
            yield Received(message, system, sequence, peer, now)
        elif not ((system and component) or kind.startswith("UNKNOWN")):  # cameras etc. are normal
            yield Rejection(f"{name} system {system} component {component}", reason)


class _LogData:
    """LOGGING_DATA or LOGGING_DATA_ACKED in a MAVLink 2 frame."""

    def __init__(self, number: int, frame: bytes, end: int) -> None:
        self._number, self._frame = number, frame
        payload = frame[_HEADER:end].ljust(_LOG_HEADER.size, b"\0")  # zeros are not sent
        fields = _LOG_HEADER.unpack_from(payload)
        self.sequence, self.target_system, self.target_component, self.length, self.first_message_offset = fields
        self.data = payload[_LOG_HEADER.size :]

    def get_type(self) -> str:
        """Return the name of the message, as pymavlink does."""
        return _LOG_DATA[self._number]

    def get_msgId(self) -> int:  # noqa: N802 - pymavlink's name
        """Return the number of the message, as pymavlink does."""
        return self._number

    def get_msgbuf(self) -> bytes:
        """Return the frame, as pymavlink does."""
        return self._frame


class _Parser(dialect.MAVLink):  # type: ignore[misc] # pymavlink has no types
    """Decode only the messages that nedbus uses; of others, only the header, as if the dialect lacked them.

    Pymavlink takes 20 us for ULog data, and reads each datagram twice; here that takes a fifth of the time.
    """

    def parse_buffer(self, data: bytes) -> Any:
        """Return the messages that these bytes complete, None without any."""
        size = len(data) - _HEADER - 2
        if size < 0 or data[:3] != bytes([dialect.PROTOCOL_MARKER_V2, size % 256, 0]) or size > 255 or self.buf_len():
            return super().parse_buffer(data)
        try:
            return [self.decode(data)]
        except dialect.MAVError as exc:
            return [dialect.MAVLink_bad_data(data, exc.message)]

    def decode(self, msgbuf: bytes | bytearray) -> Any:
        """Return a message; raise MAVError if it is damaged."""
        is_v2 = msgbuf[0] == dialect.PROTOCOL_MARKER_V2
        number = int.from_bytes(msgbuf[7:10], "little") if is_v2 else msgbuf[5]
        if (extra := _CHECKED.get(number)) is None:
            return super().decode(bytearray(msgbuf))
        end = len(msgbuf) - 2 - _SIGNATURE * (is_v2 and bool(msgbuf[2] & dialect.MAVLINK_IFLAG_SIGNED))
        if dialect.x25crc(msgbuf[1:end] + extra).crc != int.from_bytes(msgbuf[end : end + 2], "little"):
            raise dialect.MAVError("invalid CRC")
        if number in _LOG_DATA:
            return _LogData(number, bytes(msgbuf), end)
        return dialect.MAVLink_unknown(number, msgbuf)


def new_parser() -> Any:
    """Return a parser that reports bytes that are not MAVLink as BAD_DATA."""
    parser = _Parser(None)
    parser.robust_parsing = True
    return parser
