"""Sample, one message that arrived, and Counts of a subscription."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Generic, Literal

from typing_extensions import TypeVar

from nedbus_msgs import Address, Message, Provenance, VehicleLocalPosition

if TYPE_CHECKING:
    import zenoh

Mode = Literal["latest", "every"]  # of each key a slow reader gets the newest message, or every message
M_co = TypeVar("M_co", bound=Message, default=VehicleLocalPosition, covariant=True)

_UNKNOWN: Final = Provenance()


@dataclass(slots=True, eq=False)
class Sample(Generic[M_co]):
    """One message that arrived.

    `message`: the validated message; from `rows()` a Row, which has the same fields.
    `address`: vehicle, topic and instance, also as attributes of their own.
    `received`: when it was decoded here, ns since the epoch.
    `stamp`: Zenoh's timestamp, with the id of the clock; None without one, and in a copy.
    `lost`: messages of this key that were lost in transit just before this one.
    `provenance`: the source and the fields that it did not provide, also as `source` and `missing`.
    `stored`: from `bus.latest()` only: no publisher answers for this address, but a storage that kept its last message.
    """

    message: M_co
    address: Address
    received: int
    stamp: zenoh.Timestamp | None = None
    lost: int = 0
    provenance: Provenance = _UNKNOWN
    stored: bool = False
    _sent: int | None = None  # of a copy, as Zenoh's timestamp cannot be pickled

    @property
    def sent(self) -> int | None:
        """When its publisher sent it, ns since the epoch by the publisher's clock; None without a timestamp."""
        return self._sent if self.stamp is None else self.stamp.get_time_as_ntp64().as_nanos()

    @property
    def vehicle(self) -> str:
        """The vehicle."""
        return self.address.vehicle

    @property
    def topic(self) -> str:
        """The uORB topic."""
        return self.address.topic

    @property
    def instance(self) -> int | None:
        """The uORB instance, where the topic has instances."""
        return self.address.instance

    @property
    def source(self) -> str | None:
        """The kind of source, such as `sim`, `ulog`, `px4-zenoh` or `mavlink`; None if its publisher set none."""
        return self.provenance.source

    @property
    def missing(self) -> frozenset[str]:
        """The fields that the source did not provide; they hold NaN, false or 0."""
        message = self.message
        if isinstance(message, Message):  # of an older layout perhaps, by another encoder
            return self.provenance.missing | (message.DEFINITION.all_fields - message.model_fields_set)
        return self.provenance.missing

    @property
    def latency(self) -> float | None:
        """Seconds from sent to received, None without a timestamp; as good as the two hosts' clocks agree."""
        sent = self.sent
        return None if sent is None else (self.received - sent) / 1e9

    def __eq__(self, other: object) -> bool:
        """Compare everything; NaN equals NaN in a Message."""
        return self._state() == other._state() if isinstance(other, Sample) else NotImplemented

    def __hash__(self) -> int:
        return hash((self.address, self.received, self.message.timestamp))

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), self._state()

    def _state(self) -> tuple[object, ...]:
        return self.message, self.address, self.received, None, self.lost, self.provenance, self.stored, self.sent


@dataclass(frozen=True, slots=True)
class Counts:
    """Counts of the messages of a subscription.

    `received`: handed to the reader.
    `lost`: lost in transit, and not recovered.
    `dropped`: arrived, but not read in time: superseded in mode "latest", beyond 65,536 that wait in mode "every".
    `invalid`: not a valid message, or not a valid key; the log gives the reason once for each key.
    `discarded`: came twice, or too late, as another process sends under the id of a publisher, perhaps.
    """

    received: int = 0
    lost: int = 0
    dropped: int = 0
    invalid: int = 0
    discarded: int = 0
