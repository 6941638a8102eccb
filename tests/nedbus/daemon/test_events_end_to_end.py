"""Events end to end: `nedbus events`, the page and `health` report each event of six vehicles once and in order."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any, Final

import pytest
from playwright.sync_api import Browser

import nedbus
from nedbus.flights import RecordingWriter
from nedbus_msgs import BY_TOPIC, Address, Provenance
from nedbus_msgs.arrays import arrays_of
from tests.flights.messages import VALID, VLP
from tests.peers.browser import PAGE_TIMEOUT, browser, open_tabs
from tests.peers.command_line import run_command
from tests.peers.ports import free_port
from tests.peers.processes import Process, Start
from tests.waits import wait_for

__all__ = ["browser"]  # a fixture

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]

GPS: Final = "vehicle_gps_position"
VEHICLES: Final = ("alpha", "bravo", "charlie", "delta", "echo", "foxtrot")
SECONDS: Final = 150
RATE: Final = 10  # Hz

# Expected events of the recording: vehicle, kind and change.
EXPECTED: Final = [
    ("alpha", "gps_fix_lost", "begin"), ("alpha", "few_satellites", "begin"), ("alpha", "dead_reckoning", "begin"),
    ("alpha", "xy_invalid", "begin"), ("alpha", "v_xy_invalid", "begin"), ("alpha", "gps_fix_lost", "end"),
    ("alpha", "few_satellites", "end"), ("alpha", "xy_invalid", "end"), ("alpha", "v_xy_invalid", "end"),
    ("alpha", "dead_reckoning", "end"), ("bravo", "reset", "once"), ("charlie", "silent", "begin"),
    ("charlie", "silent", "end"), ("delta", "reboot", "once"), ("echo", "rejected", "begin"),
    ("echo", "rejected", "end"),
]  # fmt: skip
LINK_LOSS: Final = [("*", "link_down", "begin"), ("*", "link_down", "end")]
OVERLOAD: Final = [("*", "overload", "begin"), ("*", "overload", "end")]


def fields_at(vehicle: str, second: float) -> dict[str, object] | None:
    """Return the fields of a position message, None while the vehicle is silent."""
    fields: dict[str, object] = {**VALID, "x": 0.0, "y": 0.0}
    if vehicle == "alpha" and 4.0 <= second < 9.0:
        fields["dead_reckoning"] = True
        fields["xy_valid"] = fields["v_xy_valid"] = second < 5.0
    if vehicle == "bravo" and second >= 10.0:
        fields |= {"x": 3.1, "y": 0.4, "xy_reset_counter": 1, "delta_xy": (3.1, 0.4)}
    if vehicle == "charlie" and 11.0 <= second < 16.0:
        return None
    return fields


def write_recording(path: Path) -> None:
    """Write a recording with positions of all vehicles and GNSS messages of one, with scripted faults."""
    position, gps = BY_TOPIC[VLP], BY_TOPIC[GPS]
    start = 1_700_000_000_000_000_000
    with RecordingWriter(path) as writer:
        for number in range(SECONDS * RATE):
            second = number / RATE
            logged = [start + round(second * 1e9)]
            for vehicle in VEHICLES:
                # s after the start of the recording
                booted = 17.0 if vehicle == "delta" and second >= 17.0 else -100.0
                stamp = round((second - booted) * 1e6) + 1_000_000
                if vehicle == "alpha":
                    has_fix = not 3.0 <= second < 8.0
                    message = gps.model(
                        timestamp=stamp, fix_type=3 * has_fix, satellites_used=12 * has_fix
                    )
                    address = Address(vehicle, GPS)
                    writer.write(
                        arrays_of(gps).of([message]),
                        gps,
                        [(address, Provenance("sim"))],
                        logged=logged,
                        published=logged,
                    )
                fields = fields_at(vehicle, second)
                if fields is None:
                    continue
                array = arrays_of(position).of([position.model(timestamp=stamp, **fields)])
                if vehicle == "echo" and 19.0 <= second < 19.3:
                    array["x"] = float("nan")  # invalid, because xy_valid is true
                writer.write(
                    array,
                    position,
                    [(Address(vehicle, VLP), Provenance("sim"))],
                    logged=logged,
                    published=logged,
                )


def events_of(process: Process) -> list[tuple[str, str, str]]:
    events = [json.loads(line) for line in process.out.splitlines()]
    return [(event["vehicle"], event["kind"], event["change"]) for event in events]


def wait_for_event(process: Process, vehicle: str, kind: str, change: str) -> None:
    wait_for(
        lambda: (vehicle, kind, change) in events_of(process),
        what=f"{vehicle} {kind} {change}",
        seconds=PAGE_TIMEOUT,
    )


def freeze(process: Process, subscription: nedbus.Subscription[Any], messages: int) -> None:
    """Suspend a process while a vehicle sends this number of messages."""
    process.signal(signal.SIGSTOP)
    try:
        for _ in range(messages):
            subscription.receive(timeout=PAGE_TIMEOUT)
    finally:
        process.signal(signal.SIGCONT)


def test_each_event_is_reported_once_and_in_order(
    run_nedbus: Start, browser: Browser, tmp_path: Path
) -> None:
    """`nedbus events` and the page report each event of a replayed recording once and in order.

    One vehicle loses GPS, one resets its estimate, one is silent, one reboots, and one sends invalid messages. Then the
    router restarts, and both readers are frozen for a while.
    """
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    write_recording(tmp_path / "fleet.mcap")
    router = run_nedbus("router", "--listen", endpoint)
    wait_for(lambda: "router on" in router.err, what="the router")
    events = run_nedbus("events", "--connect", endpoint, "--json")
    web = run_nedbus("web", "--connect", endpoint, "--http", f"127.0.0.1:{port}")
    wait_for(lambda: "open http" in web.err, what="the page")
    with open_tabs(browser, allow_console_errors=True) as make:
        page = make(width=1280, height=800)
        page.open(f"http://127.0.0.1:{port}")
        run_nedbus("serve", "--connect", endpoint, "-s", f"mcap:{tmp_path / 'fleet.mcap'}")
        wait_for_event(events, *EXPECTED[-1])
        assert events_of(events) == EXPECTED
        story = json.loads(run_command("why", "-c", endpoint, "--vehicle", "alpha", "--json").out)
        assert story["faults"][0]["what"] == "xy and vxy not valid"
        assert [each["kind"] for each in story["verdict"]["cause"]] == [
            "gps_fix_lost",
            "few_satellites",
            "dead_reckoning",
        ]
        router.signal(signal.SIGTERM)
        router.wait()
        wait_for_event(events, *LINK_LOSS[0])
        router = run_nedbus("router", "--listen", endpoint)
        wait_for_event(events, *LINK_LOSS[1])
        with (
            nedbus.connect(endpoint, timeout=PAGE_TIMEOUT) as bus,
            bus.subscribe(vehicle="foxtrot", mode="every") as follow,
        ):
            follow.receive(timeout=PAGE_TIMEOUT)
            freeze(events, follow, 4 * RATE)
            freeze(web, follow, 4 * RATE)
            wait_for_event(events, *OVERLOAD[1])
        assert events_of(events) == [*EXPECTED, *LINK_LOSS, *OVERLOAD]
        shown = [each for each in (*EXPECTED, *LINK_LOSS, *OVERLOAD) if each[2] != "end"]
        wait_for(
            lambda: len(page.rows("vehicle")) >= len(shown),
            what="all events on the page",
            seconds=PAGE_TIMEOUT,
        )
        marks = sorted(page.rows("vehicle"), key=lambda mark: mark["time"])
        assert [mark["vehicle"] for mark in marks] == [vehicle for vehicle, *_ in shown]
    health = run_command(
        "health", "-c", endpoint, "--within", "300", "--expect", ",".join(VEHICLES)
    )
    assert health.exit_code == 1
    faults = [line.partition(": ")[2] for line in health.err.splitlines()]
    assert [fault.partition(":")[0].removeprefix("vehicle ") for fault in faults[:-1]] == [
        vehicle for vehicle, _, change in EXPECTED if change != "end"
    ]
    assert "no link to" in faults[-1]
