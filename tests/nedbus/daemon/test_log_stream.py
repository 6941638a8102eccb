"""The ULog stream of PX4 in a service: messages, status, metrics and the saved log, and a refused stream.

The simulated PX4 replays a stream recorded from PX4 in SITL (main of 2026-05-14).
"""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus.client import LogStreamStatus
from nedbus.recording import Flight
from nedbus.timings import Timings
from tests.peers.command_line import run_command
from tests.peers.custom_timings import start_with_timings
from tests.peers.http_client import HttpClient
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import Start
from tests.peers.px4_log_stream import SHORT, START, STOP, Px4LogStream, read_recording
from tests.waits import DEADLINE, wait_for


def log_stream(bus: nedbus.Bus) -> LogStreamStatus | None:
    """Return the status of the only log stream; None before it exists."""
    return next((log for each in bus.services() for source in each.sources for log in source.log_streams), None)


@pytest.mark.process
def test_log_stream_arrives_completely_in_another_process(start: Start, tmp_path: Path) -> None:
    """A subscriber receives the complete stream; `info`, /metrics and the saved log agree on the totals."""
    link, endpoint, pages = f"mavlink:udpin:127.0.0.1:{free_port()}", free_endpoint(), HttpClient(free_port())
    port = int(link.rpartition(":")[2])
    source = f"{link}?log=1&save={tmp_path}"
    slow = Timings(log_answer=DEADLINE, log_link=DEADLINE, log_header=10 * DEADLINE)  # tolerates a busy host
    service = start_with_timings(start, slow, "serve", "--listen", endpoint, "--http", pages.where, "--source", source)
    with (
        nedbus.connect(endpoint, timeout=DEADLINE) as bus,
        bus.subscribe(vehicle="1", mode="every") as positions,
        Px4LogStream(read_recording(SHORT), port) as peer,
    ):
        wait_for(peer.finished.is_set, what="the end of the recording")
        total = sum(len(each.data) for each in peer.recording.header) + sum(
            len(each.content.data) for each in peer.recording.entries if not isinstance(each.content, bytes)
        )
        wait_for(lambda: (log := log_stream(bus)) and log.received == total, what=f"the stream: {service.err}")
        status: Any = log_stream(bus)
        assert (status.state, status.gaps, status.lost, status.undecodable) == ("streaming", 0, 0, 0)
        assert status.header_time > 0.25  # one round trip of 4 ms for each of 125 messages
        info = run_command("info", "--connect", endpoint)
        assert "ULog stream of vehicle 1: streaming" in info.out, info.out
        wait_for(lambda: pages.values("nedbus_log_stream_bytes_total", vehicle="1") == [total], what="the metrics")
        assert pages.values("nedbus_log_stream_active", vehicle="1") == [1]
        assert pages.values("nedbus_log_stream_messages_lost_total", vehicle="1") == [0]
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
    with Flight(saved, topics=None) as flight:
        assert {address.topic for address in flight.addresses} >= {"vehicle_local_position", "event"}


@pytest.mark.process
def test_refused_log_stream_is_reported(run_nedbus: Start) -> None:
    """If another client has the stream, `info`, `doctor` and the log report it; positions come from MAVLink instead."""
    endpoint, port = free_endpoint(), free_port()
    service = run_nedbus("serve", "--listen", endpoint, "--source", f"mavlink:udpin:127.0.0.1:{port}?log=1")
    with (
        nedbus.connect(endpoint, timeout=DEADLINE) as bus,
        bus.subscribe(vehicle="1", mode="every") as positions,
        Px4LogStream(read_recording(SHORT), port, refusal=1),
    ):
        wait_for(lambda: (log := log_stream(bus)) and log.state == "refused", what=f"the refusal: {service.err}")
        info = run_command("info", "--connect", endpoint)
        assert "another client already receives it" in " ".join(info.out.split()), info.out
        doctor = run_command("doctor", "--connect", endpoint, "--json")
        findings = [each for each in json.loads(doctor.out)["findings"] if "no ULog stream" in each["seen"]]
        assert findings, doctor.out
        assert findings[0]["state"] == "warning"
        assert next(iter(positions)).source == "mavlink"
    assert "no ULog stream; PX4 rejected" in service.err
