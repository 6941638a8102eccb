"""The Typer application: commands and global options."""

from typing import Annotated

import typer

from nedbus import __version__

from .commands.bridges import export, foxglove, ros2, web
from .commands.checks import check, doctor, health
from .commands.echo import echo
from .commands.events import events, why
from .commands.hz import hz
from .commands.pki import pki
from .commands.query import get, info, list_, schema
from .commands.recordings import convert, plot, record
from .commands.serve import router, serve
from .options import command
from .output.logs import LogFormat, LogLevel, log_to_stderr
from .output.streams import write

app = typer.Typer(
    name="nedbus",
    help="PX4's messages, validated, on every host of a Zenoh network.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _command in (
    serve, router, list_, echo, hz, get, info, events, why, health, doctor, check, export, schema, ros2, foxglove, web,
    record, convert, plot,
):  # fmt: skip
    app.command(_command.__name__.rstrip("_"))(_command)
app.add_typer(pki, name="pki")


@command
def _show_version(requested: bool) -> None:
    if requested:
        write(f"nedbus {__version__}")
        raise typer.Exit


VersionOption = Annotated[bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show version")]
LevelOption = Annotated[LogLevel, typer.Option("--log-level", envvar="NEDBUS_LOG_LEVEL", help="Lowest level to log")]
FormatOption = Annotated[LogFormat, typer.Option("--log-format", envvar="NEDBUS_LOG_FORMAT", help="Format of the log")]


@app.callback()
@command
def _set_up(
    *,
    version: VersionOption = False,
    debug: Annotated[bool, typer.Option("--debug", help="Log debug messages, show tracebacks")] = False,
    log_level: LevelOption = "info",
    log_format: FormatOption = "text",
) -> None:
    log_to_stderr(level="debug" if debug else log_level, log_format=log_format)
