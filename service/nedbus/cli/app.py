"""The Typer application: commands, imported on first use, and global options."""

from collections.abc import Collection, Mapping
from importlib import import_module
from typing import Annotated, Final, NamedTuple

import typer

from nedbus import __version__

from .output import LogFormat, LogLevel
from .parsing import Command, Group


class _Command(NamedTuple):
    """The module of a command in `commands`, and the first sentence of its docstring."""

    module: str
    summary: str


_COMMANDS: Final[Mapping[str, _Command]] = {
    "serve": _Command("serve", "Run a service: publish validated messages from sources."),
    "router": _Command("serve", "Run a Zenoh router without sources, for services and scripts."),
    "list": _Command(
        "query",
        "List the published streams with the state of each and the age of its last message.",
    ),
    "echo": _Command("echo", "Print messages as they arrive, one line each."),
    "hz": _Command("hz", "Measure rate, jitter, latency, loss and validity of each stream."),
    "get": _Command("query", "Show the last message of each stream with all its fields."),
    "info": _Command("info", "Show the services on the network with their sources and streams."),
    "events": _Command("events", "Show vehicle events and their evidence, live or from a file."),
    "why": _Command(
        "events",
        "Show the verdict on each vehicle, live or from a file: usable or not, since when, for how long, and why.",
    ),
    "fusion": _Command(
        "fusion",
        "Show whether a position that is sent into a vehicle is used, and why not, live or from a file.",
    ),
    "health": _Command(
        "health", "Check services, sources, messages and vehicles; exit with 0 if healthy."
    ),
    "doctor": _Command("checks", "Diagnose why no messages arrive."),
    "check": _Command("checks", "Check settings and router files."),
    "export": _Command(
        "bridges",
        "Serve Prometheus metrics of all streams, measured by a subscriber, until Ctrl-C.",
    ),
    "schema": _Command("query", "Print the JSON Schema of a message, or its supported layouts."),
    "ros2": _Command("bridges", "Publish px4_msgs on /fmu/out/... to ROS 2 with rmw_zenoh."),
    "foxglove": _Command("bridges", "Serve live vehicles to Foxglove until Ctrl-C."),
    "web": _Command(
        "bridges", "Serve a web page with a map, the faults and plots of all vehicles."
    ),
    "record": _Command("recordings", "Record messages to an MCAP file until Ctrl-C."),
    "convert": _Command("files", "Convert flight logs to an MCAP recording."),
    "plot": _Command(
        "files",
        "Plot flights: track, height, speed, flags, resets and events; or fields over time.",
    ),
    "pki": _Command("pki", "Manage keys, certificates and access rules for tls/ endpoints."),
}
"""All commands, in the order of the help. The list of commands imports none of their modules."""


def make_app(arguments: Collection[str] | None = None) -> typer.Typer:
    """Return the application; import only the commands in `arguments`, by default all.

    A command that is not imported can be listed and suggested, but not run: `arguments` must be those of the run.
    """
    app = typer.Typer(
        name="nedbus",
        cls=Group,
        help="PX4's messages, validated, on every host of a Zenoh network.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_set_up)
    for name, command in _COMMANDS.items():
        # a value of an option, such as info, imports a command in vain
        if arguments is None or name in arguments:
            _add_command(app, name, command.module)
        else:
            app.command(name, help=command.summary)(_not_imported)
    return app


def _add_command(app: typer.Typer, name: str, module: str) -> None:
    commands = import_module(f"{__package__}.commands.{module}")
    function = getattr(commands, name, None) or getattr(commands, f"{name}_")
    if isinstance(function, typer.Typer):
        for command in function.registered_commands:
            command.cls = Command
        app.add_typer(function, name=name, cls=Group)
    else:
        app.command(name, cls=Command)(function)


def _not_imported() -> None:
    raise AssertionError("the arguments of the run were not passed to make_app")


def _show_version(requested: bool) -> None:
    if requested:
        from .options import exit_on_errors
        from .output.streams import write

        with exit_on_errors():
            write(f"nedbus {__version__}")
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show version")
]
LevelOption = Annotated[
    LogLevel, typer.Option("--log-level", envvar="NEDBUS_LOG_LEVEL", help="Lowest level to log")
]
FormatOption = Annotated[
    LogFormat, typer.Option("--log-format", envvar="NEDBUS_LOG_FORMAT", help="Format of the log")
]


def _set_up(
    *,
    version: VersionOption = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Log debug messages, show tracebacks")
    ] = False,
    log_level: LevelOption = "info",
    log_format: FormatOption = "text",
) -> None:
    from .options import exit_on_errors
    from .output.logs import log_to_stderr

    with exit_on_errors():
        log_to_stderr(level="debug" if debug else log_level, log_format=log_format)
