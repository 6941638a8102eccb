"""The command hz: measure rates, latencies and losses of streams."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, Final

from nedbus import Bus, clock
from nedbus.cli.follow import follow
from nedbus.cli.options import (
    ALL,
    CountOption,
    CsvOption,
    DurationOption,
    JsonOption,
    allow_one,
    command,
)
from nedbus.cli.output.streams import csv_line, write
from nedbus.cli.output.table import live_table
from nedbus.clock import format_duration
from nedbus.health import Health, Monitor, StreamState, describe_stream, stream_state
from nedbus_msgs import DOUBT_FLAGS, Address, Selection

_HEAD: Final = ("VEHICLE/TOPIC", "HZ", "JITTER", "LATENCY", "MAX", "LOST", "STATE")
_OPTIONAL: Final = ("JITTER", "MAX", "LATENCY", "LOST")
_CSV_HEAD: Final = (
    "time", "vehicle", "topic", "instance", "state", "reason", "rate", "usual_rate", "nominal", "jitter", "latency",
    "latency_max", "age", "messages", "lost", "gaps", "out_of_order", "reboots", *DOUBT_FLAGS,
)  # fmt: skip
_FORGET_AFTER: Final = 60.0  # s until a stream that is gone is hidden


@command
def hz(
    bus: Bus,
    selection: Selection = ALL,
    *,
    json_output: JsonOption = False,
    csv_output: CsvOption = False,
    count: CountOption = None,
    duration: DurationOption = None,
) -> None:
    """Measure rate, jitter, latency, loss and validity of each stream.

    Updates every second; the worst streams come first. With --json and --csv, each second has a line for every stream
    that received messages or changed its state.
    """
    allow_one({"--json": json_output, "--csv": csv_output})
    monitor = Monitor()
    written: dict[Address, tuple[int, str]] = {}
    with (
        bus.subscribe(
            *selection.topics, vehicle=selection.vehicles, instance=selection.instance, mode="every"
        ) as subscription,
        live_table(_HEAD, _OPTIONAL) as show_table,
    ):
        if csv_output:
            write(csv_line(_CSV_HEAD))

        def show() -> None:
            states = _states(bus, monitor)
            streams = sorted(
                states, key=lambda each: (each[2].severity, describe_stream(*each[1:]) == "ok")
            )
            if not (json_output or csv_output):
                show_table([_to_row(*each) for each in streams])
                return
            former = written.copy()
            written.clear()  # of streams that are no longer shown
            for address, health, state in streams:
                written[address] = health.messages, state.name
                if former.get(address) != written[address]:
                    fields: dict[str, Any] = {
                        "time": clock.utc(),
                        **asdict(address),
                        "state": state.name,
                    }
                    fields |= {"reason": state.reason, **asdict(health)}
                    cells = {**fields, **(health.flags or {}), "time": f"{fields['time']:.3f}"}
                    write(csv_line(map(cells.get, _CSV_HEAD)) if csv_output else json.dumps(fields))

        follow(bus, subscription, monitor.add, count=count, duration=duration, each_second=show)


def _states(bus: Bus, monitor: Monitor) -> Iterator[tuple[Address, Health, StreamState]]:
    publishers = bus.publishers(timeout=0.5)
    for address, health in monitor.snapshot().items():
        state = stream_state(health, publishers=publishers[address], connected=bus.connected)
        if state.name == "gone" and (health.age or 0.0) > _FORGET_AFTER:
            monitor.forget(address)
        else:
            yield address, health, state


def _to_row(address: Address, health: Health, state: StreamState) -> list[str]:
    rate = "-" if health.rate is None else f"{health.rate:.1f}"
    jitter = "-" if health.jitter is None else f"{health.jitter * 1e3:.1f} ms"
    latencies = []
    for latency in (health.latency, health.latency_max):
        if latency is None or health.rate is None:
            latencies.append("-")
        else:
            latencies.append(format_duration(latency))
    state_text = describe_stream(health, state)
    return [str(address), rate, jitter, *latencies, str(health.lost), state_text]
