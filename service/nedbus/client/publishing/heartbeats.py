"""Heartbeats: the number of the newest message of each stream that has fallen silent, for readers that missed it."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import zenoh

from nedbus.transport import Session, heartbeat_key, heartbeat_payload

if TYPE_CHECKING:
    from .writer import Writer

_PAUSES: Final = (0.4, 0.5, 1.0, 2.0, 4.0)  # s of silence before the first heartbeat, and before those that follow it
_LOOK, _IDLE = 0.1, 0.5  # s between two looks: while messages are published, and otherwise
_TURN: Final = 256  # heartbeats at once, as a job of housekeeping must not hold up the others
HEARTBEAT: Final = _PAUSES[0] + _LOOK
"""Seconds after which a reader learns that it missed the newest message, of a stream that went on until then."""


@dataclass(slots=True)
class _Silence:
    """The silence of a writer since it had `published` so many messages; it begins with the first."""

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
        """Send what is due at this time, in monotonic seconds; return the seconds until the next look."""
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
            pause = min(pause, silence.due - now, _IDLE if silence.sent else _LOOK)
        return pause
