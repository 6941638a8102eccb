"""Fields of one MAVLink message that complete another one."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.mavlink.stored_fields import StoredFields


def odometry(north: float, east: float, down: float) -> Any:
    """Return an ODOMETRY with these variances of the velocity."""
    covariance = [0.0] * 21
    covariance[0], covariance[6], covariance[11] = north, east, down
    vectors = (0, 0, 0, (1, 0, 0, 0), *(0,) * 6)
    return dialect.MAVLink_odometry_message(
        1000, 1, 12, *vectors, [0.0] * 21, covariance, 0, 8, 100
    )


def status(horizontal: float, vertical: float) -> Any:
    """Return an ESTIMATOR_STATUS with these errors of the position."""
    flags = dialect.ESTIMATOR_POS_HORIZ_ABS | dialect.ESTIMATOR_VELOCITY_HORIZ
    return dialect.MAVLink_estimator_status_message(
        1000, flags, 0, 0, 0, 0, 0, 0, horizontal, vertical
    )


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (odometry(9.0, 16.0, 4.0), {"evh": 5.0, "evv": 2.0}),
        (odometry(0.0, 0.0, 0.0), {}),
        (odometry(math.nan, 1.0, math.nan), {}),
        (odometry(1.0, math.nan, math.inf), {}),
        (odometry(-1.0, 2.0, -1.0), {}),
        (status(1.0, 2.0), {"eph": 1.0, "epv": 2.0}),
        (status(0.0, math.nan), {}),
        (status(math.inf, -1.0), {}),
    ],
)
def test_errors_are_added_if_they_are_known(message: Any, expected: dict[str, float]) -> None:
    """Errors of velocity and position are those that MAVLink sends; 0, NaN and negative ones are unknown."""
    stored = StoredFields()
    stored.add(message.get_type(), message, 1000, 100.0)
    fields: dict[str, object] = dict.fromkeys(("timestamp", "x", "y", "z", "vx", "vy", "vz"), 0)
    stored.complete("vehicle_local_position", fields, 101.0)
    assert {name: value for name, value in fields.items() if name[0] == "e"} == expected


@pytest.mark.parametrize(("age", "is_known"), [(4.9, True), (5.1, False)])
def test_utc_is_added_to_gps_for_five_seconds(age: float, is_known: bool) -> None:
    """SYSTEM_TIME places the boot in UTC, from which that of a later GPS message follows."""
    stored = StoredFields()
    unix = 1_700_000_000_000_000
    message = dialect.MAVLink_system_time_message(unix, 1000)
    stored.add("SYSTEM_TIME", message, 1_000_000, 100.0)
    fields: dict[str, object] = {"timestamp": 3_000_000}
    stored.complete("sensor_gps", fields, 100.0 + age)
    assert fields.get("time_utc_usec") == (unix + 2_000_000 if is_known else None)
