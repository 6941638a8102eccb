"""The answer to "why": what was wrong, since when, for how long, what precedes it, and what the data do not have."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from .event import WINDOW, Condition, Event, Severity, State, explain, state_of
from .rules import OUTLIVING, RECENT, RULES

_TOGETHER: Final = 1.0  # s within which conditions that begin are one story
_HEADS: Final = (
    "gone", "silent", "xy_invalid", "z_invalid", "v_xy_invalid", "v_z_invalid", "failsafe", "battery", "reboot",
)  # fmt: skip
_GPS: Final = "vehicle_gps_position"
_EVIDENCE: Final = (_GPS, "estimator_status_flags", "vehicle_status", "failsafe_flags")
"""The topics that tell why an estimate is not valid."""

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
    end: Event | None = None
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
        """True if it keeps the vehicle from its task."""
        return self.begin is None or self.begin.severity == "bad"

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics of its evidence."""
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
    spans = [span for span in spans if span.begin is not None or span.end is None]  # not what was so at the start only
    chosen = [span for span in spans if span.kind in _HEADS]
    if not chosen or (at is not None and not any(_holds(span, at) for span in chosen)):
        chosen += [span for span in spans if span.begin and span.severity != "info" and span.kind not in _HEADS]
    stories: list[Story] = []
    left = sorted(chosen, key=lambda each: _HEADS.index(each.kind) if each.kind in _HEADS else len(_HEADS))
    while left:
        group = _together(left[0], left)
        stories.append(_tell_one(left[0], group, spans, events, topics))
        left = [span for span in left if span not in group]
    stories.sort(key=lambda story: story.since)
    if at is None:
        return _without_parts(stories)
    held = [story for story in stories if story.since <= at and (story.until is None or at <= story.until)]
    return held or [story for story in stories if story.since <= at][-1:] or stories[:1]


def about(event: Event, events: Sequence[Event], *, topics: Collection[str] = ()) -> Story | None:
    """Return the story of one event: of what it began, or ended, or of what happened once."""
    spans = spans_of(events)
    span = next((each for each in spans if event in (each.begin, each.end)), None)
    return None if span is None else _tell_one(span, _together(span, spans), spans, events, topics)


def spans_of(events: Sequence[Event], conditions: Iterable[Condition] = ()) -> list[Span]:
    """Return the conditions of one vehicle from begin to end, and what happened once, in the order of their begin.

    `conditions`: those that may have held at the first message already, of which `initial` is looked at.
    """
    known = list(conditions)
    told = {_identity(event) for event in events}
    ended: list[Span] = []
    going: dict[tuple[str, str, bool], Span] = {}  # by kind, flag, and whether it held at the first message
    for each in known:
        if each.initial:
            span = Span(each.kind, each.severity, each.since, None, each.text, None, first=each)
            going |= dict.fromkeys([(each.kind, flag, True) for flag in each.begin.names or ("",)], span)

    def end(keys: Iterable[tuple[str, str, bool]], event: Event) -> None:
        spans = dict.fromkeys([going.pop(key) for key in keys])
        ended.extend(replace(span, until=event.time, end=event) for span in spans)

    for event in events:
        flags = event.names if event.kind in _FLAGGED else ("",)
        if event.change == "once":
            ended.append(Span(event.kind, event.severity, event.time, event.time, event.text, event))
            if event.kind == "reboot":  # begins anew
                old = [key for key in going if key[0] not in OUTLIVING or key[2]]
                end([key for key in old if not key[2] or going[key].since < event.time], event)
        elif event.change == "begin":
            if event.kind == "gone":
                end([key for key in going if key == ("silent", "", False)], event)
            since = event.time - (event.numbers.get("age", 0.0) if event.kind in ("silent", "gone") else 0.0)
            span = Span(event.kind, event.severity, since, None, event.text, event)
            going |= dict.fromkeys([(event.kind, flag, False) for flag in flags], span)
        else:
            end([key for key in going if key[0] == event.kind and (key[2] or key[1] in flags)], event)
    ended += [
        span for span in dict.fromkeys(going.values()) if span.first is None or _identity(span.first.begin) not in told
    ]
    ended += [
        Span(each.kind, each.severity, each.since, None, each.text, each.begin, first=each)
        for each in known
        if not each.initial and _identity(each.begin) not in told
    ]
    return sorted(ended, key=lambda span: span.since)


