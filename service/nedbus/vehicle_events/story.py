"""Stories for `nedbus why`: each fault with its period, evidence, and missing topics that may hold more evidence."""

import math
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from .event import LATE, WINDOW, Condition, Event, State, explain, rank, state_of, without_wild
from .kinds import KINDS
from .rules import AID_SOURCES, EVIDENCE, RECENT, VISION
from .times import Times

TOGETHER: Final = 1.0  # s; maximum time between the starts of conditions of one story
_INVALID: Final = " not valid"
_TOPICS_OF_VISION: Final = {*VISION, *(topic for topic in AID_SOURCES if "_ev_" in topic)}
# EVIDENCE that does not explain an invalid estimate
_UNNEEDED: Final = ("barometer", "magnetometer", "battery")
# PX4's "MAG #0 failed: STALE!", and its event for it
_SENSOR_FAILURE: Final = re.compile(r"#\d+ fail(ed|ure):")


class Period(NamedTuple):
    """A period on the event log's clock [s]."""

    begin: float
    end: float


class _Key(NamedTuple):
    """A condition: its kind, and its flag, "" for a kind without flags."""

    kind: str
    flag: str


@dataclass(frozen=True, slots=True)
class Span(Condition):
    """A condition and its end: the time `until` and the event `end`, both None while the condition is active."""

    until: float | None = None
    end: Event | None = None

    @property
    def stop(self) -> float:
        """The time of its end; infinite while it is active."""
        if self.until is None:
            return math.inf
        return self.until

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
        is_single = self.until == self.since
        if is_single:
            stop = self.since + RECENT
        else:
            stop = self.stop
        return self.since <= time < stop

    def is_active(self, time: float) -> bool:
        """Return True if the condition is active at `time`; a single event never is."""
        return self.since <= time < self.stop


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
    def stop(self) -> float:
        """The time of its end; infinite while it is active."""
        if self.until is None:
            return math.inf
        return self.until

    @property
    def is_bad(self) -> bool:
        """True if any of its conditions is bad."""
        return any(span.severity == "bad" for span in self.spans)

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
        if self.until is None:
            until = now
        else:
            until = self.until
        return times.period(self._dated_begin(), self.end, until - self.since)

    def _dated_begin(self) -> Event | None:
        """Return the event that began the fault at the fault's own time: silence is detected later."""
        begin = self.begin
        if begin is None or begin.time == self.since:
            return begin
        boot = begin.boot
        if boot is not None:
            boot -= begin.time - self.since
        return replace(begin, time=self.since, boot=boot)

    def is_in(self, periods: Sequence[Period]) -> bool:
        """Return True if it lasted into one of these periods."""
        return any(period.begin <= self.stop and self.since <= period.end for period in periods)


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
    remaining = sorted(faults, key=lambda span: rank(span, span.until))
    flights = _flights(events)
    stories: list[Story] = []
    while remaining:
        group = _together(remaining[0], remaining)
        story = _make_story(group, spans, events, topics)
        if flights and not story.is_in(flights):
            story = replace(story, in_flight=False)
        stories.append(story)
        remaining = [span for span in remaining if span not in group]
    if at is not None:
        stories = _stories_at(at, stories)
    return sorted(_without_parts(stories), key=lambda story: story.since)


def _stories_at(time: float, stories: Iterable[Story]) -> list[Story]:
    """Return the stories active at a time, else the last one before, else the first."""
    ordered = sorted(stories, key=lambda story: story.since)
    begun = [story for story in ordered if story.since <= time]
    active = [story for story in begun if time <= story.stop]
    if active:
        return active
    if begun:
        return begun[-1:]
    return ordered[:1]


def events_outside(stories: Iterable[Story], events: Iterable[Event]) -> list[Event]:
    """Return the events of severity bad and watch that are in no story: texts of PX4."""
    told = set[Event]()
    for story in stories:
        told.update(story.before, story.meanwhile, story.after)
        told.update(span.begin for span in story.spans)
    notable = [event for event in without_wild(events) if event.severity != "info"]
    return [event for event in notable if event not in told]


