"""A finding: the state of one subject, the observation behind it, and advice."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal, get_args

State = Literal["ok", "unknown", "warning", "wrong"]
_STATES: Final[tuple[State, ...]] = get_args(State)  # the worst last
_MAX_FINDINGS: Final = 10  # listed for one check: any peer may claim to be a thousand vehicles
_MAX_NAME: Final = 140  # characters of text from a peer; an address has up to 133


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check on one subject.

    `check`: its name in docs/doctor.md, such as `endpoint`.
    `subject`: an endpoint, address or file; empty for the network as a whole.
    `seen`: the observation; `advice`: the remedy, empty if none is needed.
    Both may contain text from peers: escape it before printing.
    """

    check: str
    subject: str
    state: State
    seen: str
    advice: str = ""


def worst_state(findings: Iterable[Finding]) -> State:
    """Return the worst state of these findings; ok if there are none."""
    return max((finding.state for finding in findings), key=_STATES.index, default="ok")


def sort_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Sort findings, the worst last; the order within a state is kept."""
    return sorted(findings, key=lambda finding: _STATES.index(finding.state))


def limit_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Return the worst findings of a check, preceded by one that counts the others."""
    ordered = sort_findings(findings)
    rest, kept = ordered[:-_MAX_FINDINGS], ordered[-_MAX_FINDINGS:]
    if rest:
        kept.insert(0, Finding(kept[0].check, "", worst_state(rest), f"{len(rest)} more of the same kind"))
    return kept


def brief(value: object) -> str:
    """Return a value from a peer as text of limited length."""
    text = str(value)
    return text if len(text) <= _MAX_NAME else f"{text[: _MAX_NAME - 3]}..."


def list_names(names: Iterable[object], limit: int = 5) -> str:
    """Join the first names; append the number of the others."""
    every = [brief(name) for name in names]
    return ", ".join(every[:limit]) + (f" and {len(every) - limit} more" if len(every) > limit else "")
