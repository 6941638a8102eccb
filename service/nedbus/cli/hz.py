"""The command that measures streams: hz."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Final

from nedbus.client import Bus, Health, Monitor, StreamState, describe_stream, stream_state, to_age
from nedbus_msgs import ANY, DOUBT_FLAGS, Address

from .follow import Link, follow
from .format import csv_line
from .live_table import LiveTable
from .options import (
    CountOption,
    CsvOption,
    DurationOption,
    InstanceOption,
    JsonOption,
    TopicArgument,
    TopicOption,
    VehicleOption,
    choose,
    on_bus,
    require_one,
    write,
)

_HEAD: Final = ("VEHICLE/TOPIC", "HZ", "JITTER", "LATENCY", "MAX", "LOST", "STATE")
_OPTIONAL: Final = ("JITTER", "MAX", "LATENCY", "LOST")
_MEASURES: Final = (
    "rate", "usual_rate", "nominal", "jitter", "latency", "latency_max", "age", "messages", "lost", "gaps",
    "out_of_order", "reboots",
)  # fmt: skip
_FORGET: Final = 60.0  # s after which a stream that is gone is not shown any more


@on_bus
def hz(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: TopicOption = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    json_output: JsonOption = False,
    csv_output: CsvOption = False,
    count: CountOption = None,
    duration: DurationOption = None,
) -> None:
    """Measure rate, jitter, latency, loss and validity of each vehicle and topic, every second, the worst first.

    With --json and --csv there is a line for each stream that had messages, or whose state changed.
    """
    require_one({"--json": json_output, "--csv": csv_output})
    streams = _Streams(bus, Link(bus))
    selection = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance, default=ANY)
    with bus.subscribe_to(selection, mode="every") as subscription, LiveTable(_HEAD, _OPTIONAL) as table:
        if csv_output:
            write(csv_line(["time", "vehicle", "topic", "instance", "state", "reason", *_MEASURES, *DOUBT_FLAGS]))

        def show() -> None:
            if json_output or csv_output:
                for line in streams.changed():
                    write(_to_csv(line) if csv_output else _to_json(line))
            else:
                table.show([_to_row(line) for line in streams.worst_first()])

        follow(subscription, streams.monitor.add, link=streams.link, count=count, duration=duration, each_second=show)


@dataclass(frozen=True, slots=True)
class _Line:
    address: Address
    health: Health
    state: StreamState


@dataclass(slots=True)
class _Streams:
    """All streams that are followed, with their states."""

    bus: Bus
    link: Link
    monitor: Monitor = field(default_factory=Monitor)
    _written: dict[Address, tuple[int, str]] = field(default_factory=dict)

    def worst_first(self) -> list[_Line]:
        """Return all streams; what is gone is forgotten after a minute."""
        connected = self.link.connected
        alive = {each for addresses in self.bus.vehicles(timeout=0.5).values() for each in addresses}
        lines = []
        for address, health in self.monitor.snapshot().items():
            state = stream_state(health, alive=address in alive, connected=connected)
            if state.name == "gone" and (health.age or 0.0) > _FORGET:
                self.monitor.forget(address)
                self._written.pop(address, None)
            else:
                lines.append(_Line(address, health, state))
        return sorted(lines, key=lambda line: (line.state.severity, describe_stream(line.health, line.state) == "ok"))

    def changed(self) -> list[_Line]:
        """Return the streams that had messages since the last call, or whose state changed."""
        lines = [
            line
            for line in self.worst_first()
            if self._written.get(line.address) != (line.health.messages, line.state.name)
        ]
        self._written.update({line.address: (line.health.messages, line.state.name) for line in lines})
        return lines


def _to_row(line: _Line) -> Sequence[str]:
    health, is_live = line.health, line.health.rate is not None
    return (
        str(line.address),
        f"{health.rate:.1f}" if health.rate is not None else "-",
        f"{health.jitter * 1e3:.1f} ms" if health.jitter is not None else "-",
        to_age(health.latency) if is_live and health.latency is not None else "-",
        to_age(health.latency_max) if is_live and health.latency_max is not None else "-",
        str(health.lost),
        describe_stream(health, line.state),
    )


def _to_json(line: _Line) -> str:
    address = line.address
    head = {"time": time.time(), "vehicle": address.vehicle, "topic": address.topic, "instance": address.instance}
    return json.dumps({**head, "state": line.state.name, "reason": line.state.reason, **asdict(line.health)})


def _to_csv(line: _Line) -> str:
    address, health, flags = line.address, line.health, line.health.flags or {}
    return csv_line(
        [
            f"{time.time():.3f}",
            address.vehicle,
            address.topic,
            address.instance,
            line.state.name,
            line.state.reason,
            *(getattr(health, name) for name in _MEASURES),
            *(flags.get(name) for name in DOUBT_FLAGS),
        ]
    )
