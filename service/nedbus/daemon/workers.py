"""The workers of a service, each in a thread of its own; sources are started and stopped while others go on."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from nedbus.log_event import about

from .plan import Planned
from .worker import Clock, Worker

_log = logging.getLogger(__name__)

_GRACE: Final = 5.0  # s that a source which is gone from the configuration has to end


@dataclass(frozen=True, slots=True)
class _Running:
    planned: Planned
    worker: Worker
    clock: Clock
    thread: threading.Thread


class Workers:
    """Run the sources of a plan; `make_worker` makes the worker of one, stopped by a clock.

    Not thread-safe, but for reading `workers`.
    """

    def __init__(self, make_worker: Callable[[Planned, Clock], Worker]) -> None:
        self._make_worker = make_worker
        self._running: tuple[_Running, ...] = ()

    @property
    def workers(self) -> list[Worker]:
        """The workers, in the order of the plan."""
        return [each.worker for each in self._running]

    def apply(self, plan: Sequence[Planned]) -> tuple[int, int, int]:
        """Start what is new and stop what is gone; return how many were started, were stopped, and went on."""
        left, ordered = list(self._running), []
        for planned in plan:
            same = next((each for each in left if each.planned.is_same(planned)), None)
            if same is not None:
                left.remove(same)
            ordered.append(same)
        self._stop(left)
        # Those that are new may need the addresses of those that are gone.
        self._running = tuple(same or self._start(planned) for same, planned in zip(ordered, plan, strict=True))
        started = sum(same is None for same in ordered)
        return started, len(left), len(plan) - started

    def end(self, grace: float) -> None:
        """Stop all workers and wait up to `grace` seconds."""
        for each in self._running:
            each.clock.stop()
        deadline = time.monotonic() + grace
        for each in self._running:
            each.thread.join(max(0.0, deadline - time.monotonic()))

    def _start(self, planned: Planned) -> _Running:
        clock = Clock()
        worker = self._make_worker(planned, clock)
        thread = threading.Thread(target=worker.run, name=worker.text, daemon=True)
        thread.start()
        return _Running(planned, worker, clock, thread)

    def _stop(self, gone: Sequence[_Running]) -> None:
        """Stop these workers and wait a while: giving an address back may take as long as its slowest reader."""
        retiring = [threading.Thread(target=_retire, args=[each], name="nedbus-retire", daemon=True) for each in gone]
        for thread in retiring:
            thread.start()
        deadline = time.monotonic() + _GRACE
        for each, thread in zip(gone, retiring, strict=True):
            thread.join(max(0.0, deadline - time.monotonic()))
            if thread.is_alive():
                text = "%s: does not end, perhaps because of a slow reader; it goes on until then"
                _log.warning(text, each.worker.text, extra=about("reload"))


def _retire(running: _Running) -> None:
    """Stop a source, and withdraw its addresses."""
    running.clock.stop()
    running.thread.join()
    running.worker.withdraw()
    _log.info("%s: ended, as it is not configured any more", running.worker.text, extra=about("reload"))
