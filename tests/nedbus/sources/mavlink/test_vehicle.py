"""Requests to one MAVLink vehicle, and its estimates, with a fake clock."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import common as dialect

import nedbus
from nedbus.mavlink.fields import CONVERSIONS
from nedbus.mavlink.parser import new_parser
from nedbus.mavlink.requests import ORIGIN, STREAMS, request_rates
from nedbus.mavlink.sequence import SequenceCounter
from nedbus.mavlink.vehicle import Vehicle
from nedbus.sources import Rejection, SourceMessage
from nedbus.sources.mavlink.log_stream import LogStream
from nedbus.sources.options import MavlinkOptions
from nedbus_msgs import TOPICS, Address
from nedbus_msgs.frames import quaternion_to_euler
from tests.flights.messages import VLP

from .receiving.test_sequence import ORDERS

NEEDED = (32, 230, 33, 141, 331)  # for vehicle_local_position


def new_vehicle(topics: str) -> Vehicle:
    return Vehicle("9", MavlinkOptions.model_validate({"topics": topics}).chosen_topics)


@pytest.fixture
def vehicle() -> Vehicle:
    """Return a vehicle before its first message, to be asked for 30 positions per second over a telemetry radio."""
    return new_vehicle(VLP)


def handle(
    vehicle: Vehicle, message: Any, now: float, log: LogStream | None = None
) -> SourceMessage:
    """Return the message converted by a vehicle, which must not be rejected."""
    converted = vehicle.handle(message, now, log)
    assert isinstance(converted, SourceMessage)
    return converted


def position(ms: int) -> Any:
    return dialect.MAVLink_local_position_ned_message(ms, 0, 0, 0, 0, 0, 0)


def estimate(vehicle: Vehicle, ms: int, now: float) -> dict[str, object]:
    """Return the fields converted from a position at this time since boot [ms]."""
    return dict(handle(vehicle, position(ms), now).fields)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (0b1111111111, True),  # at rest, since 48f1687d3a
        (0b1101111111, True),  # in flight
        (0b1101100101, False),  # GPS lost
        (0b0010100101, False),  # constant position mode up to 1.15: no velocity, no position
        (0b0010111101, False),  # the same, in a release that keeps the position
    ],
)
def test_constant_position_mode_invalidates_only_without_velocity(
    vehicle: Vehicle, flags: int, expected: bool
) -> None:
    """Constant position mode invalidates xy only without valid horizontal velocity; see PX4's commit 48f1687d3a."""
    vehicle.handle(
        dialect.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 1.0, 1.0), 100.0
    )
    assert estimate(vehicle, 1, 100.0)["xy_valid"] is expected


def test_variances_are_the_diagonals_of_covariances() -> None:
    """MAVLink sends the upper triangle of a 6x6 matrix row by row: its diagonal has indices 0, 6, 11, 15, 18 and 20."""
    pose, twist = [float(each) for each in range(21)], [float(100 + each) for each in range(21)]
    vectors = (0, 0, 0, (1, 0, 0, 0), *(0,) * 6)
    message = dialect.MAVLink_odometry_message(1_000_000, 1, 12, *vectors, pose, twist, 0, 8, 100)
    fields = handle(new_vehicle("vehicle_odometry"), message, 100.0).fields
    assert fields["position_variance"] == (0.0, 6.0, 11.0)
    assert fields["orientation_variance"] == (15.0, 18.0, 20.0)
    assert fields["velocity_variance"] == (100.0, 106.0, 111.0)


@pytest.mark.parametrize(
    ("time_usec", "timestamp"),
    [
        (0, 7_000_000),
        (6_500_000, 6_500_000),
        (1_700_000_000_000_000, 7_000_000),
        (2**64 - 1, 7_000_000),
    ],
)
def test_unusable_message_time_is_replaced(time_usec: int, timestamp: int) -> None:
    """A timestamp that is Unix time, unknown or invalid is replaced by the newest time since boot."""
    vehicle = new_vehicle(f"{VLP},sensor_gps")
    estimate(vehicle, 7000, 100.0)
    gps = dialect.MAVLink_gps_raw_int_message(
        time_usec, 3, 10, 20, 30, 65535, 150, 65535, 9000, 255
    )
    assert handle(vehicle, gps, 100.0).fields["timestamp"] == timestamp


@pytest.mark.parametrize(
    ("rate", "baud", "status", "odometry"),
    [
        (30.0, 57600, 13.04, 10.0),
        (20.0, 57600, 20.0, 10.0),
        (45.0, 57600, 8.86, 8.86),
        (50.0, 115200, 50.0, 10.0),
        (0.5, 57600, 2.0, 10.0),
        (200.0, None, 200.0, 10.0),
    ],
)
def test_estimator_status_rate_fits_link(
    rate: float, baud: int | None, status: float, odometry: float
) -> None:
    """ESTIMATOR_STATUS is requested with each position, or as often as the remaining bandwidth of a port allows."""
    rates = request_rates(rate, baud, [VLP])
    assert [*rates] == [*NEEDED]
    assert rates[32] == rate
    assert rates[331] == pytest.approx(odometry, abs=0.01)
    assert rates[230] == pytest.approx(status, abs=0.01)


