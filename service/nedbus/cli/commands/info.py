"""The command info: the services on the network with their sources and streams."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Final

from nedbus import Bus, limits
from nedbus.cli.options import JsonOption, command
from nedbus.cli.output.streams import to_text, write, write_stderr
from nedbus.cli.output.table import fold, to_table
from nedbus.clock import format_duration
from nedbus.health import ServiceStatus, SourceStatus, StreamStatus, describe_stream, stream_state
from nedbus_msgs import TOPICS
from nedbus_msgs.text import counted

_SOURCE_HEAD: Final = (
    "SOURCE",
    "STATE",
    "PUBLISHED",
    "REJECTED",
    "LOST",
    "REBOOTS",
    "RETRIES",
    "REMARK",
)
_SOURCE_OPTIONAL: Final = ("REBOOTS", "RETRIES", "LOST", "REJECTED", "PUBLISHED")
_STREAM_HEAD: Final = ("VEHICLE/TOPIC", "HZ", "OF", "AGE", "MESSAGES", "STATE")
_STREAM_OPTIONAL: Final = ("OF", "MESSAGES", "AGE")
# shown per source: damage of its file, or the first rejection of each origin
_WARNINGS: Final = 5


@command
def info(bus: Bus, *, json_output: JsonOption = False) -> None:
    """Show the services on the network with their sources and streams."""
    services = bus.services()
    vehicles = bus.vehicles()
    if json_output:
        for service in services:
            write(json.dumps(asdict(service)))
        return
    write(f"router    {' or '.join(bus.routers)}")
    write(f"vehicles  {to_text(', '.join(vehicles) or 'none', limits.LIST_TEXT)}")
    for service in services[: limits.TABLE_ROWS]:
        _show_service(service)
    if len(services) > limits.TABLE_ROWS:
        write(counted(len(services) - limits.TABLE_ROWS, "more service"))
    if not services:
        write_stderr(
            "no nedbus service answers: start one with 'nedbus serve', or run 'nedbus doctor'"
        )


def _show_service(service: ServiceStatus) -> None:
    write(f"\n{_title(service)}")
    sources = [_source_row(source) for source in service.sources]
    if sources:
        table = to_table(
            _SOURCE_HEAD, sources, optional=_SOURCE_OPTIONAL, max_rows=limits.TABLE_ROWS
        )
        write(table)
    for head, text in _remarks(service):
        write(fold(f"{head}: ", to_text(text, limits.LIST_TEXT)))
    streams = [
        _stream_row(service, source, stream)
        for source in service.sources
        for stream in source.streams
    ]
    if streams:
        table = to_table(
            _STREAM_HEAD, streams, optional=_STREAM_OPTIONAL, max_rows=limits.TABLE_ROWS
        )
        write(f"\n{table}")


def _title(service: ServiceStatus) -> str:
    name = to_text(service.service)
    version = to_text(service.version)
    if service.is_outdated:
        reason = "its status does not name its vehicle, and is not shown: update nedbus on its host"
        return f"service {name} on {to_text(service.host)}, nedbus {version}: {reason}"
    role = to_text(service.role)
    return f"service {name}, nedbus {version}, as {role}, vehicle {to_text(service.vehicle)}"


def _remarks(service: ServiceStatus) -> Iterator[tuple[str, str]]:
    """Yield head and text of each remark on what a service does not publish, receives or sends."""
    absent: dict[str, list[str]] = {
        "gone": [],
        "announced, nothing arrives": [],
        "not carried": [],
    }
    copies = 0
    for source in service.sources:
        absent["gone"] += source.stale
        absent["announced, nothing arrives"] += source.silent
        absent["not carried"] += source.not_carried
        copies += source.copies
    for head, names in absent.items():
        if names:
            yield head, ", ".join(names)
    if copies:
        yield (
            "left out",
            f"{copies} messages that came again, or late, over a second link to their vehicle",
        )
    for source in service.sources:
        for warning in source.warnings[:_WARNINGS]:
            yield "warning", warning
    for source in service.sources:
        for log in source.log_streams:
            yield f"ULog stream of vehicle {to_text(log.vehicle)}", log.text
        for position in source.positions:
            yield f"position into vehicle {to_text(position.vehicle)}", position.text
    if service.refused:
        yield "vehicles refused by the router", ", ".join(service.refused)


def _source_row(source: SourceStatus) -> list[str]:
    lost = str(source.lost)
    if any(log.gaps for log in source.log_streams):
        lost = f"~{lost}"  # gaps in a ULog stream make it an estimate
    remark = source.error or source.overload
    if not remark:
        remark = "-"
        if source.stale:
            remark = f"{len(source.stale)} gone"
    cells = (
        source.source,
        source.state,
        source.published,
        source.rejected,
        lost,
        source.reboots,
        source.retries,
        remark,
    )
    return [to_text(cell) for cell in cells]


def _stream_row(service: ServiceStatus, source: SourceStatus, stream: StreamStatus) -> list[str]:
    health = stream.health
    vehicle, *names = stream.address.split("/")
    if vehicle in service.refused:
        text = "refused by the router"
    else:
        publishers = 0
        if stream.address in source.addresses:
            publishers = 1
        text = describe_stream(health, stream_state(health, publishers=publishers))
        if TOPICS.keys().isdisjoint(names):
            text += ", by PX4's definition"
    rate = "-"
    if health.rate is not None:
        rate = f"{health.rate:.1f}"
    nominal = "-"
    if health.nominal:
        nominal = f"{health.nominal:g}"
    age = "-"
    if health.age is not None:
        age = format_duration(health.age)
    return [to_text(stream.address), rate, nominal, age, str(health.messages), text]
