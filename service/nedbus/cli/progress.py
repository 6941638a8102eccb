"""What `nedbus serve` shows while it runs: a live display on a terminal, plain log lines elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from typing import TYPE_CHECKING, Final, Self

from nedbus.daemon import Daemon
from nedbus.session import DEFAULT_ENDPOINT
from nedbus.worker import WorkerStatus

from .text import to_line

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_log = logging.getLogger("nedbus")
_PAUSES: Final = (10.0,) * 6 + (60.0,)  # s between reports in a plain log; the last one stays
_SHOWN: Final = 3  # messages that a report shows

_HINT: Final = """In a second terminal:
  nedbus list{where}                        what is published
  nedbus echo{where}                        every message, a line each
  nedbus hz{where}                          rate, jitter, latency, loss
  nedbus get{where} vehicle_local_position  all fields of the last message"""


class Display:
    """Show what a daemon does; `update` is called several times a second."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._greeted = False
        self._reports = 0
        self._last = time.monotonic()
        self._progress: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._rates: dict[str, tuple[float, int]] = {}

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            self._start_progress()
        return self

    def __exit__(self, *exc: object) -> None:
        if self._progress is not None:
            self._progress.stop()

    def update(self) -> None:
        """Bring what is shown up to date."""
        if not self._daemon.ready.is_set():
            return
        if not self._greeted:
            self._greeted = True
            for worker in self._daemon.workers:
                self._rate(worker)  # from here on it is measured
            if not self._daemon.until_done and (self._daemon.role == "router" or sys.stderr.isatty()):
                known = DEFAULT_ENDPOINT in self._daemon.endpoints
                where = "" if known else f" -c {self._daemon.endpoints[0]}"
                self._tell(_HINT.format(where=where))
        if self._progress is not None:
            for worker in self._daemon.workers:
                self._show(self._progress, worker)
        elif time.monotonic() - self._last >= _PAUSES[min(self._reports, len(_PAUSES) - 1)]:
            self._last = time.monotonic()
            self._reports += 1
            self._report()

    def _report(self) -> None:
        """Log how far each source is, and some of what it published last."""
        for worker in self._daemon.workers:
            if worker.state == "running":
                _log.info("%s: %s", worker.source.rstrip(":"), self._numbers(worker))
        shown = [sample for sample in self._daemon.newest() if sample.topic == "vehicle_local_position"]
        for sample in shown[:_SHOWN]:
            _log.info("%s", to_line(sample))

    def _tell(self, text: str) -> None:
        if self._progress is not None:
            self._progress.console.print(text, highlight=False)
        else:
            sys.stderr.write(f"{text}\n")

    def _start_progress(self) -> None:
        from rich.console import Console
        from rich.logging import RichHandler
        from rich.progress import BarColumn, Progress, TextColumn

        console = Console(stderr=True)
        handler = RichHandler(console=console, show_path=False, log_time_format="%H:%M:%S")
        logging.basicConfig(handlers=[handler], format="%(message)s", force=True)
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[state]}  {task.fields[numbers]}", markup=False),
        )
        self._progress = Progress(*columns, console=console, refresh_per_second=4)
        self._progress.start()

    def _show(self, progress: Progress, worker: WorkerStatus) -> None:
        if worker.source not in self._tasks:
            self._tasks[worker.source] = progress.add_task(worker.source, total=None, state="", numbers="")
        numbers = self._numbers(worker)
        if worker.error:
            numbers += f", {worker.error}"
        total = worker.total or (1 if worker.ended else None)
        done = worker.done if worker.total else int(worker.ended)
        progress.update(self._tasks[worker.source], completed=done, total=total, state=worker.state, numbers=numbers)

    def _numbers(self, worker: WorkerStatus) -> str:
        count = f"{worker.done} of {worker.total}" if worker.total else f"{worker.published}"
        rejected = f", {worker.rejected} rejected" if worker.rejected else ""
        lost = f", {worker.lost} lost" if worker.lost else ""
        silent = f", silent: {', '.join(worker.silent)}" if worker.silent else ""
        return f"{count} messages, {self._rate(worker):.0f}/s{rejected}{lost}{silent}"

    def _rate(self, worker: WorkerStatus) -> float:
        """Return messages a second, as an average that follows within about a second."""
        now = time.monotonic()
        then, published = self._rates.setdefault(worker.source, (now, worker.published))
        if now - then > 2.0:
            self._rates[worker.source] = (
                now - 1.0,
                worker.published - round((worker.published - published) / (now - then)),
            )
        return (worker.published - published) / (now - then) if now > then else 0.0
