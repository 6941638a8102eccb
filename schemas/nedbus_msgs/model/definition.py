"""Message definitions, their registry, and conversion between PX4's layouts and the model.

A layout is identified by its field names or its name, never by MESSAGE_VERSION, which two layouts may share.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import replace
from functools import cached_property
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, NamedTuple, TypeVar

from .declaration import ALL, RELEASES, Layout, Topic, cached_on_owner
from .px4_types import NAN, FieldType, field_type
from .validation import Validation, Values, positions_of

if TYPE_CHECKING:
    from .message import Message

_MAX_READERS: Final = 64  # types of messages for which a FieldReader keeps a function
M = TypeVar("M", bound="Message")
M_co = TypeVar("M_co", bound="Message", covariant=True)


class Row(tuple[Any, ...]):
    """A message as a named tuple with the fields of the model in the same order; much faster than a model.

    A row is validated when it is decoded or encoded, not when it is created.
    Type checkers treat it as the message class; `_fields` and `_asdict()` work as in any named tuple.
    """

    __slots__ = ()
    DEFINITION: ClassVar[Definition[Any]]
    _fields: ClassVar[tuple[str, ...]] = ()

    def _asdict(self) -> dict[str, Any]:
        return dict(zip(self._fields, self, strict=True))

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value!r}" for name, value in self._asdict().items())
        return f"{type(self).__name__}({values})"

    def __reduce__(self) -> tuple[object, ...]:
        return _row, (self.DEFINITION, tuple(self))


class FlatRow(tuple[Any, ...]):
    """The values of a message in order, each element of an array as one value; read them with a FieldReader."""

    __slots__ = ()
    _positions: ClassVar[Mapping[str, int | slice]] = {}


class FieldReader:
    """Fast access to some fields of models, rows and dicts; a missing field has the value `absent`."""

    def __init__(self, names: Sequence[str], absent: float | None = None) -> None:
        self.names, self._absent = tuple(names), absent
        self._readers: dict[type, Callable[[Any], tuple[Any, ...]]] = {}  # by type of message

    def __call__(self, message: object) -> tuple[Any, ...]:
        """Return the values in the order of `names`."""
        read = self._readers.get(type(message))
        if read is None:
            if len(self._readers) >= _MAX_READERS:
                self._readers.clear()
            read = self._readers[type(message)] = self._reader_of(message)
        return read(message)

    def _reader_of(self, message: object) -> Callable[[Any], tuple[Any, ...]]:
        """Return a function that reads the fields of messages of this type."""
        names = self.names
        absent = self._absent
        positions = getattr(message, "_positions", None)
        if isinstance(message, Mapping):
            return lambda fields: tuple([fields.get(name, absent) for name in names])
        if positions is None and all(hasattr(message, name) for name in names):
            return (
                attrgetter(*names) if len(names) > 1 else lambda model: (getattr(model, names[0]),)
            )
        if positions is None:
            return lambda model: tuple([getattr(model, name, absent) for name in names])
        known = [positions[name] for name in names if name in positions]
        # the publisher defines the fields of a topic that is not built in
        if len(known) < len(names):
            return lambda row: tuple(
                [row[positions[name]] if name in positions else absent for name in names]
            )
        return itemgetter(*known) if len(known) > 1 else itemgetter(slice(known[0], known[0] + 1))


class UpgradePlan(NamedTuple):
    """Mapping from the fields of a layout to those of the model.

    `provided`: the model's fields that receive a value, which are the keys of `names` and `converted`; `missing`: all
    others.
    `names`: the source field, for each field whose value is copied.
    `converted`: for each other field, the source fields (None for a missing array element) and the conversion.
    """

    provided: frozenset[str]
    missing: frozenset[str]
    names: Mapping[str, str]
    converted: Mapping[str, tuple[Sequence[str | None], Callable[..., Any]]]


class Definition(Generic[M_co]):
    """Metadata of one message, derived from its class.

    `name`: its name in PX4, such as VehicleAttitude. `model`: its Pydantic model.
    `types`: the PX4 type of every field of the model, in order; `has_text`: some are char arrays.
    `topics`, `older`: topics and older fields by name. `rules`: the rules for its fields.
    `flags`: for each flag, the fields that are valid while it is true.
    `always`: the fields present in every log, even the oldest. `caches`: see `cached_on_owner`.
    """

    def __init__(self, model: type[M_co]) -> None:
        self.name = model.__name__
        self.model = model
        self.types: Mapping[str, FieldType] = {
            name: next(mark for mark in field.metadata if isinstance(mark, FieldType))
            for name, field in model.__pydantic_fields__.items()
        }
        self.names = tuple(self.types)
        self.all_fields = frozenset(self.names)
        self.has_text = any(kind.is_text for kind in self.types.values())
        self.topics = {topic.name: topic for topic in model.TOPICS}
        self.older = {old.name: old for old in model.OLDER}
        self.rules = model.RULES
        self.flags = {flag: names for rule in model.RULES for flag, names in rule.flags.items()}
        self.always = frozenset(model.ALWAYS.split())
        self.caches: dict[object, Callable[..., Any]] = {}

    @cached_property
    def layouts(self) -> Mapping[str, Layout]:
        """PX4's layouts by name, oldest first; the last one has exactly the model's fields."""
        found = {
            layout.name: replace(layout, types=self._types_of(layout.text))
            for layout in self.model.LAYOUTS
        }
        if all(layout.wire is None for layout in found.values()):
            fields = list(self.types.items())
            own = next(
                (layout for layout in found.values() if list(layout.types.items()) == fields), None
            )
            own = replace(
                found.pop(own.name) if own else Layout(ALL, "*"), wire=0, types=self.types
            )
            found[own.name] = own
        return found

    @cached_property
    def current(self) -> Layout:
        """The layout with all fields of the model."""
        return list(self.layouts.values())[-1]

    @cached_property
    def validation(self) -> Validation:
        """Validation of fields and rows."""
        return Validation(self.types, self.rules)

    @cached_property
    def row(self) -> type[Row]:
        """The named tuple class of this message."""
        members: dict[str, Any] = {
            name: property(itemgetter(index)) for index, name in enumerate(self.names)
        }
        members |= {
            name: each for name, each in vars(self.model).items() if isinstance(each, property)
        }
        members |= {
            "_positions": {name: index for index, name in enumerate(self.names)},
            "_fields": self.names,
        }
        return type(f"{self.name}Row", (Row,), {**members, "__slots__": (), "DEFINITION": self})

    @cached_property
    def flat_row(self) -> type[FlatRow]:
        """The class of flattened values of this message."""
        return type(
            f"{self.name}FlatRow",
            (FlatRow,),
            {"__slots__": (), "_positions": positions_of(self.types)},
        )

    def layout_of_release(self, release: str) -> Layout | None:
        """Return the layout with this name or of this PX4 release; None if there is none."""
        if release in self.layouts or release not in RELEASES:
            return self.layouts.get(release)
        until = RELEASES[: RELEASES.index(release) + 1]
        return next((self.layouts[each] for each in reversed(until) if each in self.layouts), None)

    def find_layout(self, names: Iterable[str]) -> Layout | None:
        """Return the layout with exactly these field names in any order, or None."""
        given = frozenset(names)
        return next(
            (layout for layout in self.layouts.values() if given == layout.types.keys()), None
        )

    @cached_property
    def known_types(self) -> Mapping[str, Set[FieldType]]:
        """All types of each field, including those in older layouts."""
        known: dict[str, set[FieldType]] = {}
        for layout in self.layouts.values():
            for name, kind in layout.types.items():
                known.setdefault(name, set()).add(kind)
        return known

    def recorded_layout(self, provided: frozenset[str]) -> Layout:
        """Return the layout for recording messages that have these fields of the model.

        If the current layout is not one of PX4's, return PX4's layout with exactly these fields, if there is one.
        """
        return (
            self.current if self.current.name != ALL else self.find_layout(provided) or self.current
        )

    @cached_on_owner  # all messages of a stream have the same field names
    def plan(self, names: tuple[str, ...]) -> UpgradePlan:
        """Return the mapping from these fields, of any PX4 release, to the model; unknown names are ignored."""
        direct: dict[str, str] = {name: name for name in names if name in self.types}
        converted: dict[str, tuple[list[str | None], Callable[..., Any]]] = {}
        for old in (self.older[name] for name in names if name in self.older):
            for base, index in old.targets:
                if index is not None and base not in direct:
                    sources, _ = converted.setdefault(
                        base, ([None] * self.types[base].values, lambda *values: values)
                    )
                    sources[index] = old.name
                elif old.up and base not in direct:
                    converted.setdefault(base, ([old.name], old.up))
                elif base not in converted:
                    direct.setdefault(base, old.name)
        in_order = {name: direct[name] for name in self.types if name in direct}
        provided = frozenset({*direct, *converted})
        return UpgradePlan(provided, self.all_fields - provided, in_order, converted)

    def downgrade(self, values: Mapping[str, Any], layout: Layout) -> dict[str, object]:
        """Convert the model's values to a layout, in its order; fields without a fitting value are "not provided"."""
        found: dict[str, object] = {}
        for name, kind in layout.types.items():
            value, old = values.get(name, kind.absent), self.older.get(name)
            if old:
                base, index = old.targets[0]
                value = values[base] if index is None else values[base][index]
                value = old.down(value) if old.down else value
            if self.types.get(name) != kind and not (kind.length or kind.is_float):
                least, greatest = kind.limits
                value = value if least <= value <= greatest else kind.absent
            found[name] = value
        return found

    def meaning(self, name: str) -> str:
        """Return the unit and meaning of a field of any layout."""
        field = self.model.model_fields.get(name)
        return (
            field.description if field else self.older[name].doc if name in self.older else ""
        ) or ""

    def schema(self) -> dict[str, Any]:
        """Return the JSON Schema (2020-12), where NaN and infinities are strings, and the layouts.

        Each layout has its name, its number on the wire (or None), and its fields in order, with name and type.
        """
        schema = {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            **self.model.model_json_schema(),
        }
        for field in schema["properties"].values():
            # JSON has no NaN, and a writer should omit fields that are not provided
            field.pop("default", None)
        layouts = [
            {
                "name": layout.name,
                "wire": layout.wire,
                "fields": [
                    {"name": name, "type": str(kind)} for name, kind in layout.types.items()
                ],
            }
            for layout in self.layouts.values()
        ]
        return {"json_schema": schema, "layouts": layouts}

    def explain_unknown_field(self, name: str) -> str:
        """Return the error text for an unknown field, with suggestions."""
        base, bracket, _ = name.partition("[")
        near = (
            [base]
            if bracket and base in self.types
            else difflib.get_close_matches(name.lower(), self.names, 3, 0.5)
        )
        hint = (
            f"did you mean {' or '.join(near)}?"
            if near
            else f"'nedbus schema {self.name}' lists the fields"
        )
        return f"unknown field {name!r}: {hint}"

    def __repr__(self) -> str:
        return f"<Definition of {self.name}>"

    def __reduce__(self) -> tuple[object, ...]:
        return attrgetter("DEFINITION"), (self.model,)

    def _types_of(self, text: str) -> Mapping[str, FieldType]:
        base, *changes = (part.strip() for part in text.split(","))
        same = next((layout for layout in self.model.LAYOUTS if layout.name == base), None)
        if same or base == "*":
            fields = list((self._types_of(same.text) if same else self.types).items())
        else:
            fields = list(map(self._field, base.split()))
        for change in changes:
            if change.startswith("without "):
                removed = change.split()[1:]
                fields = [field for field in fields if field[0] not in removed]
            else:
                after, _, names = change.partition(":")
                index = [name for name, _ in fields].index(after) + 1
                fields[index:index] = map(self._field, names.split())
        return dict(fields)

    def _field(self, text: str) -> tuple[str, FieldType]:
        """Parse `name`, or `name:type` where the type overrides the model's."""
        name, _, kind = text.partition(":")
        if kind or name in self.types:
            return name, field_type(kind) if kind else self.types[name]
        old = self.older[name]
        base, index = old.targets[0]
        return name, field_type(
            old.type or (str(self.types[base]) if index is None else self.types[base].base)
        )


