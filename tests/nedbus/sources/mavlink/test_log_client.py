"""ULog stream state machine with a fake clock; each case was observed on a real PX4 (SITL, main of 2026-05-14)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from typing import Any, Final, Literal

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.mavlink.log_client import Command, LogReason, LogState, LogStreamClient
from nedbus.timings import TIMINGS
from tests.peers.px4_log_stream import START, STOP, STREAMS, datagrams

from .test_log_reassembly import CountingReassembly

OURS: Final = (245, 191)
OTHERS: Final = (246, 190)
PX4: Final = dialect.MAV_AUTOPILOT_PX4
ACCEPTED: Final = dialect.MAV_RESULT_ACCEPTED
REJECTED: Final = dialect.MAV_RESULT_TEMPORARILY_REJECTED
IN_PROGRESS: Final = dialect.MAV_RESULT_IN_PROGRESS

Log = Literal["1", "armed"]
StateAndReason = tuple[LogState, LogReason | None]


class Session:
    """A client, a manually stepped vehicle, the commands sent, and each state with its reason."""

    def __init__(
        self, *log: Log, armed: bool = False, autopilot: int = PX4, header: float | None = None
    ) -> None:  # fmt: skip
        self.client = LogStreamClient({"1", *log}, system=OURS[0], component=OURS[1], header=header)
        self.autopilot, self.armed, self.now, self.round_trip = autopilot, armed, 1000.0, 0.001
        self.sent: list[Command] = []
        self.states: list[StateAndReason] = [("idle", None)]
        self.texts: list[str] = []
        self._next = 0

    @property
    def commands(self) -> list[str]:
        """START and STOP, without acknowledgements."""
        return [each.kind for each in self.sent if each.kind in ("start", "stop")]

    @property
    def acknowledged(self) -> list[int]:
        return [each.sequence for each in self.sent if each.kind == "acknowledge"]

    def add(self, commands: list[Command]) -> None:
        """Collect commands; answer TIMESYNC after the round trip."""
        self.sent += commands
        for each in commands:
            if each.kind == "ping" and self.round_trip:
                self.now += self.round_trip
                self.add(self.client.on_timesync(each.sequence, self.now))
        if self.client.status[:2] != self.states[-1]:
            self.states.append(self.client.status[:2])
            self.texts.append(self.client.status.text)

    def wait(self, seconds: float, *, heartbeats: bool = True) -> None:
        """Advance the clock, with heartbeats at 1 Hz and 10 ticks per second."""
        for step in range(round(seconds * 10)):
            self.now += 0.1
            if heartbeats and step % 10 == 0:
                self.add(self.client.on_heartbeat(self.autopilot, self.now, armed=self.armed))
            self.add(self.client.tick(self.now))

    def answer(self, command: int, result: int, ids: tuple[int, int] = OURS) -> None:
        self.add(self.client.on_command_ack(command, result, *ids, self.now))

    def receive(
        self, *, acked: bool = False, begins: bool = False, sequence: int | None = None
    ) -> None:
        """Receive the next message of the stream, or the one with this sequence number."""
        self._next = 0 if begins else self._next
        assert self.client.accepts(*OURS)
        at = self._next if sequence is None else sequence
        self.add(self.client.on_data(at, self.now, acked=acked, begins=begins))
        self._next += sequence is None

    def header(self, messages: int = 274, round_trip: float = 0.004) -> None:
        """Receive a header for as long as it is acknowledged."""
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
                self.add(self.client.on_heartbeat(self.autopilot, self.now, armed=self.armed))
            self.receive()
            self.add(self.client.tick(self.now))

    def start(self, interval: float = 0.004) -> None:
        """Start a stream; receive its header and its first second."""
        self.wait(0.1)
        self.answer(START, ACCEPTED)
        self.header(round_trip=interval)
        self.stream()


@pytest.fixture
def session() -> Session:
    """Return a session with log=1, before the first heartbeat."""
    return Session()


def test_every_logging_data_acked_is_acknowledged(session: Session) -> None:
    """The first heartbeat triggers START; each LOGGING_DATA_ACKED is acknowledged, including retransmissions."""
    session.start()
    session.receive(acked=True, sequence=273)
    session.receive(acked=True)
    session.receive(acked=True, sequence=session._next - 1)
    assert session.commands == ["start"]
    assert session.acknowledged == [*range(274), 273, 294, 294]
    assert session.states[1:] == [("starting", None), ("header", None), ("streaming", None)]
    assert session.client.header_seconds == pytest.approx(273 * 0.004)


def test_data_for_other_ids_is_rejected(session: Session) -> None:
    """Data that was not requested, or is addressed to another client, is neither used nor acknowledged."""
    assert not session.client.accepts(*OURS)
    session.wait(0.1)
    assert session.client.accepts(*OURS)
    assert not session.client.accepts(*OTHERS)
    assert not session.client.accepts(0, 0)


def test_command_acks_for_other_ids_are_ignored(session: Session) -> None:
    """A COMMAND_ACK for another client, or for another command, has no effect."""
    session.wait(0.1)
    session.answer(START, REJECTED, OTHERS)
    session.answer(STOP, ACCEPTED)
    session.answer(400, ACCEPTED)
    assert session.states[-1] == ("starting", None)
    session.answer(START, ACCEPTED, (0, 0))  # MAVLink 1 has no ids
    session.wait(1.5)
    assert session.commands == ["start"]
    session.wait(TIMINGS.log_timeout)
    assert session.commands == ["start", "start"]


@pytest.mark.parametrize(
    ("result", "reason", "retry"),
    [
        (REJECTED, "taken", TIMINGS.log_retry),
        (dialect.MAV_RESULT_DENIED, "bandwidth", TIMINGS.log_slow_retry),
        (dialect.MAV_RESULT_UNSUPPORTED, "unsupported", TIMINGS.log_slow_retry),
        (dialect.MAV_RESULT_FAILED, "failed", TIMINGS.log_retry),
        (99, "failed", TIMINGS.log_retry),
    ],
)
def test_rejected_start_is_reported_once_and_retried(
    session: Session, result: int, reason: LogReason, retry: float
) -> None:
    """Each result of START maps to a reason; a retry with the same result does not change the status."""
    session.wait(0.1)
    for _ in range(3):
        session.answer(START, result)
        session.wait(retry - 0.2)
        attempts = len(session.commands)
        session.wait(0.4)
        assert len(session.commands) == attempts + 1
    assert session.states[1:] == [("starting", None), ("refused", reason)]
    assert set(session.commands) == {"start"}


def test_in_progress_extends_timeout(session: Session) -> None:
    """After IN_PROGRESS the client keeps waiting for the final result."""
    session.wait(0.9)
    session.answer(START, IN_PROGRESS)
    session.wait(0.8)
    assert session.commands == ["start"]


def test_unanswered_start_is_reported_after_three_attempts(session: Session) -> None:
    """An unanswered START, as with SDLOG_BACKEND 0, is sent after 0, 1 and 3 s, then reported, and sent every 30 s."""
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


def test_autopilot_other_than_px4_receives_no_start() -> None:
    """The client sends nothing to another autopilot, and the reason names that autopilot."""
    session = Session(autopilot=dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
    session.wait(100)
    assert session.sent == []
    assert session.states[1:] == [("refused", "not_px4")]
    assert "MAV_AUTOPILOT_ARDUPILOTMEGA" in session.client.status.text


def test_start_waits_for_disarming() -> None:
    """START blocks the vehicle's logger, so it is sent only while disarmed; a running stream continues in flight."""
    session = Session(armed=True)
    session.wait(60)
    assert (session.commands, session.states[1:]) == ([], [("waiting_for_disarm", "armed")])
    session.armed = False
    session.start()
    session.armed = True
    session.stream(5)
    assert session.commands == ["start"]
    assert session.client.status.state == "streaming"


