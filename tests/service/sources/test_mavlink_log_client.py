"""The state machine that requests PX4's ULog stream, with a fake clock; each case was seen on a real PX4 (SITL)."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.mavlink.log_client import Command, LogStreamClient

START, STOP = dialect.MAV_CMD_LOGGING_START, dialect.MAV_CMD_LOGGING_STOP
OURS = (245, 191)


class Vehicle:
    """The client of one vehicle, what it sent, and each state with its reason."""

    def __init__(self, *log: Any, autopilot: int = dialect.MAV_AUTOPILOT_PX4, armed: bool = False) -> None:
        self.client = LogStreamClient(frozenset(log or ("1",)), system=OURS[0], component=OURS[1])
        self.autopilot, self.armed, self.now = autopilot, armed, 100.0
        self.sent: list[Command] = []
        self.states = [self.client.status[:2]]

    @property
    def kinds(self) -> list[str]:
        return [each.kind for each in self.sent]

    def take(self, commands: list[Command]) -> None:
        self.sent += commands
        if self.client.status[:2] != self.states[-1]:
            self.states.append(self.client.status[:2])

    def live(self, seconds: float, *, heartbeats: bool = True) -> None:
        """Let time pass, with a heartbeat every half second."""
        for step in range(round(seconds * 10)):
            self.now += 0.1
            if heartbeats and step % 5 == 0:
                self.take(self.client.on_heartbeat(self.autopilot, self.now, armed=self.armed))
            self.take(self.client.tick(self.now))

    def answer(self, command: int, result: int) -> None:
        self.take(self.client.on_command_ack(command, result, *OURS, self.now))

    def data(self, sequence: int, *, acked: bool = False, begins: bool = False) -> None:
        assert self.client.accepts(*OURS)
        self.take(self.client.on_data(sequence, self.now, acked=acked, begins=begins))

    def begin(self, *, round_trip: float = 0.004, messages: int = 40) -> None:
        """Start a stream with a header."""
        self.live(0.2)
        self.answer(START, dialect.MAV_RESULT_ACCEPTED)
        for sequence in range(messages):
            self.data(sequence, acked=True, begins=sequence == 0)
            self.now += round_trip
        self.data(messages)


def test_header_is_acknowledged_and_measured() -> None:
    """Each acknowledged message is answered at once, repetitions too, and the time of the header is kept."""
    vehicle = Vehicle()
    vehicle.begin()
    vehicle.data(3, acked=True)
    assert vehicle.kinds == ["start"] + ["acknowledge"] * 41
    assert vehicle.client.status.state == "streaming"
    assert vehicle.client.header_seconds is not None
    assert 0.15 < vehicle.client.header_seconds < 0.2


def test_refusals_are_told_apart() -> None:
    """Every result of START has its own reason, and none is asked again at once."""
    results = {
        dialect.MAV_RESULT_TEMPORARILY_REJECTED: "taken", dialect.MAV_RESULT_DENIED: "bandwidth",
        dialect.MAV_RESULT_UNSUPPORTED: "unsupported", dialect.MAV_RESULT_FAILED: "failed",
    }  # fmt: skip
    for result, reason in results.items():
        vehicle = Vehicle()
        vehicle.live(0.2)
        vehicle.answer(START, result)
        vehicle.live(5)
        assert vehicle.client.status[:2] == ("refused", reason)
        assert vehicle.kinds == ["start"]
        assert vehicle.states[-1] == ("refused", reason)


def test_no_answer_is_named() -> None:
    """A PX4 without a logger does not answer: START is repeated three times."""
    vehicle = Vehicle()
    vehicle.live(10)
    assert vehicle.kinds == ["start"] * 3
    assert vehicle.client.status.reason == "no_answer"


def test_armed_vehicle_is_asked_after_disarming() -> None:
    """An armed vehicle is left alone until it is disarmed, unless log=armed."""
    vehicle = Vehicle(armed=True)
    vehicle.live(3)
    assert (vehicle.sent, vehicle.client.status.state) == ([], "waiting_for_disarm")
    vehicle.armed = False
    vehicle.live(1)
    assert vehicle.kinds[0] == "start"
    bold = Vehicle("armed", armed=True)
    bold.live(1)
    assert bold.kinds == ["start"]


def test_other_autopilot_is_not_asked() -> None:
    """Only PX4 is asked; the reason names the autopilot."""
    vehicle = Vehicle(autopilot=dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
    vehicle.live(5)
    assert not vehicle.sent
    assert "ARDUPILOT" in vehicle.client.status.text


def test_stream_of_another_client_is_taken_on_request_only() -> None:
    """With log=take the other stream is stopped first, once; without it nothing is stopped."""
    vehicle = Vehicle("take")
    vehicle.live(0.2)
    vehicle.answer(START, dialect.MAV_RESULT_TEMPORARILY_REJECTED)
    assert vehicle.kinds == ["start", "stop"]
    vehicle.answer(STOP, dialect.MAV_RESULT_IN_PROGRESS)
    vehicle.answer(STOP, dialect.MAV_RESULT_ACCEPTED)
    vehicle.live(4)
    assert vehicle.kinds[:3] == ["start", "stop", "start"]


def test_accepted_without_data_is_stopped_and_started_again() -> None:
    """START that is accepted without data, as after STOP without waiting, is cured by STOP, a pause and START."""
    vehicle = Vehicle()
    vehicle.live(0.2)
    vehicle.answer(START, dialect.MAV_RESULT_ACCEPTED)
    vehicle.live(1.5)
    assert vehicle.kinds == ["start", "stop"]
    vehicle.answer(STOP, dialect.MAV_RESULT_ACCEPTED)
    vehicle.live(3)
    assert vehicle.kinds == ["start", "stop", "start"]


def test_slow_header_is_aborted() -> None:
    """A round trip that would block the vehicle's logger for too long ends the stream, with the figure."""
    vehicle = Vehicle()
    vehicle.begin(round_trip=0.08)
    assert "stop" in vehicle.kinds
    assert vehicle.client.status.reason == "slow_link"
    assert "80 ms" in vehicle.client.status.text


