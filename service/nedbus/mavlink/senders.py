"""Ids of the senders on a MAVLink link."""

from typing import Final

AUTOPILOT: Final = 1  # component id; cameras, gimbals and ground stations have others


def ignore_reason(system: int, component: int) -> str:
    """Return why the messages of a sender are ignored; "" for an autopilot."""
    if not (system and component):
        return "id 0 is for broadcast only; an autopilot has system id 1 to 255 and component id 1"
    return "" if component == AUTOPILOT else f"not an autopilot, which has component id {AUTOPILOT}"
