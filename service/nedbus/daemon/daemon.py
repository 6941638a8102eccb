"""The service: sources in, validated messages out, its status on demand, a clean end."""

from __future__ import annotations

import logging
import os
import re
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Final

from nedbus.client import HEARTBEAT, Housekeeping, PublisherRegistry, QueryServer, Sample, ServiceStatus, SourceStatus
from nedbus.errors import ConnectError
from nedbus.events import QUESTION, Account, AccountReport, report_of
from nedbus.log_event import about
from nedbus.settings import Settings, locate_setting
from nedbus.sources import LiveSource, Source
from nedbus.transport import UPLINK_POLL, Session, Uplinks, open_client, open_router, read_router_config
from nedbus_msgs import codec_of, provenance_of, status_key

from .plan import Planned, is_finite, plan_sources
from .status import Role, SourceMeasures
from .worker import Worker
from .workers import Workers
from .write_permission import WritePermission, watch_permission

_log = logging.getLogger(__name__)

_GRACE: Final = 1.0  # s that a source has to end
_LOOK: Final = 1.0  # s between two looks at what is silent, and at the link
_RELOADED: Final = frozenset({"source", "vehicle"})  # settings that can change while the service runs


class Daemon:
    """Publish the sources of the settings until they are done or `stop` is called.

    `run` blocks and is meant for a thread of its own, so that signals always reach the main thread.

    Raises ConfigError at once for an invalid source.
    """

    def __init__(self, settings: Settings, *, version: str) -> None:
        self._settings = settings
        self.version = version
        self.started = time.time()
        self._stop = threading.Event()
        self._changed = threading.Event()
        self._workers: Workers | None = None
        self._planning = threading.Lock()  # `run` starts what is planned, `reload` changes it
        self._registry: PublisherRegistry | None = None
        self._session: Session | None = None
        self._permission: WritePermission | None = None
        self.account = Account()
        # In containers every service may be process 1 of the same host name.
        self.id = re.sub(r"[^A-Za-z0-9_-]", "-", f"{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}")
        self.max_sessions: int | None = None  # of the embedded router, when it is open
        self.ready = threading.Event()
        self.role: Role = "client" if settings.is_client else "router"
        self.endpoints = settings.connect if settings.is_client else settings.router_endpoints
        self._plan = self._make_plan(settings)

    @property
    def until_done(self) -> bool:
        """True if it ends when its finite sources have ended."""
        return self._settings.until_done

    @property
    def status(self) -> ServiceStatus:
        """The status of the service now."""
        return ServiceStatus(
            service=self.id,
            host=socket.gethostname(),
            version=self.version,
            started=self.started,
            now=time.time(),
            role=self.role,
            endpoints=self.endpoints,
            refused=tuple(sorted(vehicle for vehicle, refused in self.refused.items() if refused)),
            sources=self.sources,
        )

    @property
    def sources(self) -> tuple[SourceStatus, ...]:
        """The status of each source now."""
        return tuple(worker.status for worker in self._list_workers())

    @property
    def refused(self) -> Mapping[str, bool]:
        """Answer of the router for each published vehicle where it is known: true if access rules refuse it."""
        return {} if self._permission is None else self._permission.refused

    @property
    def measures(self) -> list[SourceMeasures]:
        """Measurements of each source, for metrics."""
        return [worker.measures for worker in self._list_workers()]

    @property
    def busy(self) -> float:
        """For how long the loop of a source has not gone round, of the slowest one [s]: for a watchdog."""
        return max((worker.busy for worker in self._list_workers()), default=0.0)

    @property
    def sessions(self) -> int:
        """Number of connected sessions: of the embedded router, or of this client to its router."""
        return 0 if self._session is None else len(self._session.info.transports())

    def look(self, measures: Sequence[SourceMeasures] | None = None) -> Account:
        """Return the account of what happened, as it is now; `measures` of this moment, where they are known."""
        measured: dict[str, str] = {}
        for source in self.measures if measures is None else measures:
            measured |= source.states
        mains = [vehicle.main for vehicle in list(self.account.vehicles.values()) if vehicle.main is not None]
        states = {main: measured[str(main)] for main in mains if str(main) in measured}
        is_cut = self.role == "client" and self._session is not None and not self.sessions
        link = f"no link to {' or '.join(self.endpoints)}" if is_cut else ""
        self.account.look(time.time(), states, link=link)
        return self.account

    def report(self, *, within: float = 0.0) -> AccountReport:
        """Return what this service remembers of the last seconds, and the state of each vehicle now."""
        return report_of(self.look(), self.id, socket.gethostname(), time.time(), within=within)

    def _answer_events(self, within: str) -> dict[str, object]:
        try:
            seconds = float(within)
        except ValueError:
            seconds = 0.0
        return asdict(self.report(within=seconds))

    def newest(self) -> list[Sample]:
        """Return the last message of each address that was published."""
        publishers = self._registry.publishers if self._registry else []
        last = [(publisher, *publisher.last) for publisher in publishers if publisher.last]
        return [
            Sample(
                codec_of(publisher.definition).decode(payload),
                publisher.address,
                time.time_ns(),
                stamp,
                provenance=provenance_of(publisher.definition, encoding),
            )
            for publisher, payload, stamp, encoding in last
        ]

    def stop(self) -> None:
        """Ask it to end; callable from anywhere, a signal handler included."""
        self._stop.set()
        self._changed.set()

    def reload(self, settings: Settings) -> str:
        """Start sources that are new, stop those that are gone, leave all others alone; return what was done.

        Raises ConfigError, and changes nothing, for a source that is invalid, or another setting than source and
        vehicle that differs.
        """
        for name in type(settings).model_fields:
            if name not in _RELOADED and getattr(settings, name) != getattr(self._settings, name):
                raise locate_setting(settings, name, f"{name} cannot change while the service runs: restart it")
        plan = self._make_plan(settings)
        with self._planning:
            self._settings, self._plan = settings, plan
            if self._workers is None:
                return "nothing runs yet"
            started, stopped, kept = self._workers.apply(plan)
        self._changed.set()
        return f"{started} started, {stopped} stopped, {kept} unchanged"

    def run(self) -> bool:
        """Publish until done or stopped; return whether no source failed for good.

        Raises ListenError when the embedded router cannot listen, ConfigError for a mistake in its file.
        """
        if self.role == "client":
            self._log_client()
        session = self._open()
        if session is None:
            return True
        if self.role == "router":
            self._log_router()
        self._session = session
        settings, queries, housekeeping = self._settings, QueryServer(session), Housekeeping()
        registry = self._registry = PublisherRegistry(
            session, queries, housekeeping, prefix=self._settings.prefix, is_client=self.role == "client"
        )
        try:
            key = status_key(self.id, prefix=self._settings.prefix)
            queries.answer_json(key, lambda: asdict(self.status), **{QUESTION: self._answer_events})
            router = session if self.role == "router" else None
            with self._planning:
                self._workers = Workers(
                    lambda planned, clock: Worker(
                        planned.text,
                        planned.source,
                        registry,
                        router=router,
                        clock=clock,
                        account=self.account,
                        retry=not settings.until_done,
                        on_end=self._changed.set,
                    )
                )
                self._workers.apply(self._plan)
            self.ready.set()
            self._permission = watch_permission(session, settings, registry)
            self._wait(registry, Uplinks(session, settings.connect, tls=settings.tls) if router else None)
        finally:
            self._stop.set()
            if self._workers is not None:
                self._workers.end(_GRACE)
            queries.close()
            housekeeping.close()
            session.close()
            if self._permission is not None:
                self._permission.close()
        return not any(source.state == "failed" for source in self.sources)

    def _list_workers(self) -> list[Worker]:
        return self._workers.workers if self._workers is not None else []

    def _make_plan(self, settings: Settings) -> list[Planned]:
        """Return the sources of these settings, opened; raise ConfigError, with its place, for the first mistake."""
        plan, mistakes = plan_sources(settings, self.endpoints)
        if mistakes:
            raise mistakes[0]
        return plan

    def _log_client(self) -> None:
        """Log whose client it is, and what made it one: NEDBUS_CONNECT may be set for scripts."""
        setter = self._settings.set_by("connect")
        hint = "" if setter == "connect" else f", as set by {setter}: it starts no router of its own without --listen"
        _log.info("client of %s%s", ", ".join(self.endpoints), hint, extra=about("client"))

    def _log_router(self) -> None:
        connect = self._settings.connect
        joining = f", joining {', '.join(connect)}" if connect else ""
        _log.info("router on %s%s", ", ".join(self.endpoints), joining, extra=about("router"))

    def _open(self) -> Session | None:
        """Open the session; a client waits for its router for as long as it takes."""
        if self.role == "router":
            settings = self._settings
            session = open_router(
                listen=settings.listen,
                connect=settings.connect,
                config_file=settings.router_config,
                tls=settings.tls if settings.connect else None,
            )
            self.max_sessions = read_router_config(settings.router_config).max_sessions
            return session
        logged = False
        while not self._stop.is_set():
            try:
                return open_client(self.endpoints, timeout=1.0, tls=self._settings.tls, stop=self._stop)
            except ConnectError as exc:
                if not logged:
                    _log.warning("%s; still trying", exc, extra=about("link-broken"))
                logged = True
        return None

    def _wait(self, registry: PublisherRegistry, uplinks: Uplinks | None) -> None:
        """Wait for `stop`, or for the end of all finite sources and for their readers to have all of it."""
        watches = uplinks is not None and bool(self._settings.connect)
        while not self._stop.is_set():
            if self._settings.until_done:
                finite = [worker for worker in self._list_workers() if is_finite(worker.source)]
                if all(worker.status.ended for worker in finite):
                    # A reader that missed the very last message learns it from a heartbeat.
                    self._stop.wait(2 * HEARTBEAT if any(_is_paced(worker.source) for worker in finite) else 0.0)
                    registry.flush(registry.publishers, stop=self._stop)
                    return
            self._changed.wait(UPLINK_POLL if watches else _LOOK)
            self._changed.clear()
            self.look()
            if uplinks is not None:
                uplinks.check()


def _is_paced(source: Source) -> bool:
    return isinstance(source, LiveSource) or source.speed is not None
