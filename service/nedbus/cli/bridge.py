"""Commands that give the data to others while it comes: ros2, foxglove."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Annotated

import typer

from nedbus.bus import Bus
from nedbus.errors import ConfigError, ConnectError, NedbusError
from nedbus.extras import needs
from nedbus.ros2 import Bridge
from nedbus_msgs import ANY, CURRENT, LAYOUTS

from .options import InstanceOption, TopicArgument, TopicOption, VehicleOption, choose, on_bus, tell
from .serve import run_until_signal


@on_bus
def ros2(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: TopicOption = ANY,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    humble: Annotated[bool, typer.Option("--humble", help="For ROS 2 Humble, whose keys have no type hash")] = False,
    layout: Annotated[
        str, typer.Option(help=f"Layout of px4_msgs in the ROS 2 workspace: {', '.join(LAYOUTS)} (to main)")
    ] = CURRENT.name,
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", min=0, max=232, help="ROS domain")] = 0,
    namespace: Annotated[
        list[str] | None,
        typer.Option(metavar="VEHICLE:NAMESPACE", help="Topics of a vehicle, as /NAMESPACE/fmu/out/...; repeatable"),
    ] = None,
    to: Annotated[str | None, typer.Option(metavar="ENDPOINT", help="The router of ROS 2, if it is another")] = None,
) -> None:
    """Publish to ROS 2 nodes that use rmw_zenoh, until Ctrl-C: px4_msgs/msg/VehicleLocalPosition on /fmu/out/..."""
    wanted = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance)
    for each in namespace or ():
        if ":" not in each:
            raise ConfigError("--namespace", f"{each!r} is not VEHICLE:NAMESPACE")
    named = dict(each.partition(":")[::2] for each in namespace or ())
    with ExitStack() as closing:
        try:
            session = bus.join(to)
        except ConnectError as exc:
            raise NedbusError(f"nothing answers at {to}: start the router of ROS 2 there, or correct --to") from exc
        closing.callback(session.close)
        bridge = Bridge(
            bus,
            session,
            layout=layout,
            domain=domain,
            topic=wanted.topic,
            vehicle=wanted.vehicle,
            instance=wanted.instance,
            hashed=not humble,
            namespaces=named,
        )
        _run(bridge.run)


@on_bus
def foxglove(
    bus: Bus,
    *,
    vehicle: VehicleOption = ANY,
    host: Annotated[str, typer.Option(help="Where to listen; 0.0.0.0 lets other hosts in")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port, 0 for any")] = 8765,
) -> None:
    """Serve live vehicles to Foxglove, until Ctrl-C: plots of every field, poses in 3D, places on the map."""
    view_module = needs("foxglove", "nedbus.foxglove_view")
    with view_module.FoxgloveView(bus, host=host, port=port) as view:
        tell(f"open {view.url} in Foxglove: Open connection, Foxglove WebSocket")
        _run(partial(view.run, vehicle=vehicle))


def _run(body: Callable[[threading.Event], object]) -> None:
    """Run something until Ctrl-C or SIGTERM, also as the first process of a container."""
    stop = threading.Event()

    def run() -> bool:
        body(stop)
        return True

    ends = run_until_signal(run, stop.set, beside=lambda: None)
    if ends is not None:
        raise typer.Exit(ends)
