"""Conditions and events of a vehicle, or of the service itself: begin, end, severity, evidence and suppression."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

from nedbus import limits
from nedbus.clock import format_duration
from nedbus_msgs.text import counted

from . import rules
from .detectors import Finding
from .event import (
    ALONE,
    SUPPRESSED,
    WINDOW,
    Author,
    Condition,
    Event,
    State,
    explain,
    state_of,
    without_wild,
)
from .kinds import KINDS, Severity


class Conditions:
    """Conditions of a vehicle, or of the service itself, and the events that they cause.

    `on_event`: callback for each event. `common`: conditions that concern all vehicles.

    `conditions`: active conditions by kind and flag. `initial`: conditions active in the first messages.
    `usual`: those of `usual` kinds, active since the first messages; they belong to the flight and affect no state.
    `armed`: None if unknown. `author`: of the vehicle's log messages. `recent`: recent events, searched for evidence.
    `time`: time of the last message with a detector [s]. `boot`: the time since boot in it [s].
    """

    def __init__(
        self, name: str, on_event: Callable[[Event], None], common: Conditions | None = None
    ) -> None:
        self.name = name
        self.conditions: dict[tuple[str, str], Condition] = {}
        self.initial: list[Condition] = []
        self.usual: dict[tuple[str, str], Condition] = {}
        self.armed: bool | None = None
        self.time = 0.0
        self.boot: float | None = None
        self.author: Author = "PX4"
        self.recent: deque[Event] = deque(maxlen=limits.RECENT_EVENTS)
        self._on_event = on_event
        self._common = common
        self._before = -math.inf  # time of the message before the last one in its stream
        self._invalid = -math.inf  # last time when a quantity of the estimate was invalid
        self._frequency = _Frequency()
        # lost and rejected messages and dropouts [ms], by kind
        self._bursts: dict[str, _Burst] = {}

    def settle(self, time: float) -> None:
        """Report bursts and flapping that have ended."""
        for kind, burst in list(self._bursts.items()):
            if burst.has_ended(kind, time):
                del self._bursts[kind]
                # rejections end; the others are single events
                if kind == "rejected":
                    at = burst.end
                else:
                    at = burst.begin
                self.emit(_finding_of_burst(kind, burst), "", at)
        for event in self._frequency.settle(time):
            self._report(event)

    def state(self, time: float) -> State:
        """Return the current state, set by active and flapping conditions and single events of the last minute."""
        conditions = [
            condition for condition in self.conditions.values() if self._counts(condition)
        ]
        kinds = {condition.kind for condition in conditions}
        for event in reversed(without_wild(self.recent)):
            text = event.text
            if event.change == "once":
                if event.time <= time - rules.RECENT:
                    continue
            elif event.change == "begin" and event.kind not in kinds:
                if not self._frequency.is_flapping(event):
                    continue
                kinds.add(event.kind)
                text = f"{text} (flapping)"
            else:
                continue
            conditions.append(Condition(event.kind, event.severity, text, event.time, event))
        return state_of(dict.fromkeys(conditions))  # a condition with several flags appears once

    def emit(
        self,
        finding: Finding,
        topic: str,
        time: float,
        *,
        changed: float | None = None,
    ) -> None:
        """Begin or end the conditions of a finding, or report a single event.

        `changed`: time when the condition began or ended, if earlier than `time`.
        """
        if changed is None:
            changed = time
        if finding.change == "begin":
            self.begin(finding, topic, time, changed)
        elif finding.change == "end":
            self.end(finding, topic, time, changed)
        else:
            self._report_unless_frequent(finding, self._event(finding, topic, time))

    def begin(
        self,
        finding: Finding,
        topic: str,
        time: float,
        since: float,
    ) -> None:
        """Begin the conditions of a finding, active `since`; report an event unless they are initial or flapping."""
        keys = _keys_of(finding)
        kind = KINDS[finding.kind]
        if finding.switch and keys[0] in self.conditions:
            return
        event = self._event(finding, topic, time, is_alone=self._is_alone(finding))
        severity = finding.severity or kind.severity
        condition = Condition(
            finding.kind,
            severity,
            finding.text,
            since,
            event,
            finding.initial,
        )
        for key in keys:
            self.usual.pop(key, None)
        if finding.initial and kind.usual:
            self.usual |= dict.fromkeys(keys, condition)
            return
        self.conditions |= dict.fromkeys(keys, condition)
        if kind.validity:
            self._invalid = math.inf
        if finding.initial and len(self.initial) < limits.RECENT_EVENTS:
            self.initial.append(condition)
        self._report_unless_frequent(finding, event)

    def end(
        self,
        finding: Finding,
        topic: str,
        time: float,
        until: float,
    ) -> None:
        """End the conditions of a finding, active `until`; report an event unless they were initial or are flapping."""
        keys = _keys_of(finding)
        kind = KINDS[finding.kind]
        if finding.switch and keys[0] not in self.conditions:
            return
        is_alone = self._is_alone(finding)
        for key in keys:
            self.usual.pop(key, None)
        ended = [self.conditions.pop(key) for key in keys if key in self.conditions]
        if kind.validity and not self._is_any_invalid:
            self._invalid = until
        starts = [condition.since for condition in ended if not condition.initial]
        text = kind.first or finding.text
        lasted = None
        if starts:
            lasted = max(0.0, until - min(starts))
            text = f"{finding.text} after {format_duration(lasted)}"
        ending = replace(finding, text=text)
        event = self._event(ending, topic, time, lasted=lasted, is_alone=is_alone)
        self._report_unless_frequent(ending, event)

    @property
    def held(self) -> list[Condition]:
        """Conditions active since the first messages or now, including the usual ones."""
        return [*dict.fromkeys([*self.initial, *self.conditions.values(), *self.usual.values()])]

    @property
    def held_from_start(self) -> str:
        """Bad and watch conditions active since the first message, as text; "" if none."""
        initial = [condition for condition in self.conditions.values() if condition.initial]
        texts = [condition.text for condition in initial if condition.severity != "info"]
        return ", ".join(dict.fromkeys(texts))

    def count_lost(self, count: int, stream: str, time: float) -> None:
        """Count lost messages of a stream, "" for an estimate of those of all topics of the vehicle's ULog stream."""
        self._count("lost", time, count, stream)

    def _count(
        self,
        kind: str,
        time: float,
        count: int,
        topic: str = "",
    ) -> None:
        burst = self._bursts.setdefault(kind, _Burst(time, time))
        burst.end = time
        burst.count += count
        if len(burst.topics) < limits.SHOWN_NAMES:
            burst.topics.add(topic)

    def _counts(self, condition: Condition) -> bool:
        """Return whether a condition affects the state: on the ground, some do not."""
        is_flying = self.armed is not False
        return is_flying or KINDS[condition.kind].on_ground != "info"

    @property
    def _is_any_invalid(self) -> bool:
        return any(KINDS[kind].validity for kind, _ in self.conditions)

    def _event(
        self,
        finding: Finding,
        topic: str,
        time: float,
        *,
        lasted: float | None = None,
        is_alone: bool = False,
    ) -> Event:
        is_text = finding.kind == "text"
        numbers = dict(finding.numbers)
        if self.armed and is_text:
            numbers["armed"] = 1
        if is_alone:
            numbers[ALONE] = 1
        boot = None
        if self.boot is not None:
            boot = round(self.boot + time - self.time, 6)
        return Event(
            vehicle=self.name,
            kind=finding.kind,
            change=finding.change,
            severity=self._severity(finding, time),
            text=finding.text,
            time=time,
            boot=boot,
            topic=topic,
            numbers=numbers,
            names=finding.names,
            lasted=lasted,
            author=self.author if is_text else None,
        )

    def _severity(self, finding: Finding, time: float) -> Severity:
        """Return the severity of an event: of its kind, unless the finding or the ground changes it."""
        kind = KINDS[finding.kind]
        if finding.change == "end":
            return finding.severity or "info"
        severity = finding.severity or kind.severity
        if self.armed is False and kind.on_ground is not None and severity != "info":
            return kind.on_ground
        if self.armed and finding.is_large and time - self._invalid >= rules.RECOVERY:
            return "bad"
        return severity

    def _is_alone(self, finding: Finding) -> bool:
        """Return whether the value that changes now began with the message just before, of a PERIODIC stream."""
        if KINDS[finding.kind].message not in rules.PERIODIC:
            return False
        if self.time - self._before > rules.WILD:
            return False
        for key in _keys_of(finding):
            condition = self.conditions.get(key)
            if condition is None or condition.initial:
                continue
            if condition.begin.time == self._before:
                return True
        return False

    def _report_unless_frequent(self, finding: Finding, event: Event) -> None:
        if finding.initial:
            return
        if not self._frequency.is_frequent(event):
            self._report(event)

    def _report(self, event: Event) -> None:
        recent = [*self.recent]
        conditions = [*self.conditions.values(), *self.usual.values()]
        if self._common is not None:
            recent = [*self._common.recent, *recent]
            conditions += self._common.conditions.values()
        self.recent.append(event)
        held = [condition for condition in conditions if condition.begin is not event]
        self._on_event(replace(event, evidence=tuple(explain(event, recent, held))))


