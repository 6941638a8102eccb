"""Recordings: read by independent readers, complete after a power cut, and replayed to the bit."""

from __future__ import annotations

import math
import os
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
from nedbus.errors import OutputError, SourceError
from nedbus.recording import Recorder, RecordingReader, RecordingWriter, convert
from nedbus.sources import SourceMessage
from nedbus_msgs import (
    ANY,
    LAYOUTS,
    ROS2_TYPE,
    Address,
    Provenance,
    VehicleLocalPosition,
    downgrade,
    encode,
    encode_cdr,
    message_definition,
    upgrade,
)
from nedbus_msgs.arrays import to_array
from tests.conftest import DEADLINE, LOGS, Start, message, wait_for, wait_for_reader
from tests.replays import convert_replay, open_replay
from tests.ulogs import write_log

VLP = "vehicle_local_position"
ADDRESS = Address("7", VLP)


def read_independently(path: Path) -> list[tuple[str, int, int, Any]]:
    """Read with the mcap package, and decode by the definition in the file: no code of this project."""
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


def write(path: Path, *messages: VehicleLocalPosition, provenance: Provenance | None = None) -> None:
    with RecordingWriter(path) as writer:
        times = [each.timestamp * 1000 for each in messages]
        writer.write(to_array(messages), repeat((ADDRESS, provenance or Provenance())), logged=times, published=times)


def test_independent_readers_get_named_fields(tmp_path: Path) -> None:
    """The mcap package and a decoder made from the definition in the file return every field as it was."""
    sent = message(
        5, x=0.1, vxy_max=math.inf, delta_xy=(1.0, math.nan), ref_lat=47.397742123456789, xy_reset_counter=255
    )
    write(tmp_path / "a.mcap", sent)
    [(topic, logged, published, read)] = read_independently(tmp_path / "a.mcap")
    assert (topic, logged, published) == (f"/{ADDRESS}", 5000, 5000)
    for name, value in sent.model_dump().items():
        there = getattr(read, name)
        there = tuple(there.tolist()) if isinstance(value, tuple) else there
        assert repr(there) == repr(value), name


def test_recording_is_replayed_to_the_bit(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path) -> None:
    """Recorded from the bus and replayed from the file: the same messages, and the same fields not provided."""
    messages = list(open_replay("sim:?duration=3").messages)
    path = tmp_path / "flight.mcap"
    publishers = {
        address: bus.publisher(address.topic, vehicle="7", instance=address.instance, source="sim")
        for address in {each.address for each in messages}
    }
    stop = threading.Event()
    recorder = Recorder(bus.subscribe(ANY, mode="every"), path)
    thread = threading.Thread(target=recorder.run, args=(stop,))
    thread.start()
    for publisher in publishers.values():
        wait_for_reader(bus._session, publisher.key)
    sent: dict[str, list[bytes]] = {}
    for each in messages:
        published = upgrade({name: value for name, value in each.fields.items() if name != "tilt_var"})
        publishers[each.address].publish(published)
        sent.setdefault(str(publishers[each.address].address), []).append(encode(published))
    wait_for(lambda: recorder.status.startswith(f"{len(messages)} "), what="all messages")
    stop.set()
    thread.join(DEADLINE)
    with bus.subscribe(ANY, vehicle="8", mode="every") as subscription:
        source = f"mcap:{path}?vehicle=8&speed=max&wait=1"
        replay = run_nedbus("serve", "--connect", endpoint, "--until-done", "-s", source)
        received: dict[str, list[bytes]] = {}
        for _ in messages:
            sample = subscription.receive(DEADLINE)
            assert (sample.source, sorted(sample.missing)) == ("mcap", ["tilt_var"])
            received.setdefault(f"7/{sample.address.stream}", []).append(encode(sample.message))
    assert replay.wait() == 0, replay.err
    assert received == sent


