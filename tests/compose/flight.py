"""What the simulated vehicle publishes, to compare with what arrived: the same seed gives the same flight."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from nedbus.sources import Record
from nedbus_msgs import Address, VehicleLocalPosition, upgrade
from tests.replays import open_replay


class Flight:
    """The messages of a simulated source, each with its place in the sequence of its address."""

    def __init__(self, source: str = "sim:") -> None:
        self._records: Iterator[Record] = open_replay(source).records
        self._known: dict[tuple[Address, int], tuple[int, VehicleLocalPosition]] = {}
        self._counts: dict[Address, int] = {}

    def places(self, arrived: Iterable[tuple[Address, VehicleLocalPosition]]) -> dict[Address, list[int]]:
        """Return, for each address, the places of its messages in the order of their arrival; all must be right."""
        places: dict[Address, list[int]] = {}
        for address, message in arrived:
            place, right = self._find(address, message.timestamp)
            assert message == right, f"{address} at {message.timestamp}"
            places.setdefault(address, []).append(place)
        return places

    def last(self, address: Address) -> VehicleLocalPosition:
        """Return the last message of an address; the flight must have an end."""
        *_, last = (record for record in self._records if record.address == address)
        return upgrade(last.fields)

    def _find(self, address: Address, timestamp: int) -> tuple[int, VehicleLocalPosition]:
        while (address, timestamp) not in self._known:
            record = next(self._records)
            message = upgrade(record.fields)
            place = self._counts.get(record.address, 0)
            self._counts[record.address] = place + 1
            self._known[record.address, message.timestamp] = place, message
        return self._known[address, timestamp]


def is_whole(places: list[int]) -> bool:
    """Return whether nothing is missing, doubled or out of order."""
    return places == list(range(places[0], places[0] + len(places)))


def missing(places: list[int]) -> int:
    """Return how many are missing between the first and the last."""
    return places[-1] - places[0] + 1 - len(set(places))
