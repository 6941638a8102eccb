"""Opening and closing a bus: absent routers, cancellation, forks and garbage collection, with either client."""

from __future__ import annotations

import asyncio
import gc
import signal
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from typing import Any, Final, cast

import pytest
import zenoh

import nedbus
from nedbus import Mode
from nedbus.client import AsyncBus
from nedbus.client.receiving import Decoder, Inbox, LayoutLookup, Receiver
from nedbus.transport import Session, open_router
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import publish, wait_for_subscriber
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.peers.queryables import answer_queries
from tests.waits import DEADLINE, wait_for

from .test_bus import BOTH

_STEPS: Final = 100  # more function calls than a blocking read makes


def test_connect_without_a_router_raises() -> None:
    """Without a router, `connect` raises a ConnectionError with the endpoint and a remedy."""
    where = free_endpoint()
    assert issubclass(nedbus.ConnectError, ConnectionError)
    with pytest.raises(
        nedbus.ConnectError,
        match=rf'nothing answers at {where} .*nedbus serve.*--connect, connect\("tcp/HOST:PORT"\) or NED',
    ):
        nedbus.connect(where, timeout=0.1)


@pytest.mark.parametrize("is_async", [False, True])
def test_connect_without_a_timeout_waits_for_a_router(*, is_async: bool) -> None:
    """`timeout=None` waits for a router indefinitely."""
    where = free_endpoint()

    async def connect_async() -> bool:
        async with nedbus.connect_async(where, timeout=None) as bus:
            return bus.connected

    def connect() -> bool:
        with nedbus.connect(where, timeout=None) as bus:
            return bus.connected

    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit((lambda: asyncio.run(connect_async())) if is_async else connect)
        with pytest.raises(TimeoutError):
            waiting.result(0.2)
        router = open_router(listen=(where,))
        assert waiting.result(DEADLINE)
    router.close()


@pytest.mark.slow
@pytest.mark.parametrize("read", [lambda subscription: subscription.receive(DEADLINE), next])
def test_ctrl_c_at_any_step_of_a_read_releases_all_locks(
    endpoint: str, bus: nedbus.Bus, read: Callable[[nedbus.Subscription[Any]], nedbus.Sample[Any]]
) -> None:
    """A read interrupted at any step blocks neither the next read nor the close.

    CPython handles signals when a Python function is entered and when a C function has returned.
    """
    publisher, interrupted = bus.publisher(VLP, vehicle="1"), list[int]()

    def interrupt_all() -> None:
        with nedbus.connect(endpoint) as other, other.subscribe(VLP, mode="every") as subscription:
            wait_for_subscriber(publisher)
            for step in range(1, _STEPS):
                steps = iter(range(step))

                def interrupt(
                    _: object, event: str, __: object, steps: Iterator[int] = steps
                ) -> None:
                    if event in ("call", "c_return") and next(steps, None) is None:
                        raise KeyboardInterrupt

                timer = threading.Timer(0.003, publish, [publisher, 2 * step])  # during the wait
                timer.start()
                sys.setprofile(interrupt)
                try:
                    read(subscription)
                except KeyboardInterrupt:
                    interrupted.append(step)
                finally:
                    sys.setprofile(None)
                timer.join()
                publish(publisher, 2 * step + 1)
                while read(subscription).message.timestamp <= 2 * step:
                    pass

    reading = threading.Thread(target=interrupt_all, daemon=True)
    reading.start()
    reading.join(DEADLINE)
    assert not reading.is_alive(), interrupted
    assert len(interrupted) > 25


@pytest.mark.slow
def test_cancelled_connect_leaves_no_thread() -> None:
    """After a cancelled `connect_async` the connecting thread ends without an error."""
    errors: list[object] = []

    async def scenario() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context))
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(
                nedbus.connect_async(free_endpoint(), timeout=None).__aenter__(), 0.1
            )
        while len(asyncio.all_tasks()) > 1:
            await asyncio.sleep(0.01)
        gc.collect()

    asyncio.run(scenario())
    assert not errors


