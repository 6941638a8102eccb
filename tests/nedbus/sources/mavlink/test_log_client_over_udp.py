"""State machine and reassembly over UDP, against a peer that plays recordings of a PX4 (SITL)."""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any, Final

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.mavlink.log_client import Command, LogStreamClient
from nedbus.timings import Timings
from tests.peers.px4_log_stream import START, STOP, STREAMS, Px4LogStream, Recording, read_recording
from tests.waits import DEADLINE

from .test_log_client import OTHERS, OURS, Log, StateAndReason
from .test_log_reassembly import CountingReassembly

STARTED: Final[list[StateAndReason]] = [("starting", None), ("header", None), ("streaming", None)]

pytestmark = [
    pytest.mark.logs,
    pytest.mark.skipif(
        not STREAMS.exists(),
        reason=f"no recordings of a PX4's ULog stream: {STREAMS} does not exist",
    ),
]

recording = cache(lambda name: read_recording(STREAMS / f"ulog_stream_{name}.bin.gz"))


def recorded_bytes(name: str) -> int:
    """Return the length of the ULog in a recording."""
    found: Recording = recording(name)
    plain = [each.content for each in found.entries if not isinstance(each.content, bytes)]
    return sum(len(each.data) for each in (*found.header, *plain, *found.tail))


class Link:
    """A client on a UDP port; counts what it receives, and collects each state with its reason."""

    def __init__(
        self,
        *log: Log,
        acknowledges: bool = True,
        header: float | None = None,
        ids: tuple[int, int] = OURS,
    ) -> None:
        self.client = LogStreamClient({"1", *log}, system=ids[0], component=ids[1], header=header)
        self.reassembly = CountingReassembly()
        self.states: list[StateAndReason] = [("idle", None)]
        self.bytes = self.rejected = 0
        self.peer: Px4LogStream
        self._acknowledges = acknowledges
        self._mav = dialect.MAVLink(None, *ids)
        self.sent: list[str] = []  # kinds of commands
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        self._vehicle: Any = None  # address of the vehicle
        self._boot = 0

    @property
    def port(self) -> int:
        """The port of this link."""
        return int(self._socket.getsockname()[1])

    @contextmanager
    def play(self, name: str, **options: Any) -> Iterator[Link]:
        """Start a vehicle that plays a recording."""
        with self._socket, Px4LogStream(recording(name), self.port, **options) as self.peer:
            yield self

    def run(self, until: Callable[[], object]) -> None:
        """Receive until a condition holds."""
        end = time.monotonic() + DEADLINE
        while not until():
            assert time.monotonic() < end, self.states
            self.step()

    def step(self) -> None:
        """Receive a message, or wait for 50 ms."""
        client, commands = self.client, list[Command]()
        with suppress(TimeoutError):
            frame, self._vehicle = self._socket.recvfrom(2048)
            for message in self._mav.parse_buffer(frame) or []:
                commands += self._handle(message, time.monotonic())
        self._send(commands + client.tick(time.monotonic()))
        if client.status[:2] != self.states[-1]:
            self.states.append(client.status[:2])

    def expect_states(self, *states: StateAndReason) -> None:
        """Receive until the state has changed as often as expected, and compare the changes."""
        self.run(lambda: len(self.states) > len(states))
        assert self.states[1:] == [*states]

    def stop(self) -> None:
        """Play the recording to its end, and stop the stream."""
        self.run(self.peer.finished.is_set)
        self._send(self.client.stop(time.monotonic()))
        self.run(lambda: self.client.status.state == "stopped")

    def _send(self, commands: list[Command]) -> None:
        self.sent += [each.kind for each in commands if each.kind in ("start", "stop")]
        for kind, sequence in commands:
            message: Any = dialect.MAVLink_logging_ack_message(1, 1, sequence)
            if kind == "ping":
                message = dialect.MAVLink_timesync_message(0, sequence)
            elif kind != "acknowledge":
                message = dialect.MAVLink_command_long_message(
                    1, 1, START if kind == "start" else STOP, *(0,) * 8
                )
            if self._acknowledges or kind != "acknowledge":
                self._socket.sendto(message.pack(self._mav), self._vehicle)

    def _handle(self, message: Any, now: float) -> list[Command]:
        client, kind = self.client, message.get_type()
        if kind == "HEARTBEAT" and message.get_srcComponent() == dialect.MAV_COMP_ID_AUTOPILOT1:
            return client.on_heartbeat(message.autopilot, now, armed=bool(message.base_mode & 128))
        if kind == "COMMAND_ACK":
            ids = message.target_system, message.target_component
            return client.on_command_ack(message.command, message.result, *ids, now)
        if kind == "TIMESYNC":
            return client.on_timesync(message.ts1, now)
        if kind.startswith("LOGGING_DATA"):
            if not client.accepts(message.target_system, message.target_component):
                self.rejected += 1
                return []
            fields = message.sequence, message.length, message.first_message_offset, message.data
            chunk = self.reassembly.add(*fields)
            return client.on_data(
                message.sequence, now, acked=kind.endswith("ACKED"), begins=chunk.begins
            )
        if (ms := getattr(message, "time_boot_ms", None)) is not None:
            if ms < self._boot - 1000:
                client.on_reboot()
            self._boot = ms
        return []


