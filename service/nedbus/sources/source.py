"""The two kinds of sources, replay and live, and the messages they yield."""

from collections.abc import Callable, Iterator, MutableMapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from nedbus.samples import LogStreamStatus, PositionStatus, Rejection, SourceMessage
from nedbus.transport import Session
from nedbus_msgs import Address

from .options import RecordedOptions, SimulatorOptions


@dataclass(frozen=True, slots=True)
class LinkLoad:
    """How well this host keeps up with a link; yielded on change.

    `dropped`: messages that this host has dropped, which count as lost, too. `overload`: description of an overload,
    "" if there is none.
    """

    dropped: int = 0
    overload: str = ""


@dataclass(frozen=True, slots=True)
class LinkCopies:
    """Messages that came again, or late, over a second link to their vehicle, and were left out; yielded on change.

    `count`: of all vehicles of a source.
    """

    count: int = 0


@dataclass(frozen=True, slots=True)
class UnavailableTopics:
    """Topics that vehicles announce but a live source does not deliver; yielded on change.

    `unsupported`: names of messages that have no definition, or are not selected.
    `silent`: announced addresses without messages, while other topics of the same vehicle arrive.
    """

    unsupported: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()


@dataclass(slots=True)
class ReplayRun:
    """One run of a replay; its attributes are updated while the messages are iterated.

    `messages`: in order of `at`; can be iterated once.
    `addresses`: addresses of the messages so far, each with its definition, or None for the topic's default.
    `total`: number of messages, or of bytes if `position` is set; None if endless.
    `summary`: description for the log; `warnings`: damage and skipped parts.
    `damage`: description of damage that cost messages, and makes the run fail; None if no message was lost.
    `position`: returns the bytes read so far; None if progress is counted in messages.
    `boot_utc`: Unix time of the vehicle's boot [us], from the metadata of the file; 0 if unknown.
    """

    messages: Iterator[SourceMessage]
    addresses: MutableMapping[Address, Any]
    total: int | None
    summary: str
    warnings: tuple[str, ...] = ()
    damage: str | None = None
    position: Callable[[], int] | None = None
    boot_utc: int = 0

    def done(self, messages: int) -> int:
        """Return the progress towards `total`, given the number of messages so far."""
        return messages if self.position is None else self.position()


@dataclass(frozen=True, slots=True)
class ReplaySource:
    """A source that can be replayed repeatedly; `open` raises SourceError if there is no readable message."""

    options: RecordedOptions | SimulatorOptions
    open: Callable[[], ReplayRun]

    @property
    def finite(self) -> bool:
        """True if the replay has an end."""
        options = self.options
        return (
            options.duration is not None
            if isinstance(options, SimulatorOptions)
            else not options.loop
        )


LiveItem = (
    SourceMessage
    | Rejection
    | UnavailableTopics
    | LinkLoad
    | LinkCopies
    | LogStreamStatus
    | PositionStatus
    | None
)


@runtime_checkable
class LiveSource(Protocol):
    """A source that receives from vehicles; its addresses become known as messages arrive."""

    def listen(self, router: Session | None) -> Iterator[LiveItem]:
        """Yield events until the iterator is closed; yield None at least twice a second while idle.

        `router`: the service's Zenoh session if the service is a router; borrowed, so do not close it.

        Raises SourceError if the source cannot be opened or the connection breaks.
        """


Source = ReplaySource | LiveSource
