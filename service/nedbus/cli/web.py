"""The command for the page in the browser: web."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final

import typer

from nedbus import __version__
from nedbus import web as page
from nedbus.client import Bus
from nedbus.errors import ConfigError
from nedbus.settings import is_loopback, split_http
from nedbus_msgs import ANY

from .options import InstanceOption, TopicOption, VehicleOption, choose, lazily_on_bus, write_stderr
from .run import run_until_stopped

DEFAULT_LISTEN: Final = "127.0.0.1:8420"


@lazily_on_bus
def web(
    open_bus: Callable[[], Bus],
    file: Annotated[
        Path | None,
        typer.Argument(metavar="[FILE]", help="A .ulg log or .mcap recording to look at, instead of live vehicles"),
    ] = None,
    *,
    topic_option: TopicOption = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    listen: Annotated[str, typer.Option(metavar="HOST:PORT", help="Where to serve the page")] = DEFAULT_LISTEN,
    origin: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST:PORT", help="Another name that browsers call this page by; repeatable"),
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option(
            "--map",
            exists=True,
            dir_okay=False,
            metavar="FILE",
            help="GeoJSON, or a picture with a world file, under the tracks",
        ),
    ] = None,
) -> None:
    """Show all vehicles in a browser: a map, what is wrong with whom, and plots; live, or of a recording."""
    host, port = _split("--listen", listen)
    for name in origin or ():
        _split("--origin", name)
    selection = choose(None, topic=topic_option, vehicle=vehicle, instance=instance, default=ANY)
    where = page.Where(host, port, tuple(origin or ()), background)

    def tell(url: str) -> None:
        write_stderr(f"open {url} in a browser; Ctrl-C ends it")
        if not is_loopback(host):
            write_stderr(
                f"whoever reaches {listen} can see all vehicles, without a password; nothing can be changed there"
            )

    if file is not None:
        run_until_stopped(lambda stop: page.serve_recording(file, where, stop=stop, tell=tell))
        return
    with open_bus() as bus:
        run_until_stopped(
            lambda stop: page.serve_live(bus, selection, where, version=__version__, stop=stop, tell=tell)
        )


def _split(option: str, where: str) -> tuple[str, int]:
    try:
        return split_http(where)
    except ValueError as exc:
        raise ConfigError(option, str(exc)) from exc
