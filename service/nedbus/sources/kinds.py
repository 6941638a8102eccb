"""Table of source kinds, and parser of sources: `KIND:TARGET?OPTION=VALUE&...`, or a TOML table."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, cast
from urllib.parse import parse_qsl, quote, unquote, urlencode

from pydantic import ValidationError

from nedbus.errors import AddressError, ConfigError
from nedbus.extras import import_optional
from nedbus.flights import find_format
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
        return (
            self.target is not None
            if target
            else self.target is None or self.target.startswith("[")
        )


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
        kind, path = SOURCE_KINDS[self.kind], Path(self.target).expanduser()
        # A pipe, socket or device may block forever, and cannot be read twice.
        if kind.target == "FILE" and path.exists() and not (path.is_file() or path.is_dir()):
            raise ConfigError(
                f"source {self.text!r}",
                f"{path} is not a regular file; save the data to a file first",
            )
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
    kind_name, _, rest = text.partition(":")
    kind = SOURCE_KINDS.get(kind_name)
    if kind is None:
        path = rest if rest and "/" not in kind_name else text
        kind_of_file = find_format(path.partition("?")[0])
        hint = (
            f"write {kind_of_file}:{path}"
            if kind_of_file
            else f"choose from {', '.join(SOURCE_KINDS)}"
        )
        raise ConfigError(f"source {text!r}", f"unknown kind {kind_name!r}; {hint}")
    target, _, query = rest.rpartition("?") if "?" in rest else (rest, "", "")
    if not kind.accepts(target):
        form = f"{kind_name}:{kind.target}" if kind.target else f"{kind_name}:?OPTION=VALUE"
        raise ConfigError(f"source {text!r}", f"the target is missing or not allowed; write {form}")
    try:
        # Unlike in an HTML form, a plus is not a space.
        pairs = parse_qsl(
            query.replace("+", "%2B"), keep_blank_values=True, strict_parsing=bool(query)
        )
        options = kind.options.model_validate(dict(pairs))
    except ValidationError as exc:
        detail = exc.errors()[0]
        name = str(detail["loc"][0])
        if (field := kind.options.model_fields.get(name)) is None:
            reason = f"unknown option {name!r}; choose from {', '.join(kind.options.model_fields)}"
        elif (
            isinstance(cause := detail.get("ctx", {}).get("error"), AddressError)
            and name == "topics"
        ):
            reason = str(cause)
        else:
            reason = f"{name}={detail['input']} is invalid; expected {field.description}"
        raise ConfigError(f"source {text!r}", reason, key=name) from exc
    except ValueError:
        hint = "; in a path, write ? as %3F" if kind.target == "FILE" else ""
        raise ConfigError(
            f"source {text!r}", f"{query!r} is not OPTION=VALUE&OPTION=VALUE{hint}"
        ) from None
    if len(dict(pairs)) < len(pairs):
        raise ConfigError(f"source {text!r}", "an option occurs twice; remove one")
    if kind.target == "FILE":
        target = re.sub("%(3F|25)", lambda found: unquote(found[0]), target, flags=re.IGNORECASE)
    return SourceSpec(text, kind_name, target, options)


def _text_of_table(table: Mapping[str, object]) -> str:
    """Convert a table to the text of a source; raise ConfigError if the kind or target is missing or invalid."""
    options = dict(table)
    name = options.pop("kind", None)
    kind = SOURCE_KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        problem, key = (
            ("kind is missing", "") if name is None else (f"unknown kind {name!r}", "kind")
        )
        raise ConfigError("source", f"{problem}; choose from {', '.join(SOURCE_KINDS)}", key=key)
    target_name = (kind.target or "").strip("[]").lower()
    target = options.pop(target_name, "")
    if not isinstance(target, str) or not kind.accepts(target):
        raise ConfigError(f"source {name!r}", f'it needs {target_name} = "..."', key=target_name)
    return _join(str(name), target, {key: _text_of_value(value) for key, value in options.items()})


def _text_of_value(value: object) -> str:
    """Format the value of an option: 1 for true, NAME:VEHICLE,NAME:VEHICLE for a table."""
    if isinstance(value, Mapping):
        return ",".join(f"{name}:{each}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ",".join(map(_text_of_value, value))
    return str(int(value)) if isinstance(value, bool) else str(value)


def _join(kind: str, target: str, options: Mapping[str, str]) -> str:
    """Return the text of a source, with % and ? escaped in a path."""
    path = (
        target.replace("%", "%25").replace("?", "%3F")
        if SOURCE_KINDS[kind].target == "FILE"
        else target
    )
    query = urlencode(options, safe=":,/+", quote_via=quote)
    return f"{kind}:{path}?{query}" if query else f"{kind}:{path}"
