"""The message: PX4's VehicleLocalPosition as one validated, immutable Pydantic model.

Names, order, types and meaning follow PX4's `msg/versioned/VehicleLocalPosition.msg` (1.16 to main).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Set
from typing import TYPE_CHECKING, ClassVar, Final, Self, cast

from pydantic import BaseModel, ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from .equivalents import to_python
from .fast_path import passes_rules, validate_fields
from .float32 import float32_overflows, name_rounded
from .px4_types import NAN, Bool, Float32, Float32x2, Float64, Uint8, Uint64
from .rows import NAMES, TEMPLATE, Row, Values, values_of
from .rules import violations


class VehicleLocalPosition(BaseModel):
    """One local position estimate of one vehicle, in PX4's current layout (1.16 to main).

    Frame: local NED, metres, radians, seconds; z points down.
    The origin is where EKF2 started, or the global origin once that is set.
    x, y, z, vx, vy and vz hold numbers even while they are invalid: check the flags.

    A float32 field holds the float32 nearest to the number given, as a C float would, so that a message is received
    bit for bit as it was made; a number beyond float32 (1e39) is rejected.
    A field that is not given is "not provided": NaN, false or 0, and absent from `model_fields_set`.

    Raises pydantic.ValidationError, with field and reason, for a wrong type, an unknown field or a violated rule.
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
            # A subclass may have validators of its own, which only Pydantic knows.
            values = validate_fields(fields) if type(self) is VehicleLocalPosition else None
            if values is None:
                super().__init__(**fields)
            else:
                _fill(self, values, _ALL if len(fields) == len(NAMES) else frozenset(fields))

        # As Pydantic marks its own constructor: validation of dicts and JSON does not call this one.
        __init__.__pydantic_base_init__ = True

    @model_validator(mode="wrap")
    @classmethod
    def _accept_equivalents(cls, fields: object, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """Validate, and where that fails once more with what NumPy and JSON have in place of Python's values."""
        try:
            return validate(fields)
        except ValidationError:
            if not isinstance(fields, dict):
                raise
            converted = to_python(fields)
            if all(converted[name] is value for name, value in fields.items()):
                raise
        return validate(converted)

    @model_validator(mode="after")
    def _round_and_check(self) -> Self:
        """Round float32 fields to float32, then check the rules between fields."""
        values = self.__dict__
        row = values_of(values)
        try:
            values.update(name_rounded(row))
        except OverflowError:
            raise _validation_error(values, float32_overflows(values)) from None
        if not passes_rules(row):
            broken = list(violations(values))
            if broken:
                raise _validation_error(values, broken)
        return self

    def __eq__(self, other: object) -> bool:
        """Compare all fields; NaN equals NaN."""
        if not isinstance(other, VehicleLocalPosition):
            return NotImplemented
        return all(_is_same(value, other.__dict__[name]) for name, value in self.__dict__.items())

    def __hash__(self) -> int:
        return hash((self.timestamp, self.timestamp_sample))

    def model_copy(self, *, update: Mapping[str, object] | None = None, deep: bool = False) -> Self:
        """Return a copy; unlike Pydantic's own, one with updates is validated."""
        if not update:
            return super().model_copy(deep=deep)
        given = {name: self.__dict__[name] for name in self.model_fields_set}
        return type(self).model_validate({**given, **update})


Message = VehicleLocalPosition | Row
"""A message, as a model or as a named tuple: what functions accept that only read its fields."""


def _is_same(one: object, other: object) -> bool:
    if isinstance(one, tuple) and isinstance(other, tuple):
        return all(map(_is_same, one, other))
    return one == other or (repr(one) == repr(other) == "nan")


def _validation_error(values: Mapping[str, object], broken: Iterable[tuple[str, str]]) -> ValidationError:
    """Build an error with an entry for each field, like Pydantic's own."""
    details: list[InitErrorDetails] = [
        {"type": PydanticCustomError("px4_rule", "{reason}", {"reason": reason}), "loc": (name,), "input": values[name]}
        for name, reason in broken
    ]
    return ValidationError.from_exception_data("VehicleLocalPosition", details)


def message_of(row: Values) -> VehicleLocalPosition:
    """Return the message of a row that is valid and rounded to float32, without validating it again."""
    message = VehicleLocalPosition.__new__(VehicleLocalPosition)
    values = TEMPLATE.copy()
    values.update(zip(NAMES, row, strict=True))
    _fill(message, values, _ALL)
    return message


def _fill(message: VehicleLocalPosition, values: dict[str, object], given: Set[str]) -> None:
    _set_dict(message, values)
    _set_fields_set(message, given)
    _set_extra(message, None)
    _set_private(message, None)


# What Pydantic's own validator sets on an instance (2.12 to 2.x); the model is frozen, so this sets its slots.
_ALL: Final = frozenset(NAMES)
_set_dict, _set_fields_set, _set_extra, _set_private = (
    cast("Callable[[VehicleLocalPosition, object], None]", vars(BaseModel)[slot].__set__)
    for slot in ("__dict__", "__pydantic_fields_set__", "__pydantic_extra__", "__pydantic_private__")
)
