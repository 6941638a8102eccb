"""Conversion of MAVLink messages to fields: units, angles and enumerations."""

from __future__ import annotations

import doctest
import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.mavlink import fields
from nedbus.mavlink.fields import CONVERSIONS
from nedbus_msgs import BY_TOPIC

ZEROS = [0.0] * 21


def convert(message: Any) -> dict[str, object]:
    """Return the known fields of a converted message."""
    _, conversion = CONVERSIONS[message.get_type()]
    return {name: value for name, value in conversion(message).items() if value is not None}


def test_example_of_the_module_is_true() -> None:
    """The example in the docstring of the module prints what it shows."""
    result = doctest.testmod(fields)
    assert (result.failed, result.attempted) == (0, 4)


CONVERTED: dict[str, tuple[Any, dict[str, Any]]] = {
    "gps": (
        dialect.MAVLink_gps_raw_int_message(
            10**6, 3, 470_000_000, 80_000_000, 500_000, 120, 150, 1234, 18_000, 12,
            547_000, 2_500, 3_500, 400, 0, 27_000,
        ),
        {
            "fix_type": 3, "latitude_deg": 47.0, "longitude_deg": 8.0, "altitude_msl_m": 500.0,
            "altitude_ellipsoid_m": 547.0, "eph": 2.5, "epv": 3.5, "s_variance_m_s": 0.4, "hdop": 1.2, "vdop": 1.5,
            "vel_m_s": 12.34, "cog_rad": math.pi, "heading": -math.pi / 2, "satellites_used": 12,
        },
    ),
    "fix of another number": (
        dialect.MAVLink_gps_raw_int_message(10**6, 7, 1, 1, 0, 0, 0, 0, 0, 3),
        {
            "latitude_deg": 1e-7, "longitude_deg": 1e-7, "altitude_msl_m": 0.0, "vel_m_s": 0.0, "cog_rad": 0.0,
            "satellites_used": 3,
        },
    ),
    "battery": (
        dialect.MAVLink_battery_status_message(
            0, 0, 0, 2_500, [4_000, 4_100] + [2**16 - 1] * 8, 1_234, 567, -1, 80, 90, 2, [4_200, 0, 0, 0]
        ),
        {
            "voltage_v": 12.3, "current_a": 12.34, "discharged_mah": 567.0, "remaining": 0.8, "time_remaining_s": 90.0,
            "temperature": 25.0, "warning": 1,
        },
    ),
    "global position": (
        dialect.MAVLink_global_position_int_message(0, 470_000_000, -80_000_000, 500_000, 0, 0, 0, 0, 0),
        {"lat": 47.0, "lon": -8.0, "alt": 500.0},
    ),
    "home": (
        dialect.MAVLink_home_position_message(
            470_000_000, 80_000_000, 500_000, 1, 2, 3, [math.sqrt(0.5), 0, 0, math.sqrt(0.5)], 0, 0, 0
        ),
        {
            "lat": 47.0, "lon": 8.0, "alt": 500.0, "valid_hpos": True, "valid_alt": True, "x": 1.0, "y": 2.0, "z": 3.0,
            "roll": 0.0, "pitch": 0.0, "yaw": math.pi / 2,
        },
    ),
    "attitude": (
        dialect.MAVLink_attitude_message(0, 0.0, 0.0, math.pi, 0, 0, 0),
        {"q": (0.0, 0.0, 0.0, 1.0)},
    ),
    "flying": (dialect.MAVLink_extended_sys_state_message(0, 2), {"landed": False}),
    "odometry in other frames": (
        dialect.MAVLink_odometry_message(
            0, dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_GLOBAL, 1, 2, 3, [1, 0, 0, 0], 4, 5, 6, 7, 8, 9,
            ZEROS, ZEROS, 1, 8, 100,
        ),
        {"angular_velocity": (7, 8, 9), "reset_counter": 1, "quality": 100},
    ),
    "odometry in FRD": (
        dialect.MAVLink_odometry_message(
            0, dialect.MAV_FRAME_LOCAL_FRD, dialect.MAV_FRAME_BODY_FRD, 1, 2, 3, [1, 0, 0, 0], 4, 5, 6, 7, 8, 9,
            ZEROS, ZEROS, 1, 8, 100,
        ),
        {
            "pose_frame": 2, "position": (1, 2, 3), "q": (1, 0, 0, 0), "velocity_frame": 3, "velocity": (4, 5, 6),
            "angular_velocity": (7, 8, 9), "reset_counter": 1, "quality": 100,
        },
    ),
    "armed in simulation": (
        dialect.MAVLink_heartbeat_message(2, 12, 128 + 32, 0, dialect.MAV_STATE_CRITICAL, 3),
        {
            "arming_state": 2, "hil_state": 1, "failsafe": True, "system_type": 2, "system_id": 0, "component_id": 0,
        },
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CONVERTED)
def test_values_are_in_the_units_of_px4(name: str) -> None:
    """Values have PX4's units and numbers; those that mean "unknown", and fixes that differ, are left out."""
    message, expected = CONVERTED[name]
    fields = convert(message)
    assert fields.keys() == expected.keys()
    for field, value in expected.items():
        assert fields[field] == pytest.approx(value, abs=1e-6), field


@pytest.mark.parametrize("name", CONVERTED)
def test_converted_fields_are_those_of_the_topic(name: str) -> None:
    """Each converted field is one of the topic's message."""
    message, _ = CONVERTED[name]
    topic, conversion = CONVERSIONS[message.get_type()]
    assert conversion(message).keys() <= BY_TOPIC[topic].types.keys()