@pytest.mark.slow
def test_recorded_stream_arrives_completely() -> None:
    """At full speed all bytes of the recording arrive; only the 11 messages missing in the recording count as lost."""
    with Link("armed").play("default_topics", speed=None) as link:
        link.stop()
    assert link.states[1:] == [*STARTED, ("stopping", None), ("stopped", None)]
    assert link.peer.commands == [START, STOP]
    # Duplicates are not checked: on a busy machine acknowledgements are late, and the peer repeats messages.
    assert link.reassembly.lost == 11
    assert link.reassembly.bytes + link.reassembly.skipped == recorded_bytes("default_topics")


@pytest.mark.long
@pytest.mark.parametrize(
    "impairment",
    [
        {"loss": 0.03},
        {"loss": 0.05},
        {"loss": 0.05, "burst": 20},
        {"reorder": 0.02},
        {"loss": 0.03, "reorder": 0.02},
    ],
)
def test_loss_count_equals_dropped_and_late_messages(impairment: dict[str, float]) -> None:
    """Exactly the dropped and late messages count as lost; acknowledged messages always arrive."""
    with Link("armed").play("flight1", speed=None, seed=7, **impairment) as link:
        link.stop()
    assert link.states[1:] == [*STARTED, ("stopping", None), ("stopped", None)]
    assert link.reassembly.lost == link.peer.dropped + link.peer.late
    assert link.peer.dropped + link.peer.late > 0


@pytest.mark.slow
def test_denied_start_is_reported() -> None:
    """A START that PX4 denies because the link is too slow is reported as a lack of bandwidth."""
    with Link().play("default_topics", refusal=dialect.MAV_RESULT_DENIED) as link:
        link.expect_states(("starting", None), ("refused", "bandwidth"))


@pytest.mark.slow
def test_stream_of_another_client_is_rejected() -> None:
    """Another client's data is rejected even if it arrives on the same link."""
    with Link().play("default_topics", owner=OTHERS, is_owner_on_link=True) as link:
        link.run(lambda: link.rejected > 20)
    assert link.states[1:] == [("starting", None), ("refused", "taken")]
    assert set(link.peer.commands) == {START}


