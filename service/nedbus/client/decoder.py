"""From Zenoh's samples to ours: the address of a key, the message of a payload, the provenance of an encoding."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import zenoh

from nedbus.transport import RawSample
from nedbus_msgs import (
    PAYLOAD_LIMIT,
    PAYLOAD_SIZE,
    Address,
    AddressError,
    DecodeError,
    Provenance,
    provenance_of,
)

from .layout_lookup import LayoutLookup
from .sample import M_co, Sample

_log = logging.getLogger(__name__)

MAX_KEYS: Final = 10_000
"""Keys that a reader remembers; no peer can make it remember more."""

Decode = Callable[..., M_co]
"""`nedbus_msgs.decode` or `decode_row`: a payload, and `newer` layouts, to a message."""

_UNKNOWN: Final = Provenance()


@dataclass(slots=True, eq=False)
class _Key:
    """What is derived from a key once, and the provenance of its last encoding."""

    address: Address
    encoding: zenoh.Encoding | None = None
    provenance: Provenance = _UNKNOWN


class Decoder:
    """Decode what arrives, and count what is invalid; its reason is logged once for each key."""

    def __init__(self, layouts: LayoutLookup, *, prefix: str) -> None:
        self.invalid = 0
        self._layouts = layouts
        self._prefix = prefix
        self._keys: dict[str, _Key] = {}
        self._warned: set[str] = set()
        self._counting = threading.Lock()  # the pump and the reader both reject

    def decode(self, raw: RawSample, key: str, decode: Decode[M_co], *, lost: int = 0) -> Sample[M_co] | None:
        """Return the sample of what arrived on a key, None if it is invalid."""
        known = self._keys.get(key)
        try:
            if known is None:
                known = self._remember(key)
            payload = raw.payload.to_bytes()
            if not payload and raw.kind == zenoh.SampleKind.DELETE:
                raise DecodeError("a delete, which no publisher of nedbus sends")
            message = decode(payload, newer=self._layouts.newer)
        except (AddressError, DecodeError) as exc:
            self.reject(key, exc)
            return None
        encoding = raw.encoding
        if encoding != known.encoding:  # almost always it is the same: comparing is all that it costs
            known.encoding, known.provenance = encoding, provenance_of(str(encoding))
        return Sample(message, known.address, time.time_ns(), raw.timestamp, lost, known.provenance)

    def admit(self, batch: Iterable[RawSample]) -> list[RawSample]:
        """Return what is worth queueing; look up the layouts that are not known here, waiting for publishers' answers.

        A payload of the size that `encode` writes is admitted, and decoded when it is read.
        Any other is decoded here: it must neither displace a valid sample nor take up much memory.
        """
        admitted = []
        for raw in batch:
            size = len(raw.payload)
            if size == PAYLOAD_SIZE:
                admitted.append(raw)
                continue
            try:
                if size > PAYLOAD_LIMIT:
                    raise DecodeError(f"{size} bytes, more than the {PAYLOAD_LIMIT} that a message can have")
                if raw.kind == zenoh.SampleKind.PUT:
                    self._layouts.check(raw.payload.to_bytes())
            except DecodeError as exc:
                self.reject(str(raw.key_expr), exc)
            else:
                admitted.append(raw)
        return admitted

    def addresses(self, keys: Iterable[str]) -> Mapping[str, Address]:
        """Return the addresses of keys, without those that have none."""
        found: dict[str, Address] = {}
        for key in set(keys):
            try:
                found[key] = (self._keys.get(key) or self._remember(key)).address
            except AddressError:
                continue  # `decode` rejects it
        return found

    def count_invalid(self, count: int) -> None:
        """Count invalid samples."""
        with self._counting:
            self.invalid += count

    def reject(self, key: str, error: Exception) -> None:
        """Count an invalid sample, and log why, once for each key."""
        self.count_invalid(1)
        with self._counting:
            if key in self._warned or len(self._warned) >= MAX_KEYS:
                return
            self._warned.add(key)
        _log.warning("%r: %s", key, error)

    def _remember(self, key: str) -> _Key:
        known = _Key(Address.from_key(key, prefix=self._prefix))
        if len(self._keys) < MAX_KEYS:
            self._keys[key] = known
        return known
