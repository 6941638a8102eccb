"""What is found through a router that answers: permissions, services, vehicles, clocks, other keys."""

from __future__ import annotations

from collections.abc import Sequence

from nedbus.transport import RouterState, Tls, open_client, probe_writes

from .clocks import check_clocks
from .finding import Finding, limit_findings
from .observation import Observation, observe
from .other_keys import check_other_keys
from .permissions import check_permissions
from .services import check_services
from .vehicles import check_vehicles

_OPEN = 1.5  # s
_NEARLY_FULL = 0.8  # of the sessions that a router accepts


def check_network(
    routers: Sequence[str], tls: Tls | None, *, prefix: str, version: str, vehicle: str | None, listen: float
) -> list[Finding]:
    """Join the first of these routers, which all answer, and return what is found there."""
    with open_client(routers[:1], timeout=_OPEN, tls=tls) as session:
        verdict = None
        if vehicle is not None:
            with open_client(routers[:1], timeout=_OPEN, tls=tls) as writer:
                verdict = probe_writes(session, writer, [vehicle], prefix=prefix)[vehicle]
        seen = observe(session, prefix=prefix, listen=listen)
    groups = (
        _count(seen),
        check_permissions(seen, vehicle, verdict),
        check_services(seen, version=version),
        check_vehicles(seen, vehicle, writes_only=verdict == "allowed" and tls is not None),
        check_clocks(seen),
        check_other_keys(seen),
    )
    return [finding for group in groups for finding in limit_findings(list(group))]


def _count(seen: Observation) -> list[Finding]:
    if not seen.routers:
        return [Finding("router", "", "ok", "joined; who else is connected this client is not told")]
    return [_judge(router) for router in seen.routers]


def _judge(router: RouterState) -> Finding:
    if router.load is None:
        return Finding("router", router.zid, "ok", f"sessions that are connected: {router.sessions:,}")
    seen = f"{router.sessions:,} of {router.max_sessions:,} sessions"
    if router.load < _NEARLY_FULL:
        return Finding("router", router.zid, "ok", seen)
    advice = (
        "raise max_sessions in its configuration, and how many files it may open, or run a second router: docs/hosts.md"
    )
    return Finding("router", router.zid, "warning", seen, advice)
