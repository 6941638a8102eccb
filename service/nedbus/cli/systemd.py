"""What systemd is told of a service with Type=notify: ready, status, reloading, stopping, and that it still works."""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final, Self

from nedbus.daemon import Daemon
from nedbus.log_event import about
from nedbus.monitoring import why_not_ready

from .format import MAX_TEXT, to_text

_log = logging.getLogger("nedbus")

_PATIENCE: Final = (
    30.0  # s after which a client counts as started without its router: the boot must not wait for a link
)
_STATUS_INTERVAL: Final = 1.0  # s between two texts of the status
_START_INTERVAL: Final = 0.1  # s between two looks whether the service is ready


class NotifySocket:
    """Where systemd listens, as sd_notify(3) describes NOTIFY_SOCKET; without one, sending does nothing.

    Raises nothing and never blocks: a service works on when nobody listens.
    """

    def __init__(self, address: str) -> None:
        self._address = f"\0{address[1:]}" if address.startswith("@") else address  # @: an abstract address
        self._socket: socket.socket | None = None
        if address.startswith(("/", "@")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
        elif address:
            _log.warning(
                "NOTIFY_SOCKET is %s, which is neither a path nor @NAME: systemd is told nothing",
                address,
                extra=about("setting"),
            )

    @property
    def active(self) -> bool:
        """Whether somebody wants to be told."""
        return self._socket is not None

    def send(self, **fields: object) -> bool:
        """Send these fields as one datagram; return whether it was taken."""
        if self._socket is None:
            return False
        try:
            self._socket.sendto("\n".join(f"{name}={value}" for name, value in fields.items()).encode(), self._address)
        except OSError as exc:  # nobody there, or too many datagrams wait: what matters is sent again
            _log.debug("systemd cannot be told: %s", exc)
            return False
        return True

    def close(self) -> None:
        """Close it; nothing is sent from then on."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class Notifier:
    """Tell systemd of a daemon while this is entered; does nothing where systemd does not ask for it.

    READY is sent when `daemon.ready` is set: the router listens, or the session is open, and all sources have begun.
    Sources that do not speak yet do not delay it; the text of the status names them.
    A client whose router does not answer counts as started after `patience` [s].

    WATCHDOG proves that all of it works: Zenoh answers how many sessions there are, the main thread has called `tick`
    since the last time, and the loop of no source has been at one message for half of what systemd waits.
    It is sent from a thread of its own, so that the main thread reacts to signals while Zenoh blocks.
    """

    def __init__(
        self, daemon: Daemon, *, environment: Mapping[str, str] = os.environ, patience: float = _PATIENCE
    ) -> None:
        self._daemon = daemon
        self._patience = patience
        self._socket = NotifySocket(environment.get("NOTIFY_SOCKET", ""))
        self._feeding = watchdog_interval(environment)
        self._begun = time.monotonic()
        self._fed = self._told = -float("inf")
        self._counted: tuple[float, int] | None = None  # when, and how many messages were published by then
        self._is_ready = self._ticked = False
        self._text = self._rejected = ""
        self._lock = threading.Lock()  # of _is_ready and what was sent of it; not taken in signal handlers
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="nedbus-systemd", daemon=True)

    def __enter__(self) -> Self:
        if self._socket.active:
            self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stopping()
        if self._thread.is_alive():
            self._thread.join(1.0)  # a thread inside Zenoh at the end of the interpreter would abort it
        self._socket.close()

    def tick(self) -> None:
        """Note that the main thread works, and the thread that it waits for; to be called ten times a second."""
        self._ticked = True

    def stopping(self) -> None:
        """Say that it ends; callable from a signal handler, and again."""
        if not self._stop.is_set():
            self._stop.set()
            self._socket.send(STOPPING=1, STATUS="ends")

    @contextmanager
    def reloading(self) -> Iterator[None]:
        """Say that the configuration is read again, and afterwards that all is ready; an error is said and passed on.

        The error stays in the text of the status until the next time.
        """
        with self._lock:
            if self._is_ready:
                now = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
                self._socket.send(RELOADING=1, MONOTONIC_USEC=now, STATUS="reads the configuration again")
        self._rejected = ""
        try:
            yield
        except Exception as exc:
            self._rejected = f"the new configuration is rejected, the old one works on: {exc}"
            raise
        finally:
            with self._lock:
                self._text = ""  # whatever the thread told last, it tells again
                if self._is_ready:  # if it is not taken, the thread sends it again: systemd waits for it
                    self._is_ready = self._socket.send(READY=1, STATUS=to_text(self._rejected or "ready", MAX_TEXT))

    def _run(self) -> None:
        while True:
            now = time.monotonic()
            begins = not self._is_ready and (self._daemon.ready.is_set() or self._has_waited(now))
            if begins or now - self._told >= _STATUS_INTERVAL:
                self._told = now
                self._tell(to_text(self._status(now), MAX_TEXT), begins=begins)
            if self._feeding is not None and now - self._fed >= self._feeding and self._works(self._feeding):
                self._fed, self._ticked = now, False
                self._socket.send(WATCHDOG=1)
            pause = _STATUS_INTERVAL if self._is_ready else _START_INTERVAL
            if self._stop.wait(pause if self._feeding is None else min(pause, self._feeding / 2)):
                return

    def _works(self, limit: float) -> bool:
        return self._ticked and self._daemon.busy < limit

    def _tell(self, text: str, *, begins: bool) -> None:
        with self._lock:
            if begins:
                self._is_ready = self._socket.send(READY=1, STATUS=text)
                self._text = text if self._is_ready else ""
            elif text != self._text and self._socket.send(STATUS=text):
                self._text = text

    def _has_waited(self, now: float) -> bool:
        return self._daemon.role == "client" and now - self._begun >= self._patience

    def _status(self, now: float) -> str:
        """Return what `systemctl status` shows: what is published, then what does not work, in one line."""
        daemon = self._daemon
        if not daemon.ready.is_set():
            where = " or ".join(daemon.endpoints)
            return f"waits for a router at {where}" if daemon.role == "client" else f"starts a router on {where}"
        sessions, sources = daemon.sessions, daemon.sources
        published = sum(source.published for source in sources)
        since, before = self._counted or (now, published)
        self._counted = now, published
        counts = [
            _count(len(sources), "source"),
            _count(sum(len(source.addresses) for source in sources), "stream"),
            f"{_round(max(0, published - before) / (now - since)) if now > since else 0:g} messages/s",
            _count(sessions, "session"),
        ]
        return "; ".join([", ".join(counts), *filter(None, [self._rejected]), *why_not_ready(daemon)])


def watchdog_interval(environment: Mapping[str, str]) -> float | None:
    """Return how often systemd wants to hear that this process works [s], half of what it waits; None for never."""
    limit = environment.get("WATCHDOG_USEC", "")
    if not limit.isdecimal() or int(limit) == 0 or environment.get("WATCHDOG_PID", "") not in {"", str(os.getpid())}:
        return None
    return int(limit) / 2e6


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _round(rate: float) -> float:
    """Return a rate with two digits: a status that changes all the time tells nobody anything."""
    return float(f"{rate:.2g}")
