"""A service on a host that is too busy to read its MAVLink link: the overload in each command and page."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress

import pytest
from pymavlink.dialects.v20 import common as dialect

import nedbus
from tests.flights.messages import VLP
from tests.peers.command_line import run_command
from tests.peers.http_client import HttpClient
from tests.peers.live_source import source_status
from tests.peers.ports import free_port
from tests.peers.processes import Start
from tests.waits import wait_for


@pytest.mark.slow
@pytest.mark.process
def test_overload_is_reported(run_nedbus: Start, bus: nedbus.Bus, endpoint: str) -> None:
    """After 0.8 s in which the process did not run, each command and page reports an overload."""
    port, pages = free_port(), HttpClient(free_port())
    service = run_nedbus(
        "serve",
        "--connect",
        endpoint,
        "--http",
        pages.where,
        "-s",
        f"mavlink:udpin:127.0.0.1:{port}",
    )
    encoder = dialect.MAVLink(None, 9, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:

        def send() -> None:
            with suppress(ConnectionError):  # before the service listens
                message = dialect.MAVLink_local_position_ned_message(
                    round(time.monotonic() * 1e3) % 2**31, *range(6)
                )
                vehicle.sendto(message.pack(encoder), ("127.0.0.1", port))
            encoder.seq = (encoder.seq + 1) % 256

        def is_published() -> bool:
            send()
            return pages.values("nedbus_messages_published_total", topic=VLP) > [20]

        wait_for(is_published, what="positions")
        assert pages.request("/readyz")[0] == 200
        assert source_status(bus).overload == ""

        def stop_for_a_while() -> None:
            service.signal(signal.SIGSTOP)
            stopped, number = time.monotonic(), 0
            while time.monotonic() < stopped + 0.8:
                if time.monotonic() > stopped + number / 100:
                    send()
                    number += 1
            service.signal(signal.SIGCONT)

        def wait_for_report(is_reported: Callable[[], object], what: str) -> None:
            """Wait for a report of the overload, and cause it again while there is none: the report ends soon."""

            def is_done() -> bool:
                stop_for_a_while()
                wait_for(lambda: source_status(bus).overload, what="the overload")
                return bool(is_reported())

            wait_for(is_done, what=what)

        def shows(text: str, *arguments: str) -> bool:
            result = run_command(*arguments, "-c", endpoint)
            return text in result.out + result.err

        wait_for_report(
            lambda: "host overloaded: messages up to" in source_status(bus).overload, "the status"
        )
        wait_for_report(lambda: "host overloaded" in pages.request("/readyz")[1], "the readiness")
        wait_for_report(lambda: pages.values("nedbus_source_overloaded") == [1], "the metric")
        assert pages.values("nedbus_source_dropped_total") == [0]
        wait_for_report(lambda: shows("host overloaded", "info"), "`info`")
        wait_for_report(lambda: shows("host overloaded", "health"), "`health`")
        wait_for_report(lambda: shows("overloaded", "why"), "`why`")
