"""What arrived, by the thousand: one NumPy array of messages, with columns for where each came from and when."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
import zenoh

from nedbus_msgs import PAYLOAD_SIZE, Address, Origin, Row, origin_of
from nedbus_msgs.arrays import DTYPE, FEW, Records, read_records


@dataclass(eq=False)
class Batch:
    """Messages that arrived together, in the order of their arrival; all are valid.

    `messages`: structured array, one record a message, one column a field of VehicleLocalPosition: `messages["x"]`.
    `addresses`: the addresses that occur; `which`: for each message, the place of its address among them.
    `received`: when they were taken here, ns since the epoch.
    `lost`: messages that were lost on the way before these, all addresses together.
    """

    messages: Records
    addresses: tuple[Address, ...]
    which: npt.NDArray[np.intp]
    received: int
    lost: int
    raw: Sequence[zenoh.Sample] = field(repr=False)

    def __len__(self) -> int:
        return len(self.messages)

    def of(self, address: Address) -> Records:
        """Return the messages of one address."""
        if address not in self.addresses:
            return self.messages[:0]
        chosen: Records = self.messages[self.which == self.addresses.index(address)]
        return chosen

    @cached_property
    def sent(self) -> npt.NDArray[np.int64]:
        """When each was sent, ns since the epoch by its publisher's clock; 0 if that did not say."""
        stamps = (raw.timestamp for raw in self.raw)
        return np.array([stamp.get_time_as_ntp64().as_nanos() if stamp else 0 for stamp in stamps], np.int64)

    @cached_property
    def sequence(self) -> npt.NDArray[np.int64]:
        """Each one's number in the sequence of its publisher; -1 if that has none."""
        infos = (raw.source_info for raw in self.raw)
        return np.array([info.source_sn if info else -1 for info in infos], np.int64)

    @cached_property
    def origins(self) -> list[Origin]:
        """Where each comes from, and what that source did not provide."""
        return [origin_of(str(raw.encoding)) for raw in self.raw]


def make_batch(
    raw: Sequence[zenoh.Sample],
    keys: Sequence[str],
    addresses: Mapping[str, Address],
    *,
    received: int,
    lost: int,
    judge: Callable[[zenoh.Sample], Row | None],
) -> Batch:
    """Return the batch of what arrived on these keys, of which some may have no address.

    `judge` gives the row of one that needs a closer look, None if it is invalid.
    """
    if len(raw) < FEW:
        judged = list(map(judge, raw))
        messages = np.array([row for row in judged if row is not None], DTYPE)
        valid = np.array([row is not None for row in judged])
    else:
        messages, valid = _read(raw, keys, addresses, judge)
    if not valid.all():
        kept = np.flatnonzero(valid).tolist()
        raw, keys = [raw[place] for place in kept], [keys[place] for place in kept]
    places = {key: place for place, key in enumerate(dict.fromkeys(keys))}
    which = np.fromiter(map(places.__getitem__, keys), np.intp, len(keys))
    return Batch(messages, tuple(addresses[key] for key in places), which, received, lost, raw)


def _read(
    raw: Sequence[zenoh.Sample],
    keys: Sequence[str],
    addresses: Mapping[str, Address],
    judge: Callable[[zenoh.Sample], Row | None],
) -> tuple[Records, npt.NDArray[np.bool_]]:
    """Return the valid messages, and which of all were valid."""
    payloads = [sample.payload.to_bytes() for sample in raw]
    if set(map(len, payloads)) != {PAYLOAD_SIZE}:
        payloads = [payload if len(payload) == PAYLOAD_SIZE else bytes(PAYLOAD_SIZE) for payload in payloads]
    messages, valid = read_records(b"".join(payloads))
    if len(addresses) < len(set(keys)):
        valid &= [key in addresses for key in keys]
    if valid.all():
        return messages, valid
    for place in np.flatnonzero(~valid).tolist():
        row = judge(raw[place])
        if row is not None:
            messages[place] = row
            valid[place] = True
    return messages[valid], valid
