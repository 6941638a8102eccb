"""The table of commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated

import typer

from nedbus import __version__

from .bridges import foxglove, ros2
from .check import check
from .doctor import doctor
from .echo import echo
from .events import events, why
from .files import convert, plot, record
from .health import health
from .http import export
from .hz import hz
from .logs import LogFormat, LogLevel, log_to_stderr
from .options import command, write
from .pki import pki
from .query import get, info, list_, schema
from .serve import router, serve
from .web import web

app = typer.Typer(
    name="nedbus",
    help="PX4's local position estimate, validated, on every host.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_COMMANDS: Mapping[str, Callable[..., None]] = {
    "serve": serve,
    "router": router,
    "list": list_,
    "echo": echo,
    "hz": hz,
    "get": get,
    "info": info,
    "events": events,
    "why": why,
    "health": health,
    "doctor": doctor,
    "check": check,
    "export": export,
    "schema": schema,
    "ros2": ros2,
    "foxglove": foxglove,
    "web": web,
    "record": record,
    "convert": convert,
    "plot": plot,
}
for _name, _function in _COMMANDS.items():
    app.command(_name)(_function)
app.add_typer(pki, name="pki")


@command
def _show_version(asked: bool) -> None:
    if asked:
        write(f"nedbus {__version__}")
        raise typer.Exit


@app.callback()
def _set_up(
    *,
    version: Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show it")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Log everything, and show tracebacks")] = False,
    log_level: Annotated[
        LogLevel, typer.Option("--log-level", envvar="NEDBUS_LOG_LEVEL", help="Log from this level on")
    ] = LogLevel.INFO,
    log_format: Annotated[
        LogFormat, typer.Option("--log-format", envvar="NEDBUS_LOG_FORMAT", help="json: an object a line")
    ] = LogFormat.TEXT,
) -> None:
    log_to_stderr(level=LogLevel.DEBUG if debug else log_level, log_format=log_format)