@pytest.mark.timeout(120)
def test_power_cut_costs_a_second_at_most(run_nedbus: Start, endpoint: str, tmp_path: Path) -> None:
    """After kill -9 the file opens with an independent reader, and ends within a second of the last message."""
    path = tmp_path / "cut.mcap"
    recorder = run_nedbus("record", "-c", endpoint, "-o", str(path), measured=False)
    wait_for(path.exists, what="the file")
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    with nedbus.connect(endpoint) as bus, bus.subscribe(VLP) as subscription:
        first = subscription.receive(DEADLINE).message.timestamp
        wait_for(lambda: subscription.receive(DEADLINE).message.timestamp > first + 3_500_000, what="some seconds")
        recorder.kill()
        last = subscription.receive(DEADLINE).message.timestamp
    times = [each.timestamp for topic, _, _, each in read_independently(path) if topic == f"/1/{VLP}"]
    assert times == sorted(times)
    # Messages that it had not received when it was killed do not count: a machine may be slow.
    assert last - times[-1] < 3_000_000
    assert len(times) > 150


def test_file_is_complete_after_every_flush(tmp_path: Path) -> None:
    """From its opening on any reader finds all that was flushed, and a valid end, as after kill -9."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for count in range(1, 6):
            writer.write(to_array([message(count)]), [(ADDRESS, Provenance())], logged=[count], published=[count])
            assert len(read_independently(path)) == count - 1
            writer.flush()
            assert [each.timestamp for *_, each in read_independently(path)] == list(range(1, count + 1))
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 5


def test_truncated_file_is_read_up_to_the_cut(tmp_path: Path) -> None:
    """Wherever a file is cut, the whole messages before the cut are read."""
    path, truncated = tmp_path / "a.mcap", tmp_path / "truncated.mcap"
    with RecordingWriter(path) as writer:
        for count in range(1, 11):
            writer.write(to_array([message(count)]), [(ADDRESS, Provenance())], logged=[count], published=[count])
            writer.flush()
    data = path.read_bytes()
    counts = []
    for size in range(3000, len(data), 97):
        truncated.write_bytes(data[:size])
        with RecordingReader(truncated, vehicle="1") as reader:
            counts.append(sum(reader.counts.values()))
            assert len(list(reader.messages())) == counts[-1]
    assert counts == sorted(counts)
    assert counts[-1] == 10


@pytest.mark.parametrize("content", [b"", b"not mcap", b"\x89MCAP0\r\n" + bytes(100), bytes(10_000)])
def test_file_that_is_not_mcap_is_an_error(tmp_path: Path, content: bytes) -> None:
    """Any other content raises SourceError."""
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(SourceError):
        open_replay(f"mcap:{path}")


def test_recording_without_the_topics_is_an_error(tmp_path: Path) -> None:
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
def test_bags_of_ros2_are_replayed(tmp_path: Path, layout: str) -> None:
    """Files of `ros2 bag record`: without vehicle metadata, in any layout of px4_msgs, beside other topics."""
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
    run = open_replay(f"mcap:{path}")
    assert list(map(str, run.addresses)) == ["1/vehicle_local_position", "px4_1/estimator_local_position/1"]
    assert any("/somebody is left out" in warning for warning in run.warnings)
    for each in run.messages:
        assert upgrade(each.fields) == upgrade(downgrade(sent, layout))


def test_channels_of_other_encodings_are_left_out(tmp_path: Path) -> None:
    """A channel whose encoding is not supported is left out, with a warning."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(ROS2_TYPE, "ros2idl", b"")
        writer.add_message(writer.register_channel(f"/{ADDRESS}", "cdr", schema), 1, b"", 1)
        writer.finish()
    with RecordingReader(path, vehicle="1") as reader:
        assert reader.counts == {}
        assert "cdr with ros2idl, not cdr" in reader.warnings[0]


def test_existing_file_is_not_replaced(run_nedbus: Start, endpoint: str, tmp_path: Path) -> None:
    """A recording is never overwritten."""
    path = tmp_path / "a.mcap"
    path.write_text("precious")
    recorder = run_nedbus("record", "-c", endpoint, "-o", str(path))
    assert recorder.wait() == 1
    assert "file exists): choose another name, or remove it" in recorder.err
    assert path.read_text() == "precious"


