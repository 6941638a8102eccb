"""Checks of services by their status: version, sources that fail, wait, lost their vehicle, or reject messages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from nedbus.client import ServiceStatus, SourceStatus

from .finding import Finding, brief, list_names
from .observation import Observation

_MAX_ERROR_LENGTH: Final = 300


def check_services(seen: Observation) -> Iterator[Finding]:
    """Yield the findings on the version and the sources of each service."""
    for service in (each.status for each in seen.services):
        name = f"service {brief(service.service)}"
        theirs = brief(service.version or "unknown")
        if theirs.split(".")[:2] != seen.version.split(".")[:2]:
            advice = "install the same version on both sides; docs and CHANGELOG say what changed on the wire"
            yield Finding("version", name, "warning", f"it is nedbus {theirs}, this is {seen.version}", advice)
        findings = [finding for source in service.sources for finding in _check_source(source)]
        yield from findings
        if all(finding.state == "ok" for finding in findings):
            host = brief(service.host or "an unknown host")
            yield Finding(
                "service", name, "ok", f"nedbus {theirs} on {host}, its sources have no fault: {len(service.sources)}"
            )
    if not seen.services:
        advice = "'nedbus serve' is one; a script that publishes by itself is none"
        yield Finding("service", "", "unknown", "no nedbus service answers", advice)


def reported(service: ServiceStatus) -> Iterator[str]:
    """Yield the addresses that a service says it publishes."""
    for source in service.sources:
        yield from map(brief, source.addresses)


def has_source(seen: Observation, kind: str) -> bool:
    """Return whether any service has a source of this kind."""
    return any(source.source.startswith(f"{kind}:") for each in seen.services for source in each.status.sources)


def _check_source(source: SourceStatus) -> Iterator[Finding]:
    name, state = brief(source.source), source.state
    error = (source.error or "it does not say why")[:_MAX_ERROR_LENGTH]
    if state in {"failed", "retrying"}:
        ends = "it has ended" if state == "failed" else "it is tried again"
        yield Finding("source", name, "wrong", f"{state}: {error}", f"{ends}; the log of its service says more")
    elif state in {"waiting", "starting"}:
        advice = "is its vehicle on, does it send here? for MAVLink see 'nedbus doctor --mavlink LINK' on its host"
        yield Finding("source", name, "warning", f"{state}: nothing has arrived yet", advice)
    if source.silent:
        advice = "if the vehicle has them, its PX4 loses them: no line of its zenoh/pub.csv may have rel=: docs/live.md"
        seen = f"announced, and nothing arrives while other topics do: {list_names(source.silent, 20)}"
        yield Finding("source", name, "warning", seen, advice)
    if source.not_carried:
        advice = "to carry them, give PX4's definitions: px4-zenoh:?msg=NAME.msg, or a folder of them"
        seen = f"vehicles publish messages that it does not carry: {list_names(source.not_carried, 20)}"
        yield Finding("source", name, "ok", seen, advice)
    if stale := [address for address in source.stale if address not in source.silent]:
        advice = "is the vehicle on, is its link up? they come back by themselves"
        seen = f"nothing arrives any more of {list_names(stale)}"
        yield Finding("source", name, "warning", seen, advice)
    if source.rejected > 0:
        why = f": {list_names(source.rejections)}" if source.rejections else ""
        advice = "'nedbus echo' shows nothing of these; reasons are in the log of the service and on @rejected keys"
        yield Finding("source", name, "warning", f"{source.rejected} messages were rejected{why}", advice)
