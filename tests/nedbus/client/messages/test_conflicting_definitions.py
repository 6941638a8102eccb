"""A message that several firmware builds define differently: readers use the definition of the sender."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Final

import hypothesis
import msgpack
import pytest
import zenoh
from hypothesis import strategies as st

import nedbus
from nedbus import Counts
from nedbus.cli.recorder import Recorder
from nedbus.flights.writer import RecordingWriter
from nedbus.transport import Session, open_router, query
from nedbus_msgs import (
    Address,
    Definition,
    Provenance,
    codec_of,
    define,
    encoding_of,
    field_type,
    short_hash,
)
from tests.flights.ulogs import UlogWriter
from tests.nedbus.client.numbered import wait_for_subscriber
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.peers.queryables import answer_queries, reply_with
from tests.waits import DEADLINE, wait_for, wait_for_matching

NAME, TOPIC = "WindCell", "wind_cell"
pytestmark = pytest.mark.usefixtures("long_lookup_timeout")

FIELDS: Final = {
    "A": ("timestamp", "north", "east"),
    "B": ("timestamp", "east", "north"),  # the same types: only the hash distinguishes them
    "C": ("timestamp", "east", "north", "down"),
}
VALUES: Final = {"north": 1.0, "east": 2.0, "down": 3.0}
Sent = tuple[str, dict[str, object]]
"""The vehicle and the fields of a message."""


def definition_of(firmware: str) -> Definition[Any]:
    types = [
        (name, field_type("uint64" if name == "timestamp" else "float32"))
        for name in FIELDS[firmware]
    ]
    return define(NAME, types)


def fields_of(firmware: str, timestamp: int) -> dict[str, object]:
    return {"timestamp": timestamp, **{name: VALUES[name] for name in FIELDS[firmware][1:]}}


def publisher_of(bus: nedbus.Bus, firmware: str, vehicle: str | None = None) -> nedbus.Publisher:
    return bus._publishers.publisher(
        Address(vehicle or firmware, TOPIC), definition_of(firmware), owner=bus
    )


def as_dict(message: Any) -> dict[str, object]:
    return dict(message._asdict() if hasattr(message, "_asdict") else message.model_dump())


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    where = free_endpoint()
    session = open_router(listen=(where,))
    yield where
    session.close()


class Reader:
    """A reader of all vehicles in mode `every`, as models, rows or batches (`form`)."""

    def __init__(self, endpoint: str, form: str) -> None:
        self.form = form
        self.bus = nedbus.connect(endpoint, timeout=DEADLINE)
        self.subscription = self.bus.subscribe(TOPIC, mode="every")
        self.read: list[Sent] = []

    def read_until(self, sent: Sent) -> None:
        while sent not in self.read:
            if self.form == "batches":
                batch = self.subscription.receive_batch(DEADLINE)
                names = batch.messages.dtype.names or ()
                for index, row in zip(batch.address_index, batch.messages.tolist(), strict=True):
                    self.read.append(
                        (batch.addresses[index].vehicle, dict(zip(names, row, strict=True)))
                    )
                continue
            # `rows()` has no timeout
            pop = partial(self.subscription._inbox.pop, self.form == "rows")
            sample = self.subscription._next(pop, DEADLINE)
            self.read.append((sample.vehicle, as_dict(sample.message)))


class Network:
    """Three readers and four vehicles: one vehicle per firmware build, and vehicle 1, which changes its firmware."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.stamps = count(1)
        self.buses: dict[str, nedbus.Bus] = {}
        self.publishers: dict[str, tuple[str, nedbus.Publisher]] = {}
        self.last: dict[str, Sent] = {}  # last message of each publisher
        self.slowest = 0.0  # s, the longest time until all readers have read a message
        self.readers = {form: Reader(endpoint, form) for form in FORMS}
        for firmware in FIELDS:
            self.restart(firmware)

    def restart(self, firmware: str) -> None:
        if firmware in self.buses:
            self.buses[firmware].close()
        bus = self.buses[firmware] = nedbus.connect(self.endpoint, timeout=DEADLINE)
        if "1" in self.publishers:
            self.publishers["1"][1].close()
        for vehicle in (firmware, "1"):
            self.publishers[vehicle] = firmware, publisher_of(bus, firmware, vehicle)
            self.last.pop(vehicle, None)

    def publish(self, firmware: str) -> None:
        for vehicle, (own, publisher) in self.publishers.items():
            if own == firmware:
                wait_for_subscriber(publisher)
                sent = self.last[vehicle] = vehicle, fields_of(firmware, next(self.stamps))
                publisher.publish(sent[1])
                start = time.monotonic()
                for reader in self.readers.values():
                    reader.read_until(sent)
                self.slowest = max(self.slowest, time.monotonic() - start)

    def restart_reader(self, form: str) -> None:
        self.readers[form].bus.close()
        self.readers[form] = Reader(self.endpoint, form)
        for sent in self.last.values():
            self.readers[form].read_until(sent)

    def close(self) -> None:
        for bus in [*self.buses.values(), *(reader.bus for reader in self.readers.values())]:
            bus.close()


