"""Verdict on a vehicle: one or two sentences that say whether it is usable, since when, for how long, and why not."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Final

from .event import ALL, WINDOW, Condition, Event
from .story import POSITIONS, Story, stories_of
from .times import Times, to_age

_LENGTH: Final = 285  # characters of a verdict: three lines of 100 columns with the name of the vehicle
_QUOTED: Final = 80  # characters of one event in a verdict
_TOGETHER: Final = 1.0  # s after the begin of a fault in which PX4's texts are about it


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a vehicle.

    `text`: for people; it names the clock of its times, and is not escaped: it may quote texts of the vehicle.
    `usable`: False if the vehicle could not do its task, now or at the time of the fault; True if it could throughout;
    None if the data does not tell.
    `begin`: the event that began the worst fault, None without a fault, or if it held in the first message.
    `since`, `until`: of that fault, by the account's clock [s]; `until` is None while it is active.
    `cause`: its evidence in order of time. `faults`: the number of stories.
    """

    text: str
    usable: bool | None
    begin: Event | None = None
    since: float | None = None
    until: float | None = None
    cause: tuple[Event, ...] = ()
    faults: int = 0


def verdict_of(
    vehicle: str,
    events: Sequence[Event],
    held: Iterable[Condition] = (),
    *,
    topics: Collection[str],
    times: Times,
    end: float,
    at: float | None = None,
) -> Verdict:
    """Return the verdict on a vehicle.

    `events`: those of this vehicle and of ALL, in order of time; others are left out. `held`: conditions that are
    active after the last event. `topics`: the topics that it publishes. `end`: now, or the end of the file, by the
    account's clock [s]. `at`: the moment in question, None for all of the data.
    """
    own = [event for event in events if event.vehicle in (vehicle, ALL)]
    stories = stories_of(own, held, topics=topics, at=at)
    is_known = not POSITIONS.isdisjoint(topics)
    length = "the history of the services" if times.is_live else f"{end:.0f} s"
    unknown = "; whether the position is valid is unknown, as no topic of the data has it"
    if not stories:
        return Verdict(f"no faults in {length}{'' if is_known else unknown}", True if is_known else None)
    worst = min(stories, key=_order)
    usable = False if worst.is_bad else True if is_known else None
    cause = _cause(worst)
    head = f"usable in all {length}, but " if usable and at is None else ""
    text = f"{head}{worst.what[: 2 * _QUOTED]} {_when(worst, times, end)}."
    text = f"{text} {_why(worst, cause, times, _LENGTH - len(text))}".rstrip()
    return Verdict(text, usable, worst.begin, worst.since, worst.until, cause, len(stories))


def _order(story: Story) -> tuple[bool, bool, float]:
    """Return the sort key of a story: bad ones first, then active ones, then the longest."""
    return not story.is_bad, story.until is not None, story.since - (story.until or story.since)


def _when(story: Story, times: Times, end: float) -> str:
    """Return when a fault held, and for how long."""
    lasted = to_age((end if story.until is None else story.until) - story.since)
    still = "" if story.until is not None else " until now" if times.is_live else " until the end"
    if story.begin is None:
        return f"from the first message on{still} ({lasted})"
    begin, clock = times.text(story.begin), times.unit(story.begin)
    if story.until == story.since:
        return f"at {begin} {clock}"
    if story.end is None:
        return f"from {begin} {clock}{still} ({lasted})"
    return f"from {begin} to {times.text(story.end)} {clock} ({lasted})"


def _cause(story: Story) -> tuple[Event, ...]:
    """Return the evidence of a fault in order of time: what preceded it, and PX4's texts about it."""
    texts = [each for each in story.meanwhile if each.kind == "text" and each.time <= story.since + _TOGETHER]
    return tuple(sorted((*story.before, *texts), key=lambda each: (each.time, each.kind != "text")))


def _why(story: Story, cause: Sequence[Event], times: Times, room: int) -> str:
    """Return the evidence, PX4's own texts if there is not enough room for all, or what is missing."""
    missing = f"Not in the data: {', '.join(story.lacking)}." if story.lacking else ""
    if not cause:
        none = "" if story.begin is None else f"No evidence in the {WINDOW:.0f} s before. "
        return f"{none}{missing}"
    chosen: list[Event] = []
    text = ""
    for each in sorted(cause, key=lambda each: each.kind != "text"):
        wider = sorted((*chosen, each), key=cause.index)
        longer = f"Before it: {_listed(wider, times)}."
        if text and len(longer) > room - len(missing):
            continue
        chosen, text = wider, longer
    return f"{text} {missing}".rstrip()


def _listed(events: Iterable[Event], times: Times) -> str:
    """Return times with their events."""
    groups = groupby(events, key=times.text)
    return "; ".join(f"{time} {', '.join(dict.fromkeys(map(_quoted, group)))}" for time, group in groups)


def _quoted(event: Event) -> str:
    """Return the text of an event; PX4's own in quotes."""
    text = event.text if len(event.text) <= _QUOTED else f"{event.text[: _QUOTED - 3]}..."
    return f'PX4: "{text}"' if event.kind == "text" else text
