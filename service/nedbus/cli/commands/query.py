"""Commands that query the network once: list, get, schema."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from typing import Annotated, Any, Final

import typer

from nedbus import Bus, Sample
from nedbus.cli.absence import Absence, explain_absence
from nedbus.cli.options import (
    POSITIONS,
    FieldOption,
    JsonOption,
    VehiclesOption,
    command,
    parse_fields,
)
from nedbus.cli.output.samples import to_fields, to_json
from nedbus.cli.output.streams import write, write_stderr
from nedbus.cli.output.table import to_table
from nedbus.clock import format_duration
from nedbus.errors import AddressError, ConfigError, ConnectError
from nedbus.health import Health, StreamState, describe_stream, health_of_last, stream_state
from nedbus.timings import TIMINGS
from nedbus_msgs import (
    ANY,
    DEFAULT_TOPIC,
    MESSAGES,
    TOPICS,
    Address,
    Definition,
    Message,
    Selection,
    definition_of,
    get_topic,
)

_SIMILAR: Final = 0.8  # minimum similarity of a name that counts as a misspelling
# of a stream without a message so far, or whose publisher does not answer
_NO_MESSAGE: Final = "no last message"


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
    measured: dict[str, Health] = {}
    if newest:
        measured = _measured_by_services(bus)
    selected = {address for address in everything if selection.matches(address)}
    streams = []
    for address in sorted(selected | newest.keys()):
        stream = _Stream(address)
        sample = newest.get(address)
        if sample is not None:
            stream.evaluate(sample, measured.get(str(address)), everything[address])
        streams.append(stream)
    if json_output:
        for stream in streams:
            write(json.dumps(stream.fields()))
    elif streams:
        write(to_table(["VEHICLE/TOPIC", "AGE", "STATE"], [stream.cells() for stream in streams]))
    is_failure = not everything.complete
    if not streams:
        published = {address.vehicle for address in everything}
        absence = Absence("not all streams are listed: try again", is_fault=True)
        if everything.complete or published:
            absence = explain_absence(bus, published, vehicle or ())
        what = f"no vehicle {' or '.join(vehicle)}" if vehicle else "no vehicle"
        known = "is known yet"
        if everything.complete:
            known = "is published"
        write_stderr(f"{what} {known} at {' or '.join(bus.routers)}: {absence.reason}")
        is_failure = is_failure or absence.is_fault or bool(vehicle)
    if is_failure:
        raise typer.Exit(1)


@dataclass(slots=True)
class _Stream:
    """A listed stream; without a sample, health and state are None."""

    address: Address
    health: Health | None = None
    state: StreamState | None = None
    is_stored: bool = False

    def evaluate(self, sample: Sample[Message], measured: Health | None, publishers: int) -> None:
        """Derive health and state from the last sample."""
        self.health = health_of_last(sample, measured=measured)
        self.state = stream_state(self.health, publishers=publishers)
        self.is_stored = sample.stored

    def fields(self) -> dict[str, object]:
        """Return the fields of a line of JSON."""
        fields = asdict(self.address)
        fields |= {"age": None, "state": None, "reason": _NO_MESSAGE}
        if self.health:
            fields["age"] = self.health.age
        if self.state:
            fields["state"] = self.state.name
            fields["reason"] = self.state.reason
        fields["stored"] = self.is_stored
        return fields

    def cells(self) -> list[str]:
        """Return the cells of a row: address, age and state."""
        age = "-"
        text = _NO_MESSAGE
        if self.health and self.state:
            text = describe_stream(self.health, self.state)
            if self.health.age is not None:
                age = format_duration(self.health.age)
        if self.is_stored:
            text = f"stored, {text}"
        return [str(self.address), age, text]


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
        if json_output:
            write(to_json(sample, fields))
        else:
            write(to_fields(sample, fields))
    if all(sample.stored for sample in samples):
        reason = "no publisher answers: these messages are from a storage"
        if not samples:
            expression = ", ".join(selection.key_exprs(prefix=bus.prefix))
            reason = (
                f"nothing is published on {expression}: 'nedbus list' shows the published streams"
            )
        write_stderr(reason)
        raise typer.Exit(1)


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
    part = "json_schema"
    if layouts:
        part = "layouts"
    write(json.dumps(definition.schema()[part], indent=2))


def _ask_publisher(open_bus: Callable[[], Bus], name: str) -> Definition[Any]:
    """Return the definition of a published message, given by the name of its topic or its own."""
    reason = "and no such message or topic is published"
    topic = ANY
    try:
        if not name[:1].isupper():
            topic = name
            get_topic(name)  # raises AddressError for "*"
        with open_bus() as bus:
            for sample in bus.latest(topic):
                message: Message = sample.message
                if name in (message.DEFINITION.name, sample.topic):
                    return message.DEFINITION
    except AddressError:
        pass
    except ConnectError as exc:
        reason = f"and no publisher can be queried ({exc})"
    near = get_close_matches(name, [*MESSAGES, *TOPICS], 3, _SIMILAR)
    hint = f"known messages are {', '.join(MESSAGES)}"
    if near:
        hint = f"did you mean {' or '.join(near)}?"
    raise ConfigError("message", f"unknown message {name!r}, {reason}: {hint}")
