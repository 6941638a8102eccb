"""Sample, a received message with its metadata, and Counts, the statistics of a subscription."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Generic, Literal, TypedDict

from typing_extensions import TypeVar

from nedbus_msgs import Address, Message, Provenance, VehicleLocalPosition, VehicleNames

if TYPE_CHECKING:
    import zenoh

# a slow reader gets the newest message of each key, or every message
Mode = Literal["latest", "every"]
M_co = TypeVar("M_co", bound=Message, default=VehicleLocalPosition, covariant=True)

M2 = TypeVar("M2", bound=Message)  # of further topics of a subscription
M3 = TypeVar("M3", bound=Message)


class Query(TypedDict, total=False):
    """Options of `latest`."""

    vehicle: VehicleNames
    instance: int | None
    timeout: float


class Subscribe(TypedDict, total=False):
    """Options of `subscribe`."""

    vehicle: VehicleNames
    instance: int | None
    mode: Mode
    max_rate: float | None
    limit: int | None


_UNKNOWN: Final = Provenance()


@dataclass(slots=True, eq=False)
class Sample(Generic[M_co]):
    """A received message with its metadata.

    `message`: the validated message; from `rows()`, a Row with the same fields.
    `address`: vehicle, topic and instance, also available as attributes.
    `received`: time at which it left Zenoh's ring buffer, before it was read; ns since the epoch by this host's clock.
    `stamp`: Zenoh's timestamp with its clock id; None if the publisher sent none, and in copies.
    `lost`: messages of this key lost in transit just before this one.
    `provenance`: the source and the fields it did not provide, also available as `source` and `missing`.
    `retained`: True for a publisher's last message before the subscription, and for samples from `bus.latest()`.
    `stored`: True if it came from a storage because no publisher of the address replied; `bus.latest()` only.
    """

    message: M_co
    address: Address
    received: int
    stamp: zenoh.Timestamp | None = None
    lost: int = 0
    provenance: Provenance = _UNKNOWN
    retained: bool = False
    stored: bool = False
    _sent: int | None = None  # set in copies, because Zenoh's timestamp cannot be pickled

    @property
    def sent(self) -> int | None:
        """Time of sending, ns since the epoch by the publisher's clock; None without a timestamp."""
        return self._sent if self.stamp is None else self.stamp.get_time_as_ntp64().as_nanos()

    @property
    def vehicle(self) -> str:
        """The vehicle id."""
        return self.address.vehicle

    @property
    def topic(self) -> str:
        """The uORB topic."""
        return self.address.topic

    @property
    def instance(self) -> int | None:
        """The uORB instance; None for a topic without instances."""
        return self.address.instance

    @property
    def source(self) -> str | None:
        """The kind of source, such as `sim`, `ulog`, `px4-zenoh` or `mavlink`; None if the publisher set none."""
        return self.provenance.source

    @property
    def missing(self) -> frozenset[str]:
        """The fields that the source did not provide; they hold NaN, false or 0."""
        message = self.message
        if isinstance(message, Message):  # another encoder may have used an older layout
            return self.provenance.missing | (
                message.DEFINITION.all_fields - message.model_fields_set
            )
        return self.provenance.missing

    @property
    def latency(self) -> float | None:
        """Seconds from `sent` to `received`, None without a timestamp; includes the offset between the two clocks."""
        sent = self.sent
        return None if sent is None else (self.received - sent) / 1e9

    def __eq__(self, other: object) -> bool:
        """Compare all fields; NaN equals NaN in a Message."""
        return self._state() == other._state() if isinstance(other, Sample) else NotImplemented

    def __hash__(self) -> int:
        return hash((self.address, self.received, self.message.timestamp))

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), self._state()

    def _state(self) -> tuple[object, ...]:
        flags = self.retained, self.stored
        return (
            self.message,
            self.address,
            self.received,
            None,
            self.lost,
            self.provenance,
            *flags,
            self.sent,
        )


@dataclass(frozen=True, slots=True)
class Counts:
    """Message counts of a subscription.

    `received`: returned to the caller.
    `lost`: lost in transit and not recovered.
    `dropped`: arrived but not read in time: superseded in mode "latest", beyond the limit of unread
    messages or of 64 MiB, or unread when the subscription was closed.
    `invalid`: invalid message or key; the log gives the reason once per key.
    `discarded`: duplicate or too late, for example because two processes publish under the same id.
    `forgotten`: keys evicted beyond the limit of 10,000, least recently active first; `lost` omits their next gap.
    """

    received: int = 0
    lost: int = 0
    dropped: int = 0
    invalid: int = 0
    discarded: int = 0
    forgotten: int = 0
