"""Heartbeats: the number of the newest message of each stream that has fallen silent, for readers that missed it.

While a stream goes on, the next message shows by its number that one was lost.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import zenoh

from nedbus.transport import Session, heartbeat_key, heartbeat_payload

if TYPE_CHECKING:
    from .writer import Writer

_PAUSES: Final = (0.4, 0.5, 1.0, 2.0, 4.0)  # s of silence before the first heartbeat, and before those that follow it
_LOOK: Final = 0.1  # s between two looks while messages are published
_IDLE: Final = 0.5  # s between two looks otherwise
_TURN: Final = 256  # heartbeats at once, as a job of housekeeping must not hold up the others
HEARTBEAT: Final = _PAUSES[0] + _LOOK
"""Seconds after which a reader learns that it missed the newest message, of a stream that went on until then."""


@dataclass(slots=True, eq=False)
class _Silence:
    """The silence of a writer since it had published so many messages; `due`: the next heartbeat [s]."""

    writer: Writer
    publisher: zenoh.Publisher
    published: int = 0
    heartbeats: int = 1  # in this silence, or as if
    due: float = float("inf")


class Heartbeats:
    """Send the heartbeats of all writers of a session; `send_due` is a job of its housekeeping."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self._silences: dict[Writer, _Silence] = {}

    def add(self, writer: Writer) -> None:
        """Send heartbeats from the writer's first message on."""
        # Declared, so that nothing is sent while nobody reads it.
        publisher = self.session.declare_publisher(
            heartbeat_key(writer.key, writer.name),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=writer.priority,
        )
        self._silences[writer] = _Silence(writer, publisher)

    def remove(self, writer: Writer) -> None:
        """Send no more heartbeats of a writer, if it has any."""
        self._silences.pop(writer, None)

    def send_due(self, now: float) -> float:
        """Send what is due at this time, in monotonic seconds; return the seconds until the next look."""
        pause, soonest, left = _IDLE, now + _IDLE, _TURN
        for silence in tuple(self._silences.values()):
            if silence.published != silence.writer.published:
                silence.published, silence.heartbeats = silence.writer.published, 0
                silence.due = now + _PAUSES[0]
            elif silence.due <= now and left:
                left -= 1
                with suppress(zenoh.ZError):  # the session is closed
                    silence.publisher.put(heartbeat_payload(silence.published))
                silence.heartbeats += 1
                silence.due = now + _PAUSES[min(silence.heartbeats, len(_PAUSES) - 1)]
            if not silence.heartbeats:
                pause = _LOOK
            soonest = min(soonest, silence.due)
        return min(pause, soonest - now)
