"""A batch: what arrived as one NumPy array of messages, with the address, time and sequence number of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from nedbus.transport import RawSample
from nedbus_msgs import PAYLOAD_SIZE, Address, Provenance, Row, provenance_of
from nedbus_msgs.arrays import DTYPE, FEW, MessageArray, decode_array


@dataclass(eq=False)
class Batch:
    """Messages that arrived together, in the order of their arrival; get one from `subscription.batches()`.

    All are valid.

    `messages`: structured array of shape (n,) and dtype DTYPE, a column for each field: `messages["x"]`.
    `addresses`: the addresses that occur; `address_index`: for each message, the index of its address among them.
    `received`: when they were read here, ns since the epoch.
    `lost`: messages that were lost in transit before these, all addresses together.
    """

    messages: MessageArray
    addresses: tuple[Address, ...]
    address_index: npt.NDArray[np.intp]
    received: int
    lost: int
    _raw: Sequence[RawSample] = field(repr=False)

    def __len__(self) -> int:
        return len(self.messages)

    def of(self, address: Address) -> MessageArray:
        """Return the messages of one address."""
        if address not in self.addresses:
            return self.messages[:0]
        chosen: MessageArray = self.messages[self.address_index == self.addresses.index(address)]
        return chosen

    @cached_property
    def sent(self) -> npt.NDArray[np.int64]:
        """When each was sent, ns since the epoch by its publisher's clock; 0 without a timestamp."""
        stamps = (raw.timestamp for raw in self._raw)
        return np.array([stamp.get_time_as_ntp64().as_nanos() if stamp else 0 for stamp in stamps], np.int64)

    @cached_property
    def sequence(self) -> npt.NDArray[np.int64]:
        """The sequence number of each, as its publisher counts; -1 without one."""
        infos = (raw.source_info for raw in self._raw)
        return np.array([info.source_sn if info else -1 for info in infos], np.int64)

    @cached_property
    def provenances(self) -> list[Provenance]:
        """The source of each, and the fields that it did not provide."""
        return [provenance_of(str(raw.encoding)) for raw in self._raw]


def make_batch(
    raw: Sequence[RawSample],
    keys: Sequence[str],
    addresses: Mapping[str, Address],
    *,
    received: int,
    lost: int,
    decode: Callable[[RawSample, str], Row | None],
) -> Batch:
    """Return the batch of what arrived on these keys, of which some may have no address.

    `decode` returns the row of one sample, None if it is invalid; it is for what `decode_array` cannot read.
    """
    if len(raw) < FEW:
        rows = list(map(decode, raw, keys))
        messages = np.array([row for row in rows if row is not None], DTYPE)
        valid = np.array([row is not None for row in rows])
    else:
        messages, valid = _decode(raw, keys, addresses, decode)
    if not valid.all():
        kept = np.flatnonzero(valid).tolist()
        raw, keys = [raw[index] for index in kept], [keys[index] for index in kept]
    indices = {key: index for index, key in enumerate(dict.fromkeys(keys))}
    address_index = np.fromiter(map(indices.__getitem__, keys), np.intp, len(keys))
    return Batch(messages, tuple(addresses[key] for key in indices), address_index, received, lost, raw)


def _decode(
    raw: Sequence[RawSample],
    keys: Sequence[str],
    addresses: Mapping[str, Address],
    decode: Callable[[RawSample, str], Row | None],
) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
    """Return the valid messages, and which of all were valid."""
    payloads = [sample.payload.to_bytes() for sample in raw]
    if set(map(len, payloads)) != {PAYLOAD_SIZE}:
        payloads = [payload if len(payload) == PAYLOAD_SIZE else bytes(PAYLOAD_SIZE) for payload in payloads]
    messages, valid = decode_array(b"".join(payloads))
    if len(addresses) < len(set(keys)):
        valid &= [key in addresses for key in keys]
    if valid.all():
        return messages, valid
    for index in np.flatnonzero(~valid).tolist():
        row = decode(raw[index], keys[index])
        if row is not None:
            messages[index] = row
            valid[index] = True
    return messages[valid], valid