def test_full_disk_ends_cleanly(tmp_path: Path) -> None:
    """A full disk raises OutputError, and all that was flushed can be read."""
    path = tmp_path / "full.mcap"
    flushed = 0

    def fill() -> None:
        nonlocal flushed
        with RecordingWriter(path) as writer:
            for count in range(100_000):
                noise = message(count, x=math.sin(count), y=math.cos(count), z=math.tan(count), vx=math.sin(count * 7))
                writer.write(to_array([noise]), [(ADDRESS, Provenance())], logged=[count], published=[count])
                if count % 100 == 99:
                    writer.flush()
                    flushed = count + 1

    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limit[1]))
    try:
        with pytest.raises(OutputError, match=r"full\.mcap cannot be written \(file too large\)"):
            fill()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert flushed
    assert len(read_independently(path)) == flushed


FULL_DISK = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)),) * 2)
from nedbus.cli import main
main()
"""


@pytest.mark.parametrize(
    ("size", "arguments", "reason"),
    [
        (50_000, ["convert", "flight.mcap", "new.mcap"], "new.mcap cannot be written (file too large)"),
        (5_000, ["plot", "flight.mcap", "-o", "new.png"], "new.png cannot be written (file too large)"),
        (200, ["pki", "ca", "new"], "new/ca cannot be written: file too large"),
        (300, ["pki", "ca", "new"], "new/ca cannot be written: file too large"),
    ],
)
def test_full_disk_leaves_nothing_behind(
    start: Start, tmp_path: Path, size: int, arguments: list[str], reason: str
) -> None:
    """convert, plot and pki say what failed, exit with 1, and leave no half file: no empty key above all."""
    convert_replay("sim:?duration=20", tmp_path / "flight.mcap")
    arguments = [each.replace("flight", str(tmp_path / "flight")) for each in arguments]
    folder = tmp_path / "full"
    folder.mkdir()
    arguments[-1] = str(folder / arguments[-1])
    process = start("-c", FULL_DISK, str(size), *arguments)
    assert process.wait(60) == 1, process.err
    assert reason in process.err
    assert not [path for path in folder.rglob("*") if path.is_file()]


def test_conversion_replaces_nothing(run_nedbus: Start, tmp_path: Path) -> None:
    """A recording of the same name stays as it is, and nothing else is left."""
    convert_replay("sim:?duration=1", tmp_path / "flight.mcap")
    path = tmp_path / "new" / "a.mcap"
    path.parent.mkdir()
    path.write_text("precious")
    convert = run_nedbus("convert", str(tmp_path / "flight.mcap"), str(path))
    assert convert.wait() == 1
    assert "file exists): choose another name, or remove it" in convert.err
    assert path.read_text() == "precious"
    assert list(path.parent.iterdir()) == [path]


def dues(path: Path, *logged: float) -> list[float]:
    """Return when the messages of a recording are due that were recorded at these seconds, stamped as it likes."""
    with RecordingWriter(path) as writer:
        for number, time in enumerate(logged):
            address = Address(str(number % 2), VLP)
            published = number % 2 * 3600 * 10**9 + (10**19 if number == 3 else number)
            rows = to_array([message(number)])
            writer.write(rows, [(address, Provenance())], logged=[round(time * 1e9)], published=[published])
    return [round(each.due, 6) for each in open_replay(f"mcap:{path}").messages]


@pytest.mark.parametrize(
    ("logged", "due"),
    [
        ([0, 1, 2, 3, 4], [0, 1, 2, 3, 4]),  # two vehicles whose clocks differ by an hour: side by side
        ([0, 10800, 10801, 10802], [0, 0, 1, 2]),  # the last value of three hours ago comes first
        ([0, 1, 1.7e10, 2, 3], [0, 1, 1, 1, 2]),  # a stray time
        ([5, 6, 5.5, 7], [0, 1, 1, 2]),  # one that was recorded late
        ([5000, 5001, 0, 1], [0, 1, 1, 2]),  # the recorder's clock was set
    ],
)
def test_replay_follows_the_times_of_recording(tmp_path: Path, logged: list[float], due: list[float]) -> None:
    """What the publishers' clocks say does not matter, and no gap of more than a minute is waited for."""
    assert dues(tmp_path / "a.mcap", *logged) == due