def upgrade_with(definition: Definition[M], fields: Mapping[str, object]) -> M:
    """Build a message from the fields of any PX4 release; arrays are tuples.

    Old names of fields are mapped to current ones, and unknown names are ignored.
    A missing field is "not provided": NaN, false or 0, and absent from `model_fields_set`.

    Raises pydantic.ValidationError for an invalid message.
    """
    return definition.model(**upgrade_fields(definition, fields))


def upgrade_fields(definition: Definition[Any], fields: Mapping[str, Any]) -> dict[str, Any]:
    """Convert the fields of any PX4 release to those of the model, as `upgrade_with` does, without validation."""
    plan = definition.plan(tuple(fields))
    upgraded = {name: fields[old] for name, old in plan.names.items()}
    for name, (olds, convert) in plan.converted.items():
        values = [NAN if old is None else fields[old] for old in olds]
        try:
            upgraded[name] = convert(*values)
        except (TypeError, OverflowError):  # not a number: the model rejects it
            (upgraded[name],) = values
    return upgraded


def _row(definition: Definition[Any], values: Values) -> Row:
    return tuple.__new__(definition.row, values)


MESSAGES: Final[dict[str, Definition[Any]]] = {}
"""Definitions of all registered messages by name: the built-in ones, and those of imported classes."""
TOPICS: Final[dict[str, Topic]] = {}
"""Topics of these messages by name."""
BY_TOPIC: Final[dict[str, Definition[Any]]] = {}
"""Definitions of these messages by topic."""


def register(definition: Definition[Any]) -> None:
    """Register a message; raise ValueError if its name or one of its topics is already registered."""
    if taken := [
        name for name in (definition.name, *definition.topics) if name in MESSAGES or name in TOPICS
    ]:
        raise ValueError(
            f"cannot register {definition.name}: {', '.join(taken)} already registered"
        )
    MESSAGES[definition.name] = definition
    for topic in definition.topics.values():
        TOPICS[topic.name], BY_TOPIC[topic.name] = topic, definition
