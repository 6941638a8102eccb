"""All that is wrong with settings, found before a service starts: values, sources, files, endpoints."""

from __future__ import annotations

import datetime as dt
import os
import socket
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from nedbus.errors import ConfigError, NedbusError, SourceError
from nedbus.settings import Settings, find_mistakes, locate_setting, locate_source
from nedbus.sources import LiveSource
from nedbus.transport import Certificate, read_router_config

from .plan import plan_sources

_PATIENCE: Final = 2.0  # s for an endpoint to answer
_SOON: Final = 30.0  # days before its end that a certificate should be renewed
_STREAMS: Final = frozenset({"tcp", "tls", "ws"})  # protocols whose endpoints can be tried by connecting


def check_service(
    file: str | Path | None = None, given: Mapping[str, object] | None = None, *, offline: bool = False
) -> list[ConfigError]:
    """Return all mistakes in the settings of a service, as `load_settings` would read them with what is given.

    `offline`: only the text counts, and not what this host has: files, certificates, endpoints.
    """
    settings, mistakes = find_mistakes(file, **(given or {}))
    return mistakes if settings is None else list(_check_settings(settings, offline=offline))


def check_router_file(path: Path, *, offline: bool = False) -> list[ConfigError]:
    """Return all mistakes in a router's configuration file; `offline` as in `check_service`."""
    try:
        config = read_router_config(path)
    except ConfigError as exc:
        return [exc]
    if offline:
        return []
    text = path.read_text(errors="replace")
    found = [*_try_listen(config.listen), *_try_connect(config.connect)]
    for name, file in config.tls_files.items():
        if not os.access(file, os.R_OK):
            found.append((str(file), f"{name}: {file} cannot be read: does it exist, and may this user read it?"))
        elif name.endswith("_certificate") and (reason := _judge_certificate(file)):
            found.append((str(file), f"{name}: {reason}"))
    return [ConfigError.in_file(path, reason, **_place(text, endpoint)) for endpoint, reason in found]


def _check_settings(settings: Settings, *, offline: bool) -> Iterator[ConfigError]:
    endpoints: tuple[str, ...] = settings.connect
    if not settings.is_client:
        try:
            endpoints = settings.router_endpoints
        except ConfigError as exc:
            yield exc
    plan, mistakes = plan_sources(settings, endpoints)
    yield from mistakes
    if offline:
        return
    yield from _check_tls(settings)
    for planned in plan:
        if isinstance(planned.source, LiveSource):
            continue
        try:
            with closing(planned.source.open().messages):  # type: ignore[type-var] # each is a generator
                pass
        except (SourceError, OSError) as exc:
            yield locate_source(settings, planned.index, ConfigError(f"source {planned.text!r}", str(exc)))
    for name, tried in (("connect", _try_connect(settings.connect)), ("listen", _try_listen(settings.listen))):
        for _, reason in tried:
            yield locate_setting(settings, name, reason)


def _judge_certificate(path: str | Path) -> str | None:
    """Return what is wrong with a certificate: it has expired, or will within 30 days; None if nothing is."""
    try:
        certificate = Certificate.read(path)
    except (ValueError, OSError) as exc:
        return f"{path} cannot be read as a certificate: {exc}"
    days = certificate.days_left(dt.datetime.now(dt.UTC))
    if days > _SOON:
        return None
    when = "has expired" if days < 0 else f"expires in {days:.0f} days"
    return f"{path} {when} ({certificate.ends:%Y-%m-%d}): 'nedbus pki renew' makes a new one"


def _check_tls(settings: Settings) -> Iterator[ConfigError]:
    try:
        tls = settings.tls
        if tls is not None:
            tls.zenoh_settings()
            if reason := tls.explain():
                yield locate_setting(settings, "tls_certificate", reason)
            for name, path in (("tls_ca", tls.ca), ("tls_certificate", tls.certificate)):
                if path is not None and (reason := _judge_certificate(path)):
                    yield locate_setting(settings, name, reason)
    except ConfigError as exc:
        yield locate_setting(settings, "tls_ca", exc.reason)


def _try_connect(endpoints: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield each endpoint that does not answer, and why; those of UDP and QUIC only by name."""
    for endpoint in endpoints:
        protocol, host, port = _split(endpoint)
        try:
            if protocol in _STREAMS:
                socket.create_connection((host, port), _PATIENCE).close()
            elif host:
                socket.getaddrinfo(host, port)
        except socket.gaierror:
            yield endpoint, f"{endpoint}: this host finds no address of {host}"
        except OSError as exc:
            yield endpoint, f"{endpoint}: nothing answers ({(exc.strerror or str(exc)).lower()})"


def _try_listen(endpoints: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield each endpoint whose address is none of this host; a port may be taken by what is to be replaced."""
    for endpoint in endpoints:
        _, host, _ = _split(endpoint)
        if not host:
            continue
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            with socket.socket(family) as probe:
                probe.bind((host, 0))
        except OSError as exc:
            yield endpoint, f"{endpoint}: {host} is no address of this host ({(exc.strerror or str(exc)).lower()})"


def _split(endpoint: str) -> tuple[str, str, int]:
    """Return protocol, host and port; no host for a socket file."""
    protocol, _, rest = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return protocol, "", 0
    parts = urlsplit(f"//{rest.partition('#')[0].partition('?')[0]}")
    return protocol, parts.hostname or "", parts.port or 0


def _place(text: str, value: str) -> dict[str, int]:
    start = text.find(value)
    if start < 0:
        return {}
    return {"line": text.count("\n", 0, start) + 1, "column": start - text.rfind("\n", 0, start)}


def describe_mistakes(mistakes: Iterable[NedbusError]) -> list[str]:
    """Return a line for each mistake, each once."""
    return list(dict.fromkeys(map(str, mistakes)))
