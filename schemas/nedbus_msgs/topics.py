"""Addresses and selections of streams, their key expressions, and their ROS 2 topics."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import lru_cache
from typing import Any, Final, TypeAlias, cast

from . import limits
from .errors import AddressError, ArgumentError
from .model.declaration import Topic
from .model.definition import MESSAGES, TOPICS
from .model.message import Message

ANY: Final = "*"
DEFAULT_PREFIX: Final = "nedbus"
VehicleNames: TypeAlias = str | int | Sequence[str | int]
"""One vehicle or several, each by name or by number; "*" matches any."""

RATE: Final = "/@rate/"
"""Separator between the key of a stream and its downsampled rate [messages per second]."""
REJECTED: Final = "/@rejected"
"""Appended to the prefix in the keys of reports on rejected messages."""

_TOPIC = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")

_TYPO_SIMILARITY: Final = 0.9  # minimum similarity of a name that counts as a misspelling
_STREAM = re.compile(r"/([^/]*)/([^/]*)(?:/(0|[1-9][0-9]{0,2}))?")
_CHUNK = re.compile(r"[A-Za-z0-9_-]+")
_ROS2_TOPIC = re.compile(r"([a-z][a-z0-9_]*?)(?:_v\d+)?(?:_?(\d{1,3}))?")
_OUT: Final = ("fmu", "out")
_IN: Final = ("fmu", "in")
_INSTANCES: Final = 256  # uORB's multi_id in a log is a uint8


class _Hashed:
    """Slot for a hash that is computed once, and read without Python code: each message is looked up several times."""

    __slots__ = ("__hash__",)


@dataclass(frozen=True, slots=True)
class Address(_Hashed):
    """The address of a stream: vehicle, topic and, where the topic has instances, the uORB instance.

    Addresses sort by these fields; an address without an instance sorts before instance 0.

    Raises AddressError for a vehicle that is not 1 to 64 characters of A-Z a-z 0-9 _ -, a topic that `get_topic`
    rejects, an instance of a topic without instances, or none for a topic with instances.
    """

    vehicle: str
    topic: str
    instance: int | None = None

    def __post_init__(self) -> None:
        check_vehicle(self.vehicle)
        has_instances = get_topic(self.topic).instances is True
        _check_instance(self.topic, self.instance, required=has_instances)
        value = hash((self.vehicle, self.topic, self.instance))
        object.__setattr__(self, "__hash__", value.__int__)

    __hash__ = _Hashed.__hash__  # type: ignore[misc] # the slot, because a dataclass would define a method

    def __reduce__(self) -> tuple[object, ...]:
        return Address, (self.vehicle, self.topic, self.instance)  # hashes differ between processes

    @classmethod
    def from_key(cls, key: str, *, prefix: str = DEFAULT_PREFIX) -> Address:
        """Parse a key; raise AddressError if it is not the key of one address, for example if it has wildcards."""
        parts = None
        if key.startswith(prefix):
            parts = _STREAM.fullmatch(key.removeprefix(prefix))
        if parts is None:
            raise AddressError("key", key, f"{prefix}/<vehicle>/<topic>[/<instance>]")
        vehicle, topic, instance = parts.groups()
        if instance is None:
            return cls(vehicle, topic)
        return cls(vehicle, topic, int(instance))

    def key(self, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the Zenoh key expression of this address."""
        return f"{prefix}/{self}"

    def alive_key(self, publisher: str, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the key of the liveliness token of one publisher of this address; `publisher`: its Zenoh id."""
        return f"{prefix}/{self.vehicle}/@alive/{publisher}/{self.stream}"

    def rejected_key(self, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the key expression of reports on rejected messages of this address."""
        return self.key(prefix=prefix + REJECTED)

    def rate_key(self, rate: int | str, *, prefix: str = DEFAULT_PREFIX) -> str:
        """Return the key expression of this stream downsampled to `rate` messages/s; "*" matches any rate."""
        return f"{self.key(prefix=prefix)}{RATE}{rate}"

    @property
    def stream(self) -> str:
        """The topic, with its instance where it has one: the part of the key after the vehicle."""
        if self.instance is None:
            return self.topic
        return f"{self.topic}/{self.instance}"

    def __lt__(self, other: Address) -> bool:
        return self._order < other._order

    @property
    def _order(self) -> tuple[str, str, int]:
        if self.instance is None:
            return self.vehicle, self.topic, -1
        return self.vehicle, self.topic, self.instance

    def __str__(self) -> str:
        return f"{self.vehicle}/{self.stream}"


@dataclass(frozen=True, slots=True, init=False)
class Selection:
    """The addresses with one of these topics, one of these vehicles, and this instance; "*" and None match any.

    `topic`, `vehicle`: one name or several; a vehicle may be a number, such as a MAVLink system id. "*" includes all
    others, and a name counts once. `topics`, `vehicles`: the names that remain.

    Raises AddressError for a vehicle, topic or instance that no address can have, and for an empty list of names.
    """

    topics: tuple[str, ...]
    vehicles: tuple[str, ...]
    instance: int | None

    def __init__(
        self,
        topic: str | Sequence[str] = ANY,
        vehicle: VehicleNames = ANY,
        instance: int | None = None,
    ) -> None:
        topics = _distinct("topic", topic)
        vehicles = _distinct("vehicle", vehicle)
        object.__setattr__(self, "topics", topics)
        object.__setattr__(self, "vehicles", vehicles)
        object.__setattr__(self, "instance", instance)
        if vehicles != (ANY,):
            for name in vehicles:
                check_vehicle(name)
        if topics != (ANY,):
            for name in topics:
                get_topic(name)
                _check_instance(name, instance)
        elif instance is not None:
            raise AddressError("instance", instance, "none without a topic")

    def matches(self, address: Address) -> bool:
        """Return whether an address is selected."""
        return (
            (self.topics == (ANY,) or address.topic in self.topics)
            and self.matches_vehicle(address.vehicle)
            and self.instance in (None, address.instance)
        )

    def matches_vehicle(self, vehicle: str) -> bool:
        """Return whether a vehicle is selected."""
        return self.vehicles == (ANY,) or vehicle in self.vehicles

    def key_exprs(self, *, prefix: str = DEFAULT_PREFIX) -> list[str]:
        """Return the Zenoh key expressions that match the keys of these addresses: one per vehicle and topic."""
        return self._key_exprs(prefix, "")

    def alive_key_exprs(self, *, prefix: str = DEFAULT_PREFIX) -> list[str]:
        """Return the key expressions that match the liveliness tokens of these addresses."""
        return self._key_exprs(prefix, "@alive/*/")

    def rate_key_exprs(self, rate: int | str, *, prefix: str = DEFAULT_PREFIX) -> list[str]:
        """Return the key expressions of these streams downsampled to `rate` messages/s; "*" matches any rate."""
        return [f"{key}{RATE}{rate}" for key in self.key_exprs(prefix=prefix)]

    def _key_exprs(self, prefix: str, kind: str) -> list[str]:
        streams = self._streams()
        return [
            f"{prefix}/{vehicle}/{kind}{stream}" for vehicle in self.vehicles for stream in streams
        ]

    def _streams(self) -> list[str]:
        """Return the part of a key expression after the vehicle, for each topic."""
        if self.topics == (ANY,):
            return ["**"]
        if self.instance is not None:
            return [f"{topic}/{self.instance}" for topic in self.topics]
        any_instance = {True: f"/{ANY}", False: "", None: "/**"}
        return [f"{topic}{any_instance[get_topic(topic).instances]}" for topic in self.topics]

    def __str__(self) -> str:
        parts = []
        if self.vehicles != (ANY,):
            parts.append(f"vehicle {' or '.join(self.vehicles)}")
        if self.topics != (ANY,):
            parts.append(" or ".join(self.topics))
        if self.instance is not None:
            parts.append(f"instance {self.instance}")
        return ", ".join(parts) or "all streams"


def _distinct(what: str, given: object) -> tuple[str, ...]:
    """Return the distinct names in one name or several, only "*" if it is among them; the caller checks them."""
    given_names: Iterable[Any] = [given]
    if isinstance(given, Iterable) and not isinstance(given, str):
        given_names = given
    names: list[str] = []
    for given_name in given_names:
        name = vehicle_name(given_name)
        if name not in names:  # compared, because a wrong value may not be hashable
            names.append(name)
    if not names:
        raise AddressError(what, given, f'at least one {what}, or "*" for all')
    if ANY in names:
        return (ANY,)
    return tuple(names)


def address_of_alive_key(key: str, *, prefix: str = DEFAULT_PREFIX) -> Address:
    """Parse the key of a liveliness token; raise AddressError for any other key."""
    vehicle, alive, token = key.removeprefix(prefix + "/").partition("/@alive/")
    publisher, _, stream = token.partition("/")
    if not (alive and publisher):
        raise AddressError(
            "key", key, f"{prefix}/<vehicle>/@alive/<publisher>/<topic>[/<instance>]"
        )
    return Address.from_key(f"{prefix}/{vehicle}/{stream}", prefix=prefix)


def schema_key(message: str, *, vehicle: str = ANY, prefix: str = DEFAULT_PREFIX) -> str:
    """Return the key to query the publishers of a vehicle for the JSON Schema and the layouts of a message."""
    return f"{prefix}/@schema/{vehicle}/{message}"


def status_key(service: str, *, vehicle: str = ANY, prefix: str = DEFAULT_PREFIX) -> str:
    """Return the key to query for what a service reports about a vehicle; "*" matches all of either.

    The key names the vehicle, so that access rules can bind reports about a vehicle to its certificate.
    """
    return f"{prefix}/@service/{vehicle}/{service}/status"


def all_status_keys(*, prefix: str = DEFAULT_PREFIX) -> str:
    """Return the key expression of all status keys, including those of older services, which name no vehicle."""
    return f"{prefix}/@service/**/status"


def parse_status_key(key: str, *, prefix: str = DEFAULT_PREFIX) -> tuple[str | None, str]:
    """Return vehicle and service of a status key; the vehicle is None for an older service, whose key names none.

    Raises AddressError for any other key.
    """
    chunks = key.removeprefix(f"{prefix}/@service/").removesuffix("/status").split("/")
    if len(chunks) == 1:
        return None, chunks[0]
    if len(chunks) != 2:
        raise AddressError("key", key, f"{prefix}/@service/<vehicle>/<id>/status")
    vehicle, service = chunks
    return check_vehicle(vehicle), service


def prefix_of(key: str) -> str:
    """Return the prefix of the key of a message or of a publisher's token; "" if it has none, as in plain ROS 2."""
    before_token, alive, _ = key.partition("/@alive/")
    chunks = before_token.split("/")
    if not alive:
        chunks = chunks[:-1]  # without the topic
    prefix = chunks[:-1]  # without the vehicle
    # `<domain>/fmu/out/vehicle_local_position`
    is_ros2_domain = bool(prefix) and prefix[0].isdecimal()
    if is_ros2_domain:
        return ""
    return "/".join(prefix)


def ack_key(key_expr: str) -> str:
    """Return the key to query readers of a key or key expression for acknowledgements."""
    return f"{key_expr}/@ack"


def get_topic(name: object) -> Topic:
    """Return a topic by name; an unknown name is assumed to be a PX4 topic that is not built in.

    Raises AddressError for a name that is not lower_snake_case, or looks like a misspelling of a built-in topic.
    """
    if not isinstance(name, str):
        raise AddressError("topic", name, 'a topic name, or "*" for all')
    return TOPICS.get(name) or _other_topic(name)


@lru_cache(1024)
def _other_topic(name: str) -> Topic:
    if not _TOPIC.fullmatch(name) or len(name) > limits.NAME:
        raise AddressError("topic", name, _expected_topic(name))
    similar = get_close_matches(name, TOPICS, 3, _TYPO_SIMILARITY)
    if similar:
        raise AddressError("topic", name, f"{' or '.join(similar)} (looks like a misspelling)")
    return Topic(name, 0.0, "another PX4 topic", instances=None)


def _expected_topic(name: str) -> str:
    """Return what to give instead of a name that no topic can have."""
    if re.search(r"(^|/)(in|out)/", name):
        return f"{split_ros2_topic(name)[1]}, without the ROS 2 prefix"
    base, _, instance = name.partition("/")
    if base in TOPICS:
        return f"{base} with instance {instance}"
    if name in MESSAGES:
        return f"one of {', '.join(MESSAGES[name].topics)}"
    return f"one of {', '.join(TOPICS)}, or another PX4 topic in lower_snake_case"


def split_ros2_topic(topic: str) -> tuple[str, str, int | None]:
    """Split the name of a ROS 2 topic into namespace, uORB topic and instance.

    `px4_1/fmu/out/estimator_local_position_0` has namespace `px4_1` and instance 0.
    `/fmu/in/...` are inputs of the same vehicle. The `_v1` of a versioned topic is ignored.

    Raises AddressError for a name that no PX4 topic can have.
    """
    *path, name = topic.strip("/").split("/")
    if tuple(path[-2:]) in (_OUT, _IN):
        path = path[:-2]
    namespace = "/".join(path)
    digits = None
    parts = _ROS2_TOPIC.fullmatch(name)
    if parts and name not in TOPICS:
        name, digits = parts.groups()
    if digits is not None:
        return namespace, name, int(digits)
    if get_topic(name).instances:
        return namespace, name, 0
    return namespace, name, None


def is_vehicle_input(topic: str) -> bool:
    """Return whether a ROS 2 topic is an input of a vehicle, `/fmu/in/...`."""
    return tuple(topic.split("/")[-3:-1]) == _IN


def ros2_topic_of(address: Address, namespace: str) -> str:
    """Return the ROS 2 topic of an address, without a leading slash; an empty namespace means none."""
    is_plain = address.instance is None
    if address.instance == 0:
        is_plain = get_topic(address.topic).plain_first
    topic = "/".join([*_OUT, address.topic])
    if not is_plain:
        topic += f"_{address.instance}"
    namespace = namespace.strip("/")
    return f"{namespace}/{topic}" if namespace else topic


def vehicle_name(vehicle: str | int) -> str:
    """Return the name of a vehicle, given by name or by number, such as a MAVLink system id."""
    if type(vehicle) is int:
        return str(vehicle)
    return cast("str", vehicle)


def topic_of(message: type[Message] | str, topic: str | None = None) -> str:
    """Return the topic of a message: a topic name unchanged; for a class, `topic` or, if None, its first topic.

    Raises AddressError for a topic of another message, and for a class that declares no topics.
    """
    topics: list[str] = []
    if isinstance(message, str):
        topics = [message]
    elif isinstance(message, type):
        topics = [declared.name for declared in vars(message).get("TOPICS", ())]
    name = getattr(message, "__name__", message)
    if not topics:
        raise AddressError("message", name, "a class that declares TOPICS, or the name of a topic")
    if topic is not None and topic not in topics:
        raise AddressError("topic", topic, f"one of {name}: {', '.join(topics)}")
    return topic or topics[0]


def check_vehicle(vehicle: object) -> str:
    """Return a valid vehicle name; raise AddressError for any other."""
    if not isinstance(vehicle, str):
        raise AddressError(
            "vehicle", vehicle, 'a name, such as "7", a list of names, or "*" for all'
        )
    if not _CHUNK.fullmatch(vehicle) or len(vehicle) > limits.NAME:
        raise AddressError("vehicle", vehicle, f"1 to {limits.NAME} of A-Z a-z 0-9 _ -")
    return vehicle


def _check_instance(topic: str, instance: int | None, *, required: bool = False) -> None:
    if instance is None and not required:
        return
    if instance is not None and get_topic(topic).instances is False:
        raise AddressError("instance", instance, f"none ({topic} has no instances)")
    if type(instance) is not int or not 0 <= instance < _INSTANCES:
        expected = f"an integer from 0 to {_INSTANCES - 1} for {topic}"
        raise AddressError("instance", instance, expected)


def check_prefix(prefix: str) -> None:
    """Raise AddressError for a key prefix that is not chunks of A-Z a-z 0-9 _ - separated by slashes."""
    if not all(_CHUNK.fullmatch(chunk) for chunk in prefix.split("/")):
        raise AddressError("prefix", prefix, "chunks of A-Z a-z 0-9 _ - separated by /")


def check_max_rate(max_rate: object) -> None:
    """Raise ArgumentError unless `max_rate` is a finite number above 0."""
    is_positive = False
    if isinstance(max_rate, int | float) and not isinstance(max_rate, bool):
        is_positive = 0 < max_rate < math.inf
    if not is_positive:
        raise ArgumentError("max_rate", max_rate, "messages per second, a finite number above 0")
