"""Recordings: read by readers that no one here wrote, whole after a power cut, and back on the bus to the bit."""

from __future__ import annotations

import math
import resource
import signal
import threading
from itertools import repeat
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import nedbus
from nedbus.errors import RecordError, SourceError
from nedbus.playback import Playback
from nedbus.recorder import Recorder, convert
from nedbus.recording import Recording
from nedbus.sources import Flight, Record
from nedbus_msgs import (
    LAYOUTS,
    ROS2_TYPE,
    Address,
    Origin,
    VehicleLocalPosition,
    downgrade,
    encode,
    encode_cdr,
    message_definition,
    upgrade,
)
from nedbus_msgs.arrays import to_records
from tests.conftest import DEADLINE, LOGS, Start, message, wait_for, wait_for_reader
from tests.replays import open_replay

VLP = "vehicle_local_position"
HERE = Address("7", VLP)


def read_plainly(path: Path) -> list[tuple[str, int, int, Any]]:
    """Read with the plain mcap reader, and decode by the definition in the file: no code of this project."""
    store = get_typestore(Stores.EMPTY)
    found = []
    with path.open("rb") as file:
        for schema, channel, each in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            if schema.name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            found.append(
                (channel.topic, each.log_time, each.publish_time, store.deserialize_cdr(each.data, schema.name))
            )
    return found


def write(path: Path, *messages: VehicleLocalPosition, origin: Origin | None = None) -> None:
    with Recording(path) as recording:
        times = [each.timestamp * 1000 for each in messages]
        recording.write(to_records(messages), repeat((HERE, origin or Origin())), logged=times, published=times)


def test_plain_readers_see_named_fields(tmp_path: Path) -> None:
    """The mcap package and a decoder made from the definition in the file give every field as it was."""
    sent = message(
        5, x=0.1, vxy_max=math.inf, delta_xy=(1.0, math.nan), ref_lat=47.397742123456789, xy_reset_counter=255
    )
    write(tmp_path / "a.mcap", sent)
    [(topic, logged, published, read)] = read_plainly(tmp_path / "a.mcap")
    assert (topic, logged, published) == (f"/{HERE}", 5000, 5000)
    for name, value in sent.model_dump().items():
        there = getattr(read, name)
        there = tuple(there.tolist()) if isinstance(value, tuple) else there
        assert repr(there) == repr(value), name


def test_flight_comes_back_to_the_bit(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path) -> None:
    """Recorded off the bus, and replayed from the file: the same messages, with what was not provided."""
    flight = list(open_replay("sim:?duration=3").records)
    path = tmp_path / "flight.mcap"
    publishers = {
        address: bus.publisher(address.topic, vehicle="7", instance=address.instance, source="sim")
        for address in {record.address for record in flight}
    }
    stop = threading.Event()
    recorder = Recorder(bus.subscribe(mode="every"), path)
    thread = threading.Thread(target=recorder.run, args=(stop,))
    thread.start()
    for publisher in publishers.values():
        wait_for_reader(bus._session, publisher.key)
    sent: dict[str, list[bytes]] = {}
    for record in flight:
        each = upgrade({name: value for name, value in record.fields.items() if name != "tilt_var"})
        publishers[record.address].publish(each)
        sent.setdefault(str(publishers[record.address].address), []).append(encode(each))
    wait_for(lambda: recorder.status.startswith(f"{len(flight)} "), what="all messages")
    stop.set()
    thread.join(DEADLINE)
    with bus.subscribe(vehicle="8", mode="every") as subscription:
        source = f"mcap:{path}?vehicle=8&speed=max&wait=1"
        replay = run_nedbus("serve", "--connect", endpoint, "--until-done", "-s", source)
        received: dict[str, list[bytes]] = {}
        for _ in flight:
            sample = subscription.receive(DEADLINE)
            assert (sample.source, sorted(sample.missing)) == ("mcap", ["tilt_var"])
            received.setdefault(f"7/{sample.address.stream}", []).append(encode(sample.message))
    assert replay.wait() == 0, replay.err
    assert received == sent


