"""Positions from the bus into a vehicle: a service, a script that publishes, and a PX4 on the link."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Self

import pytest
import zenoh
import zenoh.ext

import nedbus
from nedbus import VehicleOdometry
from nedbus.errors import ConfigError
from nedbus.sources import parse_source
from nedbus.sources.mavlink import position_sender
from nedbus.sources.mavlink.position_sender import (
    BusAccess,
    PositionSender,
    SenderName,
    Target,
    choose_target,
)
from nedbus.sources.options import MavlinkOptions
from nedbus.transport import KeyReader, open_client, open_router
from nedbus_msgs import Address, provenance_of
from tests.peers.live_source import source_status
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Process, Start
from tests.peers.px4_log_stream import STREAMS, Px4LogStream, read_recording
from tests.waits import DEADLINE, wait_for

from .px4_vision import SYNC_ANSWERS, Px4OnLink
from .test_external_position import odometry

ALL = dict.fromkeys(("position", "height", "velocity", "yaw"), "fused")
TOPIC = "vehicle_visual_odometry"
REFUSED = STREAMS.parent / "ev_refused.bin.gz"


class Script:
    """A script that publishes at a rate, on a thread; `change` replaces fields of a position by its number."""

    def __init__(
        self, bus: nedbus.Bus, *, rate: float = 50.0, source: str = "mocap", vehicle: str = "mocap",
        change: Callable[[int], dict[str, Any]] = lambda _: {},
    ) -> None:  # fmt: skip
        self._publisher = bus.publisher(
            VehicleOdometry, topic=TOPIC, vehicle=vehicle, source=source
        )
        self._interval, self._change, self._stop = 1 / rate, change, threading.Event()
        self.sent: dict[int, float] = {}  # time of publication [s], by quality, which numbers them
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._publisher.close()

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(self._interval):
            now = time.monotonic()
            stamp = round(1e6 * now)
            fields = {"timestamp": stamp, "timestamp_sample": stamp - 2000} | self._change(number)
            self.sent[number] = now
            self._publisher.publish(odometry(**fields))
            number += 1


class Setup:
    """A service with `position=`, its bus, and the PX4 on its link."""

    def __init__(self, start: Start, **options: object) -> None:
        self.port, self.endpoint = free_port(), f"tcp/127.0.0.1:{free_port()}"
        query = "&".join(f"{name}={value}" for name, value in options.items())
        self.source = f"mavlink:udpin:127.0.0.1:{self.port}?position=mocap/{TOPIC}&{query}".rstrip(
            "&"
        )
        self._start = start
        self.service = self.serve()

    def serve(self) -> Process:
        return self._start(
            "-m", "nedbus", "serve", "--source", self.source, "--listen", self.endpoint
        )


def left_out(bus: nedbus.Bus) -> dict[str, int]:
    """Return the numbers of positions that the service left out, by kind; {} before its first status."""
    return {
        kind: count for status in source_status(bus).positions for kind, count in status.left_out
    }


@pytest.fixture
def setup(start: Start) -> Setup:
    return Setup(start)


@pytest.fixture
def bus(setup: Setup) -> Iterator[nedbus.Bus]:
    with nedbus.connect(setup.endpoint, timeout=20) as bus:
        yield bus


@pytest.mark.slow
def test_position_of_a_script_is_fused(setup: Setup, bus: nedbus.Bus) -> None:
    """PX4 fuses all quantities of the positions of a script, from component 197 of the vehicle, each counted."""
    with Px4OnLink(setup.port) as px4, Script(bus) as script:
        wait_for(lambda: px4.state() == ALL, what="fusion")
        wait_for(lambda: px4.count() >= 100, what="100 positions")
        wait_for(
            lambda: any(status.sent >= 100 for status in source_status(bus).positions),
            what="status",
        )
    [status] = source_status(bus).positions
    assert (status.vehicle, status.address, status.clock) == ("1", f"mocap/{TOPIC}", "arrival")
    assert status.sender.startswith("mocap (session ")
    assert status.age is not None
    assert 0.002 <= status.age < 0.1
    message = px4.messages[-1][1]
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 197)
    assert px4.timesyncs == 0
    assert all(message.time_usec <= 1e6 * arrived for arrived, message in px4.messages)
    assert px4.count() <= len(script.sent)


@pytest.mark.slow
def test_start_of_the_service_names_what_is_sent(setup: Setup) -> None:
    """The start says in one line which positions are sent, over which link, and whose clock stamps them."""
    line = f"udpin:127.0.0.1:{setup.port}: positions of mocap/{TOPIC} are sent into the vehicle; PX4 stamps them"
    wait_for(lambda: line in setup.service.err, what="the line")
    assert setup.service.err.count("are sent into the vehicle") == 1


@pytest.mark.slow
def test_without_the_option_nothing_is_sent(start: Start) -> None:
    """By default a source only reads: a position on the bus is not sent."""
    setup = Setup.__new__(Setup)
    setup._start, setup.port, setup.endpoint = start, free_port(), f"tcp/127.0.0.1:{free_port()}"
    setup.source = f"mavlink:udpin:127.0.0.1:{setup.port}"
    service = setup.serve()
    with (
        nedbus.connect(setup.endpoint, timeout=20) as bus,
        Px4OnLink(setup.port) as px4,
        Script(bus) as script,
    ):
        wait_for(lambda: source_status(bus).published > 2, what="the vehicle")
        wait_for(lambda: len(script.sent) > 50, what="published positions")
        assert px4.count() == 0
        assert "sent into the vehicle" not in service.err
        assert source_status(bus).positions == ()


@pytest.mark.slow
def test_timesync_is_answered_on_request(start: Start) -> None:
    """With position_clock=timesync PX4 uses time_usec after 500 answers, and fuses the positions as before."""
    setup = Setup(start, position_clock="timesync")
    with (
        nedbus.connect(setup.endpoint, timeout=20) as bus,
        Px4OnLink(setup.port, timesync_rate=400.0) as px4,
        Script(bus),
    ):
        wait_for(lambda: px4.vision.answers >= SYNC_ANSWERS, what="time synchronisation")
        synchronised = px4.count()
        wait_for(lambda: px4.count() >= synchronised + 100, what="positions after it")
        assert px4.state() == ALL
        with px4.lock:
            echoes = [fields for topic, fields in px4.vision.published if topic == TOPIC][-50:]
        ages = [(fields["timestamp"] - fields["timestamp_sample"]) / 1e6 for fields in echoes]
        assert sorted(ages)[len(ages) // 2] == pytest.approx(0.004, abs=0.02)


@pytest.mark.logs
@pytest.mark.slow
@pytest.mark.skipif(not REFUSED.exists(), reason=f"no recording: {REFUSED}")
def test_another_client_that_answers_timesync_is_named(start: Start) -> None:
    """timesync_status in the log stream of a real PX4, whose TIMESYNC a second client answered, causes a warning."""
    setup = Setup(start, log=1)
    recording = read_recording(REFUSED)
    with (
        nedbus.connect(setup.endpoint, timeout=20) as bus,
        Px4LogStream(recording, setup.port, speed=10.0),
    ):

        def warnings() -> list[str]:
            return [text for status in source_status(bus).positions for text in status.warnings]

        wait_for(warnings, what="the warning")
        assert warnings()[0].startswith(
            "another client answers TIMESYNC: if it does so on this link, PX4 stamps"
        )


@pytest.mark.parametrize(("protocol", "is_warned"), [(0, True), (1, True), (2, False)])
def test_timesync_over_dds_is_no_clock_of_the_link(protocol: int, is_warned: bool) -> None:
    """A client that synchronises over DDS does not affect MAVLink; PX4's MAVLink module sets no protocol."""
    options = MavlinkOptions.model_validate({"position": f"mocap/{TOPIC}"})
    access = BusAccess(None, ("tcp/127.0.0.1:1",), None, "nedbus")
    sender = PositionSender("link", options, access, find_target=Target, send=lambda *_: True)
    sender.on_timesync_status({"source_protocol": protocol}, time.monotonic())
    sender.close()
    assert bool(sender.status().warnings) == is_warned


