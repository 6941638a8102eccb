"""HomePosition: where the vehicle returns to."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from nedbus_msgs.model.declaration import Topic
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import NAN, Bool, Float32, Float64, Uint32, Uint64
from nedbus_msgs.model.rules import FiniteWhile, Within


class HomePosition(Message):
    """Home of a vehicle: where it returns to, on the globe and in local NED.

    Latitude and longitude, altitude, and local position each have a flag; what is not valid is mostly 0, not NaN.
    PX4 publishes it when home is set or moves, and then perhaps not for minutes: keep the last one.
    valid_attitude is of main; up to 1.18 nothing says whether roll, pitch and yaw are valid.
    x, y and z hold until the estimator moves the origin of local NED.
    """

    TOPICS: ClassVar = (Topic("home_position", 0.0, "the commander, when home is set or moves", on_change=True),)
    LAYOUTS: ClassVar = {
        "1.13": "timestamp lat lon alt x y z yaw valid_alt valid_hpos valid_lpos manual_home",
        "1.15": "1.13, manual_home: update_count",
        "1.17": "1.15, z: roll pitch",
        "main": "*",
    }  # fmt: skip
    RULES: ClassVar = (
        Within("lat", 90.0),
        Within("lon", 180.0),
        FiniteWhile({"valid_hpos": ("lat", "lon"), "valid_alt": ("alt",), "valid_lpos": ("x", "y", "z")}),
    )

    timestamp: Uint64 = Field(description="Time since boot [us]")

    lat: Float64 = Field(NAN, description="Latitude [deg] [WGS84]")
    lon: Float64 = Field(NAN, description="Longitude [deg] [WGS84]")
    alt: Float32 = Field(NAN, description="Altitude above mean sea level [m]")

    x: Float32 = Field(NAN, description="North position [m] [local NED]")
    y: Float32 = Field(NAN, description="East position [m] [local NED]")
    z: Float32 = Field(NAN, description="Down position, negative altitude [m] [local NED]")

    roll: Float32 = Field(NAN, description="Roll, body frame to local NED [rad]")
    pitch: Float32 = Field(NAN, description="Pitch, body frame to local NED [rad]")
    yaw: Float32 = Field(NAN, description="Yaw, body frame to local NED [rad]")

    valid_alt: Bool = Field(False, description="alt is valid")
    valid_hpos: Bool = Field(False, description="lat and lon are valid")
    valid_lpos: Bool = Field(False, description="x, y and z are valid")
    valid_attitude: Bool = Field(False, description="roll, pitch and yaw are valid")

    manual_home: Bool = Field(False, description="Home was set by the user, not by the vehicle")
    update_count: Uint32 = Field(0, description="Count of changes of home since boot")
