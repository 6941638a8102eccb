"""Commands that query once: list, get, info, health, schema."""

from __future__ import annotations

import json
import socket
import time
from typing import Annotated

import typer

from nedbus.client import Bus, Health
from nedbus.errors import NedbusError
from nedbus_msgs import ANY, Address, json_schema, layout_table, message_doubts

from .format import to_age, to_fields, to_json, to_state, to_table
from .options import (
    InstanceOption,
    JsonOption,
    PositionTopicOption,
    TopicArgument,
    VehicleOption,
    choose,
    command,
    on_bus,
    write,
    write_stderr,
)


@on_bus
def list_(bus: Bus, *, json_output: JsonOption = False) -> None:
    """List the vehicles and topics that are published now, and how old their last message is."""
    addresses = [address for addresses in bus.vehicles().values() for address in addresses]
    newest = {sample.address: sample for sample in bus.latest(ANY)}
    rows = []
    for address in addresses:
        sample = newest.get(address)
        age = None if sample is None or sample.sent is None else (time.time_ns() - sample.sent) / 1e9
        if json_output:
            write(json.dumps({**_chunks(address), "age": age}))
        state = message_doubts(sample.message) if sample else "no answer"
        rows.append([str(address), "-" if age is None else to_age(age), state])
    if not json_output and rows:
        write(to_table(["VEHICLE/TOPIC", "AGE", "STATE"], rows))
    if not rows:
        write_stderr(f"no vehicle is published at {' or '.join(bus.routers)}: start a source with 'nedbus serve'")


@on_bus
def get(
    bus: Bus,
    topic: TopicArgument = None,
    *,
    topic_option: PositionTopicOption = None,
    vehicle: VehicleOption = ANY,
    instance: InstanceOption = None,
    json_output: JsonOption = False,
) -> None:
    """Show the last message of each vehicle and topic, all fields; exit 1 when there is none."""
    selection = choose(topic, topic=topic_option, vehicle=vehicle, instance=instance)
    samples = bus.latest(selection.topic, vehicle=selection.vehicle, instance=selection.instance)
    for sample in samples:
        write(to_json(sample) if json_output else to_fields(sample))
    if not samples:
        write_stderr(f"nothing is published on {selection.key_expr(prefix=bus.prefix)}: 'nedbus list' shows what is")
        raise typer.Exit(1)


@on_bus
def info(bus: Bus, *, json_output: JsonOption = False) -> None:
    """Show the services on this network: the state of their sources and streams, and what was rejected."""
    services = bus.services()
    vehicles = bus.vehicles()
    if json_output:
        for service in services:
            write(json.dumps(service))
        return
    write(f"router    {' or '.join(bus.routers)}")
    write(f"vehicles  {', '.join(vehicles) or 'none'}")
    for service in services:
        write(f"\nservice {service.get('service')}, nedbus {service.get('version')}, as {service.get('role')}")
        rows = [_source_row(source) for source in _sources(service)]
        if rows:
            write(to_table(["SOURCE", "STATE", "PUBLISHED", "REJECTED", "LOST", "REBOOTS", "RETRIES", "REMARK"], rows))
        streams = [row for source in _sources(service) for row in _stream_rows(source)]
        if streams:
            write("\n" + to_table(["VEHICLE/TOPIC", "HZ", "OF", "AGE", "MESSAGES", "STATE"], streams))
    if not services:
        write_stderr("no nedbus service answers here")


@on_bus
def health(bus: Bus) -> None:
    """Exit 0 when the services of this host answer and all their sources work, else 1 with the reason."""
    host = socket.gethostname()
    own = [service for service in bus.services() if service.get("host") == host]
    if not own:
        raise NedbusError(f"no service of {host} answers at {' or '.join(bus.routers)}")
    sources = [source for service in own for source in _sources(service)]
    for source in sources:
        if source.get("state") in {"retrying", "failed"}:
            raise NedbusError(f"{source.get('source')} is {source.get('state')}: {source.get('error')}")
    write(f"{len(own)} services, {len(sources)} sources, {sum(map(_published, sources))} messages published")


@command
def schema(
    *, layouts: Annotated[bool, typer.Option("--layouts", help="PX4's layouts: fields and types in order")] = False
) -> None:
    """Print the JSON Schema of a message, or the layouts that can be read."""
    write(json.dumps(layout_table() if layouts else json_schema(), indent=2))


def _chunks(address: Address) -> dict[str, object]:
    return {"vehicle": address.vehicle, "topic": address.topic, "instance": address.instance}


def _sources(service: dict[str, object]) -> list[dict[str, object]]:
    """Return the sources in the status of a service; the status comes from the network."""
    sources = service.get("sources")
    return [source for source in sources if isinstance(source, dict)] if isinstance(sources, list) else []


def _published(source: dict[str, object]) -> int:
    count = source.get("published")
    return count if isinstance(count, int) else 0


def _source_row(source: dict[str, object]) -> list[str]:
    keys = ("source", "state", "published", "rejected", "lost", "reboots", "retries")
    stale = source.get("stale")
    remark = f"stale: {', '.join(map(str, stale))}" if stale and isinstance(stale, list) else "-"
    return [*(str(source.get(key, "-")) for key in keys), str(source.get("error") or remark)]


def _stream_rows(source: dict[str, object]) -> list[list[str]]:
    """Return a row for each stream of a source that can be parsed; the status comes from the network."""
    streams = source.get("streams")
    rows = []
    for stream in streams if isinstance(streams, list) else ():
        try:
            health = Health(**stream["health"])
            rate = "-" if health.rate is None else f"{health.rate:.1f}"
            age = "-" if health.age is None else to_age(health.age)
            rows.append([stream["address"], rate, f"{health.nominal:g}", age, str(health.messages), to_state(health)])
        except (TypeError, KeyError, AttributeError, ValueError):
            continue  # of another version of nedbus
    return rows
