"""Run all checks, each with a timeout."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from nedbus import Tls, connect
from nedbus.errors import NedbusError
from nedbus.extras import import_optional
from nedbus.health import probe_writes
from nedbus.log_event import about
from nedbus.pki import AccessControl, Certificate, read_router_config
from nedbus.settings import Settings
from nedbus.sources import parse_link
from nedbus.timings import TIMINGS

from .access_rules import explain_permissions
from .configuration import check_sources
from .finding import Finding, limit_findings, sort_findings
from .network_checks import NETWORK_CHECKS
from .observation import Observation
from .prober import check_endpoint, check_tls_files

_log = logging.getLogger(__name__)

Check = Callable[[], Iterable[Finding]]
_ENDPOINTS_TIMEOUT: Final = 9.0  # s for the parallel checks before connecting to a router
_NETWORK_TIMEOUT: Final = 12.0  # s
_MAX_ROUTERS: Final = 8


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
    access = None if rules is None else read_router_config(rules).access
    tls_findings, tls = check_tls_files(settings)
    findings = [*_describe_settings(settings), *(finding for _, finding in tls_findings)]
    checks: dict[tuple[str, str], Check] = {("settings", ""): partial(_check_sources, settings)}
    if mavlink is not None:
        parse_link(mavlink)
        checks["mavlink", mavlink] = lambda: import_optional(
            "mavlink", "nedbus.doctor.mavlink"
        ).check_mavlink(mavlink)
    for endpoint in settings.routers[:_MAX_ROUTERS]:
        checks["endpoint", endpoint] = partial(check_endpoint, endpoint, tls)
    findings += _run_together(checks, _ENDPOINTS_TIMEOUT)
    answering = [
        each.subject for each in findings if (each.check, each.state) == ("endpoint", "ok")
    ]
    seen = Observation(settings.prefix, version, vehicle)
    if answering:
        # one router is enough, so the others do not explain missing data
        for index, each in enumerate(findings):
            if each.check == "endpoint" and each.state == "wrong":
                findings[index] = replace(each, state="warning")
        checks = {("network", ""): partial(check_network, seen, answering[0], tls)}
        findings += _run_together(checks, _NETWORK_TIMEOUT)
    if access is not None:
        findings += _explain_rules(settings, access, seen)
    return sort_findings(findings)


def _describe_settings(settings: Settings) -> Iterator[Finding]:
    """Yield the routers and the other settings, each with the flag, variable or file that set it."""
    setters = {name: setter for name in Settings.model_fields if (setter := settings.set_by(name))}
    setters = {
        name: f"--{name.replace('_', '-')}" if setter == name else setter
        for name, setter in setters.items()
    }
    setter = next(
        (setters[name] for name in ("connect", "listen", "router_config") if name in setters), ""
    )
    text = f"set by {setter}" if setter else "the default"
    advice = (
        ""
        if setter
        else "for a router on another host, use --connect, NEDBUS_CONNECT or nedbus.toml"
    )
    yield Finding("settings", "connect", "ok", f"{' or '.join(settings.routers)}, {text}", advice)
    if others := ", ".join(
        f"{name} by {setter}" for name, setter in setters.items() if name != "connect"
    ):
        yield Finding("settings", "others", "ok", f"set: {others}")


def _explain_rules(
    settings: Settings, access: AccessControl, seen: Observation
) -> Iterator[Finding]:
    """Yield the rules that decide about this client's certificate."""
    if not access.is_enabled:
        yield Finding(
            "rules", "", "ok", "the file has no access rules: every client may write every key"
        )
        return
    if settings.tls_certificate is None:
        advice = "use --tls-certificate and --tls-key with the files of this client"
        yield Finding("rules", "", "unknown", "this client has no certificate", advice)
        return
    try:
        name = Certificate.read(settings.tls_certificate).subject
    except (OSError, ValueError) as exc:  # also without the extra `pki`
        yield Finding(
            "rules",
            str(settings.tls_certificate),
            "unknown",
            "name of the certificate not read",
            str(exc),
        )
        return
    yield from explain_permissions(
        access, name, vehicle=seen.vehicle, prefix=seen.prefix, verdict=seen.verdict
    )


def _check_sources(settings: Settings) -> Iterator[Finding]:
    for mistake in check_sources(settings, settings.routers) if settings.source else ():
        yield Finding(
            "settings", mistake.where, "wrong", mistake.reason, "correct it and restart the service"
        )


def check_network(seen: Observation, router: str, tls: Tls | None) -> Iterator[Finding]:
    """Connect to a router, observe its network, and yield the findings of `NETWORK_CHECKS`."""
    with connect(router, timeout=TIMINGS.doctor_open, prefix=seen.prefix, tls=tls) as bus:
        session = bus._session  # noqa: SLF001 - a further one might exceed the limit of the router
        if seen.vehicle is not None:
            with bus.open_session(timeout=TIMINGS.doctor_open) as writer:
                seen.verdict = probe_writes(session, writer, [seen.vehicle], prefix=seen.prefix)[
                    seen.vehicle
                ]
        seen.observe(bus, session)
    for check in NETWORK_CHECKS:
        yield from limit_findings(check(seen))


def _run_together(checks: Mapping[tuple[str, str], Check], seconds: float) -> list[Finding]:
    """Run checks, given by name and subject, in parallel threads; return findings in the order of the checks.

    A check that fails or exceeds `seconds` results in a finding; the check's own timeouts then end its thread.
    """
    found: dict[tuple[str, str], list[Finding]] = {}

    def run(name: tuple[str, str], check: Check) -> None:
        try:
            found[name] = list(check())
        except (NedbusError, OSError) as exc:
            found[name] = [Finding(*name, "wrong", f"check failed: {exc}")]
        except BaseException as exc:  # noqa: BLE001 - includes Zenoh's panics
            _log.exception(
                "unexpected error in check %s",
                " ".join(filter(None, name)),
                extra=about("internal_error"),
            )
            seen = f"check failed: unexpected {type(exc).__name__}: {exc}"
            found[name] = [
                Finding(
                    *name, "unknown", seen, "a bug in nedbus: report it with the traceback above"
                )
            ]

    threads = [
        threading.Thread(target=run, args=each, name=f"nedbus-{each[0][0]}", daemon=True)
        for each in checks.items()
    ]
    end = time.monotonic() + seconds
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
    late = f"no result within {seconds:g} s"
    advice = "try again; if this persists, a DNS server may not be answering"
    for name in checks:
        found.setdefault(
            name, [Finding(*name, "wrong" if name[0] == "endpoint" else "unknown", late, advice)]
        )
    return [each for name in checks for each in found[name]]