@pytest.mark.parametrize(
    "topics", [[*TOPICS], ["vehicle_attitude"], ["sensor_gps", "home_position"], [VLP], ["x"]]
)
@pytest.mark.parametrize("rate", [0.5, 30.0, 100.0])
def test_only_needed_messages_are_requested_within_bandwidth(
    topics: list[str], rate: float
) -> None:
    """Only messages of chosen topics are requested, each at its own rate, or at that of the option if it has none.

    If the link cannot carry them, all but the position are reduced, to 2 Hz at the least, until 90 % of it are used.
    """
    rates = request_rates(rate, 57600, topics)
    own = {number: hertz or rate for number, (_, hertz, of) in STREAMS.items() if of & {*topics}}
    if 230 in own:
        own[230] = max(2.0, rate)  # ESTIMATOR_STATUS, which has the flags
    least = {number: hertz if number == 32 else min(2.0, hertz) for number, hertz in own.items()}
    assert [*rates] == [*own]
    assert all(least[number] <= hertz <= own[number] for number, hertz in rates.items())
    used, wanted, minimal = (
        sum(STREAMS[number][0] * hertz for number, hertz in each.items())
        for each in (rates, own, least)
    )
    assert used == pytest.approx(min(wanted, max(0.9 * 57600 / 10, minimal)))


def test_every_converted_topic_has_a_requested_message() -> None:
    """Each topic of CONVERSIONS is needed by a row of STREAMS, under the same name."""
    needed = {topic for stream in STREAMS.values() for topic in stream.topics}
    assert needed == {topic for topic, _ in CONVERSIONS.values()} <= TOPICS.keys()


def test_attitude_replaces_missing_attitude_quaternion() -> None:
    """ATTITUDE is converted only while the vehicle sends no ATTITUDE_QUATERNION."""
    vehicle = new_vehicle("vehicle_attitude")
    converted = handle(
        vehicle, dialect.MAVLink_attitude_message(1000, 0.1, -0.2, 3.0, 0, 0, 0), 100.0
    )
    assert quaternion_to_euler(cast("tuple[float, ...]", converted.fields["q"])) == pytest.approx(
        (0.1, -0.2, 3.0)
    )
    assert vehicle.handle(
        dialect.MAVLink_attitude_quaternion_message(1010, 1, 0, 0, 0, 0, 0, 0), 100.1
    )
    assert vehicle.handle(dialect.MAVLink_attitude_message(1020, 0, 0, 0, 0, 0, 0), 100.2) is None
    assert vehicle.handle(dialect.MAVLink_attitude_message(4000, 0, 0, 0, 0, 0, 0), 103.0)


def test_order_is_checked_per_topic() -> None:
    """Only a message older than the last one of the same topic is out of order; the same one again is a copy."""
    vehicle = new_vehicle("*")
    odometry = [1, 1, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [math.nan] * 21, [math.nan] * 21]
    assert estimate(vehicle, 2000, 100.0)
    assert vehicle.handle(dialect.MAVLink_odometry_message(1_900_000, *odometry), 100.0)
    late = vehicle.handle(dialect.MAVLink_odometry_message(1_800_000, *odometry), 100.0)
    assert isinstance(late, Rejection)
    assert (late.where, late.reason) == (
        "9/vehicle_odometry",
        "out of order (1800 ms since boot, after 1900 ms)",
    )
    assert vehicle.handle(position(2000), 100.0) is None
    assert vehicle.copies == 1
    assert estimate(vehicle, 2050, 100.1)["timestamp"] == 2_050_000


def heartbeat() -> Any:
    return dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_PX4, 0, 0, 4, 3)


def test_second_link_adds_nothing() -> None:
    """A second link is 0.3 s late, with messages at other times: they, and its old heartbeats, are left out.

    A message that is older than the last one of the same link is out of order, also then.
    """
    vehicle = new_vehicle("*")
    for number in range(60):
        now, ms = 100 + 0.05 * number, 10_000 + 50 * number
        vehicle.count_lost(0, now, link=0)
        assert isinstance(vehicle.handle(position(ms), now), SourceMessage)
        vehicle.count_lost(0, now, link=1)
        assert vehicle.handle(position(ms - 320), now) is None
        assert vehicle.handle(heartbeat(), now) is None
    assert vehicle.copies == 120
    vehicle.count_lost(0, 103.0, link=0)
    assert isinstance(vehicle.handle(position(12_901), 103.0), Rejection)
    vehicle.count_lost(0, 103.0, link=0)
    assert isinstance(vehicle.handle(heartbeat(), 103.0), SourceMessage)


