"""Checks of services by their status: version, sources that fail, wait, lost their vehicle, or reject messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from .finding import Finding, brief, list_names
from .observation import Observation, Service

_MAX_ERROR_LENGTH: Final = 300


def check_services(seen: Observation) -> Iterator[Finding]:
    """Yield the findings on the version and the sources of each service."""
    for service in seen.services:
        name = f"service {brief(service.text('service'))}"
        theirs = brief(service.text("version") or "unknown")
        if theirs.split(".")[:2] != seen.version.split(".")[:2]:
            advice = "install the same version on both sides; docs and CHANGELOG say what changed on the wire"
            yield Finding("version", name, "warning", f"it is nedbus {theirs}, this is {seen.version}", advice)
        findings = [finding for source in service.sources for finding in _check_source(source)]
        yield from findings
        if all(finding.state == "ok" for finding in findings):
            host = brief(service.text("host") or "an unknown host")
            text = f"nedbus {theirs} on {host}, its sources have no fault: {len(service.sources)}"
            yield Finding("service", name, "ok", text)
    if not seen.services:
        advice = "'nedbus serve' is one; a script that publishes by itself is none"
        yield Finding("service", "", "unknown", "no nedbus service answers", advice)


def reported(service: Service) -> Iterator[str]:
    """Yield the addresses that a service says it publishes."""
    for source in service.sources:
        yield from map(brief, _list(source, "addresses"))


def has_source(seen: Observation, kind: str) -> bool:
    """Return whether any service has a source of this kind."""
    sources = [source for service in seen.services for source in service.sources]
    return any(str(source.get("source")).startswith(f"{kind}:") for source in sources)


def _check_source(source: Mapping[str, object]) -> Iterator[Finding]:
    name, state = brief(source.get("source")), str(source.get("state"))
    error = str(source.get("error") or "it does not say why")[:_MAX_ERROR_LENGTH]
    if state in {"failed", "retrying"}:
        ends = "it has ended" if state == "failed" else "it is tried again"
        yield Finding("source", name, "wrong", f"{state}: {error}", f"{ends}; the log of its service says more")
    elif state in {"waiting", "starting"}:
        advice = "is its vehicle on, does it send here? for MAVLink see 'nedbus doctor --mavlink LINK' on its host"
        yield Finding("source", name, "warning", f"{state}: nothing has arrived yet", advice)
    stale, silent, not_carried = (_list(source, field) for field in ("stale", "silent", "not_carried"))
    if silent:
        advice = "if the vehicle has them, its PX4 loses them: no line of its zenoh/pub.csv may have rel=: docs/live.md"
        seen = f"announced, and nothing arrives while other topics do: {list_names(silent, 20)}"
        yield Finding("source", name, "warning", seen, advice)
    if not_carried:
        advice = "to carry them, give PX4's definitions: px4-zenoh:?msg=NAME.msg, or a folder of them"
        seen = f"vehicles publish messages that it does not carry: {list_names(not_carried, 20)}"
        yield Finding("source", name, "ok", seen, advice)
    if stale := [address for address in stale if address not in silent]:
        advice = "is the vehicle on, is its link up? they come back by themselves"
        seen = f"nothing arrives any more of {list_names(stale)}"
        yield Finding("source", name, "warning", seen, advice)
    rejected, rules = source.get("rejected"), source.get("rejections")
    if isinstance(rejected, int) and rejected > 0:
        why = f": {list_names(rules)}" if isinstance(rules, dict) and rules else ""
        advice = "'nedbus echo' shows nothing of these; reasons are in the log of the service and on @rejected keys"
        yield Finding("source", name, "warning", f"{rejected} messages were rejected{why}", advice)


def _list(source: Mapping[str, object], name: str) -> list[object]:
    value = source.get(name)
    return value if isinstance(value, list) else []
