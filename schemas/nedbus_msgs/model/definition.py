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

from nedbus_msgs import limits

from .declaration import ALL, RELEASES, Layout, RenamedField, Topic, cached_on_owner
from .px4_types import NAN, FieldType, field_type
from .validation import Validation, Values, positions_of

if TYPE_CHECKING:
    from .message import Message

_CLOSE_NAME: Final = 0.5  # minimum similarity of a field that an error suggests
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
        self.names = tuple(names)
        self._absent = absent
        self._readers: dict[type, Callable[[Any], tuple[Any, ...]]] = {}  # by type of message

    def __call__(self, message: object) -> tuple[Any, ...]:
        """Return the values in the order of `names`."""
        read = self._readers.get(type(message))
        if read is None:
            # A definition that arrives at run time has an own type of rows.
            if len(self._readers) >= limits.FIELD_READERS:
                self._readers.clear()
            read = self._reader_of(message)
            self._readers[type(message)] = read
        return read(message)

    def _reader_of(self, message: object) -> Callable[[Any], tuple[Any, ...]]:
        """Return a function that reads the fields of messages of this type."""
        names = self.names
        absent = self._absent
        if isinstance(message, Mapping):
            return lambda fields: tuple([fields.get(name, absent) for name in names])
        positions = getattr(message, "_positions", None)
        if positions is not None:
            return self._reader_of_rows(positions)
        if len(names) == 1:
            only = names[0]
            return lambda model: (getattr(model, only, absent),)
        if all(hasattr(message, name) for name in names):
            return attrgetter(*names)
        return lambda model: tuple([getattr(model, name, absent) for name in names])

    def _reader_of_rows(self, positions: Mapping[str, Any]) -> Callable[[Any], tuple[Any, ...]]:
        names = self.names
        absent = self._absent
        known = [positions[name] for name in names if name in positions]
        # the publisher defines the fields of a topic that is not built in
        if len(known) < len(names):
            return lambda row: tuple(
                [row[positions[name]] if name in positions else absent for name in names]
            )
        if len(known) == 1:
            return itemgetter(slice(known[0], known[0] + 1))
        return itemgetter(*known)


class FieldConversion(NamedTuple):
    """A field of the model that is computed from other fields; `sources`: None for a missing element of an array."""

    sources: list[str | None]
    convert: Callable[..., Any]