def is_alarm(event: Event) -> bool:
    """Return True for PX4's text about a failed sensor, or of severity critical and worse while armed."""
    if event.kind != "text":
        return False
    is_critical = event.severity == "bad" and "armed" in event.numbers
    return is_critical or _SENSOR_FAILURE.search(event.text) is not None


def _is_fault(span: Span) -> bool:
    if span.kind == "text":
        return is_alarm(span.begin)
    # as the invalid estimate of a vehicle that boots
    has_ended_early = span.initial and span.end is not None
    return span.severity != "info" and not span.is_usual and not has_ended_early


def _as_fault(span: Span) -> Span:
    """Return a text as a watch condition: PX4 reports a failure, but the estimate may be sound."""
    if span.kind != "text":
        return span
    return replace(span, severity="watch")


def story_of(
    event: Event,
    events: Sequence[Event],
    conditions: Iterable[Condition] = (),
    *,
    topics: Collection[str] = (),
) -> Story | None:
    """Return the story of a single event, or of the condition that an event begins or ends."""
    spans = spans_of(events, conditions)
    for span in spans:
        if span.end is None:
            ends = [span.begin]
        else:
            ends = [span.begin, span.end]
        if event.identity in [end.identity for end in ends]:
            return _make_story(_together(span, spans), spans, events, topics)
    return None


def spans_of(events: Sequence[Event], conditions: Iterable[Condition] = ()) -> list[Span]:
    """Return the conditions and single events of one vehicle as spans, ordered by start.

    `conditions`: active or initial conditions, added if their start is not among the events.
    """
    reported = {event.identity for event in events}
    unreported = [
        _span_of(condition) for condition in conditions if condition.begin.identity not in reported
    ]
    initial = [span for span in unreported if span.initial]
    later = [span for span in unreported if not span.initial]
    steps: list[Event | Span] = [*events, *initial]
    history = _History()
    for step in sorted(steps, key=_order_of_step):
        if isinstance(step, Span):
            history.hold(step)
        else:
            history.add(step)
    spans = [*history.ended, *history.active, *dict.fromkeys(later)]
    return sorted(spans, key=lambda span: span.since)


def _span_of(condition: Condition) -> Span:
    return Span(
        condition.kind,
        condition.severity,
        condition.text,
        condition.since,
        condition.begin,
        condition.initial,
    )


def _order_of_step(step: Event | Span) -> tuple[float, int]:
    """Return a sort key: at equal times reboots, then initial conditions, then other events."""
    if isinstance(step, Span):
        return step.since, 1
    if step.kind == "reboot":
        return step.time, 0
    return step.time, 2


class _History:
    """Conditions of a vehicle while its events are replayed.

    `ended`: the spans that have ended, and single events.
    """

    def __init__(self) -> None:
        self.ended: list[Span] = []
        self._active: dict[_Key, Span] = {}

    @property
    def active(self) -> list[Span]:
        """The active spans, each once."""
        return [*dict.fromkeys(self._active.values())]

    def hold(self, span: Span) -> None:
        """Add a condition that is active from here on."""
        for key in _keys_of(span.kind, span.begin.names):
            self._active[key] = span

    def add(self, event: Event) -> None:
        """Begin, end or add what an event reports."""
        if event.change == "end":
            self._end(_keys_of(event.kind, event.names), event)
        elif event.change == "once":
            self._add_single(event)
        else:
            self._begin(event)

    def _add_single(self, event: Event) -> None:
        span = Span(
            event.kind,
            event.severity,
            event.text,
            event.time,
            event,
            until=event.time,
        )
        self.ended.append(span)
        if event.kind == "reboot":
            lost = [key for key in self._active if not KINDS[key.kind].kept_on_reboot]
            self._end(lost, event)

    def _begin(self, event: Event) -> None:
        keys = _keys_of(event.kind, event.names)
        if event.kind == "duplicate" and keys[0] in self._active:
            return  # each service that publishes the vehicle reports it
        self._end(keys, event)
        if event.kind == "gone":
            self._end([_Key("silent", "")], event)
        since = event.time
        if event.kind in ("silent", "gone"):
            since -= event.numbers.get("age", 0.0)
        self.hold(Span(event.kind, event.severity, event.text, since, event))

    def _end(self, keys: Iterable[_Key], event: Event) -> None:
        spans = [self._active.pop(key) for key in keys if key in self._active]
        for span in dict.fromkeys(spans):
            self.ended.append(replace(span, until=event.time, end=event))


