"""A batch: what arrived as one NumPy array of messages, with the address, time and sequence number of each."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from nedbus_msgs import DEFAULT, Address, Message, Provenance, codec_of
from nedbus_msgs.arrays import MessageArray, arrays_of

from .decoder import Arrival, Decoder


@dataclass(eq=False)
class Batch:
    """Valid messages of one kind that arrived together, in that order; get one from `subscription.batches()`.

    `messages`: structured array of shape (n,), a column for each field: `messages["x"]`; `message`: what they are.
    `addresses`: the addresses that occur; `address_index`: for each message, the index of its address among them.
    `received`: when they were read here, ns since the epoch.
    `lost`: messages that were lost in transit before these, all addresses together.
    """

    messages: MessageArray
    message: type[Message]
    addresses: tuple[Address, ...]
    address_index: npt.NDArray[np.intp]
    received: int
    lost: int
    _arrivals: Sequence[Arrival] = field(repr=False)
    _decoder: Decoder = field(repr=False)

    def __len__(self) -> int:
        return len(self.messages)

    def of(self, address: Address) -> MessageArray:
        """Return the messages of one address."""
        index = self.addresses.index(address) if address in self.addresses else -1
        chosen: MessageArray = self.messages[self.address_index == index]
        return chosen

    @cached_property
    def sent(self) -> npt.NDArray[np.int64]:
        """When each was sent, ns since the epoch by its publisher's clock; 0 without a timestamp."""
        stamps = (raw.timestamp for _, _, raw, _ in self._arrivals)
        return np.array([stamp.get_time_as_ntp64().as_nanos() if stamp else 0 for stamp in stamps], np.int64)

    @cached_property
    def sequence(self) -> npt.NDArray[np.int64]:
        """The sequence number of each, as its publisher counts; -1 without one."""
        infos = (raw.source_info for _, _, raw, _ in self._arrivals)
        return np.array([info.source_sn if info else -1 for info in infos], np.int64)

    @cached_property
    def provenances(self) -> list[Provenance]:
        """The source of each, and the fields that it did not provide."""
        return list(map(self._decoder.provenance, self._arrivals))


def make_batch(arrivals: Sequence[Arrival], decoder: Decoder, *, lost: int) -> Batch:
    """Return the batch of what arrived; what is invalid is counted by the decoder, and left out."""
    received = time.time_ns()
    codec = decoder.resolve(arrivals[0][0])  # which waits for an answer that is on its way
    definition = codec.definition if codec else DEFAULT
    blank = bytes(codec_of(definition).size)  # in the place of another layout, invalid, so that it is decoded by itself
    own = arrivals[0][0].size  # -1 while it is not known what these are
    payloads = [payload if len(payload) == own else blank for _, payload, _, _ in arrivals]
    messages, valid = arrays_of(definition).decode(b"".join(payloads))
    if not valid.all():
        for index in np.flatnonzero(~valid).tolist():
            sample = decoder.decode(arrivals[index], rows=True)
            if sample is not None:
                messages[index] = sample.message
                valid[index] = True
        messages = messages[valid]
        arrivals = [arrivals[index] for index in np.flatnonzero(valid).tolist()]
    keys = [stream.key for stream, _, _, _ in arrivals]
    addresses = {stream.key: stream.address for stream, _, _, _ in arrivals}
    indices = {key: index for index, key in enumerate(addresses)}
    address_index = np.fromiter(map(indices.__getitem__, keys), np.intp, len(keys))
    return Batch(
        messages, definition.model, tuple(addresses.values()), address_index, received, lost, arrivals, decoder
    )
