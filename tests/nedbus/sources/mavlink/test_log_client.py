"""The client of PX4's ULog stream with a fake clock: each case was seen on a real PX4 (SITL, main of 2026-05-14)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, Final, Literal

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.mavlink.log_client import Command, LogReason, LogState, LogStreamClient
from nedbus.timings import TIMINGS
from tests.peers.px4_log_stream import START, STOP, STREAMS, datagrams

from .counted import CountedReassembly

OURS: Final = (245, 191)
OTHERS: Final = (246, 190)
PX4: Final = dialect.MAV_AUTOPILOT_PX4
ACCEPTED: Final = dialect.MAV_RESULT_ACCEPTED
TAKEN: Final = dialect.MAV_RESULT_TEMPORARILY_REJECTED
IN_PROGRESS: Final = dialect.MAV_RESULT_IN_PROGRESS

Log = Literal["1", "armed", "take"]
Reason = tuple[LogState, LogReason | None]


class Session:
    """A client, the vehicle's part by hand, what was sent, and each state with its reason."""

    def __init__(self, *log: Log, armed: bool = False, autopilot: int = PX4) -> None:
        self.client = LogStreamClient({"1", *log}, system=OURS[0], component=OURS[1])
        self.autopilot, self.armed, self.now = autopilot, armed, 1000.0
        self.sent: list[Command] = []
        self.states: list[Reason] = [("idle", None)]
        self.texts: list[str] = []
        self._next = 0

    @property
    def commands(self) -> list[str]:
        """START and STOP, without acknowledgements."""
        return [each.kind for each in self.sent if each.kind != "acknowledge"]

    @property
    def acknowledged(self) -> list[int]:
        return [each.sequence for each in self.sent if each.kind == "acknowledge"]

    def take(self, commands: list[Command]) -> None:
        self.sent += commands
        if self.client.status[:2] != self.states[-1]:
            self.states.append(self.client.status[:2])
            self.texts.append(self.client.status.text)

    def wait(self, seconds: float, *, heartbeats: bool = True) -> None:
        """Let time pass, with heartbeats at 1 Hz and 10 ticks a second."""
        for step in range(round(seconds * 10)):
            self.now += 0.1
            if heartbeats and step % 10 == 0:
                self.take(self.client.on_heartbeat(self.autopilot, self.now, armed=self.armed))
            self.take(self.client.tick(self.now))

    def answer(self, command: int, result: int, ids: tuple[int, int] = OURS) -> None:
        self.take(self.client.on_command_ack(command, result, *ids, self.now))

    def receive(self, *, acked: bool = False, begins: bool = False, sequence: int | None = None) -> None:
        """Receive the next message of the stream, or the one with this sequence."""
        self._next = 0 if begins else self._next
        assert self.client.accepts(*OURS)
        at = self._next if sequence is None else sequence
        self.take(self.client.on_data(at, self.now, acked=acked, begins=begins))
        self._next += sequence is None

    def header(self, messages: int = 274, round_trip: float = 0.004) -> None:
        """Receive a header, as long as it is acknowledged."""
        for number in range(messages):
            before = len(self.acknowledged)
            self.receive(acked=True, begins=number == 0)
            if len(self.acknowledged) == before:
                return
            self.now += round_trip

    def stream(self, seconds: float = 1.0, interval: float = 0.05) -> None:
        for step in range(round(seconds / interval)):
            self.now += interval
            if step % max(1, round(1 / interval)) == 0:
                self.take(self.client.on_heartbeat(self.autopilot, self.now, armed=self.armed))
            self.receive()
            self.take(self.client.tick(self.now))

    def start(self) -> None:
        """Start a stream, and receive its header and its first second."""
        self.wait(0.1)
        self.answer(START, ACCEPTED)
        self.header()
        self.stream()


@pytest.fixture
def session() -> Session:
    """Return a session with log=1 in which nothing has happened."""
    return Session()


