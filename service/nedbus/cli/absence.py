"""Why no vehicle, or not the requested one, is published: the reason of its source first, then other causes."""

from collections.abc import Collection, Iterator, Sequence
from typing import Final, NamedTuple

from nedbus import Bus, limits
from nedbus.health import ServiceStatus, SourceStatus
from nedbus_msgs.text import counted

from .output.streams import to_text

_TIMEOUT: Final = 1.0  # s for the router to list the tokens of other prefixes
_REASONS: Final = 5  # sources or prefixes in a hint; more would hide the remedy


class Absence(NamedTuple):
    """Why nothing is published, and the remedy; `is_fault`: True if a source or the prefix is known to be at fault."""

    reason: str
    is_fault: bool


def explain_absence(bus: Bus, published: Collection[str], wanted: Sequence[str] = ()) -> Absence:
    """Return why no vehicle is published, or none of the `wanted` ones; queries the services."""
    services = bus.services()
    reasons: list[str] = []
    for service in services:
        reasons += _source_reasons(service, wanted)
    if reasons:
        text = "; ".join(reasons[:_REASONS])
        hidden = len(reasons) - _REASONS
        if hidden > 0:
            text = f"{text}; and {hidden} more"
        return Absence(text, is_fault=True)
    if published:
        return Absence(f"choose one of {_names(sorted(published))}", is_fault=False)
    if services:
        advice = "see 'nedbus info' and the access rules for it and this client (docs/security.md)"
        outdated = [service.service for service in services if service.is_outdated]
        if outdated:
            advice = f"{advice}; update nedbus on the host of {_names(outdated)}, which is older"
        return Absence(f"a service answers: {advice}", is_fault=False)
    prefixes = [to_text(prefix) for prefix in bus.other_prefixes(timeout=_TIMEOUT)[:_REASONS]]
    if prefixes:
        names = " and ".join(f"{prefix}/" for prefix in prefixes)
        here = f"the prefix here is {bus.prefix}/: use --prefix {prefixes[0]}"
        return Absence(f"messages are published under {names}, but {here}", is_fault=True)
    return Absence("start a source with 'nedbus serve'", is_fault=False)


def _names(names: Sequence[str]) -> str:
    return to_text(", ".join(names[: limits.SHOWN_NAMES]))


def describe_outdated(services: Sequence[ServiceStatus]) -> list[str]:
    """Return a line for each of the first older services, whose reports are not used, and one for the others."""
    outdated = [service for service in services if service.is_outdated]
    lines: list[str] = []
    for service in outdated[: limits.SHOWN_NAMES]:
        where = f"service {to_text(service.service, 64)} on {to_text(service.host or 'an unknown host', 64)}"
        version = f"nedbus {to_text(service.version or 'of an unknown version', 20)}"
        lines.append(
            f"{where} runs {version}, whose status does not name its vehicle, and is not used: update it"
        )
    more = len(outdated) - limits.SHOWN_NAMES
    if more > 0:
        lines.append(f"{counted(more, 'more older service')}, which any vehicle can invent")
    return lines


def _source_reasons(service: ServiceStatus, wanted: Sequence[str]) -> Iterator[str]:
    where = f"of service {to_text(service.service)} on {to_text(service.host or 'an unknown host')}"
    for source in service.sources:
        reason = _source_reason(source, wanted)
        if reason:
            yield f"source {to_text(source.source)} {where} {reason}"


def _source_reason(source: SourceStatus, wanted: Sequence[str]) -> str:
    """Return the state of a source that publishes none of the wanted vehicles, "" if it works."""
    error = to_text(source.error or "unknown reason", limits.PEER_TEXT)
    if source.state == "failed":
        return f"has failed: {error}"
    if source.state == "retrying":
        return f"fails and is restarted: {error}"
    stale = [
        address for address in source.stale if not wanted or address.partition("/")[0] in wanted
    ]
    if stale:
        hint = "check that the vehicle is on and its link is up"
        return f"receives no more messages of {_names(stale)}: {hint}"
    if source.state in {"waiting", "starting"} and not source.addresses:
        return "has received no message yet: check that the vehicle sends to it"
    return ""
