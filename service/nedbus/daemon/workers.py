"""The workers of a service; sources are started and stopped while others go on."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from nedbus.log_event import about

from .plan import Planned
from .worker import Worker

_log = logging.getLogger(__name__)

_GRACE: Final = 5.0  # s that a source which is gone from the configuration has to end


class Workers:
    """Run the sources of a plan.

    Not thread-safe, but for iteration over the workers, in the order of the plan.
    """

    def __init__(self) -> None:
        self.workers: Sequence[Worker] = ()

    def apply(self, plan: Sequence[Planned], make_worker: Callable[[Planned], Worker]) -> tuple[int, int, int]:
        """Start new sources and stop removed ones; return the numbers started, stopped and unchanged."""
        left, ordered = list(self.workers), []
        for planned in plan:
            same = next((worker for worker in left if worker.planned.is_same(planned)), None)
            if same is not None:
                left.remove(same)
            ordered.append(same)
        for worker in left:
            worker.stop(release=True)
        _join(left, _GRACE)
        for worker in left:
            if worker.thread.is_alive():  # giving an address back may take as long as its slowest reader
                text = "%s: does not end, perhaps because of a slow reader; it goes on until then"
                _log.warning(text, worker.text, extra=about("reload"))
        # New sources may need the addresses of those that are gone.
        self.workers = [same or make_worker(planned) for same, planned in zip(ordered, plan, strict=True)]
        for same, worker in zip(ordered, self.workers, strict=True):
            if same is None:
                worker.thread.start()
        started = ordered.count(None)
        return started, len(left), len(plan) - started

    def end(self, grace: float) -> None:
        """Stop all workers and wait up to `grace` seconds."""
        for worker in self.workers:
            worker.stop()
        _join(self.workers, grace)


def _join(workers: Iterable[Worker], grace: float) -> None:
    deadline = time.monotonic() + grace
    for worker in workers:
        worker.thread.join(max(0.0, deadline - time.monotonic()))