def state_at(spans: Iterable[Span], time: float) -> State:
    """Return the state of a vehicle at a time, by all that was wrong with it before and after."""
    return state_of(
        Condition(span.kind, span.severity, span.text, span.since, begin, span.first is not None)
        for span in spans
        if _holds(span, time)
        and (begin := span.begin or (span.first.begin if span.first is not None else span.end)) is not None
    )


def _tell_one(
    span: Span, group: Sequence[Span], spans: Sequence[Span], events: Sequence[Event], topics: Collection[str]
) -> Story:
    until = None if any(each.until is None for each in group) else max(each.until or 0.0 for each in group)
    words = list(dict.fromkeys(each.text for each in group))
    if len(words) > 1 and all(word.endswith(" not valid") for word in words):
        words = [" and ".join(word.removesuffix(" not valid") for word in words) + " not valid"]
    used = {each.begin for each in group} | {each.end for each in group}
    before: list[Event] = []
    if span.begin is not None:
        near = [each for each in events if span.since - WINDOW <= each.time <= span.since]
        held = [
            Condition(other.kind, other.severity, other.text, other.since, other.begin)
            for other in spans
            if other.begin and other.since <= span.since and (other.until is None or other.until > span.since)
        ]
        before = [each for each in explain(span.begin, near, held) if each not in used]
    used.update(before)
    end = next((each.end for each in group if each.end is not None and each.until == until), None)
    after = [each for each in explain(end, events) if each not in used] if end else []
    used.update(after)
    notable = [each for each in events if each not in used and _is_notable(each)]
    if until is not None:
        after += [each for each in notable if until <= each.time <= until + _TOGETHER and each.change == "once"]
    meanwhile = [each for each in notable if span.since <= each.time and (until is None or each.time < until)]
    lacking: list[str] = []
    if span.kind.endswith("_invalid") or span.kind in ("dead_reckoning", "reset", "jump"):
        has_gps = not {"sensor_gps", "vehicle_gps_position"}.isdisjoint(topics)
        lacking = [each for each in _EVIDENCE if each not in topics and not (has_gps and each == _GPS)]
    return Story(
        "; ".join(words), span.since, until, span.begin, end, tuple(before), tuple(meanwhile), tuple(after),
        tuple(lacking),
    )  # fmt: skip


def _without_parts(stories: Sequence[Story]) -> list[Story]:
    """Return the stories that are not told as part of something bad that began before."""
    kept: list[Story] = []
    for story in stories:
        parts = {event for each in kept if each.is_bad for event in (*each.meanwhile, *each.after)}
        if story.begin not in parts:
            kept.append(story)
    causes = {event for story in kept if story.is_bad for event in story.before}
    return [story for story in kept if story.is_bad or story.begin not in causes]


def _together(span: Span, spans: Iterable[Span]) -> list[Span]:
    """Return a span, and those that are one story with it: parts of an estimate that are not valid any more."""
    return [
        each
        for each in spans
        if each is span
        or (
            each.kind.endswith("_invalid")
            and span.kind.endswith("_invalid")
            and abs(each.since - span.since) <= _TOGETHER
        )
    ]


def _holds(span: Span, at: float) -> bool:
    """Return whether a condition holds at a time, or something that happened once is recent."""
    until = math.inf if span.until is None else span.until + RECENT if span.since == span.until else span.until
    return span.since <= at < until


def _is_notable(event: Event) -> bool:
    return event.change != "end" and (event.severity != "info" or event.kind == "mode")


def _identity(event: Event) -> tuple[object, ...]:
    return event.kind, event.time, event.names
