"""A subscriber on the host that stores all samples, and the simulated flight to compare them with."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from typing import Any

import nedbus
from nedbus.sources import SourceMessage
from nedbus_msgs import BY_TOPIC, Address, Message, upgrade_with
from tests.flights.replays import open_replay
from tests.waits import DEADLINE, wait_for


class Recorder:
    """Read a subscription in a thread and store all samples."""

    def __init__(self, subscription: nedbus.Subscription[Any]) -> None:
        self.subscription = subscription
        self.samples: list[nedbus.Sample[Any]] = []
        self.unseen = 0  # messages that may have been superseded before the first sample
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for sample in self.subscription:
            if not self.samples:
                self.unseen = self.subscription.counts.dropped
            self.samples.append(sample)

    def wait_for_more(self, count: int, *, seconds: float = DEADLINE) -> float:
        """Wait for `count` new samples, and return the duration [s]."""
        start, before = time.monotonic(), len(self.samples)
        wait_for(
            lambda: len(self.samples) >= before + count,
            what=f"{count} more samples",
            seconds=seconds,
        )
        return time.monotonic() - start

    def of(self, address: Address) -> list[nedbus.Sample[Any]]:
        """Return the samples of one address so far."""
        return [sample for sample in list(self.samples) if sample.address == address]

    def close(self) -> None:
        self.subscription.close()
        self._thread.join(DEADLINE)


def indices(samples: list[nedbus.Sample[Any]], flight: Flight) -> list[int]:
    """Return the indices of these samples of one address in its flight; assert that all values are correct."""
    return flight.indices((sample.address, sample.message) for sample in samples).popitem()[1]


class Flight:
    """The messages of a simulated source, which are the same in each run, with their index per address."""

    def __init__(self, source: str = "sim:") -> None:
        self._messages: Iterator[SourceMessage] = open_replay(source).messages
        self._known: dict[tuple[Address, int], tuple[int, Message]] = {}
        self._counts: dict[Address, int] = {}

    def indices(self, arrived: Iterable[tuple[Address, Message]]) -> dict[Address, list[int]]:
        """Return the indices of the messages of each address in order of arrival; assert that all are correct."""
        indices: dict[Address, list[int]] = {}
        for address, message in arrived:
            index, expected = self._find(address, message.timestamp)
            assert message == expected, f"{address} at {message.timestamp}"
            indices.setdefault(address, []).append(index)
        return indices

    def last(self, address: Address) -> Message:
        """Return the last message of an address; the flight must be finite."""
        *_, last = (each for each in self._messages if each.address == address)
        message: Message = upgrade_with(BY_TOPIC[address.topic], last.fields)
        return message

    def _find(self, address: Address, timestamp: int) -> tuple[int, Message]:
        while (address, timestamp) not in self._known:
            published = next(self._messages)
            message = upgrade_with(BY_TOPIC[published.address.topic], published.fields)
            index = self._counts.get(published.address, 0)
            self._counts[published.address] = index + 1
            self._known[published.address, message.timestamp] = index, message
        return self._known[address, timestamp]


def is_complete(indices: list[int]) -> bool:
    """Return whether no message is missing, duplicated or out of order."""
    return indices == list(range(indices[0], indices[0] + len(indices)))


def missing(indices: list[int]) -> int:
    """Return the number of messages missing between the first and the last."""
    return indices[-1] - indices[0] + 1 - len(set(indices))
