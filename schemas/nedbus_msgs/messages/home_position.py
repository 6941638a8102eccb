"""HomePosition: the point to which the vehicle returns."""

from typing import ClassVar

from nedbus_msgs.frames import GlobalPosition, Ned
from nedbus_msgs.model import LONGITUDE_LIMIT, FiniteWhile, Layout, Message, Topic, Within
from nedbus_msgs.model.px4_types import Bool, Float32, Float64, Uint32, field, while_valid


class HomePosition(Message):
    """Home position of a vehicle, the point to which it returns, in global coordinates and in local NED.

    Horizontal position, altitude and local position each have a validity flag; invalid values are mostly 0, not NaN.
    PX4 publishes it when home is set or moved, which may be minutes apart: keep the last one.
    valid_attitude exists in main only; up to 1.18 the validity of roll, pitch and yaw is unknown.
    x, y and z become outdated when the estimator moves the origin of local NED.
    """

    TOPICS = (
        Topic("home_position", 0.0, "the commander, when home is set or moved", on_change=True),
    )
    LAYOUTS = (
        Layout(
            "1.13",
            """
                timestamp lat lon alt x y z yaw valid_alt valid_hpos valid_lpos manual_home
            """,
        ),
        Layout(
            "1.15",
            base="1.13",
            insert_after={
                "manual_home": "update_count",
            },
        ),
        Layout(
            "1.17",
            base="1.15",
            insert_after={
                "z": "roll pitch",
            },
        ),
        Layout("main", "*"),
    )
    RULES = (
        Within(lat=90.0, lon=LONGITUDE_LIMIT),
        FiniteWhile(valid_hpos="lat lon", valid_alt="alt", valid_lpos="x y z"),
    )

    lat: Float64 = field("Latitude [deg] [WGS84]")
    lon: Float64 = field("Longitude [deg] [WGS84], up to PX4 1.15 also beyond +-180")
    alt: Float32 = field("Altitude above mean sea level [m]")

    x: Float32 = field("North position [m] [local NED]")
    y: Float32 = field("East position [m] [local NED]")
    z: Float32 = field("Down position, negative altitude [m] [local NED]")

    roll: Float32 = field("Roll, body frame to local NED [rad]")
    pitch: Float32 = field("Pitch, body frame to local NED [rad]")
    yaw: Float32 = field("Yaw, body frame to local NED [rad]")

    valid_alt: Bool = field("alt is valid")
    valid_hpos: Bool = field("lat and lon are valid")
    valid_lpos: Bool = field("x, y and z are valid")
    valid_attitude: Bool = field("roll, pitch and yaw are valid")
    manual_home: Bool = field("Home position was set manually")
    update_count: Uint32 = field("Number of home position updates since boot")

    position: ClassVar = while_valid(Ned, "x, y and z [m] [local NED]", "valid_lpos")
    global_position: ClassVar = while_valid(
        GlobalPosition.wrapped, "lat, lon [deg], alt [m]", "valid_hpos", "valid_alt"
    )
