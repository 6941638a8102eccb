"""A fleet and its bad day: python -m benchmarks.fleet.

Vehicles in three processes, each in as many sessions as asked for, one to three routers that are joined, and readers of
every message: `all` vehicles, `one` vehicle, and a recorder. What happens, in the order of --events, spread over
--seconds:

    router   the first router is killed, and starts again after 2 s
    routers  all routers are killed, and start again after 2 s
    link     the link of a third of the vehicles is cut for 10 s, without either side being told
    restart  a third of the vehicles end their sessions, and open them again after 1 s
    late     one more reader of all vehicles joins
    stuck    a reader is stopped for 10 s with SIGSTOP: the late one, or that of one vehicle

Each message has its number, so that each that is missing is known.
The results are written to build/fleet.json and build/fleet.png, or as --output says, and as tables to the terminal.
"""

from __future__ import annotations

import argparse
import json
import signal
import tempfile
import time
from pathlib import Path
from typing import Any, Final

from mcap.reader import make_reader

from .fleet_account import account, describe
from .fleet_day import PATIENCE, Fleet, say
from .fleet_picture import draw
from .fleet_plan import Plan
from .processes import ROOT, end, expect

EVENTS: Final = ("router", "routers", "link", "restart", "late", "stuck")
BEFORE: Final = 5.0  # s from the first message to the first event, at least


def main() -> None:
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=60)
    parser.add_argument("--vehicles", type=int, help="as many as sessions, if not given")
    parser.add_argument("--topics", type=int, default=1, choices=range(1, 5))
    parser.add_argument("--rate", type=float, default=1.0, help="Hz, of each stream")
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--routers", type=int, default=1, choices=range(1, 4))
    parser.add_argument("--events", default=",".join(EVENTS), help="comma-separated, none for a quiet day")
    parser.add_argument("--zenohd", metavar="PATH", help="instead of `nedbus router`")
    parser.add_argument("--router-config", metavar="FILE", help="the routers' JSON5 file")
    parser.add_argument("--output", type=Path, default=ROOT / "build" / "fleet", help="without extension")
    given = parser.parse_args()
    events = tuple(event for event in given.events.split(",") if event and event != "none")
    if unknown := set(events) - set(EVENTS):
        parser.error(f"no such event: {', '.join(sorted(unknown))}")
    plan = Plan(
        sessions=given.sessions,
        vehicles=max(given.sessions, given.vehicles or 0),
        topics=given.topics,
        rate=given.rate,
        seconds=given.seconds,
        routers=given.routers,
        events=events,
        zenohd=given.zenohd,
        router_config=given.router_config,
    )
    with tempfile.TemporaryDirectory() as folder:
        fleet = Fleet(plan, Path(folder))
        try:
            found = run(fleet)
        finally:
            fleet.close()
    given.output.parent.mkdir(exist_ok=True)
    given.output.with_suffix(".json").write_text(json.dumps(found))
    draw(found, given.output.with_suffix(".png"))
    print(describe(found))


def run(fleet: Fleet) -> dict[str, Any]:
    """Have the day, and return what was found."""
    plan = fleet.plan
    declared = fleet.open()
    at_rest = fleet.link_bytes()
    print(f"{plan.sessions} sessions are open after {declared:.1f} s", flush=True)
    for process in fleet.vehicles:
        say(process, "start")
    begin = time.monotonic()
    pause = plan.seconds / (len(plan.events) + 1)
    happened: list[dict[str, Any]] = []
    cpu = fleet.cpu()
    for number, event in enumerate(plan.events):
        time.sleep(max(0.0, begin + max(BEFORE, (number + 1) * pause) - time.monotonic()))
        cpu = _spend(happened, cpu, fleet)
        print(f"{time.monotonic() - begin:6.1f} s  {event}", flush=True)
        started = time.time()
        over = fleet.happen(event)
        happened.append({"name": event, "begin": started, "over": over})
        for reader in fleet.readers.values():
            say(reader, f"mark {event} {over!r}")
    time.sleep(max(0.0, begin + plan.seconds - time.monotonic()))
    _spend(happened, cpu, fleet)
    published: dict[str, list[Any]] = {}
    late = 0.0
    for process in fleet.vehicles:
        say(process, "stop")
        told = json.loads(expect(process, PATIENCE))
        published |= told["streams"]
        late = max(late, told["late"])
    for reader in fleet.readers.values():
        say(reader, "report")
    reports = {name: json.loads(expect(reader, PATIENCE)) for name, reader in fleet.readers.items()}
    return {
        "plan": {**vars(plan), "router": "zenohd" if plan.zenohd else "nedbus router", "zenohd": None},
        "epoch": fleet.epoch,
        "declared": declared,
        "link at rest": at_rest,
        "link": fleet.link_bytes(),
        "events": happened,
        "published": published,
        "late": late,
        "readers": reports,
        "accounts": account(published, reports),
        "recorded": _count(fleet),
        "recorder": fleet.recorder_log.read_text().splitlines()[-1],
        "looks": [vars(look) for look in fleet.looks],
    }


def _spend(happened: list[dict[str, Any]], before: dict[str, float], fleet: Fleet) -> dict[str, float]:
    """Note for the last event what processor time was spent since it began, and return what it is now."""
    now = fleet.cpu()
    if happened:
        happened[-1]["cpu"] = {name: now[name] - before.get(name, 0.0) for name in now}
        happened[-1]["cpu seconds"] = time.time() - happened[-1]["begin"]
    return now


def _count(fleet: Fleet) -> int:
    """Return how many messages are in the recording, which ends here."""
    fleet.processes["recorder"].send_signal(signal.SIGTERM)
    end(fleet.processes["recorder"], patience=PATIENCE)
    with fleet.recording.open("rb") as file:
        summary = make_reader(file).get_summary()
    return summary.statistics.message_count if summary and summary.statistics else 0


if __name__ == "__main__":
    main()