class UpgradePlan(NamedTuple):
    """Mapping from the fields of a layout to those of the model.

    `provided`: the model's fields that receive a value, which are the keys of `names` and `converted`; `missing`: all
    others.
    `names`: the source field, for each field whose value is copied.
    `converted`: the conversion of each other field.
    """

    provided: frozenset[str]
    missing: frozenset[str]
    names: Mapping[str, str]
    converted: Mapping[str, FieldConversion]


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
        self.types: Mapping[str, FieldType] = _types_of_model(model)
        self.names = tuple(self.types)
        self.all_fields = frozenset(self.names)
        self.has_text = any(kind.is_text for kind in self.types.values())
        self.topics = {topic.name: topic for topic in model.TOPICS}
        self.older = {old.name: old for old in model.OLDER}
        self.rules = model.RULES
        self.flags: dict[str, Sequence[str]] = {}
        for rule in model.RULES:
            self.flags.update(rule.flags)
        self.always = frozenset(model.ALWAYS.split())
        self.caches: dict[object, Callable[..., Any]] = {}

    @cached_property
    def layouts(self) -> Mapping[str, Layout]:
        """PX4's layouts by name, oldest first; the last one has exactly the model's fields."""
        layouts = {
            layout.name: replace(layout, types=self._types_of(layout))
            for layout in self.model.LAYOUTS
        }
        if all(layout.wire is None for layout in layouts.values()):
            # Without a declared number on the wire, the model's own fields have number 0.
            own = Layout(ALL)
            types = list(self.types.items())
            for layout in list(layouts.values()):
                if list(layout.types.items()) == types:
                    own = layouts.pop(layout.name)
                    break
            layouts[own.name] = replace(own, wire=0, types=self.types)
        return layouts

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
        positions = {name: index for index, name in enumerate(self.names)}
        members: dict[str, Any] = {
            "DEFINITION": self,
            "_fields": self.names,
            "_positions": positions,
            "__slots__": (),
        }
        for name, index in positions.items():
            members[name] = property(itemgetter(index))
        for name, member in vars(self.model).items():
            if isinstance(member, property):
                members[name] = member
        return type(f"{self.name}Row", (Row,), members)

    @cached_property
    def flat_row(self) -> type[FlatRow]:
        """The class of flattened values of this message."""
        positions = positions_of(self.types)
        members: dict[str, Any] = {"__slots__": (), "_positions": positions}
        return type(f"{self.name}FlatRow", (FlatRow,), members)

    def layout_of_release(self, release: str) -> Layout | None:
        """Return the layout with this name or of this PX4 release; None if there is none."""
        if release not in RELEASES:
            return self.layouts.get(release)
        index = RELEASES.index(release)
        until = RELEASES[: index + 1]
        for earlier in reversed(until):
            if earlier in self.layouts:
                return self.layouts[earlier]
        return None

    def find_layout(self, names: Iterable[str]) -> Layout | None:
        """Return the layout with exactly these field names in any order, or None."""
        given = frozenset(names)
        for layout in self.layouts.values():
            if given == layout.types.keys():
                return layout
        return None

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
        if self.current.name != ALL:
            return self.current
        return self.find_layout(provided) or self.current

    @cached_on_owner  # all messages of a stream have the same field names
    def plan(self, names: tuple[str, ...]) -> UpgradePlan:
        """Return the mapping from these fields, of any PX4 release, to the model; unknown names are ignored."""
        copied: dict[str, str] = {name: name for name in names if name in self.types}
        converted: dict[str, FieldConversion] = {}
        for name in names:
            older = self.older.get(name)
            if older is not None:
                self._add_older_field(older, copied, converted)
        in_order = {name: copied[name] for name in self.types if name in copied}
        provided = frozenset([*copied, *converted])
        missing = self.all_fields - provided
        return UpgradePlan(provided, missing, in_order, converted)

    def _add_older_field(
        self,
        older: RenamedField,
        copied: dict[str, str],
        converted: dict[str, FieldConversion],
    ) -> None:
        """Add the model's fields that receive the value of a field of older layouts."""
        for name, index in older.targets:
            if name in copied:
                continue
            if index is not None:
                sources: list[str | None] = [None] * self.types[name].values
                empty = FieldConversion(sources, _as_array)
                conversion = converted.setdefault(name, empty)
                conversion.sources[index] = older.name
            elif older.up:
                conversion = FieldConversion([older.name], older.up)
                converted.setdefault(name, conversion)
            elif name not in converted:
                copied[name] = older.name

    def downgrade(self, values: Mapping[str, Any], layout: Layout) -> dict[str, object]:
        """Convert the model's values to a layout, in its order; fields without a fitting value are "not provided"."""
        fields: dict[str, object] = {}
        for name, kind in layout.types.items():
            older = self.older.get(name)
            value = values.get(name, kind.absent)
            if older is not None:
                value = _older_value(older, values)
            is_integer = not kind.length and not kind.is_float
            if is_integer and self.types.get(name) != kind:
                least, greatest = kind.limits
                if not least <= value <= greatest:
                    value = kind.absent
            fields[name] = value
        return fields

    def meaning(self, name: str) -> str:
        """Return the unit and meaning of a field of any layout."""
        field = self.model.model_fields.get(name)
        if field is not None:
            return field.description or ""
        if name in self.older:
            return self.older[name].doc
        return ""

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
        layouts = []
        for layout in self.layouts.values():
            fields = [{"name": name, "type": str(kind)} for name, kind in layout.types.items()]
            layouts.append({"name": layout.name, "wire": layout.wire, "fields": fields})
        return {"json_schema": schema, "layouts": layouts}

    def explain_unknown_field(self, name: str) -> str:
        """Return the error text for an unknown field, with suggestions."""
        base, bracket, _ = name.partition("[")
        similar = difflib.get_close_matches(name.lower(), self.names, 3, _CLOSE_NAME)
        if bracket and base in self.types:
            similar = [base]
        hint = f"'nedbus schema {self.name}' lists the fields"
        if similar:
            hint = f"did you mean {' or '.join(similar)}?"
        return f"unknown field {name!r}: {hint}"

    def __repr__(self) -> str:
        return f"<Definition of {self.name}>"

    def __reduce__(self) -> tuple[object, ...]:
        return attrgetter("DEFINITION"), (self.model,)

    def _types_of(self, layout: Layout) -> Mapping[str, FieldType]:
        """Return the fields of a layout with their types, in order."""
        removed = layout.without.split()
        before = self._types_before_changes(layout)
        names = [name for name in before if name not in removed]
        for previous, inserted in layout.insert_after.items():
            position = names.index(previous) + 1
            names[position:position] = inserted.split()
        return {name: before.get(name) or self._type_of(name, layout) for name in names}

    def _types_before_changes(self, layout: Layout) -> Mapping[str, FieldType]:
        if layout.base:
            by_name = {other.name: other for other in self.model.LAYOUTS}
            return self._types_of(by_name[layout.base])
        if layout.text == "*":
            return self.types
        return {name: self._type_of(name, layout) for name in layout.text.split()}

    def _type_of(self, name: str, layout: Layout) -> FieldType:
        """Return the type of a field that the text of a layout names."""
        if name in layout.other_types:
            return field_type(layout.other_types[name])
        if name in self.types:
            return self.types[name]
        older = self.older[name]
        if older.type:
            return field_type(older.type)
        base, index = older.targets[0]
        if index is None:
            return self.types[base]
        return field_type(self.types[base].base)


def _types_of_model(model: type[Message]) -> dict[str, FieldType]:
    """Return PX4's type of each field of a model, which its annotation has."""
    return {
        name: mark
        for name, field in model.__pydantic_fields__.items()
        for mark in field.metadata
        if isinstance(mark, FieldType)
    }


def _as_array(*elements: object) -> tuple[object, ...]:
    return elements


def _older_value(older: RenamedField, values: Mapping[str, Any]) -> Any:
    """Return the value of a field of older layouts, from the values of the model."""
    name, index = older.targets[0]
    value = values[name]
    if index is not None:
        value = value[index]
    if older.down is None:
        return value
    return older.down(value)


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
    for name, conversion in plan.converted.items():
        values = [NAN if old is None else fields[old] for old in conversion.sources]
        try:
            upgraded[name] = conversion.convert(*values)
        except (TypeError, OverflowError):  # not a number: the model rejects it
            upgraded[name] = values[0]
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
    names = [definition.name, *definition.topics]
    taken = [name for name in names if name in MESSAGES or name in TOPICS]
    if taken:
        raise ValueError(
            f"cannot register {definition.name}: {', '.join(taken)} already registered"
        )
    MESSAGES[definition.name] = definition
    for name, topic in definition.topics.items():
        TOPICS[name] = topic
        BY_TOPIC[name] = definition
