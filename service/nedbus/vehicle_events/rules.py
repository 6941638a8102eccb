"""Flag labels, thresholds and mode names for the table of kinds and the event detectors."""

from collections.abc import Mapping
from typing import Final

_AIDING: Final = {
    "cs_gnss_pos": "GNSS position",
    "cs_gnss_vel": "GNSS velocity",
    "cs_ev_pos": "vision position",
    "cs_ev_vel": "vision velocity",
    "cs_opt_flow": "optical flow",
    "cs_aux_gpos": "auxiliary position",
}
FAKE_AIDING: Final = {"cs_fake_pos": "fake position", "cs_valid_fake_pos": "valid fake position"}
"""Fake position measurements, which the EKF fuses in the absence of horizontal aiding."""
AIDING: Final[Mapping[str, str]] = {**_AIDING, **FAKE_AIDING}
"""All sources of horizontal aiding."""

HEIGHTS: Final = {
    "cs_gps_hgt": "GNSS height",
    "cs_gnss_yaw": "GNSS yaw",
    "cs_ev_yaw": "vision yaw",
    "cs_ev_hgt": "vision height",
    "cs_baro_hgt": "baro height",
    "cs_rng_hgt": "range height",
}
FUSED: Final[Mapping[str, str]] = {**_AIDING, **HEIGHTS}
FAULTS: Final = {
    "cs_mag_field_disturbed": "magnetic field disturbed",
    "cs_mag_fault": "magnetometer",
    "cs_rng_fault": "range finder",
    "cs_gnss_yaw_fault": "GNSS yaw",
    "cs_ev_yaw_fault": "vision yaw",
    "cs_baro_fault": "barometer",
    "cs_gnss_fault": "GNSS",
    "cs_gnss_hgt_fault": "GNSS height",
    "fs_bad_mag_x": "magnetometer x",
    "fs_bad_mag_y": "magnetometer y",
    "fs_bad_mag_z": "magnetometer z",
    "fs_bad_hdg": "heading",
    "fs_bad_mag_decl": "magnetic declination",
    "fs_bad_airspeed": "airspeed",
    "fs_bad_sideslip": "sideslip",
    "fs_bad_optflow_x": "optical flow x",
    "fs_bad_optflow_y": "optical flow y",
    "fs_bad_acc_vertical": "vertical accelerometer",
    "fs_bad_acc_clipping": "accelerometer clipping",
    "fs_bad_acc_bias": "accelerometer bias",
    "fs_bad_vel_n": "north velocity",
    "fs_bad_vel_e": "east velocity",
    "fs_bad_vel_d": "vertical velocity",
    "fs_bad_pos_n": "north position",
    "fs_bad_pos_e": "east position",
    "fs_bad_pos_d": "vertical position",
}
REJECTED: Final = {
    "reject_hor_vel": "horizontal velocity",
    "reject_ver_vel": "vertical velocity",
    "reject_hor_pos": "horizontal position",
    "reject_ver_pos": "vertical position",
    "reject_mag_x": "magnetometer x",
    "reject_mag_y": "magnetometer y",
    "reject_mag_z": "magnetometer z",
    "reject_yaw": "yaw",
    "reject_airspeed": "airspeed",
    "reject_sideslip": "sideslip",
    "reject_hagl": "height above ground",
    "reject_optflow_x": "optical flow x",
    "reject_optflow_y": "optical flow y",
}
_AID: Final = "estimator_aid_src_"
MINOR_AIDS: Final = frozenset(
    {
        f"{_AID}gnss_yaw",
        f"{_AID}baro_hgt",
        f"{_AID}rng_hgt",
        f"{_AID}mag",
        f"{_AID}terrain_range_finder",
    }
)
"""Topics of AID_SOURCES whose rejection alone leaves the position as it is."""
AID_SOURCES: Final[Mapping[str, str]] = {
    f"{_AID}ev_pos": "vision position",
    f"{_AID}ev_hgt": "vision height",
    f"{_AID}ev_vel": "vision velocity",
    f"{_AID}ev_yaw": "vision yaw",
    f"{_AID}gnss_pos": "GNSS position",
    f"{_AID}gnss_vel": "GNSS velocity",
    f"{_AID}gnss_hgt": "GNSS height",
    f"{_AID}gnss_yaw": "GNSS yaw",
    f"{_AID}optical_flow": "optical flow",
    f"{_AID}aux_global_position": "auxiliary position",
    f"{_AID}baro_hgt": "baro height",
    f"{_AID}rng_hgt": "range height",
    f"{_AID}terrain_range_finder": "range finder",
    f"{_AID}mag": "magnetometer",
}
"""Measurements that the EKF may fuse, by topic: PX4's EstimatorAidSource1d, 2d and 3d (1.14 and later)."""
VISION: Final = ("vehicle_visual_odometry",)
"""Topics of positions sent into the vehicle that EKF2 reads; it does not read vehicle_mocap_odometry."""
# s for which all messages of an aid source agree before it counts as fused, rejected or unused
AID_HOLD: Final = 0.5
AID_COUNT: Final = 3  # ... and their minimum number
# s without messages after which an aid source has stopped, and is judged anew
AID_PAUSE: Final = 1.0
# s in which vision arrives without being fused; PX4 starts to fuse it within 0.5 s
VISION_HOLD: Final = 1.5