def test_stream_starts_and_every_acked_message_is_acknowledged(session: Session) -> None:
    """START at the first heartbeat; each LOGGING_DATA_ACKED is acknowledged, repeated and late ones too."""
    session.start()
    session.receive(acked=True, sequence=273)
    session.receive(acked=True)
    session.receive(acked=True, sequence=session._next - 1)
    assert session.commands == ["start"]
    assert session.acknowledged == [*range(274), 273, 294, 294]
    assert session.states[1:] == [("starting", None), ("header", None), ("streaming", None)]
    assert session.client.header_seconds == pytest.approx(273 * 0.004)


def test_messages_for_other_ids_are_rejected(session: Session) -> None:
    """Data that were not requested, or are addressed to another client, are neither used nor acknowledged."""
    assert not session.client.accepts(*OURS)
    session.wait(0.1)
    assert session.client.accepts(*OURS)
    assert not session.client.accepts(*OTHERS)
    assert not session.client.accepts(0, 0)


def test_command_acks_for_other_ids_are_ignored(session: Session) -> None:
    """The answer to another client on the link, or to another command, changes nothing."""
    session.wait(0.1)
    session.answer(START, TAKEN, OTHERS)
    session.answer(STOP, ACCEPTED)
    session.answer(400, ACCEPTED)
    assert session.states[-1] == ("starting", None)
    session.answer(START, ACCEPTED, (0, 0))  # MAVLink 1 has no ids
    session.wait(1.5)
    assert session.commands == ["start", "stop"]


@pytest.mark.parametrize(
    ("result", "reason", "retry"),
    [
        (TAKEN, "taken", TIMINGS.log_retry),
        (dialect.MAV_RESULT_DENIED, "bandwidth", TIMINGS.log_slow_retry),
        (dialect.MAV_RESULT_UNSUPPORTED, "unsupported", TIMINGS.log_slow_retry),
        (dialect.MAV_RESULT_FAILED, "failed", TIMINGS.log_retry),
        (99, "failed", TIMINGS.log_retry),
    ],
)
def test_refusal_is_reported_once_and_retried_seldom(
    session: Session, result: int, reason: LogReason, retry: float
) -> None:
    """Each result of START has its reason; another attempt with the same result is no news."""
    session.wait(0.1)
    for _ in range(3):
        session.answer(START, result)
        session.wait(retry - 0.2)
        attempts = len(session.commands)
        session.wait(0.4)
        assert len(session.commands) == attempts + 1
    assert session.states[1:] == [("starting", None), ("refused", reason)]
    assert set(session.commands) == {"start"}


def test_in_progress_is_waited_for(session: Session) -> None:
    """IN_PROGRESS is no result: the answer follows."""
    session.wait(0.9)
    session.answer(START, IN_PROGRESS)
    session.wait(0.8)
    assert session.commands == ["start"]


def test_missing_answer_is_reported_after_three_attempts(session: Session) -> None:
    """With SDLOG_BACKEND 0 no command is answered: attempts after 0, 1 and 3 s, and then every 30 s."""
    session.wait(0.1)
    for seconds, attempts in ((0.8, 1), (0.4, 2), (1.6, 2), (0.4, 3), (3.5, 3)):
        session.wait(seconds)
        assert len(session.commands) == attempts
    session.wait(0.5)
    assert session.states[1:] == [("starting", None), ("refused", "no_answer")]
    assert "SDLOG_BACKEND" in session.client.status.text
    session.wait(80)
    assert session.states[1:] == [("starting", None), ("refused", "no_answer")]
    assert len(session.commands) <= 10


