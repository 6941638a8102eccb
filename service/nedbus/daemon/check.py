"""All that is wrong with settings, found before a service starts: values, sources, files, endpoints."""

from __future__ import annotations

import datetime as dt
import logging
import os
import socket
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from nedbus.errors import ConfigError, NedbusError
from nedbus.log_event import about
from nedbus.pki import Certificate
from nedbus.settings import Settings, find_mistakes, locate_setting, locate_source, place_at
from nedbus.sources import SOURCE_KINDS, LiveSource, parse_source
from nedbus.transport import Tls, check_pem, read_router_config, router_endpoints
from nedbus_msgs import DEFAULT_TOPIC, Address

from .plan import Planned, plan_sources

_log = logging.getLogger(__name__)

_PATIENCE: Final = 2.0  # s for an endpoint to answer
_STREAMS: Final = frozenset({"tcp", "tls", "ws"})  # protocols whose endpoints can be tried by connecting
_TLS_FILES: Final = {"tls_ca": "CERTIFICATE", "tls_certificate": "CERTIFICATE", "tls_key": "PRIVATE KEY"}


def check_service(
    file: str | Path | None = None, given: Mapping[str, object] | None = None, *, offline: bool = False
) -> list[ConfigError]:
    """Return all mistakes in the settings of a service, as `load_settings` would read them with what is given.

    `offline`: only the text counts, and not what this host has: files, certificates, endpoints.
    """
    settings, mistakes = find_mistakes(file, **(given or {}))
    return [*mistakes, *_check_settings(settings, offline=offline)]


def check_router_file(
    path: Path, *, offline: bool = False, replaced: Collection[str] = frozenset()
) -> list[ConfigError]:
    """Return all mistakes in a router's configuration file; `offline` as in `check_service`.

    `replaced`: of `listen` and `connect` what is given elsewhere, in place of what the file says.
    """
    try:
        config = read_router_config(path)
    except ConfigError as exc:
        return [exc]
    if offline:
        return []
    text = path.read_text(errors="replace")
    found = [
        *_try_listen(config.listen if "listen" not in replaced else ()),
        *_try_connect(config.connect if "connect" not in replaced else ()),
    ]
    for name, file in config.tls_files.items():
        if not os.access(file, os.R_OK):
            found.append((str(file), f"{name}: {file} cannot be read: does it exist, and may this user read it?"))
        elif name.endswith("_certificate") and (reason := _judge_certificate(file)):
            found.append((str(file), f"{name}: {reason}"))
    places = [place_at(text, text.find(value)) for value, _ in found]
    return [
        ConfigError.in_file(path, reason, line=line, column=column)
        for (_, reason), (line, column) in zip(found, places, strict=True)
    ]


def _check_settings(settings: Settings, *, offline: bool) -> Iterator[ConfigError]:
    endpoints = settings.connect if settings.is_client else settings.listen
    if settings.router_config is not None:
        replaced = {name for name in ("listen", "connect") if getattr(settings, name)}
        yield from check_router_file(settings.router_config, offline=offline, replaced=replaced)
        try:
            of_file = router_endpoints((), settings.router_config)
        except ConfigError as exc:
            yield exc
        else:
            endpoints = endpoints or of_file
    plan, mistakes = plan_sources(settings, endpoints or router_endpoints())
    yield from mistakes
    yield from _check_sources(settings, plan, offline=offline)
    if offline:
        return
    yield from _check_tls(settings)
    for name, tried in (
        ("connect", _try_connect(settings.connect)),
        ("listen", _try_listen(settings.listen)),
        ("http", _try_listen((f"http/{settings.http}",) if settings.http else ())),
    ):
        for _, reason in tried:
            yield locate_setting(settings, name, reason)


def _check_sources(settings: Settings, plan: Iterable[Planned], *, offline: bool) -> Iterator[ConfigError]:
    """Yield each source that cannot be opened, or publishes what another one does."""
    publishers: dict[Address, Planned] = {}
    for planned in plan:
        where = f"source {planned.text!r}"
        try:
            addresses = _addresses(planned, offline=offline)
        except (NedbusError, OSError) as exc:
            yield locate_source(settings, planned.index, ConfigError(where, str(exc)))
            continue
        same = next((address for address in addresses if address in publishers), None)
        if same is not None and "vehicle" not in settings.left_out:
            reason = (
                f"it publishes {same}, as source {publishers[same].text!r} does: give one of the two another vehicle"
            )
            yield locate_source(settings, planned.index, ConfigError(where, reason))
        for address in addresses:
            publishers.setdefault(address, planned)


