"""Checks of settings and router files for `nedbus check` and `nedbus serve --check`; each mistake has its location."""

import logging
import socket
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

from nedbus.daemon import PlannedSource, plan_sources
from nedbus.endpoints import DEFAULT_ENDPOINT, check_endpoints, split_endpoint
from nedbus.errors import ConfigError, NedbusError
from nedbus.log_event import about
from nedbus.pki import RouterConfig, read_router_config
from nedbus.settings import Settings, find_mistakes, locate_setting, locate_source
from nedbus_msgs import Address

from .access_rules import find_rule_mistakes
from .finding import Finding
from .prober import check_pem_file, check_tls_files, reach_endpoint

_log = logging.getLogger(__name__)


def check_service(
    file: str | Path | None = None,
    given: Mapping[str, object] | None = None,
    *,
    offline: bool = False,
) -> list[ConfigError]:
    """Return all mistakes in the settings of a service; `file` and `given` as in `load_settings`.

    `offline`: check only the text, without access to files, certificates and endpoints.
    """
    settings, mistakes = find_mistakes(file, **(given or {}))
    endpoints = settings.connect if settings.is_client else settings.listen
    if settings.router_config is not None:
        replaced = {name for name in ("listen", "connect") if getattr(settings, name)}
        mistakes += check_router_file(settings.router_config, offline=offline, replaced=replaced)
        try:
            endpoints = endpoints or settings.router_endpoints
        except ConfigError as exc:
            mistakes.append(exc)
    mistakes += check_sources(settings, endpoints or (DEFAULT_ENDPOINT,), offline=offline)
    if offline:
        return mistakes
    found = [
        *check_tls_files(settings)[0],
        *(("connect", finding) for finding in map(reach_endpoint, settings.connect)),
        *(("listen", finding) for finding in map(_try_listen, settings.listen)),
        ("http", _try_listen(f"tcp/{settings.http}") if settings.http else None),
    ]
    return mistakes + [
        locate_setting(settings, name, reason) for name, each in found if (reason := _reason(each))
    ]


def check_router_file(
    path: Path, *, offline: bool = False, replaced: Collection[str] = frozenset()
) -> list[ConfigError]:
    """Return all mistakes in a router's configuration file; `offline`: as in `check_service`.

    `replaced`: `listen`, `connect` or both, if overridden by settings.
    """
    try:
        config = read_router_config(path)
    except ConfigError as exc:
        return [exc]
    text = path.read_text(errors="replace")
    subjects = max(0, text.find("cert_common_names"))  # names of certificates also occur before
    located = [
        (mistake.reason, text.find(f'"{mistake.certificate}"', subjects))
        for mistake in find_rule_mistakes(config.access)
    ]
    if not offline:
        found = _check_router_access(config, replaced)
        located += [(reason, text.find(value)) for value, reason in found if reason]
    return [ConfigError.in_text(path, reason, text, index) for reason, index in located]


def _check_router_access(config: RouterConfig, replaced: Collection[str]) -> list[tuple[str, str]]:
    """Return endpoints and TLS files of a router, each with its mistake, or "" if it is usable."""
    found = list[tuple[str, str]]()
    for name, endpoints, probe in (
        ("listen", config.listen, _try_listen),
        ("connect", config.connect, reach_endpoint),
    ):
        for endpoint in endpoints if name not in replaced else ():
            try:
                # the others have no HOST:PORT
                if endpoint.partition("/")[0] in {"tcp", "tls", "udp", "ws", "quic"}:
                    check_endpoints([endpoint], where=name)
                found.append((endpoint, _reason(probe(endpoint))))
            except ConfigError as exc:
                found.append((endpoint, exc.reason))
    for name, file in config.tls_files.items():
        reason = _reason(check_pem_file(name, file, "it is"))
        found.append((str(file), reason and f"{name}: {reason}"))
    return found


def check_sources(
    settings: Settings, endpoints: Iterable[str], *, offline: bool = False
) -> Iterator[ConfigError]:
    """Yield a mistake for each source that cannot be opened, or that publishes the same address as another source."""
    plan, mistakes = plan_sources(settings, tuple(endpoints))
    yield from mistakes
    publishers: dict[Address, PlannedSource] = {}
    for planned in plan:
        try:
            addresses, reason = planned.addresses(offline=offline), ""
        except (NedbusError, OSError) as exc:
            addresses, reason = (), str(exc)
        same = next((address for address in addresses if address in publishers), None)
        if same is not None and "vehicle" not in settings.left_out:
            other = publishers[same].text
            reason = (
                f"publishes {same}, as does source {other!r}: set another vehicle for one of them"
            )
        if reason:
            yield locate_source(
                settings, planned.index, ConfigError(f"source {planned.text!r}", reason)
            )
        for address in addresses:
            publishers.setdefault(address, planned)


def _try_listen(endpoint: str) -> Finding | None:
    """Return a finding if this host does not have the address; ignore the port, which a running service may use."""
    parts = split_endpoint(endpoint)
    if parts is None:  # a Unix domain socket
        return None
    _, host, _ = parts
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
    except (OSError, UnicodeError):
        return Finding("endpoint", endpoint, "wrong", f"{host} is not an address of this host")
    return None


def _reason(finding: Finding | None) -> str:
    """Return the text of a mistake, "" for none; only log an unknown state, for example if a package is missing."""
    if finding is None or finding.state == "ok":
        return ""
    subject = (
        f"{finding.subject}: " if finding.check == "endpoint" or finding.state == "unknown" else ""
    )
    text = f"{subject}{finding.seen}" + (f"; {finding.advice}" if finding.advice else "")
    if finding.state == "unknown":
        _log.warning("%s", text, extra=about("notice"))
        return ""
    return text