@dataclass(slots=True)
class _Burst:
    """Losses, rejections or dropouts in close succession, reported as one event."""

    begin: float
    end: float
    count: int = 0
    topics: set[str] = field(default_factory=set)

    def has_ended(self, kind: str, time: float) -> bool:
        """Return whether it is over; losses that continue are reported after LOSS_PERIOD."""
        if kind == "lost" and time - self.begin > rules.LOSS_PERIOD:
            return True
        return time - self.end > rules.PAUSE


def _finding_of_burst(kind: str, burst: _Burst) -> Finding:
    """Return the finding that reports losses or a dropout, or ends rejections."""
    if kind == "lost":
        return _finding_of_losses(burst)
    if kind == "dropout":
        seconds = burst.count / 1e3
        text = f"logging dropout of {format_duration(seconds)}"
        return Finding(kind, "once", text, numbers={"duration": seconds})
    messages = counted(burst.count, "message")
    text = f"rejections stopped ({messages})"
    return Finding(kind, "end", text, numbers={"messages": burst.count})


def _finding_of_losses(burst: _Burst) -> Finding:
    messages = counted(burst.count, "message")
    names = tuple(sorted(burst.topics - {""}))
    streams = ", ".join(names)
    if "" in burst.topics:
        messages = f"about {messages}"
        streams = f"{streams} and the ULog stream" if streams else "the ULog stream"
    duration = burst.end - burst.begin
    within = ""
    if duration >= 1:
        within = f" in {format_duration(duration)}"
    text = f"{messages} lost{within} ({streams})"
    numbers = {"messages": burst.count, "duration": duration}
    return Finding("lost", "once", text, names, numbers)


