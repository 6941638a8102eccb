"""Stories for `nedbus why`: each fault with its period, evidence, and missing topics that may hold more evidence."""

import math
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from .event import WINDOW, Condition, Event, State, explain, state_of, without_wild
from .kinds import KINDS, importance
from .rules import EVIDENCE, RECENT
from .times import Times

TOGETHER: Final = 1.0  # s; maximum time between the starts of conditions of one story
_INVALID: Final = " not valid"
_UNNEEDED: Final = ("barometer", "battery")  # EVIDENCE that does not explain an invalid estimate
_SENSOR_FAILURE: Final = re.compile(r"#\d+ fail(ed|ure):")  # PX4's "MAG #0 failed: STALE!", and its event for it


@dataclass(frozen=True, slots=True)
class Span(Condition):
    """A condition and its end: the time `until` and the event `end`, both None while the condition is active."""

    until: float | None = None
    end: Event | None = None

    @property
    def is_of_estimate(self) -> bool:
        """True if it is a fault of the position estimate."""
        return KINDS[self.kind].message == "VehicleLocalPosition"

    def holds(self, time: float) -> bool:
        """Return True if the condition is active at `time`, or the single event is recent."""
        until = math.inf if self.until is None else self.until + RECENT * (self.until == self.since)
        return self.since <= time < until


@dataclass(frozen=True, slots=True)
class Story:
    """One fault of a vehicle.

    `spans`: its conditions, the main one first. `what`: their text.
    `since`, `until`: times on the event log's clock [s]; `until` is None while it is active.
    `begin`: the event that began it, None if it was active in the first message. `end`: the event that ended it.
    `before`: the evidence, oldest first. `meanwhile`: other events during the fault. `after`: events at its end.
    `lacking`: topics that may hold evidence, but are missing from the data.
    """

    spans: tuple[Span, ...]
    what: str
    since: float
    until: float | None
    begin: Event | None
    end: Event | None
    before: tuple[Event, ...]
    meanwhile: tuple[Event, ...]
    after: tuple[Event, ...]
    lacking: tuple[str, ...]

    @property
    def is_bad(self) -> bool:
        """True if any of its conditions is bad."""
        return any(each.severity == "bad" for each in self.spans)

    def has_ended(self, now: float) -> bool:
        """Return True if it is over, and not a single event of the last minute."""
        return not any(span.holds(now) for span in self.spans)

    def when(self, times: Times, now: float) -> str:
        """Format the period of the fault; `now`: the current time, or the end of the file."""
        begin = self.begin
        if begin is not None and begin.time != self.since:  # silence is detected later
            boot = None if begin.boot is None else begin.boot - (begin.time - self.since)
            begin = replace(begin, time=self.since, boot=boot)
        return times.period(begin, self.end, (now if self.until is None else self.until) - self.since)


def stories_of(
    events: Sequence[Event],
    conditions: Iterable[Condition] = (),
    *,
    topics: Collection[str] = (),
    at: float | None = None,
) -> list[Story]:
    """Return the stories of one vehicle in chronological order; [] if it has no faults.

    `events`: all events of the vehicle, in order. `conditions`: conditions active after the last event.
    `topics`: published topics. `at`: return the stories active at this time, else the last one before, else the first.
    """
    events = without_wild(events)
    spans = [span for span in spans_of(events, conditions) if not (span.initial and span.end)]
    chosen = [span for kind in KINDS.values() if kind.fault for span in spans if span.kind == kind.name]
    if not any(span.until is None if at is None else span.holds(at) for span in chosen):
        others = [s for s in spans if s.severity != "info" and not (KINDS[s.kind].fault or KINDS[s.kind].stateless)]
        chosen += [s for s in others if s.until is None] if chosen and at is None else others
    chosen += [replace(span, severity="watch") for span in spans if _is_alarm(span.begin)]
    stories: list[Story] = []
    while chosen:
        group = _together(chosen[0], chosen)
        stories.append(_make_story(group, spans, events, topics))
        chosen = [span for span in chosen if span not in group]
    stories.sort(key=lambda story: story.since)
    if at is None:
        return _without_parts(stories)
    held = [story for story in stories if story.since <= at and (story.until is None or at <= story.until)]
    return held or [story for story in stories if story.since <= at][-1:] or stories[:1]


def _is_alarm(event: Event) -> bool:
    """Return True for PX4's text about a failed sensor, or of severity critical and worse while armed."""
    is_critical = event.severity == "bad" and "armed" in event.numbers
    return event.kind == "text" and (is_critical or _SENSOR_FAILURE.search(event.text) is not None)


def story_of(
    event: Event, events: Sequence[Event], conditions: Iterable[Condition] = (), *, topics: Collection[str] = ()
) -> Story | None:
    """Return the story of a single event, or of the condition that an event begins or ends."""
    spans = spans_of(events, conditions)
    ends = ((span, each) for span in spans for each in (span.begin, span.end) if each is not None)
    span = next((span for span, each in ends if each.identity == event.identity), None)
    return None if span is None else _make_story(_together(span, spans), spans, events, topics)


