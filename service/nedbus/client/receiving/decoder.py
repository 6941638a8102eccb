"""Decoder: turns Zenoh samples into nedbus samples (key to address, payload to message, encoding to provenance)."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from nedbus import clock
from nedbus.client.protocol import LIVE
from nedbus.client.rate_gate import RateGate
from nedbus.errors import AddressError, DecodeError, UnknownLayoutError
from nedbus.log_event import about
from nedbus.samples import Sample
from nedbus.transport import RawSample
from nedbus_msgs import BY_TOPIC, PAYLOAD_LIMIT, RATE, Address, Codec, Provenance, codec_of, identity_of, provenance_of

from .layout_lookup import LayoutLookup, Sender

if TYPE_CHECKING:
    from .writer_proxy import WriterProxy

_log = logging.getLogger(__name__)

WAKE_UP: Final = "nedbus/wake-up"  # encoding of a session-local sample that wakes a reader blocked on the ring
_MAX_LOGGED_KEYS: Final = 100  # keys with a logged warning about invalid messages
_MAX_ENCODING: Final = 512  # characters kept of an encoding; nedbus's own encodings have at most 250
_MAX_TEXT: Final = 300  # logged characters of a key and of a reason


@dataclass(slots=True, eq=False)
class KeyState:
    """State of a key: address, codec, writer proxies and losses not yet reported."""

    key: str  # key of the full-rate stream
    wire_key: str  # key on which messages arrive, perhaps downsampled
    address: Address
    codec: Codec[Any] | None = None  # None for messages not built in: each encoding identifies a definition
    size: int = -1  # bytes of a payload with all fields
    encoding: tuple[object, str] = None, ""  # last encoding: Zenoh's object and its text; accessed by two threads
    provenance: tuple[str, Provenance] = "", Provenance()  # last provenance, with its encoding
    writers: dict[str, WriterProxy] = field(default_factory=dict)  # by name
    writer: WriterProxy | None = None  # publisher of the last message
    last_active: float = 0.0  # monotonic time of the last message or heartbeat [s]
    gap: int = 0  # messages lost before the next delivery
    unreported: int = 0  # messages lost before one that was dropped or invalid; the next sample read reports them
    gate: RateGate | None = None  # set with a maximum rate, once a downsampled message has arrived
    last_sent: float = -math.inf  # with a maximum rate, time of sending of the retained message [ns]


class DetachedSample(NamedTuple):
    """Metadata of a sample, detached from Zenoh's receive buffer, which a waiting sample would keep in memory."""

    timestamp: zenoh.Timestamp | None
    source_info: zenoh.SourceInfo | None
    encoding: str
    retained: bool


Arrival = tuple[KeyState, bytes, RawSample | DetachedSample, int, int]
"""An admitted message: key state, payload (empty if rejected), metadata, number of messages lost before it, and the
time at which it left Zenoh's ring [ns].

A plain tuple: a class with named fields would add 0.1 us to the 0.3 us that a message of a batch takes.
"""


