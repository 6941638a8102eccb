"""Show the state of `nedbus serve` while it runs: a live display on a terminal, plain log lines elsewhere."""

from __future__ import annotations

import logging
import shutil
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from nedbus.client import SourceStatus
from nedbus.daemon import Daemon
from nedbus.log_event import about
from nedbus.transport import DEFAULT_ENDPOINT, dial_endpoint
from nedbus_msgs import DEFAULT_TOPIC

from .format import to_line, to_text
from .logs import log_to, logs_for_programs
from .options import write_stderr

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

_log = logging.getLogger("nedbus")
_REPORT_INTERVALS: Final = (10.0,) * 6 + (60.0,)  # s between reports in a plain log; then the last one
_REPORTED: Final = 3  # messages in a report

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
        self._hinted = False
        self._reports = 0
        self._last = time.monotonic()
        self._starts = sys.stderr.isatty() and not logs_for_programs()
        self._progress: Progress | None = None
        self._tasks: dict[str, TaskID] = {}
        self._rates: dict[str, tuple[float, int]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self._progress is not None:
            with suppress(OSError):
                self._progress.stop()

    def update(self) -> None:
        """Show the current state; a terminal that is gone ends the display, not the service."""
        try:
            if self._starts:
                self._starts = False
                self._start_progress()
            if self._daemon.ready.is_set():
                self._update()
        except OSError:
            self._progress = None

    def _update(self) -> None:
        if not self._hinted:
            self._hinted = True
            for status in self._daemon.sources:
                self._rate(status)  # measured from here on
            is_read = not logs_for_programs() and (self._daemon.role == "router" or sys.stderr.isatty())
            if is_read and not self._daemon.until_done:
                self._print(what_to_type(self._daemon.endpoints))
        if self._progress is not None:
            for status in self._daemon.sources:
                self._show(self._progress, status)
        elif time.monotonic() - self._last >= _REPORT_INTERVALS[min(self._reports, len(_REPORT_INTERVALS) - 1)]:
            self._last = time.monotonic()
            self._reports += 1
            self._report()

    def _report(self) -> None:
        """Log the progress of each source, and the newest messages of some vehicles."""
        for status in self._daemon.sources:
            if status.state == "running":
                name = status.source.rstrip(":")
                _log.info("%s: %s", name, self._numbers(status), extra=about("progress", source=name))
        newest = [sample for sample in self._daemon.newest() if sample.topic == DEFAULT_TOPIC]
        for sample in newest[:_REPORTED]:
            _log.info("%s", to_line(sample), extra=about("progress", sample.address))

    def _print(self, text: str) -> None:
        if self._progress is not None:
            self._progress.console.print(text, highlight=False)
        else:
            write_stderr(text)

    def _start_progress(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn

        console = Console(stderr=True)
        log_to(console)
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[state]}  {task.fields[numbers]}", markup=False),
        )
        self._progress = Progress(*columns, console=console, refresh_per_second=4)
        self._progress.start()

    def _show(self, progress: Progress, status: SourceStatus) -> None:
        if status.source not in self._tasks:
            self._tasks[status.source] = progress.add_task(status.source, total=None, state="", numbers="")
        numbers = self._numbers(status)
        if status.error:
            numbers += f", {to_text(status.error)}"
        total = status.total or (1 if status.ended else None)
        done = status.done if status.total else int(status.ended)
        progress.update(self._tasks[status.source], completed=done, total=total, state=status.state, numbers=numbers)

    def _numbers(self, status: SourceStatus) -> str:
        count = f"{status.done} of {status.total}" if status.total else f"{status.published}"
        rejected = f", {status.rejected} rejected" if status.rejected else ""
        lost = f", {status.lost} lost" if status.lost else ""
        gone = f", gone: {', '.join(status.stale)}" if status.stale else ""
        return f"{count} messages, {self._rate(status):.0f}/s{rejected}{lost}{gone}"

    def _rate(self, status: SourceStatus) -> float:
        """Return messages a second, averaged over the last one to two seconds."""
        now = time.monotonic()
        then, published = self._rates.setdefault(status.source, (now, status.published))
        if now - then > 2.0:
            self._rates[status.source] = (
                now - 1.0,
                status.published - round((status.published - published) / (now - then)),
            )
        return (status.published - published) / (now - then) if now > then else 0.0


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
