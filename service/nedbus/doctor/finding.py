"""A finding: what was seen of one thing, in which state it is, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, get_args

State = Literal["ok", "unknown", "warning", "wrong"]
STATES: Final[tuple[State, ...]] = get_args(State)
"""All states, the worst last."""

_MAX_FINDINGS: Final = 10  # of one check that are listed one by one: any peer may claim to be a thousand vehicles
_MAX_NAME: Final = 140  # characters of what a peer sent; an address has up to 133


@dataclass(frozen=True, slots=True)
class Finding:
    """One answer.

    `check`: which of the checks found it, such as `endpoint`.
    `subject`: what it is about, such as an endpoint or an address; empty for the network as a whole.
    `seen`: what was seen; `advice`: what to do about it, empty where nothing is to be done.
    Both may contain text that some peer sent: whoever prints it makes it printable.
    """

    check: str
    subject: str
    state: State
    seen: str
    advice: str = ""


def worst_state(findings: Iterable[Finding]) -> State:
    """Return the worst state of these findings; ok for none."""
    return max((finding.state for finding in findings), key=STATES.index, default="ok")


def sort_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings with the worst last, those of one state as they were found."""
    return sorted(findings, key=lambda finding: STATES.index(finding.state))


def limit_findings(findings: Sequence[Finding]) -> list[Finding]:
    """Return the worst ones of a check that finds one thing for each peer, and how many more there are."""
    if len(findings) <= _MAX_FINDINGS:
        return list(findings)
    kept = sort_findings(findings)[-_MAX_FINDINGS:]
    rest = sort_findings(findings)[:-_MAX_FINDINGS]
    return [Finding(kept[0].check, "", worst_state(rest), f"{len(rest)} more of the same kind"), *kept]


def brief(value: object) -> str:
    """Return what a peer sent as text of bounded length."""
    text = str(value)
    return text if len(text) <= _MAX_NAME else f"{text[: _MAX_NAME - 3]}..."


def list_names(names: Iterable[object], limit: int = 5) -> str:
    """Return the first few of some names, and how many more there are."""
    every = [brief(name) for name in names]
    return ", ".join(every[:limit]) + (f" and {len(every) - limit} more" if len(every) > limit else "")


def format_seconds(seconds: float) -> str:
    """Return a duration for a person: 0.25 s, 5 s, 3 min, 2.0 h, 4 days."""
    for limit, unit, digits in ((10, 1, 2), (120, 1, 0), (7200, 60, 0), (172_800, 3600, 1)):
        if abs(seconds) < limit:
            return f"{seconds / unit:.{digits}f} {({1: 's', 60: 'min', 3600: 'h'})[unit]}"
    return f"{seconds / 86_400:.0f} days"
