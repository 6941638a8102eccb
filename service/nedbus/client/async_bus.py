"""AsyncBus and AsyncPublisher, the asyncio versions of Bus and Publisher."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager, suppress
from functools import partial, wraps
from operator import attrgetter
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar, Unpack, overload

from nedbus.errors import ClosedError
from nedbus.samples import M2, M3, M_co, Mode, Query, Sample, Subscribe
from nedbus.settings import load_client_settings
from nedbus.transport import Tls
from nedbus_msgs import ANY, Definition, Message, VehicleNames

from .async_newest import AsyncNewest
from .async_subscription import AsyncSubscription
from .bus import Bus, require_callable, select
from .link import LinkCallback
from .publishing.publisher import FLUSH_TIMEOUT, Publisher
from .receiving import Receiver

_P = ParamSpec("_P")
_T = TypeVar("_T")


def _awaited(
    method: Callable[Concatenate[Any, _P], _T], *, may_block: Callable[[Any], bool] = lambda _: True
) -> Callable[Concatenate[Any, _P], Coroutine[Any, Any, _T]]:
    """Wrap a method of the blocking class as a coroutine, which runs in a thread if `may_block` returns True."""

    @wraps(method)
    async def call(wrapper: Any, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        if may_block(wrapper):
            result: _T = await wrapper._in_thread(method, wrapper._blocking, *args, **kwargs)
            return result
        return method(wrapper._blocking, *args, **kwargs)

    return call


class AsyncBus:
    """The asyncio version of Bus, from `connect_async`: methods that wait are coroutines.

    It has no `open_session`, because Zenoh sessions are blocking.
    """

    def __init__(self, open_bus: Callable[[threading.Event], Bus]) -> None:
        self._open_bus = open_bus
        self._bus: Bus | None = None
        self._threads = ThreadPoolExecutor(32, "nedbus-async")  # calls at a time; others wait

    @property
    def _blocking(self) -> Bus:
        if self._bus is None:
            raise ClosedError
        return self._bus

    @property
    def closed(self) -> bool:
        """True before the bus is opened and after it is closed."""
        return self._bus is None or self._bus.closed

    @property
    def connected(self) -> bool:
        """True if the bus is connected to a router."""
        return self._blocking.connected

    @property
    def prefix(self) -> str:
        """The prefix of all keys."""
        return self._blocking.prefix

    @property
    def routers(self) -> tuple[str, ...]:
        """The endpoints of the routers."""
        return self._blocking.routers

    @overload
    def subscribe(
        self, message: type[M_co] = ..., /, *, topic: str = ..., **options: Unpack[Subscribe]
    ) -> AsyncSubscription[M_co]: ...
    @overload
    def subscribe(
        self, message: type[M_co], other: type[M2], /, **options: Unpack[Subscribe]
    ) -> AsyncSubscription[M_co | M2]: ...
    @overload
    def subscribe(
        self, message: type[M_co], other: type[M2], third: type[M3], /, **options: Unpack[Subscribe]
    ) -> AsyncSubscription[M_co | M2 | M3]: ...
    @overload
    def subscribe(
        self, *messages: type[Message] | str, **options: Unpack[Subscribe]
    ) -> AsyncSubscription[Message]: ...
    def subscribe(
        self,
        *messages: type[Message] | str,
        topic: str | None = None,
        vehicle: VehicleNames = ANY,
        instance: int | None = None,
        mode: Mode = "latest",
        max_rate: float | None = None,
        limit: int | None = None,
    ) -> AsyncSubscription[Any]:
        """Return a subscription for `async for`; see `Bus.subscribe`. It opens on first use."""
        bus = self._blocking
        selection = select(messages, vehicle, instance, topic)
        inbox = bus._make_inbox(selection, mode, max_rate, limit)
        return AsyncSubscription(partial(self._in_thread, bus._open_receiver, inbox), inbox)

    def newest(
        self,
        *messages: type[Message] | str,
        vehicle: VehicleNames = ANY,
        instance: int | None = None,
        max_rate: float | None = None,
    ) -> AsyncNewest:
        """Return a view of the newest message of each stream; see `Bus.newest`. It opens on first use."""
        bus = self._blocking
        selection = select(messages, vehicle, instance)
        inbox = bus._make_inbox(selection, "latest", max_rate, None)

        def open_receiver() -> Receiver:
            # connects for the list of publishers, which would block the event loop
            bus.publishers(timeout=0.0)
            return bus._open_receiver(inbox)

        return AsyncNewest(
            partial(self._in_thread, open_receiver), inbox, selection.topics, owner=bus
        )

    def on_link(self, call: Callable[[bool], object]) -> LinkCallback:
        """Call a function in the running event loop when the link to the router is lost or up; see `Bus.on_link`."""
        require_callable(call)
        return self._blocking.on_link(partial(_call_in, asyncio.get_running_loop(), call))

    @overload
    async def latest(
        self, message: type[M_co] = ..., /, *, topic: str = ..., **options: Unpack[Query]
    ) -> list[Sample[M_co]]: ...
    @overload
    async def latest(
        self, message: type[M_co], other: type[M2], /, **options: Unpack[Query]
    ) -> list[Sample[M_co | M2]]: ...
    @overload
    async def latest(
        self, *messages: type[Message] | str, **options: Unpack[Query]
    ) -> list[Sample[Message]]: ...
    async def latest(self, *message: Any, **options: Any) -> Any:
        """Query the last sample of each key; see `Bus.latest`."""
        return await self._in_thread(self._blocking.latest, *message, **options)

    vehicles = _awaited(Bus.vehicles)
    publishers = _awaited(Bus.publishers)
    services = _awaited(Bus.services)
    accounts = _awaited(Bus.accounts)
    other_prefixes = _awaited(Bus.other_prefixes)
    history = _awaited(Bus.history)
    why = _awaited(Bus.why)
    fusion = _awaited(Bus.fusion)
    rejections = _awaited(Bus.rejections)

    async def publisher(
        self,
        message: type[Message] | str,
        *,
        topic: str | None = None,
        vehicle: str | int,
        instance: int | None = None,
        lossless: bool = False,
        source: str | None = None,
        definition: Definition[Any] | None = None,
    ) -> AsyncPublisher:
        """Return a publisher with awaitable methods; see `Bus.publisher`."""
        opening = _Opening(
            partial(
                self._blocking.publisher, message, topic=topic, vehicle=vehicle, instance=instance, lossless=lossless,
                source=source, definition=definition,
            ),
            close=lambda publisher: publisher.close(timeout=0.0),
        )  # fmt: skip
        try:
            return AsyncPublisher(await self._in_thread(opening.run))
        except asyncio.CancelledError:
            opening.abandon()
            raise

    async def close(self, timeout: float = FLUSH_TIMEOUT) -> None:
        """Close the bus; see `Bus.close`. Cancellation closes the bus at once, without waiting for readers."""
        if (bus := self._bus) is not None:  # in a new thread: the pool's threads may be blocked
            thread = ThreadPoolExecutor(1, "nedbus-close")
            await _run_cancellable(
                thread, partial(bus.close, timeout), cancel=partial(_stop_waiting, bus)
            )

    async def __aenter__(self) -> Self:
        cancelled = threading.Event()
        opening = _Opening(partial(self._open_bus, cancelled), close=lambda bus: bus.close(0.0))
        running = asyncio.create_task(self._in_thread(opening.run))
        try:
            # asyncio can miss a Ctrl-C just before it blocks: wake it regularly
            while not running.done():
                await asyncio.wait({running}, timeout=1.0)
            self._bus = running.result()
        except asyncio.CancelledError:
            cancelled.set()  # otherwise the thread keeps connecting and blocks interpreter exit
            running.cancel()
            opening.abandon()
            raise
        return self

    async def __aexit__(self, exc: object, *_: object) -> None:
        timeout = 0.0
        if exc is None:
            timeout = FLUSH_TIMEOUT
        await self.close(timeout)

    async def _in_thread(self, call: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> _T:
        return await asyncio.get_running_loop().run_in_executor(
            self._threads, partial(call, *args, **kwargs)
        )


class _Opening(Generic[_T]):
    """What a thread opens for a task: if the task is cancelled meanwhile, it is closed as soon as it is open."""

    def __init__(self, open_: Callable[[], _T], *, close: Callable[[_T], object]) -> None:
        self._open = open_
        self._close = close
        self._lock = threading.Lock()
        self._opened: _T | None = None
        self._is_abandoned = False

    def run(self) -> _T:
        """Open in this thread; close the result at once if the waiting task was cancelled."""
        opened = self._open()
        with self._lock:
            self._opened = opened
            is_abandoned = self._is_abandoned
        if is_abandoned:
            self._close(opened)
        return opened

    def abandon(self) -> None:
        """Close what is open, in a new thread, or else what `run` opens later."""
        with self._lock:
            self._is_abandoned = True
            opened = self._opened
        if opened is not None:
            threading.Thread(target=self._close, args=(opened,), name="nedbus-close").start()


def _call_in(loop: asyncio.AbstractEventLoop, call: Callable[[bool], object], is_up: bool) -> None:
    with suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(call, is_up)


def _stop_waiting(bus: Bus) -> None:
    for publisher in tuple(bus._publishers.publishers.values()):
        publisher._flow_control.cancelled.set()


async def _run_cancellable(
    thread: ThreadPoolExecutor, call: Callable[[], _T], *, cancel: Callable[[], object]
) -> _T:
    """Run a call in a thread; on cancellation, call `cancel`, which must end the call soon."""
    running = asyncio.get_running_loop().run_in_executor(thread, call)
    try:
        return await asyncio.shield(running)
    except asyncio.CancelledError:
        cancel()
        await asyncio.wait([running])
        raise


def connect_async(
    endpoint: str | Sequence[str] | None = None,
    *,
    timeout: float | None = 3.0,
    prefix: str | None = None,
    tls: Tls | None = None,
    config: str | Path | None = None,
) -> AsyncBus:
    """Return a bus for asyncio, opened with `async with`; arguments and errors as in `connect`."""
    load = partial(load_client_settings, config, connect=endpoint, prefix=prefix, tls=tls)
    return AsyncBus(lambda stop: Bus(load(), timeout=timeout, tls=tls, stop=stop))


class AsyncPublisher(AbstractAsyncContextManager["AsyncPublisher"]):
    """The asyncio version of Publisher; get one from `await bus.publisher(...)`.

    Attributes and errors are the same as in Publisher; all methods are coroutines.
    Methods that may wait for readers (a lossless `publish`, `publish_many`, `flush`, `close`) run in a thread of this
    publisher and do not block the event loop. Cancelling a call, for example by a timeout, ends its wait: `published`
    then holds the number of messages sent, and a cancelled `close` closes at once. Await each call before the next.
    """

    def __init__(self, publisher: Publisher) -> None:
        self.address, self.key = publisher.address, publisher.key
        self.source, self.lossless = publisher.source, publisher.lossless
        self._blocking, self._thread = publisher, ThreadPoolExecutor(1, "nedbus-async")

    @property
    def closed(self) -> bool:
        """True once the publisher or its bus is closed."""
        return self._blocking.closed

    @property
    def published(self) -> int:
        """The number of messages published."""
        return self._blocking.published

    publish = _awaited(Publisher.publish, may_block=attrgetter("lossless"))
    publish_row = _awaited(Publisher.publish_row, may_block=attrgetter("lossless"))
    publish_many = _awaited(Publisher.publish_many)
    flush = _awaited(Publisher.flush)
    close = _awaited(Publisher.close)
    __aexit__ = _awaited(Publisher.__exit__)

    async def _in_thread(self, call: Callable[_P, _T], *args: _P.args, **kwargs: _P.kwargs) -> _T:
        cancelled = threading.Event()
        flow_control = self._blocking._flow_control

        def run() -> _T:
            flow_control.cancelled = cancelled
            try:
                return call(*args, **kwargs)
            finally:
                flow_control.cancelled = threading.Event()

        return await _run_cancellable(self._thread, run, cancel=cancelled.set)
