"""Whose clock is off, and by how much: of services, of publishers, and of this host."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from .finding import Finding, State, brief, format_seconds
from .observation import Observation

_WARNING: Final = 0.5  # s
_WRONG: Final = 5.0  # s
_ADVICE: Final = "run NTP or PTP on both hosts: 'timedatectl' says whether a clock is synchronised"


def check_clocks(seen: Observation) -> Iterator[Finding]:
    """Yield what is found of each clock; where all others agree and this one does not, it is this one."""
    clocks = {**_services(seen), **_publishers(seen)}
    off = {name: offset for name, (offset, error) in clocks.items() if abs(offset) > _WARNING + error}
    if len(off) > 1 and len(off) == len(clocks) and max(off.values()) - min(off.values()) < _WARNING:
        middle = sorted(off.values())[len(off) // 2]
        seen_text = f"this host's clock is {_describe(-middle)} {len(off)} others, which agree with each other"
        yield Finding("clock", "this host", _state(middle), seen_text, _ADVICE)
        return
    for name, offset in off.items():
        yield Finding(
            "clock", name, _state(offset), f"its clock is {_describe(offset)} this host's", _advise(clocks, off)
        )
    if clocks and not off:
        most = max(abs(offset) for offset, _ in clocks.values())
        agree = f"{len(clocks)} clocks agree with this host's to {format_seconds(max(most, 0.01))}"
        yield Finding("clock", "", "ok", agree)


def _services(seen: Observation) -> dict[str, tuple[float, float]]:
    """Return how far the clocks of services are ahead of ours, and how well that is known [s]."""
    return {
        f"service {brief(service.status.service)} on {brief(service.status.host)}": (service.offset, service.error)
        for service in seen.services
        if service.offset is not None
    }


def _publishers(seen: Observation) -> dict[str, tuple[float, float]]:
    """Return how far the clocks of publishers are ahead; of one that is behind only with what the network takes."""
    return {
        f"publisher of {stream.address}": (-stream.delay, 0.0 if stream.delay < 0 else _WARNING)
        for stream in seen.streams.values()
        if stream.address is not None and stream.delay is not None
    }


def _describe(offset: float) -> str:
    return f"{format_seconds(abs(offset))} {'ahead of' if offset > 0 else 'behind'}"


def _state(offset: float) -> State:
    return "wrong" if abs(offset) > _WRONG else "warning"


def _advise(clocks: dict[str, tuple[float, float]], off: dict[str, float]) -> str:
    if len(clocks) > len(off):
        return f"the others agree with this host: set its clock. {_ADVICE}"
    return f"which of the two is off cannot be told from here. {_ADVICE}"
