"""Text formats of vehicle events and verdicts: lines, JSON and CSV."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Final

from nedbus import limits
from nedbus.clock import format_duration
from nedbus.health import Event, Story, Times, Verdict

from .streams import csv_line, to_text
from .table import fold

CSV_HEAD: Final = (
    "time", "clock", "boot", "vehicle", "severity", "kind", "change", "text", "topic", "lasted", "evidence", "numbers",
    "author",
)  # fmt: skip


def to_line(event: Event, times: Times) -> str:
    """Format an event as one line: time, vehicle, severity, text and evidence."""
    severity = ""
    text = _words(event)
    if event.severity != "info":
        severity = event.severity.upper()
        evidence = ", ".join(_before(cause, event.time) for cause in event.evidence)
        if evidence:
            text = f"{text}  <- {evidence}"
    return fold(f"{times.text(event):>10}  {to_text(event.vehicle):<8} {severity:<5}  ", text)


def to_json(event: Event, times: Times) -> str:
    """Format an event as one line of JSON."""
    return json.dumps(_to_fields(event, times))


def to_csv(event: Event, times: Times) -> str:
    """Format an event as a line of CSV, with the columns of CSV_HEAD."""
    fields = _to_fields(event, times)
    evidence = [f"{cause.kind} {event.time - cause.time:.1f} s" for cause in event.evidence]
    fields["evidence"] = "; ".join(evidence)
    fields["numbers"] = ""
    if event.numbers:
        fields["numbers"] = json.dumps(dict(event.numbers))
    return csv_line([fields[name] for name in CSV_HEAD])


def describe_verdict(verdict: Verdict) -> str:
    """Format the verdict on a vehicle as one line."""
    return fold(f"{verdict.vehicle}: ", to_text(verdict.text, limits.LINE_TEXT))


def describe_stories(verdict: Verdict, advice: str) -> list[str]:
    """Format each fault of a verdict as a paragraph, then the other texts; `advice`: on missing topics."""
    paragraphs = ["\n".join(_story_lines(verdict, story, advice)) for story in verdict.stories]
    if verdict.others:
        others = [_timed(event, verdict.times, _words(event)) for event in verdict.others]
        paragraphs.append("\n".join([f"{verdict.vehicle}: other texts", *others]))
    return paragraphs


def _story_lines(verdict: Verdict, story: Story, advice: str) -> Iterator[str]:
    times = verdict.times
    what = to_text(story.what, limits.LINE_TEXT)
    yield fold(f"{verdict.vehicle}: ", f"{what} {verdict.period(story)}")
    if story.before:
        yield "  evidence"
    for event in story.before:
        yield _timed(event, times, _before(event, story.since))
    if story.meanwhile:
        yield "  meanwhile"
    for event in story.meanwhile:
        yield _timed(event, times, _words(event))
    if story.end is not None:
        with_events = ""
        if story.after:
            with_events = " with"
        yield f"  ended at {times.text(story.end)}{with_events}"
        for event in story.after:
            yield _timed(event, times, _words(event))
    if story.remark:
        yield f"  {story.remark}"
    if story.lacking:
        lacking = ", ".join(story.lacking)
        yield fold("  ", f"missing topics that may explain it: {lacking}; {advice}")


def _words(event: Event) -> str:
    return to_text(event.words, limits.LINE_TEXT)


def _timed(event: Event, times: Times, text: str) -> str:
    return fold(f"    {times.text(event)}  ", text)


def _before(event: Event, time: float) -> str:
    """Format an event with its distance from a time, which it may explain."""
    distance = format_duration(abs(time - event.time))
    side = "after"
    if event.time <= time:
        side = "before"
    return f"{_words(event)} ({distance} {side})"


def verdict_json(verdict: Verdict) -> str:
    """Format a verdict with its faults as one line of JSON."""
    times = verdict.times

    def all_fields(events: Iterable[Event]) -> list[dict[str, object]]:
        return [_to_fields(event, times) for event in events]

    def fields(event: Event | None) -> dict[str, object] | None:
        if event is None:
            return None
        return _to_fields(event, times)

    head = {
        "text": verdict.text,
        "usable": verdict.usable,
        "begin": fields(verdict.begin),
        "end": fields(verdict.end),
        "cause": all_fields(verdict.cause),
    }
    faults = [
        {
            "what": story.what,
            "begin": fields(story.begin),
            "end": fields(story.end),
            "lasted": None if story.until is None else story.until - story.since,
            "before": all_fields(story.before),
            "meanwhile": all_fields(story.meanwhile),
            "after": all_fields(story.after),
            "lacking": story.lacking,
        }
        for story in verdict.stories
    ]
    return json.dumps({"vehicle": verdict.vehicle, "verdict": head, "faults": faults})


def _to_fields(event: Event, times: Times) -> dict[str, object]:
    utc = times.utc(event)
    time = None
    if utc is not None:
        time = datetime.fromtimestamp(utc, UTC).isoformat(timespec="milliseconds")
    fields: dict[str, object] = {"time": time, "clock": times.clock(event)}
    fields |= asdict(event)
    fields["time"] = time  # not that of the event, whose clock depends on the file
    fields["evidence"] = [
        {
            "kind": cause.kind,
            "change": cause.change,
            "text": cause.text,
            "topic": cause.topic,
            "before": round(event.time - cause.time, 3),
        }
        for cause in event.evidence
    ]
    return fields
