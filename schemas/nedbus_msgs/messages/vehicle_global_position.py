"""VehicleGlobalPosition: latitude, longitude and altitude of the vehicle."""

from typing import ClassVar

from nedbus_msgs.frames import GlobalPosition
from nedbus_msgs.model import (
    LONGITUDE_LIMIT,
    FiniteWhile,
    Layout,
    Message,
    NotLater,
    NotNegative,
    Topic,
    Within,
)
from nedbus_msgs.model.px4_types import Bool, Float32, Float64, Uint8, Uint64, field, while_valid


class VehicleGlobalPosition(Message):
    """Global position estimate of a vehicle; the output of its GNSS receiver is SensorGps.

    Degrees (WGS84) and metres, positive up; VehicleLocalPosition is the same estimate in local NED.
    Layouts up to 1.15 lack lat_lon_valid and alt_valid: false then means unknown, and global_position is None.
    The position can jump by metres without a counted reset, for example when GNSS returns after dead reckoning.
    alt_ellipsoid often equals alt in simulators, and is 0 in some ground truth.
    """

    TOPICS = (
        Topic("vehicle_global_position", 50.0, "EKF2, or the EKF2 selector in multi-EKF mode"),
        Topic("vehicle_global_position_groundtruth", 50.0, "simulators (SITL, HITL)"),
        Topic("external_ins_global_position", 50.0, "an external INS driver (VectorNav, ...)"),
        Topic(
            "estimator_global_position", 2.0, "each EKF2 instance in multi-EKF mode", instances=True
        ),
    )
    LAYOUTS = (
        Layout(
            "1.13",
            base="1.16",
            without="lat_lon_valid alt_valid delta_terrain terrain_reset_counter",
        ),
        Layout("1.16", "*"),
    )
    RULES = (
        NotLater("timestamp_sample", "timestamp"),
        Within(lat=90.0, lon=LONGITUDE_LIMIT),
        NotNegative("eph", "epv"),
        FiniteWhile(lat_lon_valid="lat lon", alt_valid="alt", terrain_alt_valid="terrain_alt"),
    )

    timestamp_sample: Uint64 = field("Time of the underlying sensor data [us], <= timestamp")
    lat: Float64 = field("Latitude [deg] [WGS84]")
    lon: Float64 = field("Longitude [deg] [WGS84], up to PX4 1.15 also beyond +-180")
    alt: Float32 = field("Altitude above mean sea level [m]")
    alt_ellipsoid: Float32 = field("Altitude above the ellipsoid [m] [WGS84]")
    lat_lon_valid: Bool = field("lat and lon are valid")
    alt_valid: Bool = field("alt is valid")

    delta_alt: Float32 = field("Jump of alt at its latest reset [m], positive up")
    delta_terrain: Float32 = field("Jump of terrain_alt at its latest reset [m], positive up")
    lat_lon_reset_counter: Uint8 = field("Count of lat, lon resets, wraps at 255")
    alt_reset_counter: Uint8 = field("Count of alt resets, wraps at 255")
    terrain_reset_counter: Uint8 = field("Count of terrain_alt resets, wraps at 255")

    eph: Float32 = field("Standard deviation of horizontal position [m]")
    epv: Float32 = field("Standard deviation of altitude [m]")

    terrain_alt: Float32 = field("Terrain altitude [m], NaN if unknown")
    terrain_alt_valid: Bool = field("terrain_alt is valid")
    dead_reckoning: Bool = field("The position is estimated by dead reckoning")

    global_position: ClassVar = while_valid(
        GlobalPosition.wrapped, "lat, lon [deg], alt [m]", "lat_lon_valid", "alt_valid"
    )
    ground_altitude: ClassVar = while_valid(float, "terrain_alt [m]", "terrain_alt_valid")
