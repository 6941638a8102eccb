"""sd_notify messages of a service with Type=notify: ready, status, reloading, stopping, watchdog."""

import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Final, Self

from nedbus import limits
from nedbus.daemon import Daemon
from nedbus.log_event import UnexpectedErrors
from nedbus.monitoring import why_not_ready
from nedbus.timings import TIMINGS
from nedbus_msgs.text import counted

from .output.streams import to_text

_log = logging.getLogger("nedbus")

_START_INTERVAL: Final = 0.1  # s between two checks until the service is ready


def notify(address: str, **fields: object) -> bool:
    """Send these fields to NOTIFY_SOCKET as one datagram, see sd_notify(3); return True if it was accepted.

    Never blocks. The package `sdnotify` blocks while systemd's queue is full, and does not report whether a datagram
    was accepted.
    """
    where = f"\0{address[1:]}" if address.startswith("@") else address  # @: abstract socket
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender:
            sender.sendto(
                "\n".join(f"{name}={value}" for name, value in fields.items()).encode(), where
            )
    except OSError as exc:
        # no reader, a full queue or no file descriptor left: READY and STATUS are sent again
        _log.debug("cannot notify systemd: %s", exc)
        return False
    return True


class Notifier:
    """Report the state of a daemon to systemd in a `with` block; without NOTIFY_SOCKET do nothing.

    READY is sent once `daemon.ready` is set: the router listens, or the session is open, and all sources have started.
    Silent sources do not delay it; the status text names them.
    A client whose router does not answer reports READY after half a minute.

    WATCHDOG is sent only while everything works: Zenoh returns the number of sessions, the main thread has called
    `tick` since the last ping, and no source has spent half of systemd's limit on one message.
    A separate thread sends it, because the main thread must handle signals even while Zenoh blocks.
    """

    def __init__(self, daemon: Daemon, *, environment: Mapping[str, str] = os.environ) -> None:
        self._daemon = daemon
        address = environment.get("NOTIFY_SOCKET", "")
        self._is_active = address.startswith(("/", "@"))
        self._send: Callable[..., bool] = lambda **_: False
        if self._is_active:
            self._send = partial(notify, address)
        self._watchdog = watchdog_limit(environment)
        self._router_deadline = time.monotonic() + TIMINGS.systemd_patience
        self._counted = time.monotonic(), 0  # time, and messages published until then
        # READY was accepted; `tick` was called since the last ping
        self._is_ready = self._ticked = False
        self._rejected = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="nedbus-systemd", daemon=True)

    def __enter__(self) -> Self:
        if self._is_active:
            self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stopping()
        if self._thread.is_alive():
            self._thread.join(1.0)  # the interpreter aborts at exit if a thread is inside Zenoh

    def tick(self) -> None:
        """Record that the main thread is alive; call it twice a second."""
        self._ticked = True

    def stopping(self) -> None:
        """Report STOPPING once; safe in signal handlers."""
        if not self._stop.is_set():
            self._stop.set()
            self._send(STOPPING=1, STATUS="stopping")

    @contextmanager
    def reloading(self) -> Iterator[None]:
        """Report RELOADING, then READY; an error stays in the status text until the next reload."""
        now = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
        self._send(RELOADING=1, MONOTONIC_USEC=now, STATUS="reloading the configuration")
        self._rejected = ""
        try:
            yield
        except Exception as exc:
            self._rejected = f"new configuration rejected, the old one stays active: {exc}"
            raise
        finally:
            self._is_ready = False  # the thread sends READY

    def _run(self) -> None:
        next_status = 0.0
        limit = self._watchdog
        errors = UnexpectedErrors(_log, "unexpected error in a status update (logged once)")
        while True:
            now = time.monotonic()
            is_overdue = self._daemon.role == "client" and now >= self._router_deadline
            with errors:  # an error in the status also omits WATCHDOG
                if not self._is_ready and (self._daemon.ready.is_set() or is_overdue):
                    self._is_ready = True  # set before sending: a reload may unset it at any moment
                    if not self._send(READY=1, STATUS=self._status()):
                        self._is_ready = False
                elif now >= next_status:
                    self._send(STATUS=self._status())
                    next_status = now + TIMINGS.systemd_status
                if limit is not None and self._is_alive(limit):
                    self._ticked = False
                    self._send(WATCHDOG=1)
            if self._is_ready:
                pause = TIMINGS.systemd_status
            else:
                pause = _START_INTERVAL
            if limit is not None:
                # several within the limit: systemd may reject one, or a busy host delay it
                pause = min(pause, limit / 4)
            if self._stop.wait(pause):
                return

    def _is_alive(self, limit: float) -> bool:
        """Return whether the main thread has run since the last ping, and no source is busy for half of the limit."""
        return self._ticked and self._daemon.busy < limit / 2

    def _status(self) -> str:
        daemon = self._daemon
        if not daemon.ready.is_set():
            where = " or ".join(daemon.endpoints)
            if daemon.role == "client":
                return f"waiting for a router at {where}"
            return f"starting a router on {where}"
        now = time.monotonic()
        sources = daemon.sources
        published = sum(source.published for source in sources)
        since, before = self._counted
        self._counted = now, published
        rate = max(0, published - before) / (now - since)
        streams = sum(len(source.addresses) for source in sources)
        counts = (
            f"{counted(len(sources), 'source')}, {counted(streams, 'stream')}, "
            f"{float(f'{rate:.2g}'):g} messages/s, {counted(daemon.sessions, 'session')}"
        )
        texts = [counts, *why_not_ready(daemon)]
        if self._rejected:
            texts.insert(1, self._rejected)
        return to_text("; ".join(texts), limits.LINE_TEXT)


def watchdog_limit(environment: Mapping[str, str]) -> float | None:
    """Return the longest time that systemd allows between two pings [s]; None if it does not watch this process."""
    text = environment.get("WATCHDOG_USEC", "")
    pid = environment.get("WATCHDOG_PID", "")
    if not text.isdecimal() or int(text) == 0:
        return None
    if pid and pid != str(os.getpid()):
        return None
    return int(text) / 1e6
