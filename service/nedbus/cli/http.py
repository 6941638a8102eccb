"""HTTP for commands: serving pages while they run, and the command that serves nothing else, export."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPException
from typing import TYPE_CHECKING, Annotated, Final

import typer

from nedbus import __version__
from nedbus.client import Bus
from nedbus.errors import ListenError
from nedbus.log_event import about
from nedbus.settings import is_loopback, split_http
from nedbus_msgs import ANY

from .options import InstanceOption, TopicArgument, TopicOption, VehicleOption, choose, on_bus
from .run import run_until_stopped

if TYPE_CHECKING:
    from nedbus.monitoring import Page

_log = logging.getLogger("nedbus")

DEFAULT_HTTP: Final = "127.0.0.1:9464"
_ANSWER_TIMEOUT: Final = 1.0  # s


@contextmanager
def serve_pages(where: str, pages: Mapping[str, Callable[[], Page]]) -> Iterator[None]:
    """Serve pages on HOST:PORT for as long as this is entered."""
    from nedbus.monitoring import HttpServer

    try:
        server = HttpServer(where, pages)
    except ListenError as exc:
        if not _is_nedbus(where):
            raise
        hint = "end it, or choose another address with --http"
        raise ListenError([f"http://{where}"], "a nedbus runs there already", hint=hint) from exc
    host, _ = split_http(where)
    _log.info(
        "metrics and health on http://%s/metrics, /healthz, /readyz, /vehicles, /status", where, extra=about("http")
    )
    if not is_loopback(host):
        _log.warning("whoever reaches %s can read them; nothing can be changed there", where, extra=about("http"))
    try:
        yield
    finally:
        server.close()


def _is_nedbus(where: str) -> bool:
    """Return whether a command of ours serves pages on HOST:PORT."""
    connection = HTTPConnection(*split_http(where), timeout=_ANSWER_TIMEOUT)
    try:
        connection.request("HEAD", "/")
        return connection.getresponse().getheader("Server", "").startswith("nedbus")
    except (OSError, HTTPException):
        return False
    finally:
        connection.close()


@on_bus
def export(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: TopicOption = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    http: Annotated[str, typer.Option(metavar="HOST:PORT", help="Where to serve them")] = DEFAULT_HTTP,
) -> None:
    """Serve metrics for Prometheus of what a reader sees, until Ctrl-C: for routers without a service of ours."""
    from nedbus.monitoring import Exporter

    selection = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance, default=ANY)
    exporter = Exporter(bus, selection, version=__version__)

    def run(stop: threading.Event) -> None:
        with serve_pages(http, exporter.pages):
            exporter.run(stop)

    run_until_stopped(run)
