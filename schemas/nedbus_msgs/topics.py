"""The one table of the four topics, addresses and selections of them, and their key expressions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, cast

from .errors import AddressError

ANY: Final = "*"
DEFAULT_TOPIC: Final = "vehicle_local_position"
DEFAULT_PREFIX: Final = "nedbus"
ENCODING: Final = "application/msgpack;px4_msgs/VehicleLocalPosition"
"""Zenoh encoding of a payload; a payload can be decoded without it."""

_CHUNK = re.compile(r"[A-Za-z0-9_-]+")
_VEHICLE_LENGTH: Final = 64
_RATE: Final = "/@rate/"  # between the key of a stream and the messages a second to which it is thinned
_INSTANCES: Final = 256  # uORB's multi_id in a log is a uint8


@dataclass(frozen=True, slots=True)
class Topic:
    """One uORB topic.

    `instances`: it has uORB instances, one per EKF.
    `rate`: the nominal rate at which PX4 publishes or logs it [Hz].
    `doc`: who publishes it.
    """

    name: str
    instances: bool
    rate: float
    doc: str


TOPICS: Final[Mapping[str, Topic]] = {
    topic.name: topic
    for topic in (
        Topic("vehicle_local_position", False, 100.0, "EKF2, or the EKF2 selector of several"),
        Topic("vehicle_local_position_groundtruth", False, 50.0, "simulators (SITL, HITL)"),
        Topic("external_ins_local_position", False, 50.0, "an external INS driver (VectorNav, ...)"),
        Topic("estimator_local_position", True, 2.0, "each EKF instance, when several run"),
    )
}


@dataclass(frozen=True, slots=True, order=True)
class Address:
    """The address of a stream: vehicle, topic and, for estimator_local_position, the uORB instance.

    Raises AddressError for a vehicle that is not 1 to 64 of A-Z a-z 0-9 _ -, an unknown topic, a missing instance
    where the topic has instances, or an instance where it has none.
    """

    vehicle: str
    topic: str
    instance: int | None = None

    def __post_init__(self) -> None:
        check_vehicle(self.vehicle)
        if get_topic(self.topic).instances and self.instance is None:
            raise AddressError("instance", None, f"0 to {_INSTANCES - 1} for {self.topic}")
        _check_instance(self.topic, self.instance)

    @classmethod
    def from_key(cls, key: str, *, prefix: str = DEFAULT_PREFIX) -> Address:
        """Return the address in a key; raise AddressError for any other key, wildcards included."""
        chunks = key.removeprefix(prefix + "/").split("/")
        if not key.startswith(prefix + "/") or len(chunks) not in (2, 3):
            raise AddressError("key", key, f"{prefix}/<vehicle>/<topic>[/<instance>]")
        instance = None
        if len(chunks) == 3:
            if not re.fullmatch(r"0|[1-9][0-9]{0,2}", chunks[2]):
                raise AddressError("instance", chunks[2], f"0 to {_INSTANCES - 1}")
            instance = int(chunks[2])
        return cls(chunks[0], chunks[1], instance)

    def key(self, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the Zenoh key expression of this address."""
        return f"{prefix}/{self.vehicle}/{self.stream}"

    def alive_key(self, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the key expression of this address's liveliness token."""
        return f"{prefix}/{self.vehicle}/@alive/{self.stream}"

    def rejected_key(self, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the key expression where rejected messages of this address are reported."""
        return f"{prefix}/@rejected/{self.vehicle}/{self.stream}"

    @classmethod
    def from_rate_key(cls, key: str, *, prefix: str = DEFAULT_PREFIX) -> Address:
        """Return the address in the key of a thinned stream; raise AddressError for any other key."""
        whole, rate, _ = key.rpartition(_RATE)
        if not rate:
            raise AddressError("key", key, f"{prefix}/<vehicle>/<topic>[/<instance>]{_RATE}<messages a second>")
        return cls.from_key(whole, prefix=prefix)

    def rate_key(self, rate: int | str, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the key expression of this stream, thinned to so many messages a second; "*" stands for any rate."""
        return f"{self.key(prefix=prefix)}{_RATE}{rate}"

    @property
    def stream(self) -> str:
        """The topic, with its instance where it has one: the part of the key after the vehicle."""
        return self.topic if self.instance is None else f"{self.topic}/{self.instance}"

    def __str__(self) -> str:
        return f"{self.vehicle}/{self.stream}"


@dataclass(frozen=True, slots=True)
class Selection:
    """The addresses with this topic, vehicle and instance; "*" and None stand for any.

    Raises AddressError for what no address has.
    """

    topic: str = ANY
    vehicle: str = ANY
    instance: int | None = None

    def __post_init__(self) -> None:
        if self.vehicle != ANY:
            check_vehicle(self.vehicle)
        if self.topic != ANY:
            get_topic(self.topic)
            _check_instance(self.topic, self.instance)
        elif self.instance is not None:
            raise AddressError("instance", self.instance, "none: name the topic as well")

    def matches(self, address: Address) -> bool:
        """Return whether this address is one of them."""
        return (
            self.topic in (ANY, address.topic)
            and self.vehicle in (ANY, address.vehicle)
            and self.instance in (None, address.instance)
        )

    def key_expr(self, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the Zenoh key expression that matches the keys of these addresses."""
        if self.topic == ANY:
            return f"{prefix}/{self.vehicle}/**"
        if get_topic(self.topic).instances:
            return f"{prefix}/{self.vehicle}/{self.topic}/{ANY if self.instance is None else self.instance}"
        return f"{prefix}/{self.vehicle}/{self.topic}"

    def alive_key_expr(self, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the key expression that matches the liveliness tokens of these addresses."""
        return f"{prefix}/{self.vehicle}/@alive/{self.key_expr(prefix='').removeprefix(f'/{self.vehicle}/')}"

    def rate_key_expr(self, rate: int | str, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the key expression of these streams, thinned to so many messages a second; "*" is any rate."""
        return f"{self.key_expr(prefix=prefix)}{_RATE}{rate}"


def alive_key_expr(*, prefix: str = DEFAULT_PREFIX) -> str:
    """Return the key expression for the liveliness tokens of all addresses."""
    return f"{prefix}/*/@alive/**"


def address_of_alive_key(key: str, *, prefix: str = DEFAULT_PREFIX) -> Address:
    """Return the address in the key of a liveliness token; raise AddressError for any other key."""
    vehicle, alive, stream = key.removeprefix(prefix + "/").partition("/@alive/")
    if not alive:
        raise AddressError("key", key, f"{prefix}/<vehicle>/@alive/<topic>[/<instance>]")
    return Address.from_key(f"{prefix}/{vehicle}/{stream}", prefix=prefix)


def rejected_key_expr(*, prefix: str = DEFAULT_PREFIX) -> str:
    """Return the key expression for the reports of rejected messages of all addresses."""
    return f"{prefix}/@rejected/**"


def address_of_rejected_key(key: str, *, prefix: str = DEFAULT_PREFIX) -> Address:
    """Return the address that a report is about; raise AddressError for any other key."""
    begin = f"{prefix}/@rejected/"
    if not key.startswith(begin):
        raise AddressError("key", key, f"{begin}<vehicle>/<topic>[/<instance>]")
    return Address.from_key(f"{prefix}/{key.removeprefix(begin)}", prefix=prefix)


def schema_key(*, prefix: str = DEFAULT_PREFIX) -> str:
    """Return the key to query for the JSON Schema and the layouts that a publisher knows."""
    return f"{prefix}/@schema/VehicleLocalPosition"


def status_key(service: str, *, prefix: str = DEFAULT_PREFIX) -> str:
    """Return the key to query for the status of one service; "*" stands for all services."""
    return f"{prefix}/@service/{service}/status"


def ack_key(key_expr: str) -> str:
    """Return the key to query for acknowledgements by the readers of a key or key expression."""
    return f"{key_expr}/@ack"


def get_topic(name: object) -> Topic:
    """Return a topic by its name; raise AddressError for an unknown one."""
    if not isinstance(name, str) or name not in TOPICS:
        raise AddressError("topic", name, f"one of {', '.join(TOPICS)}")
    return TOPICS[name]


def vehicle_name(vehicle: str | int) -> str:
    """Return the name of a vehicle that is given by name or by number, such as a MAVLink system id."""
    return str(vehicle) if type(vehicle) is int else cast("str", vehicle)


def check_vehicle(vehicle: object) -> None:
    """Raise AddressError for an invalid name of a vehicle."""
    if not isinstance(vehicle, str):
        expected = 'one name, such as "7": several vehicles need a call each, or "*" where all are read'
        raise AddressError("vehicle", vehicle, expected)
    if not _CHUNK.fullmatch(vehicle) or len(vehicle) > _VEHICLE_LENGTH:
        raise AddressError("vehicle", vehicle, f"1 to {_VEHICLE_LENGTH} of A-Z a-z 0-9 _ -")


def _check_instance(topic: str, instance: int | None) -> None:
    if instance is None:
        return
    if not get_topic(topic).instances:
        raise AddressError("instance", instance, f"none: {topic} has no instances")
    if type(instance) is not int or not 0 <= instance < _INSTANCES:
        raise AddressError("instance", instance, f"0 to {_INSTANCES - 1} for {topic}")


def check_prefix(prefix: str) -> None:
    """Raise AddressError for an invalid key prefix: it is plain chunks with slashes between them."""
    if not all(_CHUNK.fullmatch(chunk) for chunk in prefix.split("/")):
        raise AddressError("prefix", prefix, "chunks of A-Z a-z 0-9 _ - with / between them")