def test_bus_that_opens_while_it_is_cancelled_is_closed() -> None:
    """If `async with connect_async()` is cancelled, a bus that its thread has opened or opens later is closed."""
    is_opening, may_open = threading.Event(), threading.Event()
    opened = list[nedbus.Bus]()
    endpoint = free_endpoint()

    def open_bus(_: threading.Event) -> nedbus.Bus:
        is_opening.set()
        assert may_open.wait(DEADLINE)
        opened.append(nedbus.connect(endpoint))
        return opened[0]

    async def scenario() -> None:
        entering = asyncio.create_task(AsyncBus(open_bus).__aenter__())
        await asyncio.to_thread(is_opening.wait, DEADLINE)
        entering.cancel()
        with suppress(asyncio.CancelledError):
            await entering
        may_open.set()
        await asyncio.to_thread(
            wait_for, lambda: opened and opened[0].closed, what="the closed bus"
        )

    with open_router(listen=[endpoint]):
        asyncio.run(scenario())


@pytest.mark.parametrize("is_open", [False, True], ids=["before it is open", "after it is open"])
def test_cancelled_publisher_frees_its_address(
    endpoint: str, monkeypatch: pytest.MonkeyPatch, is_open: bool
) -> None:
    """A cancelled `await bus.publisher(...)` closes the publisher, opened before or after the cancellation."""
    is_opening, may_open, is_returned = threading.Event(), threading.Event(), threading.Event()
    original = nedbus.Bus.publisher

    def open_slowly(bus: nedbus.Bus, *message: Any, **options: Any) -> nedbus.Publisher:
        is_opening.set()
        if not is_open:
            assert may_open.wait(DEADLINE)
        publisher = original(bus, *message, **options)
        is_returned.set()
        return publisher

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as bus:
            with monkeypatch.context() as patch:
                patch.setattr(nedbus.Bus, "publisher", open_slowly)
                opening = asyncio.create_task(bus.publisher(VLP, vehicle="7"))
                await asyncio.to_thread(is_opening.wait, DEADLINE)
                if is_open:  # blocks the event loop: the task has not yet received the publisher
                    assert is_returned.wait(DEADLINE)
                opening.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await opening
                may_open.set()
                await asyncio.to_thread(is_returned.wait, DEADLINE)
            registry = bus._blocking._publishers.publishers
            await asyncio.to_thread(wait_for, lambda: not registry, what="the free address")
            async with await bus.publisher(VLP, vehicle="7") as again:
                assert again.address == nedbus.Address("7", VLP)

    asyncio.run(scenario())