@pytest.mark.slow
def test_wrong_positions_are_counted_and_not_sent(setup: Setup, bus: nedbus.Bus) -> None:
    """Each wrong position is refused with its reason, and the right ones among them are sent."""

    def change(number: int) -> dict[str, Any]:
        return {"pose_frame": 0} if number % 2 else {}

    with Px4OnLink(setup.port) as px4, Script(bus, change=change):
        wait_for(lambda: px4.count() >= 20, what="positions")
        wait_for(lambda: "pose_frame" in left_out(bus), what="refusals")
        assert all(message.frame_id == 1 for _, message in px4.messages)
        [reason] = [
            each for each in source_status(bus).positions[0].reasons if "pose_frame" in each
        ]
        assert reason.startswith("pose_frame is 0: set it to POSE_FRAME_NED")


@pytest.mark.slow
def test_undecodable_position_is_counted_and_not_sent(setup: Setup, bus: nedbus.Bus) -> None:
    """A payload that is no position is left out as invalid, with the reason, and the positions around it are sent."""
    key = Address("mocap", TOPIC).key()
    with (
        open_client([setup.endpoint], timeout=DEADLINE) as session,
        Px4OnLink(setup.port) as px4,
        Script(bus),
    ):
        wait_for(lambda: px4.count() >= 10, what="positions")

        def is_counted() -> bool:
            session.put(key, b"no position")
            return left_out(bus).get("invalid", 0) > 0

        wait_for(is_counted, what="the invalid position")
        [reason] = [text for text in source_status(bus).positions[0].reasons if "decoded" in text]
        assert reason.startswith("the message cannot be decoded: ")
        assert reason.endswith("; use the same version of nedbus")
        before = px4.count()
        wait_for(lambda: px4.count() > before, what="further positions")


