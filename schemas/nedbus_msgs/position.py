"""The message: PX4's VehicleLocalPosition as one validated, immutable Pydantic model.

Names, order, types and meaning follow PX4's `msg/versioned/VehicleLocalPosition.msg` (1.16 to main).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import itemgetter
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import CoreConfig, CoreSchema, InitErrorDetails, PydanticCustomError, SchemaValidator, core_schema

from .px4_types import FLOAT32_MAX, NAN, Bool, Float32, Float32x2, Float64, Px4Type, TypeName, Uint8, Uint64
from .rules import broken_rules, make_check

Values = tuple[object, ...]
"""The values of all fields, in PX4's order."""


class VehicleLocalPosition(BaseModel):
    """One local position estimate of one vehicle, in PX4's current layout (1.16 to main).

    Frame: local NED, metres, radians, seconds; z points down.
    The origin is where EKF2 started, or the global origin once that is set.
    x, y, z, vx, vy and vz hold numbers even while they are not valid: look at the flags.

    A float32 field holds the float32 nearest to what it was given, as a C float would, so that what you hold is what
    arrives, to the bit; what float32 cannot hold (1e39) is refused.
    A field that is not given is "not provided": NaN, false or 0, and absent from `model_fields_set`.

    Raises pydantic.ValidationError, with the field and the reason, for a wrong type, an unknown field or a broken rule.
    """

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", ser_json_inf_nan="strings")

    MESSAGE_VERSION: ClassVar[int] = 1
    DIST_BOTTOM_SENSOR_NONE: ClassVar[int] = 0
    DIST_BOTTOM_SENSOR_RANGE: ClassVar[int] = 1
    DIST_BOTTOM_SENSOR_FLOW: ClassVar[int] = 2

    timestamp: Uint64 = Field(description="Time since boot [us] (Unix time with uXRCE time sync and in some SITL logs)")
    timestamp_sample: Uint64 = Field(0, description="Time of the sensor data behind this estimate [us], <= timestamp")

    xy_valid: Bool = Field(False, description="x and y are valid")
    z_valid: Bool = Field(False, description="z is valid")
    v_xy_valid: Bool = Field(False, description="vx and vy are valid")
    v_z_valid: Bool = Field(False, description="vz is valid")

    x: Float32 = Field(NAN, description="North position [m] [local NED]")
    y: Float32 = Field(NAN, description="East position [m] [local NED]")
    z: Float32 = Field(NAN, description="Down position, negative altitude [m] [local NED]")
    delta_xy: Float32x2 = Field((NAN, NAN), description="Jump of x and y at their latest reset [m] [local NED]")
    xy_reset_counter: Uint8 = Field(0, description="Count of x, y resets, wraps at 255")
    delta_z: Float32 = Field(NAN, description="Jump of z at its latest reset [m] [local NED]")
    z_reset_counter: Uint8 = Field(0, description="Count of z resets, wraps at 255")

    vx: Float32 = Field(NAN, description="North velocity [m/s] [local NED]")
    vy: Float32 = Field(NAN, description="East velocity [m/s] [local NED]")
    vz: Float32 = Field(NAN, description="Down velocity [m/s] [local NED]")
    z_deriv: Float32 = Field(NAN, description="Time derivative of z [m/s] [local NED]")
    delta_vxy: Float32x2 = Field((NAN, NAN), description="Jump of vx and vy at their latest reset [m/s] [local NED]")
    vxy_reset_counter: Uint8 = Field(0, description="Count of vx, vy resets, wraps at 255")
    delta_vz: Float32 = Field(NAN, description="Jump of vz at its latest reset [m/s] [local NED]")
    vz_reset_counter: Uint8 = Field(0, description="Count of vz resets, wraps at 255")

    ax: Float32 = Field(NAN, description="North velocity derivative [m/s^2] [local NED]")
    ay: Float32 = Field(NAN, description="East velocity derivative [m/s^2] [local NED]")
    az: Float32 = Field(NAN, description="Down velocity derivative [m/s^2] [local NED]")

    heading: Float32 = Field(NAN, description="Euler yaw, body frame to local NED [rad], within [-pi, pi]")
    heading_var: Float32 = Field(NAN, description="Variance of heading [rad^2]")
    unaided_heading: Float32 = Field(NAN, description="Heading from gyros alone [rad]: only differences mean anything")
    delta_heading: Float32 = Field(NAN, description="Jump of heading at its latest reset [rad]")
    heading_reset_counter: Uint8 = Field(0, description="Count of heading resets, wraps at 255")
    heading_good_for_control: Bool = Field(False, description="heading is good enough to control the vehicle with")
    tilt_var: Float32 = Field(NAN, description="Variance of tilt [rad^2]")

    xy_global: Bool = Field(False, description="x and y have a global origin (ref_lat, ref_lon)")
    z_global: Bool = Field(False, description="z has a global origin (ref_alt)")
    ref_timestamp: Uint64 = Field(0, description="Time when the origin was set, since boot [us]")
    ref_lat: Float64 = Field(NAN, description="Latitude of the origin [deg] [WGS84], NaN while there is none")
    ref_lon: Float64 = Field(NAN, description="Longitude of the origin [deg] [WGS84], NaN while there is none")
    ref_alt: Float32 = Field(
        NAN, description="Altitude of the origin above mean sea level [m], NaN while there is none"
    )

    dist_bottom_valid: Bool = Field(False, description="dist_bottom is valid")
    dist_bottom: Float32 = Field(NAN, description="Distance down to the ground [m], written even when not valid")
    dist_bottom_var: Float32 = Field(NAN, description="Variance of the terrain estimate [m^2]")
    delta_dist_bottom: Float32 = Field(NAN, description="Jump of dist_bottom at its latest reset [m]")
    dist_bottom_reset_counter: Uint8 = Field(0, description="Count of dist_bottom resets, wraps at 255")
    dist_bottom_sensor_bitfield: Uint8 = Field(0, description="Sensors behind dist_bottom: 0 none, 1 range, 2 flow")

    eph: Float32 = Field(NAN, description="Standard deviation of north and east position combined [m]")
    epv: Float32 = Field(NAN, description="Standard deviation of down position [m]")
    evh: Float32 = Field(NAN, description="Standard deviation of north and east velocity combined [m/s]")
    evv: Float32 = Field(NAN, description="Standard deviation of down velocity [m/s]")

    dead_reckoning: Bool = Field(False, description="The position is estimated by dead reckoning")

    vxy_max: Float32 = Field(NAN, description="Limit of horizontal speed [m/s]; none: infinity (0 in ground truth)")
    vz_max: Float32 = Field(NAN, description="Limit of vertical speed [m/s]; none: infinity (0 in ground truth)")
    hagl_min: Float32 = Field(NAN, description="Least height above ground [m]; none: infinity (0 in ground truth)")
    hagl_max_z: Float32 = Field(NAN, description="Greatest height above ground for z control [m]; none: infinity")
    hagl_max_xy: Float32 = Field(NAN, description="Greatest height above ground for xy control [m]; none: infinity")

    if not TYPE_CHECKING:

        def __init__(self, /, **fields: object) -> None:
            if type(self) is not VehicleLocalPosition or not _fill_quickly(self, fields):
                super().__init__(**fields)

        # As Pydantic marks its own: validation of dicts and JSON goes on without passing through here.
        __init__.__pydantic_base_init__ = True

    @model_validator(mode="after")
    def _settle(self) -> Self:
        """Round float32 fields to float32, then check the rules between fields."""
        values = self.__dict__
        try:
            _round_to_float32(values)
        except OverflowError:
            raise _refuse(values, _too_large(values)) from None
        if not _is_sound(values):
            broken = list(broken_rules(values))
            if broken:
                raise _refuse(values, broken)
        return self

    def __eq__(self, other: object) -> bool:
        """Compare all fields; what is not a number on both sides is the same."""
        if not isinstance(other, VehicleLocalPosition):
            return NotImplemented
        return all(_is_same(value, other.__dict__[name]) for name, value in self.__dict__.items())

    def __hash__(self) -> int:
        return hash((self.timestamp, self.timestamp_sample))

    def model_copy(self, *, update: Mapping[str, object] | None = None, deep: bool = False) -> Self:
        """Return a copy; unlike Pydantic's own, one with updates is validated like any other message."""
        if not update:
            return super().model_copy(deep=deep)
        given = {name: self.__dict__[name] for name in self.model_fields_set}
        return type(self).model_validate({**given, **update})


