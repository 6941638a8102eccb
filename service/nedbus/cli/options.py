"""The options that commands share: how to connect, which streams, how many; errors as one line and an exit code."""

from __future__ import annotations

import functools
import inspect
import itertools
import logging
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from nedbus.client import Bus, connect_with
from nedbus.errors import AddressError, ConfigError, ConnectError, LayoutError, NedbusError
from nedbus.log_event import about
from nedbus.settings import Settings, load_settings
from nedbus.transport import DEFAULT_ENDPOINT
from nedbus_msgs import ANY, BY_TOPIC, DEFAULT_PREFIX, DEFAULT_TOPIC, MESSAGES, TOPICS, Selection

from .output.streams import MAX_TEXT, discard_stdout, logs_for_programs, to_text, write_stderr

_log = logging.getLogger("nedbus")

_ROUTER: Final = f"Router to join (default: {DEFAULT_ENDPOINT})"
_TOPIC: Final = f'Topic, "*" for all (default: {DEFAULT_TOPIC} for echo and get, else all)'
ConfigOption = Annotated[Path | None, typer.Option("--config", help="Settings file (default: nedbus.toml if there)")]
ConnectOption = Annotated[list[str] | None, typer.Option("--connect", "-c", metavar="ENDPOINT", help=_ROUTER)]
PrefixOption = Annotated[str | None, typer.Option(help=f"First chunks of every key (default: {DEFAULT_PREFIX})")]
TlsCaOption = Annotated[Path | None, typer.Option("--tls-ca", help="Authority of tls/ routers, PEM")]
TlsCertificateOption = Annotated[Path | None, typer.Option("--tls-certificate", help="This client's certificate, PEM")]
TlsKeyOption = Annotated[Path | None, typer.Option("--tls-key", help="Key of that certificate, PEM")]
TopicArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="TOPIC", help="TOPIC, or what nedbus list prints: VEHICLE/TOPIC/INSTANCE", show_default=False
    ),
]
FileArgument = Annotated[
    Path | None, typer.Argument(metavar="[FILE]", help="A .ulg log or .mcap recording, instead of live vehicles")
]
TopicOption = Annotated[str, typer.Option("--topic", "-t", help='Topic, "*" for all')]
DefaultTopicOption = Annotated[str | None, typer.Option("--topic", "-t", help=_TOPIC)]
VehicleOption = Annotated[str, typer.Option("--vehicle", "-v", help='Vehicle, "*" for all')]
InstanceOption = Annotated[int | None, typer.Option("--instance", "-i", help="Of topics that have some (default: all)")]
FieldOption = Annotated[str | None, typer.Option("--field", metavar="NAME,NAME,...", help="Only these fields: x,y,z")]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON, for programs")]
CsvOption = Annotated[bool, typer.Option("--csv", help="CSV, with a line of names first")]
WaitOption = Annotated[bool, typer.Option("--wait", "-w", help="Wait for a router that is not there yet")]
CountOption = Annotated[int | None, typer.Option("--count", "-n", min=1, help="End after this many samples")]
DurationOption = Annotated[float | None, typer.Option("--duration", "-d", min=0.0, help="End after this many seconds")]


ALL: Final = Selection()
"""The default of commands that show all topics."""

POSITIONS: Final = Selection(DEFAULT_TOPIC)
"""The default of commands that show positions."""


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Make a command of a function, whose errors become one line and an exit code.

    The command has the options to make parameters `bus`, an open one, `open_bus` and `read_settings`, functions, and
    `selection` of; the default of `selection` has its default topic.
    """
    parameters = inspect.signature(function, eval_str=True).parameters
    makers = {name: maker for name, maker in _MAKERS.items() if name in parameters}
    taken = {name: _options_of(maker) for name, maker in makers.items()}
    own = [each for name, each in parameters.items() if name not in makers]

    @functools.wraps(function)
    def run(**values: Any) -> None:
        with _exit_on_errors(), ExitStack() as stack:
            for name, maker in makers.items():
                make = functools.partial(maker, **{each.name: values.pop(each.name) for each in taken[name]})
                if name == "selection":
                    values[name] = make(default=parameters[name].default.topic)
                else:
                    values[name] = stack.enter_context(make()) if name == "bus" else make
            function(**values)

    options = sorted([*own, *itertools.chain(*taken.values())], key=lambda each: each.kind)
    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined] # Typer reads both
    run.__annotations__ = {each.name: each.annotation for each in options}
    return run


def _options_of(maker: Callable[..., object]) -> list[inspect.Parameter]:
    """Return the parameters that have defaults; `**settings_options` stands for those of `_read_settings`."""
    parameters = [*inspect.signature(maker, eval_str=True).parameters.values()]
    own = [each for each in parameters if each.default is not each.empty]
    return [*_options_of(_read_settings), *own] if parameters[-1].kind is inspect.Parameter.VAR_KEYWORD else own


@contextmanager
def _exit_on_errors() -> Iterator[None]:
    """Turn errors into one line and an exit code: 1 failure, 2 usage, 130 interrupt."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # as `main` left it while everything was imported
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
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
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # only the exit is left, which needs no traceback


def _read_settings(
    *,
    connect: ConnectOption = None,
    prefix: PrefixOption = None,
    tls_ca: TlsCaOption = None,
    tls_certificate: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
    config: ConfigOption = None,
) -> Settings:
    tls = {"tls_ca": tls_ca, "tls_certificate": tls_certificate, "tls_key": tls_key}
    return load_settings(config, connect=connect, prefix=prefix, **tls)


def _open_bus(*, wait: WaitOption = False, **settings_options: Any) -> Bus:
    """Connect with the settings; with `wait` for as long as it takes."""
    settings = _read_settings(**settings_options)
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
    topic_option: DefaultTopicOption = None,
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


_MAKERS: Final[Mapping[str, Callable[..., Any]]] = {
    "selection": _select, "bus": _open_bus, "open_bus": _open_bus, "read_settings": _read_settings,
}  # fmt: skip


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
        first = known[0]  # an undeclared message may have any fields
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