@pytest.mark.slow
def test_second_script_is_refused(setup: Setup, bus: nedbus.Bus) -> None:
    """While a script sends, another session with the same address is refused with the name of the first."""
    with (
        nedbus.connect(setup.endpoint) as other,
        Px4OnLink(setup.port) as px4,
        Script(bus, source="first", change=lambda _: {"quality": 1}),
    ):
        wait_for(lambda: px4.count() >= 10, what="the first script")
        with Script(other, source="second", change=lambda _: {"quality": 2}):
            wait_for(lambda: left_out(bus).get("sender", 0) > 5, what="refusals")
            [reason] = [
                each for each in source_status(bus).positions[0].reasons if "second" in each
            ]
            assert "publishes, too, but first (session " in reason
        assert {message.quality for _, message in px4.messages} == {1}


@pytest.mark.slow
def test_end_of_the_script_ends_sending(setup: Setup, bus: nedbus.Bus) -> None:
    """Nothing is sent after the last position of a script, and a new script continues with its own counter."""
    with Px4OnLink(setup.port) as px4:
        with Script(bus) as script:
            wait_for(lambda: px4.count() >= 20, what="positions")
        last = max(script.sent.values())
        wait_for(
            lambda: [each.rate for each in source_status(bus).positions] == [0], what="the end"
        )
        assert px4.messages[-1][0] < last + 0.1
        with Script(bus, change=lambda _: {"reset_counter": 8}):
            count = px4.count()
            wait_for(lambda: px4.count() >= count + 20, what="positions of the next script")
        assert px4.messages[-1][1].reset_counter == 8


@pytest.mark.slow
def test_restart_of_the_service_continues(setup: Setup, bus: nedbus.Bus) -> None:
    """A restarted service sends again, with the reset counter of the script."""
    with Px4OnLink(setup.port) as px4, Script(bus):
        wait_for(lambda: px4.count() >= 20, what="positions")
        setup.service.signal(signal.SIGTERM)
        assert setup.service.wait() == 0
        count = px4.count()
        setup.serve()
        wait_for(lambda: px4.count() >= count + 20, what="positions after the restart")
        assert {message.reset_counter for _, message in px4.messages} == {7}


def test_several_vehicles_on_a_link_get_none() -> None:
    """A position is for one vehicle: with two on the link, or none, nothing is sent, with the reason."""
    assert choose_target([Target(4, "4", "peer")]) == Target(4, "4", "peer")
    assert "no vehicle" in choose_target([]).obstacle
    assert (
        "several vehicles (a, b)" in choose_target([Target(1, "a", 0), Target(2, "b", 0)]).obstacle
    )


@pytest.mark.slow
def test_own_name_of_the_vehicle_is_refused(start: Start) -> None:
    """Under the vehicle's own name, its echo would be sent back."""
    setup = Setup(start, vehicles="1:mocap")
    with (
        nedbus.connect(setup.endpoint, timeout=20) as bus,
        Px4OnLink(setup.port) as px4,
        Script(bus),
    ):
        wait_for(lambda: "address" in left_out(bus), what="the refusal")
        assert px4.count() == 0


@pytest.mark.parametrize(
    "address", ["mocap", "mocap/sensor_gps", "mo cap/vehicle_visual_odometry", "/vehicle_odometry"]
)
def test_address_must_be_one_of_a_position(address: str) -> None:
    """`position=` names a vehicle and a topic with a position."""
    with pytest.raises(ConfigError, match="position="):
        parse_source(f"mavlink:udpin:127.0.0.1:14540?position={address}")


def test_publisher_is_described_only_when_it_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The samples of one publisher name it with one look at their encoding; those of another session name that."""
    looks: list[str] = []

    def count(definition: Any, encoding: str) -> Any:
        looks.append(encoding)
        return provenance_of(definition, encoding)

    monkeypatch.setattr(position_sender, "provenance_of", count)
    names, sender = list[str](), SenderName(TOPIC)
    with open_router(listen=(free_endpoint(),)) as session:
        key = Address("mocap", TOPIC).key()
        reader = KeyReader(session, key)
        misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
        publishers = [
            zenoh.ext.declare_advanced_publisher(session, key, sample_miss_detection=misses)
            for _ in "ab"
        ]
        for publisher in (publishers[0], publishers[0], publishers[0], publishers[1]):
            publisher.put(b"")
            names.append(sender.of(reader.receive()))
        reader.close()
        assert {*names} == {f"a publisher (session {str(session.zid())[:8]})"}
    assert len(looks) == 2
