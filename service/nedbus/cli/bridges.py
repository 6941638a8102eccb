"""Commands that pass live data on to other systems: ros2, foxglove."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import Annotated

import typer

from nedbus import bridges
from nedbus.bridges import FOXGLOVE_PORT
from nedbus.client import Bus
from nedbus.errors import ConfigError, ConnectError, NedbusError
from nedbus_msgs import ANY, RELEASES, Selection

from .options import InstanceOption, TopicArgument, TopicOption, VehicleOption, choose, on_bus, write_stderr
from .run import run_until_stopped


@on_bus
def ros2(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: TopicOption = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    humble: Annotated[bool, typer.Option("--humble", help="For ROS 2 Humble, whose keys have no type hash")] = False,
    layout: Annotated[
        str, typer.Option(help=f"Release of PX4 whose px4_msgs the ROS 2 workspace has: {', '.join(RELEASES)}")
    ] = RELEASES[-1],
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", min=0, max=232, help="ROS domain")] = 0,
    namespace: Annotated[
        list[str] | None,
        typer.Option(metavar="VEHICLE:NAMESPACE", help="Topics of a vehicle, as /NAMESPACE/fmu/out/...; repeatable"),
    ] = None,
    to: Annotated[str | None, typer.Option(metavar="ENDPOINT", help="The router of ROS 2, if it is another")] = None,
) -> None:
    """Publish to ROS 2 nodes that use rmw_zenoh, until Ctrl-C: px4_msgs on /fmu/out/..."""
    selection = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance, default=ANY)
    for each in namespace or ():
        if ":" not in each:
            raise ConfigError("--namespace", f"{each!r} is not VEHICLE:NAMESPACE")
    namespaces = dict(each.partition(":")[::2] for each in namespace or ())
    with ExitStack() as closing:
        try:
            session, observer = bus.open_session(to), bus.open_session(to)
        except ConnectError as exc:
            raise NedbusError(f"nothing answers at {to}: start the router of ROS 2 there, or correct --to") from exc
        closing.callback(session.close)
        closing.callback(observer.close)
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


@on_bus
def foxglove(
    bus: Bus,
    *,
    vehicle: VehicleOption = ANY,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 accepts other hosts")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port, 0 for any")] = FOXGLOVE_PORT,
) -> None:
    """Serve live vehicles to Foxglove, until Ctrl-C: plots of every field, poses in 3D, positions on the map."""
    selection = Selection(vehicle=vehicle)
    with bridges.FoxgloveServer(bus, host=host, port=port) as server:
        write_stderr(f"open {server.url} in Foxglove: Open connection, Foxglove WebSocket")
        run_until_stopped(partial(server.run, selection=selection))