_FAILSAFE_FLAGS: Final = (
    "angular_velocity_invalid",
    "attitude_invalid",
    "local_altitude_invalid",
    "local_position_invalid",
    "local_position_invalid_relaxed",
    "local_velocity_invalid",
    "global_position_invalid",
    "global_position_invalid_relaxed",
    "auto_mission_missing",
    "home_position_invalid",
    "manual_control_signal_lost",
    "battery_low_remaining_time",
    "battery_unhealthy",
    "geofence_breached",
    "mission_failure",
    "vtol_fixed_wing_system_failure",
    "wind_limit_exceeded",
    "flight_time_limit_exceeded",
    "position_accuracy_low",
    "navigator_failure",
    "parachute_unhealthy",
    "traffic_avoidance_unhealthy",
    "remote_id_unhealthy",
    "gnss_lost",
)
FAILSAFE_FLAGS: Final[Mapping[str, str]] = {
    **{
        name: name.replace("_relaxed", " (relaxed limits)").replace("_", " ")
        for name in _FAILSAFE_FLAGS
    },
    "fd_critical_failure": "attitude or altitude limit exceeded",
    "fd_esc_arming_failure": "ESC failed to arm",
    "fd_imbalanced_prop": "imbalanced propeller",
    "fd_motor_failure": "motor failure",
    "fd_alt_loss": "uncommanded altitude loss",
}

SUBJECTS: Final[Mapping[str, str]] = {
    "accelerometer": r"\baccel|acc \d",
    "airspeed": "airspeed",
    "barometer": r"\bbaro",
    "battery": "battery",
    "EKF": "primary EKF",
    "GNSS": r"\bgps|gnss|satellite",
    "gyro": r"\bgyro",
    "heading": "heading|yaw",
    "height": r"height|altitude|vertical|\bv?z\b",
    "magnetometer": r"\bmag|compass",
    "optical flow": "flow",
    "position": r"position|dead reckoning|\bv?xy\b",
    "range finder": r"\brange|distance sensor",
    "vision": "vision|odometry",
}
"""Sensors and quantities, with patterns of the words for them in texts of PX4 and nedbus."""

POSITIONS: Final = (
    "vehicle_local_position",
    "external_ins_local_position",
    "estimator_local_position",
)
"""Topics with position validity flags, in order of preference."""

EVIDENCE: Final[Mapping[str, tuple[str, ...]]] = {
    "GPS": ("vehicle_gps_position", "sensor_gps"),
    "barometer": ("vehicle_air_data",),
    "magnetometer": ("vehicle_magnetometer",),
    "estimator flags": ("estimator_status_flags",),
    "vehicle status": ("vehicle_status",),
    "failsafe flags": ("failsafe_flags",),
    "battery": ("battery_status",),
}
"""What a verdict rests on besides the position, with its topics in order of preference, one of which suffices."""

RECENT: Final = 60.0
"""Seconds for which a single event affects the state of a vehicle."""

