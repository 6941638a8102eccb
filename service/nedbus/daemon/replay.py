"""A run of a replay: each message when it is due, at a speed, or as fast as readers take it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final

from nedbus.log_event import about
from nedbus.sources import ReplayRun, SourceMessage

from .clock import Clock

_log = logging.getLogger(__name__)

_LATE: Final = 1.0  # s: a replay that is later than this goes on from where it is, and does not hurry


def replay(
    run: ReplayRun, *, speed: float | None, publish: Callable[[SourceMessage], object], clock: Clock, name: str
) -> None:
    """Publish the messages of a run until it ends or the service is stopped; `speed` None is as fast as possible."""
    start = clock.now()
    for message in run.messages:
        if speed is not None:
            early = start + message.due / speed - clock.now()
            if early < -_LATE:
                _log.warning("%s: %.1f s late, going on from here", name, -early, extra=about("late", source=name))
                start -= early
            elif early > 0:
                clock.wait(early)
        if clock.stopped:
            return
        publish(message)
