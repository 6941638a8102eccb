"""Events, conditions and states of a vehicle, and the table of event kinds with their possible causes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, Literal, get_args

from pydantic import Field

Severity = Literal["bad", "watch", "info"]
SEVERITIES: Final[tuple[Severity, ...]] = get_args(Severity)
"""Worst first. bad: the vehicle cannot do its task; watch: may become bad; info: part of any flight."""

WINDOW: Final = 10.0
"""Seconds before an event in which other events count as evidence; the begin of an active condition always does."""

ALL: Final = "*"
"""Vehicle name of events that concern all vehicles: those of the link and of the reader itself."""

Seconds = Annotated[float, Field(ge=0.0, le=1e11)]
"""A time by the account's clock [s]; the bounds validate reports of peers."""


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """One event of a vehicle.

    `kind`: a key of KINDS. `change`: "begin" or "end" of a condition, or "once".
    `time`: seconds by the account's clock: the steady clock of this host (live), Unix time (in a report), or since the
    start of a file. `boot`: seconds since the vehicle's boot, None if no message has given it.
    `numbers`: values by name, in SI units and NED. `names`: flags, sensors, or the values before and after.
    `lasted`: duration of a condition that ends [s], None if it began before the first message.
    `evidence`: possible causes: events at most WINDOW seconds earlier, and conditions that are still active.
    """

    vehicle: str
    kind: str
    change: Literal["begin", "end", "once"]
    severity: Literal["bad", "watch", "info"]
    text: str
    time: Seconds
    boot: float | None = None
    topic: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    lasted: float | None = None
    evidence: tuple[Event, ...] = ()

    @property
    def identity(self) -> tuple[object, ...]:
        """A key that is equal for the same event in the reports of two services."""
        return self.kind, self.time, self.names

    def later(self, seconds: float) -> Event:
        """Return this event and its evidence on a clock that is ahead by `seconds`."""
        evidence = tuple(each.later(seconds) for each in self.evidence)
        return replace(self, time=max(0.0, self.time + seconds), evidence=evidence)

    @property
    def is_notable(self) -> bool:
        """True if a story includes it: a begin or single event of severity bad or watch, or a change of mode."""
        return self.change != "end" and (self.severity != "info" or self.kind == "mode")


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition of a vehicle.

    `since`: its begin by the account's clock [s]. `begin`: the event that began it.
    `initial`: it already held in the first message, so its real begin is unknown.
    `on_ground`: the severity while the vehicle is disarmed, None if it is the same.
    """

    kind: str
    severity: Literal["bad", "watch", "info"]
    text: str
    since: Seconds
    begin: Event
    initial: bool = False
    on_ground: Literal["bad", "watch", "info"] | None = None

    def later(self, seconds: float) -> Condition:
        """Return this condition on a clock that is ahead by `seconds`."""
        return replace(self, since=max(0.0, self.since + seconds), begin=self.begin.later(seconds))


@dataclass(frozen=True, slots=True)
class State:
    """The state of a vehicle: severity ("info" if all is well), text and begin of the worst condition, all of them."""

    severity: Severity
    text: str
    since: float | None
    conditions: tuple[Condition, ...]


def state_of(conditions: Iterable[Condition]) -> State:
    """Return the state of a vehicle with these conditions; the worst one gives severity, text and begin."""
    ordered = sorted(
        (each for each in conditions if each.severity != "info"),
        key=lambda each: (
            SEVERITIES.index(each.severity),
            _PRIORITY.index(each.kind) if each.kind in _PRIORITY else len(_PRIORITY),
        ),
    )  # fmt: skip
    if not ordered:
        return State("info", "ok", None, ())
    first = ordered[0]
    return State(first.severity, first.text, first.since, tuple(ordered))


_PRIORITY: Final = (
    "duplicate", "gone", "silent", "failsafe", "xy_invalid", "z_invalid", "v_xy_invalid", "v_z_invalid", "battery",
    "dead_reckoning",
)  # fmt: skip
_SENSING: Final = (
    "gps_fix_lost", "gps_fix", "few_satellites", "jamming", "spoofing", "not_fused", "not_aided", "innovation_rejected",
    "estimator_fault",
)  # fmt: skip
_CORRECTIONS: Final = ("reset", "jump", "origin_set", "origin_moved")
_ESTIMATE: Final = ("xy_invalid", "z_invalid", "v_xy_invalid", "v_z_invalid", "dead_reckoning")
KINDS: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(("xy_invalid", "v_xy_invalid"), (*_SENSING, "dead_reckoning", "reboot")),
    **dict.fromkeys(("z_invalid", "v_z_invalid"), (*_SENSING, "reboot")),
    **dict.fromkeys(("dead_reckoning", "xy_not_global", "z_not_global"), _SENSING),
    "heading_not_good": (*_SENSING, "reset", "landed"),
    "dist_bottom_invalid": ("not_fused", "estimator_fault"),
    "reset": (*_SENSING, *_ESTIMATE, "origin_set", "origin_moved"),
    "jump": ("duplicate", *_SENSING, *_ESTIMATE),
    "origin_set": _SENSING,
    "origin_moved": (*_SENSING, "reset"),
    "gps_fix_lost": ("jamming", "spoofing", "few_satellites"),
    "gps_fix": ("jamming", "spoofing", "few_satellites"),
    "few_satellites": ("jamming", "spoofing"),
    "jamming": (),
    "spoofing": (),
    "not_aided": (),
    "not_fused": ("gps_fix_lost", "few_satellites", "jamming", "spoofing", "innovation_rejected", "estimator_fault"),
    "innovation_rejected": ("gps_fix_lost", "gps_fix", "jamming", "spoofing", "estimator_fault"),
    "estimator_fault": (),
    "failsafe": (*_ESTIMATE, *_SENSING, "failsafe_flag", "gcs_lost", "battery"),
    "failsafe_flag": (*_ESTIMATE, *_SENSING),
    "mode": ("failsafe", "failsafe_flag", "xy_invalid", "z_invalid"),
    "armed": (),
    "disarmed": ("landed", "failsafe", "failsafe_flag", "estimator_fault"),
    "landed": (),
    "takeoff": (),
    "gcs_lost": (),
    "battery": (),
    "reboot": ("duplicate", "battery", "gone", "silent"),
    "silent": ("link_down", "battery", "overload"),
    "duplicate": (),
    "gone": ("link_down", "battery", "silent"),
    "lost": ("link_down", "overload"),
    "rejected": (),
    "link_down": (),
    "overload": (),
    "dropout": (),
}  # fmt: skip
"""All kinds of events, each with the kinds that may explain it."""


def explain(event: Event, before: Iterable[Event], conditions: Iterable[Condition] = ()) -> list[Event]:
    """Return the possible causes of an event, the latest of each kind: within WINDOW seconds, or still active.

    Begins explain a begin, ends explain an end; both explain a correction of the estimate.
    """
    kinds, latest = KINDS[event.kind], {}
    excluded = "begin" if event.change == "end" else "end" if event.kind not in _CORRECTIONS else ""
    for each in before:
        is_bad = each.severity != "info" or event.change == "end" or event.kind in _CORRECTIONS
        is_near = event.time - WINDOW <= each.time <= event.time
        is_link = each.kind == "link_down"  # its losses are detected after its end
        if each is not event and each.kind in kinds and is_near and (is_link or (is_bad and each.change != excluded)):
            latest[each.kind] = each
    for condition in conditions:
        is_before = condition.begin.time <= event.time  # an event may be reported late
        if condition.kind in kinds and condition.severity != "info" and event.change != "end" and is_before:
            latest.setdefault(condition.kind, condition.begin)
    return sorted(latest.values(), key=lambda each: each.time)
