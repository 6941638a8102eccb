"""The answer to "why": what was wrong, since when, for how long, what precedes it, and what the data do not have."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from .event import WINDOW, Condition, Event, Severity, State, explain, state_of
from .rules import OUTLIVING, RECENT, RULES

_TOGETHER: Final = 1.0  # s within which conditions that begin are one story
_HEADS: Final = (
    "gone", "silent", "xy_invalid", "z_invalid", "v_xy_invalid", "v_z_invalid", "failsafe", "battery", "reboot",
)  # fmt: skip
_EVIDENCE: Final = {
    "SensorGps": "vehicle_gps_position", "EstimatorStatusFlags": "estimator_status_flags",
    "VehicleStatus": "vehicle_status", "FailsafeFlags": "failsafe_flags",
}  # fmt: skip
"""The messages that tell why an estimate is not valid, each with the topic to look for."""

_FLAGGED: Final = frozenset(rule.kind for rules in RULES.values() for rule in rules)  # their events name flags


@dataclass(frozen=True, slots=True)
class Span:
    """A condition from its begin to its end; `begin` is None where it held at the `first` message already."""

    kind: str
    severity: Severity
    since: float
    until: float | None
    text: str
    begin: Event | None
    end: Event | None
    first: Condition | None = None


@dataclass(frozen=True, slots=True)
class Story:
    """One thing that was wrong with a vehicle.

    `what`: in words. `since`, `until`: by the account's clock; `until` is None while it goes on.
    `begin`: the event that began it, None where it held at the first message already; `end`: the one that ended it.
    `before`: the evidence, oldest first; `meanwhile`: what else happened until its end; `after`: what came with its
    end. `lacking`: topics that would have evidence, and are not in the data.
    """

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
        """Whether it keeps the vehicle from its task."""
        return self.begin is None or self.begin.severity == "bad"

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics that the evidence is from."""
        told = [*self.before, *self.meanwhile, *self.after]
        return tuple(sorted({each.topic for each in told if each.topic}))


def tell(
    events: Sequence[Event],
    conditions: Iterable[Condition] = (),
    *,
    topics: Collection[str] = (),
    at: float | None = None,
) -> list[Story]:
    """Return what was wrong with one vehicle, in order, each with why; nothing if all was well.

    `events`: all of one vehicle, in order. `conditions`: what holds at their end, whether they tell its begin or not.
    `topics`: those of its messages. `at`: only what held then, or, if nothing did, the last thing before.
    """
    spans = spans_of(events, conditions)
    spans = [span for span in spans if span.begin is not None or span.end is None]  # what was so at the start only
    chosen = [span for span in spans if span.kind in _HEADS]
    if not chosen or (at is not None and not any(span.since <= at and _holds(span, at) for span in chosen)):
        chosen = [*chosen, *(span for span in spans if _is_watched(span))]
    stories: list[Story] = []
    told: set[int] = set()
    for span in sorted(chosen, key=lambda each: _HEADS.index(each.kind) if each.kind in _HEADS else len(_HEADS)):
        if id(span) in told:
            continue
        group = [
            each
            for each in chosen
            if abs(each.since - span.since) <= _TOGETHER and id(each) not in told and _is_alike(span, each)
        ]
        told.update(map(id, group))
        stories.append(_tell_one(span, group, spans, events, topics))
    stories.sort(key=lambda story: story.since)
    if at is None:
        stories = _without_parts(stories)
    if at is None or not stories:
        return stories
    held = [story for story in stories if story.since <= at and (story.until is None or at <= story.until)]
    return held or [story for story in stories if story.since <= at][-1:] or stories[:1]


def about(event: Event, events: Sequence[Event], *, topics: Collection[str] = ()) -> Story | None:
    """Return the story of one event: of what it began, or ended, or of what happened once."""
    spans = spans_of(events)
    span = next((each for each in spans if event in (each.begin, each.end)), None)
    if span is None:
        return None
    group = [each for each in spans if abs(each.since - span.since) <= _TOGETHER and _is_alike(span, each)]
    return _tell_one(span, group, spans, events, topics)


def _without_parts(stories: Sequence[Story]) -> list[Story]:
    """Return the stories that are not told as part of something bad that began before."""
    kept: list[Story] = []
    for story in stories:
        parts = {event for each in kept if each.is_bad for event in (*each.meanwhile, *each.after)}
        if story.begin not in parts:
            kept.append(story)
    causes = {event for story in kept if story.is_bad for event in story.before}
    return [story for story in kept if story.is_bad or story.begin not in causes]