@pytest.mark.timeout(120)
def test_power_cut_costs_a_second_at_most(run_nedbus: Start, endpoint: str, tmp_path: Path) -> None:
    """Kill -9 in the middle: the file opens with the plain reader, and ends within a second of the last message."""
    path = tmp_path / "cut.mcap"
    recorder = run_nedbus("record", "-c", endpoint, "-o", str(path), measured=False)
    wait_for(path.exists, what="the file")
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    with nedbus.connect(endpoint) as bus, bus.subscribe(VLP) as subscription:
        first = subscription.receive(DEADLINE).message.timestamp
        wait_for(lambda: subscription.receive(DEADLINE).message.timestamp > first + 3_500_000, what="some flight")
        recorder.kill()
        last = subscription.receive(DEADLINE).message.timestamp
    times = [each.timestamp for topic, _, _, each in read_plainly(path) if topic == f"/1/{VLP}"]
    assert times == sorted(times)
    # What it had not received yet when it was killed is not its to lose: a machine may be slow.
    assert last - times[-1] < 3_000_000
    assert len(times) > 150


def test_file_ends_properly_after_every_flush(tmp_path: Path) -> None:
    """Between two flushes the file has all that was flushed, and an end, for any reader."""
    path = tmp_path / "a.mcap"
    with Recording(path) as recording:
        for count in range(1, 6):
            recording.write(to_records([message(count)]), [(HERE, Origin())], logged=[count], published=[count])
            assert len(read_plainly(path) if count > 1 else []) == count - 1
            recording.flush()
            assert [each.timestamp for *_, each in read_plainly(path)] == list(range(1, count + 1))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 5


def test_torn_file_is_read_up_to_the_tear(tmp_path: Path) -> None:
    """Wherever a file is cut, what is whole before the cut is played, and the rest is named."""
    path, torn = tmp_path / "a.mcap", tmp_path / "torn.mcap"
    with Recording(path) as recording:
        for count in range(1, 11):
            recording.write(to_records([message(count)]), [(HERE, Origin())], logged=[count], published=[count])
            recording.flush()
    data = path.read_bytes()
    counts = []
    for size in range(3000, len(data), 97):
        torn.write_bytes(data[:size])
        with Playback(torn, vehicle="1") as playback:
            counts.append(sum(playback.counts.values()))
            assert len(list(playback.messages())) == counts[-1]
    assert counts == sorted(counts)
    assert counts[-1] == 10


@pytest.mark.parametrize("content", [b"", b"no mcap", b"\x89MCAP0\r\n" + bytes(100), bytes(10_000)])
def test_no_recording_is_an_error(tmp_path: Path, content: bytes) -> None:
    """A file that is none is said to be none."""
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(SourceError):
        open_replay(f"mcap:{path}")


