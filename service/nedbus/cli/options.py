"""Options shared by commands, and the translation of errors into one line and an exit code."""

import functools
import inspect
import logging
import re
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer

from nedbus import limits
from nedbus.endpoints import DEFAULT_ENDPOINT
from nedbus.errors import (
    ArgumentError,
    ConfigError,
    ConnectError,
    LayoutError,
    NedbusError,
    system_reason,
)
from nedbus.log_event import about
from nedbus_msgs import (
    ANY,
    BY_TOPIC,
    DEFAULT_PREFIX,
    DEFAULT_TOPIC,
    MESSAGES,
    TOPICS,
    Definition,
    Selection,
)
from nedbus_msgs.frames import derived_from

from .output.streams import discard_stdout, is_log_structured, to_text, write_stderr

if TYPE_CHECKING:
    from nedbus import Bus

    OpenBus = Callable[[], Bus]
else:
    # evaluated by `command`; the client loads Zenoh, which commands for files do not need
    OpenBus = Callable[[], Any]

_log = logging.getLogger("nedbus")

_ROUTER: Final = f"Router to connect to; repeatable (default: {DEFAULT_ENDPOINT})"
_ADDRESS: Final = "TOPIC, or VEHICLE/TOPIC/INSTANCE as printed by nedbus list"
_FILES: Final = "Logs or recordings (.ulg, .mcap, .tlog), instead of live vehicles"
_TOPIC: Final = (
    f'Topic, "*" for all; repeatable (default: {DEFAULT_TOPIC} for echo and get, else all)'
)
_TOPICS: Final = "Topic; repeatable (default: all)"
_VEHICLES: Final = "Vehicle; repeatable (default: all)"
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="Settings file (default: ./nedbus.toml)")
]
ConnectOption = Annotated[
    list[str] | None, typer.Option("--connect", "-c", metavar="ENDPOINT", help=_ROUTER)
]
PrefixOption = Annotated[str | None, typer.Option(help=f"Key prefix (default: {DEFAULT_PREFIX})")]
TlsCaOption = Annotated[
    Path | None, typer.Option("--tls-ca", help="CA certificate for tls/ routers, PEM")
]
TlsCertificateOption = Annotated[
    Path | None, typer.Option("--tls-certificate", help="Client certificate, PEM")
]
TlsKeyOption = Annotated[
    Path | None, typer.Option("--tls-key", help="Key of the client certificate, PEM")
]
TopicsArgument = Annotated[
    list[str] | None, typer.Argument(metavar="TOPIC", help=_ADDRESS, show_default=False)
]
FilesArgument = Annotated[list[Path] | None, typer.Argument(metavar="FILE", help=_FILES)]
TopicsOption = Annotated[
    list[str] | None, typer.Option("--topic", "-t", metavar="TOPIC", help=_TOPICS)
]
DefaultTopicsOption = Annotated[
    list[str] | None, typer.Option("--topic", "-t", metavar="TOPIC", help=_TOPIC)
]
VehiclesOption = Annotated[
    list[str] | None, typer.Option("--vehicle", "-v", metavar="VEHICLE", help=_VEHICLES)
]
InstanceOption = Annotated[
    int | None, typer.Option("--instance", "-i", help="Instance of the topic (default: all)")
]
FieldOption = Annotated[
    str | None, typer.Option("--field", metavar="NAME,NAME,...", help="Fields to show: x,y,z")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Write JSON")]
CsvOption = Annotated[bool, typer.Option("--csv", help="Write CSV with a header line")]
WaitOption = Annotated[
    bool, typer.Option("--wait", "-w", help="Wait until the router is reachable")
]
CountOption = Annotated[
    int | None, typer.Option("--count", "-n", min=1, help="Stop after this number of samples")
]
DurationOption = Annotated[
    float | None, typer.Option("--duration", "-d", min=0.0, help="Duration in seconds")
]

ALL: Final = Selection()  # default selection of commands that show all topics
POSITIONS: Final = Selection(DEFAULT_TOPIC)  # default selection of commands that show positions


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Turn a function into a command; its errors become one line on stderr and an exit code.

    Some parameters are expanded to the options that create their values: `bus` (an open bus), `open_bus` and
    `read_settings` (functions), and `selection`, whose default supplies the default topic.
    """
    parameters = inspect.signature(function, eval_str=True).parameters
    factories = {name: factory for name, factory in _FACTORIES.items() if name in parameters}
    expanded = {name: _options_of(factory) for name, factory in factories.items()}
    options = [parameter for name, parameter in parameters.items() if name not in factories]
    for parameters_of_factory in expanded.values():
        options += parameters_of_factory
    options.sort(key=lambda option: option.kind)

    @functools.wraps(function)
    def run(**values: Any) -> None:
        with exit_on_errors(), ExitStack() as stack:
            for name, factory in factories.items():
                own = {option.name: values.pop(option.name) for option in expanded[name]}
                make = functools.partial(factory, **own)
                if name == "selection":
                    values[name] = make(default=parameters[name].default.topics)
                elif name == "bus":
                    values[name] = stack.enter_context(make())
                else:
                    values[name] = make
            function(**values)

    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined] # Typer reads both
    run.__annotations__ = {option.name: option.annotation for option in options}
    # because rich keeps line breaks
    run.__doc__ = re.sub(r"(?<=\S)\n(?=\S)", " ", inspect.getdoc(function) or "")
    return run


def _options_of(factory: Callable[..., object]) -> list[inspect.Parameter]:
    """Return a factory's parameters that have defaults; `**settings_options` expands to those of `_read_settings`."""
    parameters = [*inspect.signature(factory, eval_str=True).parameters.values()]
    options = [option for option in parameters if option.default is not option.empty]
    if parameters[-1].kind is inspect.Parameter.VAR_KEYWORD:
        return [*_options_of(_read_settings), *options]
    return options


@contextmanager
def exit_on_errors() -> Iterator[None]:
    """Report errors in one line and exit: 1 for a failure, 2 for wrong usage, 130 for an interrupt."""
    with _raising_signals():
        try:
            yield
        except (ArgumentError, ConfigError, LayoutError) as exc:
            raise _exit_with(exc, 2) from exc
        except NedbusError as exc:
            raise _exit_with(exc, 1) from exc
        except KeyboardInterrupt:
            raise typer.Exit(130) from None
        except BrokenPipeError:
            # the reader of the pipe has gone (`| head`): the flush at exit would also fail
            discard_stdout()
            raise typer.Exit(0) from None
        except EOFError as exc:  # Typer prints "Aborted." alone
            hint = "if a full disk truncated Python's bytecode, delete all __pycache__ folders"
            reason = f"unexpected end of data ({exc}): {hint}; --debug shows the traceback"
            raise _exit_with(NedbusError(reason), 1) from exc
        except OSError as exc:
            where = ""
            if exc.filename:
                where = f"{exc.filename}: "
            raise _exit_with(NedbusError(f"{where}{system_reason(exc)}"), 1) from exc
        except BaseException as exc:
            # Zenoh raises this class, which cannot be imported
            if type(exc).__name__ != "PanicException":
                raise
            hint = "check the system clock, free memory and the limit of open files ('ulimit -n')"
            raise _exit_with(NedbusError(f"Zenoh failed ({exc}): {hint}"), 1) from exc


@contextmanager
def _raising_signals() -> Iterator[None]:
    """Let signals end a command with an exception: it removes an unfinished file, and shows the cursor again."""
    handlers = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: _end_command,
        signal.SIGHUP: _end_command,  # the terminal was closed
    }
    for number, handler in handlers.items():
        if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores SIGHUP
            signal.signal(number, handler)
    try:
        yield
    finally:
        for number in handlers:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)  # no traceback during the exit


