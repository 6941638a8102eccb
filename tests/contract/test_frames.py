"""Frames and places, as PX4's own tests and a real log's vehicle_global_position have them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pyulog import ULog

from nedbus_msgs import (
    GlobalPosition,
    MapProjection,
    NoOrigin,
    Row,
    VehicleLocalPosition,
    enu_to_ned,
    flu_to_frd,
    frd_to_flu,
    ned_to_enu,
    to_global,
    to_local,
    variances_enu_to_ned,
    variances_ned_to_enu,
    wrap,
    yaw_enu_to_ned,
    yaw_ned_to_enu,
)

LOGS = Path(__file__).parents[3] / "shared" / "data" / "ulog"
RADIUS = 6_371_000.0

numbers = st.floats(-1e6, 1e6)
vectors = st.tuples(numbers, numbers, numbers)
angles = st.floats(-math.pi, math.pi)


def at_home(**fields: object) -> VehicleLocalPosition:
    """Return a message with PX4's test origin."""
    origin = {"xy_global": True, "z_global": True, "ref_lat": 47.3566094, "ref_lon": 8.5190237, "ref_alt": 151.3}
    return VehicleLocalPosition.model_validate({"timestamp": 1, **origin, **fields})


def test_known_projections() -> None:
    """A degree of latitude at the equator, on PX4's sphere."""
    north, east = MapProjection(0.0, 0.0).project(1.0, 0.0)
    assert north == pytest.approx(111194.9266, abs=0.01)
    assert east == pytest.approx(0.0, abs=0.01)


def test_local_position_is_global_as_px4_has_it() -> None:
    """PX4's test values, both ways."""
    place = to_global(at_home(x=0.5, y=1.0, z=-2.0))
    assert place
    assert place.latitude == pytest.approx(47.3566138966073, abs=1e-11)
    assert place.longitude == pytest.approx(8.51903697542915, abs=1e-11)
    assert place.altitude == pytest.approx(153.3, abs=1e-5)
    there = to_local(GlobalPosition(47.356616973876953, 8.5190505981445313, 163.7), at_home())
    assert there == pytest.approx((0.842, 2.026, -12.4), abs=1e-3)


def test_a_row_has_a_place_too() -> None:
    """Rows and models are the same to the functions."""
    message = at_home(x=0.5, y=1.0, z=-2.0)
    assert to_global(Row._make(tuple(message.__dict__.values()))) == to_global(message)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [({}, "xy_global is false"), ({"xy_global": True, "ref_lat": 1.0, "ref_lon": 2.0}, "x and y are not provided")],
)
def test_without_origin_the_answer_says_so(fields: dict[str, object], reason: str) -> None:
    """No origin is an answer with a reason, and false."""
    message = VehicleLocalPosition.model_validate({"timestamp": 1, **fields})
    answer = to_global(message)
    assert isinstance(answer, NoOrigin)
    assert not answer
    assert reason in answer.reason


def test_no_origin_for_a_way_back() -> None:
    """A place is nowhere in a frame without origin."""
    assert not to_local(GlobalPosition(47.0, 8.0, 0.0), VehicleLocalPosition(timestamp=1))


def test_altitude_needs_its_own_origin() -> None:
    """With a horizontal origin alone the altitude is NaN."""
    message = at_home(x=1.0, y=1.0, z=1.0, z_global=False)
    place = to_global(message)
    assert place
    assert math.isnan(place.altitude)
    back = to_local(place, message)
    assert back
    assert math.isnan(back[2])