def test_recording_of_something_else_is_an_error(tmp_path: Path) -> None:
    """A recording without local positions has nothing to replay."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(SourceError, match="no message of the local position topics"):
        open_replay(f"mcap:{path}")
    with pytest.raises(SourceError, match="no such file"):
        open_replay(f"mcap:{path}x")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_ros_2s_own_bags_are_played(tmp_path: Path, layout: str) -> None:
    """What `ros2 bag record` wrote: no word of vehicles in it, any layout of px4_msgs, other topics beside."""
    path = tmp_path / "bag.mcap"
    definition = "uint8 CONSTANT=1\n" + message_definition(layout) + "\n" + "=" * 80 + "\nMSG: other/Type\nuint8 z\n"
    sent = message(9, x=1.0, hagl_max_z=2.0)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(ROS2_TYPE, "ros2msg", definition.encode())
        other = writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
        topics = ("/fmu/out/vehicle_local_position", "/px4_1/fmu/out/estimator_local_position_1", "/somebody")
        for topic in topics:
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, 1, encode_cdr(downgrade(sent, layout), layout=layout), 1)
        writer.add_message(writer.register_channel("/empty", "cdr", other), 1, b"\x00\x01\x00\x00", 1)
        writer.finish()
    flight = open_replay(f"mcap:{path}")
    assert list(map(str, flight.addresses)) == ["1/vehicle_local_position", "px4_1/estimator_local_position/1"]
    assert any("/somebody is left out" in warning for warning in flight.warnings)
    for record in flight.records:
        assert upgrade(record.fields) == upgrade(downgrade(sent, layout))


def test_channels_of_other_encodings_are_left_out(tmp_path: Path) -> None:
    """Not everything with that name can be read; what cannot is named."""
    path = tmp_path / "a.mcap"
    write(path, message(1))
    with path.open("rb") as file:
        data = file.read()
    path.write_bytes(data.replace(b"ros2msg", b"ros2idl"))
    with Playback(path, vehicle="1") as playback:
        assert playback.counts == {}
        assert "cdr with ros2idl, not cdr" in playback.warnings[0]


def test_existing_file_is_not_replaced(run_nedbus: Start, endpoint: str, tmp_path: Path) -> None:
    """A recording is never written over."""
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    recorder = run_nedbus("record", "-c", endpoint, "-o", str(path))
    assert recorder.wait() == 1
    assert "file exists): choose another name, or remove it" in recorder.err
    assert path.read_text() == "precious"


def test_full_disk_ends_cleanly(tmp_path: Path) -> None:
    """When nothing more can be written that is the error, and all that was flushed can be read."""
    path = tmp_path / "full.mcap"
    flushed = 0

    def fill() -> None:
        nonlocal flushed
        with Recording(path) as recording:
            for count in range(100_000):
                noise = message(count, x=math.sin(count), y=math.cos(count), z=math.tan(count), vx=math.sin(count * 7))
                recording.write(to_records([noise]), [(HERE, Origin())], logged=[count], published=[count])
                if count % 100 == 99:
                    recording.flush()
                    flushed = count + 1

    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limit[1]))
    try:
        with pytest.raises(RecordError, match=r"full\.mcap cannot be written \(file too large\)"):
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert flushed
    assert len(read_plainly(path)) == flushed


def test_record_ends_with_ctrl_c(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path) -> None:
    """Ctrl-C is how a recording ends: exit 0, a finished file, and a line that counts."""
    path = tmp_path / "a.mcap"
    recorder = run_nedbus("record", VLP, "-c", endpoint, "-o", str(path), measured=False)
    wait_for(path.exists, what="the file")
    publisher = bus.publisher(VLP, vehicle="1")
    bus.publisher("external_ins_local_position", vehicle="1").publish(message(1))

    def is_written() -> bool:
        publisher.publish(message(1))
        return len(read_plainly(path)) > 0 if path.stat().st_size else False

    wait_for(is_written, what="a flush")
    recorder.signal(signal.SIGINT)
    assert recorder.wait() == 0, recorder.err
    found = read_plainly(path)
    assert {topic for topic, *_ in found} == {f"/1/{VLP}"}
    assert f"{len(found)} messages" in recorder.err


@pytest.fixture
def log() -> Path:
    path = LOGS / "sitl_1.13_three_topics.ulg"
    if not path.exists():
        pytest.skip(f"the real logs are not here: {LOGS}")
    return path


@pytest.mark.logs
def test_log_is_converted_whole(run_nedbus: Start, tmp_path: Path, log: Path) -> None:
    """A real log as a recording has the same messages, and what its release did not have."""
    path = tmp_path / "flight.mcap"
    converter = run_nedbus("convert", str(log), str(path))
    assert converter.wait() == 0, converter.err
    assert "1871 messages" in converter.err

    def messages(source: str) -> dict[str, list[VehicleLocalPosition]]:
        found: dict[str, list[VehicleLocalPosition]] = {}
        for record in open_replay(source).records:
            found.setdefault(str(record.address), []).append(upgrade(record.fields))
        return found

    ours, theirs = messages(f"mcap:{path}"), messages(f"ulog:{log}")
    assert ours == theirs
    assert ours[f"1/{VLP}"][0].model_fields_set == theirs[f"1/{VLP}"][0].model_fields_set
    assert len(read_plainly(path)) == 1871


def test_damaged_times_are_converted(tmp_path: Path) -> None:
    """A timestamp that no clock has is kept in the message; the file's own time goes as far as it can."""
    path = tmp_path / "a.mcap"
    records = [Record(0.0, HERE, {"timestamp": each}) for each in (1, 2**64 - 1)]
    flight = Flight(iter(records), (HERE,), 2, "")
    assert convert(flight, path, source="ulog", on_progress=lambda _: None) == "2 messages"
    assert [each.timestamp for *_, each in read_plainly(path)] == [1, 2**64 - 1]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [(["flight.txt", "a.mcap"], "a flight is one of .ulg, .mcap"), (["flight.ulg", "a.mcap"], "no such file")],
)
def test_wrong_words_are_said(run_nedbus: Start, arguments: list[str], word: str) -> None:
    """What cannot be converted is said in one line."""
    converter = run_nedbus("convert", *arguments)
    assert converter.wait() in {1, 2}
    assert word in converter.err
    assert len(converter.err.splitlines()) == 1
