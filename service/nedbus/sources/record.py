"""What a source gives: a flight of records in time order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from nedbus_msgs import Address


@dataclass(frozen=True, slots=True)
class Record:
    """One message as a source has it, not validated yet.

    `due`: seconds since the start of the flight when it was published there.
    `fields`: by name, of any PX4 layout.
    """

    due: float
    address: Address
    fields: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class Flight:
    """One run of a source.

    `records`: in order of `due`, read once.
    `addresses`: every address that the records have.
    `total`: how many records there are, None if they never end.
    `summary`: what it is, for the log; `warnings`: what is wrong with it, though it can be read.
    """

    records: Iterator[Record]
    addresses: tuple[Address, ...]
    total: int | None
    summary: str
    warnings: tuple[str, ...] = field(default=())


class Source(Protocol):
    """Something that can be flown, once or again and again."""

    @property
    def finite(self) -> bool:
        """Whether it ends by itself."""
        ...

    @property
    def loop(self) -> bool:
        """Whether it starts again when it has ended."""
        ...

    @property
    def speed(self) -> float | None:
        """How many times faster than it was flown; None for as fast as readers can take it, losing nothing."""
        ...

    @property
    def wait(self) -> bool:
        """Whether to start only when a subscriber is there."""
        ...

    def open(self) -> Flight:
        """Open it; raise SourceError when it cannot be opened or has nothing to give."""
        ...