def test_conversion_keeps_the_pace_of_several_vehicles(tmp_path: Path) -> None:
    """A converted recording is replayed as the original: the clocks of its vehicles differ, its times do not."""
    expected = dues(tmp_path / "a.mcap", 0, 1, 2, 3, 4)
    convert_replay(f"mcap:{tmp_path / 'a.mcap'}", tmp_path / "b.mcap")
    assert [each.due for each in open_replay(f"mcap:{tmp_path / 'b.mcap'}").messages] == expected


def test_record_ends_with_ctrl_c(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path) -> None:
    """Ctrl-C ends a recording: exit code 0, a finished file, and a line with the counts."""
    path = tmp_path / "a.mcap"
    recorder = run_nedbus("record", VLP, "-c", endpoint, "-o", str(path), measured=False)
    wait_for(path.exists, what="the file")
    publisher = bus.publisher(VLP, vehicle="1")
    bus.publisher("external_ins_local_position", vehicle="1").publish(message(1))

    def is_written() -> bool:
        publisher.publish(message(1))
        return len(read_independently(path)) > 0 if path.stat().st_size else False

    wait_for(is_written, what="a flush")
    recorder.signal(signal.SIGINT)
    assert recorder.wait() == 0, recorder.err
    found = read_independently(path)
    assert {topic for topic, *_ in found} == {f"/1/{VLP}"}
    assert f"{len(found)} messages" in recorder.err


def test_deleted_recording_is_an_error(run_nedbus: Start, endpoint: str, tmp_path: Path) -> None:
    """A recording that is deleted while it is written ends at the next flush, with what is lost, and exit code 1."""
    path = tmp_path / "a.mcap"
    recorder = run_nedbus("record", "-c", endpoint, "-o", str(path))
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(lambda: path.exists() and path.stat().st_size > 5000, what="messages")
    path.unlink()
    assert recorder.wait() == 1
    reason = "it was deleted while it was written): what was written is lost; write to a folder that nothing cleans up"
    assert f"{path} cannot be written ({reason}" in recorder.err
    assert " messages" not in recorder.err


def test_moved_recording_goes_on(tmp_path: Path) -> None:
    """A recording that is given another name is written to its end."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        path.rename(tmp_path / "b.mcap")
        writer.write(to_array([message(1)]), [(ADDRESS, Provenance())], logged=[1], published=[1])
    assert len(read_independently(tmp_path / "b.mcap")) == 1


@pytest.mark.parametrize("ended", ["by its duration", "by Ctrl-C"])
def test_recording_of_nothing_is_said(run_nedbus: Start, endpoint: str, tmp_path: Path, ended: str) -> None:
    """A vehicle that is not there: stderr says after 2 s that nothing came, and at the end that no file is left."""
    path = tmp_path / "a.mcap"
    duration = ["-d", "3"] if ended == "by its duration" else []
    recorder = run_nedbus("record", "-v", "9", "-c", endpoint, "-o", str(path), *duration, measured=False)
    wait_for(lambda: "nothing on nedbus/9/** yet, waiting; 'nedbus list' shows" in recorder.err, what="the notice")
    assert path.exists()
    if not duration:
        recorder.signal(signal.SIGINT)
    assert recorder.wait() == 1
    assert recorder.err.count("yet, waiting") == 1
    assert f"{path}: 0 messages: the empty file is removed" in recorder.err
    assert "nothing arrived on nedbus/9/** within" in recorder.err
    assert not path.exists()


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["convert", "a.ulg", "x.csv"], '; for a table: nedbus.read("a.ulg", dataframe="pandas").to_csv("x.csv")'),
        (["convert", "a.ulg", "b.png"], "; for a picture: nedbus plot a.ulg -o b.png"),
        (["convert", "a.ulg", "b"], ""),
        (["record", "-o", "a.txt"], ""),
        (["record", "-o", "a.csv"], '; for a table: nedbus.read("flight.mcap", dataframe="pandas").to_csv("a.csv")'),
    ],
)
def test_other_suffix_is_refused(
    run_nedbus: Start, endpoint: str, tmp_path: Path, arguments: list[str], hint: str
) -> None:
    """MCAP is written under no other name: exit code 2, one line, and no file."""
    log = str(write_log(tmp_path / "a.ulg", [1, 2]))
    connect = ["-c", endpoint] if arguments[0] == "record" else []
    process = run_nedbus(*(each.replace("a.ulg", log) for each in arguments), *connect)
    assert process.wait() == 2, process.err
    expected = f"{arguments[-1]}: expected a recording: a file that ends with .mcap{hint.replace('a.ulg', log)}\n"
    assert expected in process.err
    assert {each.name for each in tmp_path.rglob("*") if each.is_file()} == {"a.ulg", "stdout", "stderr"}


@pytest.fixture
def log() -> Path:
    path = LOGS / "sitl_1.13_three_topics.ulg"
    if not path.exists():
        pytest.skip(f"the real logs are not here: {LOGS}")
    return path


@pytest.mark.logs
def test_log_is_converted_whole(run_nedbus: Start, tmp_path: Path, log: Path) -> None:
    """The recording of a real log has the same messages, and the same fields not provided."""
    path = tmp_path / "flight.mcap"
    converter = run_nedbus("convert", str(log), str(path))
    assert converter.wait() == 0, converter.err
    assert "1871 messages" in converter.err

    def replay(source: str) -> dict[str, list[VehicleLocalPosition]]:
        found: dict[str, list[VehicleLocalPosition]] = {}
        for each in open_replay(source).messages:
            found.setdefault(str(each.address), []).append(upgrade(each.fields))
        return found

    converted, original = replay(f"mcap:{path}"), replay(f"ulog:{log}")
    assert converted == original
    assert converted[f"1/{VLP}"][0].model_fields_set == original[f"1/{VLP}"][0].model_fields_set
    assert len(read_independently(path)) == 1871


def test_damaged_times_are_converted(tmp_path: Path) -> None:
    """An impossible timestamp is kept in the message; the file's own time is limited to 64 bits of ns."""
    path = tmp_path / "a.mcap"
    messages = [SourceMessage(0.0, ADDRESS, {"timestamp": each}) for each in (1, 2**64 - 1)]
    assert convert(messages, path, source="ulog", on_progress=lambda _: None) == "2 messages"
    assert [each.timestamp for *_, each in read_independently(path)] == [1, 2**64 - 1]