def test_log_option_armed_starts_stream_in_flight() -> None:
    session = Session("armed", armed=True)
    session.start()
    assert session.client.status.state == "streaming"


def test_arming_stops_start_retries(session: Session) -> None:
    """An unanswered START is not repeated once the vehicle is armed."""
    session.wait(0.5)
    session.armed = True
    session.wait(60)
    assert session.commands == ["start"]
    assert session.client.status.state == "waiting_for_disarm"


class TestOwnership:
    """PX4 streams to one client at a time, and rejects all others."""

    def test_rejected_client_never_sends_stop(self, session: Session) -> None:
        """A rejected client never sends STOP, not even on shutdown: another client may receive the stream."""
        session.wait(0.1)
        for _ in range(4):
            session.answer(START, REJECTED)
            session.wait(TIMINGS.log_retry)
        session.answer(START, REJECTED)
        session.add(session.client.stop(session.now))
        assert set(session.commands) == {"start"}
        assert session.client.status.state == "stopped"

    def test_owner_of_stream_is_reported(self, session: Session) -> None:
        """Data on the same link reveals the ids of the client that owns the stream."""
        session.wait(0.1)
        session.answer(START, REJECTED)
        assert "another client already receives it" in session.client.status.text
        assert not session.client.accepts(255, 190)
        assert "system 255 component 190 already receives it" in session.client.status.text
        assert session.client.status[:2] == ("refused", "taken")

    def test_stream_of_earlier_process_is_restarted(self, session: Session) -> None:
        """A stream without a header that is addressed to the client is restarted once with STOP, a pause and START.

        Its data is acknowledged throughout, because PX4 stops only after the acknowledgement.
        """
        session.wait(0.1)
        session.answer(START, REJECTED)
        session.receive(sequence=7000)
        assert session.commands == ["start", "stop"]
        session.answer(STOP, IN_PROGRESS)
        session.wait(0.2)
        session.receive(acked=True, sequence=7001)
        session.answer(STOP, ACCEPTED)
        assert (session.commands, session.acknowledged) == (["start", "stop"], [7001])
        session.wait(TIMINGS.log_timeout - 0.2)
        assert session.commands == ["start", "stop"]
        session.wait(0.4)
        assert session.commands == ["start", "stop", "start"]
        session.answer(START, REJECTED)
        session.receive(sequence=7002)
        assert session.commands == ["start", "stop", "start"]
        assert session.client.status.reason == "taken"

    def test_stop_by_another_client_is_detected(self, session: Session) -> None:
        """After a STOP by another client PX4 sends only 44 more LOGGING_DATA_ACKED; the client retries START later.

        The status says when.
        """
        session.start()
        for _ in range(44):
            session.receive(acked=True)
            session.now += 0.004
        session.wait(TIMINGS.log_retry - 0.5)
        assert session.states[-1] == ("ended", "stopped_elsewhere")
        assert session.client.status.text.endswith(
            f"it is requested again in {TIMINGS.log_retry:.0f} s"
        )
        assert session.commands == ["start"]
        session.wait(3)
        assert session.commands[:2] == ["start", "start"]

    def test_late_answer_to_start_does_not_affect_stream(self, session: Session) -> None:
        """While the stream is running, late answers to START have no effect, whether START is accepted or rejected."""
        session.start()
        session.answer(START, REJECTED)
        session.answer(START, ACCEPTED)
        session.stream()
        assert session.states[-1] == ("streaming", None)
        assert session.commands == ["start"]


