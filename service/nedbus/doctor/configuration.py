"""Checks of settings and router files for `nedbus check` and `nedbus serve --check`; each mistake has its location."""

import logging
import socket
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from nedbus.daemon import PlannedSource, plan_sources
from nedbus.endpoints import DEFAULT_ENDPOINT, check_endpoints, split_endpoint
from nedbus.errors import ConfigError, NedbusError
from nedbus.log_event import about
from nedbus.pki import RouterConfig, read_router_config
from nedbus.settings import Settings, find_mistakes, locate_setting, locate_source
from nedbus_msgs import Address

from .access_rules import find_rule_mistakes
from .engine import Check, run_checks
from .finding import Finding
from .prober import check_pem_file, check_tls_files, reach_endpoint

_log = logging.getLogger(__name__)

_TIMEOUT: Final = 9.0  # s for the parallel checks of endpoints and files
_WITH_PORT: Final = {"tcp", "tls", "udp", "ws", "quic"}
"""Protocols whose endpoints are HOST:PORT."""


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
    if settings.is_client:
        endpoints = settings.connect
    else:
        endpoints = settings.listen
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
    tls_findings, _ = check_tls_files(settings)
    findings = list(tls_findings)
    for check, finding in run_checks(_checks_of_endpoints(settings), _TIMEOUT):
        findings.append((check.place, finding))
    for name, finding in findings:
        reason = _reason(finding)
        if reason:
            mistakes.append(locate_setting(settings, name, reason))
    return mistakes


def _checks_of_endpoints(settings: Settings) -> list[Check]:
    """Return a check for each endpoint in the settings of a service."""
    checks = [_check_of("connect", endpoint, reach_endpoint) for endpoint in settings.connect]
    checks += [_check_of("listen", endpoint, _try_listen) for endpoint in settings.listen]
    if settings.http:
        checks.append(_check_of("http", f"tcp/{settings.http}", _try_listen))
    return checks


def _check_of(place: str, endpoint: str, probe: Callable[[str], Finding | None]) -> Check:
    """Return the check of an endpoint with a probe, which finds at most one mistake."""

    def run() -> Iterator[Finding]:
        finding = probe(endpoint)
        if finding is not None:
            yield finding

    return Check("endpoint", endpoint, run, place)


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
    mistakes = list[ConfigError]()
    for mistake in find_rule_mistakes(config.access):
        place = text.find(f'"{mistake.certificate}"', subjects)
        mistakes.append(ConfigError.in_text(path, mistake.reason, text, place))
    if offline:
        return mistakes
    for check, finding in run_checks(_checks_of_router(config, replaced), _TIMEOUT):
        reason = _reason(finding)
        if check.name in config.tls_files and reason:
            reason = f"{check.name}: {reason}"
        if reason:
            mistakes.append(ConfigError.in_text(path, reason, text, text.find(check.place)))
    return mistakes


def _checks_of_router(config: RouterConfig, replaced: Collection[str]) -> list[Check]:
    """Return a check for each endpoint and TLS file of a router; its place is that text in the file."""
    checks = list[Check]()
    if "listen" not in replaced:
        checks += _checks_of_texts("listen", config.listen, _try_listen)
    if "connect" not in replaced:
        checks += _checks_of_texts("connect", config.connect, reach_endpoint)
    for name, file in config.tls_files.items():
        checks.append(Check(name, str(file), partial(_check_file, name, file), str(file)))
    return checks


def _checks_of_texts(
    name: str, endpoints: Sequence[str], probe: Callable[[str], Finding | None]
) -> Iterator[Check]:
    """Yield the checks of endpoints in a router's file, which Zenoh accepts with any text."""

    def check_text(endpoint: str) -> Finding | None:
        protocol, _, _ = endpoint.partition("/")
        try:
            if protocol in _WITH_PORT:
                check_endpoints([endpoint], where=name)
        except ConfigError as exc:
            return Finding(name, endpoint, "wrong", exc.reason)
        return probe(endpoint)

    for endpoint in endpoints:
        yield _check_of(endpoint, endpoint, check_text)


def _check_file(name: str, file: Path) -> Iterator[Finding]:
    finding = check_pem_file(name, file, "it is")
    if finding is not None:
        yield finding


def check_sources(
    settings: Settings, endpoints: Iterable[str], *, offline: bool = False
) -> Iterator[ConfigError]:
    """Yield a mistake for each source that cannot be opened, or that publishes the same address as another source."""
    plan, mistakes = plan_sources(settings, tuple(endpoints))
    yield from mistakes
    publishers: dict[Address, PlannedSource] = {}
    for planned in plan:
        try:
            addresses = tuple(planned.addresses(offline=offline))
            reason = ""
        except (NedbusError, OSError) as exc:
            addresses = ()
            reason = str(exc)
        taken = [address for address in addresses if address in publishers]
        if taken and "vehicle" not in settings.left_out:
            other = publishers[taken[0]].text
            reason = f"publishes {taken[0]}, as does source {other!r}: set another vehicle for one of them"
        if reason:
            error = ConfigError(f"source {planned.text!r}", reason)
            yield locate_source(settings, planned.index, error)
        for address in addresses:
            publishers.setdefault(address, planned)


def _try_listen(endpoint: str) -> Finding | None:
    """Return a finding if this host does not have the address; ignore the port, which a running service may use."""
    parts = split_endpoint(endpoint)
    if parts is None:  # a Unix domain socket
        return None
    _, host, _ = parts
    if ":" in host:
        family = socket.AF_INET6
    else:
        family = socket.AF_INET
    try:
        with socket.socket(family) as probe:
            probe.bind((host, 0))
    except (OSError, UnicodeError):
        return Finding("endpoint", endpoint, "wrong", f"{host} is not an address of this host")
    return None


def _reason(finding: Finding) -> str:
    """Return the text of a mistake, "" for none; only log an unknown state, for example if a package is missing."""
    if finding.state == "ok":
        return ""
    text = finding.seen
    if finding.check == "endpoint" or finding.state == "unknown":
        text = f"{finding.subject}: {text}"
    if finding.advice:
        text = f"{text}; {finding.advice}"
    if finding.state == "unknown":
        _log.warning("%s", text, extra=about("notice"))
        return ""
    return text