def _is_same(one: object, other: object) -> bool:
    if isinstance(one, tuple) and isinstance(other, tuple):
        return all(map(_is_same, one, other))
    return one == other or (repr(one) == repr(other) == "nan")


def _px4_type(name: str) -> TypeName:
    marks = [mark for mark in VehicleLocalPosition.model_fields[name].metadata if isinstance(mark, Px4Type)]
    return marks[-1].name


FIELD_TYPES: Final[Mapping[str, TypeName]] = {name: _px4_type(name) for name in VehicleLocalPosition.model_fields}
"""PX4's type of every field, in PX4's order."""

_SCALARS = tuple(name for name, kind in FIELD_TYPES.items() if kind == "float32")
_PAIR, _OTHER_PAIR = (name for name, kind in FIELD_TYPES.items() if kind == "float32[2]")
_get_scalars = cast("Callable[[dict[str, object]], tuple[object, ...]]", itemgetter(*_SCALARS))
_FLOATS = struct.Struct(f"<{len(_SCALARS) + 4}f")
_is_sound = make_check({name: name for name in FIELD_TYPES})


def _round_to_float32(values: dict[str, Any]) -> None:
    """Put the nearest float32 into every float32 field; raise OverflowError for what is beyond its range."""
    floats = _FLOATS.unpack(_FLOATS.pack(*_get_scalars(values), *values[_PAIR], *values[_OTHER_PAIR]))
    values.update(zip(_SCALARS, floats, strict=False))  # the last four are the pairs'
    values[_PAIR], values[_OTHER_PAIR] = floats[-4:-2], floats[-2:]


