"""The Typer application: commands, imported on first use, and global options."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Annotated, Final

import typer

from nedbus import __version__

from .options import command
from .output.logs import LogFormat, LogLevel, log_to_stderr
from .output.streams import write
from .parsing import Command, Group

_COMMANDS: Final[Mapping[str, str]] = {
    "serve": "serve", "router": "serve", "list": "query", "echo": "echo", "hz": "hz", "get": "query", "info": "query",
    "events": "events", "why": "events", "health": "checks", "doctor": "checks", "check": "checks",
    "export": "bridges", "schema": "query", "ros2": "bridges", "foxglove": "bridges", "web": "bridges",
    "record": "recordings", "convert": "files", "plot": "files", "pki": "pki",
}  # fmt: skip
"""The module in `commands` of each command, in the order of the help."""


def make_app(arguments: Sequence[str] = ()) -> typer.Typer:
    """Return the application; import only the commands in `arguments`, or all if there are none."""
    app = typer.Typer(
        name="nedbus",
        cls=Group,
        help="PX4's messages, validated, on every host of a Zenoh network.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_set_up)
    given = {each for each in arguments if each in _COMMANDS} or _COMMANDS.keys()  # or values of options, such as info
    for name, module in _COMMANDS.items():
        if name in given:
            function = getattr(commands := import_module(f"{__package__}.commands.{module}"), name, None)
            if isinstance(function, typer.Typer):
                for each in function.registered_commands:
                    each.cls = Command
                app.add_typer(function, name=name, cls=Group)
            else:
                app.command(name, cls=Command)(function or getattr(commands, f"{name}_"))
    return app


@command
def _show_version(requested: bool) -> None:
    if requested:
        write(f"nedbus {__version__}")
        raise typer.Exit


VersionOption = Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show version")]
LevelOption = Annotated[LogLevel, typer.Option("--log-level", envvar="NEDBUS_LOG_LEVEL", help="Lowest level to log")]
FormatOption = Annotated[LogFormat, typer.Option("--log-format", envvar="NEDBUS_LOG_FORMAT", help="Format of the log")]


@command
def _set_up(
    *,
    version: VersionOption = False,
    debug: Annotated[bool, typer.Option("--debug", help="Log debug messages, show tracebacks")] = False,
    log_level: LevelOption = "info",
    log_format: FormatOption = "text",
) -> None:
    log_to_stderr(level="debug" if debug else log_level, log_format=log_format)