def _end_command(number: int, _: FrameType | None) -> None:
    sys.exit(128 + number)


def _read_settings(
    *,
    connect: ConnectOption = None,
    prefix: PrefixOption = None,
    tls_ca: TlsCaOption = None,
    tls_certificate: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
    config: ConfigOption = None,
) -> Any:
    from nedbus.settings import load_settings

    tls = {"tls_ca": tls_ca, "tls_certificate": tls_certificate, "tls_key": tls_key}
    return load_settings(config, connect=connect, prefix=prefix, **tls)


def _open_bus(*, wait: WaitOption = False, **settings_options: Any) -> AbstractContextManager[Any]:
    from nedbus import Bus

    settings = _read_settings(**settings_options)
    try:
        return Bus(settings, timeout=1.0)
    except ConnectError as exc:
        if not wait:
            raise
        write_stderr(f"{exc}; waiting")
    return Bus(settings, timeout=None)


def _select(
    topics: TopicsArgument = None,
    *,
    topic_option: DefaultTopicsOption = None,
    vehicle: VehiclesOption = None,
    instance: InstanceOption = None,
    default: Sequence[str],
) -> Selection:
    """Return the selection of the options, or of arguments [VEHICLE/]TOPIC[/INSTANCE] as `nedbus list` prints them.

    Raises ConfigError for arguments of different vehicles or instances.
    """
    if not topics:
        return Selection(topic_option or default, vehicle or ANY, instance)
    if topic_option:
        raise ConfigError(
            "--topic", f"the argument already names the topic {topics[0]!r}: remove one of the two"
        )
    streams = [_split_stream(text) for text in topics]
    first = streams[0]
    for text, stream in zip(topics, streams, strict=True):
        if stream.vehicle != first.vehicle or stream.instance != first.instance:
            reason = f"{topics[0]!r} and {text!r} differ in vehicle or instance: name them with --vehicle and --topic"
            raise ConfigError("TOPIC", reason)
    vehicles = vehicle or ANY
    if first.vehicle is not None:
        vehicles = first.vehicle
    if first.instance is not None:
        instance = first.instance
    return Selection([stream.topic for stream in streams], vehicles, instance)


