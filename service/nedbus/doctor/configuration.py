"""The settings that are in force: what sets them, and what the configured sources lack."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nedbus.errors import ConfigError
from nedbus.extras import needs
from nedbus.settings import Settings
from nedbus.sources import SOURCE_KINDS, SourceSpec, parse_source

from .finding import Finding


def check_settings(settings: Settings) -> Iterator[Finding]:
    """Yield which routers are joined and why, what else is set, and what is wrong with the sources."""
    setter = _setter(settings, "connect")
    where = " or ".join(settings.routers)
    if setter:
        yield Finding("settings", "connect", "ok", f"{where}, set by {setter}")
    else:
        listens = "this configuration's own router" if settings.listen or settings.router_config else "the default"
        advice = "a router on another host is named with --connect, NEDBUS_CONNECT or in nedbus.toml"
        yield Finding("settings", "connect", "ok", f"{where}, {listens}: nothing sets connect", advice)
    others = [name for name in Settings.model_fields if name != "connect" and _setter(settings, name)]
    if others:
        told = ", ".join(f"{name} by {_setter(settings, name)}" for name in others)
        yield Finding("settings", "others", "ok", f"set: {told}")
    for source in settings.source:
        yield from _source(source)


def _setter(settings: Settings, name: str) -> str:
    """Return what sets a setting, as a person writes it; "" for a default."""
    setter = settings.set_by(name)
    return f"--{name.replace('_', '-')}" if setter == name else setter


def _source(source: str | dict[str, Any]) -> Iterator[Finding]:
    try:
        spec = parse_source(source)
    except ConfigError as exc:
        yield Finding("settings", str(source), "wrong", exc.reason, "correct it, then start the service again")
        return
    yield from _missing(spec)


def _missing(spec: SourceSpec) -> Iterator[Finding]:
    kind = SOURCE_KINDS[spec.kind]
    try:
        needs(kind.extra, kind.module)
    except ConfigError as exc:
        yield Finding(
            "settings", spec.text, "wrong", f"{exc.where} is missing: {exc.reason}", exc.reason.partition(": ")[2]
        )
    if kind.target == "FILE" and not Path(spec.target).expanduser().exists():
        yield Finding(
            "settings", spec.text, "wrong", f"there is no {spec.target}", "correct the path, or mount the file"
        )
