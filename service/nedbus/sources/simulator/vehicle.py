"""Messages of the simulated vehicle besides its estimates: status, landing, home, battery and GNSS receiver."""

import math
from typing import Final

from nedbus_msgs import MESSAGES
from nedbus_msgs.frames import MapProjection

from .flight import BOOT, CLIMB, LAP, ORIGIN_SET, OUTAGE, Estimator, Truth

_Status: Final = MESSAGES["VehicleStatus"].model
_Gps: Final = MESSAGES["SensorGps"].model
_ARMED: Final = BOOT - 1_000_000  # us since boot
_CAPACITY: Final = 5000.0  # mAh
_CURRENT: Final = 12.0  # A
_ENDURANCE: Final = 1200.0  # s until the battery is replaced by a full one, with a fifth of its charge left
_BOOTED_AT: Final = 1_767_225_600_000_000  # us of Unix time: start of 2026


def status(estimator: Estimator, time: float, _: Truth) -> dict[str, object]:
    """Return the status: take-off, then a mission; without a valid position, a failsafe that holds altitude."""
    failsafe = not estimator.xy_valid(time)
    flown = _Status.NAVIGATION_STATE_AUTO_MISSION if time >= CLIMB else _Status.NAVIGATION_STATE_AUTO_TAKEOFF
    mode = _Status.NAVIGATION_STATE_ALTCTL if failsafe else flown
    return {
        "timestamp": BOOT + round(time * 1e6), "armed_time": _ARMED, "takeoff_time": BOOT,
        "arming_state": _Status.ARMING_STATE_ARMED,
        "nav_state": mode, "nav_state_display": mode, "nav_state_user_intention": flown, "failsafe": failsafe,
        "vehicle_type": _Status.VEHICLE_TYPE_ROTARY_WING, "system_type": 2, "system_id": 1, "component_id": 1,
        "safety_off": True, "power_input_valid": True, "pre_flight_checks_pass": True,
    }  # fmt: skip


def land_detected(time: float, truth: Truth) -> dict[str, object]:
    """Return the land detector's output: landed until take-off."""
    (vx, vy, vz), landed = truth.velocity, truth.position[2] > -0.1
    return {
        "timestamp": BOOT + round(time * 1e6),
        **dict.fromkeys(("landed", "maybe_landed", "ground_contact", "at_rest"), landed),
        "vertical_movement": abs(vz) > 0.5, "horizontal_movement": math.hypot(vx, vy) > 1.5,
        "close_to_ground_or_skipped_check": truth.position[2] > -1.0,
    }  # fmt: skip


def home(time: float, truth: Truth) -> dict[str, object]:
    """Return the place of take-off, with global coordinates once the origin is known."""
    known = time >= ORIGIN_SET
    latitude, longitude, altitude = truth.origin if known else (math.nan,) * 3
    return {
        "timestamp": BOOT + round(time * 1e6), "lat": latitude, "lon": longitude, "alt": altitude,
        "x": 0.0, "y": 0.0, "z": 0.0, "roll": 0.0, "pitch": 0.0, "yaw": truth.heading,
        "valid_hpos": known, "valid_alt": known, "valid_lpos": True, "valid_attitude": True,
        "update_count": 1 + known,
    }  # fmt: skip


def battery(time: float, _: Truth) -> dict[str, object]:
    """Return the state of a battery that is discharged by a constant current."""
    discharged = _CURRENT * (time % _ENDURANCE) / 3.6
    remaining = 1.0 - discharged / _CAPACITY
    return {
        "timestamp": BOOT + round(time * 1e6), "connected": True, "id": 1, "scale": 1.0,
        "voltage_v": 14.0 + 2.8 * remaining, "current_a": _CURRENT, "current_average_a": _CURRENT,
        "discharged_mah": discharged, "remaining": remaining, "capacity": round(_CAPACITY),
        "time_remaining_s": remaining * _CAPACITY * 3.6 / _CURRENT, "temperature": 30.0, "cell_count": 4,
    }  # fmt: skip


def gps(time: float, truth: Truth) -> dict[str, object]:
    """Return a GNSS fix with noise; there is none before the origin is set, and in the outage."""
    now, is_started = BOOT + round(time * 1e6), time >= ORIGIN_SET
    fix = is_started and not OUTAGE[0] <= time % LAP < OUTAGE[1]
    north, east, down = (
        value + 0.3 * math.sin(time * rate) for value, rate in zip(truth.position, (1.7, 2.3, 3.1), strict=True)
    )
    latitude, longitude = MapProjection(*truth.origin[:2]).reproject(north, east) if fix else (math.nan, math.nan)
    altitude = truth.origin[2] - down if fix else math.nan
    vx, vy, vz = truth.velocity if fix else (math.nan,) * 3
    return {
        "timestamp": now, "device_id": 1, "fix_type": _Gps.FIX_TYPE_3D if fix else _Gps.FIX_TYPE_NONE,
        "latitude_deg": latitude, "longitude_deg": longitude,
        "altitude_msl_m": altitude, "altitude_ellipsoid_m": altitude,
        "eph": 0.9 if fix else 100.0, "epv": 1.8 if fix else 100.0, "s_variance_m_s": 0.4 if fix else 100.0,
        "hdop": 0.7 if fix else 100.0, "vdop": 1.1 if fix else 100.0, "satellites_used": 14 if fix else 0,
        "vel_ned_valid": fix, "vel_n_m_s": vx, "vel_e_m_s": vy, "vel_d_m_s": vz,
        "vel_m_s": math.hypot(vx, vy), "cog_rad": math.atan2(vy, vx),
        "time_utc_usec": _BOOTED_AT + now if is_started else 0,
    }  # fmt: skip
