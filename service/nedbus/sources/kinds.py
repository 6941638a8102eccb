"""Table of source kinds, and parser of sources: `KIND:TARGET?OPTION=VALUE&...`, or a TOML table."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast
from urllib.parse import parse_qsl, quote, unquote, urlencode

from pydantic import ValidationError

from nedbus import flights
from nedbus.errors import AddressError, ConfigError
from nedbus.extras import import_optional
from nedbus.transport import Tls
from nedbus_msgs import DEFAULT_PREFIX

from .options import (
    MavlinkOptions,
    Options,
    Px4ZenohOptions,
    RecordedOptions,
    RecordingOptions,
    SimulatorOptions,
)
from .source import LiveSource, ReplaySource, Source

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


@dataclass(frozen=True, slots=True)
class SourceKind:
    """One kind of source: its options, its target, and its function or class, which is imported on first use.

    `target`: name of the part after the colon, in brackets if it is optional; None if there is none.
    `extra`: the nedbus extra that it requires.
    """

    options: type[Options]
    target: str | None
    module: str
    name: str
    extra: str = ""

    def accepts(self, target: str) -> bool:
        """Return whether this target is allowed; "" means no target."""
        if target:
            return self.target is not None
        return self.target is None or self.target.startswith("[")


SOURCE_KINDS: Final[Mapping[str, SourceKind]] = {
    "sim": SourceKind(SimulatorOptions, None, "nedbus.sources.simulator", "open_simulator"),
    "ulog": SourceKind(RecordedOptions, "FILE", "nedbus.sources.replay", "open_replay"),
    "mcap": SourceKind(RecordingOptions, "FILE", "nedbus.sources.replay", "open_replay", "mcap"),
    "tlog": SourceKind(RecordedOptions, "FILE", "nedbus.sources.replay", "open_replay", "mavlink"),
    "px4-zenoh": SourceKind(
        Px4ZenohOptions, "[ENDPOINT]", "nedbus.sources.px4.source", "Px4ZenohSource"
    ),
    "mavlink": SourceKind(
        MavlinkOptions, "LINK", "nedbus.sources.mavlink.source", "MavlinkSource", "mavlink"
    ),
}
_KNOWN_KINDS: Final = f"choose from {', '.join(SOURCE_KINDS)}"
_ESCAPED: Final = re.compile("%(3F|25)", re.IGNORECASE)  # in a path


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """One configured source."""

    text: str
    kind: str
    target: str
    options: Options

    def open_source(
        self,
        *,
        vehicle: str,
        routers: tuple[str, ...] = (),
        tls: Tls | None = None,
        prefix: str = DEFAULT_PREFIX,
    ) -> Source:
        """Create the source for a service; raise ConfigError for an invalid target or file, or a missing extra."""
        kind = SOURCE_KINDS[self.kind]
        if kind.target == "FILE":
            path = Path(self.target).expanduser()
            # A pipe, socket or device may block forever, and cannot be read twice.
            if path.exists() and not path.is_file() and not path.is_dir():
                reason = f"{path} is not a regular file; save the data to a file first"
                raise ConfigError(f"source {self.text!r}", reason)
        make = getattr(import_optional(kind.extra, kind.module), kind.name)
        if isinstance(self.options, RecordedOptions | SimulatorOptions):
            return ReplaySource(self.options, partial(make, self.target, self.options, vehicle))
        return cast("LiveSource", make(self.target, self.options, vehicle, routers, tls, prefix))


def parse_source(source: str | Mapping[str, object]) -> SourceSpec:
    """Parse a string such as `ulog:flight.ulg?speed=2&vehicle=7`; in a path, write `?` as `%3F` and `%` as `%25`.

    A mapping holds the kind, the target by name (`file`, `link` or `endpoint`) and the options, such as
    {"kind": "ulog", "file": "flight.ulg", "speed": 2, "vehicle": 7}.

    Raises ConfigError for an unknown kind, a missing target, or an unknown or invalid option.
    """
    text = source if isinstance(source, str) else _text_of_table(source)
    where = f"source {text!r}"
    name, _, rest = text.partition(":")
    kind = SOURCE_KINDS.get(name)
    if kind is None:
        raise ConfigError(where, f"unknown kind {name!r}; {_suggest(text)}")
    target = rest
    query = ""
    if "?" in rest:
        target, _, query = rest.rpartition("?")
    if not kind.accepts(target):
        form = f"{name}:{kind.target}" if kind.target else f"{name}:?OPTION=VALUE"
        raise ConfigError(where, f"the target is missing or not allowed; write {form}")
    options = _parse_options(kind, query, where)
    if kind.target == "FILE":
        target = _ESCAPED.sub(lambda match: unquote(match[0]), target)
    return SourceSpec(text, name, target, options)


def _suggest(text: str) -> str:
    """Return what to write instead of a text of unknown kind: the kind of a file by its name, or a known kind."""
    kind, _, rest = text.partition(":")
    path = rest if rest and "/" not in kind else text
    kind_of_file = flights.find_format(path.partition("?")[0])
    if kind_of_file:
        return f"write {kind_of_file}:{path}"
    return _KNOWN_KINDS


def _parse_options(kind: SourceKind, query: str, where: str) -> Options:
    """Parse OPTION=VALUE&OPTION=VALUE; raise ConfigError, which begins with `where`."""
    try:
        # Unlike in an HTML form, a plus is not a space.
        escaped = query.replace("+", "%2B")
        pairs = parse_qsl(escaped, keep_blank_values=True, strict_parsing=bool(query))
    except ValueError:
        hint = "; in a path, write ? as %3F" if kind.target == "FILE" else ""
        reason = f"{query!r} is not OPTION=VALUE&OPTION=VALUE{hint}"
        raise ConfigError(where, reason) from None
    values = dict(pairs)
    if not values:  # for the defaults alone, Pydantic need not compile a validator
        return kind.options.model_construct()
    try:
        options = kind.options.model_validate(values)
    except ValidationError as exc:
        detail = exc.errors()[0]
        name = str(detail["loc"][0])
        raise ConfigError(where, _explain(kind, name, detail), key=name) from exc
    if len(values) < len(pairs):
        raise ConfigError(where, "an option occurs twice; remove one")
    return options


def _explain(kind: SourceKind, name: str, detail: "ErrorDetails") -> str:
    """Return why the value of an option is invalid."""
    fields = kind.options.model_fields
    if name not in fields:
        return f"unknown option {name!r}; choose from {', '.join(fields)}"
    cause = detail.get("ctx", {}).get("error")
    if name == "topics" and isinstance(cause, AddressError):
        return str(cause)
    return f"{name}={detail['input']} is invalid; expected {fields[name].description}"


def _text_of_table(table: Mapping[str, object]) -> str:
    """Convert a table to the text of a source; raise ConfigError if the kind or target is missing or invalid."""
    values = dict(table)
    if "kind" not in values:
        raise ConfigError("source", f"kind is missing; {_KNOWN_KINDS}", key="")
    name = values.pop("kind")
    kind = SOURCE_KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise ConfigError("source", f"unknown kind {name!r}; {_KNOWN_KINDS}", key="kind")
    target_name = (kind.target or "").strip("[]").lower()
    target = values.pop(target_name, "")
    if not isinstance(target, str) or not kind.accepts(target):
        raise ConfigError(f"source {name!r}", f'it needs {target_name} = "..."', key=target_name)
    if kind.target == "FILE":
        target = target.replace("%", "%25").replace("?", "%3F")
    text = f"{name}:{target}"
    if values:
        options = {option: _text_of_value(value) for option, value in values.items()}
        text += "?" + urlencode(options, safe=":,/+", quote_via=quote)
    return text


def _text_of_value(value: object) -> str:
    """Format the value of an option: 1 for true, NAME:VEHICLE,NAME:VEHICLE for a table."""
    if isinstance(value, Mapping):
        return ",".join(f"{name}:{vehicle}" for name, vehicle in value.items())
    if isinstance(value, list | tuple):
        return ",".join(map(_text_of_value, value))
    if isinstance(value, bool):
        return str(int(value))
    return str(value)
