"""The two kinds of sources, replays and live ones, and the messages that they yield."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from nedbus.transport import Session, Tls
from nedbus_msgs import Address, Definition


@dataclass(frozen=True, slots=True)
class SourceMessage:
    """One message as a source has it, not validated yet.

    `due`: in a replay, seconds since the start of its recording; a live message is due when it arrives.
    `fields`: by name, of any PX4 layout.
    `lost`: messages that were lost between the vehicle and the source, just before this one.
    `rebooted`: this is the first message after the vehicle rebooted.
    `error`: why it cannot be decoded, if so; it has no fields then.
    `definition`: that of its message, None for that of its topic.
    """

    due: float
    address: Address
    fields: Mapping[str, object]
    lost: int = 0
    rebooted: bool = False
    error: str | None = None
    definition: Definition[Any] | None = None


@dataclass(frozen=True, slots=True)
class Rejection:
    """Input that a live source could not turn into a message.

    `where`: the key, the link or the address that it came from; the log names each one once.
    `count`: the number of messages that it stands for.
    """

    where: str
    reason: str
    address: Address | None = None
    count: int = 1


@dataclass(frozen=True, slots=True)
class Absence:
    """Topics that vehicles publish and a live source does not deliver; yielded when they change.

    `not_carried`: messages that have no definition here.
    `silent`: addresses that are announced, and of which nothing arrives while other topics of their vehicles do.
    """

    not_carried: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ReplayRun:
    """One run of a replay.

    `messages`: in order of `due`; can be iterated once.
    `addresses`: every address that occurs in the messages, with the definition of these, None for that of its topic.
    `total`: the number of messages, None if they never end.
    `summary`: a description for the log; `warnings`: damage, and parts that are left out.
    `damage`: the cost of damage, if messages were lost; at its end the run has failed then.
    """

    messages: Iterator[SourceMessage]
    addresses: Mapping[Address, Definition[Any] | None]
    total: int | None
    summary: str
    warnings: tuple[str, ...] = ()
    damage: str | None = None


@dataclass(frozen=True, slots=True)
class SourceContext:
    """Settings of the service that runs a source.

    `vehicle`: the default for a source that has no vehicle name of its own.
    `routers`: endpoints of the service's router, and `tls` to connect to them.
    """

    vehicle: str
    routers: tuple[str, ...] = ()
    tls: Tls | None = None


class ReplaySource(Protocol):
    """A source that can be replayed, once or repeatedly.

    `finite`: it ends by itself; `loop`: it starts again at its end; `wait`: it starts when there is a subscriber.
    `speed`: the factor of real time; None for as fast as readers receive it, without loss.
    """

    finite: bool
    loop: bool
    wait: bool
    speed: float | None

    def open(self) -> ReplayRun:
        """Open it for one run; raise SourceError when it cannot be opened or has no messages."""
        ...


@runtime_checkable
class LiveSource(Protocol):
    """A source that receives from vehicles; which addresses it has is known when messages arrive."""

    def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | Absence | None]:
        """Yield events until the iterator is closed, and None at least twice a second when there is none.

        `router`: the session of the service where that is a router itself; it is lent, and must not be closed.

        Raises SourceError when it cannot be opened, or when the connection breaks.
        """
        ...


Source = ReplaySource | LiveSource
