"""Parts of the file of a message beside its fields: topics, layouts, and older names of fields."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from .px4_types import FieldType

DEFAULT_TOPIC: Final = "vehicle_local_position"
"""The topic of a call that names none."""
RELEASES: Final = ("1.13", "1.14", "1.15", "1.16", "1.17", "1.18", "main")
"""The releases of PX4 whose layouts are known, oldest first."""
ALL: Final = "all"
"""Name of the layout that has every field of the model, where no release of PX4 has them all."""

_CACHE_SECONDS: Final = 20.0
_MIN_CACHE: Final = 400


@dataclass(frozen=True, slots=True)
class Topic:
    """One uORB topic.

    `rate`: the nominal rate at which PX4 publishes or logs it [Hz], 0 where there is none.
    `doc`: its publisher.
    `on_change`: PX4 sends it at each change, and at `rate` otherwise: bursts and pauses are no faults.
    `instances`: it has uORB instances, one per EKF or sensor; None if that is not known.
    `plain_first`: in ROS 2 the topic of its instance 0 has no number, as PX4 calls it by default.
    `priority`: on a congested link, messages of a higher one go first.
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
        """Number of messages that a publisher keeps for readers that missed some: 20 s at the nominal rate."""
        return max(_MIN_CACHE, round(_CACHE_SECONDS * self.rate))


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """One layout.

    `name`: the first PX4 release with it.
    `text`: the names of its fields, `*` for those of the model, or its difference from another layout:
    `1.13, without a b, c: d e` lacks a and b, and has d and e behind c; `d:uint8` has a type that is not the model's.
    `wire`: its number in payloads, if it has one.
    `aliases`: names of ROS 2 types that hold it beside that of the message.
    `types`: its fields with their types, in order, as the definition of the message makes them of `text`.
    """

    name: str
    text: str = dataclasses.field(repr=False)
    wire: int | None = None
    aliases: tuple[str, ...] = ()
    types: Mapping[str, FieldType] = dataclasses.field(default_factory=dict, repr=False)

    @property
    def fields(self) -> tuple[str, ...]:
        """The names of its fields, in order."""
        return tuple(self.types)


@dataclass(frozen=True, slots=True)
class Older:
    """A field of older layouts, and its place in the model.

    `new`: the fields of the model that have its value, or an element of one, such as `position[0]`.
    `up` and `down` convert a value; without them it is only renamed.
    `type`: PX4's type of it, where that is another one; `doc`: its unit and meaning.
    """

    name: str
    new: str
    up: Callable[[Any], Any] | None = None
    down: Callable[[Any], Any] | None = None
    type: str = ""
    doc: str = ""

    @property
    def places(self) -> list[tuple[str, int | None]]:
        """The fields of the model that have its value, each with the index of an element or None."""
        parts = [place.rstrip("]").partition("[") for place in self.new.split()]
        return [(field, int(index) if index else None) for field, _, index in parts]
