"""Readers of a link: messages of autopilots with their sender, parsed where the caller waits, or ahead in a thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any, Final, NamedTuple, Protocol

from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.source import Rejection

from .link import Link
from .log_reassembly import Piece
from .senders import Peer, why_ignored

_MAX_BUFFER: Final = 2**16  # bytes kept by the parser of a stream
_MAX_WAITING: Final = 16_384  # messages read ahead; more are lost, as the sequence numbers of both protocols show
_MAX_READ: Final = 100  # messages per call
_TICK: Final = 0.05  # s, the longest wait of the thread
_STOP_TIMEOUT: Final = 0.8  # s for vehicles to confirm the end of their streams


class Received(NamedTuple):
    """A message of an autopilot. `time`: of its arrival, monotonic [s]; `sequence`: of MAVLink; `piece`: its ULog."""

    message: Any
    system: int
    sequence: int
    peer: Peer
    time: float
    piece: Piece | None = None


class Reaction(Protocol):
    """Handler of messages, in the thread that reads them."""

    def take(self, received: Received, *, has_room: bool) -> Received | Rejection:
        """React to a message, and return it or the reason why it is rejected."""
        ...

    def tick(self, now: float) -> None:
        """Do what is due; called 20 times a second."""
        ...

    def stop(self, now: float) -> None:
        """Begin to end; messages are still taken while `is_stopping`."""
        ...

    @property
    def is_stopping(self) -> bool:
        """True until the end."""
        ...


class LinkReader:
    """Parses what arrives on a link."""

    def __init__(self, link: Link, *, name: str) -> None:
        self._link, self._name = link, name
        self._parser = new_parser()

    def read(self, timeout: float) -> Iterator[Received | Rejection]:
        """Yield the messages of autopilots; wait up to `timeout` seconds for the first. Raises OSError."""
        for data, peer in self._link.read(timeout):
            now = time.monotonic()
            if not self._link.stream or len(self._parser.buf) > _MAX_BUFFER:
                # Half a message in one datagram must not consume the next one, which may have another sender.
                self._parser = new_parser()
            yield from parse(self._parser, data, self._name, peer, now)
            if not self._link.stream and self._parser.buf_len():
                yield Rejection(self._name, f"{self._parser.buf_len()} bytes of a truncated message")


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


class ReadAhead:
    """Reads a link in a thread of its own, so that PX4's log stream is acknowledged while publishing waits."""

    def __init__(self, reader: LinkReader, reaction: Reaction) -> None:
        self._reader, self._reaction = reader, reaction
        self._waiting: SimpleQueue[Received | Rejection | Exception] = SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="nedbus-mavlink", daemon=True)
        self._thread.start()

    def read(self, timeout: float) -> Iterator[Received | Rejection]:
        """Yield what was read; wait up to `timeout` seconds for the first. Raises the error that ended the thread."""
        with suppress(Empty):
            for number in range(_MAX_READ):
                item = self._waiting.get_nowait() if number else self._waiting.get(timeout=timeout)
                if isinstance(item, Exception):
                    raise item
                yield item

    def close(self) -> None:
        """End the streams and the thread; wait until the vehicles have confirmed it, or do not answer."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._turn()
            end = time.monotonic() + _STOP_TIMEOUT
            self._reaction.stop(time.monotonic())
            while self._reaction.is_stopping and time.monotonic() < end:
                self._turn()
        except Exception as exc:  # noqa: BLE001 - raised again by `read`, in the thread of the source
            self._waiting.put(exc)

    def _turn(self) -> None:
        for item in self._reader.read(_TICK):
            has_room = self._waiting.qsize() < _MAX_WAITING
            seen = self._reaction.take(item, has_room=has_room) if isinstance(item, Received) else item
            if has_room:
                self._waiting.put(seen)
        self._reaction.tick(time.monotonic())


def new_parser() -> Any:
    """Return a parser that reports what is not MAVLink as BAD_DATA."""
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser
