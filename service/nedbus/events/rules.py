"""Tables of the event detectors: flags by message with their texts, thresholds, and names of modes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from .event import Severity


@dataclass(frozen=True, slots=True)
class FlagRule:
    """A condition that holds while any of its flags has the value `bad`.

    `flags`: a label for each field; flags that change in the same message become one event.
    `severity`: of the begin; `on_ground` replaces it while the vehicle is disarmed. An end is always info.
    `begin`, `end`: event texts, with `{}` for the labels. `first`: text for the end of an initial condition.
    `minor`: flags whose begin is info.
    `initial`: a flag that is bad in the first message begins a condition.
    """

    kind: str
    flags: Mapping[str, str]
    begin: str
    end: str
    first: str = ""
    bad: bool = True
    severity: Severity = "watch"
    on_ground: Severity | None = None
    minor: frozenset[str] = frozenset()
    initial: bool = False


def _valid(field: str, kind: str, label: str) -> FlagRule:
    begin, end = f"{label} not valid", f"{label} valid again"
    return FlagRule(
        kind, {field: label}, begin, end, f"{label} valid for the first time", bad=False, severity="bad", initial=True
    )


_AIDING: Final = {
    "cs_gnss_pos": "GNSS position", "cs_gnss_vel": "GNSS velocity", "cs_ev_pos": "vision position",
    "cs_ev_vel": "vision velocity", "cs_opt_flow": "optical flow", "cs_aux_gpos": "auxiliary position",
}  # fmt: skip
FAKE_AIDING: Final = {"cs_fake_pos": "fake position", "cs_valid_fake_pos": "valid fake position"}
"""What the EKF fuses in place of a measured position, for as long as it trusts that."""
AIDING: Final[Mapping[str, str]] = {**_AIDING, **FAKE_AIDING}
_HEIGHTS: Final = {
    "cs_gps_hgt": "GNSS height", "cs_gnss_yaw": "GNSS yaw", "cs_ev_yaw": "vision yaw", "cs_ev_hgt": "vision height",
    "cs_baro_hgt": "baro height", "cs_rng_hgt": "range height",
}  # fmt: skip
_FAULTS: Final = {
    "cs_mag_field_disturbed": "magnetic field disturbed", "cs_mag_fault": "magnetometer",
    "cs_rng_fault": "range finder", "cs_gnss_yaw_fault": "GNSS yaw", "cs_ev_yaw_fault": "vision yaw",
    "cs_baro_fault": "barometer", "cs_gnss_fault": "GNSS", "cs_gnss_hgt_fault": "GNSS height",
    "fs_bad_mag_x": "magnetometer x", "fs_bad_mag_y": "magnetometer y", "fs_bad_mag_z": "magnetometer z",
    "fs_bad_hdg": "heading", "fs_bad_mag_decl": "declination", "fs_bad_airspeed": "airspeed",
    "fs_bad_sideslip": "sideslip", "fs_bad_optflow_x": "optical flow x", "fs_bad_optflow_y": "optical flow y",
    "fs_bad_acc_vertical": "accelerometer, vertical", "fs_bad_acc_clipping": "accelerometer clipping",
    "fs_bad_acc_bias": "accelerometer bias", "fs_bad_vel_n": "velocity north", "fs_bad_vel_e": "velocity east",
    "fs_bad_vel_d": "velocity down", "fs_bad_pos_n": "position north", "fs_bad_pos_e": "position east",
    "fs_bad_pos_d": "position down",
}  # fmt: skip
_REJECTED: Final = {
    "reject_hor_vel": "horizontal velocity", "reject_ver_vel": "vertical velocity",
    "reject_hor_pos": "horizontal position", "reject_ver_pos": "vertical position", "reject_mag_x": "magnetometer x",
    "reject_mag_y": "magnetometer y", "reject_mag_z": "magnetometer z", "reject_yaw": "yaw",
    "reject_airspeed": "airspeed", "reject_sideslip": "sideslip", "reject_hagl": "height above ground",
    "reject_optflow_x": "optical flow x", "reject_optflow_y": "optical flow y",
}  # fmt: skip
_FAILSAFE_FLAGS: Final = (
    "angular_velocity_invalid", "attitude_invalid", "local_altitude_invalid", "local_position_invalid",
    "local_position_invalid_relaxed", "local_velocity_invalid", "global_position_invalid",
    "global_position_invalid_relaxed", "auto_mission_missing", "home_position_invalid", "manual_control_signal_lost",
    "battery_low_remaining_time", "battery_unhealthy", "fd_critical_failure", "fd_esc_arming_failure",
    "fd_imbalanced_prop", "fd_motor_failure", "fd_alt_loss", "geofence_breached", "mission_failure",
    "vtol_fixed_wing_system_failure", "wind_limit_exceeded", "flight_time_limit_exceeded", "position_accuracy_low",
    "navigator_failure", "parachute_unhealthy", "traffic_avoidance_unhealthy", "remote_id_unhealthy", "gnss_lost",
)  # fmt: skip
RULES: Final[Mapping[str, tuple[FlagRule, ...]]] = {
    "VehicleLocalPosition": (
        _valid("xy_valid", "xy_invalid", "xy"),
        _valid("z_valid", "z_invalid", "z"),
        _valid("v_xy_valid", "v_xy_invalid", "vxy"),
        _valid("v_z_valid", "v_z_invalid", "vz"),
        FlagRule(
            "dead_reckoning", {"dead_reckoning": "dead reckoning"}, "dead reckoning", "dead reckoning ends",
            initial=True,
        ),
        FlagRule(
            "heading_not_good", {"heading_good_for_control": "heading"}, "heading not good for control",
            "heading good for control", bad=False, severity="info",
        ),
        FlagRule(
            "xy_not_global", {"xy_global": "xy"}, "xy has no global reference", "xy has a global reference",
            bad=False, on_ground="info",
        ),
        FlagRule(
            "z_not_global", {"z_global": "z"}, "z has no global reference", "z has a global reference", bad=False,
            on_ground="info",
        ),
        FlagRule(
            "dist_bottom_invalid", {"dist_bottom_valid": "distance to ground"}, "distance to ground not valid",
            "distance to ground valid", bad=False, severity="info",
        ),
    ),
    "EstimatorStatusFlags": (
        FlagRule(
            "not_fused", {**_AIDING, **_HEIGHTS}, "no longer fused: {}", "fused: {}", bad=False, on_ground="info",
            minor=frozenset(_HEIGHTS),
        ),
        FlagRule("innovation_rejected", _REJECTED, "EKF rejects {}", "EKF accepts {} again"),
        FlagRule("estimator_fault", _FAULTS, "EKF fault: {}", "EKF fault cleared: {}", initial=True),
    ),
    "VehicleStatus": (
        FlagRule("failsafe", {"failsafe": "failsafe"}, "failsafe", "failsafe ends", severity="bad", initial=True),
        FlagRule(
            "gcs_lost", {"gcs_connection_lost": "ground station"}, "link to the ground station lost",
            "link to the ground station restored", on_ground="info",
        ),
    ),
    "FailsafeFlags": (
        FlagRule(
            "failsafe_flag", {name: name.replace("_", " ") for name in _FAILSAFE_FLAGS}, "failsafe flags: {}",
            "failsafe flags cleared: {}", on_ground="info",
        ),
    ),
}  # fmt: skip

_FLAGGED: Final = frozenset(rule.kind for rules in RULES.values() for rule in rules)


def flags_of(kind: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the flags of an event, each of which is a condition of its own; "" for a kind without flags."""
    return names if kind in _FLAGGED else ("",)


RECENT: Final = 60.0
"""Seconds during which a single event counts towards the state of a vehicle."""

MAX_SILENCE: Final = 3.0  # s without a position until a vehicle is silent, if its stream has no state
MIN_FIX_TYPE: Final = 3  # SensorGps.fix_type of a 3D fix
FEW_SATELLITES: Final = 6  # the condition begins below this (PX4's EKF2_REQ_NSATS) and ends at ENOUGH_SATELLITES
ENOUGH_SATELLITES: Final = 7
JAMMING_BEGIN: Final = 80  # jamming_indicator; "too high" in PX4's guide to flight log analysis
JAMMING_END: Final = 60
JUMP_DISTANCE: Final = 1.0  # m of unexplained motion; JUMP_SHARE of the distance flown is added
JUMP_SHARE: Final = 0.2
SMALL_RESET: Final = 0.5  # m or m/s; the severity of a smaller reset is info
FLAPPING_CHANGES: Final = 4, 20  # of a condition, and of a kind of them, within WINDOW; of further ones only the last
PAUSE: Final = 5.0  # s without a further one after which flapping, losses, rejections or an overload have ended
MAX_BURST: Final = 20.0  # s after which losses are reported even if they continue
KEPT_ON_REBOOT: Final = ("silent", "gone", "duplicate", "rejected")  # conditions that a reboot does not end
ARMED: Final = 2  # arming_state

MODES: Final[Mapping[int, str]] = {
    0: "Manual", 1: "Altitude", 2: "Position", 3: "Mission", 4: "Hold", 5: "Return", 6: "Position Slow",
    7: "Guided Course", 8: "Altitude Cruise", 10: "Acro", 12: "Descend", 13: "Termination", 14: "Offboard",
    15: "Stabilized", 17: "Takeoff", 18: "Land", 19: "Follow", 20: "Precision Land", 21: "Orbit", 22: "VTOL Takeoff",
    **{number: f"External {number - 22}" for number in range(23, 31)},
}  # fmt: skip
"""Names of nav_state in QGroundControl."""

FIXES: Final[Mapping[int, str]] = {
    0: "none", 1: "none", 2: "2D", 3: "3D", 4: "DGPS", 5: "RTK float", 6: "RTK fixed", 8: "extrapolated",
}  # fmt: skip
WARNINGS: Final[Mapping[int, str]] = {
    1: "low", 2: "critical", 3: "emergency", 4: "failed", 6: "unhealthy", 7: "charging",
}  # fmt: skip
