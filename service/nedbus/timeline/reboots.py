"""Reboots of a vehicle whose streams have no common order: two messages show one."""

from __future__ import annotations

from collections.abc import Hashable
from enum import Enum

from .vehicle_clock import REORDER_WINDOW, is_boot_possible


class RebootSign(Enum):
    """What a message shows about a reboot.

    FIRST: the vehicle may have rebooted; the next message decides. DAMAGED: it has not, the time of the first message
    was damaged. REBOOT: the second message confirms it.
    """

    NONE = "none"
    FIRST = "first"
    DAMAGED = "damaged"
    REBOOT = "reboot"


class RebootDetector:
    """Reboots, from the times of streams without a common order, as those of several publishers on a bus.

    A message shows a reboot if it is older than the one before it in its stream, and than another message, and if the
    vehicle can have booted since its last message. `VehicleClock` decides for a link, whose messages have one order,
    but may repeat the time of an old sample, so there two streams or a second must confirm it.

    `before`: the time before the last reboot, or a suspected one [us].
    """

    def __init__(self) -> None:
        self.before = 0
        self._suspected: Hashable = None  # the stream of the first message

    def add(
        self,
        stream: Hashable,
        time: int,
        *,
        before: int,
        other: int,
        elapsed: float,
    ) -> RebootSign:
        """Return what a message shows.

        `before`: the time of the message before it in its stream [us]. `other`: that of one more message, of this
        stream or another one [us]. `elapsed`: time since the last message [s].
        """
        is_earlier = min(before, other) > time + REORDER_WINDOW
        if self._suspected is None:
            if not is_earlier or not is_boot_possible(time, elapsed):
                return RebootSign.NONE
            self._suspected = stream
            self.before = before
            return RebootSign.FIRST
        is_same_stream = stream == self._suspected
        is_back = time >= self.before - REORDER_WINDOW
        if is_back and is_same_stream:
            self._suspected = None
            return RebootSign.DAMAGED
        if is_back or not (is_earlier or is_same_stream):
            return RebootSign.NONE
        self._suspected = None
        return RebootSign.REBOOT
