"""Progress reports: log lines of `nedbus serve`, and the progress bar of commands that write files."""

import logging
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain, repeat
from pathlib import Path
from typing import Final

from nedbus.daemon import Daemon
from nedbus.endpoints import DEFAULT_ENDPOINT, dial_endpoint
from nedbus.health import SourceStatus
from nedbus.log_event import about
from nedbus.timings import TIMINGS
from nedbus_msgs.text import counted

from .streams import is_log_structured, write_stderr

_log = logging.getLogger("nedbus")

_HINT: Final = """In a second terminal:
  {nedbus} list{where}  published vehicles and topics
  {nedbus} echo{where}  messages as they arrive, one per line
  {nedbus} hz{where}    rate, jitter, latency, loss
  {nedbus} get{where}   all fields of the last message"""


def log_progress(daemon: Daemon) -> Iterator[None]:
    """Log the progress of a daemon when a report is due; advance it several times a second.

    Once the daemon is ready, commands to try in a second terminal are written to stderr.
    """
    last_report = time.monotonic()
    reported = Counter[str]()  # messages by source until then
    while not daemon.ready.is_set():
        yield
    if not is_log_structured() and not daemon.until_done:
        write_stderr(suggested_commands(daemon.endpoints))
    for interval in chain(TIMINGS.reports, repeat(TIMINGS.reports[-1])):
        while (elapsed := time.monotonic() - last_report) < interval:
            yield
        last_report += elapsed
        for status in daemon.sources:
            rate = (status.published - reported[status.source]) / elapsed
            reported[status.source] = status.published
            if status.state == "running":
                name = status.source.rstrip(":")
                text = _describe_progress(status, rate)
                _log.info("%s: %s", name, text, extra=about("progress", source=name))


def _describe_progress(status: SourceStatus, rate: float) -> str:
    """Describe what a source has published; `rate`: messages per second."""
    text = counted(status.published, "message")
    if status.total:
        text += f" ({status.done / status.total:.0%})"
    text += f", {rate:.0f}/s"
    if status.rejected:
        text += f", {status.rejected} rejected"
    if status.lost:
        text += f", {status.lost} lost"
    if status.stale:
        text += f" (gone: {', '.join(status.stale)})"
    return text


def suggested_commands(endpoints: Sequence[str]) -> str:
    """Return commands to try in a second terminal; a hint if all endpoints require a client certificate."""
    plain = [endpoint for endpoint in endpoints if not endpoint.startswith(("tls/", "quic/"))]
    if not plain:
        return f"Clients of {endpoints[0]} need their own certificate, see docs/security.md"
    here = [dial_endpoint(endpoint) for endpoint in plain]
    program = "nedbus"
    if Path(sys.argv[0]).name == program and shutil.which(program) is None:
        program = sys.argv[0]
    if DEFAULT_ENDPOINT in here:
        where = ""
    else:
        where = f" -c {here[0]}"
    return _HINT.format(nedbus=program, where=where)