# s without a position after which a vehicle is silent, if the state of its stream is unknown
SILENCE: Final = 3.0
MIN_FIX_TYPE: Final = 3  # SensorGps.FIX_TYPE_3D
# the condition begins below this (PX4's EKF2_REQ_NSATS) and ends at ENOUGH_SATELLITES
FEW_SATELLITES: Final = 6
ENOUGH_SATELLITES: Final = 7
JAMMING_BEGIN: Final = 80  # jamming_indicator; "too high" in PX4's guide to flight log analysis
JAMMING_END: Final = 60
JUMP_DISTANCE: Final = 1.0  # m of unexplained motion, plus JUMP_SHARE of the distance flown
JUMP_SHARE: Final = 0.2
LARGE_CORRECTION: Final = 10.0  # m or m/s; while armed, a reset or jump of this size is bad
# s after an invalid estimate in which a large correction is its recovery, and not bad
RECOVERY: Final = 1.0
SMALL_RESET: Final = 0.5  # m or m/s; a smaller reset is info
# A reference contradicts a valid estimate if they differ by more than the limit plus HEIGHT_SHARE of the height, SIGMAS
# times the GNSS accuracy, and the distance flown in GNSS_DELAY. Healthy logs: up to 2.9 m in height, 2.2 m at 18 m/s.
HEIGHT_LIMIT: Final = 8.0  # m; the whole limit is doubled if there is only one reference
HEIGHT_SHARE: Final = 0.05
POSITION_LIMIT: Final = 4.0  # m
GNSS_DELAY: Final = 0.5  # s
SIGMAS: Final = 3.0
UNKNOWN_ACCURACY: Final = 10.0  # m, in place of a missing eph or epv
# s for which all references must disagree
CONTRADICTED: Final = {"height": 1.5, "position": 3.0, "origin": 3.0}
ATMOSPHERE_SHARE: Final = 0.15  # of the height climbed; see `atmosphere_error`
TROPOPAUSE: Final = 11_000.0  # m; PX4 computes the barometer's height with the lapse rate below it
# Events within WINDOW; beyond these numbers, only the last one is reported.
CONDITION_CHANGES: Final = 4  # of one condition
KIND_CHANGES: Final = 20  # of the conditions of one kind
EQUAL_EVENTS: Final = 10  # single events of one kind, severity and quantities, or with one text
SINGLE_EVENTS: Final = 200  # single events of one kind
# PX4 sends the others when they change
PERIODIC: Final = ("VehicleLocalPosition", "SensorGps", "BatteryStatus")
# s; a condition of a PERIODIC message that ends this soon, with the next one, may be wild
WILD: Final = 0.4
# s without a recurrence after which flapping, losses, rejections or an overload have ended
PAUSE: Final = 5.0
LOSS_PERIOD: Final = 20.0  # s after which continuing losses are reported

MODES: Final[Mapping[int, str]] = {
    0: "Manual",
    1: "Altitude",
    2: "Position",
    3: "Mission",
    4: "Hold",
    5: "Return",
    6: "Position Slow",
    7: "Guided Course",
    8: "Altitude Cruise",
    10: "Acro",
    12: "Descend",
    13: "Termination",
    14: "Offboard",
    15: "Stabilized",
    17: "Takeoff",
    18: "Land",
    19: "Follow",
    20: "Precision Land",
    21: "Orbit",
    22: "VTOL Takeoff",
    **{number: f"External {number - 22}" for number in range(23, 31)},
}
"""Flight mode names by `nav_state` of VehicleStatus, as in QGroundControl."""

VEHICLE_TYPES: Final[Mapping[int, str]] = {
    0: "unspecified",
    1: "rotary wing",
    2: "fixed wing",
    3: "rover",
}
"""Vehicle types by vehicle_type of VehicleStatus."""

FIXES: Final[Mapping[int, str]] = {
    0: "none",
    1: "none",
    2: "2D",
    3: "3D",
    4: "DGPS",
    5: "RTK float",
    6: "RTK fixed",
    8: "extrapolated",
}
"""Names of GNSS fixes, by `fix_type` of SensorGps."""

WARNINGS: Final[Mapping[int, str]] = {
    1: "low",
    2: "critical",
    3: "emergency",
    4: "failed",
    6: "unhealthy",
    7: "charging",
}
LEVELS: Final = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
"""Names of LogMessage.severity, as in MAV_SEVERITY."""
