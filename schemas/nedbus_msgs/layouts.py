"""The one table of PX4's layouts of VehicleLocalPosition, and the conversion between them and the model.

A layout is found by its field names or given by its name; never by MESSAGE_VERSION, which two layouts share.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any, Final, cast

from .errors import LayoutError
from .position import VehicleLocalPosition
from .px4_types import TypeName
from .rows import FIELD_TYPES


@dataclass(frozen=True, slots=True)
class Layout:
    """One layout: its name (the first PX4 release with it), its number on the wire if any, its fields in order."""

    name: str
    wire: int | None
    fields: tuple[str, ...]

    def type_of(self, field: str) -> TypeName:
        """Return PX4's type of a field of this layout; no field ever changed its type."""
        return "float32" if field == "hagl_max" else FIELD_TYPES[field]


def _layout(name: str, wire: int | None, fields: str) -> Layout:
    return Layout(name, wire, tuple(fields.split()))


LAYOUTS: Final[Mapping[str, Layout]] = {
    layout.name: layout
    for layout in (
        _layout("1.13", None, """
            timestamp timestamp_sample xy_valid z_valid v_xy_valid v_z_valid
            x y z delta_xy xy_reset_counter delta_z z_reset_counter
            vx vy vz z_deriv delta_vxy vxy_reset_counter delta_vz vz_reset_counter ax ay az
            heading delta_heading heading_reset_counter heading_good_for_control
            xy_global z_global ref_timestamp ref_lat ref_lon ref_alt
            dist_bottom dist_bottom_valid dist_bottom_sensor_bitfield
            eph epv evh evv vxy_max vz_max hagl_min hagl_max"""),
        _layout("1.14", None, """
            timestamp timestamp_sample xy_valid z_valid v_xy_valid v_z_valid
            x y z delta_xy xy_reset_counter delta_z z_reset_counter
            vx vy vz z_deriv delta_vxy vxy_reset_counter delta_vz vz_reset_counter ax ay az
            heading delta_heading heading_reset_counter heading_good_for_control
            xy_global z_global ref_timestamp ref_lat ref_lon ref_alt
            dist_bottom dist_bottom_valid dist_bottom_sensor_bitfield
            eph epv evh evv dead_reckoning vxy_max vz_max hagl_min hagl_max"""),
        _layout("1.15", None, """
            timestamp timestamp_sample xy_valid z_valid v_xy_valid v_z_valid
            x y z delta_xy xy_reset_counter delta_z z_reset_counter
            vx vy vz z_deriv delta_vxy vxy_reset_counter delta_vz vz_reset_counter ax ay az
            heading heading_var unaided_heading delta_heading heading_reset_counter heading_good_for_control tilt_var
            xy_global z_global ref_timestamp ref_lat ref_lon ref_alt
            dist_bottom dist_bottom_valid dist_bottom_sensor_bitfield
            eph epv evh evv dead_reckoning vxy_max vz_max hagl_min hagl_max"""),
        _layout("V0", 0, """
            timestamp timestamp_sample xy_valid z_valid v_xy_valid v_z_valid
            x y z delta_xy xy_reset_counter delta_z z_reset_counter
            vx vy vz z_deriv delta_vxy vxy_reset_counter delta_vz vz_reset_counter ax ay az
            heading heading_var unaided_heading delta_heading heading_reset_counter heading_good_for_control tilt_var
            xy_global z_global ref_timestamp ref_lat ref_lon ref_alt
            dist_bottom_valid dist_bottom dist_bottom_var
            delta_dist_bottom dist_bottom_reset_counter dist_bottom_sensor_bitfield
            eph epv evh evv dead_reckoning vxy_max vz_max hagl_min hagl_max"""),
        Layout("1.16", 1, tuple(FIELD_TYPES)),
    )
}  # fmt: skip
"""PX4's layouts by name, oldest first; the last one is the model's own."""

