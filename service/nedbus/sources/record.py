"""What a source gives: a replay has a flight of records in time order, a live source has records as they come."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from nedbus.session import Tls
from nedbus_msgs import Address


@dataclass(frozen=True, slots=True)
class Record:
    """One message as a source has it, not validated yet.

    `due`: seconds since the start of the flight when it was published there; a live record is due when it comes.
    `fields`: by name, of any PX4 layout.
    `lost`: messages that were lost on the way to here just before this one.
    `restarted`: this is the first one after the vehicle started again.
    """

    due: float
    address: Address
    fields: Mapping[str, object]
    lost: int = 0
    restarted: bool = False


@dataclass(frozen=True, slots=True)
class Refusal:
    """Something that arrived and is no message, or several of it; `where` it came from is told of once."""

    where: str
    reason: str
    address: Address | None = None
    count: int = 1


@dataclass(frozen=True, slots=True)
class Flight:
    """One run of a replay.

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


@dataclass(frozen=True, slots=True)
class Home:
    """What a source may need of the service that it works for.

    `vehicle`: for a source that neither names nor knows one; `routers`: where that service is reached, and with what.
    """

    vehicle: str
    routers: tuple[str, ...] = ()
    tls: Tls | None = None


class Replay(Protocol):
    """A source that can be flown, once or again and again."""

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


@runtime_checkable
class Live(Protocol):
    """A source that is listened to, and that nobody knows beforehand what it will say."""

    def listen(self) -> Iterator[Record | Refusal | None]:
        """Listen until the iterator is closed; None says that nothing came for a moment, at least twice a second.

        Raises SourceError when it cannot be listened to, or no more.
        """
        ...


Source = Replay | Live
