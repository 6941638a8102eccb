"""Events, conditions and states of a vehicle, and the search for possible causes of an event."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, Literal

from pydantic import Field

from nedbus_msgs import ARDUPILOT, OTHER_AUTOPILOT

from .kinds import KINDS, SEVERITIES, Severity, importance
from .rules import WILD

WINDOW: Final = 10.0
"""Seconds before an event in which events of related kinds are evidence; the start of an active one may be older."""

LATE: Final = 0.5
"""Seconds after the start of a fault in which events are still its possible causes: topics differ in rate."""

ALL: Final = "*"
"""Vehicle name in events that concern all vehicles: events of the router link and of the reader."""

ALONE: Final = "one_message"
"""Name among an event's `numbers` if only one message, between two that agree, had the value that it ends."""

SUPPRESSED: Final = "suppressed"
"""Key in `numbers` of a PX4 text that represents several equal texts: their number."""

Author = Literal["PX4", "ArduPilot", "autopilot"]

AUTHORS: Final[Mapping[str | None, Author]] = {ARDUPILOT: "ArduPilot", OTHER_AUTOPILOT: "autopilot"}
"""The author of log messages by their source; all others are of PX4."""

Seconds = Annotated[float, Field(ge=0.0, le=1e11)]
"""Time on the event log's clock [s]; the bounds validate reports from peers."""


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """One event of a vehicle.

    `kind`: a key of KINDS. `change`: "begin" or "end" of a condition, or "once".
    `time` [s]: on this host's steady clock (live data), in Unix time (a report), or since the start of the file.
    `boot`: seconds since the vehicle's boot, None if unknown.
    `numbers`: values by name, in SI units and NED. `names`: flags, quantities, topics, or values before and after.
    `lasted`: duration of the condition that ends [s], None if it began before the first message.
    `evidence`: possible causes, which occurred at most WINDOW seconds earlier or began a condition still active.
    `author`: of a log message, the autopilot that the vehicle's HEARTBEAT names; None for all other events, and in the
    reports of older services.
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
    author: Author | None = None

    @property
    def identity(self) -> tuple[object, ...]:
        """Key that is equal for the same event in the reports of two services."""
        return self.kind, self.time, self.names, self.origin == "px4" and self.text

    @property
    def origin(self) -> str:
        """The author: "px4" for log messages of an autopilot, "nedbus" for events derived from messages."""
        if self.kind == "text":
            return "px4"
        return "nedbus"

    @property
    def is_minor(self) -> bool:
        """True if it concerns only minor flags of its kind, or is a small correction; it explains nothing."""
        kind = KINDS[self.kind]
        if kind.correction and kind.severity != "info":
            return self.severity == "info"
        return bool(self.names) and kind.minor.issuperset(self.names)

    @property
    def words(self) -> str:
        """The text; of an autopilot in quotes after its author, with the number of equal ones that it stands for."""
        if self.origin != "px4":
            return self.text
        quoted = f'{self.author or "PX4"}: "{self.text}"'
        count = self.numbers.get(SUPPRESSED)
        if not count:
            return quoted
        return f"{quoted}, the last of {count:.0f} suppressed texts"

    def later(self, seconds: float) -> Event:
        """Return this event and its evidence on a clock that is ahead by `seconds`."""
        evidence = tuple(event.later(seconds) for event in self.evidence)
        return replace(self, time=max(0.0, self.time + seconds), evidence=evidence)


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition of a vehicle.

    `since`: start on the event log's clock [s]. `begin`: the event that began it.
    `initial`: it was active in the first message; its true start is unknown.
    """

    kind: str
    severity: Literal["bad", "watch", "info"]
    text: str
    since: Seconds
    begin: Event
    initial: bool = False

    def later(self, seconds: float) -> Condition:
        """Return this condition on a clock that is ahead by `seconds`."""
        return replace(self, since=max(0.0, self.since + seconds), begin=self.begin.later(seconds))


@dataclass(frozen=True, slots=True)
class State:
    """State of a vehicle: conditions, worst first; severity ("info" if healthy), text and start of the worst one."""

    severity: Severity
    text: str
    since: float | None
    conditions: tuple[Condition, ...]


def rank(condition: Condition, until: float | None) -> tuple[int, int, float]:
    """Return a sort key for conditions, worst first; `until`: the end, None while it is active.

    Order: severity; importance of the kind; duration, or the largest number of a single event.
    """
    return (
        SEVERITIES.index(condition.severity),
        importance(condition.kind),
        -_size(condition, until),
    )