@pytest.mark.logs
@pytest.mark.parametrize("name", ["sitl_1.15_events.ulg", "nxp_v0_ekf_failure.ulg"])
def test_real_flight_agrees_with_px4s_own_global_position(name: str) -> None:
    """At equal timestamp_sample, place and PX4's vehicle_global_position differ by less than 1e-10 degrees."""
    if not (LOGS / name).exists():
        pytest.skip(f"the real logs are not here: {LOGS}")
    log = ULog(str(LOGS / name), ["vehicle_local_position", "vehicle_global_position"])
    tables = {data.name: data.data for data in log.data_list if data.multi_id == 0}
    ours, theirs = tables["vehicle_local_position"], tables["vehicle_global_position"]
    _, here, there = np.intersect1d(ours["timestamp_sample"], theirs["timestamp_sample"], return_indices=True)
    compared = 0
    for i, j in zip(here.tolist(), there.tolist(), strict=True):
        names = ("x", "y", "z", "ref_lat", "ref_lon", "ref_alt")
        fields = {name: ours[name][i].item() for name in names}
        if not ours["xy_global"][i] or not ours["z_global"][i] or not ours["xy_valid"][i]:
            continue
        place = to_global(VehicleLocalPosition(timestamp=1, xy_global=True, z_global=True, **fields))
        assert place
        assert place.latitude == pytest.approx(theirs["lat"][j], abs=1e-10)
        assert place.longitude == pytest.approx(theirs["lon"][j], abs=1e-10)
        assert place.altitude == pytest.approx(theirs["alt"][j], abs=1e-3)
        compared += 1
    assert compared > 10


@given(st.floats(-90, 90), st.floats(-180, 180), st.floats(0, 100_000), st.floats(-math.pi, math.pi))
def test_projection_comes_back(latitude: float, longitude: float, distance: float, bearing: float) -> None:
    """Within 100 km of any origin, poles and antimeridian included, the way there and back is within 1 mm."""
    origin = MapProjection(latitude, longitude)
    north, east = distance * math.cos(bearing), distance * math.sin(bearing)
    there = origin.reproject(north, east)
    assert -90 <= there[0] <= 90
    assert -180 <= there[1] <= 180
    assert math.dist(origin.project(*there), (north, east)) < 1e-3


@given(st.floats(-89, 89), st.floats(-180, 180), st.floats(1, 100_000), angles)
def test_distance_is_kept(latitude: float, longitude: float, distance: float, bearing: float) -> None:
    """The projection is equidistant: the great circle is as long as the way in the plane."""
    there = MapProjection(latitude, longitude).reproject(distance * math.cos(bearing), distance * math.sin(bearing))
    one, other = (unit(*map(math.radians, place)) for place in ((latitude, longitude), there))
    # The chord is well conditioned where an arc cosine is not.
    assert 2 * RADIUS * math.asin(math.dist(one, other) / 2) == pytest.approx(distance, abs=1e-3)


def unit(latitude: float, longitude: float) -> tuple[float, float, float]:
    return (
        math.cos(latitude) * math.cos(longitude),
        math.cos(latitude) * math.sin(longitude),
        math.sin(latitude),
    )


def test_known_frames() -> None:
    """PX4's and ROS's conventions, by hand."""
    assert ned_to_enu((1.0, 2.0, 3.0)) == (2.0, 1.0, -3.0)
    assert frd_to_flu((1.0, 2.0, 3.0)) == (1.0, -2.0, -3.0)
    assert variances_ned_to_enu((1.0, 2.0, 3.0)) == (2.0, 1.0, 3.0)
    assert yaw_ned_to_enu(0.0) == math.pi / 2
    assert yaw_ned_to_enu(math.pi / 4) == math.pi / 4
    assert yaw_ned_to_enu(math.pi) == -math.pi / 2
    assert math.isnan(yaw_ned_to_enu(math.nan))


@given(vectors)
def test_vectors_come_back(vector: tuple[float, float, float]) -> None:
    """Each frame's way back undoes the way there."""
    assert enu_to_ned(ned_to_enu(vector)) == vector
    assert flu_to_frd(frd_to_flu(vector)) == vector
    assert variances_enu_to_ned(variances_ned_to_enu(vector)) == vector


@given(angles)
def test_yaw_comes_back(yaw: float) -> None:
    """A yaw that goes to ENU and back is the same angle, and the same direction as a vector that goes there."""
    enu = yaw_ned_to_enu(yaw)
    assert abs(enu) <= math.pi
    assert abs(wrap(yaw_enu_to_ned(enu) - yaw)) < 1e-12
    east, north, _ = ned_to_enu((math.cos(yaw), math.sin(yaw), 0.0))
    assume(abs(east) + abs(north) > 0)
    assert abs(wrap(math.atan2(north, east) - enu)) < 1e-12