def test_silent_stream_is_asked_for_and_found_dead_or_slow() -> None:
    """After a silence START is the probe: a rejection means that the stream lives, and data that it is new."""
    vehicle = Vehicle()
    vehicle.begin()
    vehicle.live(1.5)
    assert vehicle.kinds.count("start") == 2
    vehicle.answer(START, dialect.MAV_RESULT_TEMPORARILY_REJECTED)
    assert vehicle.client.status.state == "streaming"
    dead = Vehicle()
    dead.begin()
    dead.live(9)
    assert dead.client.status.state == "ended"


def test_reboot_starts_a_new_stream() -> None:
    """After a reboot the stream is gone, and asked for anew."""
    vehicle = Vehicle()
    vehicle.begin()
    vehicle.client.on_reboot()
    assert vehicle.client.status.state == "idle"
    vehicle.live(0.6)
    assert vehicle.kinds[-1] == "start"


def test_stop_is_repeated_until_it_is_accepted() -> None:
    """STOP is sent again without an answer; data are acknowledged to the end."""
    vehicle = Vehicle()
    vehicle.begin()
    vehicle.take(vehicle.client.stop(vehicle.now))
    vehicle.live(1.2)
    vehicle.data(50, acked=True)
    vehicle.answer(STOP, dialect.MAV_RESULT_ACCEPTED)
    assert vehicle.kinds[-3:] == ["stop", "stop", "acknowledge"]
    assert vehicle.client.status.state == "stopped"


def test_data_for_others_are_not_acknowledged() -> None:
    """Data that were not asked for, or go to other ids, are rejected and counted."""
    vehicle = Vehicle()
    assert not vehicle.client.accepts(*OURS)
    vehicle.live(1)
    assert not vehicle.client.accepts(1, 2)
    assert vehicle.client.rejected == 2
