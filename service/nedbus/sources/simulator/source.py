"""Replay a simulated flight with all topics of its vehicle; the same seed gives identical messages."""

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import count
from random import Random

from nedbus.errors import SourceError
from nedbus.sources.options import SimulatorOptions
from nedbus.sources.source import ReplayRun, SourceMessage
from nedbus_msgs import BY_TOPIC, DEFAULT_TOPIC, Address

from . import flight
from .flight import TICK, Truth

Fields = Callable[[float, Truth], dict[str, object]]  # of a message, given time since start and truth


def open_simulator(_: str, options: SimulatorOptions, default_vehicle: str) -> ReplayRun:
    """Start a flight, endless unless its options set a duration; raise SourceError without any requested topic."""
    vehicle, topics = options.vehicle or default_vehicle, options.chosen_topics
    ticks = None if options.duration is None else round(options.duration / TICK)
    streams = _streams(vehicle, options.seed, sys.maxsize if ticks is None else ticks)
    chosen = {
        address: stream
        for address, stream in streams.items()
        if stream[0] and (topics is None or address.topic in topics)
    }
    if not chosen:
        asked = ", ".join(sorted(topics or ()))
        known = ", ".join(sorted({address.topic for address in streams}))
        raise SourceError("sim", f"a simulated vehicle has no {asked}; choose from {known}")
    total = None if ticks is None else sum(len(ticks) for ticks, _ in chosen.values())
    length = "endless" if ticks is None else f"{total} messages, {ticks * TICK:g} s"
    return ReplayRun(
        messages=_messages(chosen, options.seed, ticks, options.origin or flight.REFERENCE),
        addresses=dict.fromkeys(sorted(chosen, key=lambda address: address.topic != DEFAULT_TOPIC)),
        total=total,
        summary=f"vehicle {vehicle}, seed {options.seed}, {length}",
    )


def _streams(vehicle: str, seed: int, end: int) -> dict[Address, tuple[range, Fields]]:
    """Return the ticks and the fields of all streams, in the order of their messages in one tick."""
    first, second = (flight.Estimator(f"ekf {each}", seed, noise) for each, noise in enumerate((0.3, 0.5)))
    ins = flight.Estimator("ins", seed, 0.05, aided=True)
    origin = round(flight.ORIGIN_SET / TICK)
    at = partial(Address, vehicle)
    return {
        at("vehicle_local_position_groundtruth"): (range(0, end, 2), flight.truth_fields),
        at("external_ins_local_position"): (range(1, end, 2), ins.fields),
        at("estimator_local_position", 0): (range(0, end, 50), first.fields),
        at("estimator_local_position", 1): (range(0, end, 50), second.fields),
        at("vehicle_local_position"): (range(end), first.fields),
        at("vehicle_attitude"): (range(0, end, 2), first.attitude),
        at("vehicle_global_position"): (range(origin, end, 10), first.global_fields),
        at("sensor_gps", 0): (range(0, end, 10), flight.gps),
        at("vehicle_status"): (range(0, end, 50), partial(flight.status, first)),
        at("vehicle_land_detected"): (range(0, end, 100), flight.land_detected),
        at("battery_status", 0): (range(0, end, 100), flight.battery),
        at("home_position"): (range(0, min(end, origin + 1), origin), flight.home),
    }


def _messages(
    chosen: Mapping[Address, tuple[range, Fields]], seed: int, ticks: int | None, origin: tuple[float, float, float]
) -> Iterator[SourceMessage]:
    direction = Random(f"{seed}/turn").uniform(-math.pi, math.pi)
    absent = {}  # the fields of PX4's newest layout, as "not provided"
    for address in chosen:
        layout = BY_TOPIC[address.topic].layout_of_release("main")
        absent[address] = {name: kind.absent for name, kind in layout.types.items()} if layout else {}
    for tick in count() if ticks is None else range(ticks):
        time = tick * TICK
        now = flight.truth_at(time, direction, origin)
        for address, (when, fields) in chosen.items():
            if tick in when:
                yield SourceMessage(time, address, absent[address] | fields(time, now))