def _keys_of(kind: str, flags: tuple[str, ...]) -> list[_Key]:
    return [_Key(kind, flag) for flag in KINDS[kind].conditions(flags)]


def state_at(spans: Iterable[Span], time: float) -> State:
    """Return the state of the vehicle at `time`."""
    return state_of(span for span in spans if span.holds(time))


def _flights(events: Iterable[Event]) -> list[Period]:
    """Return the flights: from take-off, or from arming if the data has none, to disarming or a reboot.

    A landing is no end: a failed estimate can cause a false one in the air. Without an arming and a disarming in the
    data, the flight is as long as the data.
    """
    flights: list[Period] = []
    armed: float | None = None
    took_off: float | None = None
    for event in events:
        if event.kind == "armed":
            armed = event.time
        elif event.kind == "takeoff" and took_off is None:
            took_off = event.time
        elif event.kind == "disarmed" or (event.kind == "reboot" and armed is not None):
            flights.append(Period(_begin_of_flight(armed, took_off), event.time))
            armed = None
            took_off = None
    is_flying = armed is not None or took_off is not None
    if is_flying or not flights:
        flights.append(Period(_begin_of_flight(armed, took_off), math.inf))
    return flights


def _begin_of_flight(armed: float | None, took_off: float | None) -> float:
    if took_off is not None:
        return took_off
    if armed is not None:
        return armed
    return -math.inf  # before the data


def _make_story(
    group: Sequence[Span],
    spans: Iterable[Span],
    events: Sequence[Event],
    topics: Collection[str],
) -> Story:
    """Return the story of a group of conditions; start and evidence are those of the first one."""
    span = group[0]
    stop = max(member.stop for member in group)
    ends = [member.end for member in group if member.end is not None]
    last = [end for end in ends if end.time == stop]
    end = None
    if last:
        end = last[0]
    begins = [member.begin for member in group]
    used = {*begins, *ends}
    before = [event for event in _evidence(span, spans, events) if event not in used]
    used.update(before)
    after: list[Event] = []
    if end is not None:
        after = [event for event in explain(end, events) if event not in used]
        used.update(after)
    notable = [event for event in events if _is_notable(event) and event not in used]
    for event in notable:
        if event.change == "once" and stop <= event.time <= stop + TOGETHER:
            after.append(event)
    meanwhile = [event for event in notable if span.since <= event.time < stop]
    return Story(
        spans=tuple(group),
        what=_text_of(group),
        since=span.since,
        until=None if math.isinf(stop) else stop,
        begin=None if span.initial else span.begin,
        end=end,
        before=tuple(before),
        meanwhile=tuple(meanwhile),
        after=tuple(after),
        lacking=_lacking(span, topics),
    )


def _is_notable(event: Event) -> bool:
    """Return True for a start or a single event that is not routine, and for a change of the flight mode."""
    if event.change == "end":
        return False
    return event.severity != "info" or event.kind == "mode"


def _text_of(group: Sequence[Span]) -> str:
    texts = [span.begin.words if span.kind == "text" else span.text for span in group]
    text = "; ".join(dict.fromkeys(texts))
    if all(span.text.endswith(_INVALID) for span in group):
        return text.replace(f"{_INVALID}; ", " and ")
    return text


def _evidence(span: Span, spans: Iterable[Span], events: Sequence[Event]) -> list[Event]:
    """Return the possible causes of a condition; without any, all other starts of the ten seconds before it."""
    held = [other for other in spans if other.is_active(span.since)]
    if span.initial:
        return explain(span.begin, (), [other for other in held if other.initial])
    near = [event for event in events if span.since - WINDOW <= event.time <= span.since + LATE]
    near = _without_texts_before_arming(near, span.since)
    causes = _causes_of(span, spans, near, held)
    if span.kind == "text":
        causes = _with_texts(causes, near, span.since)
    return causes or _other_starts(span, near)


