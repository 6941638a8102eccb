"""Batches of received messages."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from nedbus.samples import Batch
from nedbus_msgs import DEFAULT, Provenance, codec_of, provenance_of
from nedbus_msgs.arrays import arrays_of

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
        return np.array([stamp.get_time_as_ntp64().as_nanos() if stamp else 0 for stamp in stamps], np.int64)

    @cached_property
    def sequence(self) -> npt.NDArray[np.int64]:
        """Publisher's sequence number of each message; -1 without one."""
        infos = (arrival.raw.source_info for arrival in self._arrivals)
        return np.array([info.source_sn if info else -1 for info in infos], np.int64)

    @cached_property
    def provenances(self) -> list[Provenance]:
        """Provenance of each message: its source and the fields that the source did not provide."""
        definition = self.message.DEFINITION
        return [provenance_of(definition, encoding_of(each.stream, each.raw)) for each in self._arrivals]


def make_batch(arrivals: Sequence[Arrival], decoder: Decoder, *, lost: int) -> ReceivedBatch:
    """Decode arrivals of one type into a batch; the decoder counts invalid ones, which are omitted."""
    arrivals = decoder.define(arrivals)
    codec = arrivals[0].codec
    definition = codec.definition if codec else DEFAULT
    blank = bytes(codec_of(definition).size)  # invalid placeholder for payloads of other layouts, decoded below
    own = codec.size if codec else -1
    payloads = [each.payload if len(each.payload) == own else blank for each in arrivals]
    arrays = arrays_of(definition)
    messages, valid = arrays.decode(b"".join(payloads))
    if not valid.all():
        for index in np.flatnonzero(~valid).tolist():
            sample = decoder.decode(arrivals[index], rows=True)
            if sample is not None:
                messages[index] = arrays.to_element(sample.message)
                valid[index] = True
        messages = messages[valid]
        arrivals = [arrivals[index] for index in np.flatnonzero(valid).tolist()]
    keys = [arrival.stream.key for arrival in arrivals]
    addresses = {arrival.stream.key: arrival.stream.address for arrival in arrivals}
    indices = {key: index for index, key in enumerate(addresses)}
    address_index = np.fromiter(map(indices.__getitem__, keys), np.intp, len(keys))
    return ReceivedBatch(messages, definition.model, tuple(addresses.values()), address_index, lost, arrivals)
