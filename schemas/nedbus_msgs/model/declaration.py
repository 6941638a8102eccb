"""Declarations in a message class, other than fields: topics, layouts and renamed fields."""

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
_HISTORY: Final = 20.0  # s of messages at the nominal rate in a history cache
_LEAST_KEPT: Final = 400  # messages of a topic with a nominal rate, because sources may be faster
_KEPT_WITHOUT_RATE: Final = 50  # messages of a source's topic
_KEPT_BYTES: Final = 2**18  # of such a topic

_F = TypeVar("_F", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True)
class Topic:
    """One uORB topic.

    `rate`: nominal rate at which PX4 publishes or logs it [Hz]; 0 if there is none.
    `doc`: the component that publishes it.
    `on_change`: True if PX4 publishes it on change, so bursts and pauses are normal; False if published at `rate`.
    `instances`: True if it has uORB instances, one per EKF or sensor; None if unknown.
    `plain_first`: True if the ROS 2 topic of instance 0 has no suffix, as in PX4's defaults.
    `priority`: Zenoh priority; higher ones are sent first on a congested link.
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
        """Number of messages in a publisher's history cache: 20 s at the nominal rate, at least 400."""
        return max(_LEAST_KEPT, round(_HISTORY * self.rate))

    def kept_for_source(self, size: int) -> int:
        """Return the same for a stream of a source; `size`: bytes of a message.

        A topic without a nominal rate, or published on change, keeps 50 messages, fewer if they exceed 256 KiB: PX4's
        log has about ninety such topics, most of them at up to 2.5 Hz.
        """
        if self.rate and not self.on_change:
            return self.kept
        return max(1, min(_KEPT_WITHOUT_RATE, _KEPT_BYTES // size))


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """One layout of a message.

    `name`: the first PX4 release that has it.
    `text`: its field names, separated by spaces; `*` for those of the model.
    `base`: the name of another layout of the message, whose fields this layout has instead of `text`.
    `without`: the names of fields that it lacks, separated by spaces.
    `insert_after`: the names of fields that it has in addition, by the name of the field before them.
    `other_types`: types of fields that differ from the model's, by name.
    `wire`: its number in payloads; None if it is not used in payloads.
    `aliases`: other ROS 2 types with this layout.
    `types`: its fields and their types in order, which the definition derives from all these.
    `caches`: see `cached_on_owner`.

        Layout("1.15", base="1.16", without="hagl_max_z hagl_max_xy", insert_after={"hagl_min": "hagl_max"})
    """

    name: str
    text: str = dataclasses.field(default="*", repr=False)
    wire: int | None = None
    aliases: tuple[str, ...] = ()
    base: str = ""
    without: str = dataclasses.field(default="", repr=False)
    insert_after: Mapping[str, str] = dataclasses.field(default_factory=dict, repr=False)
    other_types: Mapping[str, str] = dataclasses.field(default_factory=dict, repr=False)
    types: Mapping[str, FieldType] = dataclasses.field(default_factory=dict, repr=False)
    caches: dict[object, Callable[..., Any]] = dataclasses.field(
        default_factory=dict, init=False, repr=False
    )

    @property
    def fields(self) -> tuple[str, ...]:
        """The names of its fields, in order."""
        return tuple(self.types)


def cached_on_owner(make: _F) -> _F:
    """Cache up to 1,024 results of a function in its first argument, a Definition or Layout, and free them with it.

    A global cache would keep alive every definition that a peer sends.
    """

    @wraps(make)
    def find(owner: Any, *arguments: object) -> Any:
        cached = owner.caches.get(make)
        if cached is None:  # setdefault: another thread may have stored a result first
            cached = owner.caches.setdefault(make, lru_cache(1024)(partial(make, owner)))
        return cached(*arguments)

    return cast("_F", find)


@dataclass(frozen=True, slots=True)
class RenamedField:
    """A field of older layouts that the model has under another name or in another unit.

    `new`: the model's fields with its value, or an element such as `position[0]`.
    `up`, `down`: functions that convert its value to the model's and back; None if only the name changed.
    `type`: its PX4 type, if different; `doc`: its unit and meaning.
    """

    name: str
    new: str
    up: Callable[[Any], Any] | None = None
    down: Callable[[Any], Any] | None = None
    type: str = ""
    doc: str = ""

    @property
    def targets(self) -> list[tuple[str, int | None]]:
        """The model's fields with its value, each with an element index or None."""
        targets: list[tuple[str, int | None]] = []
        for target in self.new.split():
            field, bracket, index = target.rstrip("]").partition("[")
            if bracket:
                targets.append((field, int(index)))
            else:
                targets.append((field, None))
        return targets