def test_autopilot_other_than_px4_is_not_asked() -> None:
    """The reason names the autopilot."""
    session = Session(autopilot=dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
    session.wait(100)
    assert session.sent == []
    assert session.states[1:] == [("refused", "not_px4")]
    assert "MAV_AUTOPILOT_ARDUPILOTMEGA" in session.client.status.text


def test_armed_vehicle_is_asked_after_disarming() -> None:
    """A start blocks the vehicle's logger, so it waits; a stream that runs goes on in flight."""
    session = Session(armed=True)
    session.wait(60)
    assert (session.commands, session.states[1:]) == ([], [("waiting_for_disarm", "armed")])
    session.armed = False
    session.start()
    session.armed = True
    session.stream(5)
    assert session.commands == ["start"]
    assert session.client.status.state == "streaming"


def test_armed_vehicle_is_asked_on_request() -> None:
    """log=armed allows a start in flight."""
    session = Session("armed", armed=True)
    session.start()
    assert session.client.status.state == "streaming"


def test_arming_ends_the_attempts(session: Session) -> None:
    """Without an answer START is not repeated once the vehicle is armed."""
    session.wait(0.5)
    session.armed = True
    session.wait(60)
    assert session.commands == ["start"]
    assert session.client.status.state == "waiting_for_disarm"


class TestOwnership:
    """The stream belongs to one client; who else wants it, is rejected."""

    def test_stream_of_another_client_is_left_alone(self, session: Session) -> None:
        """Without log=take a rejected client never sends STOP, neither then nor when it ends."""
        session.wait(0.1)
        for _ in range(4):
            session.answer(START, TAKEN)
            session.wait(TIMINGS.log_retry)
        session.answer(START, TAKEN)
        session.take(session.client.stop(session.now))
        assert set(session.commands) == {"start"}
        assert session.client.status.state == "stopped"

    def test_client_that_has_the_stream_is_named(self, session: Session) -> None:
        """Its data on the same link show its ids."""
        session.wait(0.1)
        session.answer(START, TAKEN)
        assert "another client has it" in session.client.status.text
        assert not session.client.accepts(255, 190)
        assert "system 255 component 190 has it" in session.client.status.text
        assert session.client.status[:2] == ("refused", "taken")

    def test_stream_of_another_client_is_taken_over_on_request(self) -> None:
        """log=take: STOP, its acceptance, a pause, START; acknowledgements go on meanwhile."""
        session = Session("take")
        session.wait(0.1)
        session.answer(START, TAKEN)
        session.answer(STOP, IN_PROGRESS)
        session.wait(0.2)
        session.receive(acked=True, sequence=70)
        session.answer(STOP, ACCEPTED)
        assert (session.commands, session.acknowledged) == (["start", "stop"], [70])
        session.wait(TIMINGS.log_timeout - 0.2)
        assert session.commands == ["start", "stop"]
        session.wait(0.4)
        assert session.commands == ["start", "stop", "start"]
        session.answer(START, ACCEPTED)
        session.header()
        assert session.states[1:] == [("starting", None), ("header", None)]

    def test_stream_is_taken_over_once(self) -> None:
        """A client that is rejected again leaves the stream alone; with SDLOG_BACKEND 1 a takeover changes nothing."""
        session = Session("take")
        session.wait(0.1)
        session.answer(START, TAKEN)
        session.answer(STOP, ACCEPTED)
        session.wait(TIMINGS.log_timeout + 0.2)
        for _ in range(5):
            session.answer(START, TAKEN)
            session.wait(TIMINGS.log_retry + 0.2)
        assert session.commands.count("stop") == 1
        assert session.states[1:] == [("starting", None), ("refused", "taken")]

    def test_stream_of_an_earlier_process_is_started_anew(self, session: Session) -> None:
        """A stream to the client's own ids whose header it missed: STOP, a pause and START, once."""
        session.wait(0.1)
        session.answer(START, TAKEN)
        session.receive(sequence=7000)
        assert session.commands == ["start", "stop"]
        session.answer(STOP, ACCEPTED)
        session.receive(sequence=7001)
        session.wait(TIMINGS.log_timeout + 0.2)
        assert session.commands == ["start", "stop", "start"]
        session.answer(START, TAKEN)
        session.receive(sequence=7002)
        assert session.commands == ["start", "stop", "start"]
        assert session.client.status.reason == "taken"

    def test_stop_by_another_client_is_named(self, session: Session) -> None:
        """PX4 sends 44 acknowledged messages to the first client, and nothing else: START waits for the other one."""
        session.start()
        for _ in range(44):
            session.receive(acked=True)
            session.now += 0.004
        session.wait(TIMINGS.log_retry - 0.5)
        assert session.states[-1] == ("ended", "stopped_elsewhere")
        assert session.commands == ["start"]
        session.wait(3)
        assert session.commands[:2] == ["start", "start"]

    def test_second_start_leaves_the_stream_untouched(self, session: Session) -> None:
        """An answer to a START that is not open, or a rejection of the second one, changes nothing."""
        session.start()
        session.answer(START, TAKEN)
        session.answer(START, ACCEPTED)
        session.stream()
        assert session.states[-1] == ("streaming", None)
        assert session.commands == ["start"]


class TestNoData:
    """START is accepted, and nothing is sent: after STOP without waiting, or when another link has the stream."""

    def test_start_without_data_is_followed_by_stop_and_start(self, session: Session) -> None:
        """STOP after 1 s, START 2.5 s after its acceptance."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.wait(0.8)
        assert session.commands == ["start"]
        session.wait(0.4)
        assert session.commands == ["start", "stop"]
        session.answer(STOP, ACCEPTED)
        session.wait(TIMINGS.log_timeout - 0.2)
        assert session.commands == ["start", "stop"]
        session.wait(0.4)
        session.answer(START, ACCEPTED)
        session.header()
        session.stream()
        assert session.states[1:] == [("starting", None), ("header", None), ("streaming", None)]

    def test_start_without_data_is_given_up(self, session: Session) -> None:
        """After three attempts the stream is stopped, and asked for every 30 s."""
        session.wait(0.1)
        for attempts in (3, 4):
            for _ in range(150):
                session.answer(START, ACCEPTED)
                session.answer(STOP, ACCEPTED)
                session.wait(0.2)
            assert session.commands == ["start", "stop"] * attempts
        assert session.states[1:] == [("starting", None), ("refused", "no_data")]

    def test_data_in_the_middle_are_no_start(self, session: Session) -> None:
        """Data of an earlier stream that are still on their way are not the new one."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.receive(sequence=300)
        session.wait(1.2)
        assert session.commands == ["start", "stop"]

    def test_lost_answer_is_replaced_by_the_first_message(self, session: Session) -> None:
        """The header arrives, the COMMAND_ACK does not: START is not repeated."""
        session.wait(0.1)
        session.header()
        session.stream()
        assert session.commands == ["start"]
        assert session.client.status.state == "streaming"


class TestHeader:
    """While PX4 sends the header, its logger is blocked, and the vehicle's own log has a hole."""

    @pytest.mark.parametrize("round_trip", [0.03, 0.08, 0.2, 3.0])
    def test_long_round_trip_aborts_the_header(self, session: Session, round_trip: float) -> None:
        """Judged by the first messages: no acknowledgement more, as PX4 obeys STOP only afterwards."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        began = session.now
        session.header(round_trip=round_trip)
        assert session.commands == ["start", "stop"]
        assert len(session.acknowledged) <= 32
        assert session.now - began <= TIMINGS.log_header + round_trip
        assert session.states[-1] == ("refused", "slow_link")
        assert f"{1e3 * round_trip:.0f} ms" in session.client.status.text
        session.receive(acked=True, sequence=40)
        assert 40 not in session.acknowledged
        session.wait(2.5)
        session.answer(STOP, ACCEPTED)
        session.wait(TIMINGS.log_slow_retry - 10)
        assert session.commands.count("start") == 1
        assert session.states[-1] == ("refused", "slow_link")

    def test_lost_messages_do_not_abort_the_header(self, session: Session) -> None:
        """A lost message costs 50 ms: one of twenty is no long round trip."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        for number in range(410):
            session.receive(acked=True, begins=number == 0)
            session.now += 0.054 if number % 20 == 1 else 0.004
        assert session.client.status.state == "header"

    def test_header_that_is_only_repeated_is_over(self, session: Session) -> None:
        """PX4 repeats a message every 50 ms, and ends the stream silently after 2.5 s without acknowledgement."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.header(10)
        for _ in range(50):
            session.receive(acked=True, sequence=9)
            session.now += 0.05
        session.wait(1)
        assert session.states[-1] == ("ended", "stalled")
        session.wait(TIMINGS.log_retry)
        assert session.commands == ["start", "start"]

    def test_header_before_a_slow_stream_is_complete(self, session: Session) -> None:
        """Few slow topics send nothing for seconds after the header: PX4 rejects START, so the stream exists."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.header()
        session.wait(1.5)
        assert session.commands == ["start", "start"]
        session.answer(START, TAKEN)
        assert session.client.status == ("streaming", None, "")
        assert session.client.header_seconds == pytest.approx(273 * 0.004)

    def test_header_that_stops_is_over(self, session: Session) -> None:
        """Without repetitions and without an answer to START, the header is given up."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.header(10)
        session.wait(10)
        assert session.states[-1] == ("ended", "stalled")


class TestSilence:
    """PX4 does not announce the end of a stream: START shows whether it exists."""

    def test_slow_stream_is_left_alone(self, session: Session) -> None:
        """One topic at 1 Hz fills a message in 5 s: PX4 is asked seldom, and the stream goes on."""
        session.start()
        for _ in range(40):
            session.wait(5)
            session.answer(START, TAKEN)
            session.receive()
        assert session.states[-1] == ("streaming", None)
        assert session.commands.count("start") < 30
        assert "stop" not in session.commands

    def test_ended_stream_is_started_again_within_seconds(self, session: Session) -> None:
        """PX4 accepts START: the old stream is over, a new one begins with sequence 0."""
        session.start()
        session.wait(1.2)
        session.answer(START, ACCEPTED)
        assert session.states[-1] == ("starting", "silent")
        session.header()
        session.stream()
        assert session.states[-3:] == [("starting", "silent"), ("header", None), ("streaming", None)]

    def test_unanswered_stream_has_ended(self, session: Session) -> None:
        """Neither data nor an answer: the stream is over, and asked for again later."""
        session.start()
        session.wait(10)
        assert session.states[-1] == ("ended", "silent")
        session.wait(TIMINGS.log_retry)
        session.answer(START, ACCEPTED)
        session.header()
        assert session.client.status.state == "header"

    def test_stream_of_another_client_is_found_after_longest_silence(self, session: Session) -> None:
        """PX4 rejects START because of another client's stream: no stream of ours is silent for 15 s."""
        session.start()
        for _ in range(18):
            session.wait(1)
            session.answer(START, TAKEN)
        assert session.states[-1] == ("refused", "taken")
        assert "stop" not in session.commands

    def test_armed_vehicle_is_not_asked_because_of_silence(self, session: Session) -> None:
        """In flight START could begin a header: the end is judged by silence alone, and data correct it."""
        session.start()
        session.armed = True
        session.stream(2)
        session.wait(3)
        session.receive()
        assert session.states[-2:] == [("ended", "silent"), ("streaming", None)]
        session.wait(TIMINGS.log_longest_silence)
        assert session.commands == ["start"]
        session.armed = False
        session.wait(0.1)
        assert session.commands == ["start", "start"]

    def test_stream_that_is_alive_after_all_goes_on(self, session: Session) -> None:
        """After disarming, PX4 rejects START: the stream was only slow."""
        session.start()
        session.armed = True
        session.wait(20)
        session.armed = False
        session.wait(0.1)
        session.answer(START, TAKEN)
        assert session.states[-1] == ("streaming", None)

    @pytest.mark.parametrize("seconds", [4.0, 60.0, 600.0])
    def test_outage_of_the_link_does_not_end_the_stream(self, session: Session, seconds: float) -> None:
        """PX4 goes on without a client; the client sends nothing while the link is silent."""
        session.start()
        session.wait(seconds, heartbeats=False)
        assert session.states[-1] == ("ended", "link_lost")
        session.wait(0.1)
        session.stream(5)
        assert session.states[-2:] == [("ended", "link_lost"), ("streaming", None)]
        assert session.commands == ["start"]

    def test_stream_that_ended_during_an_outage_is_started_again(self, session: Session) -> None:
        """An unacknowledged message ended it: PX4 accepts START."""
        session.start()
        session.wait(20, heartbeats=False)
        session.wait(1.3)
        session.answer(START, ACCEPTED)
        session.header()
        assert session.states[-2:] == [("starting", "silent"), ("header", None)]


def test_reboot_starts_a_new_stream(session: Session) -> None:
    """After a reboot the stream is gone: START follows the next heartbeat."""
    session.start()
    session.client.on_reboot()
    session.take([])
    assert not session.client.accepts(*OURS)
    session.start()
    assert session.commands == ["start", "start"]
    assert session.states[-4:] == [("idle", None), ("starting", None), ("header", None), ("streaming", None)]


def test_new_stream_without_notice_is_followed(session: Session) -> None:
    """Sequence 0 with ULog's magic begins a stream, whatever came before."""
    session.start()
    session.header()
    session.stream()
    assert session.states[-3:] == [("streaming", None), ("header", None), ("streaming", None)]
    assert session.commands == ["start"]


class TestStop:
    """`stop` ends the client's own stream."""

    def test_stop_is_repeated_until_it_is_accepted(self, session: Session) -> None:
        """STOP is sent again after 1 s; the tail is acknowledged until PX4 accepts."""
        session.start()
        session.take(session.client.stop(session.now))
        session.answer(STOP, IN_PROGRESS)
        session.wait(1.2)
        for _ in range(44):
            session.receive(acked=True)
        assert session.client.status.state == "stopping"
        session.answer(STOP, ACCEPTED)
        assert session.commands == ["start", "stop", "stop"]
        assert session.acknowledged[-44:] == [*range(294, 338)]
        session.wait(60)
        assert session.states[-2:] == [("stopping", None), ("stopped", None)]
        assert session.commands == ["start", "stop", "stop"]

    def test_stop_without_an_answer_ends(self, session: Session) -> None:
        """A vehicle that is gone gets three attempts, and no more."""
        session.start()
        session.take(session.client.stop(session.now))
        session.wait(3.5)
        assert session.commands == ["start", "stop", "stop", "stop"]
        assert session.client.status.state == "stopped"

    @pytest.mark.parametrize("result", [ACCEPTED, TAKEN, None])
    def test_open_start_is_answered_before_stop(self, session: Session, result: int | None) -> None:
        """A stream that may be another client's is stopped only if the START was accepted."""
        session.wait(0.1)
        session.take(session.client.stop(session.now))
        assert session.client.status.state == "stopping"
        session.wait(0.5)
        if result is None:
            session.wait(1)
        else:
            session.answer(START, result)
        assert session.commands == (["start", "stop"] if result == ACCEPTED else ["start"])
        assert session.client.status.state == ("stopping" if result == ACCEPTED else "stopped")

    def test_stop_before_any_start_sends_nothing(self, session: Session) -> None:
        """There is nothing to end."""
        session.take(session.client.stop(session.now))
        session.wait(10)
        assert (session.sent, session.client.status.state) == ([], "stopped")


@cache
def recorded(name: str) -> list[tuple[float, bool, bytes]]:
    """Return the datagrams of a session, with the time since the first one."""
    found = [*datagrams(STREAMS / f"ulog_stream_{name}.bin.gz")]
    return [(when - found[0][0], is_sent, frame) for when, is_sent, frame in found]


class Replay:
    """A part of a session that a real PX4 sent, given to a client; a real client's acknowledgements beside its."""

    def __init__(self, name: str, begin: float, end: float, ids: tuple[int, int], *log: Log) -> None:
        self.client = LogStreamClient({"1", *log}, system=ids[0], component=ids[1])
        self.reassembly = CountedReassembly()
        self.states: list[Reason] = [("idle", None)]
        self.acknowledged: list[int] = []
        self.recorded: list[int] = []
        self._boot, last = 0, begin
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        for now, is_sent, frame in recorded(name):
            if begin <= now < end:
                while last + 0.1 < now:
                    last += 0.1
                    self._note(self.client.tick(last))
                for message in parser.parse_buffer(frame) or []:
                    if is_sent and message.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1:
                        self._note([*self._handle(message, now), *self.client.tick(now)])
                    elif not is_sent and message.get_type() == "LOGGING_ACK":
                        self.recorded.append(message.sequence)

    def _note(self, commands: list[Command]) -> None:
        self.acknowledged += [each.sequence for each in commands if each.kind == "acknowledge"]
        if self.client.status[:2] != self.states[-1]:
            self.states.append(self.client.status[:2])

    def _handle(self, message: Any, now: float) -> Iterator[Command]:
        client, kind = self.client, message.get_type()
        if kind == "HEARTBEAT":
            yield from client.on_heartbeat(message.autopilot, now, armed=bool(message.base_mode & 128))
        elif kind == "COMMAND_ACK":
            ids = message.target_system, message.target_component
            yield from client.on_command_ack(message.command, message.result, *ids, now)
        elif kind.startswith("LOGGING_DATA"):
            if client.accepts(message.target_system, message.target_component):
                fields = message.sequence, message.length, message.first_message_offset, message.data
                begins = self.reassembly.add(*fields).begins
                yield from client.on_data(message.sequence, now, acked=kind.endswith("ACKED"), begins=begins)
        elif (ms := getattr(message, "time_boot_ms", None)) is not None:
            if ms < self._boot - 1000:
                client.on_reboot()
                self._note([])
            self._boot = ms


@pytest.mark.logs
@pytest.mark.skipif(not STREAMS.exists(), reason=f"no recordings of a PX4's ULog stream: {STREAMS} is not there")
class TestRecordedSessions:
    """Sessions of a real PX4 with two clients: what ours makes of what the vehicle sent."""

    STARTED: Final[list[Reason]] = [("starting", None), ("header", None), ("streaming", None)]

    def test_flight_is_acknowledged_as_by_the_recorded_client(self) -> None:
        """Each message that the real client acknowledged, in that order, among them late topics and the tail."""
        replay = Replay("flight1", 0, 90, (245, 190))
        assert replay.acknowledged == replay.recorded
        assert len(replay.acknowledged) == 320
        assert replay.states[1:] == [*self.STARTED, ("ended", "stopped_elsewhere")]
        assert replay.client.header_seconds == pytest.approx(1.1, abs=0.01)

    def test_second_start_is_harmless_and_foreign_stop_is_named(self) -> None:
        """A second START and that of another client are rejected; then the other client sends STOP."""
        replay = Replay("session", 4.0, 15.0, (245, 190))
        assert replay.states[1:] == [*self.STARTED, ("ended", "stopped_elsewhere")]
        assert replay.acknowledged == replay.recorded

    def test_client_that_reads_nothing_loses_messages_and_goes_on(self) -> None:
        """Nothing was read for 5 s and for 12 s: 615 and 3,433 messages are lost, the stream goes on."""
        replay = Replay("session", 26.2, 52.0, (245, 190))
        outage: list[Reason] = [("ended", "link_lost"), ("streaming", None)]
        assert replay.states[1:] == [*self.STARTED, *outage, *outage]
        assert replay.reassembly.lost == 615 + 3433

    def test_header_that_is_not_acknowledged_stalls(self) -> None:
        """The recorded client acknowledged nothing: the first message came 50 times, then nothing."""
        replay = Replay("session", 65.95, 72.0, (247, 190))
        assert replay.states[1:] == [("starting", None), ("header", None), ("ended", "stalled")]
        assert replay.reassembly.counts == {"delivered": 1, "duplicate": 49}

    def test_unacknowledged_late_topic_ends_the_stream_in_flight(self) -> None:
        """The recorded client stopped acknowledging: the stream ends silently, and is not started in flight."""
        replay = Replay("session", 70.0, 82.9, (247, 190))
        assert replay.states[1:] == [*self.STARTED, ("ended", "silent")]

    def test_reboot_begins_a_new_stream(self) -> None:
        """The vehicle was killed and started again: silence, time_boot_ms back near 0, a new header after START."""
        replay = Replay("session", 95.0, 110.5, (247, 190))
        assert replay.states[1:] == [*self.STARTED, ("idle", None), *self.STARTED]

    def test_second_client_sees_nothing(self) -> None:
        """On the other link START is rejected, and no data arrive."""
        replay = Replay("session_second", 9.5, 12.0, (246, 191))
        assert replay.states[1:] == [("starting", None), ("refused", "taken")]
        assert replay.acknowledged == []