def test_second_link_replaces_the_first_one() -> None:
    """After the first link broke, the messages of the second one are used, also those without a time."""
    vehicle = new_vehicle("*")
    for number in range(20):
        vehicle.count_lost(0, 100 + 0.05 * number, link=0)
        vehicle.handle(position(10_000 + 50 * number), 100 + 0.05 * number)
    vehicle.count_lost(0, 102.0, link=1)
    assert isinstance(vehicle.handle(position(11_700), 102.0), SourceMessage)
    assert isinstance(vehicle.handle(heartbeat(), 102.0), SourceMessage)


def gps(time_usec: int, fix_type: int) -> Any:
    unknown = 2**16 - 1
    return dialect.MAVLink_gps_raw_int_message(
        time_usec, fix_type, 483861418, -1246305732, 0, 160, unknown, unknown, unknown, 9
    )


def test_gps_without_a_fix_is_no_copy() -> None:
    """ArduPilot repeats the time of the last fix while it has none: each message is published, at the newest time.

    As in a log of ArduSub 4.1.1, whose GPS lost its fix for 2.7 s at 768.005 s, with messages every half second. A fix
    that comes just after such a message has its own time, or that of the message if it was taken before.
    """
    vehicle = new_vehicle("*")
    received = []
    for ms, fix_ms, fix_type in (
        (768_200, 768_005, 3),
        (768_665, 768_005, 0),
        (769_205, 768_005, 0),
        (769_705, 768_005, 0),
        (770_205, 770_190, 3),
        (770_300, 770_190, 3),
        (770_350, 770_290, 3),
    ):
        vehicle.count_lost(0, ms / 1000)
        vehicle.handle(position(ms), ms / 1000)
        fields = handle(vehicle, gps(1000 * fix_ms, fix_type), ms / 1000).fields
        received.append((fields["timestamp"], fields["fix_type"]))
    assert received == [
        (768_005_000, 3),
        (768_665_000, 0),
        (769_205_000, 0),
        (769_705_000, 0),
        (770_190_000, 3),
        (770_300_000, 3),
        (770_300_000, 3),
    ]
    assert vehicle.copies == 0


def test_gps_of_a_second_link_is_a_copy_also_without_a_fix() -> None:
    """Each message of a GPS that repeats its time is published once, although it comes over two links."""
    vehicle = new_vehicle("*")
    published = 0
    for number, fix_type in enumerate((3, 0, 0)):
        ms = 10_000 + 500 * number
        for link, now in enumerate((100 + 0.5 * number, 100.2 + 0.5 * number)):
            vehicle.count_lost(0, now, link=link)
            vehicle.handle(position(ms), now)
            converted = vehicle.handle(gps(9_900_000, fix_type), now)
            published += isinstance(converted, SourceMessage)
    assert published == 3
    assert vehicle.copies == 3 + 3


@pytest.mark.parametrize(
    ("autopilot", "source"),
    [(dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, "mavlink-ardupilot"), (None, None)],
)
def test_texts_wait_for_the_first_heartbeat(autopilot: int | None, source: str | None) -> None:
    """Texts from before the first HEARTBEAT have the source that it names; without one they are published after 1.5 s.

    A log of ArduSub 4.1.1 begins with four texts, half a second before the first HEARTBEAT.
    """
    vehicle, texts = new_vehicle("*"), []
    text = "ArduSub V4.1.1"
    messages: list[tuple[float, Any]] = [
        (100.0, position(10_000)),
        (100.1, chunk(text.encode(), 0)),
        (101.6, dialect.MAVLink_scaled_pressure_message(11_600, 0, 0, 0)),
    ]
    if autopilot is not None:
        messages.insert(2, (100.6, dialect.MAVLink_heartbeat_message(12, autopilot, 0, 0, 4, 3)))
        messages.insert(3, (100.7, dialect.MAVLink_scaled_pressure_message(10_700, 0, 0, 0)))
    for now, message in messages:
        vehicle.count_lost(0, now)
        for each in vehicle.handle_all(message, now):
            if isinstance(each, SourceMessage) and each.address.topic == "log_message":
                texts.append((now, each.fields["text"], each.source))
    published = 101.6 if autopilot is None else 100.7
    assert texts == [(published, text, source)]