def _too_large(values: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    for name, kind in FIELD_TYPES.items():
        value = values[name]
        numbers = (value,) if kind == "float32" else value if kind == "float32[2]" else ()
        for number in cast("tuple[float, ...]", numbers):
            if math.isfinite(number) and abs(number) > FLOAT32_MAX:
                yield name, f"is beyond the range of float32 (+-{FLOAT32_MAX:.9g})"


def _refuse(values: Mapping[str, object], broken: Iterable[tuple[str, str]]) -> ValidationError:
    """Build an error that names each field, so that it reads like Pydantic's own."""
    details: list[InitErrorDetails] = [
        {"type": PydanticCustomError("px4_rule", "{reason}", {"reason": reason}), "loc": (name,), "input": values[name]}
        for name, reason in broken
    ]
    return ValidationError.from_exception_data("VehicleLocalPosition", details)


# The quick lane: a row is validated by a validator made from the model's own schema, which takes a fifth of the time of
# the model's. What does not pass here is given to the model, which has the last word and the words for it.

NAMES: Final = tuple(FIELD_TYPES)
_ALL: Final = frozenset(NAMES)


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

_is_sound_row = make_check({name: place for place, name in enumerate(NAMES)})
_get_all = cast("Callable[[Mapping[str, object]], Values]", itemgetter(*NAMES))


def check_row(values: Values) -> Values | None:
    """Return the values, validated; None if the model should look at them."""
    try:
        row: Values = _VALIDATE(values)
    except ValidationError:
        return None
    return row if _is_sound_row(row) else None


def row_of(fields: Mapping[str, object]) -> Values | None:
    """Return the values of all fields in their order, validated; None if the model should look at them."""
    if len(fields) != len(NAMES):
        return None
    try:
        return check_row(_get_all(fields))
    except KeyError:  # another name among as many
        return None


def message_of(row: Values) -> VehicleLocalPosition:
    """Return the message of a row that was checked and holds float32, without checking it again."""
    message = VehicleLocalPosition.__new__(VehicleLocalPosition)
    _fill(message, dict(zip(NAMES, row, strict=True)))
    return message


def _fill_quickly(message: VehicleLocalPosition, fields: Mapping[str, object]) -> bool:
    """Fill a message with these fields; return False if Pydantic should do it, which also knows what is wrong."""
    row = row_of(fields)
    if row is None:
        return False
    values = dict(zip(NAMES, row, strict=True))
    try:
        _round_to_float32(values)
    except OverflowError:
        return False
    _fill(message, values)
    return True


def _fill(message: VehicleLocalPosition, values: dict[str, object]) -> None:
    _set_dict(message, values)
    _set_fields_set(message, _ALL)
    _set_extra(message, None)
    _set_private(message, None)


# What Pydantic's own validator sets on an instance; the model is frozen, so the way is by its slots.
_set_dict, _set_fields_set, _set_extra, _set_private = (
    cast("Callable[[VehicleLocalPosition, object], None]", vars(BaseModel)[slot].__set__)
    for slot in ("__dict__", "__pydantic_fields_set__", "__pydantic_extra__", "__pydantic_private__")
)