class Decoder:
    """Decode samples and count invalid ones; the reason is logged once per key, for the first 100 keys."""

    def __init__(self, layouts: LayoutLookup, *, prefix: str) -> None:
        self.invalid, self.prefix, self._layouts = 0, prefix, layouts
        self._warned: set[int] = set()  # hashes, because keys may be long
        self._counting = threading.Lock()  # guards `invalid` and `_warned`: receiving and reading threads reject

    def open(self, key: str) -> KeyState:
        """Return the state of a new stream; raise AddressError if the key has no address."""
        address = Address.from_key(key.partition(RATE)[0], prefix=self.prefix)
        stream = KeyState(address.key(prefix=self.prefix), key, address)
        if address.topic in BY_TOPIC:
            stream.codec = codec_of(BY_TOPIC[address.topic])
            stream.size = stream.codec.size
        return stream

    def read(self, answers: Sequence[RawSample]) -> Iterator[Sample[Any]]:
        """Yield the valid samples among the replies to a query for last messages; wait for lookups of definitions."""
        received = clock.utc_ns()
        opened = [(raw, str(raw.key_expr), raw.payload.to_bytes()) for raw in answers]
        for raw, key, payload in opened:
            with suppress(AddressError, DecodeError):
                self.inspect(self.open(key), payload, raw)
        self._layouts.wait()
        for raw, key, payload in opened:
            stream = None
            try:
                stream = self.open(key)
                self.inspect(stream, payload, raw)
            except (AddressError, DecodeError) as exc:
                self.reject(key, exc, stream)
            else:
                if sample := self.decode((stream, payload, raw, 0, received), rows=False):
                    sample.retained = True
                    sample.stored = raw.attachment is None or raw.attachment.to_bytes() != LIVE
                    yield sample

    def find_codec(self, stream: KeyState, raw: RawSample | DetachedSample, *, wait: bool = True) -> Codec[Any] | None:
        """Return the codec of the definition in the encoding, from its publisher; None if no publisher has it.

        `wait`: wait for a lookup in progress; never do so on a receiving thread.
        Raises DecodeError if the encoding identifies no message.
        """
        encoding = encoding_of(stream, raw)
        identity = identity_of(encoding)
        if identity is None:
            text = f"the encoding {encoding!r:.100} has no message name and hash"
            raise DecodeError(f"unknown message or layout, and {text}")
        sender = Sender(stream.address.vehicle, raw.source_info and raw.source_info.source_id.zid)
        return self._layouts.codec(*identity, sender=sender, wait=wait)

    def _newer(
        self, error: UnknownLayoutError, stream: KeyState, raw: RawSample | DetachedSample, *, wait: bool = True
    ) -> Mapping[int, Sequence[str]]:
        """Return the fields of an unknown layout, which the hash in the encoding identifies; {} if there are none."""
        if stream.codec is None:
            return {}  # a definition that was looked up has a single layout
        codec, name = self.find_codec(stream, raw, wait=wait), stream.codec.definition.name
        return {error.layout: codec.definition.names} if codec and codec.definition.name == name else {}

    def decode(self, arrival: Arrival, *, rows: bool, lost: int = 0) -> Sample[Any] | None:
        """Decode an arrival to a sample, with a Row as its message if `rows`; None if it is invalid."""
        stream, payload, raw, _, received = arrival
        if not payload:
            return None
        codec = stream.codec or self.find_codec(stream, raw)
        encoding = encoding_of(stream, raw)
        if codec is None:
            self.reject(stream.key, DecodeError(f"received no definition of {encoding[:_MAX_TEXT]!r}"), stream)
            return None
        decode = codec.decode_row if rows else codec.decode
        try:
            try:
                message = decode(payload)
            except UnknownLayoutError as exc:
                message = decode(payload, newer=self._newer(exc, stream, raw))
        except DecodeError as exc:
            self.reject(stream.key, exc, stream)
            return None
        known, provenance = stream.provenance
        if known is not encoding:
            provenance = provenance_of(codec.definition, encoding)
            stream.provenance = encoding, provenance
        retained = isinstance(raw, DetachedSample) and raw.retained
        return Sample(message, stream.address, received, raw.timestamp, lost, provenance, retained)

    def count_invalid(self, count: int) -> None:
        """Add to the count of invalid samples."""
        with self._counting:
            self.invalid += count

    def reject(self, key: str, error: Exception, stream: KeyState | None) -> None:
        """Count an invalid sample and log the reason once per key, for the first 100 keys only."""
        with self._counting:
            self.invalid += 1
            if len(self._warned) >= _MAX_LOGGED_KEYS or hash(key) in self._warned:
                return
            self._warned.add(hash(key))
            last = "; further keys are only counted" if len(self._warned) == _MAX_LOGGED_KEYS else ""
        reason = str(error)[:_MAX_TEXT]
        extra = about("invalid", stream.address if stream else None, reason=reason)
        _log.warning("ignored an invalid message on %r (%s)%s", key[:_MAX_TEXT], reason, last, extra=extra)

    def inspect(self, stream: KeyState, payload: bytes, raw: RawSample) -> None:
        """Check a sample without waiting for a lookup, which it may start; raise DecodeError if it is invalid."""
        if len(payload) > PAYLOAD_LIMIT:
            raise DecodeError(f"{len(payload)} bytes, more than the limit of {PAYLOAD_LIMIT}")
        if raw.kind == zenoh.SampleKind.DELETE:
            raise DecodeError("a delete sample, which nedbus publishers never send")
        codec = stream.codec or self.find_codec(stream, raw, wait=False)
        if codec and len(payload) != codec.size:  # None: decoded on read; the lookup may be done by then
            try:
                codec.decode(payload)
            except UnknownLayoutError as exc:
                codec.decode(payload, newer=self._newer(exc, stream, raw, wait=False))


def detach(arrival: Arrival, *, retained: bool = False) -> Arrival:
    """Return an arrival without a reference to Zenoh's receive buffer; `retained`: it predates the subscription."""
    stream, payload, raw, lost, received = arrival
    if isinstance(raw, DetachedSample):
        return arrival
    detached = DetachedSample(raw.timestamp, raw.source_info, encoding_of(stream, raw), retained)
    return stream, payload, detached, lost, received


def mark_retained(arrival: Arrival) -> Arrival:
    """Return the first arrival of a publisher, marked as retained if Zenoh's history query returned it.

    Only replies to queries use congestion control BLOCK; nedbus publishers use DROP.
    """
    raw = arrival[2]
    is_reply = not isinstance(raw, DetachedSample) and raw.congestion_control == zenoh.CongestionControl.BLOCK
    return detach(arrival, retained=True) if is_reply else arrival


def encoding_of(stream: KeyState, raw: RawSample | DetachedSample) -> str:
    """Return the encoding of a sample as text; it rarely changes, so the last one is cached and shared."""
    if isinstance(raw, DetachedSample):
        return raw.encoding
    encoding = raw.encoding
    known, text = stream.encoding
    if encoding != known:
        text = str(encoding)[:_MAX_ENCODING]
        stream.encoding = zenoh.Encoding(text), text  # a copy: the original keeps its receive buffer in memory
    return text
