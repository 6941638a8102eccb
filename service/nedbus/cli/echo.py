"""The command that prints messages as they arrive: echo."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import typer

from nedbus.client import Bus, Mode, Sample, Subscription, check_max_rate
from nedbus.errors import ConfigError
from nedbus_msgs import ANY, Address, Definition

from .follow import Link, follow
from .format import to_csv, to_csv_head, to_fields, to_json
from .lines import Lines
from .options import (
    CountOption,
    CsvOption,
    DurationOption,
    FieldOption,
    InstanceOption,
    JsonOption,
    PositionTopicOption,
    TopicArgument,
    VehicleOption,
    choose,
    lazily_on_bus,
    parse_fields,
    require_one,
    write,
    write_stderr,
)


@lazily_on_bus
def echo(
    open_bus: Callable[[], Bus],
    topic: TopicArgument = None,
    *,
    topic_option: PositionTopicOption = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    field: FieldOption = None,
    full: Annotated[bool, typer.Option("--full", "-f", help="All fields, each on its line")] = False,
    every: Annotated[
        bool,
        typer.Option(
            "--every",
            help="Print every message, in order; a replay at speed=max then waits for this terminal or pipe",
        ),
    ] = False,
    json_output: JsonOption = False,
    csv_output: CsvOption = False,
    interval: Annotated[float, typer.Option(min=0.0, help="Seconds between two messages shown of a stream")] = 0.0,
    max_rate: Annotated[
        float | None,
        typer.Option(
            "--max-rate",
            metavar="HZ",
            help="Messages a second of each stream, thinned by its publisher: for links that carry no more",
        ),
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="End after one message, as --count 1")] = False,
    count: CountOption = None,
    duration: DurationOption = None,
) -> None:
    """Print messages as they arrive, a line each; a terminal that is too slow skips to the newest (see --every)."""
    require_one({"--full": full, "--json": json_output, "--csv": csv_output})
    require_one({"--once": once, "--count": count is not None})
    if max_rate is not None:
        check_max_rate(max_rate)
    selection = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance)
    fields = parse_fields(field, selection)
    form = to_json if json_output else to_csv if csv_output else to_fields if full else Lines(selection)
    show: Callable[[Sample[Any]], str] = partial(form, fields=fields)
    due: dict[Address, float] = {}
    heads: dict[Definition[Any], str] = {}  # of CSV

    def print_one(sample: Sample[Any]) -> bool:
        if interval:
            now = time.monotonic()
            if now < due.get(sample.address, 0.0):
                return False
            due[sample.address] = now + interval
        definition = sample.message.DEFINITION
        if csv_output and definition not in heads:
            heads[definition] = to_csv_head(sample, fields)
            if len(set(heads.values())) > 1:
                raise ConfigError(
                    "--csv", f"a table has one kind of message, and {sample.address} is another: name a topic"
                )
            if len(heads) == 1:
                write(heads[definition])
        write(show(sample))
        return True

    mode: Mode = "every" if every else "latest"
    with open_bus() as bus, bus.subscribe_to(selection, mode=mode, max_rate=max_rate) as subscription:
        try:
            follow(subscription, print_one, link=Link(bus), count=1 if once else count, duration=duration)
        finally:
            if not isinstance(sys.exception(), BrokenPipeError):  # `| head` has what it wanted
                _write_counts(subscription)


def _write_counts(subscription: Subscription[Any]) -> None:
    counts = subscription.counts
    if counts.lost or counts.dropped or counts.invalid or counts.discarded:
        discarded = f", {counts.discarded} discarded" if counts.discarded else ""
        write_stderr(
            f"{counts.received} received, {counts.lost} lost, {counts.dropped} dropped, {counts.invalid} invalid"
            f"{discarded}"
        )
