"""The service: publishes validated messages of its sources, replies to status queries, reloads and shuts down."""

import logging
import os
import re
import socket
import threading
from collections.abc import Collection, Mapping, Sequence
from typing import Final, Literal

from nedbus import clock
from nedbus.client import HEARTBEAT, PublisherRegistry, QueryServer, ServiceStatus, SourceStatus
from nedbus.endpoints import dial_endpoint
from nedbus.errors import ConfigError, ConnectError
from nedbus.log_event import about
from nedbus.settings import Settings, locate_setting, locate_source
from nedbus.sources import SOURCE_KINDS, ReplaySource, Source, parse_source
from nedbus.transport import Session, Uplinks, open_client, open_router, read_router_config
from nedbus.vehicle_events import AccountReport, EventLog, report_of
from nedbus_msgs import Address

from .status_replies import StatusReplies
from .worker import PlannedSource, SourceMeasures, Worker, stop_workers
from .write_permission import WritePermission, watch_permission

_log = logging.getLogger(__name__)

_GRACE: Final = 1.0  # s for sources to stop at shutdown
_RETIRE_TIMEOUT: Final = 5.0  # s for a source removed by a reload to stop
_POLL: Final = 1.0  # s between polls for silent streams and for the link
_RELOADABLE: Final = frozenset({"source", "vehicle"})  # settings that a reload can change
SOURCE_FORMS: Final = tuple(f"{name}:{kind.target or ''}" for name, kind in SOURCE_KINDS.items())
"""How the sources of a service are written, such as "ulog:FILE"; a part in brackets is optional."""

_TLS: Final = ("tls_key", "tls_certificate", "tls_ca")


def plan_sources(
    settings: Settings, endpoints: Sequence[str]
) -> tuple[list[PlannedSource], list[ConfigError]]:
    """Return the planned sources and the configuration errors, at most one per source; `endpoints`: of the service."""
    plan: list[PlannedSource] = []
    mistakes: list[ConfigError] = []
    if not settings.source and "source" not in settings.left_out:
        reason = "no source is given: use --source with sim:, ulog:FILE, px4-zenoh: or mavlink:LINK"
        mistakes.append(ConfigError("source", reason))
    tls = None
    try:
        tls = settings.tls
    except ConfigError as exc:
        if not settings.left_out.intersection(_TLS):
            given = [name for name in _TLS if getattr(settings, name)]
            mistakes.append(locate_setting(settings, given[0], exc.reason))
    routers = tuple(map(dial_endpoint, endpoints))
    for index, text in enumerate(settings.source):
        try:
            spec = parse_source(text)
            source = spec.open_source(
                vehicle=settings.vehicle, routers=routers, tls=tls, prefix=settings.prefix
            )
        except ConfigError as exc:
            mistakes.append(locate_source(settings, index, exc))
        else:
            plan.append(PlannedSource(index, spec.text, settings.vehicle, source))
    is_endless = plan and not any(is_finite(planned.source) for planned in plan)
    if settings.until_done and is_endless and not mistakes:
        reason = (
            "no source ever ends: use a log or a recording without loop=1, or sim: with duration="
        )
        mistakes.append(ConfigError("until_done", reason))
    return plan, mistakes


def is_finite(source: Source) -> bool:
    """Return True if a source ends without being stopped."""
    return isinstance(source, ReplaySource) and source.finite


