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
"""Time without a first sample after which stderr reports it [s]."""


def follow(
    bus: Bus,
    subscription: Subscription,
    handle: Callable[[Sample], bool],
    *,
    count: int | None,
    duration: float | None,
    each_second: Callable[[], object] = lambda: None,
) -> None:
    """Handle samples until there were `count`, or for `duration` [s]; raise NoDataError if there were none.

    `handle` returns whether a sample counts. The link is checked once a second, before `each_second` is called.
    """
    start = time.monotonic()
    end = float("inf") if duration is None else start + duration
    next_second = start + 1.0
    connected, noticed, seen = True, False, 0
    while (now := time.monotonic()) < end and (count is None or seen < count):
        if now >= next_second:
            next_second = max(next_second + 1.0, now)
            if connected != bus.connected:
                connected = not connected
                text = "the link to %s is back" if connected else "the link to %s is broken: waiting for it"
                event = "link-back" if connected else "link-broken"
                _log.warning(text, " or ".join(bus.routers), extra=about(event))
            each_second()
        if not seen and not noticed and now > start + SILENCE_TIMEOUT:
            noticed = True
            write_notice(subscription)
        try:
            sample = subscription.receive(max(0.0, min(end, next_second) - now))
        except NoDataError:
            continue
        seen += handle(sample)
    if not seen:
        raise NoDataError(subscription.name, duration or 0.0)
    each_second()


def write_notice(subscription: Subscription) -> None:
    """Report on stderr that nothing has arrived on a subscription so far."""
    write_stderr(f"nothing on {subscription.name} yet, waiting; 'nedbus list' shows what is published")