class TestNoData:
    """PX4 accepts START but sends no data if START follows STOP too soon, or if another link has the stream."""

    def test_start_without_data_is_repeated_without_stop(self, session: Session) -> None:
        """START is repeated when PX4 has given up, after 3.5 s; STOP might end the stream of another client."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.wait(TIMINGS.log_answer + TIMINGS.log_timeout - 0.2)
        assert session.commands == ["start"]
        session.wait(0.4)
        assert session.commands == ["start", "start"]
        session.answer(START, ACCEPTED)
        session.header()
        session.stream()
        assert session.states[1:] == [("starting", None), ("header", None), ("streaming", None)]

    def test_start_without_data_fails_after_three_attempts(self, session: Session) -> None:
        """After three attempts without data the state is "refused", reason "no_data"; the next one is 5 minutes later.

        Each attempt blocks the vehicle's logger for 2.5 s.
        """
        session.wait(0.1)
        for attempts, steps in ((3, 1480), (4, 100)):
            for _ in range(steps):
                session.answer(START, ACCEPTED)
                session.wait(0.2)
            assert session.commands == ["start"] * attempts
        assert session.states[1:] == [("starting", None), ("refused", "no_data")]

    def test_late_data_of_earlier_stream_is_not_a_new_stream(self, session: Session) -> None:
        """Delayed data of an earlier stream is not mistaken for data of the requested stream."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.receive(sequence=300)
        session.wait(TIMINGS.log_answer + TIMINGS.log_timeout + 0.2)
        assert session.commands == ["start", "start"]

    def test_header_replaces_lost_command_ack(self, session: Session) -> None:
        """If the header arrives without a COMMAND_ACK, START is not repeated."""
        session.wait(0.1)
        session.header()
        session.stream()
        assert session.commands == ["start"]
        assert session.client.status.state == "streaming"


