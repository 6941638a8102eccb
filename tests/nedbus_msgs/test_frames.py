"""Frame conversions and global positions, compared with PX4's tests and vehicle_global_position of real logs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import assume, example, given, strategies as st
from pyulog import ULog

import nedbus
from nedbus_msgs import BY_TOPIC, VehicleLocalPosition
from nedbus_msgs.arrays import derive_column, to_array, to_message
from nedbus_msgs.frames import (
    DERIVED,
    GlobalPosition,
    MapProjection,
    derive,
    derived_from,
    enu_to_ned,
    euler_to_quaternion,
    flu_to_frd,
    frd_to_flu,
    ned_to_enu,
    quaternion_enu_to_ned,
    quaternion_ned_to_enu,
    quaternion_to_euler,
    to_global,
    to_local,
    variances_enu_to_ned,
    variances_ned_to_enu,
    wrap,
    yaw_enu_to_ned,
    yaw_ned_to_enu,
)
from nedbus_msgs.messages import VehicleAttitude
from tests.flights.local_position import row_of
from tests.flights.ulogs import LOGS

RADIUS = 6_371_000.0

numbers = st.floats(-1e6, 1e6)
vectors = st.tuples(numbers, numbers, numbers)
angles = st.floats(-math.pi, math.pi)


def with_origin(**fields: object) -> VehicleLocalPosition:
    """Return a message with PX4's test origin."""
    origin = {
        "xy_global": True,
        "z_global": True,
        "ref_lat": 47.3566094,
        "ref_lon": 8.5190237,
        "ref_alt": 151.3,
    }
    return VehicleLocalPosition.model_validate({"timestamp": 1, **origin, **fields})


def test_length_of_a_degree_of_latitude_matches_px4() -> None:
    """One degree of latitude is 111,194.93 m on PX4's sphere."""
    north, east = MapProjection(0.0, 0.0).project(1.0, 0.0)
    assert north == pytest.approx(111194.9266, abs=0.01)
    assert east == pytest.approx(0.0, abs=0.01)


def test_global_and_local_positions_match_px4() -> None:
    """Both directions reproduce the values of PX4's own tests."""
    position = to_global(with_origin(x=0.5, y=1.0, z=-2.0))
    assert position
    assert position.latitude == pytest.approx(47.3566138966073, abs=1e-11)
    assert position.longitude == pytest.approx(8.51903697542915, abs=1e-11)
    assert position.altitude == pytest.approx(153.3, abs=1e-5)
    local = to_local(GlobalPosition(47.356616973876953, 8.5190505981445313, 163.7), with_origin())
    assert local == pytest.approx((0.842, 2.026, -12.4), abs=1e-3)


def test_to_global_accepts_a_row() -> None:
    """A row and its model have the same global position."""
    message = with_origin(x=0.5, y=1.0, z=-2.0)
    assert to_global(row_of(message)) == to_global(message)


@pytest.mark.parametrize(
    "fields", [{"x": 1.0, "y": 2.0}, {"xy_global": True, "ref_lat": 1.0, "ref_lon": 2.0}]
)
def test_position_without_origin_is_none(fields: dict[str, object]) -> None:
    """Without a global origin, to_global and to_local return None, and so does to_global without x and y."""
    message = VehicleLocalPosition.model_validate({"timestamp": 1, **fields})
    assert to_global(message) is None
    assert "xy_global" in fields or to_local(GlobalPosition(47.0, 8.0, 0.0), message) is None


def test_altitude_without_vertical_origin_is_nan() -> None:
    """With a horizontal origin only, altitude and z are NaN."""
    message = with_origin(x=1.0, y=1.0, z=1.0, z_global=False)
    position = to_global(message)
    assert position
    assert math.isnan(position.altitude)
    back = to_local(position, message)
    assert back
    assert math.isnan(back[2])


@pytest.mark.logs
@pytest.mark.parametrize("name", ["sitl_1.15_events.ulg", "nxp_v0_ekf_failure.ulg"])
def test_to_global_matches_px4_in_real_logs(name: str) -> None:
    """At equal timestamp_sample, to_global and PX4's vehicle_global_position differ by less than 1e-10 degrees."""
    if not (LOGS / name).exists():
        pytest.skip(f"real logs not found: {LOGS}")
    log = ULog(str(LOGS / name), ["vehicle_local_position", "vehicle_global_position"])
    tables = {data.name: data.data for data in log.data_list if data.multi_id == 0}
    local, px4_global = tables["vehicle_local_position"], tables["vehicle_global_position"]
    samples = local["timestamp_sample"], px4_global["timestamp_sample"]
    _, local_rows, global_rows = np.intersect1d(*samples, return_indices=True)
    compared = 0
    for i, j in zip(local_rows.tolist(), global_rows.tolist(), strict=True):
        if not local["xy_global"][i] or not local["z_global"][i] or not local["xy_valid"][i]:
            continue
        fields = {
            name: local[name][i].item() for name in ("x", "y", "z", "ref_lat", "ref_lon", "ref_alt")
        }
        position = to_global(
            VehicleLocalPosition(timestamp=1, xy_global=True, z_global=True, **fields)
        )
        assert position
        assert position.latitude == pytest.approx(px4_global["lat"][j], abs=1e-10)
        assert position.longitude == pytest.approx(px4_global["lon"][j], abs=1e-10)
        assert position.altitude == pytest.approx(px4_global["alt"][j], abs=1e-3)
        compared += 1
    assert compared > 10


