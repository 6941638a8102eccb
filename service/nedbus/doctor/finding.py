"""Finding of a check: its subject, the subject's state, the observation and advice."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final, Literal, get_args

from nedbus import limits
from nedbus_msgs.text import counted

State = Literal["ok", "unknown", "warning", "wrong"]
"""State of the subject of a check."""

_STATES: Final[tuple[State, ...]] = get_args(State)  # worst last
FIRST_PARTNER: Final = (
    "PX4 sends only to the first address that sent to its port since its boot: if that was another program or port,"
    " reboot the vehicle, or send from that port with udpout:HOST:PORT@LOCAL_PORT"
)
"""Advice for a link of udpout on which nothing arrives."""

_LISTED: Final = 5  # names in the text of a finding


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of a check on one subject.

    `check`: name of the check in docs/doctor.md, such as `endpoint`.
    `subject`: an endpoint, address or file, or several with equal findings, of which the first five are listed;
    "" for the whole network.
    `seen`: the observation; `advice`: the remedy, "" if none is needed.
    Both may contain text from peers: escape them before printing.
    """

    check: str
    subject: str
    state: State
    seen: str
    advice: str = ""


def worst_state(findings: Iterable[Finding]) -> State:
    """Return the worst state of these findings, "ok" if there are none."""
    return max((finding.state for finding in findings), key=_STATES.index, default="ok")


def sort_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Sort findings by state, worst last; the sort is stable."""
    return sorted(findings, key=lambda finding: _STATES.index(finding.state))


def limit_findings(findings: Iterable[Finding]) -> list[Finding]:
    """Merge equal findings of a check, and return the worst, preceded by one that states the number of the others."""
    ordered = sort_findings(_merge_equal(findings))
    kept = ordered[-limits.SHOWN_FINDINGS :]
    others = ordered[: -limits.SHOWN_FINDINGS]
    if not others:
        return kept
    text = f"{counted(len(others), 'more finding')} of this check"
    return [Finding(kept[0].check, "", worst_state(others), text), *kept]


def _merge_equal(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings that differ only in their subjects as one, which lists the subjects."""
    subjects: dict[Finding, list[str]] = {}
    for finding in findings:
        same = replace(finding, subject="")
        subjects.setdefault(same, []).append(finding.subject)
    return [replace(finding, subject=list_names(names)) for finding, names in subjects.items()]


def brief(value: object) -> str:
    """Return a value from a peer as text of at most `limits.PEER_TEXT` characters."""
    text = str(value)
    if len(text) <= limits.PEER_TEXT:
        return text
    return f"{text[: limits.PEER_TEXT - 3]}..."


def list_names(names: Iterable[object], limit: int = _LISTED) -> str:
    """Join the first names, and append the number of the others."""
    texts = [brief(name) for name in names]
    shown = ", ".join(texts[:limit])
    if len(texts) > limit:
        return f"{shown} and {len(texts) - limit} more"
    return shown