def numbered_texts(
    packets: Iterable[tuple[float, int, int]], *, offset: int = 0
) -> tuple[Counter[object], int]:
    """Return how often each text is published, and the number of copies, of packets that arrive over two links.

    Each packet has its time of arrival, its number and its link. Each tenth one is a text that names its number, the
    others are positions; the second link numbers its packets from `offset`.
    """
    vehicle, counter, texts = new_vehicle("*"), SequenceCounter(), Counter[object]()
    vehicle.count_lost(0, 99.9)
    vehicle.handle_all(heartbeat(), 99.9)
    for now, number, link in packets:
        lost = counter.add((number + offset * link) % 256, now)
        vehicle.count_lost(lost, now, link=counter.link)
        message = position(10_000 + 10 * number)
        if number % 10 == 5:
            message = chunk(b"text %d" % number, 0)
        for each in vehicle.handle_all(message, now):
            if isinstance(each, SourceMessage) and each.address.topic == "log_message":
                texts[each.fields["text"]] += 1
    return texts, vehicle.copies


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_texts_of_a_link_with_overtaken_packets_are_published(order: list[int]) -> None:
    """No text is left out as a copy because packets of its link overtook others."""
    texts, copies = numbered_texts(
        (100 + place / 100, number, 0) for place, number in enumerate(order)
    )
    assert len(texts) == 60
    assert set(texts.values()) == {1}
    assert copies == 0


@pytest.mark.parametrize("offset", [0, 5, 60, 250])
@pytest.mark.parametrize("late", [0.001, 0.3, 1.0])
def test_texts_of_two_links_are_published_once(late: float, offset: int) -> None:
    """A text that comes over two links, one of them late, is published once; one that a link lost, by the other one.

    Where the second link begins, its packets may be those of the first one in another order.
    """
    packets = []
    for number in range(1500):
        now = 100 + number / 100
        if number % 30 != 5:
            packets.append((now, number, 0))
        if number % 30 != 15 and number > 200:
            packets.append((now + late, number, 1))
    texts, copies = numbered_texts(sorted(packets), offset=offset)
    between = [texts[f"text {number}"] for number in range(245, 1400, 10)]
    assert between == [1] * 116
    assert copies > 1000


def test_repeated_text_of_two_links_is_published_as_often_as_it_was_sent() -> None:
    """A vehicle that sends a text twice within a second sends it twice over each link: it is published twice."""
    vehicle, published = new_vehicle("*"), 0
    vehicle.count_lost(0, 99.9)
    vehicle.handle_all(heartbeat(), 99.9)
    for now, link in ((100.0, 0), (100.3, 1), (100.5, 0), (100.8, 1)):
        vehicle.count_lost(0, now, link=link)
        vehicle.handle(position(round(1000 * now - 90_000 - 300 * link)), now)
        published += isinstance(vehicle.handle(chunk(b"Preflight Fail", 0), now), SourceMessage)
    assert published == 2
    assert vehicle.copies == 2 + 2


def requests_of(vehicle: Vehicle, seconds: range) -> list[tuple[int, float]]:
    """Return the requests to a vehicle that sends a message every half second."""
    requests = []
    for second in seconds:
        for now in (second, second + 0.5):
            vehicle.count_lost(0, now)
            requests.append(vehicle.next_request(now))
    return [each for each in requests if each]


def test_unanswered_requests_are_repeated(
    vehicle: Vehicle, caplog: pytest.LogCaptureFixture
) -> None:
    """Each message is requested three times, then every few seconds; each one except the origin is logged once."""
    caplog.set_level("INFO")
    requested = [number for number, _ in requests_of(vehicle, range(100, 200))]
    assert requested[:12] == [*NEEDED, ORIGIN] * 2
    for number in (*NEEDED, ORIGIN):
        assert 10 < requested.count(number) < 30
    assert caplog.text.count("does not send") == len(NEEDED)
    assert "vehicle 9 does not send ODOMETRY on request" in caplog.text


def test_arriving_messages_are_requested_three_times(vehicle: Vehicle) -> None:
    """Links lose requests, so there are three rounds; afterwards only missing messages are requested."""
    origin = dialect.MAVLink_gps_global_origin_message(1, 2, 3, 4)
    assert vehicle.next_request(99.0) is None  # no message received yet
    requested = []
    for second in range(100, 130):
        requested += requests_of(vehicle, range(second, second + 1))
        estimate(vehicle, 1000 * second, second)
        if second == 101:
            assert vehicle.handle(origin, second) is None
    assert requested[0] == (32, 30.0)
    counts = Counter(number for number, _ in requested)
    assert counts[32] == counts[ORIGIN] == 3
    assert counts[331] > 3


def fake_log(*streamed: str) -> LogStream:
    """Return a ULog stream that delivers these topics."""
    log: Any = SimpleNamespace(is_streaming=True)
    log.delivers = lambda address: log.is_streaming and address.topic in streamed
    return cast("LogStream", log)


