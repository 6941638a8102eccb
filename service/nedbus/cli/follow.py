"""Receive loop of commands with a subscription; it logs when the router link is lost and restored."""

import logging
import math
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from nedbus import Bus, Sample, Subscription
from nedbus.errors import ClosedError, NoDataError
from nedbus.log_event import about
from nedbus.timings import TIMINGS

from .output.streams import write_stderr

_log = logging.getLogger("nedbus")


def follow(
    bus: Bus,
    subscription: Subscription[Any],
    handle: Callable[[Sample[Any]], bool | None],
    *,
    count: int | None,
    duration: float | None,
    each_second: Callable[[], object] = lambda: None,
) -> None:
    """Handle samples until `count` are counted, or all that are received until `duration` [s] has passed or a signal.

    Ctrl-C and SIGTERM end reception, not the output of what has been received; a second signal ends that as well.
    `handle` returns False for a sample that does not count.

    Raises NoDataError if no sample was counted.
    """
    end = math.inf if duration is None else time.monotonic() + duration
    most = math.inf if count is None else count
    notice_time = time.monotonic() + TIMINGS.first_sample
    next_second = time.monotonic() + 1.0
    seen = 0

    def log_link(is_up: bool) -> None:
        routers = " or ".join(bus.routers)
        if is_up:
            _log.warning("the link to %s is up again", routers, extra=about("link_up"))
        else:
            _log.warning("the link to %s is lost: reconnecting", routers, extra=about("link_lost"))

    bus.on_link(log_link)
    try:
        while seen < most and (now := time.monotonic()) < end:
            if now >= next_second:
                next_second = max(next_second + 1.0, now)
                each_second()
            if not seen and now > notice_time:
                notice_time = math.inf
                write_notice(subscription)
            with suppress(NoDataError):
                sample = subscription.receive(max(0.0, min(end, next_second) - now))
                if handle(sample) is not False:
                    seen += 1
    finally:
        if not isinstance(sys.exception(), Exception):  # the end, or a signal
            subscription.drain()
            with suppress(ClosedError):
                while seen < most:
                    if handle(subscription.receive(0.0)) is not False:
                        seen += 1
    if not seen:
        raise NoDataError(subscription.name, duration or 0.0)
    each_second()


def write_notice(subscription: Subscription[Any]) -> None:
    """Notify the user on stderr that a subscription has not received a message yet."""
    write_stderr(
        f"no message on {subscription.name} yet, still waiting; 'nedbus list' shows the published streams"
    )
