"""Writers: Zenoh's advanced publishers with history cache, sequence numbers and heartbeats."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from contextlib import suppress
from time import monotonic
from typing import Final

import zenoh
from zenoh import Priority

from nedbus.client.io_thread import TICK, Job
from nedbus.errors import ClosedError, NedbusError
from nedbus.transport import (
    Session,
    entity_name,
    heartbeat_key,
    heartbeat_payload,
    translate_zenoh_errors,
)
from nedbus_msgs import Topic

from .group import HOLD, Group, Outgoing

# s of silence before the first heartbeat, and between the following ones
_PAUSES: Final = (0.4, 0.5, 1.0, 2.0, 4.0)
_TURN: Final = 256  # heartbeats per call; more would delay other jobs
# maximum time [s] until readers detect the loss of the last message
HEARTBEAT: Final = _PAUSES[0] + 2 * TICK


class Writer:
    """Put payloads of one topic on one key, with a history cache of `cache` messages."""

    def __init__(
        self,
        heartbeats: Heartbeats,
        key: str,
        topic: Topic,
        *,
        cache: int,
        encoding: zenoh.Encoding | None = None,
    ) -> None:
        self.session = heartbeats.session
        self.key = key
        self.published = 0
        self.priority = Priority.DATA_HIGH if topic.priority == "data_high" else Priority.DATA
        self.last_put = 0.0  # monotonic time of the last message [s]
        # before the first message, and once a heartbeat has followed the last one
        self.is_silent = True
        # time of the last message [s], and heartbeats since then
        self.silent_since, self.sent_heartbeats = 0.0, 0
        # monotonic time of the next heartbeat, or of a check of `last_put` [s]
        self.heartbeat_due = math.inf
        self._heartbeats, self._encoding = heartbeats, encoding
        with translate_zenoh_errors():
            self._publisher: zenoh.ext.AdvancedPublisher | None = (
                zenoh.ext.declare_advanced_publisher(
                    self.session,
                    key,
                    encoding=encoding,
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=self.priority,
                    cache=zenoh.ext.CacheConfig(cache),
                    sample_miss_detection=zenoh.ext.MissDetectionConfig(
                        heartbeat=None, sporadic_heartbeat=None
                    ),
                )
            )
            self.name = entity_name(self._publisher.id)
            try:
                # Interconnected routers cache the route of a message only if something is declared on its exact key.
                self._token = self.session.liveliness().declare_token(key)
            except BaseException:
                self._publisher = None  # the traceback references `self`
                raise
        heartbeats.writers.add(self)

    def put(self, messages: Sequence[Outgoing]) -> None:
        """Put messages in order without waiting for readers; if that fails, `published` counts those that were put."""
        if (publisher := self._publisher) is None:
            raise ClosedError
        sent, declared = 0, self._encoding
        try:
            for payload, stamp, encoding in messages:
                sent += 1  # before the put, after which Ctrl-C may be raised
                if encoding is declared:
                    publisher.put(payload, timestamp=stamp)
                else:
                    publisher.put(payload, timestamp=stamp, encoding=encoding)
        except zenoh.ZError:
            sent -= 1
            raise
        finally:
            self.published += sent
            if sent:
                self.last_put = monotonic()
                if self.is_silent:
                    self._heartbeats.resume(self)

    @property
    def closed(self) -> bool:
        """True once the writer is closed."""
        return self._publisher is None

    def close(self) -> None:
        """Withdraw the key and the history cache. Idempotent."""
        self._heartbeats.writers.discard(self)
        # This drops the only reference: undeclare() would wait for Zenoh while holding the GIL.
        self._publisher = None
        with suppress(zenoh.ZError):  # the session is already closed
            self._token.undeclare()


class Heartbeats:
    """Send the heartbeats of all writers of a session, and hand over the groups that remain incomplete.

    Without readers, heartbeats cause no traffic.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.writers: set[Writer] = set()
        self._groups: set[Group] = set()  # changed by single atomic calls
        self._job: Job | None = None
        self._closed = False
        self._lock = threading.Lock()  # guards both: several threads may put the first message

    def resume(self, writer: Writer) -> None:
        """Schedule the heartbeat of a writer that has put a message after a silence."""
        writer.is_silent, writer.heartbeat_due = False, writer.last_put + _PAUSES[0]
        with self._lock:
            if self._job is None and not self._closed:
                self._job = Job(self._run)
            job = self._job
        if job is not None:
            job.wake(writer.heartbeat_due)

    def watch(self, group: Group) -> bool:
        """Hand over the messages of a group within HOLD, now and later; return False once closed."""
        group.is_watched = True
        self._groups.add(group)
        if self._job is not None:  # `resume` has created it for the first message
            self._job.wake()
        if self._closed:  # checked last: `close` handles the groups added before it is set
            group.is_watched = False
        return not self._closed

    def close(self) -> None:
        """Stop all heartbeats, and hand over all groups: now, and from now on after each message. Idempotent."""
        with self._lock:
            self._closed = True
        if self._job is not None:
            self._job.end()
        for group in tuple(self._groups):
            group.is_watched = False
            with suppress(NedbusError):  # the session or the writer is closed
                group.hand_over()
        self._groups.clear()
        self.writers.clear()

    def _run(self, now: float) -> float:
        self._hand_over()
        due = now + self.send_due(now)
        if self._job is not None and due < math.inf:  # without a job yet, `resume` wakes it
            self._job.wake(due)  # at the next tick; a returned pause would end at the tick before
        return HOLD if self._groups else math.inf

    def _hand_over(self) -> None:
        for group in tuple(self._groups):
            if not group:  # full speed has ended
                self._groups.discard(group)
                group.is_watched = False
            if group:  # checked again: a message added before `is_watched` was reset
                self._groups.add(group)
                group.is_watched = True
                with suppress(NedbusError):  # the session or the writer is closed
                    group.try_hand_over()

    def send_due(self, now: float) -> float:
        """Send all heartbeats due at monotonic time `now` [s]; return the seconds until the next call."""
        left = _TURN
        for writer in tuple(self.writers):
            if writer.heartbeat_due > now or not left:
                continue
            # before `last_put` is read: a message after that calls `resume`
            writer.is_silent = True
            if writer.silent_since != writer.last_put:
                writer.silent_since, writer.sent_heartbeats = writer.last_put, 0
                writer.heartbeat_due = writer.silent_since + _PAUSES[0]
            if writer.heartbeat_due > now:
                writer.is_silent = False
                continue
            left -= 1
            payload, drop = heartbeat_payload(writer.published), zenoh.CongestionControl.DROP
            with suppress(zenoh.ZError):  # the session is closed
                # Not from a publisher: Zenoh keeps a few kB per declared publisher until the session closes.
                key = heartbeat_key(writer.key, writer.name)
                self.session.put(key, payload, congestion_control=drop, priority=writer.priority)
            writer.sent_heartbeats += 1
            writer.heartbeat_due = now + _PAUSES[min(writer.sent_heartbeats, len(_PAUSES) - 1)]
        return min((writer.heartbeat_due for writer in tuple(self.writers)), default=math.inf) - now
