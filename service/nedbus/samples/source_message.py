"""Messages of vehicles as sources and files provide them, not yet validated."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from nedbus_msgs import BY_TOPIC, Address, Definition, Encoded, InvalidMessageError, encode_upgraded


class RecordStream(Protocol):
    """Decoder of the payloads of one stream of records with the same fields."""

    @property
    def timestamp(self) -> Callable[[bytes], tuple[int | None]]:
        """Return the timestamp of a payload [us], or None if it has none, in a tuple."""

    @property
    def encode_valid(self) -> Callable[[bytes], Encoded | None]:
        """Validate and encode a payload; return None for one that it does not accept."""

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Return the fields of a payload by name, in any PX4 layout."""


@dataclass(slots=True)  # not frozen, because that would take four times as long to create
class SourceMessage:
    """One message from a source, not yet validated.

    `at`: in a flight, seconds since its first message, pauses included; 0 for a live message.
    `given`: the fields by name, in any PX4 layout; None for those of a `payload` of the stream `logged`.
    `lost`: number of messages lost between the vehicle and the source, just before this one.
    `rebooted`: True for the first message after the vehicle rebooted.
    `error`: why the message was rejected (`given` is then empty); None if it was decoded.
    `definition`: message definition; None for the default of the topic.
    `source`: value of `sample.source`, if it differs from the kind of the source.
    `time`: in a file, its log time [us]; without one, its timestamp.
    `dropout`: seconds for which the vehicle's logger recorded nothing, just before this message.
    `arrived`: when a live message arrived, on the host's monotonic clock [s]; 0 for now.
    """

    at: float
    address: Address
    given: Mapping[str, object] | None
    lost: int = 0
    rebooted: bool = False
    error: str | None = None
    definition: Definition[Any] | None = None
    source: str | None = None
    dropout: float = 0.0
    logged: RecordStream | None = None
    payload: Any = b""
    time: int = 0
    arrived: float = 0.0

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
        if self.error is not None:
            raise InvalidMessageError(
                self.error, [("message", "not decodable")], message=self.address.topic
            )
        if (
            self.given is None
            and self.logged is not None
            and (encoded := self.logged.encode_valid(self.payload))
        ):
            return encoded
        return encode_upgraded(self.definition or BY_TOPIC[self.address.topic], self.fields)


@dataclass(frozen=True, slots=True)
class Rejection:
    """Input that a live source could not convert; each `where` (key, link or address) is logged once."""

    where: str
    reason: str
    address: Address | None = None
    count: int = 1
