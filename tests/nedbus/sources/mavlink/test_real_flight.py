"""All MAVLink messages of one flight of a real PX4, compared with its own log."""

from __future__ import annotations

import math
from bisect import bisect
from collections import Counter, defaultdict
from typing import Any, Final

import pytest
from pymavlink.dialects.v20 import common as dialect
from pyulog import ULog

from nedbus.mavlink.parser import new_parser
from nedbus.mavlink.requests import STREAMS as REQUESTED
from nedbus.mavlink.vehicle import Vehicle
from nedbus.sources import SourceMessage
from nedbus_msgs import BY_TOPIC, upgrade_with
from tests.flights.messages import VLP
from tests.flights.replays import open_replay
from tests.nedbus.sources.px4.test_real_flight import PX4, read_datagrams
from tests.peers.px4_log_stream import STREAMS, datagrams

LOG: Final = PX4 / "twelve_messages.ulg"
TOPICS: Final = {topic for stream in REQUESTED.values() for topic in stream.topics} - {VLP}
# s: maximum age of the logged value that equals a message without a timestamp
UNTIMED_AGE: Final = 2.0
STATUS_AGE: Final = 1.2  # s: ESTIMATOR_STATUS is sent once a second
RESOLUTION: Final = {
    "lat": 1e-7, "lon": 1e-7, "latitude_deg": 1e-7, "longitude_deg": 1e-7,
    "alt": 1e-3, "altitude_msl_m": 1e-3, "altitude_ellipsoid_m": 1e-3, "eph": 1e-3, "epv": 1e-3,
    "vel_m_s": 0.01, "cog_rad": math.radians(0.01), "hdop": 0.01, "vdop": 0.01, "s_variance_m_s": 1e-3,
    "voltage_v": 1e-3, "remaining": 0.01, "current_a": 0.01,
}  # fmt: skip
NOT_IN_THE_LOG: Final = {
    "time_utc_usec",
    *(f"onboard_control_sensors_{x}" for x in ("present", "enabled", "health")),
}
FIELDS: Final = {  # converted fields by topic
    "vehicle_attitude": "q",
    "vehicle_odometry": "angular_velocity orientation_variance pose_frame position position_variance q quality"
    " reset_counter velocity velocity_frame velocity_variance",
    "vehicle_global_position": "alt alt_valid eph epv lat lat_lon_valid lon",
    "sensor_gps": "altitude_ellipsoid_m altitude_msl_m cog_rad eph epv fix_type hdop latitude_deg longitude_deg"
    " s_variance_m_s satellites_used time_utc_usec vdop vel_m_s",
    "vehicle_land_detected": "landed",
    "battery_status": "discharged_mah remaining voltage_v warning",
    "home_position": "alt lat lon pitch roll valid_alt valid_hpos x y yaw z",
    "vehicle_status": "arming_state component_id failsafe hil_state onboard_control_sensors_enabled"
    " onboard_control_sensors_health onboard_control_sensors_present system_id system_type",
}

pytestmark = [
    pytest.mark.logs,
    pytest.mark.skipif(not LOG.exists(), reason=f"no recordings of a PX4: {PX4} does not exist"),
]


def is_same(name: str, converted: Any, logged: Any) -> bool:
    """Return whether a value equals the logged one within MAVLink's resolution."""
    if isinstance(converted, tuple):
        return all(is_same(name, one, other) for one, other in zip(converted, logged, strict=True))
    if converted == logged or not isinstance(converted, float):
        return bool(converted == logged)
    error = (
        math.remainder(converted - logged, math.tau)
        if name == "cog_rad"
        else float(converted - logged)
    )
    return abs(error) <= RESOLUTION.get(name, 1e-6) or (
        math.isnan(converted) and math.isnan(logged)
    )


