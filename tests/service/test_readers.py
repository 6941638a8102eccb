"""Readers that stand still, are stopped, die or are slow: nobody else waits for them, and nothing is lost unseen."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress

import pytest

import nedbus
from nedbus.client.acknowledgement import WINDOW
from nedbus.transport import open_router
from nedbus_msgs.arrays import to_array
from tests.conftest import DEADLINE, Process, Start, free_endpoint, message, wait_for, wait_for_reader

VLP = "vehicle_local_position"
COUNT = 3 * WINDOW

READER = """
import sys, nedbus
with nedbus.connect(sys.argv[1]) as bus, bus.subscribe("vehicle_local_position", mode="every") as subscription:
    print("ready", flush=True)
    for number, sample in enumerate(subscription, 1):
        if sample.message.timestamp != number or sample.lost:
            sys.exit(f"{sample.message.timestamp} in place of {number}, {sample.lost} lost")
        if number == 10 and len(sys.argv) > 2:
            print("ten", flush=True)
        if number == int(sys.argv[-1]):
            break
    counts = subscription.counts
print("whole" if counts == nedbus.Counts(received=number) else counts, flush=True)
"""


def publish_all(bus: nedbus.Bus, *, count: int = COUNT) -> tuple[nedbus.Publisher, threading.Thread]:
    """Start to publish messages without losing any, once there is a reader."""
    publisher = bus.publisher(VLP, vehicle="1", lossless=True)
    wait_for_reader(bus._session, publisher.key)
    messages = to_array([message(number) for number in range(1, count + 1)])
    thread = threading.Thread(target=publisher.publish_many, args=[messages], daemon=True)
    thread.start()
    return publisher, thread


def test_subscription_that_is_never_read_harms_nobody(endpoint: str, bus: nedbus.Bus) -> None:
    """Neither another subscription of its own bus, nor another process's, nor closing: all get all that is live."""
    with nedbus.connect(endpoint) as own, nedbus.connect(endpoint) as other:
        unread = [own.subscribe(VLP, mode="every") for _ in range(3)]
        read = [own.subscribe(VLP, mode="every"), other.subscribe(VLP, mode="every")]
        publisher = bus.publisher(VLP, vehicle="1")
        wait_for_reader(bus._session, publisher.key)
        publisher.publish(message(1))
        assert [each.receive(DEADLINE).message.timestamp for each in read] == [1, 1]
        for start in range(2, 20_002, 200):
            for number in range(start, start + 200):
                publisher.publish(message(number))
            for each in read:
                got = [each.receive(DEADLINE).message.timestamp for _ in range(200)]
                assert got == list(range(start, start + 200))
        assert [each.receive(DEADLINE).message.timestamp for each in unread] == [1, 1, 1]


def test_replay_goes_on_slowly_beside_a_reader_that_stands_still(endpoint: str, bus: nedbus.Bus) -> None:
    """More than a window is not sent at once while one reader reads nothing, but others see more; both get all."""
    with nedbus.connect(endpoint) as one, nedbus.connect(endpoint) as two:
        stuck, healthy = one.subscribe(VLP, mode="every"), two.subscribe(VLP, mode="every")
        publisher, sending = publish_all(bus)
        got = [healthy.receive(DEADLINE).message.timestamp for _ in range(WINDOW + 5)]
        assert got == list(range(1, WINDOW + 6))
        assert publisher.published < COUNT
        late: list[int] = []
        reading = threading.Thread(
            target=lambda: late.extend(stuck.receive(DEADLINE).message.timestamp for _ in range(COUNT)), daemon=True
        )
        reading.start()
        got += [healthy.receive(DEADLINE).message.timestamp for _ in range(COUNT - WINDOW - 5)]
        reading.join(DEADLINE)
        assert late == got == list(range(1, COUNT + 1))
        sending.join(DEADLINE)
        assert not sending.is_alive()
        assert stuck.counts == healthy.counts == nedbus.Counts(received=COUNT)


