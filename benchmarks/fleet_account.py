"""What became of each message of a fleet, by its number, and what happened, as tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from nedbus_msgs import TOPICS


def account(published: Mapping[str, Sequence[Any]], reports: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Return for each reader what it was due, what it received, and what became of the rest.

    `due`: of each stream that it selects, from its first message on, or from the first that a late reader heard.
    `kept`: missing although its publisher still had it when the hole was noticed.
    `unaccounted`: missing, and neither counted as lost nor as dropped; of streams that it never heard, all.
    """
    return {name: _account(name, published, report) for name, report in reports.items()}


def _account(name: str, published: Mapping[str, Sequence[Any]], report: Mapping[str, Any]) -> dict[str, int]:
    vehicles = {stream.partition("/")[0] for stream in report["streams"]}
    selected = [each for each in published if name != "one" or each.partition("/")[0] in vehicles]
    due = received = missing = kept = silent = 0
    for stream in selected:
        count, starts = published[stream]
        if stream not in report["streams"]:
            silent += 1
            due += count if name != "late" else 0
            missing += count if name != "late" else 0
            continue
        first, expected, got = report["streams"][stream]
        first = first if name == "late" else 0
        due += count - first
        received += got
        missing += count - first - got
        holes = [(from_, from_ + length) for other, from_, length, _ in report["holes"] if other == stream]
        if first < report["streams"][stream][0]:
            holes.append((first, report["streams"][stream][0]))
        if expected < count:
            holes.append((expected, count))
        cache = TOPICS[stream.split("/")[1]].kept
        kept += sum(_kept(hole, starts, cache) for hole in holes)
    counted = report["lost"] + report["dropped"]
    return {
        "due": due,
        "received": received,
        "late": sum(phase["late"] for phase in report["phases"]),
        "missing": missing,
        "kept": kept,
        "lost": report["lost"],
        "dropped": report["dropped"],
        "invalid": report["invalid"],
        "unaccounted": missing - counted - report["invalid"],
        "streams missing": len({hole[0] for hole in report["holes"]}),
        "streams silent": silent,
        "disordered": report["disordered"],
    }


def _kept(hole: tuple[int, int], starts: Sequence[int], cache: int) -> int:
    """Return how many of a hole the publisher had when the first message after it was sent."""
    begin, end = hole
    since = max((start for start in starts if start <= end), default=0)
    return max(0, end - max(begin, since, end - cache))


def describe(found: Mapping[str, Any]) -> str:
    """Return the tables."""
    return "\n".join(
        [*_head(found), "", *_events(found), "", *_accounts(found), "", *_latencies(found), "", *_processes(found)]
    )


def _head(found: Mapping[str, Any]) -> Iterator[str]:
    plan, rest = found["plan"], found["link at rest"]
    streams = plan["vehicles"] * plan["topics"]
    yield (
        f"{plan['sessions']} sessions, {plan['vehicles']} vehicles, {streams} streams at {plan['rate']:g} Hz"
        f", {plan['routers']} x {plan['router']}: all declared after {found['declared']:.1f} s"
        f", published at most {found['late']:.2f} s late"
    )
    if rest:
        share = rest["connections"]
        yield (
            f"declarations on the link, before the first message: {rest['up'] / share:.0f} bytes up"
            f" and {rest['down'] / share:.0f} down for each of its {share} sessions"
            f", {streams / plan['sessions']:g} streams in each, handshake and keep-alives included"
        )


def _events(found: Mapping[str, Any]) -> Iterator[str]:
    yield f"{'event':8} {'took':>6}   {'back, s after it: median, last (not back)':60} processor, s: routers, all, of s"
    for event in found["events"]:
        cells = []
        for name, report in found["readers"].items():
            phase = next((phase for phase in report["phases"] if phase["name"] == event["name"]), None)
            if phase is not None and (phase["back median"] is not None or phase["not back"]):
                last = phase["back all"] if phase["back all"] is not None else "not all"
                cells.append(f"{name} {phase['back median']}, {last} ({phase['not back']})")
        cpu = event.get("cpu", {})
        routers = sum(value for name, value in cpu.items() if name.startswith("router"))
        yield (
            f"{event['name']:8} {event['over'] - event['begin']:6.1f}   {'; '.join(cells):60}"
            f" {routers:6.1f} {cpu.get('all', 0.0):6.1f}  of {event.get('cpu seconds', 0.0):.0f}"
        )
    late = found["readers"].get("late")
    if late and late["first heard"]:
        heard = late["first heard"]
        half = heard[len(heard) // 2]
        yield f"late joiner: {len(heard)} streams, half of them after {half:.2f} s, all after {heard[-1]:.2f} s"


def _accounts(found: Mapping[str, Any]) -> Iterator[str]:
    titles = {
        "due": "due",
        "received": "received",
        "late": "late",
        "missing": "missing",
        "kept": "still kept",
        "lost": "lost",
        "dropped": "dropped",
        "unaccounted": "unaccounted",
        "streams missing": "of streams",
        "streams silent": "silent",
    }
    yield "reader  " + "".join(f"{title:>12}" for title in titles.values())
    for name, each in found["accounts"].items():
        yield f"{name:8}" + "".join(f"{each[column]:12,}" for column in titles)
    total = sum(count for count, _ in found["published"].values())
    yield f"recorder: {found['recorded']:,} of {total:,} in the file, {total - found['recorded']:,} missing"
    yield f"it says: {found['recorder']}"


def _latencies(found: Mapping[str, Any]) -> Iterator[str]:
    yield "latency, ms: p50, p99, largest, from an event to the next; messages, of these more than 1 s late"
    for name, report in found["readers"].items():
        for phase in report["phases"]:
            if ms := phase["ms"]:
                yield (
                    f"{name:6} {phase['name']:8} {ms['p50']:10.2f} {ms['p99']:10.2f} {ms['p100']:10.2f}"
                    f"   {phase['received']:,}, {phase['late']:,}"
                )


def _processes(found: Mapping[str, Any]) -> Iterator[str]:
    yield "process       processor, s   memory, MB: at first, largest, at last   threads   descriptors"
    looks = found["looks"]
    for name in dict.fromkeys(look["name"] for look in looks):
        mine = [look for look in looks if look["name"] == name]
        memory = [look["memory"] for look in mine]
        threads, descriptors = (max(look[key] for look in mine) for key in ("threads", "descriptors"))
        yield (
            f"{name:12} {mine[-1]['cpu']:13.1f} {memory[min(4, len(memory) - 1)]:12.1f} {max(memory):8.1f}"
            f" {memory[-1]:8.1f} {threads:20} {descriptors:10}"
        )
