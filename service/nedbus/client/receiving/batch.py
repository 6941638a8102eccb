"""Batches of received messages."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from nedbus.samples import Batch
from nedbus_msgs import DEFAULT, Definition, Message, Provenance, codec_of, provenance_of
from nedbus_msgs.arrays import FEW_PAYLOADS, MessageArray, arrays_of

from .arrival import Arrival, encoding_of
from .decoder import Decoder


@dataclass(eq=False)
class ReceivedBatch(Batch):
    """Valid messages of one type from a bus, in order of arrival."""

    _arrivals: Sequence[Arrival] = field(repr=False)

    @cached_property
    def received(self) -> npt.NDArray[np.int64]:
        """Time at which each message left Zenoh's ring, ns since the epoch by the clock of this host."""
        return np.array([arrival.received for arrival in self._arrivals], np.int64)

    @cached_property
    def sent(self) -> npt.NDArray[np.int64]:
        """Time of sending of each message, ns since the epoch by the publisher's clock; 0 without a timestamp."""
        stamps = (arrival.raw.timestamp for arrival in self._arrivals)
        times = [stamp.get_time_as_ntp64().as_nanos() if stamp else 0 for stamp in stamps]
        return np.array(times, np.int64)

    @cached_property
    def sequence(self) -> npt.NDArray[np.int64]:
        """Publisher's sequence number of each message; -1 without one."""
        infos = (arrival.raw.source_info for arrival in self._arrivals)
        numbers = [info.source_sn if info else -1 for info in infos]
        return np.array(numbers, np.int64)

    @cached_property
    def provenances(self) -> list[Provenance]:
        """Provenance of each message: its source and the fields that the source did not provide."""
        definition = self.message.DEFINITION
        return [
            provenance_of(definition, encoding_of(arrival.stream, arrival.raw))
            for arrival in self._arrivals
        ]


def make_batch(arrivals: Sequence[Arrival], decoder: Decoder, *, lost: int) -> ReceivedBatch:
    """Decode arrivals of one type into a batch; the decoder counts invalid ones, which are omitted."""
    arrivals = decoder.define(arrivals)
    codec = arrivals[0].codec
    model: type[Message] = DEFAULT.model
    messages = None
    if codec is not None:
        model = codec.definition.model
        if len(arrivals) <= FEW_PAYLOADS:
            payloads = [arrival.payload for arrival in arrivals]
            messages = arrays_of(codec.definition).decode_few(payloads)
    if messages is None:
        messages, arrivals = _decode(arrivals, model.DEFINITION, decoder)
    streams = {arrival.stream.key: arrival.stream for arrival in arrivals}
    address_index = np.zeros(len(arrivals), np.intp)
    if len(streams) > 1:
        indices = {key: index for index, key in enumerate(streams)}
        address_index[:] = [indices[arrival.stream.key] for arrival in arrivals]
    addresses = tuple([stream.address for stream in streams.values()])
    return ReceivedBatch(messages, model, addresses, address_index, lost, arrivals)


def _decode(
    arrivals: Sequence[Arrival], definition: Definition[Any], decoder: Decoder
) -> tuple[MessageArray, Sequence[Arrival]]:
    """Decode arrivals; return the valid messages and their arrivals.

    An invalid placeholder stands for a payload of another layout, which is decoded alone.
    """
    arrays = arrays_of(definition)
    size = codec_of(definition).size
    placeholder = bytes(size)
    payloads = [
        arrival.payload
        if arrival.codec is not None and len(arrival.payload) == size
        else placeholder
        for arrival in arrivals
    ]
    messages, valid = arrays.decode(b"".join(payloads))
    if valid.all():
        return messages, arrivals
    for index in np.flatnonzero(~valid).tolist():
        sample = decoder.decode(arrivals[index], rows=True)
        if sample is not None:
            messages[index] = arrays.to_element(sample.message)
            valid[index] = True
    kept = np.flatnonzero(valid).tolist()
    return messages[valid], [arrivals[index] for index in kept]
