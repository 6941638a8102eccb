"""VehicleLocalPosition: position and velocity of a vehicle, and their accuracy."""

from collections.abc import Collection, Mapping
from typing import ClassVar, Final

from nedbus_msgs.frames import GlobalPosition, Ned, to_global
from nedbus_msgs.model import Layout, Message, RenamedField, Topic
from nedbus_msgs.model.px4_types import (
    Bool,
    Float32,
    Float32x2,
    Float64,
    Uint8,
    Uint64,
    field,
    while_valid,
)
from nedbus_msgs.model.rules import (
    FLOAT32_PI,
    LONGITUDE_LIMIT,
    FiniteWhile,
    NotLater,
    NotNegative,
    Within,
)

_VALID: Final = {"xy_valid": "xy", "z_valid": "z", "v_xy_valid": "vxy", "v_z_valid": "vz"}
_WARNINGS: Final = {"dead_reckoning": "dead reckoning"}  # bad if set
DOUBT_FLAGS: Final = (*_VALID, *_WARNINGS)
"""The flags that can cast doubt on a position."""


class VehicleLocalPosition(Message):
    """One local position estimate of one vehicle, in PX4's current layout (1.16 to main).

    Frame: local NED, metres, radians, seconds; z points down.
    The origin is where EKF2 started, or the global origin once that is set.
    x, y, z, vx, vy and vz hold numbers even while they are invalid: check the flags.

    Numbers in float32 fields are rounded to the nearest float32, like a C float, so a message is received bit for bit
    as it was created; numbers beyond the range of float32, such as 1e39, are rejected.
    An omitted field is "not provided": NaN, false or 0, and absent from `model_fields_set`.

    Raises pydantic.ValidationError, with field and reason, for a wrong type, an unknown field or a broken rule.
    """

    TOPICS = (
        Topic(
            "vehicle_local_position",
            100.0,
            "EKF2, or the EKF2 selector in multi-EKF mode",
            priority="data_high",
        ),
        Topic("vehicle_local_position_groundtruth", 50.0, "simulators (SITL, HITL)"),
        Topic("external_ins_local_position", 50.0, "an external INS driver (VectorNav, ...)"),
        Topic(
            "estimator_local_position", 2.0, "each EKF2 instance in multi-EKF mode", instances=True
        ),
    )
    LAYOUTS = (
        Layout(
            "1.13",
            base="1.14",
            without="dead_reckoning",
        ),
        Layout(
            "1.14",
            base="1.15",
            without="heading_var unaided_heading tilt_var",
        ),
        Layout(
            "1.15",
            base="V0",
            without="dist_bottom dist_bottom_var delta_dist_bottom dist_bottom_reset_counter",
            insert_after={
                "ref_alt": "dist_bottom",
            },
        ),
        Layout(
            "V0",
            base="1.16",
            without="hagl_max_z hagl_max_xy",
            insert_after={
                "hagl_min": "hagl_max",
            },
            wire=0,
            aliases=(
                "px4_msgs_old/msg/VehicleLocalPositionV0",
                "px4_msgs/msg/VehicleLocalPositionV0",
            ),
        ),
        Layout("1.16", "*", wire=1),
    )
    ALWAYS = "timestamp x y z vx vy vz xy_valid z_valid v_xy_valid v_z_valid"
    OLDER = (
        # As in PX4's own translation:
        RenamedField("hagl_max", "hagl_max_z hagl_max_xy", doc="Maximum height above ground [m]"),
        # Up to 1.11:
        RenamedField("yaw", "heading"),
        RenamedField("delta_yaw", "delta_heading"),
        RenamedField("yaw_reset_counter", "heading_reset_counter"),
    )
    RULES = (
        FiniteWhile(
            xy_valid="x y", z_valid="z", v_xy_valid="vx vy", v_z_valid="vz", heading_good_for_control="heading",
            xy_global="ref_lat ref_lon", z_global="ref_alt", dist_bottom_valid="dist_bottom",
        ),
        NotNegative("heading_var", "tilt_var", "dist_bottom_var", "eph", "epv", "evh", "evv"),
        Within(heading=FLOAT32_PI, ref_lat=90.0, ref_lon=LONGITUDE_LIMIT),
        NotLater("timestamp_sample", "timestamp"),
    )  # fmt: skip

    MESSAGE_VERSION: ClassVar = 1
    DIST_BOTTOM_SENSOR_NONE, DIST_BOTTOM_SENSOR_RANGE, DIST_BOTTOM_SENSOR_FLOW = range(3)

    timestamp_sample: Uint64 = field("Time of the underlying sensor data [us], <= timestamp")
    xy_valid: Bool = field("x and y are valid")
    z_valid: Bool = field("z is valid")
    v_xy_valid: Bool = field("vx and vy are valid")
    v_z_valid: Bool = field("vz is valid")

    x: Float32 = field("North position [m] [local NED]")
    y: Float32 = field("East position [m] [local NED]")
    z: Float32 = field("Down position, negative altitude [m] [local NED]")
    delta_xy: Float32x2 = field("Jump of x and y at their latest reset [m] [local NED]")
    xy_reset_counter: Uint8 = field("Count of x, y resets, wraps at 255")
    delta_z: Float32 = field("Jump of z at its latest reset [m] [local NED]")
    z_reset_counter: Uint8 = field("Count of z resets, wraps at 255")

    vx: Float32 = field("North velocity [m/s] [local NED]")
    vy: Float32 = field("East velocity [m/s] [local NED]")
    vz: Float32 = field("Down velocity [m/s] [local NED]")
    z_deriv: Float32 = field("Time derivative of z [m/s] [local NED]")
    delta_vxy: Float32x2 = field("Jump of vx and vy at their latest reset [m/s] [local NED]")
    vxy_reset_counter: Uint8 = field("Count of vx, vy resets, wraps at 255")
    delta_vz: Float32 = field("Jump of vz at its latest reset [m/s] [local NED]")
    vz_reset_counter: Uint8 = field("Count of vz resets, wraps at 255")

    ax: Float32 = field("North velocity derivative [m/s^2] [local NED]")
    ay: Float32 = field("East velocity derivative [m/s^2] [local NED]")
    az: Float32 = field("Down velocity derivative [m/s^2] [local NED]")

    heading: Float32 = field("Euler yaw, body frame to local NED [rad], within [-pi, pi]")
    heading_var: Float32 = field("Variance of heading [rad^2]")
    unaided_heading: Float32 = field(
        "Heading from gyros alone [rad]; only differences are meaningful"
    )
    delta_heading: Float32 = field("Jump of heading at its latest reset [rad]")
    heading_reset_counter: Uint8 = field("Count of heading resets, wraps at 255")
    heading_good_for_control: Bool = field("heading is good enough for control")
    tilt_var: Float32 = field("Variance of tilt [rad^2]")

    xy_global: Bool = field("x and y have a global origin (ref_lat, ref_lon)")
    z_global: Bool = field("z has a global origin (ref_alt)")
    ref_timestamp: Uint64 = field("Time when the origin was set, since boot [us]")
    ref_lat: Float64 = field("Latitude of the origin [deg] [WGS84], NaN if none")
    ref_lon: Float64 = field("Longitude of the origin [deg] [WGS84], NaN if none")
    ref_alt: Float32 = field("Altitude of the origin above mean sea level [m], NaN if none")

    dist_bottom_valid: Bool = field("dist_bottom is valid")
    dist_bottom: Float32 = field("Distance to the ground [m], written even while invalid")
    dist_bottom_var: Float32 = field("Variance of the terrain estimate [m^2]")
    delta_dist_bottom: Float32 = field("Jump of dist_bottom at its latest reset [m]")
    dist_bottom_reset_counter: Uint8 = field("Count of dist_bottom resets, wraps at 255")
    dist_bottom_sensor_bitfield: Uint8 = field(
        "Sensors used for dist_bottom: 0 none, 1 range, 2 flow"
    )

    eph: Float32 = field("Standard deviation of north and east position combined [m]")
    epv: Float32 = field("Standard deviation of down position [m]")
    evh: Float32 = field("Standard deviation of north and east velocity combined [m/s]")
    evv: Float32 = field("Standard deviation of down velocity [m/s]")
    dead_reckoning: Bool = field("The position is estimated by dead reckoning")

    vxy_max: Float32 = field(
        "Maximum horizontal speed [m/s]; infinity if unlimited (0 in ground truth)"
    )
    vz_max: Float32 = field(
        "Maximum vertical speed [m/s]; infinity if unlimited (0 in ground truth)"
    )
    hagl_min: Float32 = field(
        "Minimum height above ground [m]; infinity if unlimited (0 in ground truth)"
    )
    hagl_max_z: Float32 = field(
        "Maximum height above ground for z control [m]; infinity if unlimited"
    )
    hagl_max_xy: Float32 = field(
        "Maximum height above ground for xy control [m]; infinity if unlimited"
    )

    position: ClassVar = while_valid(Ned, "x, y and z [m] [local NED]", "xy_valid", "z_valid")
    velocity: ClassVar = while_valid(
        Ned, "vx, vy and vz [m/s] [local NED]", "v_xy_valid", "v_z_valid"
    )
    height: ClassVar = while_valid(float.__neg__, "-z, height above the origin [m]", "z_valid")
    height_above_ground: ClassVar = while_valid(float, "dist_bottom [m]", "dist_bottom_valid")
    good_heading: ClassVar = while_valid(
        float, "heading, good for control [rad]", "heading_good_for_control"
    )
    origin: ClassVar = while_valid(
        GlobalPosition.wrapped, "ref_lat, ref_lon [deg], ref_alt [m]", "xy_global", "z_global"
    )

    @property
    def global_position(self) -> GlobalPosition | None:
        """Position as latitude, longitude [deg] [WGS84] and altitude [m]; None without position and origin."""
        if self.position and self.origin:
            return to_global(self)
        return None


