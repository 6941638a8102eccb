"""Stream and Arrival: what a subscription knows of a key and of one received message; no I/O."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from nedbus import limits
from nedbus.transport import RawSample
from nedbus_msgs import Address, Codec, Provenance

if TYPE_CHECKING:
    from .throttle import Throttled
    from .writer_proxy import WriterProxy


Layouts = Mapping[int, Sequence[str]]  # names of the fields by layout
NO_LAYOUTS: Final[Layouts] = {}


@dataclass(slots=True, eq=False)
class Stream:
    """State of a key: address, codec, writer proxies and losses not yet reported."""

    key: str  # key of the full-rate stream
    wire_key: str  # key on which messages arrive, perhaps downsampled
    address: Address
    # None for messages not built in: each encoding identifies a definition
    codec: Codec[Any] | None = None
    size: int = -1  # bytes of a payload with all fields
    # last encoding: Zenoh's object and its text; accessed by two threads
    encoding: tuple[object, str] = None, ""
    provenance: tuple[str, Provenance] = "", Provenance()  # last provenance, with its encoding
    writers: dict[str, WriterProxy] = field(default_factory=dict)  # by name
    writer: WriterProxy | None = None  # publisher of the last message
    last_active: float = 0.0  # monotonic time of the last message or heartbeat [s]
    gap: int = 0  # messages lost before the next delivery
    # messages lost before one that was dropped or invalid; the next sample read reports them
    unreported: int = 0
    throttled: Throttled | None = None  # of a reader with a maximum rate


class DetachedSample(NamedTuple):
    """Metadata of a sample, detached from Zenoh's receive buffer, which a waiting sample would keep in memory."""

    timestamp: zenoh.Timestamp | None
    source_info: zenoh.SourceInfo | None
    encoding: str
    retained: bool


class Arrival(NamedTuple):
    """A received message.

    `payload`: empty if it was rejected. `codec`: of its definition; None while a lookup of the definition is due.
    `lost`: messages lost before it. `received`: time at which it left Zenoh's ring [ns].
    `newer`: names of its fields by layout, if its layout is newer than the built-in ones.
    """

    stream: Stream
    payload: bytes
    raw: RawSample | DetachedSample
    codec: Codec[Any] | None
    lost: int
    received: int
    newer: Layouts = NO_LAYOUTS


def detach(arrival: Arrival, *, retained: bool = False) -> Arrival:
    """Return an arrival without a reference to Zenoh's receive buffer; `retained`: it predates the subscription."""
    raw = arrival.raw
    if isinstance(raw, DetachedSample):
        return arrival
    return arrival._replace(
        raw=DetachedSample(
            raw.timestamp, raw.source_info, encoding_of(arrival.stream, raw), retained
        )
    )


def encoding_of(stream: Stream, raw: RawSample | DetachedSample) -> str:
    """Return the encoding of a sample as text; it rarely changes, so the last one is cached and shared."""
    if isinstance(raw, DetachedSample):
        return raw.encoding
    encoding = raw.encoding
    known, text = stream.encoding
    if encoding != known:
        text = str(encoding)[: limits.ENCODING_TEXT]
        # a copy: the original keeps its receive buffer in memory
        stream.encoding = zenoh.Encoding(text), text
    return text