def test_losses_during_stream_are_reported_once() -> None:
    """Losses of streamed topics are reported with the next message; those of the stream only by the stream."""
    vehicle, log = new_vehicle(f"{VLP},vehicle_attitude"), fake_log(VLP)
    streamed = SourceMessage(0.0, Address("9", VLP), {}, lost=3)

    def attitude(ms: int) -> SourceMessage:
        converted = vehicle.handle(
            dialect.MAVLink_attitude_quaternion_message(ms, 1, 0, 0, 0, 0, 0, 0), 100.0, log
        )
        assert isinstance(converted, SourceMessage)
        return converted

    for number in range(10):
        vehicle.count_lost(1 if number else 0, 100.0)
        assert vehicle.handle(position(1000 + number), 100.0, log) is None
    assert attitude(1100).lost == 0, "may be data of the stream"
    assert vehicle.report(streamed, log).lost == 3
    vehicle.count_lost(0, 100.0, counted=2)
    assert vehicle.report(streamed, log).lost == 3 + 9 - 2
    assert vehicle.report(streamed, log).lost == 3
    vehicle.count_lost(4, 100.0)
    cast("Any", log).is_streaming = False
    assert attitude(1200).lost == 4
    assert handle(vehicle, position(1300), 100.0).lost == 0


def test_streamed_texts_are_not_converted() -> None:
    """A STATUSTEXT is neither converted nor limited while the ULog stream delivers the log messages."""
    vehicle, log = new_vehicle("log_message"), fake_log("log_message")
    assert vehicle.handle(position(1000), 0.0) is None
    assert not any(vehicle.handle(chunk(b"text", 0), 50.0, log) for _ in range(200))
    cast("Any", log).is_streaming = False
    assert handle(vehicle, chunk(b"converted", 0), 50.0, log).fields["text"] == "converted"


def test_stopped_positions_are_requested_again(vehicle: Vehicle) -> None:
    """If positions stop while other messages arrive, positions are requested again."""
    requested = []
    for second in range(100, 140):
        if second < 120:
            estimate(vehicle, 1000 * second, second)
        requested += [
            (second, number) for number, _ in requests_of(vehicle, range(second, second + 1))
        ]
    assert [second // 10 for second, number in requested if number == 32][3:] == [12, 12, 13, 13]


def test_expired_values_are_not_provided(vehicle: Vehicle) -> None:
    """A heading that is not repeated expires after 2 s; an origin is kept until a reboot."""
    vehicle.handle(dialect.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 9000), 100.0)
    vehicle.handle(dialect.MAVLink_gps_global_origin_message(473977418, 85455939, 488000), 100.0)
    assert estimate(vehicle, 1000, 101.0)["heading"] == pytest.approx(math.pi / 2)
    later = estimate(vehicle, 4000, 104.0)
    assert "heading" not in later
    assert later["ref_lat"] == 47.3977418
    assert "ref_timestamp" not in later
    for ms in (4000, 490):
        vehicle.handle(
            dialect.MAVLink_global_position_int_message(ms, 0, 0, 0, 0, 0, 0, 0, 65535), 105.0
        )
    back = handle(vehicle, position(500), 105.0)
    assert ("ref_lat" in back.fields, back.rebooted) == (False, True)
    assert isinstance(vehicle.handle(position(499), 105.0), Rejection)


def test_heading_that_becomes_unknown_is_not_provided(vehicle: Vehicle) -> None:
    """An unknown heading or yaw ends the earlier one at once; mavkit 0.3.0 keeps it (findings)."""
    vehicle.handle(dialect.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 9000), 100.0)
    vehicle.handle(dialect.MAVLink_attitude_message(0, 0, 0, 1.25, 0, 0, 0), 100.0)
    assert estimate(vehicle, 1, 100.0)["heading"] == pytest.approx(math.pi / 2)
    vehicle.handle(
        dialect.MAVLink_global_position_int_message(2, 0, 0, 0, 0, 0, 0, 0, 65535), 100.1
    )
    assert estimate(vehicle, 3, 100.1)["heading"] == pytest.approx(1.25)
    vehicle.handle(dialect.MAVLink_attitude_message(4, 0, 0, math.nan, 0, 0, 0), 100.2)
    assert "heading" not in estimate(vehicle, 5, 100.2)


def test_attitude_yaw_replaces_unknown_heading(vehicle: Vehicle) -> None:
    """If the heading in GLOBAL_POSITION_INT is unknown (65535), the heading is the yaw of ATTITUDE."""
    vehicle.handle(dialect.MAVLink_attitude_message(0, 0, 0, 1.25, 0, 0, 0), 100.0)
    vehicle.handle(
        dialect.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 65535), 100.0
    )
    assert estimate(vehicle, 1, 100.0)["heading"] == pytest.approx(1.25)


