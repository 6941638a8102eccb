"""A message as a named tuple, and the names and types of its fields, which the rest is derived from."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from operator import itemgetter
from typing import Final, NamedTuple, cast, get_type_hints

from .px4_types import Bool, Float32, Float32x2, Float64, TypeName, Uint8, Uint64, type_name


class Row(NamedTuple):
    """A message as a named tuple, with the fields of VehicleLocalPosition in PX4's order.

    It takes a fraction of the time of a model, and is validated where it is decoded or encoded, not where it is made.
    """

    timestamp: Uint64
    timestamp_sample: Uint64

    xy_valid: Bool
    z_valid: Bool
    v_xy_valid: Bool
    v_z_valid: Bool

    x: Float32
    y: Float32
    z: Float32
    delta_xy: Float32x2
    xy_reset_counter: Uint8
    delta_z: Float32
    z_reset_counter: Uint8

    vx: Float32
    vy: Float32
    vz: Float32
    z_deriv: Float32
    delta_vxy: Float32x2
    vxy_reset_counter: Uint8
    delta_vz: Float32
    vz_reset_counter: Uint8

    ax: Float32
    ay: Float32
    az: Float32

    heading: Float32
    heading_var: Float32
    unaided_heading: Float32
    delta_heading: Float32
    heading_reset_counter: Uint8
    heading_good_for_control: Bool
    tilt_var: Float32

    xy_global: Bool
    z_global: Bool
    ref_timestamp: Uint64
    ref_lat: Float64
    ref_lon: Float64
    ref_alt: Float32

    dist_bottom_valid: Bool
    dist_bottom: Float32
    dist_bottom_var: Float32
    delta_dist_bottom: Float32
    dist_bottom_reset_counter: Uint8
    dist_bottom_sensor_bitfield: Uint8

    eph: Float32
    epv: Float32
    evh: Float32
    evv: Float32

    dead_reckoning: Bool

    vxy_max: Float32
    vz_max: Float32
    hagl_min: Float32
    hagl_max_z: Float32
    hagl_max_xy: Float32


Values = tuple[object, ...]
"""The values of all fields, in PX4's order."""

FIELD_TYPES: Final[Mapping[str, TypeName]] = {
    name: type_name(hint) for name, hint in get_type_hints(Row, include_extras=True).items()
}
"""PX4's type of every field, in PX4's order."""

NAMES: Final = Row._fields

values_of: Final = cast("Callable[[Mapping[str, object]], Values]", itemgetter(*NAMES))
"""Return the values of all fields in PX4's order from a mapping that has them; raise KeyError if it lacks one."""


def explain_unknown_field(name: str) -> str:
    """Return what to say of a name that no field has: the names that may have been meant, if there are any."""
    near = difflib.get_close_matches(name.lower(), FIELD_TYPES, 3, 0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else "'nedbus schema' lists them"
    return f"there is no field {name!r}: {hint}"


TEMPLATE: Final[dict[str, object]] = dict.fromkeys(NAMES)
"""All names in PX4's order: a copy that is filled takes less time than a dict that grows."""