FORMS: Final = ("models", "rows", "batches")
Steps = list[tuple[Callable[[Network, str], None], str]]
STEPS: Final = st.lists(
    st.tuples(st.sampled_from([Network.publish, Network.restart]), st.sampled_from("ABC"))
    | st.tuples(st.just(Network.restart_reader), st.sampled_from(FORMS)),
    min_size=4,
    max_size=12,
)


@pytest.mark.router
def test_restart_with_other_firmware_changes_fields(router: str) -> None:
    """After a vehicle restarts with another firmware build, a new reader gets the fields of the new build."""
    before = [(Network.publish, "C"), (Network.restart_reader, "rows")]
    run(router, [*before, (Network.restart, "C"), *before])


@pytest.mark.router
@pytest.mark.long
@hypothesis.given(steps=STEPS)
def test_restarts_in_any_order_do_not_mix_up_fields(router: str, steps: Steps) -> None:
    """While vehicles and readers restart in any order, each message is read once, with the fields of its sender."""
    hypothesis.target(run(router, steps), label="seconds until a message is read")


def run(router: str, steps: Steps) -> float:
    """Run the steps, check what was read, and return the longest time until all readers had read a message [s]."""
    with closing(Network(router)) as network:
        for step, which in [*steps, *((Network.publish, firmware) for firmware in FIELDS)]:
            step(network, which)
        for reader in network.readers.values():
            for vehicle, fields in reader.read:
                assert fields.keys() == (
                    set(FIELDS[vehicle]) if vehicle in FIELDS else fields.keys()
                )
                assert all(fields[name] == VALUES[name] for name in fields if name != "timestamp")
            counts = reader.subscription.counts
            # A message in transit during the query for last messages arrives twice, and is discarded once.
            assert counts == Counts(received=len(reader.read), discarded=counts.discarded)
            assert len({fields["timestamp"] for _, fields in reader.read}) == len(reader.read)
        return network.slowest


def test_unread_samples_keep_their_definition(client: nedbus.Bus, bus: nedbus.Bus) -> None:
    """Each unread sample of a vehicle that changed its firmware is decoded with its own definition."""
    with client.subscribe(TOPIC, mode="every") as subscription:
        sent = []
        for number, firmware in enumerate("ABCBA"):
            with publisher_of(bus, firmware, "1") as publisher:
                wait_for_subscriber(publisher)
                sent.append(fields_of(firmware, number))
                publisher.publish(sent[-1])
        assert [as_dict(subscription.receive(DEADLINE).message) for _ in sent] == sent
        assert subscription.counts == Counts(received=len(sent))
    publisher = publisher_of(bus, "B", "1")
    publisher.publish(fields_of("B", 9))
    wait_for(lambda: client.latest(TOPIC), what="the last message")
    assert [as_dict(sample.message) for sample in client.latest(TOPIC)] == [fields_of("B", 9)]


