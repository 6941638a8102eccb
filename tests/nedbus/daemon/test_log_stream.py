"""The ULog stream of PX4 in a service: messages, status, metrics and the saved log, and a refused stream.

The simulated PX4 replays a stream recorded from PX4 in SITL (main of 2026-05-14).
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from pyulog import ULog

import nedbus
from nedbus.client import LogStreamStatus
from nedbus.timings import Timings
from nedbus.ulog import Data, UlogParser
from tests.peers.command_line import run_command, run_until_shown
from tests.peers.custom_timings import start_with_timings
from tests.peers.http_client import HttpClient
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Process, Start
from tests.peers.px4_log_stream import (
    SHORT,
    START,
    STOP,
    STREAMS,
    Message,
    Px4LogStream,
    read_recording,
    stream_message,
)
from tests.waits import DEADLINE, wait_for

SLOW = Timings(log_answer=DEADLINE, log_link=DEADLINE, log_header=10 * DEADLINE, link_wait=DEADLINE)
"""Timings that tolerate a busy host."""


def log_stream(bus: nedbus.Bus) -> LogStreamStatus | None:
    """Return the status of the only log stream; None before it exists."""
    return next(
        (log for each in bus.services() for source in each.sources for log in source.log_streams),
        None,
    )


@pytest.mark.slow
@pytest.mark.process
def test_log_stream_arrives_completely_in_another_process(start: Start, tmp_path: Path) -> None:
    """A subscriber receives the complete stream; `info`, /metrics and the saved log agree on the totals."""
    link, endpoint, pages = (
        f"mavlink:udpin:127.0.0.1:{free_port()}",
        free_endpoint(),
        HttpClient(free_port()),
    )
    port = int(link.rpartition(":")[2])
    source = f"{link}?log=1&save={tmp_path}"
    service = start_with_timings(
        start, SLOW, "serve", "--listen", endpoint, "--http", pages.where, "--source", source
    )
    with (
        nedbus.connect(endpoint, timeout=DEADLINE) as bus,
        bus.subscribe(vehicle="1", mode="every") as positions,
        Px4LogStream(read_recording(SHORT), port) as peer,
    ):
        wait_for(peer.finished.is_set, what="the end of the recording")
        total = sum(len(each.data) for each in peer.recording.header) + sum(
            len(each.content.data)
            for each in peer.recording.entries
            if not isinstance(each.content, bytes)
        )
        wait_for(
            lambda: (log := log_stream(bus)) and log.received == total,
            what=f"the stream: {service.err}",
        )
        status: Any = log_stream(bus)
        assert (status.state, status.gaps, status.lost, status.undecodable) == (
            "streaming",
            0,
            0,
            0,
        )
        assert status.header_time > 0.25  # one round trip of 4 ms for each of 125 messages
        run_until_shown("ULog stream of vehicle 1: streaming", "info", "--connect", endpoint)
        wait_for(
            lambda: pages.values("nedbus_log_stream_bytes_total", vehicle="1") == [total],
            what="the metrics",
        )
        assert pages.values("nedbus_log_stream_active", vehicle="1") == [1]
        assert pages.values("nedbus_log_stream_messages_lost_total", vehicle="1") == [0]
        assert pages.values("nedbus_log_stream_unsaved_bytes_total", vehicle="1") == [0]
        sample = next(each for each in positions if each.source == "mavlink-ulog")
        assert sample.missing == frozenset()
        assert sample.message.delta_heading is not None
        (saved,) = tmp_path.glob("1_*.ulg")
        why = run_command("why", str(saved))  # while the file is being written
        assert why.exit_code in (0, 1), why.err
        assert "damaged" not in why.err
        service.signal(signal.SIGTERM)
        assert service.wait() == 0, service.err
        assert [each for each in peer.commands if each in (START, STOP)][-1] == STOP
    with nedbus.open(saved) as flight:
        assert {address.topic for address in flight.addresses} >= {
            "vehicle_local_position",
            "event",
        }


@pytest.mark.slow
@pytest.mark.process
def test_refused_log_stream_is_reported(run_nedbus: Start) -> None:
    """If another client has the stream, `info`, `doctor` and the log report it; positions come from MAVLink instead."""
    endpoint, port = free_endpoint(), free_port()
    service = run_nedbus(
        "serve", "--listen", endpoint, "--source", f"mavlink:udpin:127.0.0.1:{port}?log=1"
    )
    with (
        nedbus.connect(endpoint, timeout=DEADLINE) as bus,
        bus.subscribe(vehicle="1", mode="every") as positions,
        Px4LogStream(read_recording(SHORT), port, refusal=1),
    ):
        wait_for(
            lambda: (log := log_stream(bus)) and log.state == "refused",
            what=f"the refusal: {service.err}",
        )
        run_until_shown("another client already receives it", "info", "--connect", endpoint)
        doctor = run_until_shown("no ULog stream", "doctor", "--connect", endpoint, "--json")
        findings = [
            each for each in json.loads(doctor.out)["findings"] if "no ULog stream" in each["seen"]
        ]
        assert findings, doctor.out
        assert findings[0]["state"] == "warning"
        assert next(iter(positions)).source == "mavlink"
    assert "no ULog stream; PX4 rejected" in service.err


class Flight1:
    """A recorded flight that a service receives, and all messages of the stream that the vehicle has sent."""

    def __init__(self, start: Start, endpoint: str, options: str) -> None:
        self.port = free_port()
        self.sent: dict[int, Message] = {}  # by sequence
        self._source = f"mavlink:udpin:127.0.0.1:{self.port}?{options}"
        self._start, self._endpoint = start, endpoint
        flight = read_recording(STREAMS / "ulog_stream_flight1.bin.gz")
        self.peer = Px4LogStream(flight, self.port, on_send=self._on_send)

    def serve(self) -> Process:
        """Start a service that receives the stream."""
        options = "--connect", self._endpoint, "--source", self._source
        return start_with_timings(self._start, SLOW, "serve", *options)

    def kill_service_in_flight(self, positions: Iterable[nedbus.Sample[Any]]) -> None:
        """Start a service, and kill it once the stream has begun and the vehicle is armed."""
        service = self.serve()
        next(each for each in positions if each.source == "mavlink-ulog")
        wait_for(lambda: self.peer.is_armed, what="arming")
        service.signal(signal.SIGKILL)
        service.wait()

    def positions(self) -> dict[int, tuple[float, ...]]:
        """Return the positions that the vehicle has sent, by timestamp."""
        parser, found = UlogParser(verify=False), {}
        for record in parser.feed(b"".join(self.sent[each].data for each in sorted(self.sent))):
            if isinstance(record, Data) and record.subscription.name == "vehicle_local_position":
                fields: Any = record.subscription.layout.decode(record.payload)
                found[fields["timestamp"]] = tuple(
                    fields[name] for name in ("x", "y", "z", "vx", "vy", "vz")
                )
        return found

    def _on_send(self, frame: bytes) -> None:
        if message := stream_message(frame):
            self.sent[message.sequence] = message


recorded_flight = [
    pytest.mark.slow,
    pytest.mark.process,
    pytest.mark.logs,
    pytest.mark.skipif(
        not STREAMS.exists(),
        reason=f"no recordings of a PX4's ULog stream: {STREAMS} does not exist",
    ),
]


class TestRestartInFlight:
    """A service that is restarted while the vehicle is armed."""

    pytestmark = recorded_flight

    @pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
    def test_stream_continues(
        self, start: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path, number: signal.Signals
    ) -> None:
        """The next process continues the stream, and counts the gap; every message equals one that PX4 sent.

        The first message was sent at most 3 s after the process began to listen, by the vehicle's clock.
        """
        flight = Flight1(start, endpoint, f"log=1&save={tmp_path}/saved")
        with bus.subscribe(vehicle="1", mode="every") as positions, flight.peer:
            service = flight.serve()
            streamed = (each for each in positions if each.source == "mavlink-ulog")
            received = [next(streamed)]
            wait_for(lambda: flight.peer.is_armed, what="arming")
            received += islice(streamed, 100)
            service.signal(number)
            service.wait()
            restart = max(flight.positions())
            service = flight.serve()
            wait_for(lambda: ": listening" in service.err, what="the restarted service")
            ready = max(flight.positions())
            while (last := sum(each.message.timestamp <= restart for each in received)) > len(
                received
            ) - 200:
                received.append(next(streamed))
            wait_for(
                lambda: (log := log_stream(bus)) and log.gaps, what=f"the status: {service.err}"
            )
            status = log_stream(bus)
            assert status
            assert [each for each in flight.peer.commands if each in (START, STOP)] == [START]
            service.signal(signal.SIGKILL)
            service.wait()
        sent = flight.positions()
        for each in received:
            message = each.message
            values = message.x, message.y, message.z, message.vx, message.vy, message.vz
            assert values == pytest.approx(sent[message.timestamp], nan_ok=True, rel=0, abs=0)
        times = [each.message.timestamp for each in received]
        assert times == sorted(times)
        for part in (times[:last], times[last:]):
            assert part == [each for each in sorted(sent) if part[0] <= each <= part[-1]]
        assert times[last] - ready <= 3_000_000
        missing = sum(times[last - 1] < each < times[last] for each in sent)
        assert 0 < missing <= status.lost_messages
        assert (status.state, status.gaps, status.undecodable) == ("streaming", 1, 0)
        assert 0 < status.lost < len(flight.sent)
        assert "it continues the one of an earlier process" in service.err
        saved = [ULog(str(each)) for each in sorted((tmp_path / "saved").iterdir())]
        assert len(saved) == 2
        assert not any(each.file_corruption for each in saved)
        assert [len(each.dropouts) for each in saved] == [0, 1]

    def test_stream_without_saved_definitions_is_reported(
        self, start: Start, endpoint: str, bus: nedbus.Bus
    ) -> None:
        """Without the state file, the stream of a killed process is rejected with the remedy, and left alone."""
        flight = Flight1(start, endpoint, "log=1&state=0")
        with bus.subscribe(vehicle="1", mode="every") as positions, flight.peer:
            flight.kill_service_in_flight(positions)
            service = flight.serve()
            reason = "of an earlier process cannot be continued, because state=0 is set; it restarts after disarming"
            wait_for(lambda: reason in service.err, what="the reason")
            assert [each for each in flight.peer.commands if each in (START, STOP)] == [START]
            service.signal(signal.SIGKILL)
            service.wait()
        assert "or at once with log=armed" in service.err

    def test_stream_of_another_client_is_left_alone(
        self, start: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path
    ) -> None:
        """A stream that is addressed to other ids is not continued, although its definitions are known."""
        flight = Flight1(start, endpoint, f"log=armed&state={tmp_path}")
        with bus.subscribe(vehicle="1", mode="every") as positions, flight.peer:
            flight.kill_service_in_flight(positions)
            flight.peer.change_owner((255, 190))
            service = flight.serve()
            wait_for(
                lambda: "system 255 component 190 already receives it" in service.err,
                what="the owner",
            )
            assert set(flight.peer.commands) & {START, STOP} == {START}
            wait_for(lambda: (log := log_stream(bus)) and log.state == "refused", what="the status")
            log = log_stream(bus)
            assert log
            assert log.received == 0
            service.signal(signal.SIGTERM)
            service.wait()
            assert STOP not in flight.peer.commands
