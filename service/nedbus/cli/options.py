"""What all commands share: options, the open bus, output, exit codes, one line for an error."""

from __future__ import annotations

import errno
import functools
import inspect
import logging
import os
import signal
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, ParamSpec

import typer

from nedbus.client import Bus, connect_with
from nedbus.errors import AddressError, ConfigError, ConnectError, LayoutError, NedbusError
from nedbus.log_event import about
from nedbus.settings import load_settings
from nedbus.transport import DEFAULT_ENDPOINT
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT_PREFIX, DEFAULT_TOPIC, MESSAGES, TOPICS, Selection

from .format import MAX_TEXT, printable, to_text
from .logs import logs_for_programs

P = ParamSpec("P")
_log = logging.getLogger("nedbus")

ConfigOption = Annotated[Path | None, typer.Option("--config", help="Settings file (default: nedbus.toml if there)")]
ConnectOption = Annotated[
    list[str] | None,
    typer.Option("--connect", "-c", metavar="ENDPOINT", help=f"Router to join (default: {DEFAULT_ENDPOINT})"),
]
PrefixOption = Annotated[
    str | None, typer.Option("--prefix", help=f"First chunks of every key (default: {DEFAULT_PREFIX})")
]
TlsCaOption = Annotated[Path | None, typer.Option("--tls-ca", help="Authority of tls/ routers, PEM")]
TlsCertificateOption = Annotated[Path | None, typer.Option("--tls-certificate", help="This client's certificate, PEM")]
TlsKeyOption = Annotated[Path | None, typer.Option("--tls-key", help="Key of that certificate, PEM")]
TopicArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="TOPIC", help="TOPIC, or what nedbus list prints: VEHICLE/TOPIC/INSTANCE", show_default=False
    ),
]
TopicOption = Annotated[str | None, typer.Option("--topic", "-t", help='Topic, "*" for all (default: all)')]
PositionTopicOption = Annotated[
    str | None, typer.Option("--topic", "-t", help=f'Topic, "*" for all (default: {DEFAULT_TOPIC})')
]
VehicleOption = Annotated[str, typer.Option("--vehicle", "-v", help='Vehicle, "*" for all')]
InstanceOption = Annotated[
    int | None, typer.Option("--instance", "-i", help="Instance, of topics that have some (default: all)")
]
FieldOption = Annotated[
    str | None, typer.Option("--field", metavar="NAME,NAME,...", help="Only these fields: x,y,z; nedbus schema")
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON, for programs")]
CsvOption = Annotated[bool, typer.Option("--csv", help="CSV, with a line of names first")]
WaitOption = Annotated[bool, typer.Option("--wait", "-w", help="Wait for a router that is not there yet")]
CountOption = Annotated[int | None, typer.Option("--count", "-n", min=1, help="End after this many samples")]
DurationOption = Annotated[float | None, typer.Option("--duration", "-d", min=0.0, help="End after this many seconds")]


def command(function: Callable[P, None]) -> Callable[P, None]:
    """Turn errors into one line and an exit code: 1 failure, 2 usage, 130 interrupt."""

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # as `main` left it while everything was imported
            signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            function(*args, **kwargs)
        except (ConfigError, AddressError, LayoutError) as exc:
            raise _exit_with(exc, 2) from exc
        except NedbusError as exc:
            raise _exit_with(exc, 1) from exc
        except KeyboardInterrupt:
            raise typer.Exit(130) from None
        except BrokenPipeError:
            # The reader of a pipe is gone (`| head`): nothing can be written, at exit either.
            _discard_stdout()
            raise typer.Exit(0) from None
        except OSError as exc:
            where = f"{exc.filename}: " if exc.filename else ""
            raise _exit_with(NedbusError(f"{where}{(exc.strerror or str(exc)).lower()}"), 1) from exc
        except BaseException as exc:
            if type(exc).__name__ != "PanicException":  # of Zenoh's; it cannot be imported
                raise
            hint = "is the clock set, is there memory, are enough open files allowed ('ulimit -n')?"
            raise _exit_with(NedbusError(f"Zenoh cannot go on ({exc}): {hint}"), 1) from exc
        finally:
            if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
                signal.signal(signal.SIGINT, signal.SIG_DFL)  # what is left is the end, which needs no traceback

    return run


def on_bus(function: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function: it gets an open bus as its first argument, and the options for connecting."""

    @functools.wraps(function)
    def run(open_bus: Callable[[], Bus], **options: Any) -> None:
        with open_bus() as bus:
            function(bus, **options)

    return lazily_on_bus(run)


def lazily_on_bus(function: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function that opens the bus itself: its first argument is what returns one."""

    @command
    def run(**options: Any) -> None:
        open_bus = functools.partial(_open_bus, **{name: options.pop(name) for name in _BUS_OPTIONS})
        function(open_bus, **options)

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
    """Connect with these options; with `wait` for as long as it takes."""
    settings = load_settings(
        config,
        connect=connect and tuple(connect),
        prefix=prefix,
        tls_ca=tls_ca,
        tls_certificate=tls_certificate,
        tls_key=tls_key,
    )
    try:
        return connect_with(settings, timeout=1.0)
    except ConnectError as exc:
        if not wait:
            raise
        write_stderr(f"{exc}; waiting")
    return connect_with(settings, timeout=None)


_BUS_OPTIONS = inspect.signature(_open_bus, eval_str=True).parameters


def write_stderr(text: str) -> None:
    """Write a line for a person to stderr, at once, or log it for programs; if nobody can read it any more, go on."""
    if logs_for_programs():
        for line in text.splitlines():
            _log.info("%s", line, extra=about("notice"))
        return
    with suppress(OSError):
        sys.stderr.write(f"{printable(text)}\n")
        sys.stderr.flush()


def write(line: str) -> None:
    """Write a line of output, or several, at once.

    Raises BrokenPipeError when its reader is gone, NedbusError when it cannot be written.
    """
    try:
        if sys.stdout is None:
            raise OSError(errno.EBADF, "standard output is closed")
        sys.stdout.write(f"{printable(line)}\n")
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as exc:
        _discard_stdout()
        raise NedbusError(f"cannot write: {(exc.strerror or str(exc)).lower()}") from exc


def require_one(flags: Mapping[str, bool]) -> None:
    """Raise ConfigError when more than one of these flags is set."""
    given = [name for name, is_set in flags.items() if is_set]
    if len(given) > 1:
        raise ConfigError(given[1], f"cannot be combined with {given[0]}: remove one of the two")


def parse_fields(text: str | None, selection: Selection) -> list[str]:
    """Return the names in `x,y,z`; raise ConfigError for one that no field of the selected messages has."""
    names = [name.strip() for name in text.split(",") if name.strip()] if text else []
    known = list(MESSAGES.values()) if selection.topic == ANY else [BY_TOPIC.get(selection.topic)]
    for name in names:
        first = known[0]  # what has no file here has any fields
        if first is not None and not any(each and name in each.types for each in known):
            raise ConfigError("--field", first.explain_unknown_field(name))
    return names


def choose(
    argument: str | None, *, topic: str | None, vehicle: str, instance: int | None, default: str = DEFAULT_TOPIC
) -> Selection:
    """Return the selection of the options, or of an argument as `nedbus list` prints it: [VEHICLE/]TOPIC[/INSTANCE].

    `default` is the topic if none is given.

    Raises ConfigError when both give a topic, AddressError for a selection that is invalid.
    """
    if argument is None:
        return Selection(default if topic is None else topic, vehicle, instance)
    if topic is not None:
        raise ConfigError("--topic", f"the topic is given as {argument!r} already: remove one of the two")
    chunks = argument.strip("/").split("/")
    if chunks[0] not in {*TOPICS, ANY} and len(chunks) > 1:
        vehicle = chunks.pop(0)
    if len(chunks) == 2 and chunks[1].isdecimal():
        instance = int(chunks.pop())
    return Selection("/".join(chunks), vehicle, instance)


def _exit_with(error: NedbusError, code: int) -> typer.Exit:
    """Return the exit for an error that is reported in one line; raise the error itself with --debug."""
    if logging.getLogger("nedbus").isEnabledFor(logging.DEBUG):
        raise error
    if logs_for_programs():
        _log.error("%s", error, extra=about("error"))
    else:
        write_stderr(to_text(f"nedbus: {error}", MAX_TEXT))
    return typer.Exit(code)


def _discard_stdout() -> None:
    """Redirect stdout to the null device, so that flushing it at exit does not fail again."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
