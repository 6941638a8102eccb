"""Connecting: from endpoint, TLS and settings to a bus."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

from nedbus.settings import Settings, load_settings
from nedbus.transport import Tls, open_client

from .async_bus import AsyncBus
from .bus import Bus


def connect(
    endpoint: str | Sequence[str] | None = None,
    *,
    timeout: float | None = 3.0,
    prefix: str | None = None,
    tls: Tls | None = None,
    config: str | Path | None = None,
) -> Bus:
    """Connect to a router and return a bus; use it as a context manager, or drop it: it closes itself.

    `endpoint` is Zenoh's, such as tcp/192.168.1.5:7447, or several of which the first that answers is taken.
    Without it, NEDBUS_CONNECT or `connect` in nedbus.toml decides, else the router that `nedbus serve` starts on this
    host.
    `timeout` is how long to try, in seconds; None waits for a router for ever, until Ctrl-C.
    Later breaks of the link are reconnected by themselves.
    `tls` is for tls/ endpoints; without it, the settings decide.
    `config` names a file instead of nedbus.toml.

    Raises ConnectError when nothing answers, ConfigError for an invalid setting.
    """
    return connect_with(load_settings(config, connect=endpoint, prefix=prefix), timeout=timeout, tls=tls)


def connect_async(
    endpoint: str | Sequence[str] | None = None,
    *,
    timeout: float | None = 3.0,
    prefix: str | None = None,
    tls: Tls | None = None,
    config: str | Path | None = None,
) -> AsyncBus:
    """Return a bus for asyncio, to be opened with `async with`; arguments and errors are those of `connect`."""

    def open_bus(stop: threading.Event) -> Bus:
        settings = load_settings(config, connect=endpoint, prefix=prefix)
        return connect_with(settings, timeout=timeout, tls=tls, stop=stop)

    return AsyncBus(open_bus)


def connect_with(
    settings: Settings, *, timeout: float | None, tls: Tls | None = None, stop: threading.Event | None = None
) -> Bus:
    """Connect as settings say, with `tls` in place of theirs if it is given; errors are those of `connect`.

    Setting `stop` ends the wait for a router, with ConnectError.
    """
    routers, tls = settings.routers, tls or settings.tls
    session = open_client(routers, timeout=timeout, tls=tls, stop=stop)
    return Bus(session, routers=routers, prefix=settings.prefix, tls=tls)
