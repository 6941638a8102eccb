"""Commands that serve data to browsers, Prometheus, Foxglove and ROS 2: web, export, foxglove, ros2."""

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from nedbus import Bus, __version__, bridges, monitoring, web as page
from nedbus.bridges import FOXGLOVE_PORT
from nedbus.cli.options import (
    ALL,
    FilesArgument,
    InstanceOption,
    TopicsOption,
    VehiclesOption,
    command,
)
from nedbus.cli.output.streams import write_stderr
from nedbus.cli.run import run_until_stopped
from nedbus.endpoints import is_loopback, split_http
from nedbus.errors import ConfigError, ConnectError, NedbusError
from nedbus.log_event import about
from nedbus_msgs import ANY, RELEASES, Selection

_log = logging.getLogger("nedbus")
_OPEN: Final = "%s has no password: every client can read it, but not write; listen on loopback to prevent this"

_MAP: Final = "Map: GeoJSON, or an image with a world file"
_NAMESPACE: Final = "Publish as /NAMESPACE/fmu/out/...; repeatable"
_ORIGIN: Final = "Additional host name of this page, for example of a proxy; repeatable"
_LAYOUT: Final = f"PX4 release of px4_msgs in the ROS 2 workspace: {', '.join(RELEASES)}"
_TO: Final = "ROS 2's router (default: nedbus's router)"

MapOption = Annotated[
    Path | None, typer.Option("--map", exists=True, dir_okay=False, metavar="FILE", help=_MAP)
]
NamespaceOption = Annotated[
    list[str] | None, typer.Option(metavar="VEHICLE:NAMESPACE", help=_NAMESPACE)
]
HttpOption = Annotated[
    str, typer.Option("--http", metavar="HOST:PORT", help="Address to listen on (port 0: any free)")
]


@command
def web(
    open_bus: Callable[[], Bus],
    files: FilesArgument = None,
    *,
    topic_option: TopicsOption = None,
    vehicle: VehiclesOption = None,
    instance: InstanceOption = None,
    http: HttpOption = "127.0.0.1:8420",
    origin: Annotated[list[str] | None, typer.Option(metavar="HOST:PORT", help=_ORIGIN)] = None,
    background: MapOption = None,
) -> None:
    """Serve a web page with a map, the faults and plots of all vehicles."""
    host, port = _split_http("--http", http)
    for name in origin or ():
        _split_http("--origin", name)
    selection = Selection(topic_option or ANY, vehicle or ANY, instance)
    options = page.PageOptions(host, port, tuple(origin or ()), background)

    def on_listening(url: str) -> None:
        write_stderr(f"open {url} in a browser; Ctrl-C stops the server")
        if not is_loopback(host):
            write_stderr(_OPEN % http)

    if files:
        run_until_stopped(
            lambda stop: page.serve_recording(files, options, stop=stop, on_listening=on_listening)
        )
        return
    serve_live = partial(page.serve_live, version=__version__, on_listening=on_listening)
    with open_bus() as bus:
        run_until_stopped(lambda stop: serve_live(bus, selection, options, stop=stop))


@command
def export(
    open_bus: Callable[[], Bus], selection: Selection = ALL, *, http: HttpOption = "127.0.0.1:9464"
) -> None:
    """Serve Prometheus metrics of all streams, measured by a subscriber, until Ctrl-C.

    Use it for routers without a nedbus service; a service serves its own metrics (serve --http).
    """
    _split_http("--http", http)
    # raises ConfigError without the extra, before a bus is opened
    make_exporter = monitoring.Exporter
    with open_bus() as bus:
        exporter = make_exporter(bus, selection, version=__version__)
        with serve_pages(http, exporter.pages):
            run_until_stopped(exporter.run)


@command
def foxglove(
    open_bus: Callable[[], Bus],
    *,
    vehicle: VehiclesOption = None,
    http: HttpOption = f"127.0.0.1:{FOXGLOVE_PORT}",
) -> None:
    """Serve live vehicles to Foxglove until Ctrl-C.

    Foxglove can plot every field, and show poses in 3D and positions on a map.
    """
    host, port = _split_http("--http", http)
    # raises ConfigError without the extra, before a bus is opened
    make_server = bridges.FoxgloveServer
    with open_bus() as bus, make_server(bus, host=host, port=port) as server:
        write_stderr(
            f"in Foxglove, choose Open connection > Foxglove WebSocket, and enter {server.url}"
        )
        run_until_stopped(partial(server.run, selection=Selection(vehicle=vehicle or ANY)))


@command
def ros2(
    bus: Bus,
    selection: Selection = ALL,
    *,
    humble: Annotated[
        bool, typer.Option("--humble", help="Use ROS 2 Humble's keys, without type hash")
    ] = False,
    layout: Annotated[str, typer.Option(help=_LAYOUT)] = RELEASES[-1],
    domain: Annotated[
        int, typer.Option(envvar="ROS_DOMAIN_ID", min=0, max=232, help="ROS domain id")
    ] = 0,
    namespace: NamespaceOption = None,
    to: Annotated[str | None, typer.Option(metavar="ENDPOINT", help=_TO)] = None,
) -> None:
    """Publish px4_msgs on /fmu/out/... to ROS 2 with rmw_zenoh."""
    namespaces: dict[str, str] = {}
    for text in namespace or ():
        vehicle, colon, name = text.partition(":")
        if not colon:
            raise ConfigError("--namespace", f"{text!r}: expected VEHICLE:NAMESPACE")
        namespaces[vehicle] = name
    try:
        session = bus.open_session(to)
        observer = bus.open_session(to)
    except ConnectError as exc:
        raise NedbusError(
            f"no router answers at {to}: start ROS 2's router there, or correct --to"
        ) from exc
    with closing(session), closing(observer):
        bridge = bridges.Ros2Bridge(
            bus, session, observer=observer, selection=selection, layout=layout, domain=domain, hashed=not humble,
            namespaces=namespaces,
        )  # fmt: skip
        run_until_stopped(bridge.run)


@contextmanager
def serve_pages(where: str, pages: Mapping[str, Callable[[], monitoring.Page]]) -> Iterator[None]:
    """Serve pages on HOST:PORT inside a `with` block."""
    with closing(monitoring.HttpServer(where, pages)):
        _log.info(
            "serving http://%s/metrics, /healthz, /readyz, /vehicles and /status",
            where,
            extra=about("http"),
        )
        if not is_loopback(split_http(where)[0]):
            _log.warning(_OPEN, where, extra=about("http"))
        yield


def _split_http(option: str, address: str) -> tuple[str, int]:
    try:
        return split_http(address)
    except ValueError as exc:
        raise ConfigError(option, str(exc)) from exc