def _addresses(planned: Planned, *, offline: bool) -> Collection[Address]:
    """Return what a source publishes: what is in a replay, or the vehicles that a live source names."""
    spec = parse_source(planned.text)
    if isinstance(planned.source, LiveSource):
        named = {getattr(spec.options, "vehicle", None), *getattr(spec.options, "vehicles", {}).values()}
        return [Address(vehicle, DEFAULT_TOPIC) for vehicle in named if vehicle is not None]
    if offline and SOURCE_KINDS[spec.kind].target == "FILE":
        return ()
    run = planned.source.open()
    with closing(run.messages):  # type: ignore[type-var] # each is a generator
        return run.addresses


def _judge_certificate(path: str | Path) -> str | None:
    """Return what is wrong with a certificate: it has expired, or is to be renewed; None if nothing is."""
    now = dt.datetime.now(dt.UTC)
    try:
        certificate = Certificate.read(path)
    except ConfigError as exc:  # what is not installed is no mistake in the settings
        _log.warning("%s is not checked for when it expires: %s", path, exc, extra=about("notice"))
        return None
    except (ValueError, OSError) as exc:
        return f"{path} cannot be read as a certificate: {exc}"
    if not certificate.is_due(now):
        return None
    days = certificate.days_left(now)
    when = "has expired" if days < 0 else f"expires in {days:.0f} days"
    return f"{path} {when} ({certificate.ends:%Y-%m-%d}): 'nedbus pki renew' makes a new one"


def _check_tls(settings: Settings) -> Iterator[ConfigError]:
    """Yield what is wrong with each file, and with all of them together if none is."""
    is_whole = not settings.left_out & _TLS_FILES.keys()
    for name, kind in _TLS_FILES.items():
        path = getattr(settings, name)
        if path is None:
            continue
        try:
            check_pem(path, kind)
        except ConfigError as exc:
            is_whole = False
            yield locate_setting(settings, name, exc.reason)
        else:
            if kind == "CERTIFICATE" and (reason := _judge_certificate(path)):
                yield locate_setting(settings, name, reason)
    if settings.tls_ca is None or not is_whole or (settings.tls_certificate is None) != (settings.tls_key is None):
        return
    tls = Tls(settings.tls_ca, settings.tls_certificate, settings.tls_key)
    try:
        tls.zenoh_settings()
    except ConfigError as exc:
        yield locate_setting(settings, "tls_key", exc.reason)
        return
    if reason := tls.explain():
        yield locate_setting(settings, "tls_certificate" if tls.certificate else "tls_ca", reason)


def _try_connect(endpoints: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield each endpoint that does not answer, and why; those of UDP and QUIC only by name."""
    for endpoint in endpoints:
        try:
            protocol, host, port = _split(endpoint)
            if protocol in _STREAMS:
                socket.create_connection((host, port), _PATIENCE).close()
            elif host:
                socket.getaddrinfo(host, port)
        except (socket.gaierror, UnicodeError):  # the latter for a name with an empty part, such as a..b
            yield endpoint, f"{endpoint}: this host finds no address of {host}"
        except OSError as exc:
            yield endpoint, f"{endpoint}: nothing answers ({(exc.strerror or str(exc)).lower()})"
        except ValueError as exc:
            yield endpoint, f"{endpoint} is not an endpoint: {str(exc).lower()}"


def _try_listen(endpoints: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield each endpoint whose address is none of this host; a port may be taken by what is to be replaced."""
    for endpoint in endpoints:
        try:
            _, host, _ = _split(endpoint)
            if host:
                with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
                    probe.bind((host, 0))
        except UnicodeError:
            yield endpoint, f"{endpoint}: {host} is no address of this host"
        except OSError as exc:
            yield endpoint, f"{endpoint}: {host} is no address of this host ({(exc.strerror or str(exc)).lower()})"
        except ValueError as exc:
            yield endpoint, f"{endpoint} is not an endpoint: {str(exc).lower()}"


def _split(endpoint: str) -> tuple[str, str, int]:
    """Return protocol, host and port; no host for a socket file. Raises ValueError for what is no endpoint."""
    protocol, _, rest = endpoint.partition("/")
    if protocol == "unixsock-stream":
        return protocol, "", 0
    parts = urlsplit(f"//{rest.partition('#')[0].partition('?')[0]}")
    return protocol, parts.hostname or "", parts.port or 0


def describe_mistakes(mistakes: Iterable[NedbusError]) -> list[str]:
    """Return a line for each mistake, each once."""
    return list(dict.fromkeys(map(str, mistakes)))
