"""Listening to a live source: what arrives is published, what is stale is withdrawn."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from nedbus.sources import Absence, LiveSource, Rejection
from nedbus.transport import Session

from .clock import Clock
from .output import SourceOutput
from .status import State

_POLL: Final = 0.5  # s between two checks for stale streams


def listen(
    source: LiveSource,
    output: SourceOutput,
    *,
    router: Session | None,
    on_state: Callable[[State], object],
    on_turn: Callable[[], object],
    clock: Clock,
) -> None:
    """Publish what a live source delivers until it ends or the service is stopped.

    `on_state` is called with "waiting" once the source listens and when all streams are stale, with "running" when a
    message arrives; `on_turn` for each message, and several times a second without any: the loop goes round.

    Raises SourceError when the source cannot be opened, or fails.
    """
    with ExitStack() as closing:
        items = source.listen(router)
        closing.callback(getattr(items, "close", lambda: None))
        next_poll = float("-inf")
        for number, item in enumerate(items):
            on_turn()
            if not number:
                on_state("waiting")
            if clock.stopped:
                return
            if isinstance(item, Rejection):
                output.reject(item)
            elif isinstance(item, Absence):
                output.note(item)
            elif item is not None:
                output.publish_live(item)
                on_state("running")
            now = clock.now()
            if now >= next_poll:
                next_poll = now + _POLL
                if not output.expire_stale():
                    on_state("waiting")
