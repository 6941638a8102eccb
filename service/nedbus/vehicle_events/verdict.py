"""Verdict on a vehicle in one or two sentences: usable or not, since when, for how long, and why."""

import math
import re
import textwrap
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

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
_MAX_TEXTS: Final = 2  # of PX4 in the evidence
_MAX_CAUSES: Final = 3  # other events in the evidence


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
        chosen: list[Event] = []
        missing, others = "", list[str]()

        def text() -> str:
            sentences = [self.state]
            if chosen:
                sentences.append(f"Evidence: {_listed(chosen, times)}.")
            elif self.none:
                sentences.append(self.none)
            if missing:
                sentences.append(missing)
            if others:
                sentences.append(f"Also {'; '.join(others)}.")
            return " ".join(sentences)

        def fits() -> bool:
            return len(textwrap.wrap(text(), _WIDTH)) <= _LINES

        def add_evidence(events: Iterable[Event]) -> None:
            for event in events:
                chosen.append(event)
                if not fits():
                    chosen.pop()

        def add_others(parts: Iterable[str]) -> None:
            for part in parts:
                others.append(part)
                if not fits():
                    others.pop()

        def add_missing() -> None:
            nonlocal missing
            missing = self.missing
            if not fits():
                missing = ""

        is_quoted_only = all(event.kind == "text" for event in self.evidence)
        add_evidence(self.evidence[:1] if is_quoted_only else self.evidence[:2])
        if self.is_other_urgent:
            add_others(self.others[:1])
        if is_quoted_only:
            add_missing()
        add_evidence(event for event in self.evidence if event not in chosen)
        add_missing()
        add_others(part for part in self.others if part not in others)
        return (
            textwrap.shorten(text(), _LINES * _WIDTH, placeholder="...") if not fits() else text()
        )


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
) -> Verdict:
    """Return the verdict on a vehicle.

    `events`: events in chronological order; only those of this vehicle and of ALL are used. `held`: conditions active
    after the last event. `topics`: published topics. `unknown`: flags that its position does not provide.
    `end`: now, or the end of the file, on the event log's clock [s]. `at`: the time in question, None for all.
    `since`: time of the first position in live data, None if unknown.
    """
    events = [event for event in events if event.vehicle in (vehicle, ALL)]
    held = list(held)
    stories = stories_of(events, held, topics=topics, at=at)
    known = None if set(POSITIONS).isdisjoint(topics) or "xy_valid" in unknown else True
    if not stories:
        remark = "" if known else f"; {_describe_unknown(topics)}"
        return Verdict(
            f"{_without_faults(held, times, end, since)}{remark}", known, vehicle, times, end
        )
    is_now = times.is_live and at is None
    past = [
        story for story in stories if is_now and (story.has_ended(end) or KINDS[story.kind].of_data)
    ]
    ranked = sorted(
        stories,
        key=lambda story: (story in past, not (story.in_flight or times.is_live), story.rank),
    )
    worst = ranked[0]
    is_then = at is None or worst.since <= at <= (at if worst.until is None else worst.until)
    usable = False if worst.is_bad and worst not in past and is_then else known
    valid_since = _valid_since(events, since)
    head = _head(worst, stories, times, valid_since, is_past=worst in past, usable=usable)
    if not is_then:
        head = "no fault at that time; nearest: "
    cause, ordered = _evidence(worst, stories, events)
    none = (
        f"No evidence in the {WINDOW:.0f} s before."
        if worst.begin and worst.is_bad and not cause
        else ""
    )
    missing = (
        f"Not in the data: {', '.join(worst.lacking)}."
        if worst.lacking and (worst.is_bad or not cause)
        else ""
    )
    state = f"{head}{_what(worst)}{_count(worst, stories)} {worst.when(times, end)}."
    others = _others(worst, ranked, cause, stories, times)
    is_other_urgent = sum(story.is_bad for story in stories) > 1
    correction = _largest_correction(worst, stories)
    if correction is not None:
        after_bad_one = 1 if is_other_urgent else 0
        others.insert(after_bad_one, f"{times.text(correction)} {short_text(correction)}")
        is_other_urgent = True
    text = _Parts(state, tuple(ordered), none, missing, tuple(others), is_other_urgent).render(
        times
    )
    return Verdict(text, usable, vehicle, times, end, worst.begin, worst.end, cause, tuple(stories))


def _without_faults(
    held: Iterable[Condition], times: Times, end: float, since: float | None
) -> str:
    if not times.is_live:
        text = f"no faults in {end:.0f} s"
    elif since is None:
        text = "no faults in the services' history"
    else:
        text = f"no faults since {times.text_at(since)} UTC ({format_duration(end - since)})"
    usual = dict.fromkeys(each.text for each in held if each.initial and KINDS[each.kind].usual)
    if usual:
        text += f"; throughout: {', '.join(usual)}"
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
    return "now" if since is None else f"since {times.text_at(since)} UTC"