class TestHeader:
    """While PX4 sends the header its logger is blocked, which leaves a gap in the vehicle's own log."""

    @pytest.mark.parametrize("round_trip", [0.03, 0.08, 0.2, 3.0])
    def test_long_round_trip_aborts_header(self, session: Session, round_trip: float) -> None:
        """If round trips are long, STOP aborts the header, and acknowledgements end, or PX4 would ignore STOP."""
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
        session.receive(begins=True)  # until PX4 stops, it may repeat the beginning
        assert session.states[-1] == ("refused", "slow_link")
        session.wait(2.5)
        session.answer(STOP, ACCEPTED)
        session.wait(TIMINGS.log_slow_retry - 10)
        assert session.commands.count("start") == 1
        assert session.states[-1] == ("refused", "slow_link")

    @pytest.mark.parametrize("messages", [1, 274])
    def test_unreadable_stream_is_stopped_once(self, session: Session, messages: int) -> None:
        """A rejected stream is stopped, and requested again after the longest delay, even if data still arrives."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.header(messages)
        session.client.reject("it has a flag")
        session.wait(0.1)
        assert session.states[-1] == ("refused", "unreadable")
        assert session.texts[-1] == "the ULog stream cannot be read, because it has a flag"
        session.receive(acked=True, sequence=400)
        assert 400 not in session.acknowledged
        session.answer(STOP, ACCEPTED)
        session.receive()
        session.receive(begins=True)
        session.wait(TIMINGS.log_slow_retry - 10)
        assert session.states[-1] == ("refused", "unreadable")
        assert session.commands == ["start", "stop"]
        session.wait(20)
        session.answer(START, ACCEPTED)
        session.header()
        session.stream()
        assert session.client.status.state == "streaming"

    @pytest.mark.parametrize("round_trip", [0.04, 0.08, 0.16, 2.0])
    def test_no_start_if_the_header_would_take_too_long(
        self, session: Session, round_trip: float
    ) -> None:
        """The round trip is measured with TIMESYNC before START, which would block the vehicle's logger."""
        session.round_trip = round_trip
        session.wait(10)
        assert session.states[-1] == ("refused", "slow_link")
        assert re.search(
            rf"would take \d+ s, at {1e3 * round_trip + 4:.0f} ms for", session.client.status.text
        )
        assert "because of the vehicle's parameters alone" in session.client.status.text
        session.wait(2 * TIMINGS.log_slow_retry)
        assert session.commands == []
        session.round_trip = 0.001
        session.wait(TIMINGS.log_measure_again + 3)
        assert session.commands[:1] == ["start"]

    @pytest.mark.parametrize("busy", [1.0, 4.0])
    def test_busy_vehicle_at_boot_is_measured_again(self, session: Session, busy: float) -> None:
        """A vehicle that boots answers TIMESYNC late: the stream starts some seconds later, before it is armed."""
        session.round_trip = 0.03
        session.wait(busy)
        session.round_trip = 0.002
        session.wait(10 - busy)
        assert session.commands[:1] == ["start"]

    def test_armed_vehicle_is_not_measured(self, session: Session) -> None:
        """While a refused vehicle is armed, nothing is sent; the link is measured again after disarming."""
        session.round_trip = 0.03
        session.wait(4)
        session.armed, session.round_trip, session.sent = True, 0.002, []
        session.wait(60)
        assert session.sent == []
        session.armed = False
        session.wait(2)
        assert session.commands[:1] == ["start"]

    def test_refusal_names_number_of_topics_that_fit_and_longer_limit(
        self, session: Session
    ) -> None:
        """At 26 ms per message 10 s are enough for 61 topics, and header=15 for all; then START is sent."""
        session.round_trip = 0.022
        session.wait(2)
        text = session.client.status.text
        assert "10 s are allowed, enough for the header of 61 topics" in text
        assert text.endswith("or set header=15")
        patient = Session(header=15)
        patient.round_trip = 0.022
        patient.start(interval=0.026)
        assert patient.client.status.state == "streaming"
        assert patient.commands == ["start"]

    def test_shortest_of_three_round_trips_counts(self, session: Session) -> None:
        """A TIMESYNC that waited in a queue, or was lost, does not prevent START."""
        session.round_trip = 0.0  # no answers
        session.wait(0.1)
        for delay in (0.2, 0.01, 0.3):
            session.now += delay
            session.add(session.client.on_timesync(session.sent[-1].sequence, session.now))
        assert session.commands == ["start"]

    def test_start_is_sent_without_an_answer_to_timesync(self, session: Session) -> None:
        """A vehicle that does not answer TIMESYNC receives START after three requests."""
        session.round_trip = 0.0
        session.wait(2.8)
        assert [each.kind for each in session.sent] == ["ping"] * 3
        session.wait(0.5)
        assert session.commands == ["start"]

    def test_answers_to_other_clients_do_not_start_the_stream(self, session: Session) -> None:
        """An answer to TIMESYNC counts once, and only if it answers a request of this client."""
        session.round_trip = 0.0
        session.wait(0.1)
        first = session.sent[-1].sequence
        for sent in (first + 1, first, first, first):
            session.now += 0.01
            session.add(session.client.on_timesync(sent, session.now))
        assert session.commands == []

    def test_header_that_slows_down_is_aborted_after_a_second(self, session: Session) -> None:
        """On a link of 57,600 baud each message takes longer than the one before; PX4's logger is released early."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        began = session.now
        for number, wait in enumerate((0.1, 0.16, 0.28, 0.49, 0.73, 1.1, 1.5, 2.1)):
            session.receive(acked=True, begins=number == 0)
            session.now += wait
        assert session.states[-1] == ("refused", "slow_link")
        assert session.commands == ["start", "stop"]
        assert len(session.acknowledged) <= 4
        assert session.now - began > 5

    def test_link_outage_during_header_delays_the_next_start(self, session: Session) -> None:
        """PX4 gives up on a header after 2.5 s without the link; the next START follows 5 minutes later."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.header(10)
        session.wait(4, heartbeats=False)
        assert session.states[-1] == ("ended", "stalled")
        session.wait(TIMINGS.log_slow_retry - 10)
        assert session.commands == ["start"]

    def test_lost_messages_do_not_abort_header(self, session: Session) -> None:
        """A lost message delays the header by 50 ms; one loss in twenty does not count as a long round trip."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        for number in range(410):
            session.receive(acked=True, begins=number == 0)
            session.now += 0.054 if number % 20 == 1 else 0.004
        assert session.client.status.state == "header"

    def test_header_with_only_retransmissions_stalls(self, session: Session) -> None:
        """If only retransmissions arrive until PX4 silently gives up after 2.5 s, the header has stalled."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.header(10)
        for _ in range(50):
            session.receive(acked=True, sequence=9)
            session.now += 0.05
        session.wait(1)
        assert session.states[-1] == ("ended", "stalled")
        session.wait(TIMINGS.log_slow_retry - 10)
        assert session.commands == ["start"]
        session.wait(20)
        assert session.commands[:2] == ["start", "start"]

    def test_header_of_slow_stream_completes_on_rejected_start(self, session: Session) -> None:
        """With few slow topics no data follows for seconds; the rejection of START proves that the stream exists."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.header()
        session.wait(1.5)
        assert session.commands == ["start", "start"]
        session.answer(START, REJECTED)
        assert session.client.status == ("streaming", None, "")
        assert session.client.header_seconds == pytest.approx(273 * 0.004)

    def test_silent_header_stalls(self, session: Session) -> None:
        """Without retransmissions and without an answer to START the header is considered stalled."""
        session.wait(0.1)
        session.answer(START, ACCEPTED)
        session.header(10)
        session.wait(10)
        assert session.states[-1] == ("ended", "stalled")


class TestSilence:
    """PX4 does not announce the end of a stream; its answer to START shows whether the stream still exists."""

    def test_slow_stream_continues(self, session: Session) -> None:
        """If a topic at 1 Hz fills a message only every 5 s, START is rarely sent, and the stream continues."""
        session.start()
        for _ in range(40):
            session.wait(5)
            session.answer(START, REJECTED)
            session.receive()
        assert session.states[-1] == ("streaming", None)
        assert session.commands.count("start") < 30
        assert "stop" not in session.commands

    def test_ended_stream_restarts_within_seconds(self, session: Session) -> None:
        """START is sent after 1 s without data; if PX4 accepts it, a new stream begins with sequence number 0."""
        session.start()
        session.wait(1.2)
        session.answer(START, ACCEPTED)
        assert session.states[-1] == ("starting", "silent")
        session.header()
        session.stream()
        assert session.states[-3:] == [
            ("starting", "silent"),
            ("header", None),
            ("streaming", None),
        ]

    def test_stream_ends_without_data_and_start_reply(self, session: Session) -> None:
        """Without data and without a reply to START, the stream has ended; START is retried later."""
        session.start()
        session.wait(10)
        assert session.states[-1] == ("ended", "silent")
        session.wait(TIMINGS.log_retry)
        session.answer(START, ACCEPTED)
        session.header()
        assert session.client.status.state == "header"

    def test_longest_silence_means_another_client_owns_stream(self, session: Session) -> None:
        """If PX4 rejects START for 15 s without sending data, another client owns the stream."""
        session.start()
        for _ in range(18):
            session.wait(1)
            session.answer(START, REJECTED)
        assert session.states[-1] == ("refused", "taken")
        assert "stop" not in session.commands

    def test_silence_in_flight_sends_no_start(self, session: Session) -> None:
        """START could begin a header in flight, so it is not sent: silence ends the stream, and new data resumes it."""
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

    def test_rejected_start_after_disarming_resumes_stream(self, session: Session) -> None:
        """PX4 rejects START after disarming if the stream still exists: the state is "streaming" again."""
        session.start()
        session.armed = True
        session.wait(20)
        session.armed = False
        session.wait(0.1)
        session.answer(START, REJECTED)
        assert session.states[-1] == ("streaming", None)

    @pytest.mark.parametrize("seconds", [4.0, 60.0, 600.0])
    def test_stream_resumes_after_link_outage(self, session: Session, seconds: float) -> None:
        """PX4 keeps streaming during an outage, so the client sends no START, and the stream resumes with the link."""
        session.start()
        session.wait(seconds, heartbeats=False)
        assert session.states[-1] == ("ended", "link_lost")
        session.wait(0.1)
        session.stream(5)
        assert session.states[-2:] == [("ended", "link_lost"), ("streaming", None)]
        assert session.commands == ["start"]

    def test_stream_that_ended_during_outage_restarts(self, session: Session) -> None:
        """If PX4 ended the stream during an outage, for lack of acknowledgements, it accepts START."""
        session.start()
        session.wait(20, heartbeats=False)
        session.wait(1.3)
        session.answer(START, ACCEPTED)
        session.header()
        assert session.states[-2:] == [("starting", "silent"), ("header", None)]


def test_reboot_triggers_new_start(session: Session) -> None:
    """A reboot ends the stream; START follows the next heartbeat."""
    session.start()
    session.client.on_reboot()
    session.add([])
    assert not session.client.accepts(*OURS)
    session.start()
    assert session.commands == ["start", "start"]
    assert session.states[-4:] == [
        ("idle", None),
        ("starting", None),
        ("header", None),
        ("streaming", None),
    ]


def test_unannounced_new_stream_is_accepted(session: Session) -> None:
    """Sequence number 0 with ULog's magic bytes begins a new stream at any time."""
    session.start()
    session.header()
    session.stream()
    assert session.states[-3:] == [("streaming", None), ("header", None), ("streaming", None)]
    assert session.commands == ["start"]


