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

MAX_KEYS: Final = 10_000  # tracked per reader, a bound on memory that no peer can exceed
WAKE_UP: Final = "nedbus/wake-up"  # encoding of a session-local sample that wakes a reader blocked on the ring
_MAX_WARNED: Final = 100  # keys with a logged warning about invalid messages
_MAX_TEXT: Final = 300  # logged characters of a key and of a reason


@dataclass(slots=True, eq=False)
class KeyState:
    """State of a key: address, codec, writer proxies and losses not yet reported.

    `key`: key of the full-rate stream. `wire_key`: key on which messages arrive, perhaps downsampled.
    `codec`: None while the definition of `message` is unknown. `size`: payload size in bytes of the known layout.
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
    last: tuple[zenoh.Encoding | None, Provenance] = None, Provenance()  # one tuple, as two threads access it
    writers: dict[str, WriterProxy] = field(default_factory=dict)
    writer: WriterProxy | None = None
    gap: int = 0
    unreported: int = 0

    def set_codec(self, codec: Codec[Any]) -> None:
        """Set the codec and the values derived from it."""
        self.codec, self.size, self.message = codec, codec.size, codec.definition.name


class DetachedSample(NamedTuple):
    """Metadata of a sample, detached from Zenoh's receive buffer, which a waiting sample would keep in memory."""

    timestamp: zenoh.Timestamp | None
    source_info: zenoh.SourceInfo | None
    provenance: Provenance


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
                stream.set_codec(codec_of(BY_TOPIC[address.topic]))
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
        return stream, payload, DetachedSample(raw.timestamp, raw.source_info, cls.provenance(arrival)), lost

    @staticmethod
    def provenance(arrival: Arrival) -> Provenance:
        """Return the provenance of an arrival."""
        stream, _, raw, _ = arrival
        if isinstance(raw, DetachedSample):
            return raw.provenance
        encoding = raw.encoding
        known, provenance = stream.last
        if encoding != known and stream.codec:  # rarely changes, so the last one is cached
            provenance = provenance_of(stream.codec.definition, str(encoding))
            stream.last = encoding, provenance
        return provenance

    def decode(self, arrival: Arrival, *, rows: bool, lost: int = 0) -> Sample[Any] | None:
        """Decode an arrival to a sample, with a Row as its message if `rows`; None if it is invalid."""
        stream, payload, raw, _ = arrival
        if not payload:
            return None
        codec = stream.codec or self.resolve(stream)
        if codec is None:
            self.reject(stream.key, DecodeError("no publisher has described its layout", stream.message))
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
        return Sample(message, stream.address, clock.utc_ns(), raw.timestamp, lost, self.provenance(arrival))

    def resolve(self, stream: KeyState) -> Codec[Any] | None:
        """Return the codec of a key, looked up if its message is unknown; None if no publisher describes the message.

        Waits once for a lookup in progress, so never call it on a receiving thread.
        """
        if stream.codec is None and stream.message:
            for _ in range(2):
                with suppress(DecodeError):
                    stream.set_codec(codec_of(self._layouts.definition(stream.message)))
                    break
                self._layouts.wait()
        return stream.codec

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
        if stream.codec is None:
            stream.message = message_name_of(str(raw.encoding)) or ""
            if not stream.message:
                raise DecodeError(f"unknown message type: the encoding {str(raw.encoding)!r:.100} names none")
            with suppress(DecodeError):  # decoded on read; the lookup may be done by then
                stream.set_codec(codec_of(self._layouts.definition(stream.message)))
        if len(payload) != stream.size and stream.codec:
            self._layouts.check(stream.codec, payload)
