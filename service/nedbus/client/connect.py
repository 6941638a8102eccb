"""Connecting: from endpoint, TLS and settings to a bus."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from nedbus.settings import Settings, load_settings
from nedbus.transport import Tls, open_client

from .async_bus import AsyncBus
from .bus import Bus


def connect(
    endpoint: str | Sequence[str] | None = None,
    *,
    timeout: float = 3.0,
    prefix: str | None = None,
    tls: Tls | None = None,
    config: str | Path | None = None,
) -> Bus:
    """Connect to a router and return a bus; use it as a context manager, or drop it: it closes itself.

    `endpoint` is Zenoh's, such as tcp/192.168.1.5:7447, or several of which the first that answers is taken.
    Without it, NEDBUS_CONNECT or `connect` in nedbus.toml decides, else the router that `nedbus serve` starts on this
    host.
    `timeout` is how long to try, in seconds; later breaks of the link are reconnected by themselves.
    `tls` is for tls/ endpoints; without it, the settings decide.
    `config` names a file instead of nedbus.toml.

    Raises ConnectError when nothing answers, ConfigError for an invalid setting.
    """
    return connect_with(load_settings(config, connect=endpoint, prefix=prefix), timeout=timeout, tls=tls)


def connect_async(
    endpoint: str | Sequence[str] | None = None,
    *,
    timeout: float = 3.0,
    prefix: str | None = None,
    tls: Tls | None = None,
    config: str | Path | None = None,
) -> AsyncBus:
    """Return a bus for asyncio, to be opened with `async with`; arguments and errors are those of `connect`."""
    return AsyncBus(partial(connect, endpoint, timeout=timeout, prefix=prefix, tls=tls, config=config))


def connect_with(settings: Settings, *, timeout: float, tls: Tls | None = None) -> Bus:
    """Connect as settings say, with `tls` in place of theirs if it is given; errors are those of `connect`."""
    routers, tls = settings.routers, tls or settings.tls
    return Bus(open_client(routers, timeout=timeout, tls=tls), routers=routers, prefix=settings.prefix, tls=tls)
