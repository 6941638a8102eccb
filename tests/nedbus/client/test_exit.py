"""Scripts without cleanup: a process that uses nedbus exits promptly, whatever it left open."""

from __future__ import annotations

import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress

import pytest

import nedbus
from tests.flights.messages import VLP, message
from tests.peers.processes import Start
from tests.waits import DEADLINE, Stopwatch, repeating, wait_for

# s that the main thread sleeps after its last line; a blocked close of Zenoh takes 10 s
LIMIT = 5.0

PREAMBLE = """
import sys, threading, time
import nedbus
bus = nedbus.connect()
publisher = bus.publisher("vehicle_local_position", vehicle="mine")
publisher.publish({"timestamp": 1})
subscription = bus.subscribe("vehicle_local_position", vehicle="1", mode=MODE)
subscription.receive()
"""

ASYNC = """
import asyncio
import nedbus
async def main():
    bus = nedbus.connect_async()
    await bus.__aenter__()
    subscription = bus.subscribe("*", vehicle="1", mode=MODE)
    await subscription.receive()
    print("end", flush=True)
    END
asyncio.run(main())
"""

END = 'print("end", flush=True)'
SCRIPTS = {
    "closes nothing": PREAMBLE + END,
    "raises": PREAMBLE + 'print("end", flush=True); raise RuntimeError("on purpose")',
    "exits": PREAMBLE + 'print("end", flush=True); sys.exit(3)',
    "never reads": PREAMBLE + "time.sleep(1.0); " + END,
    "reads in a thread": PREAMBLE
    + "threading.Thread(target=lambda: list(subscription), daemon=True).start(); "
    + END,
    "has a pump thread": PREAMBLE + "subscription.receive(5.0); " + END,
    "queries and closes nothing": PREAMBLE + 'bus.latest("*"); bus.vehicles(); ' + END,
    "async closes nothing": ASYNC.replace("END", "pass"),
    "async raises": ASYNC.replace("END", 'raise RuntimeError("on purpose")'),
}
CODES = {"raises": 1, "async raises": 1, "exits": 3}
# "every" starts all threads of "latest", and more
MODES = ["every", pytest.param("latest", marks=pytest.mark.slow)]


@pytest.fixture
def flood(endpoint: str, bus: nedbus.Bus) -> Iterator[str]:
    """Publish continuously, to fill all queues of a script that does not read."""
    publisher, sent = bus.publisher(VLP, vehicle="1"), message(1)
    with repeating(lambda: [publisher.publish(sent) for _ in range(400)]):  # type: ignore[func-returns-value] # called 400 times
        yield endpoint


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("script", SCRIPTS)
def test_script_without_close_exits(start: Start, flood: str, script: str, mode: str) -> None:
    """A bus that is never closed, blocking or asyncio, does not delay process exit, however full its queues are."""
    process = start(
        "-c", SCRIPTS[script].replace("MODE", repr(mode)), NEDBUS_CONNECT=flood, coverage=False
    )
    wait_for(lambda: "end" in process.out, what=f"the script to reach its end: {process.err}")
    with Stopwatch(process.popen.pid) as watch:
        assert process.wait() == CODES.get(script, 0), process.err
    assert watch.seconds < LIMIT
    assert "Traceback" not in process.err or "on purpose" in process.err
    assert "panicked" not in process.err
    assert "FATAL" not in process.err


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("vehicle", ["1", "silent"])
@pytest.mark.parametrize("mode", MODES)
def test_signal_ends_a_reading_script(
    start: Start, flood: str, number: signal.Signals, vehicle: str, mode: str
) -> None:
    """Ctrl-C and SIGTERM end a loop over samples, whether or not samples arrive."""
    code = f"""
import nedbus
bus = nedbus.connect()
subscription = bus.subscribe("*", vehicle={vehicle!r}, mode={mode!r})
print("ready", flush=True)
for sample in subscription:
    pass
"""
    process = start("-c", code, NEDBUS_CONNECT=flood, coverage=False)
    wait_for(lambda: "ready" in process.out, what=f"the script: {process.err}")
    with Stopwatch(process.popen.pid) as watch:
        process.signal(number)
        assert process.wait() == -number, process.err
    assert watch.seconds < LIMIT


@pytest.mark.slow
@pytest.mark.parametrize("timeout", [600, None])
@pytest.mark.parametrize(
    "how",
    ["nedbus.connect(timeout=T)", "asyncio.run(nedbus.connect_async(timeout=T).__aenter__())"],
)
def test_signal_ends_a_script_that_waits_for_a_router(
    start: Start, how: str, timeout: float | None
) -> None:
    """Ctrl-C ends the wait for a router that does not answer."""
    code = f"import asyncio, nedbus; T = {timeout}; {how}"
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(DEADLINE)
        process = start(
            "-c", code, NEDBUS_CONNECT=f"tcp/127.0.0.1:{server.getsockname()[1]}", coverage=False
        )
        server.accept()[0].close()  # the script is connecting
    process.signal(signal.SIGINT)
    assert process.wait() == -signal.SIGINT, process.err


