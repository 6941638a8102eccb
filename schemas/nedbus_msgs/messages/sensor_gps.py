"""SensorGps: output of a GNSS receiver."""

import math
from typing import ClassVar

from nedbus_msgs.frames import GlobalPosition, Ned
from nedbus_msgs.model import (
    LONGITUDE_LIMIT,
    FiniteWhile,
    InRange,
    Layout,
    Message,
    RenamedField,
    Topic,
    Within,
)
from nedbus_msgs.model.px4_types import (
    Bool,
    Float32,
    Float64,
    Int32,
    Uint8,
    Uint16,
    Uint32,
    Uint64,
    field,
)


def _integer(value: float, scale: float) -> int:
    """Convert a value to an integer in units of 1 / scale; NaN and infinity become 0."""
    if math.isfinite(value * scale):
        return round(value * scale)
    return 0


class SensorGps(Message):
    """Output of a GNSS receiver (sensor_gps), or the selected or blended output that EKF2 uses (vehicle_gps_position).

    Without a fix (fix_type 0 or 1), fields may look plausible and vel_ned_valid may be set, but global_position and
    velocity are None. Some receivers then report eph and epv of thousands of kilometres; many leave timestamp_sample 0.
    cog_rad is within [-pi, pi] or [0, 2 pi], depending on the receiver; time_utc_usec is 0 until UTC is available.

    Layouts 1.13 and 1.14 have integers for latitude and longitude (1e-7 deg) and altitudes (mm), converted both ways.
    Since 1.17 jamming_state and spoofing_state 2 and 3 mean "mitigated" and "detected";
    before 1.17, "warning" and "critical" (jamming), or "indicated" and "multiple" (spoofing).
    """

    TOPICS = (
        Topic(
            "sensor_gps", 8.0, "the driver of each GNSS receiver", instances=True, plain_first=True
        ),
        Topic("vehicle_gps_position", 50.0, "the GNSS selector or blending"),
    )
    LAYOUTS = (
        Layout(
            "1.13",
            base="1.14",
            without="""
                timestamp_sample jamming_indicator spoofing_state rtcm_injection_rate
                selected_rtcm_instance
            """,
            insert_after={
                "automatic_gain_control": "jamming_indicator",
            },
        ),
        Layout(
            "1.14",
            base="1.15",
            without="""
                latitude_deg longitude_deg altitude_msl_m altitude_ellipsoid_m
                rtcm_crc_failed rtcm_msg_used
            """,
            insert_after={
                "device_id": "lat lon alt alt_ellipsoid",
            },
        ),
        Layout(
            "1.15",
            base="1.17",
            without="authentication_state system_error",
        ),
        Layout(
            "1.17",
            base="1.18",
            without="antenna_offset_x antenna_offset_y antenna_offset_z",
        ),
        Layout("1.18", "*"),
    )
    OLDER = (
        RenamedField(
            "lat", "latitude_deg", lambda lat: lat / 1e7, lambda deg: _integer(deg, 1e7), "int32"
        ),
        RenamedField(
            "lon", "longitude_deg", lambda lon: lon / 1e7, lambda deg: _integer(deg, 1e7), "int32"
        ),
        RenamedField(
            "alt", "altitude_msl_m", lambda mm: mm / 1e3, lambda m: _integer(m, 1e3), "int32"
        ),
        RenamedField(
            "alt_ellipsoid",
            "altitude_ellipsoid_m",
            lambda mm: mm / 1e3,
            lambda m: _integer(m, 1e3),
            "int32",
        ),
    )
    RULES = (
        Within(latitude_deg=90.0, longitude_deg=LONGITUDE_LIMIT),
        InRange("eph", 0.0, math.inf, or_=-1.0),
        InRange("epv", 0.0, math.inf, or_=-1.0),
        FiniteWhile(vel_ned_valid="vel_n_m_s vel_e_m_s vel_d_m_s"),
    )

    FIX_TYPE_NONE: ClassVar = 1
    FIX_TYPE_2D: ClassVar = 2
    FIX_TYPE_3D: ClassVar = 3
    FIX_TYPE_RTCM_CODE_DIFFERENTIAL: ClassVar = 4
    FIX_TYPE_RTK_FLOAT: ClassVar = 5
    FIX_TYPE_RTK_FIXED: ClassVar = 6
    FIX_TYPE_EXTRAPOLATED: ClassVar = 8
    JAMMING_STATE_UNKNOWN, JAMMING_STATE_OK, JAMMING_STATE_MITIGATED, JAMMING_STATE_DETECTED = (
        range(4)
    )
    SPOOFING_STATE_UNKNOWN, SPOOFING_STATE_OK, SPOOFING_STATE_MITIGATED, SPOOFING_STATE_DETECTED = (
        range(4)
    )
    (
        AUTHENTICATION_STATE_UNKNOWN, AUTHENTICATION_STATE_INITIALIZING, AUTHENTICATION_STATE_ERROR,
        AUTHENTICATION_STATE_OK, AUTHENTICATION_STATE_DISABLED,
    ) = range(5)  # fmt: skip
    SYSTEM_ERROR_OK: ClassVar = 0
    SYSTEM_ERROR_INCOMING_CORRECTIONS: ClassVar = 1
    SYSTEM_ERROR_CONFIGURATION: ClassVar = 2
    SYSTEM_ERROR_SOFTWARE: ClassVar = 4
    SYSTEM_ERROR_ANTENNA: ClassVar = 8
    SYSTEM_ERROR_EVENT_CONGESTION: ClassVar = 16
    SYSTEM_ERROR_CPU_OVERLOAD: ClassVar = 32
    SYSTEM_ERROR_OUTPUT_CONGESTION: ClassVar = 64
    RTCM_MSG_USED_UNKNOWN, RTCM_MSG_USED_NOT_USED, RTCM_MSG_USED_USED = range(3)

    timestamp_sample: Uint64 = field(
        "Time of the underlying sensor data [us]; with PPS up to 0.1 s after timestamp"
    )
    device_id: Uint32 = field("Device ID, unchanged by restarts")
    latitude_deg: Float64 = field("Latitude [deg] [WGS84]")
    longitude_deg: Float64 = field(
        "Longitude [deg] [WGS84], also beyond +-180 if receivers are blended"
    )
    altitude_msl_m: Float64 = field("Altitude above mean sea level [m]")
    altitude_ellipsoid_m: Float64 = field("Altitude above the ellipsoid [m] [WGS84]")

    s_variance_m_s: Float32 = field("Speed accuracy [m/s], not a variance")
    c_variance_rad: Float32 = field("Course accuracy [rad], not a variance")
    fix_type: Uint8 = field(
        "Fix: 0, 1 none, 2 2D, 3 3D, 4 RTCM differential, 5 RTK float, 6 RTK fixed, 8 extrapolated"
    )

    eph: Float32 = field("Horizontal position accuracy [m]")
    epv: Float32 = field("Vertical position accuracy [m]")
    hdop: Float32 = field("Horizontal dilution of precision")
    vdop: Float32 = field("Vertical dilution of precision")

    noise_per_ms: Int32 = field("Noise per millisecond, in receiver-specific units")
    automatic_gain_control: Uint16 = field("Automatic gain control, in receiver-specific units")
    jamming_state: Uint8 = field("Jamming: 0 unknown, 1 OK, 2 mitigated, 3 detected")
    jamming_indicator: Int32 = field("Jamming level, in receiver-specific units")
    spoofing_state: Uint8 = field("Spoofing: 0 unknown, 1 OK, 2 mitigated, 3 detected")
    authentication_state: Uint8 = field(
        "Signal authentication: 0 unknown, 1 initializing, 2 error, 3 OK, 4 disabled"
    )

    vel_m_s: Float32 = field("Ground speed [m/s]")
    vel_n_m_s: Float32 = field("North velocity [m/s] [NED]")
    vel_e_m_s: Float32 = field("East velocity [m/s] [NED]")
    vel_d_m_s: Float32 = field("Down velocity [m/s] [NED]")
    cog_rad: Float32 = field("Course over ground, not heading [rad]")
    vel_ned_valid: Bool = field("vel_n_m_s, vel_e_m_s and vel_d_m_s are valid")

    timestamp_time_relative: Int32 = field("Time of time_utc_usec relative to timestamp [us]")
    time_utc_usec: Uint64 = field("Unix time of the fix [us], 0 if unknown")
    satellites_used: Uint8 = field("Number of satellites used")
    system_error: Uint32 = field("Receiver error bitmask, see SYSTEM_ERROR_; 0 if none")

    heading: Float32 = field("Dual-antenna heading, body frame to NED [rad], NaN if unknown")
    heading_offset: Float32 = field("Dual-antenna angle in the body frame [rad], NaN if not used")
    heading_accuracy: Float32 = field("Heading accuracy [rad]")

    rtcm_injection_rate: Float32 = field("RTCM injection rate [Hz]")
    selected_rtcm_instance: Uint8 = field("uORB instance of the RTCM corrections in use")
    rtcm_crc_failed: Bool = field("CRC of the last RTCM message failed")
    rtcm_msg_used: Uint8 = field("Receiver used the last RTCM message: 0 unknown, 1 no, 2 yes")

    antenna_offset_x: Float32 = field("Antenna position, forward [m] [body FRD]")
    antenna_offset_y: Float32 = field("Antenna position, right [m] [body FRD]")
    antenna_offset_z: Float32 = field("Antenna position, down [m] [body FRD]")

    @property
    def global_position(self) -> GlobalPosition | None:
        """Latitude, longitude [deg] [WGS84] and altitude above mean sea level [m]; None without a 3D fix."""
        has_fix = self.fix_type >= SensorGps.FIX_TYPE_3D
        if has_fix:
            return GlobalPosition.wrapped(
                self.latitude_deg, self.longitude_deg, self.altitude_msl_m
            )
        return None

    @property
    def velocity(self) -> Ned | None:
        """Velocity [m/s] [NED]; None without a fix, or while vel_ned_valid is false."""
        is_valid = self.vel_ned_valid and self.fix_type >= SensorGps.FIX_TYPE_2D
        if is_valid:
            return Ned(self.vel_n_m_s, self.vel_e_m_s, self.vel_d_m_s)
        return None
