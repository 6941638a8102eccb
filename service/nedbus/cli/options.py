"""What holds for all commands: options, exit codes, one line for an error."""

from __future__ import annotations

import functools
import inspect
import logging
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ParamSpec

import typer

from nedbus.bus import Bus
from nedbus.bus import connect as nedbus_connect
from nedbus.errors import AddressError, ConfigError, ConnectError, LayoutError, NedbusError
from nedbus_msgs import ANY, TOPICS

P = ParamSpec("P")

ConfigOption = Annotated[Path | None, typer.Option("--config", help="Settings file (default: nedbus.toml if there)")]
ConnectOption = Annotated[
    list[str] | None,
    typer.Option("--connect", "-c", metavar="ENDPOINT", help="Router to join (default: tcp/127.0.0.1:7447)"),
]
PrefixOption = Annotated[str | None, typer.Option("--prefix", help="First chunks of every key (default: nedbus)")]
TlsCaOption = Annotated[Path | None, typer.Option("--tls-ca", help="Authority of tls/ routers, PEM")]
TlsCertificateOption = Annotated[Path | None, typer.Option("--tls-certificate", help="This client's certificate, PEM")]
TlsKeyOption = Annotated[Path | None, typer.Option("--tls-key", help="Key of that certificate, PEM")]
TopicArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="TOPIC", help="TOPIC, or what nedbus list prints: VEHICLE/TOPIC/INSTANCE", show_default=False
    ),
]
TopicOption = Annotated[str, typer.Option("--topic", "-t", help='Topic, "*" for all')]
VehicleOption = Annotated[str, typer.Option("--vehicle", "-v", help='Vehicle, "*" for all')]
InstanceOption = Annotated[
    int | None, typer.Option("--instance", "-i", help="Instance of estimator_local_position (default: all)")
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON, for programs")]
WaitOption = Annotated[bool, typer.Option("--wait", "-w", help="Wait for a router that is not there yet")]
CountOption = Annotated[int | None, typer.Option("--count", "-n", min=1, help="End after this many samples")]
DurationOption = Annotated[float | None, typer.Option("--duration", "-d", min=0.0, help="End after this many seconds")]


def command(function: Callable[P, None]) -> Callable[P, None]:
    """Turn errors into one line and an exit code: 1 failure, 2 usage, 130 interrupt."""

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            function(*args, **kwargs)
        except (ConfigError, AddressError, LayoutError) as exc:
            raise _fail(exc, 2) from exc
        except NedbusError as exc:
            raise _fail(exc, 1) from exc
        except KeyboardInterrupt:
            raise typer.Exit(130) from None
        except BrokenPipeError:
            # The reader of a pipe is gone (`| head`): say nothing, and nothing more at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None
        except OSError as exc:
            tell(f"nedbus: cannot write: {(exc.strerror or str(exc)).lower()}")
            # What is buffered cannot be written at exit either.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None

    return run


def on_bus(function: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function: give it an open bus first, and the options that say where that is."""

    @command
    def run(**options: Any) -> None:
        with _open_bus(**{name: options.pop(name) for name in _BUS_OPTIONS}) as bus:
            function(bus, **options)

    _, *own = inspect.signature(function, eval_str=True).parameters.values()
    parameters = [*own, *_BUS_OPTIONS.values()]
    run.__doc__ = function.__doc__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined] # Typer reads both
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def _open_bus(
    *,
    connect: ConnectOption = None,
    prefix: PrefixOption = None,
    tls_ca: TlsCaOption = None,
    tls_certificate: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
    config: ConfigOption = None,
    wait: WaitOption = False,
) -> Bus:
    """Connect as the options say; with `wait` for as long as it takes."""

    def connect_within(seconds: float) -> Bus:
        return nedbus_connect(
            connect,
            timeout=seconds,
            prefix=prefix,
            tls_ca=tls_ca,
            tls_certificate=tls_certificate,
            tls_key=tls_key,
            config=config,
        )

    try:
        return connect_within(1.0)
    except ConnectError as exc:
        if not wait:
            raise
        tell(f"{exc}; waiting")
    return connect_within(float("inf"))


_BUS_OPTIONS = inspect.signature(_open_bus, eval_str=True).parameters


def tell(text: str) -> None:
    """Say something to a person, beside the output."""
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def write(line: str) -> None:
    """Write a line of output, at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


@dataclass(frozen=True, slots=True)
class Choice:
    """What of the bus a command is about."""

    topic: str
    vehicle: str
    instance: int | None


def choose(argument: str | None, *, topic: str, vehicle: str, instance: int | None) -> Choice:
    """Return what was asked for: by options, or by an argument as `nedbus list` prints it, [VEHICLE/]TOPIC[/INSTANCE].

    Raises ConfigError when both say something.
    """
    if argument is None:
        return Choice(topic, vehicle, instance)
    if topic != ANY:
        raise ConfigError("--topic", f"the topic is given as {argument!r} already: take one away")
    chunks = argument.strip("/").split("/")
    if chunks[0] not in {*TOPICS, ANY} and len(chunks) > 1:
        vehicle = chunks.pop(0)
    if len(chunks) == 2 and chunks[1].isdecimal():
        instance = int(chunks.pop())
    return Choice("/".join(chunks), vehicle, instance)


def _fail(error: NedbusError, code: int) -> typer.Exit:
    if logging.getLogger("nedbus").isEnabledFor(logging.DEBUG):
        raise error
    tell(f"nedbus: {error}")
    return typer.Exit(code)
