"""Verdict on a vehicle in one or two sentences: usable or not, since when, for how long, and why."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final, NamedTuple

from nedbus.clock import format_duration

from .event import ALL, WINDOW, Condition, Event
from .kinds import KINDS, importance
from .position import large_part, short_text
from .rules import LARGE_CORRECTION, POSITIONS, SUBJECTS
from .story import TOGETHER, Story, is_alarm, stories_of
from .times import Times

_GLOBAL: Final = "vehicle_global_position"
_WIDTH: Final = 97  # columns next to a short vehicle name
_LINES: Final = 3
_MODULE: Final = re.compile(r'(?<=PX4: )"\[\w+\] ')  # the name of PX4's module before a text
_QUOTED: Final = 2  # texts of PX4 in the evidence
_NAMED: Final = 3  # other events in the evidence


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a vehicle.

    `text`: human-readable; names the clock of its times, and may quote text from the vehicle: escape it.
    `usable`: False if the fault kept the vehicle from its task, True if not; None if the data has no position validity.
    `begin`, `end`: events that began and ended the worst fault, None if it was active in the first or last message.
    `cause`: its evidence. `stories`: all faults. Both are in chronological order.
    `vehicle`, `times`, `checked`: the vehicle, the clock of its events, and the time to which the verdict refers: now,
    or the end of the file, on the clock of `event.time` [s]. `others`: PX4's texts that are in no story.
    """

    text: str
    usable: bool | None
    vehicle: str
    times: Times
    checked: float
    begin: Event | None = None
    end: Event | None = None
    cause: tuple[Event, ...] = ()
    stories: tuple[Story, ...] = ()
    others: tuple[Event, ...] = ()

    def period(self, story: Story) -> str:
        """Format the period of one of its stories, such as "from 14:05:01.2 UTC, until now (3.4 s)"."""
        return story.when(self.times, self.checked)


@dataclass(frozen=True, slots=True)
class _Parts:
    """The parts of a verdict's text; `render` joins as many as fit into three lines, each of them whole.

    `state`: the worst fault and its period. `evidence`: most important first. `missing`: topics that may hold more.
    `none`: says that there is no evidence. `others`: what else happened, most important first; `is_other_urgent`:
    the first of them is bad, or a large correction.
    """

    state: str
    evidence: tuple[Event, ...] = ()
    none: str = ""
    missing: str = ""
    others: tuple[str, ...] = ()
    is_other_urgent: bool = False

    def render(self, times: Times) -> str:
        """Return the text."""
        text = _Text(self, times)
        is_quoted_only = all(event.kind == "text" for event in self.evidence)
        first = 1 if is_quoted_only else 2
        text.add_evidence(self.evidence[:first])
        if self.is_other_urgent:
            text.add_others(self.others[:1])
        if is_quoted_only:
            text.add_missing()
        text.add_evidence(self.evidence)
        text.add_missing()
        text.add_others(self.others)
        return text.shortened


class _Text:
    """The text of a verdict, to which parts are added as long as it fits into three lines."""

    def __init__(self, parts: _Parts, times: Times) -> None:
        self._parts = parts
        self._times = times
        self._evidence: list[Event] = []
        self._missing = ""
        self._others: list[str] = []

    def add_evidence(self, events: Iterable[Event]) -> None:
        """Add the events that fit and are not in the text."""
        for event in events:
            if event in self._evidence:
                continue
            self._evidence.append(event)
            if not self._fits:
                self._evidence.pop()

    def add_others(self, parts: Iterable[str]) -> None:
        """Add the parts that fit and are not in the text."""
        for part in parts:
            if part in self._others:
                continue
            self._others.append(part)
            if not self._fits:
                self._others.pop()

    def add_missing(self) -> None:
        """Add the topics that are not in the data, if they fit."""
        self._missing = self._parts.missing
        if not self._fits:
            self._missing = ""

    @property
    def shortened(self) -> str:
        """The text, cut if the state alone is too long."""
        if self._fits:
            return str(self)
        return textwrap.shorten(str(self), _LINES * _WIDTH, placeholder="...")

    @property
    def _fits(self) -> bool:
        return len(textwrap.wrap(str(self), _WIDTH)) <= _LINES

    def __str__(self) -> str:
        sentences = [self._parts.state]
        if self._evidence:
            sentences.append(f"Evidence: {_listed(self._evidence, self._times)}.")
        elif self._parts.none:
            sentences.append(self._parts.none)
        if self._missing:
            sentences.append(self._missing)
        if self._others:
            sentences.append(f"Also {'; '.join(self._others)}.")
        return " ".join(sentences)