class TestStop:
    """`stop` ends only the client's own stream."""

    def test_stop_is_repeated_until_accepted(self, session: Session) -> None:
        """STOP is repeated after 1 s; the last messages are acknowledged until PX4 accepts STOP."""
        session.start()
        session.add(session.client.stop(session.now))
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

    def test_unanswered_stop_times_out(self, session: Session) -> None:
        """If the vehicle does not answer, STOP is sent three times; then the state is "stopped"."""
        session.start()
        session.add(session.client.stop(session.now))
        session.wait(3.5)
        assert session.commands == ["start", "stop", "stop", "stop"]
        assert session.client.status.state == "stopped"

    @pytest.mark.parametrize("result", [ACCEPTED, REJECTED, None])
    def test_stop_waits_for_pending_start(self, session: Session, result: int | None) -> None:
        """The stream may be another client's, so STOP is sent only if the pending START is accepted."""
        session.wait(0.1)
        session.add(session.client.stop(session.now))
        assert session.client.status.state == "stopping"
        session.wait(0.5)
        if result is None:
            session.wait(1)
        else:
            session.answer(START, result)
        assert session.commands == (["start", "stop"] if result == ACCEPTED else ["start"])
        assert session.client.status.state == ("stopping" if result == ACCEPTED else "stopped")

    def test_stop_before_any_start_sends_nothing(self, session: Session) -> None:
        session.add(session.client.stop(session.now))
        session.wait(10)
        assert (session.sent, session.client.status.state) == ([], "stopped")


