"""The service: sources in, validated messages out, status on demand, a clean end."""

from __future__ import annotations

import logging
import os
import re
import socket
import threading
import time
from dataclasses import asdict, dataclass
from typing import Final, Literal

from nedbus_msgs import decode, origin_of, status_key

from .errors import ConfigError, ConnectError
from .intake import Sample
from .publisher import HEARTBEAT, Outbox
from .session import DEFAULT_ENDPOINT, Session, listened_by, open_client, open_router
from .settings import Settings, dialled
from .sources import Live, Source, parse_source
from .worker import Worker, WorkerStatus

_log = logging.getLogger(__name__)

_GRACE: Final = 1.0  # s that a source has to end


@dataclass(frozen=True, slots=True)
class ServiceStatus:
    """What a service tells of itself on `nedbus/@service/<id>/status`.

    Times are seconds since the epoch; `host` is the name of its host, or of its container.
    """

    service: str
    host: str
    version: str
    started: float
    now: float
    role: Literal["router", "client"]
    endpoints: tuple[str, ...]
    sources: tuple[WorkerStatus, ...]


class Daemon:
    """Publish the sources of the settings until they are done or `stop` is called.

    `run` blocks and is meant for a thread of its own, so that signals always reach the main thread.

    Raises ConfigError at once for a source that cannot be.
    """

    def __init__(self, settings: Settings, *, version: str) -> None:
        if not settings.source:
            raise ConfigError(
                "source", "nothing to publish: give --source sim:, ulog:FILE, px4-zenoh: or mavlink:LINK, or several"
            )
        self._settings = settings
        self._version = version
        self._started = time.time()
        self._stop = threading.Event()
        self._changed = threading.Event()
        self._workers: list[Worker] = []
        self._outbox: Outbox | None = None
        # In containers every service may be process 1 of the same host name.
        self.id = re.sub(r"[^A-Za-z0-9_-]", "-", f"{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}")
        self.ready = threading.Event()
        own = settings.listen or (settings.router_config and (str(settings.router_config),))
        self.role: Literal["router", "client"] = "client" if settings.connect and not own else "router"
        self.endpoints = settings.connect if self.role == "client" else own or (DEFAULT_ENDPOINT,)
        self._sources = [(text, self._open_source(text)) for text in settings.source]
        if settings.until_done and not any(_is_finite(source) for _, source in self._sources):
            raise ConfigError("until_done", "no source ever ends: give sim: a duration, or take loop=1 from ulog:")

    @property
    def until_done(self) -> bool:
        """Whether it ends when its finite sources have ended."""
        return self._settings.until_done

    @property
    def status(self) -> ServiceStatus:
        """What the service is doing now."""
        return ServiceStatus(
            service=self.id,
            host=socket.gethostname(),
            version=self._version,
            started=self._started,
            now=time.time(),
            role=self.role,
            endpoints=self.endpoints,
            sources=self.workers,
        )

    @property
    def workers(self) -> tuple[WorkerStatus, ...]:
        """What each source is doing now."""
        return tuple(worker.status for worker in self._workers)

    def newest(self) -> list[Sample]:
        """Return the last message of each address that was published."""
        publishers = self._outbox.publishers if self._outbox else []
        last = [(publisher.address, *publisher.last) for publisher in publishers if publisher.last]
        return [
            Sample(decode(payload), address, time.time_ns(), stamp, origin=origin_of(encoding))
            for address, payload, stamp, encoding in last
        ]

    def stop(self) -> None:
        """Ask it to end; callable from anywhere, a signal handler included."""
        self._stop.set()
        self._changed.set()

    def run(self) -> bool:
        """Publish until done or stopped; return whether no source failed for good.

        Raises ListenError when the embedded router cannot listen, ConfigError for a mistake in its file.
        """
        session = self._open()
        if session is None:
            return True
        joined = f", joined to {', '.join(self._settings.connect)}" if self._settings.connect else ""
        if self.role == "router":
            _log.info("router on %s%s", ", ".join(self.endpoints), joined)
        else:
            _log.info("client of %s", ", ".join(self.endpoints))
        outbox = self._outbox = Outbox(session, prefix=self._settings.prefix)
        threads: list[threading.Thread] = []
        try:
            outbox.answer_json(status_key(self.id, prefix=self._settings.prefix), lambda: asdict(self.status))
            retry = not self._settings.until_done
            self._workers = [
                Worker(text, source, outbox, stop=self._stop, retry=retry, on_end=self._changed.set)
                for text, source in self._sources
            ]
            threads = [threading.Thread(target=worker.run, name=worker.text, daemon=True) for worker in self._workers]
            for thread in threads:
                thread.start()
            self.ready.set()
            self._wait(outbox)
        finally:
            self._stop.set()
            deadline = time.monotonic() + _GRACE
            for thread in threads:
                thread.join(max(0.0, deadline - time.monotonic()))
            outbox.close()
            session.close()
        return not any(worker.state == "failed" for worker in self.workers)

    def _open_source(self, text: str) -> Source:
        settings = self._settings
        routers = settings.connect
        if self.role == "router":
            file = settings.router_config
            routers = settings.listen or (listened_by(file) if file else ()) or (DEFAULT_ENDPOINT,)
        return parse_source(text).open_source(
            vehicle=settings.vehicle, routers=tuple(map(dialled, routers)), tls=settings.tls
        )

    def _open(self) -> Session | None:
        """Open the session; a client waits for its router for as long as it takes."""
        if self.role == "router":
            settings = self._settings
            return open_router(listen=settings.listen, connect=settings.connect, config_file=settings.router_config)
        told = False
        while not self._stop.is_set():
            try:
                return open_client(self.endpoints, timeout=1.0, tls=self._settings.tls, stop=self._stop)
            except ConnectError as exc:
                if not told:
                    _log.warning("%s; still trying", exc)
                told = True
        return None

    def _wait(self, outbox: Outbox) -> None:
        """Wait for `stop`, or for the end of all finite sources and for their readers to have all of it."""
        while not self._stop.is_set():
            if self._settings.until_done:
                finite = [worker for worker in self._workers if _is_finite(worker.source)]
                if all(worker.status.ended for worker in finite):
                    # A reader that missed the very last message learns it from a heartbeat.
                    self._stop.wait(2 * HEARTBEAT if any(_is_paced(worker.source) for worker in finite) else 0.0)
                    outbox.flush(outbox.publishers, stop=self._stop)
                    return
            self._changed.wait()
            self._changed.clear()


def _is_finite(source: Source) -> bool:
    return not isinstance(source, Live) and source.finite


def _is_paced(source: Source) -> bool:
    return isinstance(source, Live) or source.speed is not None
