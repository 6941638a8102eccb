"""Progress reports: log lines of `nedbus serve`, and the progress bar of commands that write files."""

import logging
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from nedbus.daemon import Daemon
from nedbus.log_event import about
from nedbus.timings import TIMINGS
from nedbus.transport import DEFAULT_ENDPOINT, dial_endpoint

from .streams import is_log_structured, write_stderr

_log = logging.getLogger("nedbus")

_HINT: Final = """In a second terminal:
  {nedbus} list{where}  published vehicles and topics
  {nedbus} echo{where}  messages as they arrive, one per line
  {nedbus} hz{where}    rate, jitter, latency, loss
  {nedbus} get{where}   all fields of the last message"""


class ProgressLog:
    """Log the progress of a daemon; `update` is called several times a second.

    Once the daemon is ready, commands to try in a second terminal are written to stderr.
    """

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._hinted = False
        self._reports = 0
        self._reported = time.monotonic()
        self._counts: dict[str, int] = {}  # messages published by each source up to the last report

    def update(self) -> None:
        """Log a report if one is due."""
        if not self._daemon.ready.is_set():
            return
        if not self._hinted:
            self._hinted = True
            if not is_log_structured() and not self._daemon.until_done:
                write_stderr(suggested_commands(self._daemon.endpoints))
        elapsed = time.monotonic() - self._reported
        if elapsed < TIMINGS.reports[min(self._reports, len(TIMINGS.reports) - 1)]:
            return
        self._reported += elapsed
        self._reports += 1
        for status in self._daemon.sources:
            count = status.published - self._counts.get(status.source, 0)
            self._counts[status.source] = status.published
            if status.state == "running":
                name = status.source.rstrip(":")
                text = f"{status.published} messages"
                text += f" ({status.done / status.total:.0%})" if status.total else ""
                text += f", {count / elapsed:.0f}/s"
                text += f", {status.rejected} rejected" if status.rejected else ""
                text += f", {status.lost} lost" if status.lost else ""
                text += f", gone: {', '.join(status.stale)}" if status.stale else ""
                _log.info("%s: %s", name, text, extra=about("progress", source=name))


@contextmanager
def show_progress() -> Iterator[Callable[[str, int | None, int | None], None]]:
    """Yield a function that shows a label, the number done and the total; it does nothing without a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    columns = TextColumn("{task.description}", markup=False), BarColumn(bar_width=24)
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("", total=None)
        yield lambda text, done, total: progress.update(task, description=text, completed=done or 0, total=total)


def suggested_commands(endpoints: Sequence[str]) -> str:
    """Return commands to try in a second terminal; a hint if all endpoints require a client certificate."""
    plain = [each for each in endpoints if not each.startswith(("tls/", "quic/"))]
    if not plain:
        return f"Readers at {endpoints[0]} need their own certificate, see docs/security.md"
    here = [dial_endpoint(each) for each in plain]
    is_on_path = Path(sys.argv[0]).name != "nedbus" or shutil.which("nedbus") is not None
    program = "nedbus" if is_on_path else sys.argv[0]
    return _HINT.format(nedbus=program, where="" if DEFAULT_ENDPOINT in here else f" -c {here[0]}")
