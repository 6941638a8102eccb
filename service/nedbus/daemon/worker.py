"""Worker threads of a service; each runs one source, a replay or a live source."""

import logging
import threading
import time
from collections.abc import Callable, Collection, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Final, Literal, cast, get_args

from nedbus import limits
from nedbus.client import Histogram, PositionStatus, PublisherRegistry, SourceStatus, stream_state
from nedbus.errors import ClosedError, NedbusError, SourceError
from nedbus.log_event import about
from nedbus.sources import (
    SOURCE_KINDS,
    LinkCopies,
    LinkLoad,
    LiveItem,
    LiveSource,
    Rejection,
    ReplayRun,
    ReplaySource,
    Source,
    SourceMessage,
    UnavailableTopics,
    parse_source,
)
from nedbus.timeline import SKIPPED_PAUSE, Pace
from nedbus.timings import TIMINGS
from nedbus.transport import Session
from nedbus.vehicle_events import EventLog
from nedbus_msgs import DEFAULT_TOPIC, Address

from .output import TOO_MANY, SourceOutput

_log = logging.getLogger(__name__)

# s per run of a loop: a log of one message must not be read thousands of times a second
_SHORTEST_RUN: Final = 0.1
# s; a replay that falls further behind shifts its schedule instead of catching up
_TOLERATED_DELAY: Final = 1.0
_STALE_POLL: Final = 0.5  # s between checks for stale streams
_READER_POLL: Final = 0.05  # s between checks for a subscriber

State = Literal["starting", "waiting", "running", "retrying", "done", "failed"]
STATES: Final[tuple[State, ...]] = get_args(State)
"""States of a source, in `SourceStatus.state`."""


@dataclass(frozen=True, slots=True)
class PlannedSource:
    """A configured source, number `index` in the settings; a reload keeps it if text and vehicle are unchanged."""

    index: int = field(compare=False)
    text: str
    vehicle: str
    source: Source = field(compare=False)

    def addresses(self, *, offline: bool = False) -> Collection[Address]:
        """Return the addresses of a replay, or the position addresses of vehicles named in a live source's options.

        `offline`: no file is read, and the addresses of a log or recording are unknown.

        Raises SourceError or OSError if the file cannot be read.
        """
        spec = parse_source(self.text)
        if isinstance(self.source, LiveSource):
            named = {
                getattr(spec.options, "vehicle", None),
                *getattr(spec.options, "vehicles", {}).values(),
            }
            return [Address(vehicle, DEFAULT_TOPIC) for vehicle in named if vehicle is not None]
        if offline and SOURCE_KINDS[spec.kind].target == "FILE":
            return ()
        run = self.source.open()
        with closing(run.messages):  # type: ignore[type-var] # replays are generators
            return run.addresses


@dataclass(frozen=True, slots=True)
class SourceMeasures:
    """Measurements of one source for metrics: status with all streams, and publish durations [s]."""

    status: SourceStatus
    durations: Histogram

    @property
    def beyond_limit(self) -> int:
        """Messages of a replay that are rejected because their address is beyond the limit of 10,000."""
        return self.status.rejections.get(TOO_MANY, 0)

    @property
    def states(self) -> dict[str, str]:
        """State of each stream by address; all are ok after the end of the source."""
        streams = self.status.streams
        if self.status.ended:
            return {stream.address: "ok" for stream in streams}
        alive = frozenset(self.status.addresses)
        return {
            stream.address: stream_state(stream.health, publishers=stream.address in alive).name
            for stream in streams
        }


class Clock(threading.Event):
    """Monotonic clock and stop flag: `wait` returns early once `set` is called; replaced by a fake clock in tests."""

    now = staticmethod(time.monotonic)


