"""Replay a simulated flight that has all four topics: the same seed gives the same messages, to the bit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import count

from nedbus_msgs import TOPICS, Address

from .options import SimulatorOptions
from .simulated_estimator import LAP, TICK, Estimator, truth_fields
from .simulated_trajectory import Trajectory
from .source import ReplayRun, SourceContext, SourceMessage


class SimulatorSource:
    """The simulated flight; endless unless its options have a duration."""

    loop = False

    def __init__(self, _: str, options: SimulatorOptions, context: SourceContext) -> None:
        self._vehicle = options.vehicle or context.vehicle
        self._seed = options.seed
        self._ticks = None if options.duration is None else round(options.duration / TICK)
        self.finite = options.duration is not None
        self.speed = None if options.speed == "max" else options.speed
        self.wait = options.wait

    def open(self) -> ReplayRun:
        """Start a new flight."""
        single = (Address(self._vehicle, topic.name) for topic in TOPICS.values() if not topic.instances)
        estimate, truth, external = single
        instances = [Address(self._vehicle, "estimator_local_position", instance) for instance in (0, 1)]
        # In every 100 ticks: 100 estimates, 50 truths, 50 external, 2 of each instance.
        total = None if self._ticks is None else 2 * self._ticks + 2 * math.ceil(self._ticks / 50)
        return ReplayRun(
            messages=self._messages(estimate, truth, external, instances),
            addresses=(estimate, truth, external, *instances),
            total=total,
            summary=f"vehicle {self._vehicle}, seed {self._seed}, "
            + ("endless" if self._ticks is None else f"{total} messages, {self._ticks * TICK:g} s"),
        )

    def _messages(
        self, estimate: Address, truth: Address, external: Address, instances: list[Address]
    ) -> Iterator[SourceMessage]:
        trajectory = Trajectory(self._seed)
        filters = [Estimator("ekf 0", self._seed, 0.3), Estimator("ekf 1", self._seed, 0.5)]
        ins = Estimator("ins", self._seed, 0.05, aided=True)
        for tick in count() if self._ticks is None else range(self._ticks):
            time = tick * TICK
            now = trajectory.at(time)
            for estimator in (*filters, ins):
                estimator.step(time % LAP, now)
            if tick % 2 == 0:
                yield SourceMessage(time, truth, truth_fields(time, now))
            else:
                yield SourceMessage(time, external, ins.fields(time, now))
            if tick % 50 == 0:
                for address, estimator in zip(instances, filters, strict=True):
                    yield SourceMessage(time, address, estimator.fields(time, now))
            yield SourceMessage(time, estimate, filters[0].fields(time, now))
