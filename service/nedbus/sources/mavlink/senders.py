"""Senders on a MAVLink link: autopilots, others, and two autopilots with one system id."""

from collections import defaultdict, deque
from typing import Any, Final

AUTOPILOT: Final = 1
"""Component id of an autopilot; cameras, gimbals and ground stations have others."""

_CHANGES: Final = 5  # of the address within the window; a reconnect is one, and a packet that overtakes two more
_WINDOW: Final = 5.0  # s

Peer = Any  # address of the other side, as its socket has it


def why_ignored(system: int, component: int) -> str:
    """Return the reason why the messages of a sender are ignored, "" for those of an autopilot."""
    if not (system and component):
        return "id 0 addresses all and is no sender's; an autopilot has system id 1 to 255 and component id 1"
    return "" if component == AUTOPILOT else f"not an autopilot, which has component id {AUTOPILOT}"


class Senders:
    """Finds system ids that two senders use, as their messages come from both addresses in turn."""

    def __init__(self) -> None:
        self._changes: defaultdict[int, deque[tuple[Peer, float]]] = defaultdict(lambda: deque(maxlen=_CHANGES))
        self._found: set[int] = set()

    def add(self, system: int, peer: Peer, now: float) -> str:
        """Add a message at monotonic time `now` [s]; return a description of two senders, once for each system."""
        changes = self._changes[system]
        if changes and changes[-1][0] == peer:
            return ""
        changes.append((peer, now))
        if len(changes) < _CHANGES or now - changes[0][1] > _WINDOW or system in self._found:
            return ""
        self._found.add(system)
        both = " and ".join(":".join(map(str, each[:2])) for each in (changes[-2][0], peer))  # only UDP has several
        return f"{both} both send as system {system}, and their messages are mixed: give each its own MAV_SYS_ID"
