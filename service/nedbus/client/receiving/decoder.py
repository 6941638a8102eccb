"""From Zenoh's samples to ours: the address of a key, the message of a payload, the provenance of an encoding."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import zenoh

from nedbus.client.sample import M_co, Sample
from nedbus.log_event import about
from nedbus.transport import RawSample
from nedbus_msgs import PAYLOAD_LIMIT, PAYLOAD_SIZE, Address, AddressError, DecodeError, Provenance, provenance_of

from .layout_lookup import LayoutLookup

if TYPE_CHECKING:
    from .writer_proxy import WriterProxy

_log = logging.getLogger(__name__)

MAX_KEYS: Final = 10_000  # that a reader remembers; no peer can make it remember more
WAKE_UP: Final = "nedbus/wake-up"  # encoding of what a session sends to itself so that its reader looks again
Decode = Callable[..., M_co]  # `nedbus_msgs.decode` or `decode_row`: a payload, and `newer` layouts, to a message
_MAX_WARNED: Final = 100  # keys whose invalid messages are logged
_MAX_TEXT: Final = 300  # characters of a key, and of a reason, that are logged


@dataclass(slots=True, eq=False)
class Stream:
    """What is known of a key: what is derived from it once, who publishes on it, and what is to be reported of it.

    `key`: that of the whole stream. `heard`: that on which messages come. `thinned`: these are those of a thinned copy.
    `writers`: its publishers, by name; `writer` is that of the last message.
    `gap`: messages that were lost before the next one that is delivered. `unreported`: those lost before one that was
    dropped or invalid; they are reported with the next sample that is read.
    """

    key: str
    heard: str
    address: Address
    thinned: bool = False
    last: tuple[zenoh.Encoding | None, Provenance] = None, Provenance()  # in one piece: two threads look and change it
    writers: dict[str, WriterProxy] = field(default_factory=dict)
    writer: WriterProxy | None = None
    gap: int = 0
    unreported: int = 0


class Kept(NamedTuple):
    """What is kept of a sample that waits for long: the sample itself keeps the buffer in which Zenoh received it."""

    timestamp: zenoh.Timestamp | None
    source_info: zenoh.SourceInfo | None
    provenance: Provenance


Arrival = tuple[Stream, bytes, RawSample | Kept, int]  # the last: how many messages were lost before it


class Decoder:
    """Decode what arrives, and count what is invalid; its reason is logged once for each of the first 100 keys."""

    def __init__(self, layouts: LayoutLookup, *, prefix: str) -> None:
        self.invalid = 0
        self._layouts = layouts
        self._prefix = prefix
        self._streams: dict[str, Stream] = {}
        self._warned: set[int] = set()  # hashes of keys, which may be long
        self._counting = threading.Lock()  # whoever receives and whoever reads both reject

    def stream(self, key: str) -> Stream:
        """Return what is known of a key; raise AddressError for one that is none of ours."""
        stream = self._streams.get(key)
        if stream is None:
            thinned = "/@" in key  # only who asks for thinned streams gets such keys
            address = (Address.from_rate_key if thinned else Address.from_key)(key, prefix=self._prefix)
            stream = Stream(address.key(prefix=self._prefix), key, address, thinned)
            if len(self._streams) < MAX_KEYS:
                self._streams[key] = stream
        return stream

    def admit(self, batch: Iterable[RawSample]) -> list[Arrival]:
        """Return what is worth queueing, with no losses so far; what is rejected, without its payload, for its number.

        A payload of the size that `encode` writes is decoded when it is read; any other already here, as it must
        neither displace a valid sample nor take up much memory.
        """
        admitted: list[Arrival] = []
        known = self._streams.get
        for raw in batch:
            key = str(raw.key_expr)
            stream = known(key)
            payload = raw.payload.to_bytes()
            if stream is None or len(payload) != PAYLOAD_SIZE:
                if raw.encoding == WAKE_UP:
                    continue
                try:
                    stream = stream or self.stream(key)
                    if len(payload) != PAYLOAD_SIZE:
                        self._inspect(payload, raw.kind)
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
        if encoding != known:  # almost always it is the same: comparing is all that it costs
            provenance = provenance_of(str(encoding))
            stream.last = encoding, provenance
        return provenance

    def decode(self, arrival: Arrival, decode: Decode[M_co], *, lost: int = 0) -> Sample[M_co] | None:
        """Return the sample of what arrived, None if it is invalid."""
        stream, payload, raw, _ = arrival
        try:
            message = decode(payload, newer=self._layouts.newer)
        except DecodeError as exc:
            self.reject(stream.key, exc)
            return None
        return Sample(message, stream.address, time.time_ns(), raw.timestamp, lost, self.provenance(arrival))

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

    def _inspect(self, payload: bytes, kind: zenoh.SampleKind) -> None:
        if len(payload) > PAYLOAD_LIMIT:
            raise DecodeError(f"{len(payload)} bytes, more than the {PAYLOAD_LIMIT} that a message can have")
        if kind == zenoh.SampleKind.DELETE:
            raise DecodeError("a delete, which no publisher of nedbus sends")
        self._layouts.check(payload)
