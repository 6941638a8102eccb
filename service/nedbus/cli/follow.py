"""The loop of commands that follow a subscription; it logs when the link to the router breaks and when it is back."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final

from nedbus.client import Bus, Sample, Subscription
from nedbus.errors import NoDataError
from nedbus.log_event import about

from .output.streams import write_stderr

_log = logging.getLogger("nedbus")

SILENCE_TIMEOUT: Final = 2.0
"""Time without a first sample after which stderr says so [s]."""

_LINK_INTERVAL: Final = 0.5  # s between two checks of the link


class Link:
    """The link of a bus to its router."""

    def __init__(self, bus: Bus) -> None:
        self.connected = True
        self._bus = bus
        self._due = 0.0

    def check(self) -> None:
        """Log when the link breaks and when it is back; it costs nothing to call this often."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + _LINK_INTERVAL
        was, self.connected = self.connected, self._bus.connected
        if was != self.connected:
            text = "the link to %s is back" if self.connected else "the link to %s is broken: waiting for it"
            event = "link-back" if self.connected else "link-broken"
            _log.warning(text, " or ".join(self._bus.routers), extra=about(event))


def follow(
    subscription: Subscription,
    handle: Callable[[Sample], bool],
    *,
    link: Link,
    count: int | None,
    duration: float | None,
    each_second: Callable[[], object] | None = None,
) -> None:
    """Handle samples until there were `count`, or for `duration` [s]; raise NoDataError if there were none.

    `handle` returns whether a sample counts.
    """
    start = time.monotonic()
    end = float("inf") if duration is None else start + duration
    next_second, noticed, seen = start + 1.0, False, 0
    while (now := time.monotonic()) < end and (count is None or seen < count):
        link.check()
        if now >= next_second:
            if each_second is not None:
                each_second()
            next_second = max(next_second + 1.0, now)
        if not seen and not noticed and now > start + SILENCE_TIMEOUT:
            noticed = True
            write_notice(subscription)
        try:
            sample = subscription.receive(max(0.0, min(end, next_second, now + _LINK_INTERVAL) - now))
        except NoDataError:
            continue
        seen += handle(sample)
    if each_second is not None and seen:
        each_second()
    if not seen:
        raise NoDataError(subscription.name, duration or 0.0)


def write_notice(subscription: Subscription) -> None:
    """Tell a person that nothing has arrived on a subscription so far."""
    write_stderr(f"nothing on {subscription.name} yet, waiting; 'nedbus list' shows what is published")
