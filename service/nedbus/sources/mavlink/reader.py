"""Reader of a link: messages of autopilots with their sender."""

import time
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.source import Rejection

from .link import Link, Peer, why_ignored
from .log_reassembly import Piece

_MAX_BUFFER: Final = 2**16  # bytes kept by the parser of a stream


class Received(NamedTuple):
    """A message of an autopilot. `time`: of its arrival, monotonic [s]; `sequence`: of MAVLink; `piece`: its ULog."""

    message: Any
    system: int
    sequence: int
    peer: Peer
    time: float
    piece: Piece | None = None


class LinkReader:
    """Parses what arrives on a link."""

    def __init__(self, link: Link, *, name: str) -> None:
        self._link, self.name = link, name
        self._parser = new_parser()

    def read(self, timeout: float) -> Iterator[Received | Rejection]:
        """Yield the messages of autopilots; wait up to `timeout` seconds for the first. Raises OSError."""
        for data, peer in self._link.read(timeout):
            now = time.monotonic()
            if not self._link.stream or len(self._parser.buf) > _MAX_BUFFER:
                # Half a message in one datagram must not consume the next one, which may have another sender.
                self._parser = new_parser()
            yield from parse(self._parser, data, self.name, peer, now)
            if not self._link.stream and self._parser.buf_len():
                yield Rejection(self.name, f"{self._parser.buf_len()} bytes of a truncated message")


def parse(parser: Any, data: bytes, name: str, peer: Peer, now: float) -> Iterator[Received | Rejection]:
    """Yield the messages of autopilots in these bytes, received from a peer at a time."""
    for message in parser.parse_buffer(data) or []:
        raw = bytes(message.get_msgbuf())
        if message.get_type() == "BAD_DATA":
            yield Rejection(name, f"{len(raw)} bytes that are not MAVLink")
            continue
        # If the dialect does not have the message, only its header can be parsed.
        sequence, system, component = raw[4:7] if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[2:5]
        reason = why_ignored(system, component)
        if not reason:
            yield Received(message, system, sequence, peer, now)
        elif not ((system and component) or message.get_type().startswith("UNKNOWN")):  # cameras are expected
            yield Rejection(f"{name} system {system} component {component}", reason)


def new_parser() -> Any:
    """Return a parser that reports what is not MAVLink as BAD_DATA."""
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser
