"""Stories for `nedbus why`: each fault with its period, evidence, and missing topics that may hold more evidence."""

import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from .event import LATE, WINDOW, Condition, Event, State, explain, rank, state_of, without_wild
from .kinds import KINDS
from .rules import AID_SOURCES, EVIDENCE, RECENT, VISION
from .times import Times

TOGETHER: Final = 1.0  # s; maximum time between the starts of conditions of one story
_INVALID: Final = " not valid"
# EVIDENCE that does not explain an invalid estimate
_UNNEEDED: Final = ("barometer", "magnetometer", "battery")
# PX4's "MAG #0 failed: STALE!", and its event for it
_SENSOR_FAILURE: Final = re.compile(r"#\d+ fail(ed|ure):")


@dataclass(frozen=True, slots=True)
class Span(Condition):
    """A condition and its end: the time `until` and the event `end`, both None while the condition is active."""

    until: float | None = None
    end: Event | None = None

    @property
    def is_of_estimate(self) -> bool:
        """True if it is a fault of the position estimate."""
        return KINDS[self.kind].message == "VehicleLocalPosition"

    @property
    def is_usual(self) -> bool:
        """True if it belongs to the flight, as the missing global reference of a flight without GNSS."""
        return self.initial and KINDS[self.kind].usual

    def holds(self, time: float) -> bool:
        """Return True if the condition is active at `time`, or the single event is recent."""
        if self.until is not None and self.until == self.since:
            return self.since <= time < self.until + RECENT
        return self.is_active(time)

    def is_active(self, time: float) -> bool:
        """Return True if the condition is active at `time`; a single event never is."""
        return self.since <= time and (self.until is None or time < self.until)


@dataclass(frozen=True, slots=True)
class Story:
    """One fault of a vehicle.

    `spans`: its conditions, the main one first. `what`: their text.
    `since`, `until`: times on the event log's clock [s]; `until` is None while it is active.
    `begin`: the event that began it, None if it was active in the first message. `end`: the event that ended it.
    `before`: the evidence, oldest first. `meanwhile`: other events during the fault. `after`: events at its end.
    `lacking`: topics that may hold evidence, but are missing from the data.
    `in_flight`: it lasted into a flight, or the data does not tell.
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
    in_flight: bool = True

    @property
    def is_bad(self) -> bool:
        """True if any of its conditions is bad."""
        return any(each.severity == "bad" for each in self.spans)

    @property
    def kind(self) -> str:
        """The kind of its main condition."""
        return self.spans[0].kind

    @property
    def rank(self) -> tuple[int, int, float]:
        """Sort key, worst first."""
        return rank(self.spans[0], self.until)

    @property
    def remark(self) -> str:
        """The text that no evidence was found; "" if there is some, or the fault began before the data."""
        if self.before or self.meanwhile or self.begin is None:
            return ""
        return f"no evidence in the {WINDOW:.0f} s before it"

    def has_ended(self, now: float) -> bool:
        """Return True if it is over, and not a single event of the last minute."""
        return not any(span.holds(now) for span in self.spans)

    def when(self, times: Times, now: float) -> str:
        """Format the period of the fault; `now`: the current time, or the end of the file."""
        begin = self.begin
        if begin is not None and begin.time != self.since:  # silence is detected later
            boot = None if begin.boot is None else begin.boot - (begin.time - self.since)
            begin = replace(begin, time=self.since, boot=boot)
        return times.period(
            begin, self.end, (now if self.until is None else self.until) - self.since
        )


def stories_of(
    events: Sequence[Event],
    conditions: Iterable[Condition] = (),
    *,
    topics: Collection[str] = (),
    at: float | None = None,
) -> list[Story]:
    """Return the stories of one vehicle in chronological order; [] if it has no faults.

    Each event of severity bad or watch, other than a text, begins a story or is in one: as one of its conditions, as
    evidence, or as an event during it or at its end. So does each text that `is_alarm`.

    `events`: all events of the vehicle, in order. `conditions`: conditions active after the last event.
    `topics`: published topics. `at`: return the stories active at this time, else the last one before, else the first.
    """
    events = without_wild(events)
    spans = spans_of(events, conditions)
    faults = [_as_fault(span) for span in spans if _is_fault(span)]
    chosen = sorted(faults, key=lambda span: rank(span, span.until))
    flights = [*_flights(events)]
    stories: list[Story] = []
    while chosen:
        group = _together(chosen[0], chosen)
        stories.append(_make_story(group, spans, events, topics, flights))
        chosen = [span for span in chosen if span not in group]
    if at is not None:
        stories.sort(key=lambda story: story.since)
        held = [
            story
            for story in stories
            if story.since <= at and (story.until is None or at <= story.until)
        ]
        stories = held or [story for story in stories if story.since <= at][-1:] or stories[:1]
    return sorted(_without_parts(stories), key=lambda story: story.since)


def events_outside(stories: Iterable[Story], events: Iterable[Event]) -> list[Event]:
    """Return the events of severity bad and watch that are in no story: texts of PX4."""
    told = set[Event]()
    for story in stories:
        told.update(story.before, story.meanwhile, story.after)
        for span in story.spans:
            told.add(span.begin)
    return [
        event for event in without_wild(events) if event.severity != "info" and event not in told
    ]


def is_alarm(event: Event) -> bool:
    """Return True for PX4's text about a failed sensor, or of severity critical and worse while armed."""
    is_critical = event.severity == "bad" and "armed" in event.numbers
    return event.kind == "text" and (is_critical or _SENSOR_FAILURE.search(event.text) is not None)


def _is_fault(span: Span) -> bool:
    if span.kind == "text":
        return is_alarm(span.begin)
    # as the invalid estimate of a vehicle that boots
    has_ended_early = span.initial and span.end is not None
    return span.severity != "info" and not span.is_usual and not has_ended_early


def _as_fault(span: Span) -> Span:
    """Return a text as a watch condition: PX4 reports a failure, but the estimate may be sound."""
    return replace(span, severity="watch") if span.kind == "text" else span


def story_of(
    event: Event,
    events: Sequence[Event],
    conditions: Iterable[Condition] = (),
    *,
    topics: Collection[str] = (),
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

    # at equal times: reboots, initial conditions, others
    def order(step: Event | Span) -> tuple[float, bool, bool]:
        return (
            (step.since, True, False)
            if isinstance(step, Span)
            else (step.time, step.kind != "reboot", True)
        )

    steps: list[Event | Span] = [*events, *(each for each in unreported if each.initial)]
    for step in sorted(steps, key=order):
        event = step.begin if isinstance(step, Span) else step
        keys = [(step.kind, flag) for flag in KINDS[step.kind].conditions(event.names)]
        if isinstance(step, Span):
            active |= dict.fromkeys(keys, step)
        elif step.change == "end":
            end(keys, step)
        elif step.change == "once":
            spans.append(
                Span(step.kind, step.severity, step.text, step.time, step, until=step.time)
            )
            if step.kind == "reboot":
                end([key for key in active if not KINDS[key[0]].kept_on_reboot], step)
        elif step.kind != "duplicate" or keys[0] not in active:
            # each service that publishes the vehicle reports it
            end([*keys, *([("silent", "")] if step.kind == "gone" else [])], step)
            since = step.time - (
                step.numbers.get("age", 0.0) if step.kind in ("silent", "gone") else 0.0
            )
            active |= dict.fromkeys(keys, Span(step.kind, step.severity, step.text, since, step))
    spans += dict.fromkeys(active.values())
    spans += [each for each in dict.fromkeys(unreported) if not each.initial]
    return sorted(spans, key=lambda span: span.since)


def state_at(spans: Iterable[Span], time: float) -> State:
    """Return the state of the vehicle at `time`."""
    return state_of(span for span in spans if span.holds(time))


def _flights(events: Iterable[Event]) -> Iterator[tuple[float, float]]:
    """Yield begin and end of each flight: from take-off, or from arming if the data has none, to disarming or a reboot.

    A landing is no end: a failed estimate can cause a false one in the air.
    """
    armed = took_off = None
    is_known = False
    for event in events:
        if event.kind == "armed":
            armed = event.time
        elif event.kind == "takeoff" and took_off is None:
            took_off = event.time
        elif event.kind == "disarmed" or (event.kind == "reboot" and armed is not None):
            begin = took_off if took_off is not None else armed
            yield -math.inf if begin is None else begin, event.time
            armed = took_off = None
            is_known = True
    begin = took_off if took_off is not None else armed
    if begin is not None or not is_known:
        yield -math.inf if begin is None else begin, math.inf


def _make_story(
    group: Sequence[Span], spans: Iterable[Span], events: Sequence[Event], topics: Collection[str],
    flights: Sequence[tuple[float, float]] = (),
) -> Story:  # fmt: skip
    """Return the story of a group of conditions; start and evidence are those of the first one."""
    span = group[0]
    until = (
        None
        if any(each.until is None for each in group)
        else max(each.until or 0.0 for each in group)
    )
    end = next((each.end for each in group if each.end is not None and each.until == until), None)
    used = {event for each in group for event in (each.begin, each.end) if event is not None}

    def unused(found: Iterable[Event]) -> list[Event]:
        new = [each for each in found if each not in used]
        used.update(new)
        return new

    before = unused(_evidence(span, spans, events))
    after = unused(explain(end, events)) if end else []
    stop = math.inf if until is None else until
    begun = (
        each
        for each in events
        if each.change != "end" and (each.severity != "info" or each.kind == "mode")
    )
    notable = [each for each in begun if each not in used]
    after += [
        each for each in notable if stop <= each.time <= stop + TOGETHER and each.change == "once"
    ]
    meanwhile = [each for each in notable if span.since <= each.time < stop]
    in_flight = not flights or any(begin <= stop and span.since <= end for begin, end in flights)
    return Story(
        tuple(group), _text_of(group), span.since, until, None if span.initial else span.begin, end, tuple(before),
        tuple(meanwhile), tuple(after), _lacking(span, topics), in_flight,
    )  # fmt: skip


def _text_of(group: Sequence[Span]) -> str:
    texts = [span.begin.words if span.kind == "text" else span.text for span in group]
    text = "; ".join(dict.fromkeys(texts))
    if all(span.text.endswith(_INVALID) for span in group):
        return text.replace(f"{_INVALID}; ", " and ")
    return text


def _evidence(span: Span, spans: Iterable[Span], events: Sequence[Event]) -> list[Event]:
    """Return the possible causes of a condition; without any, all other starts of the ten seconds before it."""
    held = [
        other
        for other in spans
        if (other.initial or not span.initial) and other.is_active(span.since)
    ]
    if span.initial:
        return explain(span.begin, (), held)
    recovered = {
        other.begin
        for other in spans
        if other.end is not None and other.until is not None and other.until < span.since - TOGETHER
    }
    near = [event for event in events if span.since - WINDOW <= event.time <= span.since + LATE]
    near = _without_texts_before_arming(near, span.since)
    causes = [
        cause
        for cause in explain(replace(span.begin, time=span.since), near, held, late=LATE)
        if not (cause.kind == "text" and cause.time > span.since) and cause not in recovered
    ]
    if span.kind == "text":
        causes += [event for event in near if event.kind == "text" and event.severity != "info"]
        causes = sorted(
            (cause for cause in causes if cause.time <= span.since), key=lambda cause: cause.time
        )
    if causes:
        return causes
    others = [
        event
        for event in near
        if event is not span.begin
        and event.change != "end"
        and event.time < span.since
        and (event.severity != "info" or not _is_routine(event))
    ]
    return [event for event in others if event.severity != "info"] or others


def _without_texts_before_arming(events: Sequence[Event], time: float) -> list[Event]:
    """Leave out the texts of failed checks before the arming that precedes `time`: they no longer hold then."""
    armed = max(
        (event.time for event in events if event.kind == "armed" and event.time <= time),
        default=-math.inf,
    )
    return [
        event for event in events if event.kind != "text" or event.time >= armed or is_alarm(event)
    ]


def _is_routine(event: Event) -> bool:
    return KINDS[event.kind].phase or event.is_minor


def _lacking(span: Span, topics: Collection[str]) -> tuple[str, ...]:
    """Return the topics that may explain a fault of the estimate, but are missing from the data."""
    if not span.is_of_estimate or span.severity == "info" or span.kind == "origin_contradicted":
        return ()
    needed = {name: choices for name, choices in EVIDENCE.items() if name not in _UNNEEDED}
    if not {*VISION, *(topic for topic in AID_SOURCES if "_ev_" in topic)}.isdisjoint(topics):
        del needed["GPS"]  # a flight with vision needs none
    return tuple(choices[0] for choices in needed.values() if set(choices).isdisjoint(topics))


def _without_parts(stories: Sequence[Story]) -> list[Story]:
    """Drop stories that are part of a worse one."""
    kept: list[Story] = []
    for story in sorted(stories, key=lambda story: story.rank):
        if not any(_is_part(story, worse) for worse in kept):
            kept.append(story)
    return kept


def _is_part(story: Story, worse: Story) -> bool:
    """Return True if a story is evidence for a worse one, or its consequence; not if it outlasts that.

    What corrected the estimate is a consequence only of a bad one.
    """
    begin = story.spans[0].begin
    is_bad_estimate = story.is_bad and story.spans[0].is_of_estimate
    outlasts = worse.until is not None and (
        story.until is None or (is_bad_estimate and story.until > worse.until + TOGETHER)
    )
    if outlasts:
        return False
    if begin in worse.before and story.kind in KINDS[worse.kind].causes:
        return True
    if begin not in (*worse.meanwhile, *worse.after):
        return False
    is_consequence = worse.kind in KINDS[story.kind].causes
    if not worse.is_bad:
        return is_consequence and not KINDS[story.kind].correction
    is_alarm_of_sensor = story.kind == "text" and _SENSOR_FAILURE.search(begin.text) is not None
    return is_consequence or (not is_alarm_of_sensor and (story.kind == "text" or not story.is_bad))


def _together(span: Span, spans: Iterable[Span]) -> list[Span]:
    """Return all spans of one story: `span`, and losses of validity at the same time or similar initial conditions."""

    def is_part(each: Span) -> bool:
        if KINDS[span.kind].validity:
            return KINDS[each.kind].validity and abs(each.since - span.since) <= TOGETHER
        return span.initial and each.initial and each.severity == span.severity == "watch"

    return [span, *(each for each in spans if each is not span and is_part(each))]
