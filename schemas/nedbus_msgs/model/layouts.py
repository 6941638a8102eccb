"""The conversion between PX4's layouts of a message and its model.

A layout is found by its field names or given by its name; never by MESSAGE_VERSION, which two layouts may share.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

from nedbus_msgs.errors import LayoutError

from .declaration import Layout
from .definition import Definition, M
from .px4_types import NAN


def upgrade_with(definition: Definition[M], fields: Mapping[str, object]) -> M:
    """Return the message with these fields of any PX4 release; arrays are tuples.

    Known fields are used, by their present name, and unknown names are ignored.
    A missing field is "not provided": NaN, false or 0, and absent from the message's `model_fields_set`.

    Raises pydantic.ValidationError for an invalid message.
    """
    return definition.model(**upgrade_fields(definition, fields))


def upgrade_fields(definition: Definition[Any], fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a message by their names in the model, as `upgrade` does, not validated yet."""
    plan = definition.plan(fields)
    upgraded = {name: fields[old] for name, old in plan.names.items()}
    if plan.converted or plan.parts:
        upgraded |= {name: _converted(convert, fields[old]) for name, (old, convert) in plan.converted.items()}
        for name, olds in plan.parts.items():
            upgraded[name] = tuple(NAN if old is None else fields[old] for old in olds)
    return upgraded


def _converted(convert: Callable[[Any], Any], value: object) -> object:
    """Return a converted value; anything but a number stays as it is, for the model to reject."""
    try:
        return convert(value)
    except (TypeError, OverflowError):
        return value


def require_fields(definition: Definition[Any], fields: Mapping[str, object], layout: Layout) -> None:
    """Raise LayoutError, with the missing and the unknown names, unless these are the layout's fields."""
    given, wanted = set(fields), set(layout.types)
    if given == wanted:
        return
    problems = [
        f"{problem} {', '.join(sorted(names)[:5])}"
        for problem, names in (("missing", wanted - given), ("unknown", given - wanted))
        if names
    ]
    fitting = definition.find_layout(cast("Iterable[str]", fields))
    hint = f"; these are the fields of layout {fitting.name}" if fitting else ""
    raise LayoutError(f"not the {len(wanted)} fields of layout {layout.name}: {'; '.join(problems)}{hint}")
