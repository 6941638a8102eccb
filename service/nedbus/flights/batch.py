"""Batches of a flight's messages."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from nedbus.samples import Batch
from nedbus_msgs import Address, Definition, Encoded, Provenance
from nedbus_msgs.arrays import arrays_of


@dataclass(eq=False)
class FlightBatch(Batch):
    """Valid messages of one type from a flight, in the order of their log times."""

    _received: Sequence[int] = field(repr=False)
    _provenances: list[Provenance] = field(repr=False)

    @property
    def received(self) -> npt.NDArray[np.int64]:
        """Log time of each message [ns]."""
        return np.array(self._received, np.int64)

    @property
    def sent(self) -> npt.NDArray[np.int64]:
        """Zeros: files have no time of sending."""
        return np.zeros(len(self), np.int64)

    @property
    def sequence(self) -> npt.NDArray[np.int64]:
        """Only -1: files have no sequence numbers of a publisher."""
        return np.full(len(self), -1, np.int64)

    @property
    def provenances(self) -> list[Provenance]:
        """Provenance of each message: its source and the fields that the source did not provide."""
        return self._provenances


def make_batches(
    messages: Sequence[tuple[Address, Definition[Any], Encoded, int, Provenance]],
) -> Iterator[FlightBatch]:
    """Yield a batch for each type among these messages: address, definition, payload, log time [ns] and provenance."""
    by_definition: dict[Definition[Any], list[tuple[Address, Definition[Any], Encoded, int, Provenance]]] = {}
    for each in messages:
        by_definition.setdefault(each[1], []).append(each)
    for definition, own in by_definition.items():
        addresses, _, encoded, received, provenances = zip(*own, strict=True)
        arrays, _ = arrays_of(definition).decode(b"".join(each.payload for each in encoded))
        indices = {address: index for index, address in enumerate(dict.fromkeys(addresses))}
        index = np.fromiter(map(indices.__getitem__, addresses), np.intp, len(own))
        yield FlightBatch(arrays, definition.model, tuple(indices), index, 0, received, list(provenances))
