"""What the simulated vehicle publishes, to compare with what arrived: the same seed gives the same flight."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from nedbus.sources import SourceMessage
from nedbus_msgs import Address, VehicleLocalPosition, upgrade
from tests.replays import open_replay


class Flight:
    """The messages of a simulated source, each with its index in the sequence of its address."""

    def __init__(self, source: str = "sim:") -> None:
        self._messages: Iterator[SourceMessage] = open_replay(source).messages
        self._known: dict[tuple[Address, int], tuple[int, VehicleLocalPosition]] = {}
        self._counts: dict[Address, int] = {}

    def indices(self, arrived: Iterable[tuple[Address, VehicleLocalPosition]]) -> dict[Address, list[int]]:
        """Return, for each address, the indices of its messages in the order of their arrival; all must be right."""
        indices: dict[Address, list[int]] = {}
        for address, message in arrived:
            index, right = self._find(address, message.timestamp)
            assert message == right, f"{address} at {message.timestamp}"
            indices.setdefault(address, []).append(index)
        return indices

    def last(self, address: Address) -> VehicleLocalPosition:
        """Return the last message of an address; the flight must have an end."""
        *_, last = (each for each in self._messages if each.address == address)
        return upgrade(last.fields)

    def _find(self, address: Address, timestamp: int) -> tuple[int, VehicleLocalPosition]:
        while (address, timestamp) not in self._known:
            published = next(self._messages)
            message = upgrade(published.fields)
            index = self._counts.get(published.address, 0)
            self._counts[published.address] = index + 1
            self._known[published.address, message.timestamp] = index, message
        return self._known[address, timestamp]


def is_whole(indices: list[int]) -> bool:
    """Return whether nothing is missing, doubled or out of order."""
    return indices == list(range(indices[0], indices[0] + len(indices)))


def missing(indices: list[int]) -> int:
    """Return how many are missing between the first and the last."""
    return indices[-1] - indices[0] + 1 - len(set(indices))
