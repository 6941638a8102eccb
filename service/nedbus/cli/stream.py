"""Commands that follow streams: echo, hz."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Annotated, Final

import typer

from nedbus.client import Bus, Monitor, Sample, Subscription
from nedbus.errors import NoDataError
from nedbus_msgs import ANY, Address

from .format import to_cells, to_fields, to_json, to_line, to_table
from .options import (
    CountOption,
    DurationOption,
    InstanceOption,
    JsonOption,
    PositionTopicOption,
    TopicArgument,
    TopicOption,
    VehicleOption,
    choose,
    on_bus,
    write,
    write_stderr,
)

_NOTICE: Final = 2.0  # s without a sample after which stderr says so


@on_bus
def echo(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: PositionTopicOption = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    full: Annotated[bool, typer.Option("--full", "-f", help="All fields, each on its line")] = False,
    every: Annotated[
        bool,
        typer.Option(
            "--every",
            help="Print every message, in order; a replay at speed=max then waits for this terminal or pipe",
        ),
    ] = False,
    json_output: JsonOption = False,
    interval: Annotated[float, typer.Option(min=0.0, help="Seconds between two messages shown of a stream")] = 0.0,
    count: CountOption = None,
    duration: DurationOption = None,
) -> None:
    """Print messages as they arrive, a line each; a terminal that is too slow skips to the newest (see --every)."""
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

    selection = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance)
    with bus.subscribe_to(selection, mode="every" if every else "latest") as subscription:
        try:
            _follow(subscription, print_one, count=count, duration=duration)
        finally:
            if not isinstance(sys.exception(), BrokenPipeError):  # `| head` has what it wanted
                _write_counts(subscription)


@on_bus
def hz(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: TopicOption = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    json_output: JsonOption = False,
    count: CountOption = None,
    duration: DurationOption = None,
) -> None:
    """Measure rate, jitter, latency, loss and validity of each vehicle and topic, every second."""
    monitor = Monitor()
    selection = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance, default=ANY)
    with bus.subscribe_to(selection, mode="every") as subscription:
        _follow(
            subscription,
            monitor.add,
            count=count,
            duration=duration,
            each_second=lambda: _write_health(monitor, json_output=json_output),
        )


def _follow(
    subscription: Subscription,
    handle: Callable[[Sample], bool],
    *,
    count: int | None,
    duration: float | None,
    each_second: Callable[[], object] | None = None,
) -> None:
    """Handle samples until there were enough, or for so long; raise NoDataError if there were none in that time.

    `handle` returns whether a sample counts.
    """
    start = time.monotonic()
    end = float("inf") if duration is None else start + duration
    next_second, noticed, seen = start + 1.0, False, 0
    while (now := time.monotonic()) < end and (count is None or seen < count):
        if each_second is not None and now >= next_second:
            each_second()
            next_second += 1.0
        if not seen and not noticed and now > start + _NOTICE:
            noticed = True
            write_stderr(f"nothing on {subscription.name} yet, waiting; 'nedbus list' shows what is published")
        try:
            sample = subscription.receive(max(0.0, min(end, next_second if each_second else now + 0.5) - now))
        except NoDataError:
            continue
        seen += handle(sample)
    if each_second is not None and seen:
        each_second()
    if not seen:
        raise NoDataError(subscription.name, duration or 0.0)


def _write_health(monitor: Monitor, *, json_output: bool) -> None:
    rows = []
    for address, health in monitor.snapshot().items():
        if json_output:
            stream = {"vehicle": address.vehicle, "topic": address.topic, "instance": address.instance}
            write(json.dumps({**stream, **asdict(health)}))
        else:
            rows.append([str(address), *to_cells(health)])
    if rows:
        write(to_table(["VEHICLE/TOPIC", "HZ", "JITTER", "LATENCY", "MAX", "LOST", "STATE"], rows))


def _write_counts(subscription: Subscription) -> None:
    counts = subscription.counts
    if counts.lost or counts.dropped or counts.invalid:
        write_stderr(
            f"{counts.received} received, {counts.lost} lost, {counts.dropped} dropped, {counts.invalid} invalid"
        )
