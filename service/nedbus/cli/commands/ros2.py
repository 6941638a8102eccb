"""The command that publishes to ROS 2: ros2."""

from __future__ import annotations

from contextlib import closing
from typing import Annotated

import typer

from nedbus import bridges
from nedbus.cli.options import on_bus, selecting
from nedbus.cli.run import run_until_stopped
from nedbus.client import Bus
from nedbus.errors import ConfigError, ConnectError, NedbusError
from nedbus_msgs import ANY, RELEASES, Selection


@on_bus
@selecting(ANY)
def ros2(
    bus: Bus,
    selection: Selection,
    *,
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
