"""The examination of `nedbus doctor`: settings, certificates, endpoints, a MAVLink link, and the network."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from nedbus import Tls, connect
from nedbus.errors import ConfigError
from nedbus.extras import import_optional
from nedbus.health import probe_writes
from nedbus.pki import AccessControl, Certificate, read_router_config
from nedbus.settings import Settings
from nedbus.sources import parse_link
from nedbus.timings import TIMINGS

from .access_rules import explain_permissions
from .configuration import check_sources
from .engine import Check, run_checks
from .finding import Finding, limit_findings, sort_findings
from .network_checks import NETWORK_CHECKS
from .observation import Observation
from .prober import check_endpoint, check_tls_files

_ENDPOINTS_TIMEOUT: Final = 9.0  # s for the parallel checks before connecting to a router
_NETWORK_TIMEOUT: Final = 12.0  # s


def examine(
    settings: Settings,
    *,
    version: str,
    vehicle: str | None = None,
    mavlink: str | None = None,
    rules: Path | None = None,
) -> list[Finding]:
    """Run all checks and return their findings, the worst last; takes up to 10 s if no router answers.

    `version`: version of this nedbus. `vehicle`: check only this vehicle, and test the permission to publish it.
    `mavlink`: link to check, such as `udpin:0.0.0.0:14540`.
    `rules`: configuration of the router, to name the rules that decide about this client's certificate.

    Raises ConfigError for an invalid link, and for an invalid file of rules.
    """
    access = None
    if rules is not None:
        access = read_router_config(rules).access
    if mavlink is not None:
        parse_link(mavlink)  # raises ConfigError
    findings = list(_describe_settings(settings))
    tls_findings, tls = check_tls_files(settings)
    findings += [finding for _, finding in tls_findings]
    first_checks = _first_checks(settings, tls, mavlink)
    findings += [finding for _, finding in run_checks(first_checks, _ENDPOINTS_TIMEOUT)]
    seen = Observation(settings.prefix, version, vehicle)
    router = _answering_router(findings)
    if router is not None:
        findings = _excuse_others(findings)
        network = Check("network", "", partial(check_network, seen, router, tls))
        findings += [finding for _, finding in run_checks([network], _NETWORK_TIMEOUT)]
    if access is not None:
        findings += _explain_rules(settings, access, seen)
    return sort_findings(findings)


def _first_checks(settings: Settings, tls: Tls | None, mavlink: str | None) -> list[Check]:
    """Return the checks that need no router."""
    checks = [Check("settings", "", partial(_check_sources, settings))]
    if mavlink is not None:
        checks.append(Check("mavlink", mavlink, partial(_check_mavlink, mavlink)))
    checks += [
        Check("endpoint", endpoint, partial(check_endpoint, endpoint, tls))
        for endpoint in settings.routers
    ]
    return checks


def _check_mavlink(link: str) -> Iterator[Finding]:
    module = import_optional("mavlink", "nedbus.doctor.mavlink")
    yield from module.check_mavlink(link)


def _answering_router(findings: list[Finding]) -> str | None:
    """Return the first endpoint at which a router answers; None if there is none."""
    for finding in findings:
        if finding.check == "endpoint" and finding.state == "ok":
            return finding.subject
    return None


def _excuse_others(findings: list[Finding]) -> list[Finding]:
    """Return the findings with warnings about routers that do not answer: one router is enough to receive data."""
    return [
        replace(finding, state="warning")
        if finding.check == "endpoint" and finding.state == "wrong"
        else finding
        for finding in findings
    ]


def _describe_settings(settings: Settings) -> Iterator[Finding]:
    """Yield the routers and the other settings, each with the flag, variable or file that set it."""
    setters = dict[str, str]()
    for name in Settings.model_fields:
        setter = settings.set_by(name)
        if setter == name:
            setter = f"--{name.replace('_', '-')}"
        if setter:
            setters[name] = setter
    text = "the default"
    advice = "for a router on another host, use --connect, NEDBUS_CONNECT or nedbus.toml"
    decisive = [name for name in ("connect", "listen", "router_config") if name in setters]
    if decisive:
        text = f"set by {setters[decisive[0]]}"
        advice = ""
    routers = " or ".join(settings.routers)
    yield Finding("settings", "connect", "ok", f"{routers}, {text}", advice)
    setters.pop("connect", None)
    if setters:
        others = ", ".join(f"{name} by {setter}" for name, setter in setters.items())
        yield Finding("settings", "others", "ok", f"set: {others}")


def _explain_rules(
    settings: Settings, access: AccessControl, seen: Observation
) -> Iterator[Finding]:
    """Yield the rules that decide about this client's certificate."""
    if not access.is_enabled:
        text = "the file has no access rules: every client may write every key"
        yield Finding("rules", "", "ok", text)
        return
    certificate = settings.tls_certificate
    if certificate is None:
        advice = "use --tls-certificate and --tls-key with the files of this client"
        yield Finding("rules", "", "unknown", "this client has no certificate", advice)
        return
    try:
        name = Certificate.read(certificate).subject
    except (OSError, ValueError) as exc:  # also without the extra `pki`
        text = "name of the certificate not read"
        yield Finding("rules", str(certificate), "unknown", text, str(exc))
        return
    yield from explain_permissions(
        access, name, vehicle=seen.vehicle, prefix=seen.prefix, verdict=seen.verdict
    )


def _check_sources(settings: Settings) -> Iterator[Finding]:
    if not settings.source:
        return
    advice = "correct it and restart the service"
    for mistake in check_sources(settings, settings.routers):
        yield _finding_of(mistake, advice)


def _finding_of(mistake: ConfigError, advice: str) -> Finding:
    return Finding("settings", mistake.where, "wrong", mistake.reason, advice)


def check_network(seen: Observation, router: str, tls: Tls | None) -> Iterator[Finding]:
    """Connect to a router, observe its network, and yield the findings of `NETWORK_CHECKS`."""
    with connect(router, timeout=TIMINGS.doctor_open, prefix=seen.prefix, tls=tls) as bus:
        session = bus._session  # noqa: SLF001 - a further one might exceed the limit of the router
        vehicle = seen.vehicle
        if vehicle is not None:
            with bus.open_session(timeout=TIMINGS.doctor_open) as writer:
                verdicts = probe_writes(session, writer, [vehicle], prefix=seen.prefix)
            seen.verdict = verdicts[vehicle]
        seen.observe(bus, session)
    for check in NETWORK_CHECKS:
        yield from limit_findings(check(seen))
