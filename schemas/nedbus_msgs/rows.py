"""A message as a row: its fields in PX4's order, checked by the model's own validators and rules, five times as fast.

Nothing is listed here a second time: validator, names and rules come from the model and its tables.
What the quick checks here do not pass is given to the model, which has the last word and the words for it.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

from pydantic import BaseModel, ValidationError
from pydantic_core import CoreConfig, CoreSchema, SchemaValidator, core_schema

from .position import FIELD_TYPES, VehicleLocalPosition
from .rules import make_check

NAMES: Final = tuple(FIELD_TYPES)
_ALL: Final = frozenset(NAMES)

if TYPE_CHECKING:

    class Row(VehicleLocalPosition):
        """A message as a named tuple, with the fields of VehicleLocalPosition."""

        _fields: ClassVar[tuple[str, ...]]

        def _asdict(self) -> dict[str, Any]: ...

        @classmethod
        def _make(cls, iterable: Sequence[object]) -> Row: ...
else:
    Row = namedtuple("Row", NAMES, module=__name__)
    Row.__doc__ = "A message as a named tuple, with the fields of VehicleLocalPosition."


def _field_schemas() -> list[CoreSchema]:
    schema = cast("Mapping[str, object]", VehicleLocalPosition.__pydantic_core_schema__)
    while "fields" not in schema:  # the model's own validators are around the fields
        schema = cast("Mapping[str, object]", schema["schema"])
    fields = cast("Mapping[str, Mapping[str, Mapping[str, object]]]", schema["fields"])
    found = (fields[name]["schema"] for name in NAMES)
    # A row has all fields: what stands around some of them is a default.
    return [cast("CoreSchema", each["schema"] if each["type"] == "default" else each) for each in found]


_VALIDATE: Final = SchemaValidator(
    core_schema.tuple_positional_schema(_field_schemas()), CoreConfig(strict=True)
).validate_python

Values = tuple[object, ...]
_is_sound = make_check({name: place for place, name in enumerate(NAMES)})
_get_all = cast("Callable[[Mapping[str, object]], Values]", itemgetter(*NAMES))


def check_row(values: Values) -> Values | None:
    """Return the values, validated; None if the model should look at them."""
    try:
        row: Values = _VALIDATE(values)
    except ValidationError:
        return None
    return row if _is_sound(row) else None


def row_of(fields: Mapping[str, object]) -> Values | None:
    """Return the values of all fields in their order, validated; None if the model should look at them."""
    if len(fields) != len(NAMES):
        return None
    try:
        return check_row(_get_all(fields))
    except KeyError:  # another name among as many
        return None


def message_of(row: Values) -> VehicleLocalPosition:
    """Return the message of a row that was checked, without checking it again."""
    message = VehicleLocalPosition.__new__(VehicleLocalPosition)
    _set_dict(message, dict(zip(NAMES, row, strict=True)))
    _set_fields_set(message, _ALL)
    _set_extra(message, None)
    _set_private(message, None)
    return message


# What Pydantic's own validator sets on an instance; the model is frozen, so the way is by its slots.
_set_dict, _set_fields_set, _set_extra, _set_private = (
    cast("Callable[[VehicleLocalPosition, object], None]", vars(BaseModel)[slot].__set__)
    for slot in ("__dict__", "__pydantic_fields_set__", "__pydantic_extra__", "__pydantic_private__")
)
