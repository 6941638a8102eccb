"""Parts of a message's file beside its fields: topics, layouts, and older names of fields."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from .px4_types import FieldType, field_type

DEFAULT_TOPIC: Final = "vehicle_local_position"
"""The topic of a call that names none."""
EVERY: Final = "*"
"""In place of the fields of a layout: those of the model."""
_KEPT_FOR: Final = 20.0  # s
_LEAST_CACHE: Final = 400
RELEASES: Final = ("1.13", "1.14", "1.15", "1.16", "1.17", "1.18", "main")
"""The releases of PX4 whose layouts are known, oldest first."""
ALL: Final = "all"
"""Name of the layout that has every field of the model, where no release of PX4 has them all."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One uORB topic.

    `rate`: the nominal rate at which PX4 publishes or logs it [Hz], 0 where there is none.
    `doc`: its publisher.
    `on_change`: PX4 sends it whenever it changes, and at `rate` otherwise: bursts and pauses are no faults.
    `instances`: it has uORB instances, one per EKF or sensor; None for a topic of which that is not known.
    `plain_first`: in ROS 2 the topic of its instance 0 has no number, as PX4 calls it by default.
    `priority`: on a congested link, messages of a higher one go first.
    `cache`: messages that a publisher keeps for readers that missed some; 20 s at the nominal rate unless it is given.
    """

    name: str
    rate: float
    doc: str
    instances: bool | None = False
    on_change: bool = False
    plain_first: bool = False
    priority: Literal["data", "data_high"] = "data"
    cache: int = 0

    @property
    def kept(self) -> int:
        """Number of messages that a publisher keeps."""
        return self.cache or max(_LEAST_CACHE, round(_KEPT_FOR * self.rate))


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """One layout: its name (the first PX4 release with it), its number on the wire if any, its fields with types."""

    name: str
    wire: int | None
    types: Mapping[str, FieldType] = dataclasses.field(repr=False)

    @property
    def fields(self) -> tuple[str, ...]:
        """The names of its fields, in order."""
        return tuple(self.types)


@dataclass(frozen=True, slots=True)
class Older:
    """A field of older layouts, and the fields of the model that have its value now; make it with `older`."""

    new: tuple[tuple[str, int | None], ...]
    up: Callable[[Any], Any] | None
    down: Callable[[Any], Any] | None
    type: FieldType | None
    doc: str


def older(
    new: str | tuple[str, ...],
    up: Callable[[Any], Any] | None = None,
    down: Callable[[Any], Any] | None = None,
    type: str | None = None,  # noqa: A002 - a row of a table
    *,
    doc: str = "",
) -> Older:
    """Say which field of the model, or which element (`position[0]`), has the value of a field of older layouts.

    `up` and `down` convert a value; without them it is only renamed.
    `type` is PX4's type of the old field where that is another one, and `doc` its meaning.
    """
    places = tuple(map(_place, (new,) if isinstance(new, str) else new))
    return Older(places, up, down, field_type(type) if type else None, doc)


def _place(text: str) -> tuple[str, int | None]:
    name, _, index = text.rstrip("]").partition("[")
    return name, int(index) if index else None
