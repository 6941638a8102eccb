"""Commands that query the network once: list, get, info, schema."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from difflib import get_close_matches
from typing import Annotated, Any, Final

import typer

from nedbus import Bus, limits
from nedbus.cli.absence import explain_absence
from nedbus.cli.options import (
    POSITIONS,
    FieldOption,
    JsonOption,
    VehiclesOption,
    command,
    parse_fields,
)
from nedbus.cli.output.samples import to_fields, to_json
from nedbus.cli.output.streams import to_text, write, write_stderr
from nedbus.cli.output.table import fold, to_table
from nedbus.clock import format_duration
from nedbus.errors import AddressError, ConfigError, ConnectError
from nedbus.health import (
    Health,
    ServiceStatus,
    SourceStatus,
    StreamStatus,
    describe_stream,
    health_of_last,
    stream_state,
)
from nedbus.timings import TIMINGS
from nedbus_msgs import (
    ANY,
    DEFAULT_TOPIC,
    MESSAGES,
    TOPICS,
    Definition,
    Message,
    Selection,
    definition_of,
    get_topic,
)
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
_ABSENT: Final = {
    "stale": "gone: ",
    "silent": "announced, nothing arrives: ",
    "not_carried": "not carried: ",
}
_SIMILAR: Final = 0.8  # minimum similarity of a name that counts as a misspelling
# shown per source: damage of its file, or the first rejection of each origin
_WARNINGS: Final = 5


@command
def list_(bus: Bus, *, vehicle: VehiclesOption = None, json_output: JsonOption = False) -> None:
    """List the published streams with the state of each and the age of its last message.

    A stream is stale by the rule of `nedbus hz`, if a service publishes it: services report its usual interval.
    Without any, states the reason: a failed source, a vehicle's lost link, another prefix.
    Exits with 1 then, if the given vehicle is not published, and if the router is too slow or refuses the query.
    """
    selection = Selection(ANY, vehicle or ANY)
    everything = bus.publishers(timeout=TIMINGS.list_timeout)
    newest = {sample.address: sample for sample in bus.latest(ANY, vehicle=selection.vehicles)}
    measured = _measured_by_services(bus) if newest else {}
    rows, is_fault = [], False
    for address in sorted({*filter(selection.matches, everything), *newest}):
        sample = newest.get(address)
        health = health_of_last(sample, measured=measured.get(str(address))) if sample else None
        state = stream_state(health, publishers=everything[address]) if health else None
        age = health.age if health else None
        is_stored = sample is not None and sample.stored
        if json_output:
            name, reason = (state.name, state.reason) if state else (None, "no answer")
            write(
                json.dumps(
                    {
                        **asdict(address),
                        "age": age,
                        "state": name,
                        "reason": reason,
                        "stored": is_stored,
                    }
                )
            )
        text = describe_stream(health, state) if health and state else "no answer"
        since = "-" if age is None else format_duration(age)
        rows.append([str(address), since, f"stored, {text}" if is_stored else text])
    if rows and not json_output:
        write(to_table(["VEHICLE/TOPIC", "AGE", "STATE"], rows))
    if not rows:
        published = {address.vehicle for address in everything}
        hint, is_fault = "not all streams are listed: try again", True
        if everything.complete or published:
            hint, is_fault = explain_absence(bus, published, vehicle or ())
        what = f"no vehicle {' or '.join(vehicle)}" if vehicle else "no vehicle"
        known = "is published" if everything.complete else "is known yet"
        write_stderr(f"{what} {known} at {' or '.join(bus.routers)}: {hint}")
    if not everything.complete or (not rows and (vehicle or is_fault)):
        raise typer.Exit(1)


def _measured_by_services(bus: Bus) -> dict[str, Health]:
    """Return the health of the streams that services report, by address; one message reveals no usual interval."""
    return {
        stream.address: stream.health
        for service in bus.services()
        for stream in service.own_streams
    }


@command
def get(
    bus: Bus,
    selection: Selection = POSITIONS,
    *,
    field: FieldOption = None,
    json_output: JsonOption = False,
) -> None:
    """Show the last message of each stream with all its fields.

    Messages that only a storage still has are marked. Exits with 1 if no publisher answers.
    """
    fields = parse_fields(field, selection)
    samples = bus.latest(*selection.topics, vehicle=selection.vehicles, instance=selection.instance)
    for sample in samples:
        write(to_json(sample, fields) if json_output else to_fields(sample, fields))
    if all(sample.stored for sample in samples):
        expression = ", ".join(selection.key_exprs(prefix=bus.prefix))
        nothing = f"nothing is published on {expression}: 'nedbus list' shows the published streams"
        write_stderr(
            "no publisher answers: these messages are from a storage" if samples else nothing
        )
        raise typer.Exit(1)


def _write_left_out(service: ServiceStatus) -> None:
    """Write what a service does not publish: topics that it lacks, and copies."""
    for what, head in _ABSENT.items():
        if absent := [each for source in service.sources for each in getattr(source, what)]:
            write(fold(head, to_text(", ".join(absent), limits.LIST_TEXT)))
    if copies := sum(source.copies for source in service.sources):
        write(
            f"left out: {copies} messages that came again, or late, over a second link to their vehicle"
        )


@command
def info(bus: Bus, *, json_output: JsonOption = False) -> None:
    """Show the services on the network with their sources and streams."""
    services, vehicles = bus.services(), bus.vehicles()
    if json_output:
        for service in services:
            write(json.dumps(asdict(service)))
        return
    write(f"router    {' or '.join(bus.routers)}")
    write(f"vehicles  {to_text(', '.join(vehicles) or 'none', limits.LIST_TEXT)}")
    for service in services[: limits.TABLE_ROWS]:
        write(f"\n{_head_of(service)}")
        rows = [
            [*map(to_text, (
                each.source, each.state, each.published, each.rejected,
                _lost_of(each), each.reboots, each.retries,
                each.error or each.overload or (f"{len(each.stale)} gone" if each.stale else "-"),
            ))]
            for each in service.sources
        ]  # fmt: skip
        if rows:
            write(
                to_table(_SOURCE_HEAD, rows, optional=_SOURCE_OPTIONAL, max_rows=limits.TABLE_ROWS)
            )
        _write_left_out(service)
        for text in (each for source in service.sources for each in source.warnings[:_WARNINGS]):
            write(fold("warning: ", to_text(text, limits.LIST_TEXT)))
        for head, text in _links_of(service):
            write(fold(f"{head}: ", to_text(text, limits.LIST_TEXT)))
        if refused := service.refused:
            write(
                fold(
                    "vehicles refused by the router: ",
                    to_text(", ".join(refused), limits.LIST_TEXT),
                )
            )
        streams = [
            _stream_row(source, refused, each)
            for source in service.sources
            for each in source.streams
        ]
        if streams:
            table = to_table(
                _STREAM_HEAD, streams, optional=_STREAM_OPTIONAL, max_rows=limits.TABLE_ROWS
            )
            write(f"\n{table}")
    if len(services) > limits.TABLE_ROWS:
        write(counted(len(services) - limits.TABLE_ROWS, "more service"))
    if not services:
        write_stderr(
            "no nedbus service answers: start one with 'nedbus serve', or run 'nedbus doctor'"
        )


def _lost_of(source: SourceStatus) -> str:
    """Return the number of lost messages, marked if gaps in a ULog stream make it an estimate."""
    is_estimate = any(log.gaps for log in source.log_streams)
    return f"~{source.lost}" if is_estimate else str(source.lost)


def _links_of(service: ServiceStatus) -> Iterator[tuple[str, str]]:
    """Yield head and text of each ULog stream that a service receives, and of the positions that it sends."""
    for source in service.sources:
        for log in source.log_streams:
            yield f"ULog stream of vehicle {to_text(log.vehicle)}", log.text
        for position in source.positions:
            yield f"position into vehicle {to_text(position.vehicle)}", position.text


@command
def schema(
    open_bus: Callable[[], Bus],
    message: Annotated[
        str, typer.Argument(help="Message, such as VehicleAttitude, or topic")
    ] = DEFAULT_TOPIC,
    *,
    layouts: Annotated[
        bool, typer.Option("--layouts", help="Print PX4's layouts: fields and types in order")
    ] = False,
) -> None:
    """Print the JSON Schema of a message, or its supported layouts.

    The schema of a message that is not built in is requested from its publisher, by its name or its topic's.
    """
    try:
        definition: Definition[Any] = definition_of(message)
    except KeyError:
        definition = _ask_publisher(open_bus, message)
    write(json.dumps(definition.schema()["layouts" if layouts else "json_schema"], indent=2))


def _ask_publisher(open_bus: Callable[[], Bus], name: str) -> Definition[Any]:
    """Return the definition of a published message, given by the name of its topic or its own."""
    reason = "and no such message or topic is published"
    is_message_name = name[:1].isupper()
    try:
        if not is_message_name:
            get_topic(name)  # raises AddressError for "*"
        with open_bus() as bus:
            for sample in bus.latest(ANY if is_message_name else name):
                message: Message = sample.message
                if name in (message.DEFINITION.name, sample.topic):
                    return message.DEFINITION
    except AddressError:
        pass
    except ConnectError as exc:
        reason = f"and no publisher can be queried ({exc})"
    near = get_close_matches(name, [*MESSAGES, *TOPICS], 3, _SIMILAR)
    hint = (
        f"did you mean {' or '.join(near)}?"
        if near
        else f"known messages are {', '.join(MESSAGES)}"
    )
    raise ConfigError("message", f"unknown message {name!r}, {reason}: {hint}")


def _head_of(service: ServiceStatus) -> str:
    name, version, role, host = map(
        to_text, (service.service, service.version, service.role, service.host)
    )
    if service.is_outdated:
        reason = "its status does not name its vehicle, and is not shown: update nedbus on its host"
        return f"service {name} on {host}, nedbus {version}: {reason}"
    return f"service {name}, nedbus {version}, as {role}, vehicle {to_text(service.vehicle)}"


def _stream_row(source: SourceStatus, refused: Sequence[str], stream: StreamStatus) -> list[str]:
    address, health = stream.address, stream.health
    state = stream_state(health, publishers=int(address in source.addresses))
    is_refused = address.partition("/")[0] in refused
    suffix = ", by PX4's definition" if TOPICS.keys().isdisjoint(address.split("/")) else ""
    return [
        to_text(address),
        "-" if health.rate is None else f"{health.rate:.1f}",
        f"{health.nominal:g}" if health.nominal else "-",
        "-" if health.age is None else format_duration(health.age),
        str(health.messages),
        "refused by the router" if is_refused else describe_stream(health, state) + suffix,
    ]