NAN, U16 = math.nan, 2**16 - 1
# messages with the values that mean unknown in MAVLink's common.xml, and the fields that are known
UNKNOWN = {
    "gps": (
        dialect.MAVLink_gps_raw_int_message(
            10**6, 3, 1, 1, 1, U16, U16, U16, U16, 255, 0, 0, 0, 0, 0, U16
        ),
        {"fix_type", "latitude_deg", "longitude_deg", "altitude_msl_m"},
    ),
    "silent receiver": (
        dialect.MAVLink_gps_raw_int_message(10**6, 0, 0, 0, 0, U16, U16, U16, U16, 255),
        {"fix_type"},
    ),
    "battery": (
        dialect.MAVLink_battery_status_message(
            0, 0, 0, 2**15 - 1, [U16] * 10, -1, -1, -1, -1, 0, 0, [0] * 4
        ),
        set[str](),
    ),
    "further cells": (
        dialect.MAVLink_battery_status_message(
            0, 0, 0, 2**15 - 1, [16_000] + [U16] * 9, -1, -1, -1, -1, 0, 0, [U16] * 4
        ),
        {"voltage_v"},
    ),
    "home": (
        dialect.MAVLink_home_position_message(1, 1, 1, NAN, NAN, NAN, [NAN] * 4, NAN, NAN, NAN),
        {"lat", "lon", "alt", "valid_hpos", "valid_alt"},
    ),
    "home without attitude": (
        dialect.MAVLink_home_position_message(1, 1, 1, 1, 2, 3, [0] * 4, 0, 0, 0),
        {"lat", "lon", "alt", "x", "y", "z", "valid_hpos", "valid_alt"},
    ),
    "home at 0, 0": (
        dialect.MAVLink_home_position_message(0, 0, 0, 0, 0, 0, [0] * 4, 0, 0, 0),
        set[str](),
    ),
    "attitude": (
        dialect.MAVLink_attitude_quaternion_message(1000, 0, 0, 0, 0, 0, 0, 0),
        set[str](),
    ),
    "odometry without attitude": (
        dialect.MAVLink_odometry_message(
            0, 1, 1, 1, 2, 3, [0] * 4, *[0] * 6, [0] * 21, [0] * 21, 0, 8, 100
        ),
        {
            "pose_frame",
            "position",
            "velocity_frame",
            "velocity",
            "angular_velocity",
            "reset_counter",
            "quality",
        },
    ),
    "global position": (
        dialect.MAVLink_global_position_int_message(1000, 0, 0, 0, 0, 0, 0, 0, 0),
        set[str](),
    ),
    "landed": (dialect.MAVLink_extended_sys_state_message(0, 0), set[str]()),
    "status": (
        dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 0, 3),
        {"arming_state", "hil_state", "system_type", "system_id", "component_id"},
    ),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_unknown_values_are_not_provided(name: str) -> None:
    """Fields with values that MAVLink defines as unknown are left out."""
    message, known = UNKNOWN[name]
    vehicle = new_vehicle("*")
    vehicle.handle(position(1000), 100.0)
    converted = vehicle.handle(message, 100.0)
    assert converted is None or isinstance(converted, SourceMessage)
    assert {*(converted.fields if converted else ())} - {"timestamp"} == known
    if name == "further cells":
        assert converted is not None
        assert converted.fields["voltage_v"] == 16.0


def high_latency(ms: int, *, autopilot: int = dialect.MAV_AUTOPILOT_PX4, **fields: int) -> Any:
    """Return a HIGH_LATENCY2 as its receiver decodes it."""
    values = {
        "timestamp": ms, "type": 2, "autopilot": autopilot, "custom_mode": 12, "latitude": 473_977_000,
        "longitude": 85_456_000, "altitude": 500, "target_altitude": 510, "heading": 90, "target_heading": 90,
        "target_distance": 100, "throttle": 50, "airspeed": 30, "airspeed_sp": 30, "groundspeed": 28, "windspeed": 5,
        "wind_heading": 10, "eph": 12, "epv": 255, "temperature_air": 20, "climb_rate": 3, "battery": 77, "wp_num": 1,
        "failure_flags": 0, "custom0": -128, "custom1": 0, "custom2": 0, **fields,
    }  # fmt: skip
    frame = dialect.MAVLink_high_latency2_message(**values).pack(dialect.MAVLink(None, 9, 1))
    [message] = new_parser().parse_buffer(frame)
    return message


def converted_high_latency(message: Any) -> dict[str, dict[str, object]]:
    items = new_vehicle("*").handle_all(message, 100.0)
    return {
        item.address.stream: dict(item.fields) for item in items if isinstance(item, SourceMessage)
    }


