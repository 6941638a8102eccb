"""A writer: one advanced publisher of Zenoh's, with its history cache, its sequence numbers and its heartbeats."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import zenoh
from zenoh import Priority

from nedbus.errors import ClosedError
from nedbus.transport import Session, entity_name, heartbeat_key, heartbeat_payload, while_open
from nedbus_msgs import Topic

_PAUSES: Final = (0.4, 0.5, 1.0, 2.0, 4.0)  # s of silence before the first heartbeat, and before those that follow it
_POLL, _IDLE = 0.1, 0.5  # s between two polls: while messages are published, and otherwise
_TURN: Final = 256  # heartbeats at once, as a job of housekeeping must not hold up the others
HEARTBEAT: Final = _PAUSES[0] + _POLL
"""Seconds after which a reader learns that it missed the newest message, of a stream that went on until then."""


class Writer:
    """Put payloads on one key; `cache` messages are kept for readers that missed some."""

    def __init__(
        self, heartbeats: Heartbeats, key: str, *, priority: Priority, cache: int, encoding: str | None = None
    ) -> None:
        self.session, self.key, self.priority, self.published = heartbeats.session, key, priority, 0
        self._heartbeats = heartbeats
        with while_open():
            # Joined routers look up the way of each message anew, unless something is declared on its very key.
            self._token = self.session.liveliness().declare_token(key)
            self._publisher: zenoh.ext.AdvancedPublisher | None = zenoh.ext.declare_advanced_publisher(
                self.session,
                key,
                encoding=encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=priority,
                cache=zenoh.ext.CacheConfig(cache),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            )
            self.name = entity_name(self._publisher.id)
            heartbeats.add(self)

    def put(self, payload: bytes, stamp: zenoh.Timestamp, encoding: str | None = None) -> None:
        """Put a payload, with an encoding in place of the writer's if one is given; never wait for a reader."""
        if self._publisher is None:
            raise ClosedError
        self._publisher.put(payload, timestamp=stamp, encoding=encoding)
        self.published += 1

    @property
    def closed(self) -> bool:
        """True once nothing can be put any more."""
        return self._publisher is None

    def close(self) -> None:
        """Withdraw the key and the cache; a second call does nothing."""
        self._heartbeats.remove(self)
        # Dropped, as nothing else refers to it: undeclare() would wait for Zenoh while it holds the interpreter's lock.
        self._publisher = None
        with suppress(zenoh.ZError):  # closed already with the session
            self._token.undeclare()


@dataclass(slots=True)
class _Silence:
    """The silence of a writer since its last message, of the number `published`; it begins with the first."""

    publisher: zenoh.Publisher
    published: int = 0
    sent: int = 1  # heartbeats in this silence
    due: float = math.inf  # s, the next one


class Heartbeats:
    """Send the heartbeats of all writers of a session; `send_due` is a job of its housekeeping."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._silences: dict[Writer, _Silence] = {}

    def add(self, writer: Writer) -> None:
        """Send heartbeats from the writer's first message on; they are declared, so that only readers cost one."""
        key, drop = heartbeat_key(writer.key, writer.name), zenoh.CongestionControl.DROP
        publisher = self.session.declare_publisher(key, congestion_control=drop, priority=writer.priority)
        self._silences[writer] = _Silence(publisher)

    def remove(self, writer: Writer) -> None:
        """Send no more heartbeats of a writer, if it has any."""
        self._silences.pop(writer, None)

    def send_due(self, now: float) -> float:
        """Send the heartbeats that are due at this monotonic time [s]; return the seconds until the next call."""
        pause, left = _IDLE, _TURN
        for writer, silence in tuple(self._silences.items()):
            if silence.published != writer.published:
                silence.published, silence.sent, silence.due = writer.published, 0, now + _PAUSES[0]
            elif silence.due <= now and left:
                left -= 1
                with suppress(zenoh.ZError):  # the session is closed
                    silence.publisher.put(heartbeat_payload(silence.published))
                silence.sent += 1
                silence.due = now + _PAUSES[min(silence.sent, len(_PAUSES) - 1)]
            pause = min(pause, silence.due - now, _IDLE if silence.sent else _POLL)
        return pause


def priority_of(topic: Topic) -> Priority:
    """Return Zenoh's priority of the messages of a topic."""
    return Priority.DATA_HIGH if topic.priority == "data_high" else Priority.DATA
