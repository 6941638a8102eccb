"""The options that commands share: how to connect, which streams, how many; errors as one line and an exit code."""

from __future__ import annotations

import functools
import inspect
import logging
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ParamSpec

import typer

from nedbus.client import Bus, connect_with
from nedbus.errors import AddressError, ConfigError, ConnectError, LayoutError, NedbusError
from nedbus.log_event import about
from nedbus.settings import load_settings
from nedbus.transport import DEFAULT_ENDPOINT
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT_PREFIX, MESSAGES, TOPICS, Selection

from .output.streams import MAX_TEXT, discard_stdout, logs_for_programs, to_text, write_stderr

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
TopicOption = Annotated[str, typer.Option("--topic", "-t", help='Topic, "*" for all')]
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
            discard_stdout()
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
    """Make a command of a function that has a parameter `bus`, an open one, or `open_bus`, which opens one.

    The command has the options for connecting in its place.
    """
    name = "bus" if "bus" in inspect.signature(function).parameters else "open_bus"

    def run(options: dict[str, Any], own: dict[str, Any]) -> None:
        if name == "open_bus":
            function(**own, open_bus=functools.partial(_open_bus, **options))
            return
        with _open_bus(**options) as bus:
            function(**own, bus=bus)

    return command(_replace_parameter(function, name, inspect.signature(_open_bus, eval_str=True), run))


def selecting(default: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options that select streams in place of its parameter `selection`; `default`: its topic."""
    shown = "all" if default == ANY else default
    option = Annotated[str | None, typer.Option("--topic", "-t", help=f'Topic, "*" for all (default: {shown})')]

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        def run(options: dict[str, Any], own: dict[str, Any]) -> None:
            function(**own, selection=_select(**options, default=default))

        *added, _ = inspect.signature(_select, eval_str=True).parameters.values()
        added = [each.replace(annotation=option) if each.name == "topic_option" else each for each in added]
        return _replace_parameter(function, "selection", inspect.Signature(added), run)

    return decorate


def _replace_parameter(
    function: Callable[..., None],
    name: str,
    added: inspect.Signature,
    run: Callable[[dict[str, Any], dict[str, Any]], None],
) -> Callable[..., None]:
    """Return a function that has other parameters in place of one, as Typer reads them.

    `run` gets the values of those, and the values of the function's own.
    """

    @functools.wraps(function)
    def replaced(**options: Any) -> None:
        run({each: options.pop(each) for each in added.parameters}, options)

    own = [each for each in inspect.signature(function, eval_str=True).parameters.values() if each.name != name]
    parameters = sorted([*own, *added.parameters.values()], key=lambda each: each.kind)
    replaced.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined] # Typer reads both
    replaced.__annotations__ = {each.name: each.annotation for each in parameters}
    return replaced


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
    tls = {"tls_ca": tls_ca, "tls_certificate": tls_certificate, "tls_key": tls_key}
    settings = load_settings(config, connect=connect, prefix=prefix, **tls)
    try:
        return connect_with(settings, timeout=1.0)
    except ConnectError as exc:
        if not wait:
            raise
        write_stderr(f"{exc}; waiting")
    return connect_with(settings, timeout=None)


def _select(
    topic: TopicArgument = None,
    *,
    topic_option: str | None = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    default: str,
) -> Selection:
    """Return the selection of the options, or of an argument as `nedbus list` prints it: [VEHICLE/]TOPIC[/INSTANCE].

    Raises ConfigError when both give a topic, AddressError for a selection that is invalid.
    """
    if topic is None:
        return Selection(default if topic_option is None else topic_option, vehicle, instance)
    if topic_option is not None:
        raise ConfigError("--topic", f"the topic is given as {topic!r} already: remove one of the two")
    chunks = topic.strip("/").split("/")
    if chunks[0] not in {*TOPICS, ANY} and len(chunks) > 1:
        vehicle = chunks.pop(0)
    if len(chunks) == 2 and chunks[1].isdecimal():
        instance = int(chunks.pop())
    return Selection("/".join(chunks), vehicle, instance)


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


def _exit_with(error: NedbusError, code: int) -> typer.Exit:
    """Return the exit for an error that is reported in one line; raise the error itself with --debug."""
    if logging.getLogger("nedbus").isEnabledFor(logging.DEBUG):
        raise error
    if logs_for_programs():
        _log.error("%s", error, extra=about("error"))
    else:
        write_stderr(to_text(f"nedbus: {error}", MAX_TEXT))
    return typer.Exit(code)
