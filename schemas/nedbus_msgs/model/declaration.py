"""Declarations in a message's file besides its fields: topics, layouts, and fields of older layouts."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial, wraps
from typing import Any, Final, Literal, TypeVar, cast

from .px4_types import FieldType

DEFAULT_TOPIC: Final = "vehicle_local_position"
RELEASES: Final = ("1.13", "1.14", "1.15", "1.16", "1.17", "1.18", "main")
"""The PX4 releases with known layouts, oldest first."""
ALL: Final = "all"
"""Name of the layout with every field of the model, if no release of PX4 has them all."""

_CACHE_SECONDS: Final = 20.0  # s of messages in a publisher's cache, at the nominal rate
_MIN_CACHE: Final = 400  # messages in a publisher's cache
_F = TypeVar("_F", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Topic:
    """One uORB topic.

    `rate`: nominal rate at which PX4 publishes or logs it [Hz]; 0 if there is none.
    `doc`: its publisher.
    `on_change`: PX4 sends it on change, and at `rate` otherwise, so bursts and pauses are not faults.
    `instances`: True if it has uORB instances, one per EKF or sensor; None if unknown.
    `plain_first`: the ROS 2 topic of instance 0 has no number, as in PX4's defaults.
    `priority`: messages of higher priority go first on a congested link.
    """

    name: str
    rate: float
    doc: str
    instances: bool | None = False
    on_change: bool = False
    plain_first: bool = False
    priority: Literal["data", "data_high"] = "data"

    @property
    def kept(self) -> int:
        """Number of messages in a publisher's retransmission cache: 20 s at the nominal rate, at least 400."""
        return max(_MIN_CACHE, round(_CACHE_SECONDS * self.rate))


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """One layout of a message.

    `name`: the first PX4 release with it.
    `text`: the names of its fields, `*` for those of the model, or the difference from another layout:
    `1.13, without a b, c: d e` lacks a and b, and has d and e after c; `d:uint8` overrides the type in the model.
    `wire`: its number in payloads, if it has one.
    `aliases`: further ROS 2 types with this layout, besides that of the message.
    `types`: its fields and their types in order, which the definition of the message parses from `text`.
    `caches`: see `kept`.
    """

    name: str
    text: str = dataclasses.field(repr=False)
    wire: int | None = None
    aliases: tuple[str, ...] = ()
    types: Mapping[str, FieldType] = dataclasses.field(default_factory=dict, repr=False)
    caches: dict[object, Callable[..., Any]] = dataclasses.field(default_factory=dict, init=False, repr=False)

    @property
    def fields(self) -> tuple[str, ...]:
        """The names of its fields, in order."""
        return tuple(self.types)


def kept(make: _F) -> _F:
    """Cache the last 1,024 results of a function in its first argument, a Definition or Layout, to be freed with it.

    A cache of the function would keep the definitions that any peer may send.
    """

    @wraps(make)
    def find(owner: Any, *arguments: object) -> Any:
        cached = owner.caches.get(make)
        if cached is None:  # another thread may set it meanwhile
            cached = owner.caches.setdefault(make, lru_cache(1024)(partial(make, owner)))
        return cached(*arguments)

    return cast("_F", find)


@dataclass(frozen=True, slots=True)
class Older:
    """A field of older layouts, and its place in the model.

    `new`: the fields of the model with its value, or elements such as `position[0]`.
    `up`, `down`: functions that convert its value to the model and back; without them, it is only renamed.
    `type`: its PX4 type, if different; `doc`: its unit and meaning.
    """

    name: str
    new: str
    up: Callable[[Any], Any] | None = None
    down: Callable[[Any], Any] | None = None
    type: str = ""
    doc: str = ""

    @property
    def places(self) -> list[tuple[str, int | None]]:
        """The fields of the model with its value, each with the index of an element or None."""
        parts = [place.rstrip("]").partition("[") for place in self.new.split()]
        return [(field, int(index) if index else None) for field, _, index in parts]
