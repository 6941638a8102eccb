"""The command hz: measure rates, latencies and losses of streams."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Final, NamedTuple

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
    writer = _ChangeWriter(is_csv=csv_output)
    with (
        bus.subscribe(
            *selection.topics, vehicle=selection.vehicles, instance=selection.instance, mode="every"
        ) as subscription,
        live_table(_HEAD, _OPTIONAL) as show_table,
    ):
        if csv_output:
            write(csv_line(_CSV_HEAD))

        def show() -> None:
            streams = sorted(_streams(bus, monitor), key=_Stream.rank)
            if json_output or csv_output:
                writer.update(streams)
            else:
                show_table([stream.cells() for stream in streams])

        follow(bus, subscription, monitor.add, count=count, duration=duration, each_second=show)


class _Stream(NamedTuple):
    """A measured stream."""

    address: Address
    health: Health
    state: StreamState

    def rank(self) -> tuple[int, bool]:
        """Return the place in the table: the worst state first, and in a state the faulty streams."""
        return self.state.severity, describe_stream(self.health, self.state) == "ok"

    def cells(self) -> list[str]:
        """Return the cells of a row, with the columns of _HEAD."""
        health = self.health
        rate = jitter = latency = latency_max = "-"
        if health.rate is not None:
            rate = f"{health.rate:.1f}"
            if health.latency is not None:
                latency = format_duration(health.latency)
            if health.latency_max is not None:
                latency_max = format_duration(health.latency_max)
        if health.jitter is not None:
            jitter = f"{health.jitter * 1e3:.1f} ms"
        text = describe_stream(health, self.state)
        return [str(self.address), rate, jitter, latency, latency_max, str(health.lost), text]


class _ChangeWriter:
    """Write a line of JSON or CSV for each stream that received messages or changed its state since the last call."""

    def __init__(self, *, is_csv: bool) -> None:
        self._is_csv = is_csv
        self._written: dict[Address, tuple[int, str]] = {}  # number of messages, name of the state

    def update(self, streams: Iterable[_Stream]) -> None:
        """Write the changed streams, and forget those that are no longer shown."""
        former = self._written
        self._written = {}
        for stream in streams:
            content = stream.health.messages, stream.state.name
            self._written[stream.address] = content
            if former.get(stream.address) != content:
                self._write(stream)

    def _write(self, stream: _Stream) -> None:
        now = clock.utc()
        fields: dict[str, object] = {"time": now}
        fields |= asdict(stream.address)
        fields["state"] = stream.state.name
        fields["reason"] = stream.state.reason
        fields |= asdict(stream.health)
        if not self._is_csv:
            write(json.dumps(fields))
            return
        fields["time"] = f"{now:.3f}"
        fields |= stream.health.flags or {}
        write(csv_line(map(fields.get, _CSV_HEAD)))


def _streams(bus: Bus, monitor: Monitor) -> Iterator[_Stream]:
    """Yield the streams; forget those that have been gone for long."""
    publishers = bus.publishers(timeout=0.5)
    for address, health in monitor.snapshot().items():
        state = stream_state(health, publishers=publishers[address], connected=bus.connected)
        if state.name == "gone" and (health.age or 0.0) > _FORGET_AFTER:
            monitor.forget(address)
        else:
            yield _Stream(address, health, state)
