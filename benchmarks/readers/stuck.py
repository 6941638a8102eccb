"""Effect of a stuck reader in mode `every` on a healthy one at the same router: python -m benchmarks.readers.stuck.

For --seconds the stuck reader does not read, reads one message a second, or is stopped with SIGSTOP; then it resumes.
Vehicle 1 is live at --rate Hz, and the healthy reader always subscribes to it; vehicle 2 is a lossless replay of
--messages messages at the speed of its readers.

    live    the stuck reader subscribes to vehicle 1; there is no vehicle 2
    both    the stuck reader subscribes to vehicle 1, the healthy one to both: the replay continues
    replay  the stuck reader subscribes to vehicle 2, the healthy one to both: the replay waits, vehicle 1 continues

Targets: the healthy reader waits at most 0.2 s for a message of vehicle 1, or of a replay that has no stuck reader;
the stuck reader receives a replay completely and in order, and counts the loss of vehicle 1 exactly.
"""

from __future__ import annotations

import argparse
import json
import signal
import time
from typing import Any, Final

from benchmarks.processes import Process, end, expect, resume, router, start

BEFORE: Final = 2.0  # s during which all readers read
AFTER: Final = 10  # s of vehicle 1 after the stuck reader continues
TIMEOUT: Final = 120.0  # s for the rest of the replay
MAX_GAP: Final = 0.2  # s
LIVE, REPLAYED = "1", "2"
CASES: Final = {
    "live": (LIVE, [LIVE]),
    "both": (LIVE, [LIVE, REPLAYED]),
    "replay": (REPLAYED, [LIVE, REPLAYED]),
}
HABITS: Final = ("never", "slowly", "stopped")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--rate", type=int, default=1000)
    parser.add_argument("--messages", type=int, default=200_000)
    parser.add_argument("--case", choices=CASES, action="append")
    parser.add_argument("--habit", choices=[*HABITS, "reads"], action="append")
    arguments = parser.parse_args()
    for case in arguments.case or CASES:
        for habit in arguments.habit or HABITS:
            try:
                text = measure(
                    case, habit, arguments.seconds, rate=arguments.rate, messages=arguments.messages
                )
                print(text, flush=True)
            except (RuntimeError, TimeoutError) as exc:
                print(f"{case}, {habit}: MISSED: {exc}", flush=True)


def measure(case: str, habit: str, seconds: int, *, rate: int, messages: int) -> str:
    """Run one case, and return the results of both readers."""
    stuck_reads, healthy_reads = CASES[case]
    sent = {LIVE: round((BEFORE + seconds + AFTER) * rate), REPLAYED: messages}
    with router() as (_, endpoint):
        healthy = start("-m", "benchmarks.readers.stuck_reader", "reads", endpoint, *healthy_reads)
        behaves = "reads" if habit == "stopped" else habit
        stuck = start("-m", "benchmarks.readers.stuck_reader", behaves, endpoint, stuck_reads)
        live = _publisher(endpoint, sent[LIVE], rate, LIVE)
        replay = _publisher(endpoint, messages, 0, REPLAYED) if REPLAYED in healthy_reads else None
        processes = [process for process in (healthy, stuck, live, replay) if process is not None]
        try:
            for process in processes:
                expect(process)
            resume(live)
            time.sleep(BEFORE)
            if replay is not None:
                resume(replay)
            if habit == "stopped":
                stuck.send_signal(signal.SIGSTOP)
            time.sleep(seconds)
            stuck.send_signal(signal.SIGCONT)
            resume(stuck)
            resume(healthy)
            expect(live, seconds + TIMEOUT)
            took = (
                f", sent in {json.loads(expect(replay))['seconds']:.1f} s"
                if replay is not None
                else ""
            )
            for reader in (stuck, healthy):
                resume(reader)
            found = json.loads(expect(stuck)), json.loads(expect(healthy))
        finally:
            for process in processes[2:]:
                resume(process)
            end(*processes, timeout=5.0)
    return f"{case}, {habit} for {seconds} s{took}\n" + "\n".join(
        _describe(*found, sent, stuck_reads)
    )


def _publisher(endpoint: str, count: int, rate: int, vehicle: str) -> Process:
    return start(
        "-m", "benchmarks.compare.role", "rows", "publish", endpoint, str(count), str(rate), vehicle
    )


def _describe(
    stuck: dict[str, Any], healthy: dict[str, Any], sent: dict[str, int], stuck_reads: str
) -> list[str]:
    lines = []
    for vehicle, got in healthy.items():
        waits = vehicle == REPLAYED and stuck_reads == REPLAYED
        gap = "waits for the stuck reader" if waits else _verdict(got["gap"] <= MAX_GAP)
        complete = _verdict(got["received"] == sent[vehicle] and got["in order"])
        kind = "live" if vehicle == LIVE else "replayed"
        lines.append(
            f"  healthy, {kind:8}: at most {got['gap']:.3f} s without a message ({gap});"
            f" received {got['received']} of {sent[vehicle]} ({complete})"
        )
    for vehicle, got in stuck.items():
        kind = "live" if vehicle == LIVE else "replayed"
        counted = got["received"] + got["lost"] + got["dropped"]
        is_exact = (counted if vehicle == LIVE else got["received"]) == sent[vehicle] and got[
            "in order"
        ]
        lines.append(
            f"  stuck,   {kind:8}: received {got['received']}, lost {got['lost']}, dropped {got['dropped']},"
            f" together {counted} of {sent[vehicle]}, {'in order' if got['in order'] else 'NOT IN ORDER'}"
            f" ({_verdict(is_exact)})"
        )
    return lines


def _verdict(is_met: bool) -> str:
    return "met" if is_met else "MISSED"


if __name__ == "__main__":
    main()
