"""A reader of every message of a fleet: python -m benchmarks.fleet_reader VEHICLE ENDPOINT..., "*" for all vehicles.

It prints "ready" when it has subscribed, and does what it is told, a line each: `mark NAME TIME` begins a phase of that
name, and looks from when on there is of each stream a message that was published after TIME, in s since the epoch;
`report` waits until nothing arrives any more, and prints what was read as JSON.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

import nedbus

QUIET: Final = 15.0  # s without a message after which nothing more comes: Zenoh's recovery may take 10 s
LATE: Final = 1_000_000  # µs after which a message came by recovery, not live
_FINE: Final = 32  # steps of the histogram of latencies between 1 µs and 2 µs, and so on: 2 % each


def main() -> None:
    """Read, and report."""
    vehicle, *endpoints = sys.argv[1:]
    with nedbus.connect(endpoints, timeout=60.0) as bus:
        begin = time.time()
        with bus.subscribe(nedbus.ANY, vehicle=vehicle, mode="every") as subscription:
            readings = Readings(begin)
            threading.Thread(target=_listen, args=[readings], daemon=True).start()
            print("ready", flush=True)
            heard = time.monotonic()
            while not (readings.told and time.monotonic() > heard + QUIET):
                with suppress(nedbus.NoDataError):
                    readings.add(subscription.receive_batch(0.5))
                    heard = time.monotonic()
            counts = subscription.counts
        told = {"lost": counts.lost, "dropped": counts.dropped, "invalid": counts.invalid}
        print(json.dumps({**told, **readings.report()}), flush=True)
    os._exit(0)


def _listen(readings: Readings) -> None:
    for line in sys.stdin:
        word, *rest = line.split()
        if word == "mark":
            readings.mark(rest[0], float(rest[1]))
        readings.told |= word == "report"


@dataclass(slots=True, eq=False)
class Stream:
    """What was read of one stream, by the numbers of its messages."""

    first: int
    expected: int
    received: int = 0


@dataclass(slots=True, eq=False)
class Phase:
    """What was read from one mark to the next: latencies as a histogram, and when each stream was back."""

    name: str
    since: float
    missing: set[str]
    back: list[float] = field(default_factory=list)  # s after the mark
    latencies: Any = field(default_factory=lambda: np.zeros(_FINE * 40, np.int64))
    late: int = 0


class Readings:
    """All that was read: of each stream, in each phase, in each second."""

    def __init__(self, begin: float) -> None:
        self.told = False
        self._streams: dict[str, Stream] = {}
        self._holes: list[tuple[str, int, int, float]] = []  # stream, first number, how many, when it was noticed
        self._disordered = 0
        self._lock = threading.Lock()
        self._phases = [Phase("start", begin, set())]
        self._first_heard: list[float] = []  # of each stream, s after the subscription
        self._seconds: dict[int, list[int]] = {}  # received, late, missing, largest latency in µs

    def mark(self, name: str, since: float) -> None:
        """Begin a phase: from now on all streams are awaited that were heard before."""
        with self._lock:
            self._phases.append(Phase(name, since, set(self._streams)))

    def add(self, batch: nedbus.Batch) -> None:
        """Note what has arrived together."""
        with self._lock:
            now = batch.received // 1000
            stamps = batch.messages["timestamp"].astype(np.int64)
            ages = np.maximum(1, now - stamps)
            phase = self._phases[-1]
            phase.latencies += np.bincount((np.log2(ages) * _FINE).astype(np.int64), minlength=_FINE * 40)[: _FINE * 40]
            late = int((ages > LATE).sum())
            phase.late += late
            second = self._seconds.setdefault(now // 1_000_000, [0, 0, 0, 0])
            second[0] += len(batch)
            second[1] += late
            second[3] = max(second[3], int(ages.max()))
            names = [str(address) for address in batch.addresses]
            numbers = batch.messages["x"].astype(np.int64).tolist()
            for index, number, stamp in zip(batch.address_index.tolist(), numbers, stamps.tolist(), strict=True):
                second[2] += self._follow(names[index], number, now / 1e6)
                if phase.missing and stamp / 1e6 >= phase.since and names[index] in phase.missing:
                    phase.missing.discard(names[index])
                    phase.back.append(now / 1e6 - phase.since)

    def report(self) -> dict[str, Any]:
        """Return all of it for JSON."""
        return {
            "streams": {name: [each.first, each.expected, each.received] for name, each in self._streams.items()},
            "holes": self._holes,
            "disordered": self._disordered,
            "first heard": sorted(self._first_heard),
            "phases": [_describe(phase) for phase in self._phases],
            "seconds": self._seconds,
        }

    def _follow(self, name: str, number: int, now: float) -> int:
        """Note one message, and return how many are missing before it."""
        stream = self._streams.get(name)
        if stream is None:
            stream = self._streams[name] = Stream(number, number)
            self._first_heard.append(now - self._phases[0].since)
        hole = number - stream.expected
        if hole < 0:
            self._disordered += 1
            return 0
        if hole:
            self._holes.append((name, stream.expected, hole, now))
        stream.expected = number + 1
        stream.received += 1
        return hole


def _describe(phase: Phase) -> dict[str, Any]:
    counts = np.cumsum(phase.latencies)
    total = int(counts[-1])
    found = {
        f"p{part}": round(2.0 ** (float(np.searchsorted(counts, total * part / 100)) / _FINE) / 1000, 3)
        for part in (50, 99, 100)
    }
    back = sorted(phase.back)
    return {
        "name": phase.name,
        "since": phase.since,
        "received": total,
        "late": phase.late,
        "ms": found if total else {},
        "back median": round(back[len(back) // 2], 3) if back else None,
        "back all": round(back[-1], 3) if back and not phase.missing else None,
        "not back": len(phase.missing),
    }


if __name__ == "__main__":
    main()
