"""The text of the page as HTML: counts, vehicles, why, numbers, streams; all that a peer may have sent is escaped."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from html import escape
from typing import Final

from nedbus.client import to_age
from nedbus.events import Event, Story

from .fleet import GRADES, MAX_STREAMS, Fleet, Grade, Picture, Row
from .stream import is_position
from .style import SHAPES, Style

Moment = Callable[[float], str]  # a time by the account's clock, in words

_PART: Final = 5  # events that a sentence names at most
_TEXT: Final = 160  # characters of what one event says
_REPORTS: Final = 8
_CLASSES: Final = {"bad": "bad", "watch": "watch", "info": "quiet"}
_SHAPES: Final = {"bad": "■", "watch": "▲", "info": "●"}


def badge(grade: Grade, text: str) -> str:
    """Return a grade with its shape, word and colour."""
    return f'<span class="badge {grade}">{SHAPES[grade]} {escape(text)}</span>'


def action(do: str, text: str, *, pressed: bool | None = None, title: str = "") -> str:
    """Return a button that asks the viewer to do something."""
    state = "" if pressed is None else f' aria-pressed="{str(pressed).lower()}"'
    return f'<button data-do="{do}"{state} title="{escape(title)}">{escape(text)}</button>'


def header(name: str, picture: Picture, *, clock: str, slow: float, theme: str) -> str:
    """Return the counts of vehicles, the messages, and what is wrong with the link or the page itself."""
    counted = Counter(row.grade for row in picture.rows)
    counts = "".join(badge(grade, f"{counted[grade]} {grade}") for grade in GRADES if counted[grade])
    facts = [f"{picture.rate:,.0f} messages/s", f"{picture.lost} lost", f"{picture.rejected} rejected"]
    facts += [f"{picture.left_out} streams beyond {MAX_STREAMS} are left out"] if picture.left_out else []
    alarms = [picture.link, picture.own, f"this browser takes {to_age(slow)} for a picture" if slow else ""]
    wrong = "".join(f'<span class="alarm">{escape(alarm)}</span>' for alarm in alarms if alarm)
    calm = "" if any(alarms) else " · this page reads all of it"
    other = "light" if theme == "dark" else "dark"
    return (
        f'<div class="bar"><b>{escape(name)}</b>{counts or "waiting for the first message"}{wrong}'
        f'<span class="quiet">{" · ".join(facts)}{calm}</span>'
        f'<span class="end quiet">{escape(clock)}</span>{action("theme", other)}</div>'
    )


def vehicle_list(rows: Sequence[Row], chosen: str | None, style: Style, moment: Moment) -> str:
    """Return a row for each vehicle, the worst first."""
    titles = (
        '<div class="row titles"><span></span><span>vehicle</span><span>state</span><span>since</span>'
        '<span class="mode">mode</span><span>battery</span><span class="gps">GPS · sats</span></div>'
    )
    return titles + "".join(_vehicle(row, chosen, style, moment) for row in rows)


def _vehicle(row: Row, chosen: str | None, style: Style, moment: Moment) -> str:
    name = escape(row.vehicle)
    since = "" if row.since is None else moment(row.since)
    facts = row.facts
    return (
        f'<div class="row" role="button" tabindex="0" data-do="vehicle" data-with="{name}" title="{escape(row.text)}"'
        f' aria-selected="{str(row.vehicle == chosen).lower()}"><span class="{row.grade}">{SHAPES[row.grade]}</span>'
        f'<b><i class="dot" style="background: {style.vehicle(row.number)}"></i>{name}</b>'
        f'<span class="{row.grade}">{escape(row.brief)}</span><span class="quiet">{since}</span>'
        f'<span class="mode">{escape(facts.mode or "-")}</span><span>{facts.battery or "-"}</span>'
        f'<span class="gps">{escape(facts.gps or "-")}</span></div>'
    )


def why(row: Row | None, story: Story | None, now: float, moment: Moment, *, pinned: bool) -> str:
    """Return what is, or was, wrong with the chosen vehicle, and what precedes it."""
    if row is None:
        return ""
    then = f'<span class="badge watch">at {moment(now)}</span>' if pinned else ""
    head = f'<div class="bar"><b class="name">{escape(row.vehicle)}</b>{badge(row.grade, row.brief)}{then}</div>'
    head += f'<div class="quiet">{"list, numbers and marks are of now; " * pinned}last at {escape(row.where)}</div>'
    if story is None:
        calm = escape(row.text) if row.grade != "ok" else "nothing was wrong lately"
        return f'{head}<div class="why">{calm}</div>'

    def tell(events: Sequence[Event]) -> str:
        told = [f"{moment(each.time)} {escape(each.text[:_TEXT])}" for each in events[:_PART]]
        return "; ".join(told) + (f"; and {len(events) - _PART} more" if len(events) > _PART else "")

    begin = "from the first message on" if story.begin is None else f"since {moment(story.since)}"
    goes_on = story.until is None or story.until > now
    lasted = to_age(max(0.0, (now if goes_on else story.until or now) - story.since))
    parts = [
        f"<b>{escape(story.what)}</b> {begin} ({lasted}{'' if goes_on or story.until == story.since else ', over'})"
    ]
    parts += [f"before it: {tell(story.before)}"] if story.before else []
    meanwhile = [each for each in story.meanwhile if each.time <= now]
    parts += [f"meanwhile: {tell(meanwhile)}"] if meanwhile else []
    parts += [f"as it ended: {tell(story.after)}"] if story.after and not goes_on else []
    if story.topics:
        parts.append(f'<span class="quiet">evidence: {escape(", ".join(story.topics))}</span>')
    if story.lacking:
        parts.append(f'<span class="quiet">not in the data: {escape(", ".join(story.lacking))}</span>')
    text = "".join(f"<div>{part}</div>" for part in parts)
    return f'{head}<div class="why {"bad" if goes_on and row.grade == "bad" else ""}">{text}</div>'


def numbers(row: Row | None) -> str:
    """Return the numbers of the chosen vehicle as tiles; "-" where nothing says them, or they are not valid."""
    last = row.main.stream.last if row is not None and is_position(row.main.address) else None
    message = last.message if last is not None else None
    facts = row.facts if row is not None else None

    def metres(name: str, flag: str, sign: float = 1.0) -> str:
        value = getattr(message, name, math.nan)
        return f"{sign * value:z.1f} m" if getattr(message, flag, False) and math.isfinite(value) else "-"

    speed = "-"
    if message is not None and message.v_xy_valid:
        speed = f"{math.hypot(message.vx, message.vy):.1f} m/s"
    heading = getattr(message, "heading", math.nan)
    tiles = {
        "north": metres("x", "xy_valid"), "east": metres("y", "xy_valid"), "height": metres("z", "z_valid", -1.0),
        "speed": speed, "heading": f"{round(math.degrees(heading)) % 360}°" if math.isfinite(heading) else "-",
        "mode": facts.mode if facts else "", "armed": facts.armed if facts else "",
        "battery": facts.battery if facts else "", "GPS · sats": facts.gps if facts else "",
    }  # fmt: skip
    shown = "".join(
        f'<div class="tile"><span>{name}</span><b>{escape(text or "-")}</b></div>' for name, text in tiles.items()
    )
    return f'<div class="tiles">{shown}</div>'


def streams(row: Row | None, picture: Picture, *, is_open: bool, moment: Moment) -> str:
    """Return the streams of the chosen vehicle, if they are asked for, and the messages that were rejected last."""
    if row is None:
        return ""
    count = f"{len(row.lines)} stream{'s' * (len(row.lines) > 1)}"
    head = action("streams", f"{'▾' if is_open else '▸'} {count} of {row.vehicle}", pressed=is_open)
    if not is_open:
        return head
    table = "".join(
        f"<tr><td>{escape(line.address.stream)}</td><td>{line.health.rate or 0:.0f}</td><td>{line.health.lost}</td>"
        f"<td>{line.rejected}</td><td>{escape(line.words)}</td></tr>"
        for line in row.lines
    )
    text = f"<table><tr><th>topic</th><th>Hz</th><th>lost</th><th>rejected</th><th>state</th></tr>{table}</table>"
    if picture.reports:
        told = "".join(
            f"<tr><td>{moment(report.received / 1e9)}</td>"
            f"<td>{escape(str(report.address))}</td><td>{escape(report.reason)}</td></tr>"
            for report in picture.reports[:_REPORTS]
        )
        text += f"<table><tr><th>rejected at</th><th>which</th><th>why</th></tr>{told}</table>"
    return head + text


def toolbar(*, focus: str, trail: str, long: str, truth: bool, pinned: str, note: str) -> str:
    """Return the buttons of the map, and what its metres are of."""
    buttons = [
        action("focus:all", "fit all", pressed=focus == "all", title="a"),
        action("focus:follow", "follow", pressed=focus == "follow", title="f"),
        action("focus:vehicle", "zoom to", pressed=focus == "vehicle", title="z"),
        action("trail", f"trail {'60 s' if trail == 'minute' else long}", title="t"),
        action("truth", "truth", pressed=truth, title="ground truth, dotted"),
    ]
    now = [f'<span class="badge watch">at {escape(pinned)}</span>', action("now", "back to now")] if pinned else []
    return f'<div class="bar">{"".join(buttons + now)}<span class="quiet">{escape(note)}</span></div>'


def strip(events: Sequence[Event], length: float) -> str:
    """Return the marks of events for the slider of a recording of so many seconds."""
    marks = (
        f'<span data-do="event" data-with="{index}" title="{escape(event.text[:_TEXT])}"'
        f' class="{_CLASSES[event.severity]}" style="left: {100 * event.time / length:.2f}%">'
        f"{_SHAPES[event.severity]}</span>"
        for index, event in enumerate(events)
    )
    return f'<div class="strip">{"".join(marks)}</div>' if length else ""


def frame(fleet: Fleet, rows: Sequence[Row]) -> str:
    """Say what the map's metres are of."""
    projection = fleet.origin.projection
    own = [row.vehicle for row in rows if row.main.stream.valid is not None and not row.main.stream.valid.common]
    nowhere = [row.vehicle for row in rows if row.main.stream.valid is None]
    common = f"metres from {projection.latitude:.6f}, {projection.longitude:.6f}" if projection else ""
    parts = [common, f"from their own origin: {_few(own)}" if own else ""]
    parts += [f"never had a valid position: {_few(nowhere)}" if nowhere else ""]
    return "; ".join(part for part in parts if part)


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