def spans_of(events: Sequence[Event], conditions: Iterable[Condition] = ()) -> list[Span]:
    """Return the conditions and single events of one vehicle as spans, ordered by start.

    `conditions`: active or initial conditions, added if their start is not among the events.
    """
    known = {event.identity for event in events}
    unreported = [
        Span(each.kind, each.severity, each.text, each.since, each.begin, each.initial)
        for each in conditions
        if each.begin.identity not in known
    ]
    spans: list[Span] = []
    active: dict[tuple[str, str], Span] = {}  # by kind and flag

    def end(keys: Iterable[tuple[str, str]], event: Event) -> None:
        ended = dict.fromkeys([active.pop(key) for key in keys if key in active])
        spans.extend(replace(span, until=event.time, end=event) for span in ended)

    def order(step: Event | Span) -> tuple[float, bool, bool]:  # at equal times: reboots, initial conditions, others
        return (step.since, True, False) if isinstance(step, Span) else (step.time, step.kind != "reboot", True)

    steps: list[Event | Span] = [*events, *(each for each in unreported if each.initial)]
    for step in sorted(steps, key=order):
        event = step.begin if isinstance(step, Span) else step
        keys = [(step.kind, flag) for flag in KINDS[step.kind].conditions(event.names)]
        if isinstance(step, Span):
            active |= dict.fromkeys(keys, step)
        elif step.change == "end":
            end(keys, step)
        elif step.change == "once":
            spans.append(Span(step.kind, step.severity, step.text, step.time, step, until=step.time))
            if step.kind == "reboot":
                end([key for key in active if not KINDS[key[0]].kept_on_reboot], step)
        elif step.kind != "duplicate" or keys[0] not in active:  # each service that publishes the vehicle reports it
            end([*keys, *([("silent", "")] if step.kind == "gone" else [])], step)
            since = step.time - (step.numbers.get("age", 0.0) if step.kind in ("silent", "gone") else 0.0)
            active |= dict.fromkeys(keys, Span(step.kind, step.severity, step.text, since, step))
    spans += dict.fromkeys(active.values())
    spans += [each for each in dict.fromkeys(unreported) if not each.initial]
    return sorted(spans, key=lambda span: span.since)


def state_at(spans: Iterable[Span], time: float) -> State:
    """Return the state of the vehicle at `time`."""
    return state_of(span for span in spans if span.holds(time))


def _make_story(
    group: Sequence[Span], spans: Iterable[Span], events: Sequence[Event], topics: Collection[str]
) -> Story:
    """Return the story of a group of conditions; start and evidence are those of the first one."""
    span = group[0]
    until = None if any(each.until is None for each in group) else max(each.until or 0.0 for each in group)
    end = next((each.end for each in group if each.end is not None and each.until == until), None)
    what = "; ".join(dict.fromkeys(each.begin.words if each.kind == "text" else each.text for each in group))
    if all(each.text.endswith(_INVALID) for each in group):
        what = what.replace(f"{_INVALID}; ", " and ")
    used = {event for each in group for event in (each.begin, each.end) if event is not None}

    def unused(found: Iterable[Event]) -> list[Event]:
        new = [each for each in found if each not in used]
        used.update(new)
        return new

    near = [each for each in events if span.since - WINDOW <= each.time <= span.since]
    held = (s for s in spans if s.initial == span.initial and s.since <= span.since < (s.until or math.inf))
    before = unused(explain(span.begin, [] if span.initial else near, held))
    if not before and not span.initial:
        before = unused(e for e in near if e.change != "end" and not (KINDS[e.kind].phase and e.severity == "info"))
    after = unused(explain(end, events)) if end else []
    begun = (each for each in events if each.change != "end" and (each.severity != "info" or each.kind == "mode"))
    notable = [each for each in begun if each not in used]
    stop = math.inf if until is None else until
    after += [each for each in notable if stop <= each.time <= stop + TOGETHER and each.change == "once"]
    lacking: list[str] = []
    if span.is_of_estimate and span.severity != "info":
        needed = (each for name, each in EVIDENCE.items() if name not in _UNNEEDED)
        lacking = [each[0] for each in needed if set(each).isdisjoint(topics)]
    return Story(
        tuple(group), what, span.since, until, None if span.initial else span.begin, end, tuple(before),
        tuple(each for each in notable if span.since <= each.time < stop), tuple(after), tuple(lacking),
    )  # fmt: skip


def _without_parts(stories: Sequence[Story]) -> list[Story]:
    """Drop stories that are part of an earlier bad story, or evidence for a bad story."""
    kept: list[Story] = []
    for story in stories:
        if not any(_is_part(story, each) for each in kept):
            kept.append(story)
    causes = {event for story in kept if story.is_bad for event in story.before}
    return [story for story in kept if story.is_bad or story.spans[0].begin not in causes]


def _is_part(story: Story, of: Story) -> bool:
    """Return True if a story is part of a bad one; not if it is still active, or bad and more important or longer."""
    begin, kind = story.spans[0].begin, story.spans[0].kind
    if not of.is_bad or begin not in (*of.before, *of.meanwhile, *of.after):
        return False
    is_bad_estimate = story.is_bad and story.spans[0].is_of_estimate
    outlasts = of.until is not None and (story.until is None or (is_bad_estimate and story.until > of.until + TOGETHER))
    is_worse = story.is_bad and importance(kind) < importance(of.spans[0].kind)
    return not (outlasts or is_worse)


def _together(span: Span, spans: Iterable[Span]) -> list[Span]:
    """Return all spans of one story: `span`, and losses of validity at the same time or similar initial conditions."""

    def is_part(each: Span) -> bool:
        if KINDS[span.kind].validity:
            return KINDS[each.kind].validity and abs(each.since - span.since) <= TOGETHER
        return span.initial and each.initial and each.severity == span.severity == "watch"

    return [span, *(each for each in spans if each is not span and is_part(each))]
