"""Progress: a live display on a terminal, of `nedbus serve` and of commands that write files; elsewhere log lines."""

from __future__ import annotations

import logging
import shutil
import socket
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from nedbus.client import SourceStatus
from nedbus.daemon import Daemon
from nedbus.log_event import about
from nedbus.transport import DEFAULT_ENDPOINT, dial_endpoint
from nedbus_msgs import DEFAULT_TOPIC

from .logs import log_to
from .samples import to_line
from .streams import logs_for_programs, to_text, write_stderr

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_log = logging.getLogger("nedbus")
_REPORT_INTERVALS: Final = (10.0,) * 6 + (60.0,)  # s between reports in a plain log; then the last one
_MAX_REPORTED: Final = 3  # messages in a report
_RATE_WINDOW: Final = 2.0  # s of which the display shows the rate

_HINT: Final = """In a second terminal:
  {nedbus} list{where}  what is published
  {nedbus} echo{where}  messages as they arrive, a line each
  {nedbus} hz{where}    rate, jitter, latency, loss
  {nedbus} get{where}   all fields of the last message"""
_ELSEWHERE: Final = """
On another host:
  nedbus list -c {endpoint}"""
_TLS_HINT: Final = "Readers at {endpoint} need a certificate of their own: docs/security.md"
_ENCRYPTED: Final = ("tls/", "quic/")


class Display:
    """Show the state of a daemon; `update` is called several times a second, where Ctrl-C raises nothing."""

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._is_terminal = sys.stderr.isatty() and not logs_for_programs()
        self._progress: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._hinted = False
        self._reports = 0
        self._reported = time.monotonic()
        self._counts: dict[str, int] = {}  # messages published of each source at the last report

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._progress is not None:
            with suppress(OSError):
                self._progress.stop()

    def update(self) -> None:
        """Show the current state; a terminal that is gone ends the display, not the service."""
        try:
            self._update()
        except OSError:
            self._progress, self._is_terminal = None, False

    def _update(self) -> None:
        if self._is_terminal and self._progress is None:
            self._progress = _make_progress("{task.fields[state]}  {task.fields[numbers]}")
            log_to(self._progress.console)
            self._progress.start()
        if not self._daemon.ready.is_set():
            return
        if not self._hinted:
            self._hinted = True
            is_read = not logs_for_programs() and (self._daemon.role == "router" or sys.stderr.isatty())
            if is_read and not self._daemon.until_done:
                write_stderr(what_to_type(self._daemon.endpoints))
        elapsed = time.monotonic() - self._reported
        if self._progress is not None:
            for status in self._daemon.sources:
                self._show(self._progress, status)
        elif elapsed >= _REPORT_INTERVALS[min(self._reports, len(_REPORT_INTERVALS) - 1)]:
            self._report(elapsed)

    def _report(self, elapsed: float) -> None:
        """Log the progress of each source, and the newest messages of some vehicles."""
        self._reported += elapsed
        self._reports += 1
        for status in self._daemon.sources:
            count = status.published - self._counts.get(status.source, 0)
            self._counts[status.source] = status.published
            if status.state == "running":
                name = status.source.rstrip(":")
                text = _numbers(status, count / elapsed)
                _log.info("%s: %s", name, text, extra=about("progress", source=name))
        newest = [sample for sample in self._daemon.newest() if sample.topic == DEFAULT_TOPIC]
        for sample in newest[:_MAX_REPORTED]:
            _log.info("%s", to_line(sample), extra=about("progress", sample.address))

    def _show(self, progress: Progress, status: SourceStatus) -> None:
        if status.source not in self._tasks:
            self._tasks[status.source] = progress.add_task(status.source, total=None, state="", numbers="")
        task = self._tasks[status.source]
        done, total = (status.done, status.total) if status.total else (status.published, None)
        if status.ended:
            total = total or max(1, done)
        numbers = _numbers(status, progress.tasks[task].speed or 0.0)
        if status.error:
            numbers += f", {to_text(status.error)}"
        progress.update(task, completed=done, total=total, state=status.state, numbers=numbers)


def _numbers(status: SourceStatus, rate: float) -> str:
    count = f"{status.done} of {status.total}" if status.total else f"{status.published}"
    rejected = f", {status.rejected} rejected" if status.rejected else ""
    lost = f", {status.lost} lost" if status.lost else ""
    gone = f", gone: {', '.join(status.stale)}" if status.stale else ""
    return f"{count} messages, {rate:.0f}/s{rejected}{lost}{gone}"


@contextmanager
def show_progress() -> Iterator[Callable[[str, int | None, int | None], None]]:
    """Yield what shows a text, and a number done of a total; on a terminal, else nothing is shown."""
    if not sys.stderr.isatty():
        yield lambda text, done, total: None
        return
    with _make_progress(transient=True) as progress:
        task = progress.add_task("", total=None)
        yield lambda text, done, total: progress.update(task, description=text, completed=done or 0, total=total)


def _make_progress(*fields: str, transient: bool = False) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    texts = [TextColumn(each, markup=False) for each in ("{task.description}", *fields)]
    columns = (texts[0], BarColumn(bar_width=24), *texts[1:])
    return Progress(
        *columns, console=Console(stderr=True), refresh_per_second=4, speed_estimate_period=_RATE_WINDOW,
        transient=transient,
    )  # fmt: skip


def what_to_type(endpoints: Sequence[str]) -> str:
    """Return what to type in a second terminal; it has not the certificate of this service, and must not need it."""
    plain = [each for each in endpoints if not each.startswith(_ENCRYPTED)]
    if not plain:
        return _TLS_HINT.format(endpoint=endpoints[0])
    here = [dial_endpoint(each) for each in plain]
    hint = _HINT.format(nedbus=_program(), where="" if DEFAULT_ENDPOINT in here else f" -c {here[0]}")
    anywhere = next((each for each, dialled in zip(plain, here, strict=True) if each != dialled), None)
    return hint if anywhere is None else hint + _ELSEWHERE.format(endpoint=_from_elsewhere(anywhere))


def _from_elsewhere(endpoint: str) -> str:
    """Return where another host connects to what listens on all addresses: at that of the default route, if any."""
    family, target, wildcard = socket.AF_INET, "192.0.2.1", "/0.0.0.0:"
    if "/[::]:" in endpoint:
        family, target, wildcard = socket.AF_INET6, "2001:db8::1", "/[::]:"
    host = socket.gethostname()
    with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect((target, 9))  # of UDP: nothing is sent
        host = str(probe.getsockname()[0])
    return endpoint.replace(wildcard, f"/[{host}]:" if ":" in host else f"/{host}:")


def _program() -> str:
    """Return how a second terminal calls nedbus: by its path, if this one did so and no other is found."""
    path = sys.argv[0]
    return path if Path(path).name == "nedbus" and shutil.which("nedbus") is None else "nedbus"