def test_encoding_has_the_hash_of_the_definition(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """The encoding of a message that is not built in contains the hash by which readers query its definition."""
    for firmware in "AB":
        publisher_of(bus, firmware).publish(fields_of(firmware, 1))
    short = {firmware: short_hash(NAME, definition_of(firmware).types) for firmware in "AB"}
    assert (
        encoding_of(definition_of("A"), "ulog")
        == f"application/msgpack;px4_msgs/WindCell;hash={short['A']};source=ulog"
    )
    assert len(set(short.values())) == 2
    for parameter, expected in ("", set("AB")), (f"?hash={short['B']}", {"B"}):
        replies = query(zenoh_session, f"nedbus/@schema/*/{NAME}{parameter}", timeout=DEADLINE)
        found = [json.loads(reply.payload.to_bytes()) for reply in replies]
        assert {each["hash"] for each in found} == {short[firmware] for firmware in expected}


def test_definition_with_wrong_hash_is_ignored(client: nedbus.Bus, zenoh_session: Session) -> None:
    """A definition whose fields do not match the requested hash is not used, whatever hash the peer claims."""
    wrong, definition = definition_of("B"), definition_of("A")
    schema = f"nedbus/@schema/peer/{NAME}"
    layout = {
        "wire": 0,
        "fields": [{"name": name, "type": str(kind)} for name, kind in wrong.types.items()],
    }
    claim = {"layouts": [layout], "hash": short_hash(NAME, definition.types)}
    with (
        answer_queries(zenoh_session, schema, reply_with({schema: json.dumps(claim).encode()})),
        client.subscribe(TOPIC, mode="every") as subscription,
    ):
        wait_for_matching(zenoh_session, f"nedbus/1/{TOPIC}")
        payload = codec_of(definition).encode_fields(fields_of("A", 1))
        zenoh_session.put(f"nedbus/1/{TOPIC}", payload, encoding=encoding_of(definition, None))

        def is_rejected() -> bool:
            with suppress(nedbus.NoDataError):
                raise AssertionError(subscription.receive(0.1))
            return subscription.counts.invalid == 1

        wait_for(is_rejected, what="the message to be rejected")


def test_unresponsive_publisher_does_not_delay_readers(
    endpoint: str, bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """A message is read as soon as one publisher of its vehicle replies, even if another does not."""
    held: list[zenoh.Query] = []
    publisher_of(bus, "A").publish(fields_of("A", 1))
    with (
        answer_queries(zenoh_session, f"nedbus/@schema/A/{NAME}", held.append),
        closing(Reader(endpoint, "models").bus) as reader,
        reader.subscribe(TOPIC, mode="every") as subscription,
    ):
        assert as_dict(subscription.receive(DEADLINE).message) == fields_of("A", 1)
        assert held
        held.clear()


def test_payload_that_contradicts_its_encoding_is_invalid(
    bus: nedbus.Bus, zenoh_session: Session
) -> None:
    """A payload that does not fit the definition in its encoding is invalid."""
    publisher_of(bus, "A")
    with bus.subscribe(TOPIC, mode="every") as subscription:
        key, encoding = f"nedbus/1/{TOPIC}", encoding_of(definition_of("A"), None)
        wait_for_matching(zenoh_session, key)
        for payload in (
            msgpack.packb([0, 1, 2.0]),
            msgpack.packb([7, 1, 2.0, 3.0]),
            msgpack.packb([0, 1, 2.0, 3.0]),
        ):
            zenoh_session.put(key, payload, encoding=encoding)
        assert as_dict(subscription.receive(DEADLINE).message) == {
            "timestamp": 1,
            "north": 2.0,
            "east": 3.0,
        }
        assert subscription.counts.invalid == 2


@pytest.mark.parametrize("distinct", [True, False])
def test_recording_has_a_schema_per_firmware(
    bus: nedbus.Bus, tmp_path: Path, distinct: bool
) -> None:
    """Each firmware build is recorded with its schema and read back with its fields, even if two share an address."""
    path, stop = tmp_path / "flight.mcap", threading.Event()
    recorder = Recorder(bus.subscribe(TOPIC, mode="every"), path)
    thread = threading.Thread(target=recorder.run, args=(stop,))
    thread.start()
    for number, firmware in enumerate("ABCAB", 1):
        with publisher_of(
            bus, firmware, firmware if distinct or firmware == "C" else "1"
        ) as publisher:
            wait_for_subscriber(publisher)
            publisher.publish(fields_of(firmware, number))
            wait_for(lambda number=number: recorder.messages == number, what="the message")  # type: ignore[misc]
    stop.set()
    thread.join(DEADLINE)
    names = {firmware: FIELDS[firmware] for firmware in "ABC"} | {"1": FIELDS["A"]}
    for vehicle in "ABC" if distinct else "1C":
        read = nedbus.read(path, TOPIC, vehicle=vehicle)
        assert set(read.dtype.names or ()) == set(names[vehicle])
        assert all((read[name] == VALUES[name]).all() for name in names[vehicle][1:])
        assert len(read) == (1 if vehicle == "C" else 2 if distinct else 4)


@pytest.mark.slow
@pytest.mark.process
def test_replay_uses_the_definition_of_each_message(
    tmp_path: Path, run_nedbus: Start, endpoint: str, bus: nedbus.Bus
) -> None:
    """A recording of a vehicle that changed its firmware is replayed with the definition of each message."""
    made = [
        (number, firmware, definition_of(firmware).model)
        for number, firmware in enumerate("AACB", 1)
    ]
    with RecordingWriter(tmp_path / "flight.mcap") as writer:
        for number, firmware, model in made:
            message = model.model_validate(fields_of(firmware, number))
            writer.write_messages(
                [(message, Address("1", TOPIC), Provenance("ulog"), number * 1000)]
            )
    with bus.subscribe(TOPIC, mode="every") as subscription:
        run_nedbus(
            "serve",
            "-c",
            endpoint,
            "--source",
            f"mcap:{tmp_path / 'flight.mcap'}?topics=*&speed=max&wait=1",
        )
        read = [as_dict(subscription.receive(DEADLINE).message) for _ in made]
    assert read == [fields_of(firmware, number) for number, firmware, _ in made]


def write_log(path: Path, firmware: str, system_id: int) -> Path:
    log = UlogWriter(system_id=system_id)
    log.put(
        "F",
        f"{TOPIC}:uint64_t timestamp;{''.join(f'float {name};' for name in FIELDS[firmware][1:])}".encode(),
    )
    log.put("A", struct.pack("<BH", 0, 0) + TOPIC.encode())
    for number in range(1, 51):
        values = [VALUES[name] for name in FIELDS[firmware][1:]]
        log.put("D", struct.pack(f"<HQ{len(values)}f", 0, number, *values))
    return log.write(path)


READ_ONE: Final = """
import sys, nedbus
with nedbus.connect(sys.argv[1]) as bus:
    print(bus.subscribe("wind_cell", vehicle=sys.argv[2]).receive(30.0).message.model_dump_json())
"""


@pytest.mark.slow
@pytest.mark.process
def test_service_with_several_firmware_builds_replies_with_each_definition(
    tmp_path: Path, run_nedbus: Start, start: Start, endpoint: str
) -> None:
    """If a service replays logs of several firmware builds, a new reader gets the fields of each log."""
    logs = [
        write_log(tmp_path / f"{name}.ulg", name, number) for number, name in enumerate("ABC", 1)
    ]
    sources = [each for log in logs for each in ("--source", f"ulog:{log}?topics=*")]
    run_nedbus("serve", "-c", endpoint, *sources)
    for number, name in ((2, "B"), (3, "C"), (1, "A")):
        reader = start("-c", READ_ONE, endpoint, str(number))
        assert reader.wait() == 0, reader.err
        shown = json.loads(reader.out)
        assert {key: shown[key] for key in FIELDS[name][1:]} == {
            key: VALUES[key] for key in FIELDS[name][1:]
        }
        assert list(shown) == list(FIELDS[name])
        shown = json.loads(
            run_command(
                "echo", "-c", endpoint, TOPIC, "--vehicle", str(number), "-n", "1", "--json"
            ).out
        )
        assert list(shown["message"]) == list(FIELDS[name])
