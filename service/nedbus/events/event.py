"""Events, conditions and states of a vehicle; all kinds of events, and the evidence that may explain each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final, Literal, get_args

from pydantic import Field

Severity = Literal["bad", "watch", "info"]
SEVERITIES: Final[tuple[Severity, ...]] = get_args(Severity)
"""The worst first: bad keeps a vehicle from its task, watch may become bad, info occurs in any flight."""

WINDOW: Final = 10.0
"""Seconds before an event in which others count as evidence; of conditions that go on, the begin counts at any time."""

ALL: Final = "*"
"""The vehicle of events of the link, and of the reader itself, which concern all."""

Seconds = Annotated[float, Field(ge=0.0, le=1e11)]
"""A time by the account's clock; the bounds apply to reports of peers."""


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """One event of a vehicle.

    `kind`: a key of KINDS. `change`: a condition begins or ends, or something happens once.
    `time`: seconds by the clock of the account: since the epoch by this host's clock where messages arrive live, since
    the start of a file otherwise. `boot`: seconds since the vehicle's boot; None where the vehicle has said nothing.
    `numbers`: by name, in SI units and NED; `names`: flags, sensors, or what was before and after.
    `lasted`: of an end, seconds since the begin; None where it began before the first message.
    `evidence`: the events that may explain it and precede it by at most WINDOW, or began earlier and go on.
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
        """The same for one event of a vehicle in the reports of two services."""
        return self.kind, self.time, self.names

    @property
    def is_notable(self) -> bool:
        """True for a begin that is bad or to be watched, and for a change of mode: both belong to a story."""
        return self.change != "end" and (self.severity != "info" or self.kind == "mode")


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition of a vehicle, its begin by the account's clock, and the event that began it.

    `initial`: it held at the first message already: it began at an unknown time before.
    `on_ground`: its severity while the vehicle is disarmed, where that is another.
    """

    kind: str
    severity: Literal["bad", "watch", "info"]
    text: str
    since: Seconds
    begin: Event
    initial: bool = False
    on_ground: Literal["bad", "watch", "info"] | None = None


@dataclass(frozen=True, slots=True)
class State:
    """The state of a vehicle now: severity ("info" is well), text, begin, and all conditions."""

    severity: Severity
    text: str
    since: float | None
    conditions: tuple[Condition, ...]


def state_of(conditions: Iterable[Condition]) -> State:
    """Return the state in which these conditions leave a vehicle: the worst one speaks for it."""
    ordered = sorted(
        (each for each in conditions if each.severity != "info"),
        key=lambda each: (
            SEVERITIES.index(each.severity), _FIRST.index(each.kind) if each.kind in _FIRST else len(_FIRST)
        ),
    )  # fmt: skip
    if not ordered:
        return State("info", "ok", None, ())
    first = ordered[0]
    return State(first.severity, first.text, first.since, tuple(ordered))


_FIRST: Final = (
    "gone", "silent", "failsafe", "xy_invalid", "z_invalid", "v_xy_invalid", "v_z_invalid", "battery", "dead_reckoning",
)  # fmt: skip
_SENSING: Final = (
    "gps_fix_lost", "gps_fix", "few_satellites", "jamming", "spoofing", "not_fused", "innovation_rejected",
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
    "jump": (*_SENSING, *_ESTIMATE),
    "origin_set": _SENSING,
    "origin_moved": (*_SENSING, "reset"),
    "gps_fix_lost": ("jamming", "spoofing", "few_satellites"),
    "gps_fix": ("jamming", "spoofing", "few_satellites"),
    "few_satellites": ("jamming", "spoofing"),
    "jamming": (),
    "spoofing": (),
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
    "reboot": ("battery", "gone", "silent"),
    "silent": ("link_down", "battery", "overload"),
    "gone": ("link_down", "battery", "silent"),
    "lost": ("link_down", "overload"),
    "rejected": (),
    "link_down": (),
    "overload": (),
}  # fmt: skip
"""All kinds, each with those that may explain it."""


def explain(event: Event, before: Iterable[Event], conditions: Iterable[Condition] = ()) -> list[Event]:
    """Return the events that may explain one, the last of each kind: at most WINDOW before it, or begun and going on.

    A begin is explained by what went wrong, an end by what ended; a correction of the estimate by either.
    """
    kinds, latest = KINDS[event.kind], {}
    unwanted = "begin" if event.change == "end" else "end" if event.kind not in _CORRECTIONS else ""
    for each in before:
        is_bad = each.severity != "info" or event.change == "end" or event.kind in _CORRECTIONS
        is_near = event.time - WINDOW <= each.time <= event.time
        is_link = each.kind == "link_down"  # what was lost is seen when the link is back
        if each is not event and each.kind in kinds and is_near and (is_link or (is_bad and each.change != unwanted)):
            latest[each.kind] = each
    for condition in conditions:
        is_before = condition.begin.time <= event.time  # an event may be told late
        if condition.kind in kinds and condition.severity != "info" and event.change != "end" and is_before:
            latest.setdefault(condition.kind, condition.begin)
    return sorted(latest.values(), key=lambda each: each.time)