@cache
def recorded(name: str) -> list[tuple[float, bool, bytes]]:
    """Return the datagrams of a session, with the time since the first one."""
    found = [*datagrams(STREAMS / f"ulog_stream_{name}.bin.gz")]
    return [(when - found[0][0], is_sent, frame) for when, is_sent, frame in found]


class Replay:
    """Replay part of a recorded session to a client, and collect the recorded client's acknowledgements."""

    def __init__(
        self, name: str, begin: float, end: float, ids: tuple[int, int], *log: Log
    ) -> None:
        self.client = LogStreamClient({"1", *log}, system=ids[0], component=ids[1])
        self.reassembly = CountingReassembly()
        self.states: list[StateAndReason] = [("idle", None)]
        self.acknowledged: list[int] = []
        self.recorded: list[int] = []
        self._boot, last = 0, begin
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        for now, is_sent, frame in recorded(name):
            if begin <= now < end:
                while last + 0.1 < now:
                    last += 0.1
                    self._add(self.client.tick(last))
                for message in parser.parse_buffer(frame) or []:
                    if is_sent and message.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1:
                        self._add([*self._handle(message, now), *self.client.tick(now)])
                    elif not is_sent and message.get_type() == "LOGGING_ACK":
                        self.recorded.append(message.sequence)

    def _add(self, commands: list[Command]) -> None:
        self.acknowledged += [each.sequence for each in commands if each.kind == "acknowledge"]
        for each in commands:
            if each.kind == "ping":
                self._add(self.client.on_timesync(each.sequence, each.sequence / 1e9 + 0.001))
        if self.client.status[:2] != self.states[-1]:
            self.states.append(self.client.status[:2])

    def _handle(self, message: Any, now: float) -> Iterator[Command]:
        client, kind = self.client, message.get_type()
        if kind == "HEARTBEAT":
            yield from client.on_heartbeat(
                message.autopilot, now, armed=bool(message.base_mode & 128)
            )
        elif kind == "COMMAND_ACK":
            ids = message.target_system, message.target_component
            yield from client.on_command_ack(message.command, message.result, *ids, now)
        elif kind.startswith("LOGGING_DATA"):
            if client.accepts(message.target_system, message.target_component):
                fields = (
                    message.sequence,
                    message.length,
                    message.first_message_offset,
                    message.data,
                )
                begins = self.reassembly.add(*fields).begins
                yield from client.on_data(
                    message.sequence, now, acked=kind.endswith("ACKED"), begins=begins
                )
        elif (ms := getattr(message, "time_boot_ms", None)) is not None:
            if ms < self._boot - 1000:
                client.on_reboot()
                self._add([])
            self._boot = ms