def _describe_unknown(topics: Collection[str]) -> str:
    """Describe data without the validity of positions."""
    text = "the data has no position validity"
    if set(POSITIONS).isdisjoint(topics) and _GLOBAL in topics:
        text += ", only a global position, as over a satellite link (HIGH_LATENCY2)"
    return text


def verdict_of(
    vehicle: str,
    events: Sequence[Event],
    held: Iterable[Condition] = (),
    *,
    topics: Collection[str],
    unknown: Collection[str] = (),
    times: Times,
    end: float,
    at: float | None = None,
    since: float | None = None,
    begin: float = 0.0,
) -> Verdict:
    """Return the verdict on a vehicle.

    `events`: events in chronological order; only those of this vehicle and of ALL are used. `held`: conditions active
    after the last event. `topics`: published topics. `unknown`: flags that its position does not provide.
    `end`: now, or the end of the file, on the event log's clock [s]. `at`: the time in question, None for all.
    `since`: time of the first position in live data, None if unknown. `begin`: the begin of the vehicle's file.
    """
    events = [event for event in events if event.vehicle in (vehicle, ALL)]
    held = list(held)
    stories = stories_of(events, held, topics=topics, at=at)
    has_validity = not set(POSITIONS).isdisjoint(topics) and "xy_valid" not in unknown
    healthy = True if has_validity else None
    if not stories:
        text = _without_faults(held, times, end, since, begin)
        if not has_validity:
            text += f"; {_describe_unknown(topics)}"
        return Verdict(text, healthy, vehicle, times, end)
    past: list[Story] = []
    if times.is_live and at is None:
        past = [story for story in stories if _is_past(story, end)]

    def order(story: Story) -> tuple[bool, bool, tuple[int, int, float]]:
        is_on_ground = not (story.in_flight or times.is_live)
        return story in past, is_on_ground, story.rank

    ranked = sorted(stories, key=order)
    worst = ranked[0]
    is_past = worst in past
    is_then = at is None or _is_during(worst, at)
    usable = healthy
    if worst.is_bad and is_then and not is_past:
        usable = False
    head = "no fault at that time; nearest: "
    if is_then:
        valid_since = _valid_since(events, since)
        head = _head(
            worst,
            stories,
            times,
            valid_since,
            is_past=is_past,
            usable=usable,
        )
    evidence = _evidence(worst, stories, events)
    others = _others(worst, ranked, evidence.events, times)
    is_other_urgent = sum(story.is_bad for story in stories) > 1
    correction = _largest_correction(worst, stories)
    if correction is not None:
        after_bad_one = 1 if is_other_urgent else 0
        others.insert(after_bad_one, f"{times.text(correction)} {short_text(correction)}")
        is_other_urgent = True
    parts = _Parts(
        state=f"{head}{_what(worst)}{_count(worst, stories)} {worst.when(times, end)}.",
        evidence=tuple(evidence.shown),
        none=_without_evidence(worst, evidence),
        missing=_missing(worst, evidence),
        others=tuple(others),
        is_other_urgent=is_other_urgent,
    )
    return Verdict(
        text=parts.render(times),
        usable=usable,
        vehicle=vehicle,
        times=times,
        checked=end,
        begin=worst.begin,
        end=worst.end,
        cause=evidence.events,
        stories=tuple(stories),
    )


def _is_past(story: Story, now: float) -> bool:
    """Return whether a story is no present fault of a vehicle."""
    return story.has_ended(now) or KINDS[story.kind].of_data


def _is_during(story: Story, time: float) -> bool:
    return story.since <= time <= story.stop


def _without_evidence(worst: Story, evidence: _Evidence) -> str:
    """Return the sentence that there is no evidence, "" if there is some, or none is expected."""
    if evidence.events or worst.begin is None or not worst.is_bad:
        return ""
    return f"No evidence in the {WINDOW:.0f} s before."


def _missing(worst: Story, evidence: _Evidence) -> str:
    """Return the sentence about topics that may hold evidence, "" if it is not needed."""
    is_needed = worst.is_bad or not evidence.events
    if not is_needed or not worst.lacking:
        return ""
    return f"Not in the data: {', '.join(worst.lacking)}."