def test_connect_uses_first_answering_endpoint_or_environment(
    endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`connect` uses the first endpoint that answers; a script without an endpoint uses NEDBUS_CONNECT."""
    with nedbus.connect([free_endpoint(), endpoint]) as bus:
        assert bus.connected
    monkeypatch.setenv("NEDBUS_CONNECT", endpoint)
    with nedbus.connect() as bus:
        assert bus.connected


def test_receive_timeout_includes_opening() -> None:
    """The timeout of `receive` includes opening the subscription, even without a router."""
    where = free_endpoint()
    router = open_router(listen=(where,))

    async def scenario() -> None:
        async with nedbus.connect_async(where) as bus:
            subscription = bus.subscribe(mode="every")
            await asyncio.to_thread(router.close)
            with pytest.raises(nedbus.NoDataError):  # and not ConnectError, after 3 s
                await subscription.receive(0.01)

    asyncio.run(scenario())


def test_cancelled_receives_open_one_subscriber(endpoint: str, bus: nedbus.Bus) -> None:
    """If `receive` is cancelled while the subscription opens, a later one opens no second subscriber."""
    publisher = bus.publisher(VLP, vehicle="1")

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as other:
            subscription = other.subscribe(mode="every")
            for _ in range(3):
                task = asyncio.create_task(subscription.receive())
                await asyncio.sleep(0)
                await asyncio.sleep(0)
                task.cancel()
            for timestamp in (1, 2):
                publish(publisher, timestamp)
                assert (await subscription.receive(DEADLINE)).message.timestamp == timestamp
            assert subscription.counts == nedbus.Counts(received=2)

    asyncio.run(scenario())


@pytest.mark.parametrize("mode", BOTH)
def test_closed_subscription_ends_iteration(endpoint: str, client: nedbus.Bus, mode: Mode) -> None:
    """`close` ends an iteration without an error, even in another thread, and is idempotent. `receive` then raises."""
    with nedbus.connect(endpoint) as bus:
        waiting = bus.subscribe(VLP, mode=mode)
        reader = threading.Thread(target=list, args=(waiting,), daemon=True)
        reader.start()
        waiting.close()
        reader.join(DEADLINE)
        assert not reader.is_alive()
    subscription = client.subscribe(VLP, mode=mode)
    assert not subscription.closed
    subscription.close()
    subscription.close()
    assert subscription.closed
    assert list(islice(subscription, 1)) == []
    with pytest.raises(nedbus.ClosedError):
        subscription.receive(1.0)


@pytest.mark.parametrize("mode", BOTH)
@pytest.mark.parametrize("forms", [iter, nedbus.Subscription.rows, nedbus.Subscription.batches])
def test_failed_session_raises_in_iteration(
    endpoint: str, mode: Mode, forms: Callable[[nedbus.Subscription[Any]], Iterator[object]]
) -> None:
    """If the session ends unexpectedly, before or during a wait, iteration raises ReceiveError."""
    with nedbus.connect(endpoint) as bus:
        subscription = bus.subscribe(VLP, mode=mode)
        closer = threading.Thread(target=bus._zenoh.close)
        closer.start()
        for _ in range(2):
            with pytest.raises(
                nedbus.ReceiveError, match=r"its Zenoh session was closed.*subscribe again"
            ):
                list(forms(subscription))
        closer.join()
        subscription.close()
        with pytest.raises(nedbus.ReceiveError):
            subscription.receive(1.0)


def test_failed_session_raises_in_asyncio(endpoint: str) -> None:
    """If the session ends unexpectedly, `async for` raises ReceiveError."""

    async def scenario() -> None:
        async with nedbus.connect_async(endpoint) as bus, bus.subscribe(VLP) as subscription:
            closing = asyncio.create_task(asyncio.to_thread(bus._blocking._zenoh.close))
            with pytest.raises(nedbus.ReceiveError, match="its Zenoh session was closed"):
                async for _ in subscription:
                    pass
            with pytest.raises(nedbus.ReceiveError):
                async for _ in subscription.rows():
                    pass
            await closing

    asyncio.run(scenario())


def test_failed_pump_raises_in_iteration(
    client: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unexpected error in the pump thread raises ReceiveError, with the text of the error, in the reading thread."""

    def fail(*_: object) -> None:
        raise RuntimeError("on purpose")

    monkeypatch.setattr(Receiver, "_receive", fail)
    subscription = client.subscribe(VLP)
    with pytest.raises((nedbus.NoDataError, nedbus.ReceiveError)):
        subscription.receive(0.01)  # starts the thread
    with pytest.raises(nedbus.ReceiveError, match="unexpected RuntimeError: on purpose"):
        list(subscription)


def test_closed_publisher_frees_its_address(client: nedbus.Bus, bus: nedbus.Bus) -> None:
    """A closed publisher is not listed, does not reply, raises on publish, and frees its address."""
    publisher = client.publisher(VLP, vehicle="1")
    publish(publisher, 1)
    wait_for(bus.latest, what="the message")
    publisher.close()
    publisher.close()
    assert client.latest("*") == []
    wait_for(lambda: not bus.vehicles(), what="the vehicle to disappear")
    with pytest.raises(nedbus.ClosedError):
        publish(publisher, 2)
    with client.publisher(VLP, vehicle="1") as successor:
        publish(successor, 3)


def test_publishers_closed_before_the_first_listing_are_not_listed(client: nedbus.Bus) -> None:
    """A bus that lists vehicles for the first time lists none of its 50 closed publishers."""
    for number in range(50):
        client.publisher(VLP, vehicle=number).close()
    assert not client.vehicles()


def test_calls_on_a_closed_bus_raise(client: nedbus.Bus) -> None:
    """Every call on a closed bus raises ClosedError, and its subscriptions end."""
    subscription = client.subscribe(VLP)
    publisher = client.publisher(VLP, vehicle="1")
    with suppress(nedbus.NoDataError):
        subscription.receive(0.0)  # opens the subscription
    assert not any(each.closed for each in (client, subscription, publisher))
    client.close()
    client.close()
    assert all(each.closed for each in (client, subscription, publisher))
    assert list(islice(subscription, 1)) == []
    with pytest.raises(nedbus.ClosedError):
        publisher.publish(message())
    for call in (
        client.latest,
        client.vehicles,
        client.services,
        lambda: client.connected,
        client.subscribe,
    ):
        with pytest.raises(nedbus.ClosedError):
            call()


@pytest.mark.slow
def test_unreferenced_bus_is_closed(endpoint: str, bus: nedbus.Bus) -> None:
    """A bus closes once neither the bus nor any of its publishers and subscriptions is referenced."""
    unreferenced = nedbus.connect(endpoint)
    reference = weakref.ref(unreferenced)
    publisher, subscription = (
        unreferenced.publisher(VLP, vehicle="1"),
        unreferenced.subscribe(mode="every"),
    )
    publish(publisher, 1)
    assert subscription.receive(DEADLINE).message.timestamp == 1
    del unreferenced, subscription
    gc.collect()
    publish(publisher, 2)
    wait_for(
        lambda: [sample.message.timestamp for sample in bus.latest()] == [2], what="the message"
    )
    del publisher
    gc.collect()
    assert reference() is None
    wait_for(lambda: not bus.vehicles(), what="the vehicle to disappear")


@pytest.mark.slow
def test_garbage_collection_closes_on_the_closer_thread() -> None:
    """Garbage collection leaves closing to the closer thread, because it may run on a thread that holds a lock."""
    lock = threading.Lock()
    closed: list[threading.Thread] = []

    class Subscriber:
        def close(self) -> None:
            with lock:
                closed.append(threading.current_thread())

    queue = Inbox("latest", Decoder(LayoutLookup(lambda _: {}), prefix="nedbus"))
    subscription = nedbus.Subscription(cast("Receiver", Subscriber()), queue, owner=None)
    with lock:  # garbage collection may run while this thread holds it
        del subscription
        gc.collect()  # closing on this thread would be a deadlock
    wait_for(lambda: closed, what="the subscription to be closed")
    assert closed != [threading.current_thread()]


@pytest.mark.slow
def test_ctrl_c_ends_a_query_without_a_reply(
    start: Start, endpoint: str, zenoh_session: Session
) -> None:
    """Ctrl-C ends the wait for a queryable that never replies."""
    queries: list[zenoh.Query] = []
    code = (
        'import nedbus; bus = nedbus.connect(); print("ready", flush=True); bus.latest(timeout=600)'
    )
    with answer_queries(zenoh_session, "nedbus/**", queries.append):
        process = start("-c", code, NEDBUS_CONNECT=endpoint, coverage=False)
        wait_for(lambda: queries, what="the query")
        process.signal(signal.SIGINT)
        assert process.wait() == -signal.SIGINT, process.err


def test_ctrl_c_during_thread_start_is_raised(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C during the start of the pump thread is raised, and `close` waits for the thread, which starts anyway."""
    start, late = threading.Thread.start, list[threading.Thread]()

    def interrupted(thread: threading.Thread) -> None:
        if thread.name != "nedbus-pump":
            start(thread)
            return
        late.append(thread)
        threading.Timer(0.05, start, [thread]).start()
        raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", interrupted)
    with pytest.raises(KeyboardInterrupt), bus.subscribe() as subscription:
        subscription.receive(timeout=DEADLINE)
    assert late[0].ident is not None, "the thread has not run"
    assert not late[0].is_alive()


@pytest.mark.slow
def test_calls_in_a_forked_process_raise(start: Start, endpoint: str) -> None:
    """Zenoh does not survive a fork: in the child every call raises ForkError, and the child can exit."""
    code = """
import os, sys
import nedbus
bus = nedbus.connect()
subscription = bus.subscribe()
publisher = bus.publisher("vehicle_local_position", vehicle="1")
publisher.publish({"timestamp": 1})
if child := os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
publish, receive = lambda: publisher.publish({"timestamp": 2}), lambda: next(subscription)
for call in (bus.latest, bus.subscribe, publish, receive, nedbus.connect):
    try:
        call()
    except nedbus.errors.ForkError as exc:
        print(exc)
sys.exit(7)
"""
    process = start("-c", code, NEDBUS_CONNECT=endpoint, coverage=False, fresh=True)
    assert process.wait() == 7, process.err
    assert process.out.count("start processes with multiprocessing.get_context('spawn')") == 5
    assert "Traceback" not in process.err