@given(st.floats(-90, 90), st.floats(-180, 180), st.floats(0, 100_000), angles)
@example(10.0, 179.9, 100_000.0, math.pi / 2)
@example(10.0, -179.9, 100_000.0, -math.pi / 2)
@example(90.0, 0.0, 100_000.0, 1.0)
def test_projection_round_trip(
    latitude: float, longitude: float, distance: float, bearing: float
) -> None:
    """The round trip is exact to 1 mm within 100 km of any origin, including poles and antimeridian."""
    origin = MapProjection(latitude, longitude)
    north, east = distance * math.cos(bearing), distance * math.sin(bearing)
    projected = origin.reproject(north, east)
    assert -90 <= projected[0] <= 90
    assert -180 <= projected[1] <= 180
    assert math.dist(origin.project(*projected), (north, east)) < 1e-3


@given(st.floats(-89, 89), st.floats(-180, 180), st.floats(1, 100_000), angles)
def test_projection_is_equidistant(
    latitude: float, longitude: float, distance: float, bearing: float
) -> None:
    """The great-circle distance from the origin equals the distance in the plane."""
    other = MapProjection(latitude, longitude).reproject(
        distance * math.cos(bearing), distance * math.sin(bearing)
    )
    one, two = (unit(*map(math.radians, each)) for each in ((latitude, longitude), other))
    # The chord is well conditioned where an arc cosine is not.
    assert 2 * RADIUS * math.asin(math.dist(one, two) / 2) == pytest.approx(distance, abs=1e-3)


def unit(latitude: float, longitude: float) -> tuple[float, float, float]:
    return (
        math.cos(latitude) * math.cos(longitude),
        math.cos(latitude) * math.sin(longitude),
        math.sin(latitude),
    )


def test_frame_conversions_match_hand_computed_values() -> None:
    """Conversions match values computed by hand from the conventions of PX4 and ROS."""
    assert ned_to_enu((1.0, 2.0, 3.0)) == (2.0, 1.0, -3.0)
    assert frd_to_flu((1.0, 2.0, 3.0)) == (1.0, -2.0, -3.0)
    assert variances_ned_to_enu((1.0, 2.0, 3.0)) == (2.0, 1.0, 3.0)
    assert yaw_ned_to_enu(0.0) == math.pi / 2
    assert yaw_ned_to_enu(math.pi / 4) == math.pi / 4
    assert yaw_ned_to_enu(math.pi) == -math.pi / 2
    assert math.isnan(yaw_ned_to_enu(math.nan))


@given(vectors)
def test_vectors_round_trip(vector: tuple[float, float, float]) -> None:
    """Each conversion undoes its inverse."""
    assert enu_to_ned(ned_to_enu(vector)) == vector
    assert flu_to_frd(frd_to_flu(vector)) == vector
    assert variances_enu_to_ned(variances_ned_to_enu(vector)) == vector


@given(angles)
def test_yaw_round_trip(yaw: float) -> None:
    """A yaw converted to ENU and back is the same angle, and in ENU it has the direction of the converted vector."""
    enu = yaw_ned_to_enu(yaw)
    assert abs(enu) <= math.pi
    assert abs(wrap(yaw_enu_to_ned(enu) - yaw)) < 1e-12
    east, north, _ = ned_to_enu((math.cos(yaw), math.sin(yaw), 0.0))
    assume(abs(east) + abs(north) > 0)
    assert abs(wrap(math.atan2(north, east) - enu)) < 1e-12