@pytest.mark.long
def test_converted_messages_equal_log() -> None:
    """Each converted message is valid, in order, and equals the logged one within MAVLink's resolution."""
    rows: dict[tuple[str, int | None], list[Any]] = defaultdict(list)
    for each in open_replay(f"ulog:{LOG}?topics={','.join(TOPICS)}").messages:
        rows[each.address.topic, each.address.instance].append(
            upgrade_with(BY_TOPIC[each.address.topic], each.fields)
        )
    times = {key: [row.timestamp for row in of_key] for key, of_key in rows.items()}
    vehicle, parser = Vehicle("1", TOPICS), dialect.MAVLink(None)
    compared, unlogged, fields_converted = (
        Counter[str](),
        Counter[str](),
        defaultdict[str, set[str]](set),
    )
    for time_ns, datagram in read_datagrams(PX4 / "twelve_messages_mavlink.bin.gz"):
        for message in parser.parse_buffer(datagram) or []:
            if not message.get_srcSystem():
                continue  # not in the dialect
            vehicle.count_lost(0, time_ns / 1e9)
            converted = vehicle.handle(message, time_ns / 1e9)
            if converted is None:
                continue
            assert isinstance(converted, SourceMessage)
            assert not converted.rebooted
            topic, instance, fields = (
                converted.address.topic,
                converted.address.instance,
                converted.fields,
            )
            model, now = upgrade_with(BY_TOPIC[topic], fields), converted.fields["timestamp"]
            assert isinstance(now, int)
            of_topic, until = rows[topic, instance], bisect(times[topic, instance], now)
            has_time = topic not in ("vehicle_status", "vehicle_land_detected", "battery_status")
            if not until or (has_time and of_topic[until - 1].timestamp != now):
                unlogged[topic] += 1
                continue
            compared[topic] += 1
            fields_converted[topic] |= fields.keys() - {"timestamp"}
            for name in fields.keys() - NOT_IN_THE_LOG - {"timestamp"}:
                of_status = topic == "vehicle_global_position" and name not in ("lat", "lon", "alt")
                if of_status and name in ("eph", "epv"):
                    continue  # values from times that are not in the log
                age = STATUS_AGE if of_status else 0.0 if has_time else UNTIMED_AGE
                since = min(until - 1, bisect(times[topic, instance], now - age * 1e6))
                candidates = [getattr(row, name) for row in of_topic[since:until]]
                value = getattr(model, name)
                assert any(is_same(name, value, each) for each in candidates), (
                    topic,
                    now,
                    name,
                    value,
                    candidates,
                )
    assert fields_converted == {topic: set(names.split()) for topic, names in FIELDS.items()}
    # The log lacks some attitudes, and was closed before the last odometry.
    assert unlogged == {"vehicle_attitude": 472, "vehicle_odometry": 1}
    assert compared == {
        "vehicle_attitude": 3279, "vehicle_odometry": 2293, "vehicle_global_position": 1480, "sensor_gps": 387,
        "vehicle_land_detected": 382, "battery_status": 151, "home_position": 77, "vehicle_status": 76,
    }  # fmt: skip


@pytest.mark.slow
def test_gps_time_comes_from_system_time() -> None:
    """SYSTEM_TIME provides the Unix time of GPS messages, which advances with the time since boot."""
    vehicle, parser = Vehicle("1", {"sensor_gps"}), dialect.MAVLink(None)
    origins = []
    for time_ns, datagram in read_datagrams(PX4 / "twelve_messages_mavlink.bin.gz"):
        for message in parser.parse_buffer(datagram) or []:
            converted = vehicle.handle(message, time_ns / 1e9) if message.get_srcSystem() else None
            if isinstance(converted, SourceMessage) and "time_utc_usec" in converted.fields:
                origins.append(
                    int(str(converted.fields["time_utc_usec"]))
                    - int(str(converted.fields["timestamp"]))
                )
    assert len(origins) == 378
    assert max(origins) - min(origins) < 2_000_000  # simulated time drifts from the host's clock


@pytest.mark.slow
@pytest.mark.skipif(
    not STREAMS.exists(), reason=f"no recordings of a PX4's ULog stream in {STREAMS}"
)
def test_statustexts_appear_in_log() -> None:
    """The text of each STATUSTEXT of a flight is a logged string without its module name and trailing tab."""
    vehicle, parser = Vehicle("1", {"log_message"}), new_parser()
    texts = [
        (each.fields["timestamp"], str(each.fields["text"]))
        for when, from_vehicle, frame in datagrams(STREAMS / "ulog_stream_flight1.bin.gz")
        if from_vehicle
        for message in parser.parse_buffer(frame) or []
        if isinstance(each := vehicle.handle(message, when), SourceMessage)
    ]
    log = ULog(str(STREAMS / "ulog_stream_flight1.ulg"))
    logged = {each.message.partition("] ")[2].strip() for each in log.logged_messages}
    assert [text for _, text in texts if text not in logged] == []
    assert [text for _, text in texts][1:4] == [
        "Preflight Fail: no heading reference", "Mission rejected: empty", "Armed by external command"
    ]  # fmt: skip
    assert len(texts) == 10