@pytest.mark.logs
@pytest.mark.skipif(
    not STREAMS.exists(), reason=f"no recordings of a PX4's ULog stream: {STREAMS} does not exist"
)
class TestRecordedSessions:
    """Replays of recorded sessions of a real PX4 with two clients."""

    STARTED: Final[list[StateAndReason]] = [
        ("starting", None),
        ("header", None),
        ("streaming", None),
    ]

    @pytest.mark.slow
    def test_acknowledgements_match_recorded_client(self) -> None:
        """The acknowledgements equal the recording's, in order, including late topics and messages after STOP."""
        replay = Replay("flight1", 0, 90, (245, 190))
        assert replay.acknowledged == replay.recorded
        assert len(replay.acknowledged) == 320
        assert replay.states[1:] == [*self.STARTED, ("ended", "stopped_elsewhere")]
        assert replay.client.header_seconds == pytest.approx(1.1, abs=0.01)

    @pytest.mark.slow
    def test_second_start_is_rejected_and_foreign_stop_is_detected(self) -> None:
        """A second START and one by another client are rejected; then the other client sends STOP."""
        replay = Replay("session", 4.0, 15.0, (245, 190))
        assert replay.states[1:] == [*self.STARTED, ("ended", "stopped_elsewhere")]
        assert replay.acknowledged == replay.recorded

    @pytest.mark.slow
    def test_stream_continues_after_client_pauses_reading(self) -> None:
        """Reading pauses of 5 s and 12 s lose 615 and 3,433 messages, and the stream continues."""
        replay = Replay("session", 26.2, 52.0, (245, 190))
        outage: list[StateAndReason] = [("ended", "link_lost"), ("streaming", None)]
        assert replay.states[1:] == [*self.STARTED, *outage, *outage]
        assert replay.reassembly.lost == 615 + 3433

    def test_unacknowledged_header_stalls(self) -> None:
        """The recorded client sent no acknowledgement: PX4 sent the first message 50 times and gave up."""
        replay = Replay("session", 65.95, 72.0, (247, 190))
        assert replay.states[1:] == [("starting", None), ("header", None), ("ended", "stalled")]
        assert replay.reassembly.counts == {"delivered": 1, "duplicate": 49}

    @pytest.mark.slow
    def test_unacknowledged_late_topic_ends_stream_in_flight(self) -> None:
        """The recorded client stopped acknowledging: the stream ends silently, and does not restart in flight."""
        replay = Replay("session", 70.0, 82.9, (247, 190))
        assert replay.states[1:] == [*self.STARTED, ("ended", "silent")]

    @pytest.mark.slow
    def test_restarted_vehicle_begins_new_stream(self) -> None:
        """After the vehicle restarts, time_boot_ms is near 0 again, and a new header follows START."""
        replay = Replay("session", 95.0, 110.5, (247, 190))
        assert replay.states[1:] == [*self.STARTED, ("idle", None), *self.STARTED]

    def test_second_client_receives_no_data(self) -> None:
        """On the other link START is rejected, and no data arrives."""
        replay = Replay("session_second", 9.5, 12.0, (246, 191))
        assert replay.states[1:] == [("starting", None), ("refused", "taken")]
        assert replay.acknowledged == []
