"""What this client may do at a router with access rules: read, and write a vehicle."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from nedbus.transport import Verdict

from .finding import Finding, State, list_names
from .observation import Observation
from .services import reported

_RULES = "see access_control in the router's file (config/router-secure.json5), and docs/security.md"
_DENIED: Final[dict[State, State]] = {"ok": "ok", "unknown": "warning"}
"""How bad it is that a vehicle may not be written, by the state of reading: no fault of a reader."""


def check_permissions(seen: Observation, vehicle: str | None, verdict: Verdict | None) -> Iterator[Finding]:
    """Yield whether this client may read, by what it gets, and may write a vehicle, by what a probe showed."""
    reading = _reading(seen, verdict)
    yield reading
    if vehicle is None or verdict is None:
        advice = "with --vehicle it is: 'nedbus doctor --vehicle 1'"
        yield Finding("write", "", "unknown", "whether a vehicle may be written is not probed", advice)
    elif verdict == "allowed":
        yield Finding("write", vehicle, "ok", f"this client may publish vehicle {vehicle}: a probe came back")
    elif verdict == "denied":
        seen_text = f"the router drops what this client publishes as vehicle {vehicle}, without an error"
        advice = f"a reader needs no more; to publish, use the certificate of that vehicle; {_RULES}"
        yield Finding("write", vehicle, _DENIED.get(reading.state, "wrong"), seen_text, advice)
    else:
        seen_text = f"cannot be told: the router does not let this client read a probe of vehicle {vehicle}"
        advice = f"allow {seen.prefix}/*/@doctor/* as config/router-secure.json5 does, or look from a reader"
        yield Finding("write", vehicle, "unknown", seen_text, advice)


def _reading(seen: Observation, verdict: Verdict | None) -> Finding:
    if any(stream.address is not None for stream in seen.streams.values()) or seen.ages:
        return Finding("read", "", "ok", "this client may read: messages arrive")
    published = sorted({address for service in seen.services for address in reported(service.status)})
    if not published:
        return Finding("read", "", "unknown", "whether this client may read cannot be told: nothing is published")
    seen_text = f"services say that they publish {list_names(published)}, and nothing of it arrives here"
    if verdict == "allowed":
        advice = "a vehicle's certificate is for writing: look with that of a reader"
        return Finding("read", "", "warning", seen_text, advice)
    advice = f"may those services write these vehicles, and may this client read? {_RULES}"
    return Finding("read", "", "wrong", seen_text, advice)
