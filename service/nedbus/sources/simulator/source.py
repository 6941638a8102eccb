"""Replay a simulated flight with all topics of its vehicle; the same seed gives identical messages."""

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from random import Random

from nedbus.errors import SourceError
from nedbus.sources.options import SimulatorOptions
from nedbus.sources.source import ReplayRun, SourceContext, SourceMessage
from nedbus_msgs import BY_TOPIC, DEFAULT_TOPIC, Address

from .flight import ORIGIN_SET, REFERENCE, TICK, Estimator, Truth, truth_at, truth_fields
from .vehicle import battery, gps, home, land_detected, status

Fields = Callable[[float, Truth], dict[str, object]]  # of a message, given time since start and truth


class SimulatorSource:
    """A simulated flight; endless unless its options set a duration."""

    loop = False

    def __init__(self, _: str, options: SimulatorOptions, context: SourceContext) -> None:
        self._vehicle = options.vehicle or context.vehicle
        self._seed, self._origin = options.seed, options.origin or REFERENCE
        self._topics = options.chosen_topics
        self._ticks = None if options.duration is None else round(options.duration / TICK)
        self.finite = options.duration is not None
        self.speed, self.wait = options.speed, options.wait

    def open(self) -> ReplayRun:
        """Start a new flight."""
        streams = self._streams(sys.maxsize if self._ticks is None else self._ticks)
        chosen = {
            address: stream
            for address, stream in streams.items()
            if stream[0] and (self._topics is None or address.topic in self._topics)
        }
        if not chosen:
            asked = ", ".join(sorted(self._topics or ()))
            known = ", ".join(sorted({address.topic for address in streams}))
            raise SourceError("sim", f"a simulated vehicle has no {asked}; choose from {known}")
        total = None if self._ticks is None else sum(len(ticks) for ticks, _ in chosen.values())
        return ReplayRun(
            messages=self._messages(chosen),
            addresses=dict.fromkeys(sorted(chosen, key=lambda address: address.topic != DEFAULT_TOPIC)),
            total=total,
            summary=f"vehicle {self._vehicle}, seed {self._seed}, "
            + ("endless" if self._ticks is None else f"{total} messages, {self._ticks * TICK:g} s"),
        )

    def _streams(self, end: int) -> dict[Address, tuple[range, Fields]]:
        """Return the ticks and the fields of all streams, in the order of their messages in one tick."""
        first, second = (Estimator(f"ekf {each}", self._seed, noise) for each, noise in enumerate((0.3, 0.5)))
        ins = Estimator("ins", self._seed, 0.05, aided=True)
        origin = round(ORIGIN_SET / TICK)
        at = partial(Address, self._vehicle)
        return {
            at("vehicle_local_position_groundtruth"): (range(0, end, 2), truth_fields),
            at("external_ins_local_position"): (range(1, end, 2), ins.fields),
            at("estimator_local_position", 0): (range(0, end, 50), first.fields),
            at("estimator_local_position", 1): (range(0, end, 50), second.fields),
            at("vehicle_local_position"): (range(end), first.fields),
            at("vehicle_attitude"): (range(0, end, 2), first.attitude),
            at("vehicle_global_position"): (range(origin, end, 10), first.global_fields),
            at("sensor_gps", 0): (range(0, end, 10), gps),
            at("vehicle_status"): (range(0, end, 50), partial(status, first)),
            at("vehicle_land_detected"): (range(0, end, 100), land_detected),
            at("battery_status", 0): (range(0, end, 100), battery),
            at("home_position"): (range(0, min(end, origin + 1), origin), home),
        }

    def _messages(self, chosen: Mapping[Address, tuple[range, Fields]]) -> Iterator[SourceMessage]:
        direction = Random(f"{self._seed}/turn").uniform(-math.pi, math.pi)
        absent = {address: _absent(address.topic) for address in chosen}
        for tick in count() if self._ticks is None else range(self._ticks):
            time = tick * TICK
            now = truth_at(time, direction, self._origin)
            for address, (ticks, fields) in chosen.items():
                if tick in ticks:
                    yield SourceMessage(time, address, absent[address] | fields(time, now))


def _absent(topic: str) -> dict[str, object]:
    """Return all fields of PX4's newest layout on a topic, as "not provided"."""
    layout = BY_TOPIC[topic].layout_of_release("main")
    return {name: kind.absent for name, kind in layout.types.items()} if layout else {}
