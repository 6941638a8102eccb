"""Commands that watch: echo, hz."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated

import typer

from nedbus.bus import Bus
from nedbus.errors import NoDataError
from nedbus.health import Monitor
from nedbus.intake import Mode, Sample
from nedbus.subscriber import Subscription
from nedbus_msgs import ANY, Address

from .options import (
    CountOption,
    DurationOption,
    InstanceOption,
    JsonOption,
    TopicArgument,
    TopicOption,
    VehicleOption,
    choose,
    on_bus,
    tell,
    write,
)
from .text import to_cells, to_fields, to_json, to_line, to_table

_PATIENCE = 2.0  # s of silence after which a person is told that nothing comes


@on_bus
def echo(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: TopicOption = ANY,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    full: Annotated[bool, typer.Option("--full", "-f", help="All fields, each on its line")] = False,
    latest: Annotated[bool, typer.Option("--latest", help="Skip to the newest when this terminal is slow")] = False,
    json_output: JsonOption = False,
    interval: Annotated[float, typer.Option(min=0.0, help="Seconds between two messages shown of a stream")] = 0.0,
    count: CountOption = None,
    duration: DurationOption = None,
) -> None:
    """Print every message as it arrives, a line each."""
    show = to_json if json_output else to_fields if full else to_line
    due: dict[Address, float] = {}

    def print_one(sample: Sample) -> bool:
        if interval:
            now = time.monotonic()
            if now < due.get(sample.address, 0.0):
                return False
            due[sample.address] = now + interval
        write(show(sample))
        return True

    wanted = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance)
    mode: Mode = "latest" if latest else "every"
    with bus.subscribe(wanted.topic, vehicle=wanted.vehicle, instance=wanted.instance, mode=mode) as subscription:
        try:
            _watch(subscription, print_one, count=count, duration=duration)
        finally:
            _tell_counts(subscription)


@on_bus
def hz(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: TopicOption = ANY,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    json_output: JsonOption = False,
    count: CountOption = None,
    duration: DurationOption = None,
) -> None:
    """Measure rate, jitter, latency, loss and validity of each vehicle and topic, every second."""
    monitor = Monitor()
    wanted = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance)
    with bus.subscribe(wanted.topic, vehicle=wanted.vehicle, instance=wanted.instance, mode="every") as subscription:
        _watch(
            subscription,
            monitor.add,
            count=count,
            duration=duration,
            each_second=lambda: _show_health(monitor, json_output=json_output),
        )


def _watch(
    subscription: Subscription,
    show: Callable[[Sample], bool],
    *,
    count: int | None,
    duration: float | None,
    each_second: Callable[[], object] | None = None,
) -> None:
    """Show samples until there were enough, or for long enough; raise NoDataError if there were none in that time.

    `show` returns whether a sample counts.
    """
    start = time.monotonic()
    end = float("inf") if duration is None else start + duration
    tick, told, seen = start + 1.0, False, 0
    while (now := time.monotonic()) < end and (count is None or seen < count):
        if each_second is not None and now >= tick:
            each_second()
            tick += 1.0
        if not seen and not told and now > start + _PATIENCE:
            told = True
            tell(f"nothing on {subscription.name} yet, waiting; 'nedbus list' shows what there is")
        try:
            sample = subscription.receive(max(0.0, min(end, tick if each_second else now + 0.5) - now))
        except NoDataError:
            continue
        seen += show(sample)
    if each_second is not None and seen:
        each_second()
    if not seen:
        raise NoDataError(subscription.name, duration or 0.0)


def _show_health(monitor: Monitor, *, json_output: bool) -> None:
    rows = []
    for address, health in monitor.tell().items():
        if json_output:
            where = {"vehicle": address.vehicle, "topic": address.topic, "instance": address.instance}
            write(json.dumps({**where, **asdict(health)}))
        else:
            rows.append([str(address), *to_cells(health)])
    if rows:
        write(to_table(["VEHICLE/TOPIC", "HZ", "JITTER", "LATENCY", "MAX", "LOST", "STATE"], rows))


def _tell_counts(subscription: Subscription) -> None:
    counts = subscription.counts
    if counts.lost or counts.dropped or counts.invalid:
        tell(f"{counts.received} received, {counts.lost} lost, {counts.dropped} dropped, {counts.invalid} invalid")