class Daemon:
    """Publish the configured sources until they have ended or `stop` is called.

    `run` blocks; call it in a separate thread to keep the main thread free for signals.

    The constructor raises ConfigError for an invalid source.
    """

    def __init__(self, settings: Settings, *, version: str) -> None:
        self._settings = settings
        self.version = version
        self.started = clock.steady()
        self._stop = threading.Event()
        self._changed = threading.Event()
        self._workers: Sequence[Worker] = ()
        self._workers_lock = threading.Lock()  # held while workers start or stop
        self._registry: PublisherRegistry | None = None
        self._session: Session | None = None
        self._permission: WritePermission | None = None
        # vehicles of finite sources whose messages reached no reader
        self._refused_at_end: list[str] = []
        self.event_log = EventLog(reader="service")
        # Random, because services in containers may all be PID 1 on hosts of the same name.
        name = f"{socket.gethostname()}-{os.getpid()}-{os.urandom(3).hex()}"
        self.id = re.sub(r"[^A-Za-z0-9_-]", "-", name)
        self.max_sessions: int | None = None  # session limit of the embedded router, once open
        self.ready = threading.Event()
        self.closing = threading.Event()  # only the session is still open
        self.role: Literal["router", "client"] = "router"
        self.endpoints = settings.router_endpoints
        if settings.is_client:
            self.role = "client"
            self.endpoints = settings.connect
        self._plan = self._make_plan(settings)

    @property
    def until_done(self) -> bool:
        """True if the service stops once its finite sources have ended."""
        return self._settings.until_done

    @property
    def status(self) -> ServiceStatus:
        """Current status of the service."""
        return ServiceStatus(
            service=self.id,
            host=socket.gethostname(),
            version=self.version,
            started=self.started + clock.to_utc(),
            now=clock.utc(),
            role=self.role,
            endpoints=self.endpoints,
            refused=tuple(sorted(vehicle for vehicle, refused in self.refused.items() if refused)),
            sources=self.sources,
        )

    @property
    def sources(self) -> tuple[SourceStatus, ...]:
        """Current status of each source."""
        return tuple(worker.status() for worker in self._workers)

    @property
    def refused(self) -> Mapping[str, bool]:
        """Whether access rules deny each published vehicle; vehicles whose permission is unknown are omitted."""
        if self._permission is None:
            return {}
        return self._permission.refused

    @property
    def measures(self) -> list[SourceMeasures]:
        """Measurements of each source for metrics."""
        return [worker.measures for worker in self._workers]

    @property
    def busy(self) -> float:
        """Longest time that a source has spent on its current message [s], for watchdogs."""
        return max((worker.busy for worker in self._workers), default=0.0)

    @property
    def sessions(self) -> int:
        """Number of sessions connected to the embedded router, or of a client's links to its router."""
        if self._session is None:
            return 0
        return len(self._session.info.transports())

    def update_events(self, measures: Sequence[SourceMeasures] | None = None) -> EventLog:
        """Update and return the event log; `measures`: current measurements, if already available."""
        if measures is None:
            measures = self.measures
        measured: dict[str, str] = {}
        for source in measures:
            measured |= source.states
        present = set[str]()
        shared: Collection[str] = ()
        if self._registry is not None:
            present = {address.vehicle for address in tuple(self._registry.publishers)}
            shared = self._registry.shared_vehicles()
        states = dict[Address, str]()
        for vehicle in list(self.event_log.vehicles.values()):
            main = vehicle.main
            if main is None or str(main) not in measured:
                continue
            states[main] = "duplicate" if main.vehicle in shared else measured[str(main)]
        link = ""
        if self.role == "client" and self._session is not None and not self.sessions:
            link = f"no link to {' or '.join(self.endpoints)}"
        self.event_log.update(
            clock.steady(),
            states,
            link=link,
            dropped=sum(source.status.dropped for source in measures),
            is_behind=any(source.status.overload for source in measures),
            present=present,
        )
        return self.event_log

    def report(self, *, within: float = 0.0) -> AccountReport:
        """Return the events of the last `within` seconds and the current state of each vehicle."""
        event_log = self.update_events()
        host = socket.gethostname()
        now = clock.steady()
        return report_of(event_log, self.id, host, now, within=within, to_utc=clock.to_utc())

    def stop(self) -> None:
        """Stop `run`; safe to call from any thread and from signal handlers."""
        self._stop.set()
        self._changed.set()

    def reload(self, settings: Settings) -> str:
        """Start new sources, stop removed ones and leave all others running; return a summary for the log.

        Raises ConfigError, and changes nothing, if a source is invalid, or a setting other than source and vehicle has
        changed.
        """
        for name in type(settings).model_fields:
            if name not in _RELOADABLE and getattr(settings, name) != getattr(self._settings, name):
                reason = f"{name} cannot be changed by a reload: restart the service"
                raise locate_setting(settings, name, reason)
        plan = self._make_plan(settings)
        with self._workers_lock:
            self._settings = settings
            self._plan = plan
            if self._registry is None:
                return "no source is running yet"
            before = len(self._workers)
            unchanged = self._apply_plan(self._registry)
        self._changed.set()
        started = len(plan) - unchanged
        stopped = before - unchanged
        return f"{started} started, {stopped} stopped, {unchanged} unchanged"

    def run(self) -> bool:
        """Publish until done or stopped; return False if a source failed, or the router refused what was published.

        Raises ListenError or ConfigError.
        """
        session = self._session = self._open()
        if session is None:
            return True
        settings = self._settings
        queries = QueryServer(session)
        is_client = self.role == "client"
        replies = StatusReplies(
            queries,
            self.id,
            prefix=settings.prefix,
            status=lambda: self.status,
            report=lambda within: self.report(within=within),
        )
        registry = PublisherRegistry(
            session, queries, prefix=settings.prefix, is_client=is_client, on_vehicle=replies.add
        )
        try:
            with self._workers_lock:
                self._registry = registry
                self._apply_plan(registry)
            replies.add(settings.vehicle)  # reports sources that have not published a vehicle yet
            self.ready.set()
            self._permission = watch_permission(session, settings, registry)
            self._wait(
                registry,
                replies,
                Uplinks(session, settings.connect, is_client=is_client, tls=settings.tls),
            )
        finally:
            self._stop.set()
            stop_workers(self._workers, _GRACE)
            self.closing.set()
            queries.close()
            registry.heartbeats.close()
            session.close()
            # their calls into Zenoh fail now; a thread that is still in one when Python exits aborts the process
            stop_workers(self._workers, _GRACE)
            if self._permission is not None:
                self._permission.close()
        has_failed = any(source.state == "failed" for source in self.sources)
        return not (self._refused_at_end or has_failed)

    def _apply_plan(self, registry: PublisherRegistry) -> int:
        """Stop removed sources and start new ones, in the order of the plan; return the number of unchanged sources."""
        removed = list(self._workers)
        ordered = list[Worker]()
        new = list[Worker]()
        router = self._session if self.role == "router" else None
        for planned in self._plan:
            unchanged = [worker for worker in removed if worker.planned == planned]
            if unchanged:
                removed.remove(unchanged[0])
                ordered.append(unchanged[0])
                continue
            worker = Worker(
                planned,
                registry,
                router=router,
                event_log=self.event_log,
                retry=not self.until_done,
                on_end=self._changed.set,
            )
            new.append(worker)
            ordered.append(worker)
        stop_workers(removed, _RETIRE_TIMEOUT, release=True)
        for worker in removed:
            if worker.thread.is_alive():  # a lossless publisher waits for its slowest reader
                text = "%s: still stopping after %.0f s, possibly because of a slow reader"
                _log.warning(text, worker.text, _RETIRE_TIMEOUT, extra=about("reload"))
        # before the first message, whose readers may query the status of its source
        self._workers = ordered
        # after the removed workers have stopped, because both may use the same addresses
        for worker in new:
            worker.thread.start()
        return len(ordered) - len(new)

    def _make_plan(self, settings: Settings) -> list[PlannedSource]:
        plan, mistakes = plan_sources(settings, self.endpoints)
        if mistakes:
            raise mistakes[0]
        return plan

    def _open(self) -> Session | None:
        """Open the session; a client waits for its router. Return None if stopped during the wait."""
        if self.role == "router":
            return self._open_router()
        settings = self._settings
        setter = settings.set_by("connect")
        hint = ""
        if setter != "connect":  # NEDBUS_CONNECT may have been set for scripts
            hint = f", set by {setter}; use --listen to run a router instead"
        text = "connecting to a router at %s%s"
        _log.info(text, ", ".join(self.endpoints), hint, extra=about("client"))
        is_logged = False
        while not self._stop.is_set():
            try:
                return open_client(self.endpoints, timeout=1.0, tls=settings.tls, stop=self._stop)
            except ConnectError as exc:
                if not is_logged:
                    _log.warning("%s; still trying", exc, extra=about("link_lost"))
                is_logged = True
        return None

    def _open_router(self) -> Session:
        settings = self._settings
        session = open_router(
            listen=settings.listen,
            connect=settings.connect,
            config_file=settings.router_config,
            tls=settings.tls if settings.connect else None,
        )
        self.max_sessions = read_router_config(settings.router_config).max_sessions
        joining = f", joining {', '.join(settings.connect)}" if settings.connect else ""
        _log.info("router on %s%s", ", ".join(self.endpoints), joining, extra=about("router"))
        return session

    def _wait(self, registry: PublisherRegistry, replies: StatusReplies, uplinks: Uplinks) -> None:
        """Wait for `stop`, or until all finite sources have ended and their messages are acknowledged."""
        while not self._stop.is_set():
            if self._settings.until_done and self._is_done():
                self._flush(registry)
                return
            self._changed.wait(_POLL)
            self._changed.clear()
            for vehicle in list(self.update_events().vehicles):
                replies.add(vehicle)
            uplinks.check()

    def _is_done(self) -> bool:
        """Return whether all finite sources have ended."""
        return all(worker.status().ended for worker in self._workers if is_finite(worker.source))

    def _flush(self, registry: PublisherRegistry) -> None:
        """Wait until readers have acknowledged all messages; note the vehicles that reached none."""
        sources = [worker.source for worker in self._workers]
        if any(
            isinstance(source, ReplaySource) and source.finite and source.options.speed
            for source in sources
        ):
            self._stop.wait(
                2 * HEARTBEAT
            )  # heartbeats let readers detect the loss of the last message
        registry.flush(tuple(registry.publishers.values()), stop=self._stop)
        if self._permission is not None:
            self._refused_at_end = self._permission.decide()