def _without_faults(
    held: Iterable[Condition], times: Times, end: float, since: float | None, begin: float
) -> str:
    if not times.is_live:
        text = f"no faults in {end - begin:.0f} s"
    elif since is None:
        text = "no faults in the services' history"
    else:
        text = f"no faults since {times.text_at(since)} UTC ({format_duration(end - since)})"
    initial = [condition for condition in held if condition.initial]
    usual = [condition.text for condition in initial if KINDS[condition.kind].usual]
    if usual:
        text += f"; throughout: {', '.join(dict.fromkeys(usual))}"
    return text


def _valid_since(events: Iterable[Event], first: float | None) -> float | None:
    """Return since when the position is valid: from the first one on, or the end of an initial invalid estimate."""
    if first is None:
        return None
    ends = [event.time for event in events if KINDS[event.kind].validity and event.change == "end"]
    return max([first, *ends])


def _head(
    worst: Story,
    stories: Iterable[Story],
    times: Times,
    since: float | None,
    *,
    is_past: bool,
    usable: bool | None,
) -> str:
    """Return the words before the worst fault: whether the position is valid, and `since` when, None if unknown."""
    of_estimate = [story for story in stories if story.is_bad and story.spans[0].is_of_estimate]
    if worst.is_bad and worst in of_estimate:
        return "was not usable: " if is_past else "not usable: "
    if worst.is_bad or not usable:
        return ""
    return f"position valid {_when_valid(of_estimate, times, since)}, but "


def _when_valid(faults: Sequence[Story], times: Times, since: float | None) -> str:
    """Return when the position is valid; `faults`: the bad ones of the estimate."""
    if any(story.in_flight for story in faults):
        return "now"
    if faults:
        return "in flight"
    if not times.is_live:
        return "throughout"
    if since is None:
        return "now"
    return f"since {times.text_at(since)} UTC"


class _Evidence(NamedTuple):
    """All evidence for a story in chronological order, and what the text may show, most important first."""

    events: tuple[Event, ...]
    shown: list[Event]


def _evidence(worst: Story, stories: Sequence[Story], events: Sequence[Event]) -> _Evidence:
    """Return the evidence for a story.

    Texts of PX4 count until TOGETHER after the start, or all of them for a bad fault that was active in the first
    message; those that also appeared long before the first such fault do not.
    """
    first = min(story.since for story in stories if story.kind == worst.kind)
    texts = [event for event in events if event.kind == "text" and event.severity != "info"]
    usual = {text.text for text in texts if text.time < first - WINDOW}
    quoted = []
    for text in texts:
        is_near = -WINDOW <= text.time - worst.since <= _lateness(worst)
        if is_near and text is not worst.begin and text.text not in usual:
            quoted.append(text)
    if not quoted:
        quoted = _first_bad(texts, worst)
    causes = [event for event in worst.before if event.kind != "text"]
    ordered = sorted([*quoted, *causes], key=lambda event: event.time)
    return _Evidence(tuple(ordered), _by_importance(worst, quoted, causes))


def _lateness(worst: Story) -> float:
    """Return the seconds after the start of a fault in which texts are still its evidence."""
    if worst.begin is not None:
        return TOGETHER
    if worst.is_bad:
        return math.inf
    return -WINDOW


def _first_bad(texts: Iterable[Event], worst: Story) -> list[Event]:
    """Return the first bad text during a fault, unless it is the fault."""
    for text in texts:
        if text.severity == "bad" and _is_during(worst, text.time):
            if text is worst.begin:
                return []
            return [text]
    return []


def _by_importance(worst: Story, texts: Sequence[Event], causes: Sequence[Event]) -> list[Event]:
    """Order evidence: what precedes the fault, nearest in kind and then in time; causes of the sensors first."""
    quoted = _ordered_texts(worst, texts, causes)
    named = _ordered_causes(worst, causes, quoted)
    return [*quoted[:1], *named, *quoted[1:]]


def _ordered_texts(worst: Story, texts: Sequence[Event], causes: Sequence[Event]) -> list[Event]:
    """Return the texts that an evidence quotes, most important first, without those that say the same."""
    subjects = _subjects(worst.what)
    for event in causes:
        subjects |= _subjects(event.text)

    def order(text: Event) -> tuple[bool, bool, float, float, int]:
        distance = round(abs(text.time - worst.since), 1)
        length = len(text.text)
        if text.time >= worst.since or worst.begin is None:
            return True, False, text.numbers.get("level", 0.0), distance, length
        is_of_other = subjects.isdisjoint(_subjects(text.text))
        return False, is_of_other, text.severity != "bad", distance, length

    quoted: list[Event] = []
    for text in sorted(texts, key=order):
        if not any(_is_same(text, other) for other in quoted):
            quoted.append(text)
    return quoted[:_QUOTED]