CURRENT: Final = LAYOUTS["1.16"]
WIRE_LAYOUTS: Final[Mapping[int, Layout]] = {
    layout.wire: layout for layout in LAYOUTS.values() if layout.wire is not None
}
"""The layouts that a payload may have, by its first value, the layout number."""

_RENAMED: Final = {"yaw": "heading", "delta_yaw": "delta_heading", "yaw_reset_counter": "heading_reset_counter"}
"""Field names of 1.11 and before, and their present names."""


def find_layout(names: Iterable[str]) -> Layout | None:
    """Return the layout with exactly these field names, in any order, or None (1.12 and older are not in the table)."""
    given = frozenset(names)
    return next((layout for layout in LAYOUTS.values() if given == frozenset(layout.fields)), None)


def upgrade(fields: Mapping[str, object], layout: str | None = None) -> VehicleLocalPosition:
    """Return the message with these fields of any PX4 release; `delta_xy` and `delta_vxy` are tuples of 2.

    With the name of a layout, the fields must be exactly that layout's.
    Without, all known fields are used, `yaw` as `heading`, and unknown names are ignored.
    `hagl_max` becomes `hagl_max_z` and `hagl_max_xy`, as in PX4's own translation.
    A missing field is "not provided": NaN, false or 0, and absent from the message's `model_fields_set`.

    Raises LayoutError for other fields than the layout's, pydantic.ValidationError for an invalid message.
    """
    if layout is not None:
        require_fields(fields, get_layout(layout))
    return VehicleLocalPosition(**upgrade_fields(fields))


def upgrade_fields(fields: Mapping[str, object]) -> dict[str, Any]:
    """Return the fields of a message by the names of the current layout, as `upgrade` does, not validated yet."""
    return {name: fields[old] for name, old in upgraded_names(fields).items()}


def upgraded_names(names: Iterable[str]) -> Mapping[str, str]:
    """Return which of these names, of any PX4 release, provides each field of a message."""
    return _upgraded_names(tuple(names))


@lru_cache(64)  # all messages of a stream have the same names
def _upgraded_names(names: tuple[str, ...]) -> Mapping[str, str]:
    known = {_RENAMED.get(name, name): name for name in names}
    if "hagl_max" in known:
        known.setdefault("hagl_max_z", known["hagl_max"])
        known.setdefault("hagl_max_xy", known["hagl_max"])
    return MappingProxyType({name: known[name] for name in FIELD_TYPES if name in known})


def downgrade(message: VehicleLocalPosition, layout: str) -> dict[str, object]:
    """Return the message as the fields of an older layout, in that layout's order.

    `hagl_max` is `hagl_max_z`, as in PX4's own translation; fields that the layout lacks are dropped.

    Raises LayoutError for an unknown layout.
    """
    values: dict[str, object] = {**message.__dict__, "hagl_max": message.hagl_max_z}
    return {name: values[name] for name in get_layout(layout).fields}


def get_layout(name: str) -> Layout:
    """Return a layout by its name; raise LayoutError for an unknown one."""
    try:
        return LAYOUTS[name]
    except KeyError:
        raise LayoutError(f"unknown layout {name!r}: choose from {', '.join(LAYOUTS)}") from None


def require_fields(fields: Mapping[str, object], layout: Layout) -> None:
    """Raise LayoutError, with the missing and the unknown names, unless these are the layout's fields."""
    given, wanted = set(fields), set(layout.fields)
    if given == wanted:
        return
    problems = [
        f"{problem} {', '.join(sorted(names)[:5])}"
        for problem, names in (("missing", wanted - given), ("unknown", given - wanted))
        if names
    ]
    fitting = find_layout(cast("Iterable[str]", fields))
    hint = f"; these are the fields of layout {fitting.name}" if fitting else ""
    raise LayoutError(f"not the {len(layout.fields)} fields of layout {layout.name}: {'; '.join(problems)}{hint}")
