"""Commands that pass data on to browsers, Prometheus, Foxglove and ROS 2: web, export, foxglove, ros2."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nedbus import __version__, bridges
from nedbus import web as page
from nedbus.bridges import FOXGLOVE_PORT
from nedbus.cli.options import ALL, FileArgument, InstanceOption, TopicOption, VehicleOption, command
from nedbus.cli.output.streams import write_stderr
from nedbus.cli.run import run_until_stopped
from nedbus.client import Bus
from nedbus.errors import ConfigError, ConnectError, NedbusError
from nedbus.log_event import about
from nedbus.settings import is_loopback, split_http
from nedbus_msgs import ANY, RELEASES, Selection

if TYPE_CHECKING:
    from nedbus.monitoring import Page

_log = logging.getLogger("nedbus")

MapOption = Annotated[
    Path | None,
    typer.Option("--map", exists=True, dir_okay=False, metavar="FILE", help="GeoJSON, or a picture with a world file"),
]
NamespaceOption = Annotated[
    list[str] | None, typer.Option(metavar="VEHICLE:NAMESPACE", help="Topics as /NAMESPACE/fmu/out/...; repeatable")
]
HttpOption = Annotated[str, typer.Option("--http", metavar="HOST:PORT", help="Where to listen; port 0 for any")]


@command
def web(
    open_bus: Callable[[], Bus],
    file: FileArgument = None,
    *,
    topic_option: TopicOption = ANY,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    http: HttpOption = "127.0.0.1:8420",
    origin: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST:PORT", help="Another name that browsers call this page by; repeatable"),
    ] = None,
    background: MapOption = None,
) -> None:
    """Show all vehicles in a browser: a map, their faults, and plots; live, or of a recording."""
    host, port = _split("--http", http)
    for name in origin or ():
        _split("--origin", name)
    selection = Selection(topic_option, vehicle, instance)
    where = page.Where(host, port, tuple(origin or ()), background)

    def tell(url: str) -> None:
        write_stderr(f"open {url} in a browser; Ctrl-C ends it")
        if not is_loopback(host):
            write_stderr(f"any client that reaches {http} can see all vehicles, without a password, and change nothing")

    if file is not None:
        run_until_stopped(lambda stop: page.serve_recording(file, where, stop=stop, tell=tell))
        return
    serve_live = partial(page.serve_live, version=__version__, tell=tell)
    with open_bus() as bus:
        run_until_stopped(lambda stop: serve_live(bus, selection, where, stop=stop))


@command
def export(open_bus: Callable[[], Bus], selection: Selection = ALL, *, http: HttpOption = "127.0.0.1:9464") -> None:
    """Serve a reader's metrics for Prometheus, until Ctrl-C: for routers without a nedbus service."""
    from nedbus.monitoring import Exporter

    _split("--http", http)
    with open_bus() as bus:
        exporter = Exporter(bus, selection, version=__version__)
        with serve_pages(http, exporter.pages):
            run_until_stopped(exporter.run)


@command
def foxglove(
    open_bus: Callable[[], Bus], *, vehicle: VehicleOption = ANY, http: HttpOption = f"127.0.0.1:{FOXGLOVE_PORT}"
) -> None:
    """Serve live vehicles to Foxglove, until Ctrl-C: plots of every field, poses in 3D, positions on the map."""
    host, port = _split("--http", http)
    with open_bus() as bus, bridges.FoxgloveServer(bus, host=host, port=port) as server:
        write_stderr(f"open {server.url} in Foxglove: Open connection, Foxglove WebSocket")
        run_until_stopped(partial(server.run, selection=Selection(vehicle=vehicle)))


@command
def ros2(
    bus: Bus,
    selection: Selection = ALL,
    *,
    humble: Annotated[bool, typer.Option("--humble", help="For ROS 2 Humble, whose keys have no type hash")] = False,
    layout: Annotated[
        str, typer.Option(help=f"Release of PX4 whose px4_msgs the ROS 2 workspace has: {', '.join(RELEASES)}")
    ] = RELEASES[-1],
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", min=0, max=232, help="ROS domain")] = 0,
    namespace: NamespaceOption = None,
    to: Annotated[str | None, typer.Option(metavar="ENDPOINT", help="The router of ROS 2, if it is another")] = None,
) -> None:
    """Publish to ROS 2 nodes that use rmw_zenoh, until Ctrl-C: px4_msgs on /fmu/out/..."""
    for each in namespace or ():
        if ":" not in each:
            raise ConfigError("--namespace", f"{each!r} is not VEHICLE:NAMESPACE")
    namespaces = dict(each.partition(":")[::2] for each in namespace or ())
    try:
        session, observer = bus.open_session(to), bus.open_session(to)
    except ConnectError as exc:
        raise NedbusError(f"nothing answers at {to}: start the router of ROS 2 there, or correct --to") from exc
    with closing(session), closing(observer):
        bridge = bridges.Ros2Bridge(
            bus,
            session,
            observer=observer,
            selection=selection,
            layout=layout,
            domain=domain,
            hashed=not humble,
            namespaces=namespaces,
        )
        run_until_stopped(bridge.run)


@contextmanager
def serve_pages(where: str, pages: Mapping[str, Callable[[], Page]]) -> Iterator[None]:
    """Serve pages on HOST:PORT for as long as this is entered."""
    from nedbus.monitoring import HttpServer

    with closing(HttpServer(where, pages)):
        text = "metrics and health on http://%s/metrics, /healthz, /readyz, /vehicles, /status"
        _log.info(text, where, extra=about("http"))
        if not is_loopback(split_http(where)[0]):
            _log.warning("any client that reaches %s can read them; it can change nothing", where, extra=about("http"))
        yield


def _split(option: str, where: str) -> tuple[str, int]:
    try:
        return split_http(where)
    except ValueError as exc:
        raise ConfigError(option, str(exc)) from exc