def _causes_of(
    span: Span, spans: Iterable[Span], near: Sequence[Event], held: Sequence[Span]
) -> list[Event]:
    """Return the possible causes of a condition: no text of PX4 after its start, nothing that had recovered."""
    recovered = {other.begin for other in spans if _has_recovered(other, span.since)}
    causes = explain(replace(span.begin, time=span.since), near, held, late=LATE)
    in_time = [cause for cause in causes if cause.kind != "text" or cause.time <= span.since]
    return [cause for cause in in_time if cause not in recovered]


def _with_texts(causes: Sequence[Event], near: Iterable[Event], until: float) -> list[Event]:
    """Return the possible causes of an alarm with the texts of PX4 before it."""
    texts = [event for event in near if event.kind == "text" and event.severity != "info"]
    before = [event for event in (*causes, *texts) if event.time <= until]
    return sorted(before, key=lambda event: event.time)


def _has_recovered(span: Span, time: float) -> bool:
    """Return whether a condition ended well before a time."""
    return span.end is not None and span.stop < time - TOGETHER


def _other_starts(span: Span, near: Iterable[Event]) -> list[Event]:
    """Return the starts before a condition that no kind relates to it: the notable ones, else all but routine."""
    starts = [event for event in near if event.change != "end" and event.time < span.since]
    starts = [event for event in starts if event is not span.begin]
    notable = [event for event in starts if event.severity != "info"]
    return notable or [event for event in starts if not _is_routine(event)]


def _without_texts_before_arming(events: Sequence[Event], time: float) -> list[Event]:
    """Leave out the texts of failed checks before the arming that precedes `time`: they no longer hold then."""
    armings = [event.time for event in events if event.kind == "armed" and event.time <= time]
    armed = max(armings, default=-math.inf)
    return [
        event for event in events if event.kind != "text" or event.time >= armed or is_alarm(event)
    ]


def _is_routine(event: Event) -> bool:
    return KINDS[event.kind].phase or event.is_minor


def _lacking(span: Span, topics: Collection[str]) -> tuple[str, ...]:
    """Return the topics that may explain a fault of the estimate, but are missing from the data."""
    if not span.is_of_estimate or span.severity == "info" or span.kind == "origin_contradicted":
        return ()
    lacking = []
    for name, choices in EVIDENCE.items():
        if name in _UNNEEDED or not set(choices).isdisjoint(topics):
            continue
        if name == "GPS" and not _TOPICS_OF_VISION.isdisjoint(topics):
            continue  # a flight with vision needs none
        lacking.append(choices[0])
    return tuple(lacking)


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
    if _outlasts(story, worse):
        return False
    begin = story.spans[0].begin
    if begin in worse.before and story.kind in KINDS[worse.kind].causes:
        return True
    is_during = begin in (*worse.meanwhile, *worse.after)
    return is_during and _is_consequence(story, worse)


def _is_consequence(story: Story, worse: Story) -> bool:
    """Return True if a story that begins during a worse one is no fault beside it."""
    is_consequence = worse.kind in KINDS[story.kind].causes
    if not worse.is_bad:
        return is_consequence and not KINDS[story.kind].correction
    if is_consequence:
        return True
    if story.kind == "text":
        return _SENSOR_FAILURE.search(story.spans[0].begin.text) is None
    return not story.is_bad


def _outlasts(story: Story, worse: Story) -> bool:
    """Return True if a story lasts until now, or is a bad one of the estimate that lasts longer than another."""
    if story.until is None:
        return worse.until is not None
    is_bad_estimate = story.is_bad and story.spans[0].is_of_estimate
    return is_bad_estimate and story.until > worse.stop + TOGETHER


def _together(span: Span, spans: Iterable[Span]) -> list[Span]:
    """Return all spans of one story: `span`, and losses of validity at the same time or similar initial conditions."""

    def is_part(other: Span) -> bool:
        if KINDS[span.kind].validity:
            return KINDS[other.kind].validity and abs(other.since - span.since) <= TOGETHER
        if not (span.initial and other.initial):
            return False
        return span.severity == "watch" and other.severity == "watch"

    others = [other for other in spans if other is not span and is_part(other)]
    return [span, *others]