def _ordered_causes(worst: Story, causes: Sequence[Event], quoted: Sequence[Event]) -> list[Event]:
    """Return the causes that an evidence names, those of the sensors first, without those that others repeat."""
    subjects = _subjects(worst.what)

    def order(event: Event) -> tuple[bool, int, float]:
        is_of_other = subjects.isdisjoint(_subjects(event.text))
        return is_of_other, importance(event.kind), -event.time

    others = [*quoted, *causes]
    named = [event for event in causes if not _is_repeated(event, others)]
    named = sorted(named, key=order)[:_NAMED]
    # effects after causes
    return sorted(named, key=lambda event: KINDS[event.kind].message == "VehicleLocalPosition")


def _subjects(text: str) -> set[str]:
    """Return the sensors and quantities that a text names."""
    return {name for name, pattern in SUBJECTS.items() if re.search(pattern, text, re.IGNORECASE)}


def _is_same(text: Event, other: Event) -> bool:
    """Return whether two texts of PX4 say the same: one contains the other, or both report an injected failure."""
    if text.text in other.text or other.text in text.text:
        return True
    return "inject" in text.text.lower() and "inject" in other.text.lower()


def _is_repeated(event: Event, others: Iterable[Event]) -> bool:
    return any(_repeats(other, event) for other in others)


def _repeats(other: Event, event: Event) -> bool:
    """Return whether another event says more about the same: PX4's text on an EKF, or a lost fix on its satellites."""
    if abs(other.time - event.time) >= TOGETHER:
        return False
    if event.kind == "ekf_changed":
        return other.kind == "text" and "primary EKF changed" in other.text
    if event.kind == "few_satellites":
        return other.kind == "gps_fix_lost" and "satellites" in other.text
    return False


def _largest_correction(worst: Story, stories: Sequence[Story]) -> Event | None:
    """Return the largest reset or jump of at least LARGE_CORRECTION during a fault or at its end, no story itself."""
    begins = [story.begin for story in stories]
    meanwhile = [event for event in (*worst.meanwhile, *worst.after) if event not in begins]
    corrections = [event for event in meanwhile if event.kind in ("reset", "jump")]
    large = [event for event in corrections if _size(event) >= LARGE_CORRECTION]
    return max(large, key=_size, default=None)


def _size(correction: Event) -> float:
    """Return the largest part of a reset or jump [m or m/s]; that of the heading and times do not count."""
    numbers = correction.numbers
    sizes = [abs(numbers[name]) for name in numbers if name not in ("heading", "begin")]
    return max(sizes, default=0.0)


def _others(
    worst: Story, ranked: Sequence[Story], cause: Sequence[Event], times: Times
) -> list[str]:
    """Return the worst other fault of each kind, worst first; `ranked`: all stories, worst first."""
    largest: dict[str, Story] = {}
    for story in ranked:
        if story.kind == "text":
            key = story.what
        else:
            key = story.kind
        largest.setdefault(key, story)
    parts = []
    for story in largest.values():
        if story is worst or story.begin is None or story.begin in cause:
            continue
        if story.kind == worst.kind and not is_alarm(story.begin):
            continue  # the text of the worst one counts them
        what = _what(story)
        if KINDS[story.kind].correction:
            what = short_text(story.begin)
        parts.append(f"{times.text(story.begin)} {what}{_count(story, ranked)}")
    return parts


def _listed(events: Iterable[Event], times: Times) -> str:
    """Format events in chronological order, those of the same time together."""
    ordered = sorted(events, key=lambda event: event.time)
    parts = []
    for time, group in groupby(ordered, key=times.text):
        words = dict.fromkeys(_MODULE.sub('"', event.words) for event in group)
        parts.append(f"{time} {', '.join(words)}")
    return "; ".join(parts)


def _what(story: Story) -> str:
    """Return the text of a story, without the small part of a large reset."""
    if story.kind == "reset" and len(story.spans) == 1:
        return large_part(story.spans[0].begin)
    return _MODULE.sub('"', story.what)


def _count(story: Story, stories: Iterable[Story]) -> str:
    number = sum(other.kind == story.kind for other in stories)
    if number > 1:
        return f" (one of {number})"
    return ""
