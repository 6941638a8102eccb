"""Decoder: turns Zenoh samples into nedbus samples (key to address, payload to message, encoding to provenance)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from nedbus import clock
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
    UnknownLayoutError,
    codec_of,
    identity_of,
    provenance_of,
)

from .layout_lookup import LayoutLookup

if TYPE_CHECKING:
    from .writer_proxy import WriterProxy

_log = logging.getLogger(__name__)

MAX_KEYS: Final = 10_000  # tracked per reader, a bound on memory that no peer can exceed
WAKE_UP: Final = "nedbus/wake-up"  # encoding of a session-local sample that wakes a reader blocked on the ring
_MAX_WARNED: Final = 100  # keys with a logged warning about invalid messages
_MAX_ENCODING: Final = 512  # characters kept of an encoding; those of nedbus have 250 at most
_MAX_TEXT: Final = 300  # logged characters of a key and of a reason


@dataclass(slots=True, eq=False)
class KeyState:
    """State of a key: address, codec, writer proxies and losses not yet reported.

    `key`: key of the full-rate stream. `wire_key`: key on which messages arrive, perhaps downsampled.
    `codec`: None for messages without a file, whose definition each encoding identifies. `size`: bytes of its payload
    with all fields, or -1. `message`: its name, or "". `encoding`: the last one, as Zenoh's object and as text.
    `writers`: writer proxies by name. `writer`: the one of the last message.
    `gap`: messages lost before the next delivery. `unreported`: messages lost before one that was dropped or invalid;
    the next sample read reports them.
    """

    key: str
    wire_key: str
    address: Address
    codec: Codec[Any] | None = None
    size: int = -1
    message: str = ""
    encoding: tuple[object, str] = None, ""  # one tuple, as two threads access it
    writers: dict[str, WriterProxy] = field(default_factory=dict)
    writer: WriterProxy | None = None
    gap: int = 0
    unreported: int = 0


class DetachedSample(NamedTuple):
    """Metadata of a sample, detached from Zenoh's receive buffer, which a waiting sample would keep in memory."""

    timestamp: zenoh.Timestamp | None
    source_info: zenoh.SourceInfo | None
    encoding: str


Arrival = tuple[KeyState, bytes, RawSample | DetachedSample, int]  # the last item: messages lost before this one


class Decoder:
    """Decode samples and count invalid ones; the reason is logged once per key, for the first 100 keys."""

    def __init__(self, layouts: LayoutLookup, *, prefix: str) -> None:
        self.invalid = 0
        self._layouts = layouts
        self._prefix = prefix
        self._streams: dict[str, KeyState] = {}
        self._warned: set[int] = set()  # hashes, as keys may be long
        self._counting = threading.Lock()  # guards `invalid` and `_warned`: receiving and reading threads reject

    def stream(self, key: str) -> KeyState:
        """Return the state of a key; raise AddressError if the key has no address."""
        stream = self._streams.get(key)
        if stream is None:
            from_key = Address.from_rate_key if "/@" in key else Address.from_key  # with max_rate only
            address = from_key(key, prefix=self._prefix)
            stream = KeyState(address.key(prefix=self._prefix), key, address)
            if address.topic in BY_TOPIC:
                stream.codec = codec_of(BY_TOPIC[address.topic])
                stream.size, stream.message = stream.codec.size, stream.codec.definition.name
            if len(self._streams) < MAX_KEYS:
                stream = self._streams.setdefault(key, stream)  # another thread may have added it
        return stream

    def learn(self, batch: Iterable[RawSample]) -> None:
        """Look up the unknown messages and layouts of a batch; blocks, so never call it on a receiving thread."""
        for raw in batch:
            with suppress(AddressError, DecodeError):
                self._inspect(self.stream(str(raw.key_expr)), raw.payload.to_bytes(), raw)
        self._layouts.wait()

    def admit(self, batch: Iterable[RawSample]) -> list[Arrival]:
        """Return arrivals to queue, with 0 losses each; rejected ones keep their sequence number but lose the payload.

        A payload of the expected size is decoded when it is read. Any other size is checked here, so that it can
        neither displace a valid sample nor use much memory.
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
    def detach(cls, arrival: Arrival) -> Arrival:
        """Return an arrival without a reference to Zenoh's receive buffer."""
        stream, payload, raw, lost = arrival
        if isinstance(raw, DetachedSample):
            return arrival
        return stream, payload, DetachedSample(raw.timestamp, raw.source_info, encoding_of(stream, raw)), lost

    def codec(self, stream: KeyState, raw: RawSample | DetachedSample, *, wait: bool = True) -> Codec[Any] | None:
        """Return the codec of a sample; None if no publisher describes its message.

        `wait`: wait for a lookup in progress; never do so on a receiving thread.
        Raises DecodeError if the encoding identifies no message.
        """
        if stream.codec:
            return stream.codec
        encoding, info = encoding_of(stream, raw), raw.source_info
        identity = identity_of(encoding)
        if identity is None:
            raise DecodeError(f"the encoding {encoding!r:.100} has no name and hash of a message")
        return self._layouts.codec(*identity, publisher=info and info.source_id.zid, wait=wait)

    def decode(self, arrival: Arrival, *, rows: bool, lost: int = 0) -> Sample[Any] | None:
        """Decode an arrival to a sample, with a Row as its message if `rows`; None if it is invalid."""
        stream, payload, raw, _ = arrival
        if not payload:
            return None
        codec = stream.codec or self.codec(stream, raw)
        encoding = encoding_of(stream, raw)
        if codec is None:
            self.reject(stream.key, DecodeError(f"no publisher describes {encoding[:_MAX_TEXT]!r}"))
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
        provenance = provenance_of(codec.definition, encoding)
        return Sample(message, stream.address, clock.utc_ns(), raw.timestamp, lost, provenance)

    def count_invalid(self, count: int) -> None:
        """Add to the count of invalid samples."""
        with self._counting:
            self.invalid += count

    def reject(self, key: str, error: Exception) -> None:
        """Count an invalid sample and log the reason once per key, for the first 100 keys only."""
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
            raise DecodeError("a delete sample, which nedbus publishers never send")
        codec = self.codec(stream, raw, wait=False)  # None: decoded on read; the lookup may be done by then
        if codec and len(payload) != codec.size:
            self._layouts.check(codec, payload)


def encoding_of(stream: KeyState, raw: RawSample | DetachedSample) -> str:
    """Return the encoding of a sample as text; it rarely changes, so the last one is cached and shared."""
    if isinstance(raw, DetachedSample):
        return raw.encoding
    encoding = raw.encoding
    known, text = stream.encoding
    if encoding != known:
        text = str(encoding)[:_MAX_ENCODING]
        stream.encoding = encoding, text
    return text
