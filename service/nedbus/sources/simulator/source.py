"""Replay a simulated flight with all that its vehicle says: the same seed gives the same messages, to the bit."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from typing import NamedTuple

from nedbus.errors import SourceError
from nedbus.sources.options import SimulatorOptions
from nedbus.sources.source import ReplayRun, SourceContext, SourceMessage
from nedbus_msgs import BY_TOPIC, DEFAULT_TOPIC, Address

from .estimator import LAP, ORIGIN_SET, TICK, Estimator, truth_fields
from .trajectory import Trajectory, Truth
from .vehicle import SimulatedVehicle


class _Stream(NamedTuple):
    """Messages that are sent at some ticks, and the estimator that they need, if any."""

    address: Address
    ticks: range
    fields: Callable[[float, Truth], dict[str, object]]
    estimator: Estimator | None = None


class SimulatorSource:
    """The simulated flight; endless unless its options have a duration."""

    loop = False

    def __init__(self, _: str, options: SimulatorOptions, context: SourceContext) -> None:
        self._vehicle = options.vehicle or context.vehicle
        self._seed = options.seed
        self._topics = options.chosen_topics
        self._ticks = None if options.duration is None else round(options.duration / TICK)
        self.finite = options.duration is not None
        self.speed, self.wait = options.speed, options.wait

    def open(self) -> ReplayRun:
        """Start a new flight."""
        streams = self._streams(sys.maxsize if self._ticks is None else self._ticks)
        chosen = [
            each for each in streams if each.ticks and (self._topics is None or each.address.topic in self._topics)
        ]
        if not chosen:
            asked = ", ".join(sorted(self._topics or ()))
            known = ", ".join(sorted({each.address.topic for each in streams}))
            raise SourceError("sim", f"a simulated vehicle does not have {asked}, but {known}")
        total = None if self._ticks is None else sum(len(each.ticks) for each in chosen)
        return ReplayRun(
            messages=self._messages(streams, chosen),
            addresses=tuple(sorted((each.address for each in chosen), key=lambda each: each.topic != DEFAULT_TOPIC)),
            total=total,
            summary=f"vehicle {self._vehicle}, seed {self._seed}, "
            + ("endless" if self._ticks is None else f"{total} messages, {self._ticks * TICK:g} s"),
        )

    def _streams(self, end: int) -> tuple[_Stream, ...]:
        """Return all streams, in the order of their messages in one tick."""
        first, second = (Estimator(f"ekf {each}", self._seed, noise) for each, noise in enumerate((0.3, 0.5)))
        ins = Estimator("ins", self._seed, 0.05, aided=True)
        vehicle, origin = SimulatedVehicle(self._seed, first), round(ORIGIN_SET / TICK)
        at = partial(Address, self._vehicle)
        return (
            _Stream(at("vehicle_local_position_groundtruth"), range(0, end, 2), truth_fields),
            _Stream(at("external_ins_local_position"), range(1, end, 2), ins.fields, ins),
            _Stream(at("estimator_local_position", 0), range(0, end, 50), first.fields, first),
            _Stream(at("estimator_local_position", 1), range(0, end, 50), second.fields, second),
            _Stream(at("vehicle_local_position"), range(end), first.fields, first),
            _Stream(at("vehicle_attitude"), range(0, end, 2), first.attitude, first),
            _Stream(at("vehicle_global_position"), range(origin, end, 10), first.global_fields, first),
            _Stream(at("sensor_gps", 0), range(0, end, 10), vehicle.gps),
            _Stream(at("vehicle_status"), range(0, end, 50), vehicle.status, first),
            _Stream(at("vehicle_land_detected"), range(0, end, 100), vehicle.land_detected),
            _Stream(at("battery_status", 0), range(0, end, 100), vehicle.battery),
            _Stream(at("home_position"), range(0, min(end, origin + 1), origin), vehicle.home),
        )

    def _messages(self, streams: tuple[_Stream, ...], chosen: list[_Stream]) -> Iterator[SourceMessage]:
        trajectory = Trajectory(self._seed)
        estimators = list(dict.fromkeys(each.estimator for each in chosen if each.estimator))
        # `Estimator.fields` draws noise: it is called for what is not chosen too, so that the flight is the same.
        noisy = [estimator.fields for estimator in estimators]
        made = [each for each in streams if each in chosen or each.fields in noisy]
        absent = {each.address: _absent(each.address.topic) for each in chosen}
        for tick in count() if self._ticks is None else range(self._ticks):
            time = tick * TICK
            now = trajectory.at(time)
            for estimator in estimators:
                estimator.step(time % LAP, now)
            for each in made:
                if tick in each.ticks:
                    fields = each.fields(time, now)
                    if each.address in absent:
                        yield SourceMessage(time, each.address, absent[each.address] | fields)


def _absent(topic: str) -> dict[str, object]:
    """Return all fields that PX4's newest messages on a topic have, as "not known"."""
    layout = BY_TOPIC[topic].layout_of_release("main")
    return {name: kind.absent for name, kind in layout.types.items()} if layout else {}