def rotate(q: Sequence[float], vector: tuple[float, float, float]) -> tuple[float, ...]:
    """Return a vector rotated by a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return tuple(sum(a * b for a, b in zip(row, vector, strict=True)) for row in rows)


@given(angles, angles, angles)
def test_converted_attitude_rotates_vectors_the_same_way(
    roll: float, pitch: float, yaw: float
) -> None:
    """The converted attitude rotates an FLU vector as the original rotates the same vector in FRD."""
    q = euler_to_quaternion(roll, pitch, yaw)
    enu = quaternion_ned_to_enu(q)
    for vector in ((1.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.5, -1.0, 3.0)):
        north, east, down = rotate(q, vector)
        assert rotate(enu, frd_to_flu(vector)) == pytest.approx(
            ned_to_enu((north, east, down)), abs=1e-9
        )
    assert quaternion_enu_to_ned(enu) == pytest.approx(q)


@given(angles, angles, angles)
def test_angles_of_a_quaternion_do_not_depend_on_its_norm(
    roll: float, pitch: float, yaw: float
) -> None:
    """A quaternion that vision did not normalise has the same angles; zeros, which are no rotation, have none."""
    q = euler_to_quaternion(roll, pitch, yaw)
    expected = quaternion_to_euler(q)
    found = quaternion_to_euler([1.05 * element for element in q])
    assert all(abs(wrap(one - other)) < 1e-6 for one, other in zip(found, expected, strict=True))
    assert all(map(math.isnan, quaternion_to_euler([0.0] * 4)))


@pytest.mark.parametrize(
    ("east", "expected"), [(0.0, -179.5), (100.0, -179.4991), (-60_000.0, 179.96)]
)
def test_reprojected_longitude_is_wrapped(east: float, expected: float) -> None:
    """An origin east of 180 degrees, as PX4 up to 1.15 sends it, gives longitudes within 180 degrees."""
    projection = MapProjection(0.0, 180.5)
    assert projection.reproject(0.0, east)[1] == pytest.approx(expected, abs=1e-3)
    assert projection.project(0.0, -179.5) == pytest.approx((0.0, 0.0), abs=1e-6)


def _matrix_angles(q: Sequence[float]) -> tuple[float, float, float]:
    """Return roll, pitch and yaw [rad] from the rotation matrix of q, whose columns are the rotated body axes."""
    w, x, y, z = np.asarray(q, float) / np.linalg.norm(q)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    forward, right, down = matrix.T
    return math.atan2(right[2], down[2]), math.asin(-forward[2]), math.atan2(forward[1], forward[0])


def test_derived_angles_follow_the_documented_order() -> None:
    """From NED, the body is turned by yaw about down, then pitch about right, then roll about forward."""
    for roll, pitch, yaw in [(0.3, -0.4, 2.0), (-3.0, 1.5, -3.1), (0.0, 0.0, 0.0)]:
        message = VehicleAttitude(timestamp=1, q=euler_to_quaternion(roll, pitch, yaw))
        found = [derive(message, name) for name in ("roll", "pitch", "yaw")]
        assert found == pytest.approx([roll, pitch, yaw], abs=1e-6)
        degrees = [derive(message, name) for name in ("roll_deg", "pitch_deg", "yaw_deg")]
        assert degrees == pytest.approx(np.degrees([roll, pitch, yaw]).tolist(), abs=1e-4)


def test_derived_values_of_invalid_fields_are_nan() -> None:
    """A false or missing flag, and a q of zeros or NaN, result in NaN, in messages as in arrays."""
    local = [
        VehicleLocalPosition(timestamp=1, z=-5.0, vx=3.0, vy=4.0, z_valid=True, v_xy_valid=True),
        VehicleLocalPosition(timestamp=1, z=-5.0, vx=3.0, vy=4.0),
    ]
    for name, value in (("height", 5.0), ("speed", 5.0)):
        assert [derive(each, name) for each in local] == pytest.approx(
            [value, math.nan], nan_ok=True
        )
        assert derive_column(to_array(local), name) == pytest.approx([value, math.nan], nan_ok=True)
    unknown = to_array([VehicleAttitude(timestamp=1, q=(math.nan, 0.0, 0.0, 0.0))] * 2)
    unknown["q"][1] = 0.0
    assert np.isnan(derive_column(unknown, "roll")).all()
    assert math.isnan(derive(VehicleAttitude(timestamp=1, q=(math.nan, 0.0, 0.0, 0.0)), "yaw"))
    assert derived_from(VehicleLocalPosition.model_fields) == ["height", "speed"]
    assert derived_from(("timestamp", "height")) == []


@pytest.mark.logs
@pytest.mark.parametrize("topic", ["vehicle_attitude", "vehicle_local_position"])
def test_derived_columns_equal_messages_and_matrices_in_a_real_log(topic: str) -> None:
    """In a real log, arrays and messages have the same values, and angles are those of the rotation matrices."""
    path = LOGS / "sitl_1.15_events.ulg"
    if not path.exists():
        pytest.skip(f"real logs not found: {LOGS}")
    messages = nedbus.read(path, topic)
    names = derived_from(messages.dtype.names or ())
    assert len(names) == (6 if topic == "vehicle_attitude" else 2)
    columns = {name: derive_column(messages, name) for name in names}
    model = BY_TOPIC[topic].model
    rows = range(0, len(messages), max(1, len(messages) // 200))
    for row in rows:
        message = to_message(messages[row], model)
        assert [derive(message, name) for name in names] == pytest.approx(
            [columns[name][row] for name in names], rel=1e-12, abs=1e-12, nan_ok=True
        )
        if topic == "vehicle_attitude":
            angles = [columns[name][row] for name in ("roll", "pitch", "yaw")]
            assert angles == pytest.approx(_matrix_angles(messages["q"][row]), abs=1e-6)
    assert all(np.isfinite(columns[name]).any() for name in DERIVED if name in columns)
