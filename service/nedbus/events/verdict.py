"""Verdict on a vehicle in one or two sentences: usable or not, since when, for how long, and why."""

import math
import textwrap
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

from .event import ALL, WINDOW, Condition, Event, rank
from .kinds import KINDS
from .rules import POSITIONS
from .story import TOGETHER, Story, stories_of
from .times import Times

_GLOBAL: Final = "vehicle_global_position"
_WIDTH: Final = 97  # columns next to a short vehicle name; a verdict has at most three lines


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a vehicle.

    `text`: human-readable; names the clock of its times, and may quote text from the vehicle: escape it.
    `usable`: False if the fault kept the vehicle from its task, True if not; None if the data has no position validity.
    `begin`, `end`: events that began and ended the worst fault, None if it was active in the first or last message.
    `cause`: its evidence. `stories`: all faults. Both are in chronological order.
    """

    text: str
    usable: bool | None
    begin: Event | None = None
    end: Event | None = None
    cause: tuple[Event, ...] = ()
    stories: tuple[Story, ...] = ()


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
) -> Verdict:
    """Return the verdict on a vehicle.

    `events`: events in chronological order; only those of this vehicle and of ALL are used. `held`: conditions active
    after the last event. `topics`: published topics. `unknown`: flags that its position does not provide.
    `end`: now, or the end of the file, on the event log's clock [s]. `at`: the time in question, None for all.
    """
    events = [event for event in events if event.vehicle in (vehicle, ALL)]
    stories = stories_of(events, held, topics=topics, at=at)
    known = None if set(POSITIONS).isdisjoint(topics) or "xy_valid" in unknown else True
    if not stories:
        length = "the services' history" if times.is_live else f"{end:.0f} s"
        remark = "" if known else f"; {_describe_unknown(topics)}"
        return Verdict(f"no faults in {length}{remark}", known)
    is_now = times.is_live and at is None
    past = [story for story in stories if is_now and story.has_ended(end)]
    ranked = sorted(stories, key=lambda story: (story in past, rank(story.spans[0], story.until, is_now=is_now)))
    worst = ranked[0]
    is_then = at is None or worst.since <= at <= (at if worst.until is None else worst.until)
    usable = False if worst.is_bad and worst not in past and is_then else known
    of_estimate = [story for story in stories if story.is_bad and story.spans[0].is_of_estimate]
    head = f"position valid {'now' if of_estimate else 'throughout'}, but " if usable else ""
    if worst.is_bad:
        head = ("was " * (worst in past) + "not usable: ") * (worst in of_estimate)
    head = head if is_then else "no fault at that time; nearest: "
    # Evidence: events before the fault, and PX4's log messages until a second after its start, or all of them for a bad
    # fault that was active in the first message. Texts that also appeared long before the first fault are excluded.
    said = [event for event in events if event.kind == "text"]
    earlier = {each.text for each in said if each.time < stories[0].since - WINDOW}
    late = TOGETHER if worst.begin else math.inf if worst.is_bad else -WINDOW
    said = [event for event in said if event is not worst.begin]
    near = (e for e in said if e.severity != "info" and -WINDOW <= e.time - worst.since <= late)
    found = [each for each in near if each.text not in earlier] + [e for e in worst.before if e.kind != "text"]
    cause = tuple(sorted(found, key=lambda each: each.time))
    text = f"{head}{_cut(worst.what)}{_count(worst, stories)} {worst.when(times, end)}."
    room = 3 * _WIDTH - len(text) - (80 if sum(each.is_bad for each in stories) > 1 else 30)  # reserved for the others
    text = " ".join([text, *(f"{part}." for part in _why(worst, cause, times, room))])
    largest = {each.spans[0].kind: each for each in reversed(ranked)}
    also = ""  # the worst other fault of each kind, nearest in time first
    for each in sorted(largest.values(), key=lambda each: abs(each.since - worst.since)):
        if each.begin is None or each.begin in (worst.begin, *cause):
            continue
        part = f"{times.text(each.begin)} {_cut(each.what, 60)}{_count(each, stories)}"
        longer = f"{also}; {part}" if also else f" Also {part}"
        also = longer if len(textwrap.wrap(f"{text}{longer}.", _WIDTH)) < 4 else also
    text += f"{also}." * bool(also)
    return Verdict(text, usable, worst.begin, worst.end, cause, tuple(stories))


def _why(story: Story, cause: Sequence[Event], times: Times, room: int) -> list[str]:
    """Return sentences with as much evidence as fits into `room` characters, and with the missing topics."""
    missing = [f"Not in the data: {', '.join(story.lacking)}"] * bool(story.lacking and (story.is_bad or not cause))
    said = [
        (each.numbers.get("level", 0.0), abs(each.time - story.since), each) for each in cause if each.kind == "text"
    ]
    texts: list[Event] = []
    for *_, each in sorted(said, key=lambda text: text[:2]):
        if not any(each.text in other.text or other.text in each.text for other in texts):
            texts.append(each)
    others = [each for each in cause if each.kind != "text"][-3:]
    others.sort(key=lambda each: KINDS[each.kind].message == "VehicleLocalPosition")  # effects after causes
    ranked = [*texts[:1], *others, *texts[1:2]]
    while ranked:
        groups = groupby(sorted(ranked, key=cause.index), key=times.text)
        words = ((time, dict.fromkeys(_cut(each.words) for each in group)) for time, group in groups)
        listed = "; ".join(f"{time} {', '.join(group)}" for time, group in words)
        if len(listed) + len("".join(missing)) < room:
            return [f"Evidence: {listed}", *missing]
        ranked.pop()
    return [*([f"No evidence in the {WINDOW:.0f} s before"] if story.begin and not cause else []), *missing]


def _count(story: Story, stories: Iterable[Story]) -> str:
    number = sum(each.spans[0].kind == story.spans[0].kind for each in stories)
    return f" (one of {number})" if number > 1 else ""


def _cut(text: str, width: int = 80) -> str:
    return textwrap.shorten(text, width, placeholder="...")
