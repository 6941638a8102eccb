"""The examination: all checks, in an order in which each knows what it needs, with deadlines."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

from nedbus.errors import ConfigError
from nedbus.extras import needs
from nedbus.settings import Settings
from nedbus.sources import check_link
from nedbus.transport import Tls

from .configuration import check_settings
from .endpoint import answers, check_endpoint
from .finding import Finding, sort_findings
from .network import check_network
from .observation import LISTEN
from .parallel import run_together
from .validity import check_own_files

_WAY: Final = 9.0  # s for the way to all routers, side by side
_NETWORK: Final = 12.0  # s for what is found behind one
_MAX_ROUTERS: Final = 8


def examine(
    settings: Settings, *, version: str, vehicle: str | None = None, mavlink: str | None = None, listen: float = LISTEN
) -> list[Finding]:
    """Return all that is found with these settings, the worst last; within 10 s where nothing answers.

    `version` is that of this nedbus; `vehicle` is probed for whether it may be written; `mavlink` is a link to listen
    to, such as `udpin:0.0.0.0:14550`; `listen`: for how many seconds messages and packets are awaited.

    Raises ConfigError for a link that is invalid.
    """
    if mavlink is not None:
        check_link(mavlink)
    findings = list(check_settings(settings))
    try:
        tls, broken = settings.tls, False
    except ConfigError as exc:
        findings.append(Finding("certificate", "", "wrong", exc.reason, "see docs/security.md"))
        tls, broken = None, True
    if tls is not None:
        own = list(check_own_files(tls))
        findings += own
        broken = any(each.state == "wrong" and not each.subject for each in own)
    checks = {
        "network": partial(
            _examine_routers, settings, None if broken else tls, version=version, vehicle=vehicle, listen=listen
        )
    }
    if mavlink is not None:
        checks["mavlink"] = partial(_examine_link, mavlink, listen)
    return sort_findings([*findings, *run_together(checks, _WAY + _NETWORK)])


def _examine_routers(
    settings: Settings, tls: Tls | None, *, version: str, vehicle: str | None, listen: float
) -> Sequence[Finding]:
    routers = settings.routers[:_MAX_ROUTERS]
    findings = run_together({each: partial(check_endpoint, each, tls) for each in routers}, _WAY)
    good = [endpoint for endpoint in routers if answers(endpoint, findings)]
    if not good:
        return findings
    if len(routers) > 1:  # joined is one of them: that others do not answer is no reason for silence
        findings = [_lessen(each) for each in findings]
    check = partial(check_network, good, tls, prefix=settings.prefix, version=version, vehicle=vehicle, listen=listen)
    return [*findings, *run_together({"network": check}, _NETWORK)]


def _lessen(finding: Finding) -> Finding:
    if finding.check != "endpoint" or finding.state != "wrong":
        return finding
    return Finding(finding.check, finding.subject, "warning", finding.seen, finding.advice)


def _examine_link(link: str, listen: float) -> Sequence[Finding]:
    try:
        module = needs("mavlink", "nedbus.doctor.mavlink")
    except ConfigError as exc:
        return [Finding("mavlink", link, "wrong", f"{exc.where} is missing", exc.reason)]
    found: Sequence[Finding] = module.check_mavlink(link, listen=listen)
    return found