def describe_flags(shares: Mapping[str, float]) -> str:
    """Describe the flags that cast doubt on messages, given each flag's share of messages with it set (0 to 1).

    "xy z invalid, dead reckoning" applies to all messages, "xy invalid 20 %" to some; "ok" means that no flag is bad.
    A flag without a share is unknown: "vz unknown", or "validity unknown" if all are.
    """
    bad = {name: 1.0 - shares[name] for name in _VALID if name in shares}
    bad |= {name: shares[name] for name in _WARNINGS if name in shares}
    invalid = [label for name, label in _VALID.items() if bad.get(name, 0.0) >= 1.0]
    unknown = [label for name, label in _VALID.items() if name not in shares]
    texts = []
    if invalid:
        texts.append(f"{' '.join(invalid)} invalid")
    if len(unknown) == len(_VALID):
        texts.append("validity unknown")
    elif unknown:
        texts.append(f"{' '.join(unknown)} unknown")
    for name, share in bad.items():
        text = _WARNINGS.get(name) or f"{_VALID[name]} invalid"
        if 0.0 < share < 1.0:
            texts.append(f"{text} {min(99, max(1, round(100 * share)))} %")
        elif share >= 1.0 and name in _WARNINGS:
            texts.append(text)
    return ", ".join(texts) or "ok"


def message_doubts(message: VehicleLocalPosition, missing: Collection[str] = ()) -> str:
    """Describe the flags that cast doubt on one message, which lacks the `missing` fields; "ok" if none does."""
    return describe_flags(
        {name: float(getattr(message, name)) for name in DOUBT_FLAGS if name not in missing}
    )