def _tell_one(
    span: Span, group: Sequence[Span], spans: Sequence[Span], events: Sequence[Event], topics: Collection[str]
) -> Story:
    until = None if any(each.until is None for each in group) else max(each.until or 0.0 for each in group)
    words = list(dict.fromkeys(each.text for each in group))
    if len(words) > 1 and all(word.endswith(" not valid") for word in words):
        words = [" and ".join(word.removesuffix(" not valid") for word in words) + " not valid"]
    heads = {each.begin for each in group} | {each.end for each in group}
    before: list[Event] = []
    if span.begin is not None:
        same = [each for each in events if span.since - WINDOW <= each.time <= span.since]
        held = [
            Condition(other.kind, other.severity, other.text, other.since, other.begin)
            for other in spans
            if other.begin is not None
            and other.since <= span.since
            and (other.until is None or other.until > span.since)
        ]
        before = [each for each in explain(span.begin, same, held) if each not in heads]
    end = next((each.end for each in group if each.end is not None and each.until == until), None)
    notable = [each for each in events if each not in heads and each not in before and _is_notable(each)]
    meanwhile = [each for each in notable if span.since <= each.time and (until is None or each.time < until)]
    after = [each for each in explain(end, events) if each not in heads and each not in before] if end else []
    if until is not None:
        near = [each for each in notable if until <= each.time <= until + _TOGETHER and each.change == "once"]
        after += [each for each in near if each not in after]
    meanwhile = [each for each in meanwhile if each not in after]
    has = set(topics)
    lacking: tuple[str, ...] = ()
    if span.kind.endswith("_invalid") or span.kind in ("dead_reckoning", "reset", "jump"):
        names = dict(_EVIDENCE)
        if has & {"sensor_gps", "vehicle_gps_position"}:
            del names["SensorGps"]
        lacking = tuple(topic for topic in names.values() if topic not in has)
    return Story(
        "; ".join(words), span.since, until, span.begin, end, tuple(before), tuple(meanwhile), tuple(after), lacking
    )


def spans_of(events: Sequence[Event], conditions: Iterable[Condition] = ()) -> list[Span]:
    """Return the conditions of one vehicle from begin to end, and what happened once, in the order of their begin.

    `conditions`: those that may have held at the first message already, of which `initial` is looked at.
    """
    known = list(conditions)
    held = {(each.kind, flag): each for each in known if each.initial for flag in each.begin.names or ("",)}
    open_: dict[tuple[str, str], Event] = {}
    found: list[Span] = []
    for event in events:
        keys = [(event.kind, flag) for flag in (event.names if event.kind in _FLAGGED else ("",))]
        if event.change == "once":
            found.append(Span(event.kind, event.severity, event.time, event.time, event.text, event, None))
            if event.kind == "reboot":  # begins anew
                ended = dict.fromkeys(each for (kind, _), each in open_.items() if kind not in OUTLIVING)
                found += [_span(begin, event) for begin in ended]
                first = dict.fromkeys(each for each in held.values() if each.since < event.time)
                found += [_initial_span(each, event) for each in first]
                held = {key: each for key, each in held.items() if each not in first}
                open_ = {key: each for key, each in open_.items() if each not in ended}
        elif event.change == "begin":
            if event.kind == "gone" and (silent := open_.pop(("silent", ""), None)) is not None:
                found.append(_span(silent, event))
            open_.update(dict.fromkeys(keys, event))
        else:
            keys = [key for key in keys if key in open_]
            found += [_span(begin, event) for begin in dict.fromkeys(open_.pop(key) for key in keys)]
            over = dict.fromkeys(held.pop(key) for key in [key for key in held if key[0] == event.kind])
            found += [_initial_span(each, event) for each in over]
    found += [_span(begin, None) for begin in dict.fromkeys(open_.values())]
    told = {(each.kind, each.time, each.names) for each in events}
    found += [
        Span(each.kind, each.severity, each.since, None, each.text, None if each.initial else each.begin, None, each)
        for each in dict.fromkeys([*held.values(), *(each for each in known if not each.initial)])
        if (each.begin.kind, each.begin.time, each.begin.names) not in told
    ]
    return sorted(found, key=lambda span: span.since)


def state_at(spans: Iterable[Span], time: float) -> State:
    """Return the state of a vehicle at a time, by all that was wrong with it before and after."""
    held = [span for span in spans if span.since <= time and _holds(span, time)]
    return state_of(
        Condition(span.kind, span.severity, span.text, span.since, begin, span.first is not None)
        for span in held
        if (begin := span.begin or (span.first.begin if span.first is not None else span.end)) is not None
    )


def _initial_span(condition: Condition, end: Event) -> Span:
    return Span(condition.kind, condition.severity, condition.since, end.time, condition.text, None, end, condition)


def _span(begin: Event, end: Event | None) -> Span:
    since = begin.time - begin.numbers.get("age", 0.0) if begin.kind in ("silent", "gone") else begin.time
    return Span(begin.kind, begin.severity, since, None if end is None else end.time, begin.text, begin, end)


def _holds(span: Span, at: float) -> bool:
    """Return whether a condition goes on, or something that happened once is recent."""
    if span.until is None:
        return True
    return at < (span.until + RECENT if span.since == span.until else span.until)


def _is_watched(span: Span) -> bool:
    return span.begin is not None and span.severity != "info" and span.kind not in _HEADS


def _is_alike(one: Span, other: Span) -> bool:
    return one is other or (one.kind.endswith("_invalid") and other.kind.endswith("_invalid"))


def _is_notable(event: Event) -> bool:
    return event.change != "end" and (event.severity != "info" or event.kind == "mode")