class _Frequency:
    """Suppression of events that are so frequent that a report of each would hide all others."""

    def __init__(self) -> None:
        # events by kind, and by what is alike in them, or None for all of the kind
        self._events: dict[tuple[str, object], deque[Event]] = {}
        self._suppressed: Counter[tuple[str, object]] = Counter()  # by the same keys

    def is_flapping(self, event: Event) -> bool:
        """Return whether changes of a condition are suppressed now."""
        return (event.kind, event.names) in self._suppressed or (
            event.kind,
            None,
        ) in self._suppressed

    def is_frequent(self, event: Event) -> bool:
        """Count an event; return True if there are too many like it to report each; `settle` reports the last one."""
        for key, limit in self._limits_of(event).items():
            events = self._events.setdefault(key, deque(maxlen=limit))
            is_fast = len(events) == limit and event.time - events[0].time < WINDOW
            events.append(event)
            if is_fast:
                self._suppressed[key] += 1
                return True
        return False

    def _limits_of(self, event: Event) -> dict[tuple[str, object], int]:
        """Return how many events like one are reported within WINDOW, by what is alike in them."""
        of_kind = (event.kind, None)
        if event.change == "once":
            alike: object = event.text
            if event.kind != "text":
                alike = (event.names, event.severity)
            return {(event.kind, alike): rules.EQUAL_EVENTS, of_kind: rules.SINGLE_EVENTS}
        # flags of a kind may change in any combination
        if of_kind in self._suppressed:
            return {of_kind: rules.KIND_CHANGES}
        return {
            (event.kind, event.names): rules.CONDITION_CHANGES,
            of_kind: rules.KIND_CHANGES,
        }

    def settle(self, time: float) -> Iterator[Event]:
        """Yield the events that stand for suppressed ones, once there are no more; forget old events."""
        for key, events in list(self._events.items()):
            last = events[-1]
            if key in self._suppressed and time - last.time > rules.PAUSE:
                yield _summary(last, self._suppressed.pop(key))
            if time - last.time > WINDOW:
                del self._events[key]


def _summary(last: Event, count: int) -> Event:
    """Return the event that stands for `count` suppressed ones; PX4's own words stay as they are."""
    if last.kind == "text":
        return replace(last, numbers={**last.numbers, SUPPRESSED: count})
    return replace(last, text=f"{last.text}, the last of {count} suppressed changes")


def _keys_of(finding: Finding) -> list[tuple[str, str]]:
    """Return the keys of the conditions of a finding: its kind, and each of its flags."""
    return [(finding.kind, flag) for flag in KINDS[finding.kind].conditions(finding.names)]
