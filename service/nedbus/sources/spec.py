"""The table of source kinds, and the parser of sources: `KIND:TARGET?OPTION=VALUE&...`, or a table of TOML."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Final, cast
from urllib.parse import parse_qsl, unquote, urlencode

from pydantic import ValidationError

from nedbus.errors import AddressError, ConfigError
from nedbus.extras import needs
from nedbus.recording import SUFFIXES, format_of
from nedbus.transport import Tls

from .options import MavlinkOptions, Options, Px4ZenohOptions, RecordedOptions, SimulatorOptions
from .source import Source, SourceContext


@dataclass(frozen=True, slots=True)
class SourceKind:
    """One kind of source: its options, its target, and the class that implements it, imported on first use.

    `target`: the part after the colon; None if there is none, in brackets if it is optional.
    `extra`: the extra of nedbus that it needs.
    """

    options: type[Options]
    target: str | None
    module: str
    class_name: str
    extra: str = ""

    def accepts(self, target: str) -> bool:
        """Return whether this target, which may be empty, is allowed."""
        return self.target is not None if target else self.target is None or self.target.startswith("[")


SOURCE_KINDS: Final[Mapping[str, SourceKind]] = {
    "sim": SourceKind(SimulatorOptions, None, "nedbus.sources.simulator.source", "SimulatorSource"),
    "ulog": SourceKind(RecordedOptions, "FILE", "nedbus.sources.ulog", "UlogSource"),
    "mcap": SourceKind(RecordedOptions, "FILE", "nedbus.sources.mcap", "McapSource", "mcap"),
    "px4-zenoh": SourceKind(Px4ZenohOptions, "[ENDPOINT]", "nedbus.sources.px4.source", "Px4ZenohSource"),
    "mavlink": SourceKind(MavlinkOptions, "LINK", "nedbus.sources.mavlink.source", "MavlinkSource", "mavlink"),
}
"""The one table of sources."""


@dataclass(frozen=True, slots=True)
class SourceSpec:
    """One source as it was configured."""

    text: str
    kind: str
    target: str
    options: Options

    def open_source(self, *, vehicle: str, routers: tuple[str, ...] = (), tls: Tls | None = None) -> Source:
        """Return the source, for a service with this default vehicle, router endpoints and TLS files.

        Raises ConfigError for an invalid target, for a file that cannot be read twice, and when the extra of this kind
        is not installed.
        """
        kind, path = SOURCE_KINDS[self.kind], Path(self.target).expanduser()
        # The reader of a pipe, a socket or a device would wait for ever, or find nothing again.
        if kind.target == "FILE" and path.exists() and not (path.is_file() or path.is_dir()):
            raise ConfigError(f"source {self.text!r}", f"{path} is not a regular file: save it as one, then give that")
        make = cast("Callable[..., Source]", getattr(needs(kind.extra, kind.module), kind.class_name))
        return make(self.target, self.options, SourceContext(vehicle, routers, tls))


def parse_source(source: str | Mapping[str, object]) -> SourceSpec:
    """Parse a text such as `ulog:flight.ulg?speed=2&vehicle=7`; in a path `%3F` stands for `?`, and `%25` for `%`.

    A mapping has the kind, the target under its name (`file`, `link` or `endpoint`) and the options instead, such as
    {"kind": "ulog", "file": "flight.ulg", "speed": 2, "vehicle": 7}: its text is made of them.

    Raises ConfigError for an unknown kind, a missing target, or an unknown or invalid option.
    """
    text = source if isinstance(source, str) else _text_of_table(source)
    kind_name, _, rest = text.partition(":")
    kind = SOURCE_KINDS.get(kind_name)
    if kind is None:
        path = rest if rest and "/" not in kind_name else text
        kind_of_file = SUFFIXES.get(PurePath(path.partition("?")[0]).suffix)
        hint = f"write {kind_of_file}:{path}" if kind_of_file else f"choose from {', '.join(SOURCE_KINDS)}"
        raise ConfigError(f"source {text!r}", f"there is no kind {kind_name!r}: {hint}")
    target, _, query = rest.rpartition("?") if "?" in rest else (rest, "", "")
    if not kind.accepts(target):
        form = f"{kind_name}:{kind.target}" if kind.target else f"{kind_name}:?OPTION=VALUE"
        raise ConfigError(f"source {text!r}", f"write it as {form}")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
        options = kind.options.model_validate(dict(pairs))
    except ValidationError as exc:
        reason, name = _explain(exc, kind)
        raise ConfigError(f"source {text!r}", reason, key=name) from exc
    except ValueError:
        hint = ", and a path with ? in it has %3F instead" if kind.target == "FILE" else ""
        raise ConfigError(f"source {text!r}", f"{query!r} is not OPTION=VALUE&OPTION=VALUE{hint}") from None
    if len(dict(pairs)) < len(pairs):
        raise ConfigError(f"source {text!r}", "an option occurs twice: remove one")
    if kind.target == "FILE":
        target = re.sub("%(3F|25)", lambda found: unquote(found[0]), target, flags=re.IGNORECASE)
    return SourceSpec(text, kind_name, target, options)


def source_text_of_file(path: str | PurePath, **options: str | None) -> str:
    """Return the text of the source that replays a file, such as `ulog:flight.ulg?vehicle=7`, with these options.

    Raises ConfigError for a file suffix that belongs to no kind.
    """
    name = format_of(path)
    return _join(name, SOURCE_KINDS[name], str(path), {key: value for key, value in options.items() if value})


def _text_of_table(table: Mapping[str, object]) -> str:
    """Return the text of a source that is given as a table; raise ConfigError for a mistake."""
    options = dict(table)
    name = options.pop("kind", None)
    kind = SOURCE_KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        problem, key = ("kind is missing", "") if name is None else (f"there is no kind {name!r}", "kind")
        raise ConfigError("source", f"{problem}: choose from {', '.join(SOURCE_KINDS)}", key=key)
    target_name = (kind.target or "").strip("[]").lower()
    target = options.pop(target_name, "")
    if not isinstance(target, str) or not kind.accepts(target):
        raise ConfigError(f"source {name!r}", f'it needs {target_name} = "..."', key=target_name)
    return _join(str(name), kind, target, {key: _text_of_value(value) for key, value in options.items()})


def _text_of_value(value: object) -> str:
    """Return an option's value as a text has it: 1 for true, NAME:VEHICLE,NAME:VEHICLE for a table."""
    if isinstance(value, Mapping):
        return ",".join(f"{name}:{each}" for name, each in value.items())
    if isinstance(value, list | tuple):
        return ",".join(map(_text_of_value, value))
    return str(int(value)) if isinstance(value, bool) else str(value)


def _join(name: str, kind: SourceKind, target: str, options: Mapping[str, str]) -> str:
    """Return the text of a source; a path has its percent and question marks escaped."""
    path = target.replace("%", "%25").replace("?", "%3F") if kind.target == "FILE" else target
    query = urlencode(options, safe=":,/")
    return f"{name}:{path}?{query}" if query else f"{name}:{path}"


def _explain(error: ValidationError, kind: SourceKind) -> tuple[str, str]:
    """Return the mistake in an option, and its name."""
    detail = error.errors()[0]
    name = str(detail["loc"][0])
    field = kind.options.model_fields.get(name)
    if field is None:
        return f"there is no option {name!r}: choose from {', '.join(kind.options.model_fields)}", name
    if isinstance(cause := detail.get("ctx", {}).get("error"), AddressError) and name == "topics":
        return str(cause), name
    return f"{name}={detail['input']} is invalid: expected {field.description}", name