@pytest.mark.slow
class TestAbnormalStreams:
    """Streams with failures, in real time."""

    def test_unacknowledged_message_stalls_stream(self) -> None:
        """PX4 sends an unacknowledged message 50 times, then nothing more, and the stream is reported as stalled."""
        with Link(acknowledges=False).play("flight1") as link:
            link.expect_states(("starting", None), ("header", None), ("ended", "stalled"))
            # the last duplicates may arrive later
            link.run(lambda: link.reassembly.counts["duplicate"] == 49)
        assert link.reassembly.counts == {"delivered": 1, "duplicate": 49}

    def test_start_without_data_is_repeated(self) -> None:
        """A logger that sends no data after START gives up after 2.5 s, and accepts the next START."""
        with Link().play("flight1", unsent=1) as link:
            link.expect_states(*STARTED)
        assert [each for each in link.peer.commands if each == START] == [START, START]

    def test_stream_of_earlier_process_is_restarted(self) -> None:
        """The stream of an earlier process, with the same ids, arrives without definitions, and is restarted."""
        with Link().play("flight1", owner=OURS, is_owner_on_link=True) as link:
            link.expect_states(("starting", None), ("refused", "taken"), *STARTED)
        assert link.reassembly.counts["no_definitions"]

    def test_stop_by_another_client_is_detected(self) -> None:
        """After a STOP by another client the last messages are acknowledged; the stream is not restarted at once."""
        with Link("armed").play("flight1") as link:
            link.expect_states(*STARTED)
            link.peer.trigger("foreign_stop")
            link.expect_states(*STARTED, ("ended", "stopped_elsewhere"))
        assert link.reassembly.lost == 0

    def test_reboot_triggers_new_stream(self) -> None:
        """After a reboot the header arrives again, with another start time, followed by the same data."""
        with Link("armed").play("flight1") as link:
            link.expect_states(*STARTED)
            link.peer.trigger("reboot")
            link.expect_states(*STARTED, ("idle", None), *STARTED)
        assert (link.peer.streams, link.reassembly.lost) == (2, 0)

    def test_stream_survives_link_outage(self) -> None:
        """The stream continues after an outage of some seconds; the messages sent meanwhile are counted as lost."""
        with Link("armed", header=100).play("flight1") as link:
            link.expect_states(*STARTED)
            link.peer.trigger("vanish")
            link.expect_states(*STARTED, ("ended", "link_lost"))
            link.peer.trigger("return")
            link.run(lambda: link.reassembly.lost)
        assert link.states[-1] == ("streaming", None)
        assert link.peer.commands == [START]

    @pytest.mark.parametrize("round_trip", [0.044, 0.08])
    def test_long_round_trip_prevents_start(self, round_trip: float) -> None:
        """With a round trip of 40 ms or more no START is sent, because the header would block the logger for 17 s."""
        with Link().play("flight1", round_trip=round_trip) as link:
            link.expect_states(("starting", None), ("refused", "slow_link"))
            measured = re.search(r"at (\d+) ms for each", link.client.status.text)
            assert measured
            assert int(measured[1]) >= 1000 * round_trip
        assert START not in link.peer.commands

    def test_longer_header_is_received_if_allowed(self) -> None:
        """With header=100 a header of 274 messages arrives at 44 ms for each."""
        with Link(header=100).play("flight1", round_trip=0.044) as link:
            link.expect_states(*STARTED)
            assert link.client.header_seconds
            assert link.client.header_seconds > 273 * 0.044

    def test_stream_of_a_client_on_another_link_is_left_alone(self, timings: Timings) -> None:
        """A client does not end the stream of another client, even after a ground station's STOP.

        PX4 then accepts the START of either client, but sends the data to the client that had the stream before.
        """
        # the client without the stream is the first to send START after STOP
        timings.log_retry = 1.0
        first, other = Link("armed"), Link("armed", ids=OTHERS)
        for each in (first, other):
            each._socket.settimeout(0.001)  # they take turns
        with other._socket, first.play("flight1", second_port=other.port) as link:
            link.expect_states(*STARTED)

            def both_until(condition: Callable[[], object]) -> None:
                end = time.monotonic() + DEADLINE
                while not condition():
                    assert time.monotonic() < end, (first.states, other.states)
                    first.step()
                    other.step()

            both_until(lambda: other.states[-1] == ("refused", "taken"))
            timings.log_retry = DEADLINE  # from now on for the client that had the stream
            link.peer.trigger("foreign_stop")
            both_until(lambda: link.peer.streams == 2 and first.states[-1] == ("streaming", None))
            timings.log_retry = 1.0
            starts, received = len(other.sent), first.reassembly.bytes
            both_until(lambda: len(other.sent) > starts + 3 and first.reassembly.bytes > received)
        assert "stop" not in other.sent
        assert other.states[-1] == ("refused", "taken")
        assert other.reassembly.bytes == 0
        assert set(first.states[4:]) <= {
            ("ended", "stopped_elsewhere"),
            ("header", None),
            ("streaming", None),
        }
        assert first.sent == ["start"]
        assert STOP not in link.peer.commands
