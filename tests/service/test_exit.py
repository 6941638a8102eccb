"""Scripts that end badly: a process that uses nedbus is gone soon, whatever it forgot."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator

import pytest

import nedbus
from tests.conftest import Start, message, wait_for

LIMIT = 9.0  # s from the end of the script, when it said so: Zenoh needs 10 s where it is stuck, and the promise is 2 s

PREAMBLE = """
import sys, threading, time
import nedbus
bus = nedbus.connect()
publisher = bus.publisher("vehicle_local_position", vehicle="mine")
publisher.publish({"timestamp": 1})
subscription = bus.subscribe("vehicle_local_position", vehicle="1", mode=MODE)
subscription.receive()
"""

ENDS = {
    "forgets": 'print("end", flush=True)',
    "raises": 'print("end", flush=True); raise RuntimeError("on purpose")',
    "exits": 'print("end", flush=True); sys.exit(3)',
    "never reads": 'time.sleep(1.0); print("end", flush=True)',
    "reads in a thread": """
threading.Thread(target=lambda: [None for _ in subscription], daemon=True).start()
print("end", flush=True)""",
    "has a pump": 'subscription.receive(5.0); print("end", flush=True)',
    "asks and forgets": 'bus.latest("*"); bus.vehicles(); print("end", flush=True)',
}
CODES = {"raises": 1, "exits": 3}

ASYNC = """
import asyncio, sys
import nedbus
async def main():
    bus = nedbus.connect_async()
    await bus.__aenter__()
    subscription = bus.subscribe("*", vehicle="1", mode=MODE)
    await subscription.receive()
    print("end", flush=True)
    RAISE
asyncio.run(main())
"""


@pytest.fixture
def flood(endpoint: str) -> Iterator[str]:
    """Publish all the time, so that every queue of a script that does not read is full."""
    stop = threading.Event()
    with nedbus.connect(endpoint) as bus:
        publisher = bus.publisher("vehicle_local_position", vehicle="1")

        def publish() -> None:
            sent = message(1)
            while not stop.wait(0.001):
                for _ in range(20):
                    publisher.publish(sent)

        thread = threading.Thread(target=publish)
        thread.start()
        yield endpoint
        stop.set()
        thread.join()


def assert_gone(process_start: Start, code: str, endpoint: str, expected: int) -> None:
    process = process_start("-c", code, NEDBUS_CONNECT=endpoint, measured=False)
    wait_for(lambda: "end" in process.out, what=f"the script to reach its end: {process.err}")
    ended = time.monotonic()
    assert process.wait() == expected, process.err
    assert time.monotonic() - ended < LIMIT
    assert "Traceback" not in process.err or "on purpose" in process.err
    assert "panicked" not in process.err
    assert "FATAL" not in process.err


@pytest.mark.parametrize("mode", ["latest", "every"])
@pytest.mark.parametrize("end", ENDS)
def test_script_without_close_is_gone(start: Start, flood: str, end: str, mode: str) -> None:
    """A bus that is never closed does not keep the process, whatever its queues hold."""
    assert_gone(start, PREAMBLE.replace("MODE", repr(mode)) + ENDS[end], flood, CODES.get(end, 0))


@pytest.mark.parametrize("mode", ["latest", "every"])
@pytest.mark.parametrize("raises", ["pass", 'raise RuntimeError("on purpose")'])
def test_async_script_without_close_is_gone(start: Start, flood: str, raises: str, mode: str) -> None:
    """The same for asyncio."""
    assert_gone(start, ASYNC.replace("MODE", repr(mode)).replace("RAISE", raises), flood, int(raises != "pass"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("vehicle", ["1", "silent"])
@pytest.mark.parametrize("mode", ["latest", "every"])
def test_signal_ends_a_reading_script(
    start: Start, flood: str, number: signal.Signals, vehicle: str, mode: str
) -> None:
    """Ctrl-C and SIGTERM end a loop over samples, while they come and while none comes."""
    code = f"""
import nedbus
bus = nedbus.connect()
subscription = bus.subscribe("*", vehicle={vehicle!r}, mode={mode!r})
print("ready", flush=True)
for sample in subscription:
    pass
