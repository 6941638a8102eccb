"""Vehicles in sessions of their own, all in one process: python -m benchmarks.fleet_vehicles, with a `Part` on stdin.

When all sessions are open and all publishers declared it prints how long that took in s.
It then does what it is told, a word a line: `start` publishes, `restart` closes all sessions and opens them again after
a second, `stop` publishes no more and prints as JSON how many messages of each stream were published.
The sessions stay open, and the publishers keep what they sent, until stdin is closed.

Each message has its number in its stream as `x`, which goes on in the sessions after a restart, and when it was
published as `timestamp`, in µs since the epoch.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from tests.first_message import FIELD_TYPES, PAYLOAD_SIZE, encode_array

import nedbus

from .fleet_plan import SLOT, Part
from .forms.fields import FIELDS

AWAY: Final = 1.0  # s between two sessions of a vehicle
_ENOUGH: Final = 0.1  # s after which the publishing thread has seen that a session ends


@dataclass(slots=True, eq=False)
class Stream:
    """One stream: its publisher while its session is open, and how many messages it has published.

    `starts`: the number of the first message of each session; what was before, nobody keeps any more.
    """

    publisher: nedbus.Publisher | None = None
    published: int = 0
    starts: list[int] = field(default_factory=list)


def main() -> None:
    """Do what the lines of stdin say."""
    part = Part(**json.loads(sys.stdin.readline()))
    vehicles = Vehicles(part)
    begin = time.monotonic()
    vehicles.open()
    print(time.monotonic() - begin, flush=True)
    thread: threading.Thread | None = None
    for line in sys.stdin:
        match line.strip():
            case "start":
                thread = threading.Thread(target=vehicles.publish, daemon=True)
                thread.start()
            case "restart":
                threading.Thread(target=vehicles.restart, daemon=True).start()
            case "stop" if thread is not None:
                vehicles.stop()
                thread.join()
                print(json.dumps(vehicles.report()), flush=True)
    os._exit(0)  # closing hundreds of sessions one by one proves nothing here


class Vehicles:
    """The sessions and the streams of one part of the fleet."""

    def __init__(self, part: Part) -> None:
        self._part = part
        self._streams = {address: Stream() for session in part.sessions for address in session.addresses}
        self._buses: list[nedbus.Bus] = []
        self._stopped = threading.Event()
        self._restarting = threading.Lock()
        self._late = 0.0

    def open(self) -> None:
        """Open all sessions, and a publisher for each stream."""
        for session in self._part.sessions:
            bus = nedbus.connect(session.endpoints, timeout=60.0)
            self._buses.append(bus)
            for address in session.addresses:
                vehicle, topic, *instance = address.split("/")
                stream = self._streams[address]
                stream.starts.append(stream.published)
                number = int(instance[0]) if instance else None
                stream.publisher = bus.publisher(topic, vehicle=vehicle, instance=number)

    def restart(self) -> None:
        """End all sessions as vehicles do that are switched off and on, and open them again."""
        with self._restarting:
            for stream in self._streams.values():
                stream.publisher = None
            time.sleep(_ENOUGH)
            buses, self._buses = self._buses, []
            for bus in buses:
                bus.close()
            time.sleep(AWAY)
            self.open()

    def publish(self) -> None:
        """Publish until it is stopped, in slots of 10 ms, all streams spread evenly over them."""
        streams = list(self._streams.values())
        slots = max(1, round(1 / self._part.rate / SLOT))
        shares = [streams[slot::slots] for slot in range(slots)]
        period = 1 / self._part.rate / slots
        messages = np.repeat(nedbus.to_array([nedbus.VehicleLocalPosition(**FIELDS)]), len(shares[0]))
        start, tick = time.monotonic(), 0
        while not self._stopped.is_set():
            wait = start + tick * period - time.monotonic()
            self._late = max(self._late, -wait)
            if wait > 0:
                time.sleep(wait)
            _publish(shares[tick % slots], messages)
            tick += 1

    def stop(self) -> None:
        """Publish no more; a restart is completed before."""
        with self._restarting:
            self._stopped.set()

    def report(self) -> dict[str, Any]:
        """Return what was published, and by how many seconds it was late at most."""
        streams = {address: [stream.published, stream.starts] for address, stream in self._streams.items()}
        return {"streams": streams, "late": self._late}


def _publish(streams: Sequence[Stream], messages: Any) -> None:
    """Publish one message of each stream whose session is open.

    This process stands for as many hosts as there are vehicles: what each would encode is encoded at once.
    """
    present = [(stream, stream.publisher) for stream in streams if stream.publisher is not None]
    if not present:
        return
    chosen = messages[: len(present)]
    chosen["timestamp"] = chosen["timestamp_sample"] = time.time_ns() // 1000
    chosen["x"] = [stream.published for stream, _ in present]
    payloads = encode_array(chosen)
    for start, (stream, publisher) in zip(range(0, len(payloads), PAYLOAD_SIZE), present, strict=True):
        payload = payloads[start : start + PAYLOAD_SIZE]
        publisher._put(payload, FIELD_TYPES.keys())  # noqa: SLF001 - what `publish` does with it
        stream.published += 1


if __name__ == "__main__":
    main()