class _Stream(NamedTuple):
    """A stream as an argument; None for the parts that it does not name."""

    topic: str
    vehicle: str | None
    instance: int | None


def _split_stream(text: str) -> _Stream:
    chunks = text.strip("/").split("/")
    vehicle = instance = None
    names_vehicle = len(chunks) > 1 and chunks[0] not in {*TOPICS, ANY}
    if names_vehicle and chunks[1] not in ("in", "out"):  # fmu/out/TOPIC has its own error
        vehicle = chunks.pop(0)
    if len(chunks) == 2 and chunks[1].isdecimal():
        instance = int(chunks.pop())
    return _Stream("/".join(chunks), vehicle, instance)


_FACTORIES: Final[Mapping[str, Callable[..., Any]]] = {
    "selection": _select, "bus": _open_bus, "open_bus": _open_bus, "read_settings": _read_settings,
}  # fmt: skip


def allow_one(flags: Mapping[str, bool]) -> None:
    """Raise ConfigError if more than one of these flags is set."""
    given = [name for name, is_set in flags.items() if is_set]
    if len(given) > 1:
        raise ConfigError(given[1], f"cannot be combined with {given[0]}: remove one of the two")


def _columns_of(definition: Definition[Any]) -> list[str]:
    return [*definition.types, *derived_from(definition.types)]


def parse_fields(text: str | None, selection: Selection, *, elements: bool = False) -> list[str]:
    """Split `x,y,z` into field names; raise ConfigError for a name that no selected message has.

    `elements`: accept elements of arrays, such as `q[0]`, too.
    """
    if text is None:
        return []
    names = [name.strip() for name in text.split(",") if name.strip()]
    topics = selection.topics
    if topics == (ANY,):
        messages: list[Definition[Any]] = list(MESSAGES.values())
    elif all(topic in BY_TOPIC for topic in topics):
        messages = [BY_TOPIC[topic] for topic in topics]
    else:
        return names  # the fields of a message that is not built in are not known yet
    known = set[str]()
    for definition in messages:
        known.update(_columns_of(definition))
    for name in names:
        field = name
        if elements:
            field, _, _ = name.partition("[")
        if field not in known:
            raise ConfigError("--field", messages[0].explain_unknown_field(field))
    return names


def _exit_with(error: NedbusError, code: int) -> typer.Exit:
    """Report an error in one line and return the exit; with --debug, raise the error itself."""
    if logging.getLogger("nedbus").isEnabledFor(logging.DEBUG):
        raise error
    if is_log_structured():
        _log.error("%s", error, extra=about("error"))
    else:
        write_stderr(to_text(f"nedbus: {error}", limits.LINE_TEXT))
    return typer.Exit(code)
