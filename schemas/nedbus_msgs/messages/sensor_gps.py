"""SensorGps: what a GNSS receiver says."""

from __future__ import annotations

import math
from typing import ClassVar

from pydantic import Field

from nedbus_msgs.model.declaration import Topic, older
from nedbus_msgs.model.message import Message
from nedbus_msgs.model.px4_types import NAN, Bool, Float32, Float64, Int32, Uint8, Uint16, Uint32, Uint64
from nedbus_msgs.model.rules import FiniteWhile, NotLater, NotNegative, Within


def _integer(value: float, scale: float) -> int:
    """Return a value in units of 1/scale as an integer; 0 for NaN and infinity, which integers do not have."""
    return round(value * scale) if math.isfinite(value * scale) else 0


class SensorGps(Message):
    """Output of a GNSS receiver (sensor_gps), or of the choice or blend of all that EKF2 uses (vehicle_gps_position).

    Look at fix_type first: with 0 or 1, no fix, position and velocity may look good, and vel_ned_valid may be true.
    eph and epv are thousands of kilometres with some receivers that have no fix; timestamp_sample is 0 with many.
    cog_rad is within [-pi, pi] or [0, 2 pi], as the receiver has it; time_utc_usec is 0 until the receiver knows UTC.

    Layouts 1.13 and 1.14 have latitude and longitude in 1e-7 deg and altitudes in mm as integers: converted, both ways.
    Since 1.17 jamming_state and spoofing_state 2 and 3 mean "mitigated" and "detected";
    before, "warning" and "critical" (jamming), "indicated" and "multiple" (spoofing).
    """

    TOPICS: ClassVar = (
        Topic("sensor_gps", 8.0, "each GNSS receiver's driver", instances=True, plain_first=True),
        Topic("vehicle_gps_position", 50.0, "the blend or choice of all receivers"),
    )
    LAYOUTS: ClassVar = {
        "1.13": """
            timestamp device_id lat lon alt alt_ellipsoid s_variance_m_s c_variance_rad fix_type eph epv hdop vdop
            noise_per_ms automatic_gain_control jamming_indicator jamming_state vel_m_s vel_n_m_s vel_e_m_s
            vel_d_m_s cog_rad vel_ned_valid timestamp_time_relative time_utc_usec satellites_used heading
            heading_offset heading_accuracy""",
        "1.14": """
            timestamp timestamp_sample device_id lat lon alt alt_ellipsoid s_variance_m_s c_variance_rad fix_type
            eph epv hdop vdop noise_per_ms automatic_gain_control jamming_state jamming_indicator spoofing_state
            vel_m_s vel_n_m_s vel_e_m_s vel_d_m_s cog_rad vel_ned_valid timestamp_time_relative time_utc_usec
            satellites_used heading heading_offset heading_accuracy rtcm_injection_rate selected_rtcm_instance""",
        "1.15": """
            1.14, without lat lon alt alt_ellipsoid, device_id: latitude_deg longitude_deg altitude_msl_m
            altitude_ellipsoid_m, selected_rtcm_instance: rtcm_crc_failed rtcm_msg_used""",
        "1.17": "1.15, spoofing_state: authentication_state, satellites_used: system_error",
        "1.18": "*",
    }  # fmt: skip
    OLDER: ClassVar = {
        "lat": older("latitude_deg", lambda lat: lat / 1e7, lambda degrees: _integer(degrees, 1e7), "int32"),
        "lon": older("longitude_deg", lambda lon: lon / 1e7, lambda degrees: _integer(degrees, 1e7), "int32"),
        "alt": older("altitude_msl_m", lambda alt: alt / 1e3, lambda metres: _integer(metres, 1e3), "int32"),
        "alt_ellipsoid": older(
            "altitude_ellipsoid_m", lambda alt: alt / 1e3, lambda metres: _integer(metres, 1e3), "int32"
        ),
    }
    ENUMS: ClassVar = {
        "fix_type": "FIX_TYPE_",
        "jamming_state": "JAMMING_STATE_",
        "spoofing_state": "SPOOFING_STATE_",
        "authentication_state": "AUTHENTICATION_STATE_",
        "rtcm_msg_used": "RTCM_MSG_USED_",
    }
    RULES: ClassVar = (
        NotLater("timestamp_sample", "timestamp"),
        Within("latitude_deg", 90.0),
        Within("longitude_deg", 180.0),
        NotNegative("eph", "epv"),
        FiniteWhile({"vel_ned_valid": ("vel_n_m_s", "vel_e_m_s", "vel_d_m_s")}),
    )

    FIX_TYPE_NONE: ClassVar = 1
    FIX_TYPE_2D: ClassVar = 2
    FIX_TYPE_3D: ClassVar = 3
    FIX_TYPE_RTCM_CODE_DIFFERENTIAL: ClassVar = 4
    FIX_TYPE_RTK_FLOAT: ClassVar = 5
    FIX_TYPE_RTK_FIXED: ClassVar = 6
    FIX_TYPE_EXTRAPOLATED: ClassVar = 8
    JAMMING_STATE_UNKNOWN: ClassVar = 0
    JAMMING_STATE_OK: ClassVar = 1
    JAMMING_STATE_MITIGATED: ClassVar = 2
    JAMMING_STATE_DETECTED: ClassVar = 3
    SPOOFING_STATE_UNKNOWN: ClassVar = 0
    SPOOFING_STATE_OK: ClassVar = 1
    SPOOFING_STATE_MITIGATED: ClassVar = 2
    SPOOFING_STATE_DETECTED: ClassVar = 3
    AUTHENTICATION_STATE_UNKNOWN: ClassVar = 0
    AUTHENTICATION_STATE_INITIALIZING: ClassVar = 1
    AUTHENTICATION_STATE_ERROR: ClassVar = 2
    AUTHENTICATION_STATE_OK: ClassVar = 3
    AUTHENTICATION_STATE_DISABLED: ClassVar = 4
    SYSTEM_ERROR_OK: ClassVar = 0
    SYSTEM_ERROR_INCOMING_CORRECTIONS: ClassVar = 1
    SYSTEM_ERROR_CONFIGURATION: ClassVar = 2
    SYSTEM_ERROR_SOFTWARE: ClassVar = 4
    SYSTEM_ERROR_ANTENNA: ClassVar = 8
    SYSTEM_ERROR_EVENT_CONGESTION: ClassVar = 16
    SYSTEM_ERROR_CPU_OVERLOAD: ClassVar = 32
    SYSTEM_ERROR_OUTPUT_CONGESTION: ClassVar = 64
    RTCM_MSG_USED_UNKNOWN: ClassVar = 0
    RTCM_MSG_USED_NOT_USED: ClassVar = 1
    RTCM_MSG_USED_USED: ClassVar = 2

    timestamp: Uint64 = Field(description="Time since boot [us]")
    timestamp_sample: Uint64 = Field(0, description="Time of the sensor data behind this [us], <= timestamp")

    device_id: Uint32 = Field(0, description="ID of the sensor, kept over restarts")

    latitude_deg: Float64 = Field(NAN, description="Latitude [deg] [WGS84]")
    longitude_deg: Float64 = Field(NAN, description="Longitude [deg] [WGS84]")
    altitude_msl_m: Float64 = Field(NAN, description="Altitude above mean sea level [m]")
    altitude_ellipsoid_m: Float64 = Field(NAN, description="Altitude above the ellipsoid [m] [WGS84]")

    s_variance_m_s: Float32 = Field(NAN, description="Accuracy of speed, no variance [m/s]")
    c_variance_rad: Float32 = Field(NAN, description="Accuracy of course, no variance [rad]")
    fix_type: Uint8 = Field(
        0, description="Fix: 0, 1 none, 2 2D, 3 3D, 4 differential, 5 RTK float, 6 RTK, 8 extrapolated"
    )

    eph: Float32 = Field(NAN, description="Accuracy of horizontal position [m]")
    epv: Float32 = Field(NAN, description="Accuracy of altitude [m]")
    hdop: Float32 = Field(NAN, description="Horizontal dilution of precision")
    vdop: Float32 = Field(NAN, description="Vertical dilution of precision")

    noise_per_ms: Int32 = Field(0, description="Noise per millisecond, in the receiver's own counts")
    automatic_gain_control: Uint16 = Field(0, description="Gain of the receiver's input, in its own counts")
    jamming_state: Uint8 = Field(0, description="Jamming: 0 unknown, 1 none, 2 mitigated, 3 detected")
    jamming_indicator: Int32 = Field(0, description="Strength of jamming, in the receiver's own counts")
    spoofing_state: Uint8 = Field(0, description="Spoofing: 0 unknown, 1 none, 2 mitigated, 3 detected")
    authentication_state: Uint8 = Field(
        0, description="Signals: 0 unknown, 1 starting, 2 error, 3 authentic, 4 not checked"
    )

    vel_m_s: Float32 = Field(NAN, description="Ground speed [m/s]")
    vel_n_m_s: Float32 = Field(NAN, description="North velocity [m/s] [NED]")
    vel_e_m_s: Float32 = Field(NAN, description="East velocity [m/s] [NED]")
    vel_d_m_s: Float32 = Field(NAN, description="Down velocity [m/s] [NED]")
    cog_rad: Float32 = Field(NAN, description="Course over ground, not heading [rad]")
    vel_ned_valid: Bool = Field(False, description="vel_n_m_s, vel_e_m_s and vel_d_m_s are valid")

    timestamp_time_relative: Int32 = Field(0, description="Time of time_utc_usec, after timestamp [us]")
    time_utc_usec: Uint64 = Field(0, description="Unix time of the fix [us], 0 if not known")

    satellites_used: Uint8 = Field(0, description="Count of satellites used")
    system_error: Uint32 = Field(0, description="Faults of the receiver as bits, see SYSTEM_ERROR_; 0 none")

    heading: Float32 = Field(NAN, description="Heading by two antennas, body frame to NED [rad], NaN if not known")
    heading_offset: Float32 = Field(NAN, description="Angle of the two antennas in the body frame [rad], NaN without")
    heading_accuracy: Float32 = Field(NAN, description="Accuracy of heading [rad]")

    rtcm_injection_rate: Float32 = Field(NAN, description="Rate of RTCM corrections given to the receiver [Hz]")
    selected_rtcm_instance: Uint8 = Field(0, description="uORB instance of the corrections in use")
    rtcm_crc_failed: Bool = Field(False, description="The latest correction arrived damaged")
    rtcm_msg_used: Uint8 = Field(0, description="The receiver used the latest correction: 0 unknown, 1 no, 2 yes")

    antenna_offset_x: Float32 = Field(NAN, description="Antenna's position, forward [m] [body FRD]")
    antenna_offset_y: Float32 = Field(NAN, description="Antenna's position, right [m] [body FRD]")
    antenna_offset_z: Float32 = Field(NAN, description="Antenna's position, down [m] [body FRD]")
