"""From Zenoh's samples to ours: the address of a key, the message of a payload, the provenance of an encoding."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from nedbus.client.sample import Sample
from nedbus.log_event import about
from nedbus.transport import RawSample
from nedbus_msgs import (
    BY_TOPIC,
    PAYLOAD_LIMIT,
    Address,
    AddressError,
    Codec,
    DecodeError,
    Provenance,
    UnknownLayoutError,
    codec_of,
    message_name_of,
    provenance_of,
)

from .layout_lookup import LayoutLookup

if TYPE_CHECKING:
    from .writer_proxy import WriterProxy

_log = logging.getLogger(__name__)

MAX_KEYS: Final = 10_000  # that a reader remembers; no peer can make it remember more
WAKE_UP: Final = "nedbus/wake-up"  # encoding of what a session sends to itself so that its reader looks again
_MAX_WARNED: Final = 100  # keys whose invalid messages are logged
_MAX_TEXT: Final = 300  # characters of a key, and of a reason, that are logged


@dataclass(slots=True, eq=False)
class KeyState:
    """State of a key: its address, codec and publishers, and the losses to be reported of it.

    `key`: that of the stream at full rate; `heard`: that on which messages come, perhaps downsampled.
    `codec`: that of its messages, None while nothing defines `message`; `size`: bytes of a payload of ours.
    `writers`: its publishers, by name; `writer` is that of the last message.
    `gap`: messages that were lost before the next one that is delivered. `unreported`: those lost before one that was
    dropped or invalid; they are reported with the next sample that is read.
    """

    key: str
    heard: str
    address: Address
    codec: Codec[Any] | None = None
    size: int = -1
    message: str = ""
    last: tuple[zenoh.Encoding | None, Provenance] = None, Provenance()  # in one piece: two threads look and change it
    writers: dict[str, WriterProxy] = field(default_factory=dict)
    writer: WriterProxy | None = None
    gap: int = 0
    unreported: int = 0

    def carry(self, codec: Codec[Any]) -> None:
        """Note the codec of these messages."""
        self.codec, self.size, self.message = codec, codec.size, codec.definition.name


class Kept(NamedTuple):
    """The parts of a sample that waits for long: the sample itself keeps the buffer in which Zenoh received it."""

    timestamp: zenoh.Timestamp | None
    source_info: zenoh.SourceInfo | None
    provenance: Provenance


Arrival = tuple[KeyState, bytes, RawSample | Kept, int]  # the last: number of messages lost before it


class Decoder:
    """Decode what arrives, and count what is invalid; its reason is logged once for each of the first 100 keys."""

    def __init__(self, layouts: LayoutLookup, *, prefix: str) -> None:
        self.invalid = 0
        self._layouts = layouts
        self._prefix = prefix
        self._streams: dict[str, KeyState] = {}
        self._warned: set[int] = set()  # hashes of keys, which may be long
        self._counting = threading.Lock()  # the receiving and the reading thread both reject

    def stream(self, key: str) -> KeyState:
        """Return the state of a key; raise AddressError for one without an address."""
        stream = self._streams.get(key)
        if stream is None:
            from_key = Address.from_rate_key if "/@" in key else Address.from_key  # only with a max_rate
            address = from_key(key, prefix=self._prefix)
            stream = KeyState(address.key(prefix=self._prefix), key, address)
            if address.topic in BY_TOPIC:
                stream.carry(codec_of(BY_TOPIC[address.topic]))
            if len(self._streams) < MAX_KEYS:
                stream = self._streams.setdefault(key, stream)  # another thread may have met it meanwhile
        return stream

    def learn(self, batch: Iterable[RawSample]) -> None:
        """Ask for unknown messages and layouts of these, and wait for the answer: not for a thread that receives."""
        for raw in batch:
            with suppress(AddressError, DecodeError):
                self._inspect(self.stream(str(raw.key_expr)), raw.payload.to_bytes(), raw)
        self._layouts.wait()

    def admit(self, batch: Iterable[RawSample]) -> list[Arrival]:
        """Return arrivals to queue, with no losses so far; rejected ones without a payload, for their number.

        A payload of the size that `encode` writes is decoded when it is read; any other already here, as it must
        neither displace a valid sample nor take up much memory.
        """
        admitted: list[Arrival] = []
        known = self._streams.get
        for raw in batch:
            key = str(raw.key_expr)
            stream = known(key)
            payload = raw.payload.to_bytes()
            if stream is None or len(payload) != stream.size:
                if raw.encoding == WAKE_UP:
                    continue
                try:
                    stream = stream or self.stream(key)
                    if len(payload) != stream.size:
                        self._inspect(stream, payload, raw)
                except (AddressError, DecodeError) as exc:
                    self.reject(key, exc)
                    if stream is None:
                        continue
                    payload = b""
            admitted.append((stream, payload, raw, 0))
        return admitted

    @classmethod
    def keep(cls, arrival: Arrival) -> Arrival:
        """Return an arrival that takes up no more memory than it needs."""
        stream, payload, raw, lost = arrival
        if isinstance(raw, Kept):
            return arrival
        return stream, payload, Kept(raw.timestamp, raw.source_info, cls.provenance(arrival)), lost

    @staticmethod
    def provenance(arrival: Arrival) -> Provenance:
        """Return the provenance of an arrival."""
        stream, _, raw, _ = arrival
        if isinstance(raw, Kept):
            return raw.provenance
        encoding = raw.encoding
        known, provenance = stream.last
        if encoding != known and stream.codec:  # almost always it is the same: comparing is all that it costs
            provenance = provenance_of(stream.codec.definition, str(encoding))
            stream.last = encoding, provenance
        return provenance

    def decode(self, arrival: Arrival, *, rows: bool, lost: int = 0) -> Sample[Any] | None:
        """Return the sample of what arrived, with a Row as its message if `rows`; None if it is invalid."""
        stream, payload, raw, _ = arrival
        if not payload:
            return None
        codec = stream.codec or self.resolve(stream)
        if codec is None:
            self.reject(stream.key, DecodeError("no publisher has described it", stream.message))
            return None
        decode = codec.decode_row if rows else codec.decode
        try:
            try:
                message = decode(payload)
            except UnknownLayoutError:
                message = decode(payload, newer=self._layouts.newer(codec.definition))
        except DecodeError as exc:
            self.reject(stream.key, exc)
            return None
        return Sample(message, stream.address, time.time_ns(), raw.timestamp, lost, self.provenance(arrival))

    def resolve(self, stream: KeyState) -> Codec[Any] | None:
        """Return the codec of a stream whose message has no file here, None if no publisher describes it.

        A script that reads waits for an answer that is on its way, once; a thread that receives does not.
        """
        if stream.codec is None and stream.message:
            for _ in range(2):
                with suppress(DecodeError):
                    stream.carry(codec_of(self._layouts.definition(stream.message)))
                    break
                self._layouts.wait()
        return stream.codec

    def count_invalid(self, count: int) -> None:
        """Count invalid samples."""
        with self._counting:
            self.invalid += count

    def reject(self, key: str, error: Exception) -> None:
        """Count an invalid sample, and log why, once for each of the first 100 keys: a peer may have any number."""
        with self._counting:
            self.invalid += 1
            if len(self._warned) >= _MAX_WARNED or hash(key) in self._warned:
                return
            self._warned.add(hash(key))
            last = "; further keys are only counted" if len(self._warned) == _MAX_WARNED else ""
        stream = self._streams.get(key)
        reason = str(error)[:_MAX_TEXT]
        extra = about("invalid", stream.address if stream else None, reason=reason)
        _log.warning("%r: %s%s", key[:_MAX_TEXT], reason, last, extra=extra)

    def _inspect(self, stream: KeyState, payload: bytes, raw: RawSample) -> None:
        if len(payload) > PAYLOAD_LIMIT:
            raise DecodeError(f"{len(payload)} bytes, more than the {PAYLOAD_LIMIT} that a message can have")
        if raw.kind == zenoh.SampleKind.DELETE:
            raise DecodeError("a delete, which no publisher of nedbus sends")
        if stream.codec is None:
            stream.message = message_name_of(str(raw.encoding)) or ""
            if not stream.message:
                raise DecodeError(f"it does not name its message: its encoding is {str(raw.encoding)!r:.100}")
            with suppress(DecodeError):  # it is decoded when it is read: by then it may be known
                stream.carry(codec_of(self._layouts.definition(stream.message)))
        if len(payload) != stream.size and stream.codec:
            self._layouts.check(stream.codec, payload)