def test_high_latency_message_has_position_status_and_battery() -> None:
    """HIGH_LATENCY2 contains three topics; unknown values are left out, and only ArduPilot sends if it is armed."""
    status = {"timestamp": 5_000_000, "system_type": 2, "system_id": 9, "component_id": 1}
    assert converted_high_latency(high_latency(5000)) == {
        "vehicle_global_position": {
            "timestamp": 5_000_000, "lat": 47.3977, "lon": 8.5456, "alt": 500.0, "eph": 1.2, "lat_lon_valid": True,
            "alt_valid": True,
        },
        "vehicle_status": status,
        "battery_status/0": {"timestamp": 5_000_000, "remaining": 0.77},
    }  # fmt: skip
    ardupilot = high_latency(5000, autopilot=3, battery=-1, latitude=0, longitude=0)
    assert converted_high_latency(ardupilot) == {"vehicle_status": {**status, "arming_state": 2}}
    failed = high_latency(5000, failure_flags=dialect.HL_FAILURE_FLAG_ESTIMATOR)
    assert converted_high_latency(failed)["vehicle_global_position"]["lat_lon_valid"] is False


def test_nothing_is_requested_over_a_satellite_link() -> None:
    """A vehicle that sends only HIGH_LATENCY2 is on a satellite link; with a HEARTBEAT within 10 s it is not."""
    vehicle = new_vehicle("*")
    vehicle.count_lost(0, 100.0)
    vehicle.handle_all(high_latency(5000), 100.0)
    assert vehicle.is_high_latency
    assert vehicle.next_request(100.1) is None
    vehicle.handle_all(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3), 101.0)
    assert not vehicle.is_high_latency
    assert vehicle.next_request(101.1) is not None
    vehicle.handle_all(high_latency(8000), 103.0)
    assert not vehicle.is_high_latency


def test_zeros_of_other_messages_are_unknown(vehicle: Vehicle) -> None:
    """An origin at 0, 0 and accuracies of 0 are no values, so the estimate has neither."""
    vehicle.handle(dialect.MAVLink_gps_global_origin_message(0, 0, 0), 100.0)
    vehicle.handle(dialect.MAVLink_estimator_status_message(0, 0x3F, *[0] * 8), 100.0)
    odometry = dialect.MAVLink_odometry_message(
        0, 1, 1, 1, 2, 3, [1, 0, 0, 0], *[0] * 6, [0] * 21, [0] * 21
    )
    vehicle.handle(odometry, 100.0)
    assert (
        estimate(vehicle, 1000, 100.0)
        .keys()
        .isdisjoint({"ref_lat", "xy_global", "eph", "epv", "evh", "evv"})
    )


@pytest.mark.parametrize(
    ("state", "vehicle_type", "is_in_transition", "is_to_fixed_wing"),
    [
        (dialect.MAV_VTOL_STATE_MC, nedbus.VehicleStatus.VEHICLE_TYPE_ROTARY_WING, False, False),
        (
            dialect.MAV_VTOL_STATE_TRANSITION_TO_FW,
            nedbus.VehicleStatus.VEHICLE_TYPE_ROTARY_WING,
            True,
            True,
        ),
        (dialect.MAV_VTOL_STATE_FW, nedbus.VehicleStatus.VEHICLE_TYPE_FIXED_WING, False, False),
        (
            dialect.MAV_VTOL_STATE_TRANSITION_TO_MC,
            nedbus.VehicleStatus.VEHICLE_TYPE_ROTARY_WING,
            True,
            False,
        ),
    ],
)
def test_status_of_a_vtol_has_its_transition(
    state: int, vehicle_type: int, is_in_transition: bool, is_to_fixed_wing: bool
) -> None:
    """EXTENDED_SYS_STATE adds type and transition to the status, for as long as it arrives; an undefined state none."""
    vehicle, heartbeat = new_vehicle("*"), dialect.MAVLink_heartbeat_message(22, 12, 128, 0, 4, 3)
    vehicle.handle(position(1000), 100.0)
    vehicle.handle(dialect.MAVLink_extended_sys_state_message(state, 0), 100.0)
    fields = handle(vehicle, heartbeat, 101.0).fields
    assert (fields["is_vtol"], fields["vehicle_type"]) == (True, vehicle_type)
    assert (fields["in_transition_mode"], fields["in_transition_to_fw"]) == (
        is_in_transition,
        is_to_fixed_wing,
    )
    assert "is_vtol" not in handle(vehicle, heartbeat, 110.0).fields
    vehicle.handle(
        dialect.MAVLink_extended_sys_state_message(dialect.MAV_VTOL_STATE_UNDEFINED, 1), 111.0
    )
    assert "is_vtol" not in handle(vehicle, heartbeat, 111.0).fields


@pytest.mark.parametrize(
    ("kind", "is_vtol"),
    [
        (dialect.MAV_TYPE_QUADROTOR, False),
        (dialect.MAV_TYPE_HEXAROTOR, False),
        (dialect.MAV_TYPE_FIXED_WING, True),
    ],
)
def test_multicopter_is_no_vtol(kind: int, is_vtol: bool) -> None:
    """ArduCopter 4.5.7 sends the VTOL state of a multicopter, as in a .tlog of its SITL; a fixed wing can be a VTOL."""
    vehicle = new_vehicle("*")
    vehicle.handle(position(1000), 100.0)
    vehicle.handle(dialect.MAVLink_extended_sys_state_message(dialect.MAV_VTOL_STATE_MC, 2), 100.0)
    heartbeat = dialect.MAVLink_heartbeat_message(
        kind, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, 128, 0, 4, 3
    )
    assert ("is_vtol" in handle(vehicle, heartbeat, 101.0).fields) == is_vtol


