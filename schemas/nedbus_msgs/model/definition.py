"""Definition of a message in one object, made from the class in its file; everything else is derived from it."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, lru_cache
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, Self, TypeVar

from nedbus_msgs.errors import LayoutError

from .declaration import ALL, DEFAULT_TOPIC, EVERY, RELEASES, Layout, Older, Topic
from .px4_types import FieldType, field_type, type_of_marks
from .rules import Rule
from .validation import Validation, Values

if TYPE_CHECKING:
    from .message import Message

M = TypeVar("M", bound="Message")
M_co = TypeVar("M_co", bound="Message", covariant=True)


class Row(tuple[Any, ...]):
    """A message as a named tuple: a fraction of the time of a model, with the same fields in the same order.

    It is validated where it is decoded or encoded, not where it is made.
    For type checkers it is the message itself; `_fields` and `_asdict()` are those of any named tuple.
    """

    __slots__ = ()
    DEFINITION: ClassVar[Definition[Any]]
    _fields: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def _make(cls, values: Iterable[Any]) -> Self:
        return tuple.__new__(cls, values)

    def _asdict(self) -> dict[str, Any]:
        return dict(zip(self._fields, self, strict=True))

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value!r}" for name, value in self._asdict().items())
        return f"{type(self).__name__}({values})"

    def __reduce__(self) -> tuple[object, ...]:
        return _row, (self.DEFINITION, tuple(self))


class Plan(NamedTuple):
    """Mapping of the fields of some layout to those of the model.

    `names`: the field of the model, and that with its value. `converted`: the same, with a function of the value.
    `parts`: the field of the model, and those with its elements, None for an element that no field has.
    """

    names: Mapping[str, str]
    converted: Mapping[str, tuple[str, Callable[[Any], Any]]]
    parts: Mapping[str, tuple[str | None, ...]]

    @property
    def provided(self) -> frozenset[str]:
        """The fields of the model that get a value."""
        return frozenset({*self.names, *self.converted, *self.parts})


class Definition(Generic[M_co]):
    """Everything that is known of one message.

    `name`: PX4's name of it, such as VehicleAttitude. `model`: its Pydantic model.
    `types`: PX4's type of every field of the model, in its order.
    `topics`: by name. `layouts`: by name, oldest first; `current` is the one with the fields of the model.
    `wire_layouts`: those that a payload may have, by its first value, the number of the layout.
    `always`: the fields that it has in every log, however old.
    `aliases`: names of ROS 2 types that hold layouts of this message under another name, by layout.
    """

    def __init__(
        self,
        model: type[M_co],
        *,
        topics: Iterable[Topic] = (),
        layouts: Mapping[str, str] | None = None,
        wire: Mapping[int, str] | None = None,
        rules: Sequence[Rule] = (),
        older: Mapping[str, Older] | None = None,
        aliases: Mapping[str, Sequence[str]] | None = None,
        always: str = "timestamp",
    ) -> None:
        self.name = model.__name__
        self.model = model
        self.types: Mapping[str, FieldType] = {
            name: type_of_marks(field.metadata) for name, field in model.__pydantic_fields__.items()
        }
        self.names = tuple(self.types)
        self.all_fields = frozenset(self.names)
        self.topics = {topic.name: topic for topic in topics}
        self.rules = rules
        self.aliases = aliases or {}
        self.always = frozenset(always.split())
        self._older = older or {}
        self._wire, self._texts = wire, layouts or {}

    @cached_property
    def layouts(self) -> Mapping[str, Layout]:
        """PX4's layouts by name, oldest first; the last one is the model's own."""
        numbers = {name: number for number, name in (self._wire or {}).items()}
        found: dict[str, Layout] = {}
        for name, text in self._texts.items():
            try:
                types = self.types if text == EVERY else self._types_of(text, found)
            except (KeyError, ValueError) as exc:
                raise LayoutError(f"layout {name} of {self.name}: {exc}: no field or layout is called so") from None
            found[name] = Layout(name, numbers.get(name), types)
        if not self._wire:
            name = next(
                (name for name, layout in found.items() if [*layout.types.items()] == [*self.types.items()]), ALL
            )
            found.pop(name, None)
            found[name] = Layout(name, 0, self.types)
        return found

    @cached_property
    def wire_layouts(self) -> Mapping[int, Layout]:
        """The layouts that a payload may have, by its first value, the number of the layout."""
        return {layout.wire: layout for layout in self.layouts.values() if layout.wire is not None}

    @cached_property
    def current(self) -> Layout:
        """The layout with all fields of the model."""
        return list(self.layouts.values())[-1]

    @cached_property
    def validation(self) -> Validation:
        """Validation of fields, and of rows."""
        return Validation(self.types, self.rules)

    @cached_property
    def row(self) -> type[Row]:
        """The named tuple of this message."""
        places: dict[str, Any] = {name: property(itemgetter(index)) for index, name in enumerate(self.names)}
        return type(f"{self.name}Row", (Row,), {**places, "__slots__": (), "_fields": self.names, "DEFINITION": self})

    def get_layout(self, name: str) -> Layout:
        """Return a layout by its name; raise LayoutError for an unknown one."""
        try:
            return self.layouts[name]
        except KeyError:
            raise LayoutError(f"unknown layout {name!r}: choose from {', '.join(self.layouts)}") from None

    def layout_of_release(self, release: str) -> Layout | None:
        """Return the layout of a release of PX4, or that with this name; None for a message that it does not have."""
        if release in self.layouts or release not in RELEASES:
            return self.layouts.get(release)
        until = RELEASES[: RELEASES.index(release) + 1]
        return next((self.layouts[each] for each in reversed(until) if each in self.layouts), None)

    def find_layout(self, names: Iterable[str]) -> Layout | None:
        """Return the layout with exactly these field names, in any order, or None."""
        given = frozenset(names)
        return next((layout for layout in self.layouts.values() if given == layout.types.keys()), None)

    @cached_property
    def known_types(self) -> Mapping[str, frozenset[FieldType]]:
        """The types that each field has, or had in an older layout."""
        known = {name: frozenset({kind}) for name, kind in self.types.items()}
        for layout in self.layouts.values():
            for name, kind in layout.types.items():
                known[name] = known.get(name, frozenset()) | {kind}
        return known

    def recorded_layout(self, provided: frozenset[str]) -> Layout:
        """Return the layout to write messages in of which these fields of the model are provided.

        That is the current one, or where no layout of PX4 has all fields that of PX4 with just these.
        """
        if self.current.name != ALL:
            return self.current
        return next((layout for layout in self.layouts.values() if layout.types.keys() == provided), self.current)

    def plan(self, names: Iterable[str]) -> Plan:
        """Return how these fields, of any PX4 release, become those of the model; unknown names are ignored."""
        return _plan(self, tuple(names))

    def downgrade(self, values: Mapping[str, Any], layout: Layout) -> dict[str, object]:
        """Return the fields of an older layout, in that layout's order; what the model lacks is "not provided"."""
        return {name: self._down(name, kind, values) for name, kind in layout.types.items()}

    def meaning(self, name: str) -> str:
        """Return unit and meaning of a field of any layout."""
        field = self.model.model_fields.get(name)
        return (field.description if field else self._older[name].doc if name in self._older else "") or ""

    def explain_unknown_field(self, name: str) -> str:
        """Return what to say of a name that no field has: the names that may have been meant, if there are any."""
        base, bracket, _ = name.partition("[")
        near = [base] if bracket and base in self.types else difflib.get_close_matches(name.lower(), self.names, 3, 0.5)
        schema = "nedbus schema" if DEFAULT_TOPIC in self.topics else f"nedbus schema {self.name}"
        hint = f"did you mean {' or '.join(near)}?" if near else f"'{schema}' lists them"
        return f"there is no field {name!r}: {hint}"

    def __repr__(self) -> str:
        return f"<Definition of {self.name}>"

    def __reduce__(self) -> tuple[object, ...]:
        return attrgetter("DEFINITION"), (self.model,)

    def _types_of(self, text: str, before: Mapping[str, Layout]) -> Mapping[str, FieldType]:
        """Parse the fields of a layout, or its changes: `1.13, without a b, c: d e` has d and e behind c."""
        base, *changes = (part.strip() for part in text.split(","))
        if not changes:
            return dict(map(self._field, text.split()))
        fields = list(before[base].types.items())
        for change in changes:
            if change.startswith("without "):
                for gone in change.split()[1:]:
                    fields.remove((gone, dict(fields)[gone]))
            else:
                after, _, names = change.partition(":")
                place = [name for name, _ in fields].index(after) + 1
                fields[place:place] = map(self._field, names.split())
        return dict(fields)

    def _field(self, text: str) -> tuple[str, FieldType]:
        """Parse `name`, or `name:type` where the type is not the model's."""
        name, _, kind = text.partition(":")
        if kind:
            return name, field_type(kind)
        if name in self.types:
            return name, self.types[name]
        old = self._older[name]
        base, index = old.new[0]
        return name, old.type or (self.types[base] if index is None else FieldType(self.types[base].base))

    def _down(self, name: str, kind: FieldType, values: Mapping[str, Any]) -> object:
        if self.types.get(name) is kind:
            return values[name]
        value = values.get(name, kind.absent)
        if old := self._older.get(name):
            base, index = old.new[0]
            value = values[base] if index is None else values[base][index]
            value = old.down(value) if old.down else value
        least, greatest = kind.limits
        return value if kind.length or kind.is_float or least <= value <= greatest else kind.absent

    def make_plan(self, names: Sequence[str]) -> Plan:
        """Make what `plan` returns, and keeps."""
        older = {name: self._older[name] for name in names if name in self._older}
        direct: dict[str, str] = {name: name for name in names if name in self.types}
        converted: dict[str, tuple[str, Callable[[Any], Any]]] = {}
        parts: dict[str, list[str | None]] = {}
        for name, old in older.items():
            for base, index in old.new:
                if base in direct or base in converted:
                    continue
                if index is not None:
                    parts.setdefault(base, [None] * self.types[base].count)[index] = name
                elif old.up:
                    converted[base] = name, old.up
                else:
                    direct[base] = name
        in_order = {name: direct[name] for name in self.types if name in direct}
        return Plan(in_order, converted, {name: tuple(olds) for name, olds in parts.items()})


@lru_cache(256)  # all messages of a stream have the same names
def _plan(definition: Definition[Any], names: tuple[str, ...]) -> Plan:
    return definition.make_plan(names)


def _row(definition: Definition[Any], values: Values) -> Row:
    return tuple.__new__(definition.row, values)