def _size(condition: Condition, until: float | None) -> float:
    """Return the largest number of a single event, or the duration of a condition [s]."""
    if condition.begin.change == "once":
        return max(map(abs, condition.begin.numbers.values()), default=0.0)
    if until is None:
        return math.inf
    return round(until - condition.since, 2)


def state_of(conditions: Iterable[Condition]) -> State:
    """Return the state of a vehicle, set by the worst of these conditions and recent single events."""
    faults = [condition for condition in conditions if condition.severity != "info"]
    counting = [condition for condition in faults if not KINDS[condition.kind].stateless]
    ordered = sorted(counting, key=lambda condition: rank(condition, None))
    if not ordered:
        return State("info", "ok", None, ())
    first = ordered[0]
    return State(first.severity, first.text, first.since, tuple(ordered))


def without_wild(events: Iterable[Event]) -> list[Event]:
    """Return chronological events without the conditions, and the moves of an origin, that one message alone had.

    A condition that recurs within WINDOW is real, since the stream is not sound otherwise.
    """
    events = list(events)
    wild = _wild_events(events)
    kept: list[Event] = []
    for event in events:
        if id(event) not in wild:
            kept.append(event)
            continue
        begin = _begin_of(event, kept)
        if begin is None:
            kept.append(event)
            continue
        del kept[begin]
        if event.change == "begin":  # another condition, which the wild one interrupted
            kept.append(event)
    return kept


def _wild_events(events: Iterable[Event]) -> set[int]:
    """Return the ids of events that end a value which one message alone had, and that do not recur."""
    wild = set[int]()
    last: dict[tuple[str, str], Event] = {}
    for event in events:
        if ALONE not in event.numbers:
            continue
        key = (event.vehicle, event.kind)
        before = last.get(key)
        last[key] = event
        if before is None or event.time - before.time > WINDOW:
            wild.add(id(event))
        else:
            wild.discard(id(before))
    return wild


def _begin_of(event: Event, earlier: Sequence[Event]) -> int | None:
    """Return the index of the last event of the same kind, None if it is older than a wild message can be."""
    for index in reversed(range(len(earlier))):
        begin = earlier[index]
        if (begin.vehicle, begin.kind) == (event.vehicle, event.kind):
            if event.time - begin.time <= WILD:
                return index
            return None
    return None


def explain(
    event: Event, near: Iterable[Event], conditions: Iterable[Condition] = (), *, late: float = 0.0
) -> list[Event]:
    """Return the possible causes of an event in chronological order: the latest of each kind, and each text of PX4.

    `near`: events of about the same time; those from WINDOW seconds before the event to `late` seconds after it count.
    `conditions`: active ones count, however old. Possible causes of a start are other starts and PX4's texts; of an
    end, other ends since the condition began; of a correction of the estimate, all of these.
    """
    causes = KINDS[event.kind].causes
    latest: dict[object, Event] = {}
    window = WINDOW
    if event.lasted is not None:
        window = min(WINDOW, event.lasted)
    for other in near:
        if other is event or other.kind not in causes:
            continue
        is_near = event.time - window <= other.time <= event.time + late
        if is_near and _may_explain(other, event):
            latest[other.text if other.kind == "text" else other.kind] = other
    if event.change != "end":
        for condition in conditions:
            begin = condition.begin
            is_before = begin.time <= event.time + late  # an event may be reported late
            if condition.kind not in causes or not is_before or begin.is_minor:
                continue
            if _is_notable(condition.kind, condition.severity):
                latest.setdefault(condition.kind, begin)
    return sorted(latest.values(), key=lambda cause: cause.time)


def _may_explain(cause: Event, event: Event) -> bool:
    """Return whether an event of a kind that explains another may explain this one: by change and importance."""
    if cause.kind == "link_down":  # the losses that it causes are detected after it ends
        return True
    if cause.kind == "text":
        return cause.severity != "info" and event.change != "end"
    if KINDS[event.kind].correction:
        return not cause.is_minor
    if event.change == "end":
        return cause.change != "begin" and not cause.is_minor
    if cause.change == "end" or cause.is_minor:
        return False
    return _is_notable(cause.kind, cause.severity)


def _is_notable(kind: str, severity: Severity) -> bool:
    """Return whether a start is not routine: info because of the kind, or on the ground, but not by its size."""
    if severity != "info":
        return True
    return "info" in (KINDS[kind].severity, KINDS[kind].on_ground)