@pytest.mark.parametrize(("silence", "is_known"), [(2.9, True), (3.1, False)])
def test_silence_discards_the_state(vehicle: Vehicle, silence: float, is_known: bool) -> None:
    """After 3 s without a message all is requested again, and the origin of before is unknown."""
    vehicle.count_lost(0, 100.0)
    vehicle.handle(dialect.MAVLink_gps_global_origin_message(1, 2, 3, 4), 100.0)
    first = [vehicle.next_request(100.0) for _ in range(3 * len([*NEEDED, ORIGIN]))]
    assert vehicle.next_request(100.0) is None
    vehicle.count_lost(0, 100.0 + silence)
    fields = estimate(vehicle, 1000, 100.0 + silence)
    assert ("ref_lat" in fields) == is_known
    assert vehicle.next_request(100.0 + silence) == (None if is_known else first[0])


def test_origin_beyond_the_antimeridian_is_kept(vehicle: Vehicle) -> None:
    """PX4 up to 1.15 sends an origin east of 180 degrees."""
    vehicle.handle(dialect.MAVLink_gps_global_origin_message(-170_000_000, 1_800_000_100, 0), 100.0)
    assert estimate(vehicle, 1000, 100.0)["ref_lon"] == 180.00001


@pytest.mark.parametrize(
    ("clearance", "is_valid"), [(-1.0, False), (NAN, False), (0.0, True), (2.5, True)]
)
def test_unmeasured_clearance_is_invalid(
    vehicle: Vehicle, clearance: float, is_valid: bool
) -> None:
    """A bottom_clearance that is negative or NaN means no measurement: dist_bottom is invalid, and left out."""
    vehicle.handle(dialect.MAVLink_altitude_message(10**6, 1, 2, 3, 4, NAN, clearance), 100.0)
    fields = estimate(vehicle, 1000, 100.0)
    assert (fields["dist_bottom_valid"], "dist_bottom" in fields) == (is_valid, is_valid)


def chunk(text: bytes, number: int, sequence: int = 0, severity: int = 4) -> Any:
    return dialect.MAVLink_statustext_message(severity, text, number, sequence)


def texts_of(messages: list[tuple[float, Any]]) -> list[tuple[object, ...]]:
    """Return timestamp, severity and text of the log messages of a vehicle that sends messages at these times."""
    vehicle, later = (
        new_vehicle("log_message"),
        [(99.0, dialect.MAVLink_timesync_message(0, 0))] * 3,
    )
    found = [
        vehicle.handle(message, now) for now, message in [(0.0, position(1000)), *messages, *later]
    ]
    converted = [each for each in found if isinstance(each, SourceMessage)]
    assert {each.address.stream for each in converted} == {"log_message"}
    return [tuple(each.fields.values()) for each in converted]


def test_statustext_chunks_are_joined() -> None:
    """Chunks are joined in order, by id; missing chunks leave "...", and control characters are removed."""
    first, second = b"a" * 49 + b"\xc2", b"\xb5" + b"b" * 49
    assert texts_of([(0.0, chunk(b"Takeoff\x1b[31m detected\t", 0))]) == [
        (1_000_000, 4, "Takeoff detected")
    ]
    whole = [(0.0, chunk(first, 1)), (0.1, chunk(second, 1, 1)), (0.2, chunk(b"end", 1, 2))]
    assert texts_of(whole) == [(1_000_000, 4, f"{'a' * 49}\u00b5{'b' * 49}end")]
    [(_, _, gap)] = texts_of([whole[0], whole[2]])
    assert str(gap).endswith("...end")
    assert texts_of([whole[1], (0.3, chunk(b"next", 2, 0, 9))]) == [
        (1_000_000, 4, f"...?{'b' * 49}..."), (1_000_000, 7, "next")
    ]  # fmt: skip
    assert [text for *_, text in texts_of([(0.0, chunk(b"c" * 50, 3))])] == ["c" * 50 + "..."]


@pytest.mark.slow
def test_flood_of_statustexts_is_limited() -> None:
    """If 10,000 texts arrive within a second, 100 are published and the rest are rejected."""
    vehicle = new_vehicle("log_message")
    vehicle.handle(position(1000), 0.0)
    found = [vehicle.handle(chunk(b"flood", 0), 50.0 + number / 11_000) for number in range(10_000)]
    assert sum(isinstance(each, SourceMessage) for each in found) == 100
    assert sum(isinstance(each, Rejection) for each in found) == 9_900