@pytest.mark.parametrize("when", ["before", "amid"])
def test_stopped_reader_gets_everything(start: Start, endpoint: str, bus: nedbus.Bus, when: str) -> None:
    """One that is stopped (SIGSTOP) until Zenoh's lease has ended comes back, and has lost nothing."""
    stops = "if number == 300: import os, signal; os.kill(os.getpid(), signal.SIGSTOP)\n        if number == int"
    reader = start("-c", READER.replace("if number == int", stops) if when == "amid" else READER, endpoint, str(COUNT))
    wait_for(lambda: "ready" in reader.out, what="the reader")
    if when == "before":
        reader.popen.send_signal(signal.SIGSTOP)
    publisher, sending = publish_all(bus)
    wait_for(lambda: publisher._acknowledgement._readers.away, what="the end of the lease")
    assert sending.is_alive()
    reader.popen.send_signal(signal.SIGCONT)
    assert reader.wait(60.0) == 0, reader.err
    assert reader.out.split()[-1] == "whole"
    sending.join(DEADLINE)
    assert not sending.is_alive()


@pytest.mark.parametrize("lossless", [False, True])
def test_publishers_that_began_while_the_link_was_broken(endpoint: str, bus: nedbus.Bus, lossless: bool) -> None:
    """A reader that was away when they began gets all that they still keep, in order: it has subscribed before."""
    near = free_endpoint()
    router = open_router(listen=(near,), connect=(endpoint,))
    vehicles = [str(number) for number in range(10)]
    with nedbus.connect(near) as other, other.subscribe(VLP, mode="every") as subscription:
        router.close()
        wait_for(lambda: not other.connected, what="the end of the link")
        publishers = [bus.publisher(VLP, vehicle=vehicle, lossless=lossless) for vehicle in vehicles]
        last = 0

        def publish() -> None:
            nonlocal last
            last += 1
            for publisher in publishers:
                publisher.publish(message(last))

        for _ in range(100):
            publish()
        router = open_router(listen=(near,), connect=(endpoint,))
        got: dict[str, list[int]] = {vehicle: [] for vehicle in vehicles}

        def take() -> bool:
            publish()
            with suppress(nedbus.NoDataError):
                while True:
                    sample = subscription.receive(0.005)
                    got[sample.vehicle].append(sample.message.timestamp)
            return all(len(each) > 100 for each in got.values())

        wait_for(take, what="messages of all")
        for each in got.values():
            assert each == list(range(1, len(each) + 1))
        assert subscription.counts.lost == 0
    router.close()


def kill(reader: Process) -> None:
    os.kill(reader.popen.pid, signal.SIGKILL)


def interrupt(reader: Process) -> None:
    reader.signal(signal.SIGINT)


@pytest.mark.parametrize("end", [kill, interrupt])
def test_reader_that_dies_is_given_up(
    start: Start, endpoint: str, bus: nedbus.Bus, end: Callable[[Process], None]
) -> None:
    """A replay goes on without one that is killed, or ends, and others miss nothing."""
    slow = READER.replace("if number ==", "import time; time.sleep(0.05)\n        if number ==", 1)
    reader = start("-c", slow, endpoint, "slow", str(COUNT), measured=False)
    wait_for(lambda: "ready" in reader.out, what="the reader")
    with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
        _, sending = publish_all(bus)
        wait_for(lambda: "ten" in reader.out, what="the first messages")
        end(reader)
        got = [subscription.receive(DEADLINE).message.timestamp for _ in range(COUNT)]
        assert got == list(range(1, COUNT + 1))
        sending.join(DEADLINE)
        assert not sending.is_alive()


def test_flush_waits_for_arrival_and_not_for_scripts(endpoint: str, bus: nedbus.Bus) -> None:
    """What has arrived at a script that reads nothing is safe: the end of a replay does not wait until it is read."""
    with nedbus.connect(endpoint) as one, nedbus.connect(endpoint) as two:
        unread, read = one.subscribe(VLP, mode="every"), two.subscribe(VLP, mode="every")
        publisher, sending = publish_all(bus, count=WINDOW // 2)
        assert [read.receive(DEADLINE).message.timestamp for _ in range(WINDOW // 2)][-1] == WINDOW // 2
        read.close()
        sending.join(DEADLINE)
        assert publisher.flush(DEADLINE)
        assert [unread.receive(DEADLINE).message.timestamp for _ in range(WINDOW // 2)][-1] == WINDOW // 2