"""
    process = start("-c", code, NEDBUS_CONNECT=flood, measured=False)
    wait_for(lambda: "ready" in process.out, what=f"the script: {process.err}")
    process.signal(number)
    signalled = time.monotonic()
    assert process.wait() == -number
    assert time.monotonic() - signalled < LIMIT


WAITS = {
    "connect": """
print("ready", flush=True)
nedbus.connect("tcp/127.0.0.1:1", timeout=TIMEOUT)""",
    "connect_async": """
async def main():
    print("ready", flush=True)
    async with nedbus.connect_async("tcp/127.0.0.1:1", timeout=TIMEOUT):
        pass
asyncio.run(main())""",
}


@pytest.mark.parametrize("timeout", [600, None])
@pytest.mark.parametrize("how", WAITS)
def test_signal_ends_a_script_that_waits_for_a_router(start: Start, how: str, timeout: float | None) -> None:
    """Ctrl-C ends the wait for a router that is not there."""
    code = "import asyncio, nedbus; nedbus.connect"
    process = start("-c", code + WAITS[how].replace("TIMEOUT", repr(timeout)), measured=False)
    wait_for(lambda: "ready" in process.out, what="the script")
    process.signal(signal.SIGINT)
    assert process.wait() == -signal.SIGINT, process.err


def test_vehicle_of_a_killed_script_is_gone(start: Start, endpoint: str, bus: nedbus.Bus) -> None:
    """SIGKILL closes nothing, and still the vehicle disappears from the list."""
    code = """
import nedbus, time
bus = nedbus.connect()
bus.publisher("vehicle_local_position", vehicle="mine").publish({"timestamp": 1})
time.sleep(600)
"""
    process = start("-c", code, NEDBUS_CONNECT=endpoint, measured=False)
    wait_for(lambda: "mine" in bus.vehicles(), what="the vehicle")
    process.kill()
    wait_for(lambda: "mine" not in bus.vehicles(), what="the vehicle to go")


def test_closing_waits_for_threads_that_are_inside_zenoh(bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that comes back from there while the interpreter ends aborts the process: 'FATAL: exception not rethrown'."""
    joined: list[str] = []
    join = threading.Thread.join

    def note(thread: threading.Thread, timeout: float | None = None) -> None:
        joined.append(thread.name)
        join(thread, timeout)

    monkeypatch.setattr(threading.Thread, "join", note)
    publisher = bus.publisher("vehicle_local_position", vehicle="0")
    before = set(threading.enumerate())
    subscriptions = [bus.subscribe(vehicle=str(number), mode="every") for number in range(20)]
    reader = threading.Thread(target=lambda: list(subscriptions[0]))
    reader.start()

    def is_inside() -> bool:
        publisher.publish(message(1))
        return subscriptions[0]._subscriber._reader_waits

    wait_for(is_inside, what="the reader to be inside Zenoh")
    for subscription in subscriptions:
        subscription.close()
    assert not subscriptions[0]._subscriber._reader_waits
    assert set(threading.enumerate()) - before <= {reader}
    assert {"nedbus-pump", "nedbus-ack", "nedbus-recovery"} <= set(joined)
    reader.join()


def test_publisher_ends_amid_a_flood_of_queries(start: Start, endpoint: str) -> None:
    """Its schema is asked for more often than it can answer: what is being answered at its end does not abort it."""
    code = """
import time, nedbus
bus = nedbus.connect()
publishers = [bus.publisher("vehicle_local_position", vehicle=str(number)) for number in range(2)]
for publisher in publishers:
    publisher.publish({"timestamp": 1})
print("ready", flush=True)
time.sleep(0.5)
"""
    flood = """
import time, nedbus, zenoh
bus = nedbus.connect()
while True:
    for _ in range(50):
        bus._session.get("nedbus/@schema/VehicleLocalPosition", zenoh.handlers.RingChannel(1), timeout=1.0)
    time.sleep(0.002)
"""
    for _ in range(2):
        start("-c", flood, NEDBUS_CONNECT=endpoint, measured=False)
    for _ in range(6):
        process = start("-c", code, NEDBUS_CONNECT=endpoint, measured=False)
        assert process.wait() == 0, process.err
