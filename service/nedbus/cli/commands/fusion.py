"""The command fusion: whether a position that is sent into a vehicle is used, live or from a file."""

import json
import math
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import nedbus
from nedbus import limits
from nedbus.cli.options import (
    DurationOption,
    FilesArgument,
    JsonOption,
    OpenBus,
    VehiclesOption,
    command,
)
from nedbus.cli.output.streams import to_text, write, write_stderr
from nedbus.cli.output.table import fold
from nedbus.errors import ConfigError, NoDataError
from nedbus.fusion import FUSION_TOPICS, fusion_changes
from nedbus.health import Fusion
from nedbus_msgs import ANY

if TYPE_CHECKING:
    from nedbus import Bus, Sample
    from nedbus.health import PositionStatus

_STATUS_INTERVAL: Final = 1.0  # s between two queries of what is sent


@command
def fusion(
    open_bus: OpenBus,
    files: FilesArgument = None,
    *,
    vehicle: VehiclesOption = None,
    json_output: JsonOption = False,
    duration: DurationOption = None,
) -> None:
    """Show whether a position that is sent into a vehicle is used, and why not, live or from a file.

    One report for each change: position, height, velocity and yaw are fused, rejected, not used or not received, since
    when, and which mistake explains it. Times are seconds since the boot of the vehicle.
    """
    if files:
        if duration is not None:
            raise ConfigError("--duration", "needs live vehicles, not a file")
        for path in files:
            _show_file(path, vehicle, json_output=json_output)
        return
    with open_bus() as bus:
        sent: dict[str, PositionStatus] = {}
        _show(fusion_changes(_follow(bus, vehicle, duration, sent), sent), json_output=json_output)


def _show_file(path: Path, vehicles: list[str] | None, *, json_output: bool) -> None:
    with nedbus.open(path) as flight:
        topics = {address.topic for address in flight.addresses} & {*FUSION_TOPICS}
        if not topics:
            raise NoDataError(f"{path}: topics {', '.join(FUSION_TOPICS)}", 0.0)
        samples = flight(*sorted(topics), vehicle=vehicles or ANY)
        _show(fusion_changes(samples), json_output=json_output)


def _follow(
    bus: "Bus",
    vehicles: list[str] | None,
    duration: float | None,
    sent: "dict[str, PositionStatus]",
) -> "Iterator[Sample[Any]]":
    """Yield live samples, and update what is sent."""
    if duration is None:
        end = math.inf
    else:
        end = time.monotonic() + duration
    next_status = 0.0
    has_data = False
    with bus.subscribe(*FUSION_TOPICS, vehicle=vehicles or ANY, mode="every") as subscription:
        while (now := time.monotonic()) < end:
            if now >= next_status:
                next_status = now + _STATUS_INTERVAL
                _update_sent(bus, sent)
            with suppress(NoDataError):
                sample = subscription.receive(min(_STATUS_INTERVAL, max(0.0, end - now)))
                has_data = True
                yield sample
    if not has_data:
        names = ", ".join(vehicles or ["all vehicles"])
        raise NoDataError(f"{names}: topics {', '.join(FUSION_TOPICS)}", duration or 0.0)


def _update_sent(bus: "Bus", sent: "dict[str, PositionStatus]") -> None:
    for service in bus.services(timeout=0.5):
        for source in service.sources:
            for position in source.positions:
                sent[position.vehicle] = position


def _show(changes: Iterator[tuple[float, Fusion]], *, json_output: bool) -> None:
    for seconds, report in changes:
        if json_output:
            write(json.dumps({"time": seconds} | asdict(report)))
            continue
        for line in report.lines:
            write(fold(f"{report.vehicle}: {seconds:.1f} s: ", to_text(line, limits.LINE_TEXT)))
    if not json_output:
        write_stderr("times: seconds since the boot of the vehicle")
