"""Decoder: turns Zenoh samples into nedbus samples (key to address, payload to message, encoding to provenance)."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Any, Final

import zenoh

from nedbus import clock, limits
from nedbus.client.protocol import LIVE
from nedbus.errors import AddressError, DecodeError, UnknownLayoutError
from nedbus.log_event import about
from nedbus.samples import Sample
from nedbus.transport import RawSample
from nedbus_msgs import (
    BY_TOPIC,
    PAYLOAD_LIMIT,
    RATE,
    Address,
    Codec,
    codec_of,
    identity_of,
    provenance_of,
)

from .arrival import NO_LAYOUTS, Arrival, DetachedSample, Layouts, Stream, encoding_of
from .layout_lookup import LayoutLookup, Sender

_log = logging.getLogger(__name__)

# encoding of a session-local sample that wakes a reader blocked on the ring
WAKE_UP: Final = "nedbus/wake-up"


class Decoder:
    """Decode samples and count invalid ones; the reason is logged once per key, for the first 100 keys.

    `reasons`: why a message was invalid, by address, for the same keys.
    """

    def __init__(self, layouts: LayoutLookup, *, prefix: str) -> None:
        self.invalid = 0
        self.prefix = prefix
        self._layouts = layouts
        self.reasons: dict[Address, str] = {}
        self._warned: set[int] = set()  # hashes, because keys may be long
        # guards `invalid` and `_warned`: receiving and reading threads reject
        self._counting = threading.Lock()

    def open(self, key: str) -> Stream:
        """Return the state of a new stream; raise AddressError if the key has no address."""
        address = Address.from_key(key.partition(RATE)[0], prefix=self.prefix)
        stream = Stream(address.key(prefix=self.prefix), key, address)
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
                codec, newer = self.inspect(stream, payload, raw)
                arrival = Arrival(stream, payload, raw, codec, 0, received, newer)
            except (AddressError, DecodeError) as exc:
                self.reject(key, exc, stream)
            else:
                sample = self.decode(arrival, False)
                if sample:
                    sample.retained = True
                    sample.stored = raw.attachment is None or raw.attachment.to_bytes() != LIVE
                    yield sample

    def inspect(
        self, stream: Stream, payload: bytes, raw: RawSample
    ) -> tuple[Codec[Any] | None, Layouts]:
        """Return the codec of a sample's definition, and its layout if that is newer than those built in.

        The codec is None while a lookup is in progress, which this may start; it does not wait.
        Raises DecodeError if the sample is invalid. A payload of the expected size is checked when it is read.
        """
        if len(payload) > PAYLOAD_LIMIT:
            raise DecodeError(f"{len(payload)} bytes, more than the limit of {PAYLOAD_LIMIT}")
        if raw.kind == zenoh.SampleKind.DELETE:
            raise DecodeError("a delete sample, which nedbus publishers never send")
        newer = NO_LAYOUTS
        codec = stream.codec or self._find_codec(stream, raw)
        if codec and len(payload) != codec.size:
            try:
                codec.decode(payload)
            except UnknownLayoutError as exc:
                newer = self._find_layout(exc, stream, raw)
                codec.decode(payload, newer=newer)
        return codec, newer

    def define(self, arrivals: Sequence[Arrival]) -> Sequence[Arrival]:
        """Return arrivals of one type with their codec; wait for its lookup, but never on a receiving thread.

        This is the only wait for a definition, and all arrivals get the same answer.
        """
        if arrivals[0].stream.codec is not None or all(arrival.codec for arrival in arrivals):
            return arrivals
        known = next((arrival.codec for arrival in arrivals if arrival.codec), None)
        codec = known or self._find_codec(arrivals[0].stream, arrivals[0].raw, wait=True)
        return [arrival._replace(codec=codec) for arrival in arrivals]

    def decode(self, arrival: Arrival, rows: bool) -> Sample[Any] | None:
        """Decode an arrival to a sample, with a Row as its message if `rows`; None if it is invalid."""
        stream, payload, raw, codec, lost, received, newer = arrival
        known, encoding = stream.encoding
        if raw.encoding != known:  # rare
            encoding = encoding_of(stream, raw)
        if codec is None:
            self.reject(
                stream.key,
                DecodeError(f"received no definition of {encoding[: limits.PEER_TEXT]!r}"),
                stream,
            )
            return None
        if rows:
            decode = codec.decode_row
        else:
            decode = codec.decode
        try:
            try:
                if newer:
                    message = decode(payload, newer=newer)
                else:
                    message = decode(payload)
            except UnknownLayoutError as exc:  # a newer layout that has the expected size
                message = decode(payload, newer=self._find_layout(exc, stream, raw))
        except DecodeError as exc:
            self.reject(stream.key, exc, stream)
            return None
        described, provenance = stream.provenance
        if described is not encoding:
            provenance = provenance_of(codec.definition, encoding)
            stream.provenance = encoding, provenance
        retained = type(raw) is DetachedSample and raw.retained
        return Sample(message, stream.address, received, raw.timestamp, lost, provenance, retained)

    def count_invalid(self, count: int) -> None:
        """Add to the count of invalid samples."""
        with self._counting:
            self.invalid += count

    def reject(self, key: str, error: Exception, stream: Stream | None) -> None:
        """Count an invalid sample and log the reason once per key, for the first 100 keys only."""
        with self._counting:
            self.invalid += 1
            if len(self._warned) >= limits.LOGGED_KEYS or hash(key) in self._warned:
                return
            self._warned.add(hash(key))
            last = ""
            if len(self._warned) == limits.LOGGED_KEYS:
                last = "; further keys are only counted"
            reason = str(error)[: limits.PEER_TEXT]
            if stream is not None:
                self.reasons[stream.address] = reason
        extra = about("invalid", stream.address if stream else None, reason=reason)
        _log.warning(
            "ignored an invalid message on %r (%s)%s",
            key[: limits.PEER_TEXT],
            reason,
            last,
            extra=extra,
        )

    def _find_layout(
        self, error: UnknownLayoutError, stream: Stream, raw: RawSample | DetachedSample
    ) -> Layouts:
        """Return the fields of an unknown layout, which the hash in the encoding identifies; {} if it is not known."""
        if stream.codec is None:
            return NO_LAYOUTS  # a definition that was looked up has a single layout
        codec = self._find_codec(stream, raw, unknown=f"layout {error.layout}")
        name = stream.codec.definition.name
        if codec and codec.definition.name == name:
            return {error.layout: codec.definition.names}
        return NO_LAYOUTS

    def _find_codec(
        self,
        stream: Stream,
        raw: RawSample | DetachedSample,
        *,
        wait: bool = False,
        unknown: str = "message",
    ) -> Codec[Any] | None:
        """Return the codec of the definition in the encoding, from its publisher; None if no publisher has it.

        `wait`: wait for a lookup in progress. `unknown`: what is not built in, for the error.
        Raises DecodeError if the encoding identifies no message.
        """
        encoding = encoding_of(stream, raw)
        identity = identity_of(encoding)
        if identity is None:
            text = f"the encoding {encoding!r:.100} has no message name and hash"
            raise DecodeError(f"unknown {unknown}, and {text}")
        sender = Sender(stream.address.vehicle, raw.source_info and raw.source_info.source_id.zid)
        return self._layouts.codec(*identity, sender=sender, wait=wait)