class Worker:
    """Run one source in a thread until the worker is stopped; publishers stay open after the source has ended.

    `retry`: restart a failed replay with exponential backoff; a failed live source is restarted in any case.
    `router`: the embedded router, for live sources; `on_end`: called when the source has ended.
    """

    def __init__(
        self,
        planned: PlannedSource,
        registry: PublisherRegistry,
        *,
        router: Session | None = None,
        clock: Clock | None = None,
        event_log: EventLog,
        retry: bool,
        on_end: Callable[[], object],
    ) -> None:
        self.planned = planned
        self.source = planned.source
        # file names may be invalid UTF-8
        self.text = planned.text.encode(errors="backslashreplace").decode()
        self.thread = threading.Thread(target=self._run_and_release, name=self.text, daemon=True)
        self._name = self.text.rstrip(":")  # name in the log
        self._registry = registry
        self._router = router
        self._clock = clock or Clock()
        self._retry = retry or isinstance(self.source, LiveSource)
        self._on_end = on_end
        self._output = SourceOutput(self._name, self.text, registry, self._clock.now, event_log)
        self._run: ReplayRun | None = None
        self._state: State = "starting"
        self._error: str | None = None
        self._done = 0
        self._retries = 0
        # when publishing of the current message began; None while waiting
        self._message_start: float | None = None
        self._release = False
        self._warned: set[str] = set()

    @property
    def busy(self) -> float:
        """Time spent on the current message [s]; 0 while opening a source or waiting for the next message."""
        since = self._message_start  # changed on another thread
        if since is None:
            return 0.0
        return self._clock.now() - since

    @property
    def measures(self) -> SourceMeasures:
        """Measurements of the source for metrics."""
        return SourceMeasures(self.status(None), self._output.durations)

    def status(self, max_streams: int | None = limits.STATUS_STREAMS) -> SourceStatus:
        """Return the status of the source with at most `max_streams` streams, None for all."""
        run, output = self._run, self._output
        return SourceStatus(
            source=self.text,
            state=self._state,
            addresses=tuple(map(str, list(run.addresses) if run else output.addresses)),
            stale=tuple(map(str, output.stale)),
            published=output.published,
            rejected=output.rejected,
            rejections=dict(output.rejections),
            lost=output.lost,
            dropped=output.load.dropped,
            overload=output.load.overload,
            reboots=output.reboots,
            copies=output.copies,
            done=run.done(self._done) if run else self._done,
            total=run.total if run else None,
            retries=self._retries,
            summary=run.summary if run else "",
            warnings=run.warnings if run else output.warnings,
            error=self._error,
            streams=output.streams(max_streams),
            not_carried=output.unavailable.unsupported,
            silent=output.unavailable.silent,
            log_streams=tuple(output.log_streams.values()),
            positions=tuple(output.positions.values()),
        )

    def run(self) -> None:
        """Run the source until done or stopped, repeat it if it loops, restart it after failures; never raise."""
        try:
            self._run_until_done()
        except BaseException as exc:  # noqa: BLE001 - the state must not stay "running" when the thread ends
            extra = about("failed", source=self._name)
            _log.exception("%s: stopped by an unexpected error", self._name, extra=extra)
            self._state = "failed"
            self._error = _describe(exc)
        finally:
            self._on_end()

    def stop(self, *, release: bool) -> None:
        """Stop the source; with `release`, its thread closes the publishers, which may wait for slow readers."""
        self._release = release
        self._clock.set()

    def _run_and_release(self) -> None:
        self.run()
        self._clock.wait(None)
        if self._release:
            self._output.release()
            text = "%s: stopped, because it is no longer configured"
            _log.info(text, self.text, extra=about("reload"))

    def _run_until_done(self) -> None:
        failures = 0
        while not self._clock.is_set():
            start = self._clock.now()
            try:
                self._run_once()
            except ClosedError as exc:
                self._end("failed", str(exc))
                return
            except BaseException as exc:  # noqa: BLE001 - fails only this source; a Rust panic is not an Exception
                self._fail(exc)
            else:
                if isinstance(self.source, LiveSource) or self.source.finite:
                    self._end("failed" if self._error else "done", self._error)
                    return
                failures = 0
                self._clock.wait(max(0.0, start + _SHORTEST_RUN - self._clock.now()))
                continue
            finally:
                self._message_start = None
            if not self._retry:
                self._end("failed", self._error)
                return
            if self._clock.now() - start > TIMINGS.backoff[-1]:
                failures = 0  # it ran for longer than the maximum backoff
            last_step = len(TIMINGS.backoff) - 1
            self._clock.wait(TIMINGS.backoff[min(failures, last_step)])
            failures += 1

    def _run_once(self) -> None:
        if isinstance(self.source, LiveSource):
            self._listen(self.source)
        else:
            self._run_replay(self.source)

    def _run_replay(self, source: ReplaySource) -> None:
        speed = source.options.speed
        run = self._open_run(source)
        self._output.release(keep=run.addresses)
        self._output.claim_all(run, lossless=speed is None, stop=self._clock)
        self._set_state("running")
        pace = Pace(speed or 1.0)
        start = self._clock.now()
        for message in run.messages:
            due = pace.publish_at(message.at)
            if message.dropout:
                self._output.begin_dropout(message)
            if speed is not None:
                start += self._wait_until(start + due)
            if self._clock.is_set():
                return
            if speed is not None:  # a lossless publisher may wait for its readers
                self._message_start = self._clock.now()
            self._output.publish_replay(message, lossless=speed is None)
            self._message_start = None
            self._done += 1
        if pace.skipped:
            warning = f"skipped pauses of more than {SKIPPED_PAUSE:.0f} s ({pace.skipped})"
            run.warnings = (*run.warnings, warning)
        self._warn(run)
        self._error = run.damage

    def _open_run(self, source: ReplaySource) -> ReplayRun:
        """Open a replay, and wait for a subscriber if the source shall; log both."""
        run = source.open()
        last = self._run
        if last is None or last.summary != run.summary:
            extra = about("replay_opened", source=self._name)
            _log.info("%s: %s", self._name, run.summary, extra=extra)
            self._warned.clear()
        else:
            # so a loop keeps the publishers of streams that start later
            run.addresses.update(last.addresses)
        self._warn(run)
        self._run = run
        self._done = 0
        if source.options.wait and last is None:
            self._state = "waiting"
            extra = about("replay_waiting", source=self._name)
            _log.info("%s: waiting for a subscriber", self._name, extra=extra)
            while not self._registry.has_subscriber(run.addresses):
                if self._clock.wait(_READER_POLL):
                    break
        return run

    def _wait_until(self, due: float) -> float:
        """Wait until a message is due; return how much later all are due from now on, because it is too late [s]."""
        early = due - self._clock.now()
        if early > 0:
            self._clock.wait(early)
        if early >= -_TOLERATED_DELAY:
            return 0.0
        text = (
            "%s: the replay is %.1f s behind its schedule, so later messages are delayed by as much"
        )
        _log.warning(text, self._name, -early, extra=about("replay_late", source=self._name))
        return -early

    def _warn(self, run: ReplayRun) -> None:
        for warning in run.warnings:
            if warning in self._warned:
                continue
            self._warned.add(warning)
            extra = about("damaged", source=self._name, reason=warning)
            _log.warning("%s: %s", self._name, warning, extra=extra)

    def _listen(self, source: LiveSource) -> None:
        """Publish the messages of a live source, which yields None several times a second while no message arrives."""
        # live sources are generators
        with closing(cast("Generator[LiveItem]", source.listen(self._router))) as items:
            next_poll = 0.0
            for item in items:
                now = self._clock.now()
                self._message_start = now
                if self._clock.is_set():
                    return
                self._handle(item)
                if now >= next_poll:
                    next_poll = now + _STALE_POLL
                    if not self._output.expire_stale():
                        self._set_state("waiting")

    def _handle(self, item: LiveItem) -> None:
        output = self._output
        if isinstance(item, SourceMessage):
            output.publish_live(item)
            if self._state != "running":
                self._set_state("running")
        elif isinstance(item, Rejection):
            output.reject(item)
        elif isinstance(item, UnavailableTopics):
            output.note(item)
        elif isinstance(item, LinkLoad):
            output.note_load(item)
        elif isinstance(item, LinkCopies):
            output.copies = item.count
        elif isinstance(item, PositionStatus):
            output.positions[item.address] = item
        elif item is not None:
            output.log_streams[item.vehicle] = item

    def _set_state(self, state: State) -> None:
        if isinstance(self.source, LiveSource) and self._state in {"starting", "retrying"}:
            _log.info("%s: listening", self._name, extra=about("listening", source=self._name))
        self._state = state
        self._error = None

    def _end(self, state: Literal["done", "failed"], reason: str | None) -> None:
        if self._clock.is_set():
            return
        self._state = state
        self._error = reason
        text = f"{state}, {self._output.published} published, {self._output.rejected} rejected"
        event = "done"
        if state == "failed":
            event = "failed"
        _log.info("%s: %s", self._name, text, extra=about(event, source=self._name, reason=reason))

    def _fail(self, error: BaseException) -> None:
        """Log and store the reason; release all addresses, because another source may use them during the backoff."""
        reason = _describe(error)
        self._state = "retrying"
        self._error = reason
        self._retries += 1
        text = reason if isinstance(error, SourceError) else f"{self._name}: {reason}"
        event = "failed"
        if self._retry:
            text += "; trying again"
            event = "retrying"
        bug = None if isinstance(error, NedbusError) else error
        _log.error("%s", text, exc_info=bug, extra=about(event, source=self._name, reason=reason))
        self._output.release()


def _describe(error: BaseException) -> str:
    if isinstance(error, NedbusError):
        return str(error)
    return f"unexpected {type(error).__name__}: {error}"


def stop_workers(workers: Sequence[Worker], grace: float, *, release: bool = False) -> None:
    """Stop workers and wait up to `grace` seconds; `release` as in `Worker.stop`."""
    for worker in workers:
        worker.stop(release=release)
    deadline = time.monotonic() + grace
    for worker in workers:
        if worker.thread.ident is not None:  # None: not started, because another one could not be
            worker.thread.join(max(0.0, deadline - time.monotonic()))