def _evidence(
    worst: Story, stories: Sequence[Story], events: Sequence[Event]
) -> tuple[tuple[Event, ...], list[Event]]:
    """Return all evidence for a story in chronological order, and what the text may show, most important first.

    Texts of PX4 count until TOGETHER after the start, or all of them for a bad fault that was active in the first
    message; those that also appeared long before the first such fault do not.
    """
    first = min(story.since for story in stories if story.kind == worst.kind)
    texts = [event for event in events if event.kind == "text" and event.severity != "info"]
    usual = {text.text for text in texts if text.time < first - WINDOW}
    late = TOGETHER
    if worst.begin is None:
        late = math.inf if worst.is_bad else -WINDOW
    near = [
        text
        for text in texts
        if -WINDOW <= text.time - worst.since <= late and text is not worst.begin
    ]
    quoted = [text for text in near if text.text not in usual]
    until = math.inf if worst.until is None else worst.until
    if not quoted:
        quoted = [
            text for text in texts if text.severity == "bad" and worst.since <= text.time <= until
        ][:1]
        quoted = [text for text in quoted if text is not worst.begin]
    causes = [event for event in worst.before if event.kind != "text"]
    cause = tuple(sorted([*quoted, *causes], key=lambda event: event.time))
    return cause, _by_importance(worst, quoted, causes)


def _by_importance(worst: Story, texts: Sequence[Event], causes: Sequence[Event]) -> list[Event]:
    """Order evidence: what precedes the fault, nearest in kind and then in time; causes of the sensors first."""
    subjects = _subjects(worst.what)
    for event in causes:
        subjects |= _subjects(event.text)

    def order(text: Event) -> tuple[bool, bool, float, float]:
        distance = round(abs(text.time - worst.since), 1)
        if text.time >= worst.since or worst.begin is None:
            return True, False, text.numbers.get("level", 0.0), distance
        return False, subjects.isdisjoint(_subjects(text.text)), text.severity != "bad", distance

    said: list[Event] = []
    for text in sorted(texts, key=lambda text: (order(text), len(text.text))):
        if not any(_is_same(text, other) for other in said):
            said.append(text)
    said = said[:_MAX_TEXTS]
    shown = [
        event for event in causes if not any(_repeats(other, event) for other in (*said, *causes))
    ]
    of_worst = _subjects(worst.what)
    shown.sort(
        key=lambda event: (
            of_worst.isdisjoint(_subjects(event.text)),
            importance(event.kind),
            -event.time,
        )
    )
    shown = shown[:_MAX_CAUSES]
    # effects after causes
    shown.sort(key=lambda event: KINDS[event.kind].message == "VehicleLocalPosition")
    return [*said[:1], *shown, *said[1:]]


def _subjects(text: str) -> set[str]:
    """Return the sensors and quantities that a text names."""
    return {name for name, pattern in SUBJECTS.items() if re.search(pattern, text, re.IGNORECASE)}


def _is_same(text: Event, other: Event) -> bool:
    """Return whether two texts of PX4 say the same: one contains the other, or both report an injected failure."""
    if text.text in other.text or other.text in text.text:
        return True
    return all(re.search("inject", each.text, re.IGNORECASE) for each in (text, other))


def _repeats(other: Event, event: Event) -> bool:
    """Return whether another event says more about the same: PX4's text on an EKF, or a lost fix on its satellites."""
    if abs(other.time - event.time) >= TOGETHER:
        return False
    if event.kind == "ekf_changed":
        return other.kind == "text" and "primary EKF changed" in other.text
    return (
        event.kind == "few_satellites"
        and other.kind == "gps_fix_lost"
        and "satellites" in other.text
    )


def _largest_correction(worst: Story, stories: Sequence[Story]) -> Event | None:
    """Return the largest reset or jump of at least LARGE_CORRECTION during a fault or at its end, no story itself."""
    begins = [story.begin for story in stories]
    corrections = [
        event
        for event in (*worst.meanwhile, *worst.after)
        if event.kind in ("reset", "jump")
        and event not in begins
        and _size(event) >= LARGE_CORRECTION
    ]
    return max(corrections, key=_size, default=None)


def _size(correction: Event) -> float:
    """Return the largest part of a reset or jump [m or m/s]; that of the heading and times do not count."""
    sizes = [
        abs(size) for name, size in correction.numbers.items() if name not in ("heading", "begin")
    ]
    return max(sizes, default=0.0)


def _others(
    worst: Story,
    ranked: Sequence[Story],
    cause: Sequence[Event],
    stories: Sequence[Story],
    times: Times,
) -> list[str]:
    """Return the worst other fault of each kind, worst first."""
    largest: dict[str, Story] = {}
    for story in ranked:
        key = story.what if story.kind == "text" else story.kind
        largest.setdefault(key, story)
    parts = []
    for story in largest.values():
        if (
            story is worst
            or story.kind == worst.kind != "text"
            or story.begin is None
            or story.begin in cause
        ):
            continue
        if story.kind != worst.kind or is_alarm(story.begin):
            what = short_text(story.begin) if KINDS[story.kind].correction else _what(story)
            parts.append(f"{times.text(story.begin)} {what}{_count(story, stories)}")
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
    number = sum(each.kind == story.kind for each in stories)
    return f" (one of {number})" if number > 1 else ""
