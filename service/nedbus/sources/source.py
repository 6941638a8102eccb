"""The two kinds of sources, replay and live, and the messages they yield."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from nedbus.client import LogStreamStatus
from nedbus.transport import Session
from nedbus.ulog import LoggedStream
from nedbus_msgs import BY_TOPIC, Address, Definition, Encoded, encode_upgraded

from .options import RecordedOptions, SimulatorOptions


@dataclass(slots=True)  # not frozen, because that would take four times as long to create
class SourceMessage:
    """One message from a source, not yet validated.

    `due`: in a replay, seconds since the start of the recording; of a live message, its arrival, monotonic, or 0.
    `given`: the fields by name, in any PX4 layout; None for those of a `payload` of the stream `logged`.
    `lost`: number of messages lost between the vehicle and the source, just before this one.
    `rebooted`: True for the first message after the vehicle rebooted.
    `error`: why the message was rejected (`given` is then empty); None if it was decoded.
    `definition`: message definition; None for the default of the topic.
    `source`: value of `sample.source`, if it differs from the kind of the source.
    `dropout`: seconds for which the vehicle's logger recorded nothing, just before this message.
    """

    due: float
    address: Address
    given: Mapping[str, object] | None
    lost: int = 0
    rebooted: bool = False
    error: str | None = None
    definition: Definition[Any] | None = None
    source: str | None = None
    dropout: float = 0.0
    logged: LoggedStream | None = None
    payload: bytes = b""

    @property
    def fields(self) -> Mapping[str, object]:
        """The fields by name, in any PX4 layout."""
        if self.given is None:
            self.given = {} if self.logged is None else self.logged.decode(self.payload)
        return self.given

    @property
    def timestamp(self) -> Any:
        """The value of `timestamp`, None without one."""
        if self.given is None and self.logged is not None:
            return self.logged.timestamp(self.payload)[0]
        return self.fields.get("timestamp")

    def encode(self) -> Encoded:
        """Validate and encode the message; raise InvalidMessageError."""
        if self.given is None and self.logged is not None and (encoded := self.logged.encode_valid(self.payload)):
            return encoded
        return encode_upgraded(self.definition or BY_TOPIC[self.address.topic], self.fields)


@dataclass(frozen=True, slots=True)
class Rejection:
    """Input that a live source could not convert; each `where` (key, link or address) is logged once."""

    where: str
    reason: str
    address: Address | None = None
    count: int = 1


@dataclass(frozen=True, slots=True)
class LinkLoad:
    """How well this host keeps up with a link; yielded on change.

    `dropped`: messages that this host has dropped, which count as lost, too. `overload`: description of an overload,
    "" if there is none.
    """

    dropped: int = 0
    overload: str = ""


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

    `messages`: in order of `due`; can be iterated once.
    `addresses`: addresses of the messages so far, each with its definition, or None for the topic's default.
    `total`: number of messages, or of bytes if `position` is set; None if endless.
    `summary`: description for the log; `warnings`: damage and skipped parts.
    `damage`: description of damage that cost messages, and makes the run fail; None if no message was lost.
    `position`: bytes read so far; None if progress is counted in messages.
    `boot_utc`: Unix time of the vehicle's boot [us], from the metadata of the file; 0 if unknown.
    """

    messages: Iterator[SourceMessage]
    addresses: dict[Address, Definition[Any] | None]
    total: int | None
    summary: str
    warnings: tuple[str, ...] = ()
    damage: str | None = None
    position: int | None = None
    boot_utc: int = 0

    def done(self, messages: int) -> int:
        """Return the progress towards `total`, given the number of messages so far."""
        return messages if self.position is None else self.position


@dataclass(frozen=True, slots=True)
class ReplaySource:
    """A source that can be replayed repeatedly; `open` raises SourceError if there is no readable message."""

    options: RecordedOptions | SimulatorOptions
    open: Callable[[], ReplayRun]

    @property
    def finite(self) -> bool:
        """True if the replay has an end."""
        options = self.options
        return options.duration is not None if isinstance(options, SimulatorOptions) else not options.loop


LiveItem = SourceMessage | Rejection | UnavailableTopics | LinkLoad | LogStreamStatus | None


@runtime_checkable
class LiveSource(Protocol):
    """A source that receives from vehicles; its addresses become known as messages arrive."""

    def listen(self, router: Session | None) -> Iterator[LiveItem]:
        """Yield events until the iterator is closed; yield None at least twice a second while idle.

        `router`: the service's Zenoh session if the service is a router; borrowed, so do not close it.

        Raises SourceError if the source cannot be opened or the connection breaks.
        """


Source = ReplaySource | LiveSource