@pytest.mark.slow
def test_signal_missed_by_asyncio_ends_the_wait_for_a_router(start: Start) -> None:
    """A signal that does not wake the event loop, for example one delivered to another thread, also ends the wait."""
    code = """
import asyncio, nedbus, signal, socket, threading
server = socket.create_server(("127.0.0.1", 0))
def interrupt():
    server.accept()[0].close()
    signal.pthread_kill(threading.get_ident(), signal.SIGINT)
threading.Thread(target=interrupt).start()
asyncio.run(nedbus.connect_async(f"tcp/127.0.0.1:{server.getsockname()[1]}", timeout=None).__aenter__())
"""
    process = start("-c", code, coverage=False)
    assert process.wait() == -signal.SIGINT, process.err


@pytest.mark.slow
def test_vehicle_of_a_killed_script_disappears(
    start: Start, endpoint: str, bus: nedbus.Bus
) -> None:
    """The vehicle of a script that ends by SIGKILL, without closing anything, disappears from the list."""
    code = """
import nedbus, time
bus = nedbus.connect()
bus.publisher("vehicle_local_position", vehicle="mine").publish({"timestamp": 1})
time.sleep(600)
"""
    process = start("-c", code, NEDBUS_CONNECT=endpoint, coverage=False)
    wait_for(lambda: "mine" in bus.vehicles(), what="the vehicle")
    process.kill()
    wait_for(lambda: "mine" not in bus.vehicles(), what="the vehicle to disappear")


def test_close_waits_for_threads_inside_zenoh(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`close` waits for threads inside Zenoh, because one that returns during interpreter exit aborts the process."""
    joined: list[str] = []
    join = threading.Thread.join

    def record_join(thread: threading.Thread, timeout: float | None = None) -> None:
        joined.append(thread.name)
        join(thread, timeout)

    monkeypatch.setattr(threading.Thread, "join", record_join)
    publisher = bus.publisher(VLP, vehicle="0")
    before = set(threading.enumerate())
    subscriptions = [bus.subscribe(vehicle=str(number), mode="every") for number in range(20)]
    reader = threading.Thread(target=lambda: list(subscriptions[0]))
    reader.start()

    def is_inside() -> bool:
        """Publish a message; return True if the reading thread is blocked in Zenoh."""
        publisher.publish(message(1))
        frame = sys._current_frames().get(reader.ident or 0)
        return frame is not None and frame.f_code.co_qualname == "Receiver._receive"

    wait_for(is_inside, what="the reader to be inside Zenoh")
    with suppress(nedbus.NoDataError):
        subscriptions[1].receive(0.0)  # a timeout starts the pump thread
    for subscription in subscriptions:
        subscription.close()
    assert not is_inside()
    assert set(threading.enumerate()) - before <= {reader}
    assert joined == ["nedbus-pump"]
    reader.join()


def test_ten_subscriptions_need_at_most_twelve_threads(endpoint: str) -> None:
    """Ten subscriptions that are read with a timeout need a thread each, plus the I/O thread and the closer thread."""
    before = set(threading.enumerate())
    with nedbus.connect(endpoint) as bus:
        subscriptions = [bus.subscribe(vehicle=str(number), mode="every") for number in range(10)]
        assert {thread.name for thread in set(threading.enumerate()) - before} <= {
            "nedbus-io",
            "nedbus-closer",
        }
        for subscription in subscriptions:
            with suppress(nedbus.NoDataError):
                subscription.receive(0.0)
        assert len(set(threading.enumerate()) - before) <= 12


INTERRUPTED = """
import os, signal, threading
from nedbus.client.closing import Finalizer

class Bus:
    pass

def close():
    os.kill(os.getpid(), signal.SIGINT)
    threading.Event().wait(100)

bus = Bus()
Finalizer(bus, close)
"""
COLLECTED = """
import os, signal, threading
from nedbus.client import closing

class Bus:
    pass

def close():
    while closing._closer._calls.empty():
        threading.Event().wait(0.01)  # until the main thread waits for this one
    os.kill(os.getpid(), signal.SIGINT)
    threading.Event().wait(100)

bus = Bus()
closing.Finalizer(bus, close)
del bus
"""


@pytest.mark.slow
@pytest.mark.parametrize("script", [INTERRUPTED, COLLECTED], ids=["open", "collected"])
def test_ctrl_c_while_a_bus_is_closed_at_exit_kills_the_process(start: Start, script: str) -> None:
    """Ctrl-C at exit must not leave a bus half closed: a thread that is still inside Zenoh would abort the process."""
    process = start("-c", script, coverage=False)
    assert process.wait() == -signal.SIGINT
    assert not process.err


@pytest.mark.long
def test_publisher_exits_during_a_flood_of_queries(start: Start, endpoint: str) -> None:
    """A reply in progress at process exit does not abort a publisher that is flooded with schema queries."""
    code = """
import time, nedbus
bus = nedbus.connect()
publishers = [bus.publisher("vehicle_local_position", vehicle=str(number)) for number in range(2)]
for publisher in publishers:
    publisher.publish({"timestamp": 1})
time.sleep(0.5)
"""
    flood = """
import os, time, zenoh
from nedbus.transport import open_client
session = open_client([os.environ["NEDBUS_CONNECT"]], timeout=30.0)
while True:
    for _ in range(50):
        session.get("nedbus/@schema/*/VehicleLocalPosition", zenoh.handlers.RingChannel(1), timeout=1.0)
    time.sleep(0.002)
"""
    for _ in range(2):
        start("-c", flood, NEDBUS_CONNECT=endpoint, coverage=False)
    for _ in range(6):
        process = start("-c", code, NEDBUS_CONNECT=endpoint, coverage=False)
        assert process.wait() == 0, process.err