def test_rejected_messages_are_counted(tmp_path: Path) -> None:
    """A message that violates the rules is left out of the recording, and counted."""
    messages = [
        SourceMessage(0.0, ADDRESS, fields) for fields in ({"timestamp": 1}, {"timestamp": 2, "xy_valid": True})
    ]
    path = tmp_path / "a.mcap"
    assert convert(messages, path, source="ulog", on_progress=lambda _: None) == "1 messages, 1 rejected"
    assert [each.timestamp for *_, each in read_independently(path)] == [1]


@pytest.mark.parametrize("suffix", [".mcap", ".ulg"])
def test_pipe_is_refused_in_a_sentence(run_nedbus: Start, tmp_path: Path, suffix: str) -> None:
    """A FIFO would be waited for, for ever: it is refused, and so is a folder."""
    pipe = tmp_path / f"pipe{suffix}"
    os.mkfifo(pipe)
    plot = run_nedbus("plot", str(pipe))
    assert plot.wait() == 1, plot.err
    assert "not a regular file" in plot.err
    folder = tmp_path / f"folder{suffix}"
    folder.mkdir()
    with pytest.raises(SourceError, match="not a regular file"):
        nedbus.read(folder)


def test_progress_counts_messages(tmp_path: Path) -> None:
    """A long conversion reports how many messages it has handled."""
    done: list[int] = []
    messages = [SourceMessage(0.0, ADDRESS, {"timestamp": each}) for each in range(3000)]
    convert(messages, tmp_path / "a.mcap", source="ulog", on_progress=done.append)
    assert done == [1024, 2048]


@pytest.mark.parametrize(
    ("name", "exit_code", "reason"),
    [("flight.txt", 2, "a file that ends with .ulg or .mcap"), ("flight.ulg", 1, "no such file")],
)
def test_conversion_error_is_one_line(run_nedbus: Start, name: str, exit_code: int, reason: str) -> None:
    """A wrong argument is exit code 2, a file that cannot be read is exit code 1; either is one line."""
    converter = run_nedbus("convert", name, "a.mcap")
    assert converter.wait() == exit_code
    assert reason in converter.err
    assert len(converter.err.splitlines()) == 1
