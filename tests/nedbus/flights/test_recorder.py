"""Recordings: independent readers, crash safety, exact replay, and conversion."""

from __future__ import annotations

import math
import os
import re
import signal
import threading
from io import BytesIO
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import nedbus
from nedbus import Batch, limits
from nedbus.cli.follow import write_notice
from nedbus.cli.recorder import Recorder
from nedbus.client import Subscription
from nedbus.errors import NoDataError, SourceError
from nedbus.flights import RecordingWriter, convert
from nedbus.sources import ReplayRun, SourceMessage
from nedbus.timings import Timings
from nedbus.transport import Session
from nedbus_msgs import ANY, DEFAULT, Address, Provenance, VehicleLocalPosition
from nedbus_msgs.arrays import arrays_of, to_array
from nedbus_msgs.messages import LogMessage
from tests.flights.local_position import (
    LAYOUTS,
    ROS2_TYPE,
    downgrade,
    encode,
    encode_cdr,
    message_definition,
    upgrade,
)
from tests.flights.messages import VLP, message
from tests.flights.replays import convert_replay, open_recording, open_replay
from tests.flights.ulogs import UlogWriter, write_log
from tests.peers.command_line import run_command
from tests.peers.processes import ForkServer, Start, without_coverage
from tests.waits import DEADLINE, wait_for, wait_for_matching

ADDRESS = Address("7", VLP)


def read_independently(path: Path) -> list[tuple[str, int, int, Any]]:
    """Read with the mcap package and decode with rosbags by the definition in the file, without nedbus code."""
    store = get_typestore(Stores.EMPTY)
    found = []
    with path.open("rb") as file:
        for schema, channel, each in make_reader(file).iter_messages(log_time_order=False):
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            if schema.name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            decoded = store.deserialize_cdr(each.data, schema.name)
            found.append((channel.topic, each.log_time, each.publish_time, decoded))
    return found


def write(writer: RecordingWriter, *messages: VehicleLocalPosition) -> None:
    times = [each.timestamp * 1000 for each in messages]
    writer.write(
        to_array(messages), DEFAULT, repeat((ADDRESS, Provenance())), logged=times, published=times
    )


def test_independent_reader_decodes_every_field(tmp_path: Path) -> None:
    """The mcap package, and a decoder built from the definition in the file, return every field unchanged."""
    fields = {"x": 0.1, "vxy_max": math.inf, "delta_xy": (1.0, math.nan), "xy_reset_counter": 255}
    sent = message(5, ref_lat=47.397742123456789, **fields)
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        write(writer, sent)
    [(topic, logged, published, read)] = read_independently(tmp_path / "a.mcap")
    assert (topic, logged, published) == (f"/{ADDRESS}", 5000, 5000)
    for name, value in sent.model_dump().items():
        there = getattr(read, name)
        there = tuple(there.tolist()) if isinstance(value, tuple) else there
        assert repr(there) == repr(value), name


def test_sequence_numbers_of_publishers_are_recorded(tmp_path: Path) -> None:
    """A message has the sequence number of its publisher, 0 without one; MCAP's field has 32 bits."""
    path, numbers = tmp_path / "a.mcap", [-1, 0, 7, 2**32 - 1]
    with RecordingWriter(path) as writer:
        rows, times = to_array([message(1)] * len(numbers)), range(len(numbers))
        writer.write(
            rows,
            DEFAULT,
            repeat((ADDRESS, Provenance())),
            logged=times,
            published=times,
            sequence=numbers,
        )
    with path.open("rb") as file:
        assert [each.sequence for _, _, each in make_reader(file).iter_messages()] == [
            0,
            0,
            7,
            2**32 - 1,
        ]


def test_channels_of_a_vehicle_are_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A vehicle with too many topics and provenances does not use up the channels of a file for the others.

    Its further messages are left out, counted, and logged once; those of its known channels are recorded.
    """
    monkeypatch.setattr(limits, "CHANNELS_OF_VEHICLE", 2)
    monkeypatch.setattr(limits, "CHANNELS", 3)
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for vehicle, source in (
            ("7", "a"),
            ("7", "b"),
            ("7", "c"),
            ("7", "d"),
            ("8", "a"),
            ("9", "a"),
            ("7", "a"),
        ):
            streams = [(Address(vehicle, VLP), Provenance(source))]
            writer.write(to_array([message(1)]), DEFAULT, streams, logged=[1], published=[1])
    assert (writer.messages, writer.omitted) == (4, 3)
    assert [topic for topic, *_ in read_independently(path)] == [
        f"/{each}/{VLP}" for each in "7787"
    ]
    assert caplog.text.count("not recording some messages of vehicle 7, which has more than 2") == 1


@pytest.mark.slow
def test_replay_of_a_recording_is_bit_exact(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, zenoh_session: Session, tmp_path: Path
) -> None:
    """A replay publishes exactly the messages that were recorded from the bus, with the same missing fields."""
    messages = list(open_replay("sim:?duration=1&topics=VehicleLocalPosition").messages)
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
        wait_for_matching(zenoh_session, publisher.key)
    sent: dict[str, list[bytes]] = {}
    for each in messages:
        published = upgrade(
            {name: value for name, value in each.fields.items() if name != "tilt_var"}
        )
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


def test_message_without_a_time_of_sending_has_its_log_time(
    bus: nedbus.Bus, zenoh_session: Session, tmp_path: Path
) -> None:
    """The publish time of a message is its time of sending; without one, such as from another client, the log time."""
    path, stop = tmp_path / "a.mcap", threading.Event()
    publisher = bus.publisher(VLP, vehicle="7")
    recorder = Recorder(bus.subscribe(VLP, mode="every"), path)
    thread = threading.Thread(target=recorder.run, args=(stop,))
    thread.start()
    wait_for_matching(zenoh_session, "nedbus/8/vehicle_local_position")
    publisher.publish(message(1))
    zenoh_session.put(f"nedbus/8/{VLP}", encode(message(2)))
    wait_for(lambda: recorder.messages == 2, what="both messages")
    stop.set()
    thread.join(DEADLINE)
    ages = {topic: logged - published for topic, logged, published, _ in read_independently(path)}
    assert 0 < ages[f"/7/{VLP}"] < DEADLINE * 1e9
    assert ages[f"/8/{VLP}"] == 0


@pytest.mark.slow
def test_kill_loses_about_the_last_second(run_nedbus: Start, endpoint: str, tmp_path: Path) -> None:
    """After kill -9 an independent reader can read the file, which lacks about the last second.

    A busy host may delay the recorder for longer, but is unlikely to do so in all of five attempts.
    """
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    costs: list[int] = []
    while not costs or (costs[-1] >= 1_500_000 and len(costs) < 5):
        path = tmp_path / f"cut{len(costs)}.mcap"
        recorder = run_nedbus("record", "-c", endpoint, "-o", str(path), coverage=False)
        wait_for(path.exists, what="the file")
        with nedbus.connect(endpoint) as bus, bus.subscribe(VLP) as subscription:
            first = subscription.receive(DEADLINE).message.timestamp
            while subscription.receive(DEADLINE).message.timestamp <= first + 1_400_000:
                pass
            recorder.kill()
            last = subscription.receive(DEADLINE).message.timestamp
        times = [
            each.timestamp for topic, _, _, each in read_independently(path) if topic == f"/1/{VLP}"
        ]
        assert times == sorted(times)
        costs.append(last - times[-1] if times else last)
    assert costs[-1] < 1_500_000


@pytest.mark.slow
def test_file_is_valid_and_synced_after_every_flush(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After each flush, any reader finds a valid file with all messages, and fsync was called.

    The file is also valid before the first message.
    """
    path = tmp_path / "a.mcap"
    synced = []
    monkeypatch.setattr("os.fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
    with RecordingWriter(path) as writer:
        for count in range(1, 6):
            write(writer, message(count))
            assert len(read_independently(path)) == count - 1
            writer.flush()
            assert [each.timestamp for *_, each in read_independently(path)] == list(
                range(1, count + 1)
            )
            assert synced[-1] == path.stat().st_size
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 5


@pytest.mark.slow
def test_messages_between_flushes_do_not_fill_the_memory(tmp_path: Path) -> None:
    """A recording that is not flushed buffers at most 16 MiB of data in memory; the rest is on the disk."""
    path, blob = (
        tmp_path / "a.mcap",
        nedbus.define_msg("Blob", "uint64 timestamp\nfloat64[440] data\n"),
    )
    rows, noise = np.zeros(550, arrays_of(blob).dtype), np.random.default_rng(1)
    streams, times = repeat((Address("1", "blob"), Provenance())), repeat(1)
    with RecordingWriter(path) as writer:
        for _ in range(16):  # 2 MB that can hardly be compressed
            rows["data"] = noise.random((550, 440))
            writer.write(rows, blob, streams, logged=times, published=times)
        with open_recording(path) as reader:
            assert sum(reader.counts.values()) > 16 * 550 / 4


def test_truncated_file_is_read_up_to_the_cut(tmp_path: Path) -> None:
    """Wherever a file is cut, all complete messages before the cut are read."""
    path, truncated = tmp_path / "a.mcap", tmp_path / "truncated.mcap"
    with RecordingWriter(path) as writer:
        for count in range(1, 11):
            write(writer, message(count))
            writer.flush()
    data = path.read_bytes()
    counts = []
    for size in range(3000, len(data), 97):
        truncated.write_bytes(data[:size])
        with open_recording(truncated) as reader:
            counts.append(sum(reader.counts.values()))
            assert len(list(reader.records())) == counts[-1]
    assert counts == sorted(counts)
    assert counts[-1] == 10


def test_recording_that_goes_on_is_read_to_where_it_was_opened(tmp_path: Path) -> None:
    """What a recorder writes after the file was opened, over the end of the file, is no damage."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        write(writer, message(1))
        writer.flush()
        with open_recording(path) as reader:
            write(writer, *(message(number) for number in range(2, 1000)))
            writer.flush()
            assert len([*reader.records()]) == 1
            assert not reader.warnings
            assert not reader.damaged


def empty_recording() -> bytes:
    file = BytesIO()
    writer = Writer(file)
    writer.start()
    writer.finish()
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "an empty file"),
        (b"not mcap", "not a readable MCAP file"),
        (b"\x89MCAP0\r\n" + bytes(100), "no message can be read"),
        (bytes(10_000), "not a readable MCAP file"),
        (empty_recording(), "no messages of PX4 topics; no channel has a type of px4_msgs"),
        (None, "no such file"),
    ],
)
def test_file_without_messages_raises(tmp_path: Path, content: bytes | None, reason: str) -> None:
    """A file that is not a recording, or has no messages of PX4 topics, raises."""
    path = tmp_path / "a.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SourceError, match=reason):
        open_replay(f"mcap:{path}")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_ros2_bag_is_replayed(tmp_path: Path, layout: str) -> None:
    """A file from `ros2 bag record` in any layout of px4_msgs is replayed; other topics are ignored.

    A channel with an unsupported encoding is skipped with a warning.
    """
    path = tmp_path / "bag.mcap"
    definition = (
        "uint8 CONSTANT=1\n"
        + message_definition(layout)
        + "\n"
        + "=" * 80
        + "\nMSG: other/Type\nuint8 z\n"
    )
    sent = message(9, x=1.0, hagl_max_z=2.0)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(ROS2_TYPE, "ros2msg", definition.encode())
        other = writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
        topics = (
            "/fmu/out/vehicle_local_position",
            "/px4_1/fmu/out/estimator_local_position_1",
            "/other",
        )
        for topic in topics:
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, 1, encode_cdr(downgrade(sent, layout), layout=layout), 1)
        writer.add_message(
            writer.register_channel("/empty", "cdr", other), 1, b"\x00\x01\x00\x00", 1
        )
        idl = writer.register_schema(ROS2_TYPE, "ros2idl", b"")
        writer.add_message(writer.register_channel(f"/{ADDRESS}", "cdr", idl), 1, b"", 1)
        writer.finish()
    run = open_replay(f"mcap:{path}")
    assert list(map(str, run.addresses)) == [
        "1/vehicle_local_position",
        "px4_1/estimator_local_position/1",
    ]
    assert (
        f"skipped /{ADDRESS} (its encoding is cdr with ros2idl, not cdr with ros2msg"
        in run.warnings[0]
    )
    for each in run.messages:
        assert upgrade(each.fields) == upgrade(downgrade(sent, layout))


@pytest.mark.parametrize(
    "arguments", [["record", "-o", "there/a.mcap"], ["convert", "flight.mcap", "there/a.mcap"]]
)
def test_existing_file_is_not_replaced(endpoint: str, arguments: list[str]) -> None:
    """An existing file stays unchanged, and no other file is left behind."""
    convert_replay("sim:?duration=1", Path("flight.mcap"))
    path = Path("there/a.mcap")
    path.parent.mkdir()
    path.write_text("precious")
    ended = run_command(*arguments, NEDBUS_CONNECT=endpoint)
    assert ended.exit_code == 1
    assert "file exists): choose another name, or remove the file" in ended.err
    assert path.read_text() == "precious"
    assert list(path.parent.iterdir()) == [path]


LIMITED = """
import resource, sys
sys.dont_write_bytecode = True  # the interpreter would leave truncated bytecode in the checkout, without an error
if "plot" in sys.argv:
    import nedbus.tables.plot  # may write a cache of fonts
size = int(sys.argv.pop(1))
resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
"""

COMMAND = """
from nedbus.cli import main
main()
"""

FILL = """
import math
from pathlib import Path
from nedbus.flights import RecordingWriter
from tests.flights.messages import message
from tests.nedbus.flights.test_recorder import write

with RecordingWriter(Path(sys.argv[1])) as writer:
    for count in range(0, 100_000, 100):
        write(writer, *(message(each, x=math.sin(each), z=math.tan(each)) for each in range(count, count + 100)))
        writer.flush()
        print(f"flushed {count + 100}", flush=True)
"""


def run_limited(
    fork_server: ForkServer, script: str, size: int, *arguments: str
) -> tuple[int, str]:
    """Run a script in a process with a limit of the size of all files, as on a full disk.

    Return its exit code and output, which is a pipe and therefore not limited.
    """
    read_end, write_end = os.pipe()
    with open(os.devnull, "rb") as null, open(write_end, "wb") as out:  # noqa: PTH123 - a file descriptor
        streams = null.fileno(), out.fileno(), out.fileno()
        command = "-c", LIMITED + script, str(size), *arguments
        process = fork_server.start(
            command, cwd=Path.cwd(), environment=without_coverage(), streams=streams
        )
    try:
        exit_code = process.wait(DEADLINE)
    finally:
        process.kill()
    with open(read_end, encoding="utf-8") as output:  # noqa: PTH123 - a file descriptor
        return exit_code, output.read()


@pytest.mark.slow
@pytest.mark.process
def test_full_disk_raises_and_keeps_flushed_messages(
    fork_server: ForkServer, tmp_path: Path
) -> None:
    """A full disk raises OutputError; all flushed messages can be read."""
    path = tmp_path / "full.mcap"
    exit_code, output = run_limited(fork_server, FILL, 50_000, str(path))
    assert exit_code == 1
    assert output.splitlines()[-1].startswith(
        f"nedbus.errors.OutputError: {path} cannot be written (file too large)"
    )
    flushed = int(re.findall(r"flushed (\d+)", output)[-1])
    assert len(read_independently(path)) == flushed


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize(
    ("size", "arguments", "reason"),
    [
        (
            20_000,
            ["convert", "flight.mcap", "full/new.mcap"],
            "new.mcap cannot be written (file too large)",
        ),
        (
            5_000,
            ["plot", "flight.mcap", "-o", "full/new.png"],
            "new.png cannot be written (file too large)",
        ),
        (200, ["pki", "ca", "full/new"], "new/ca cannot be written: file too large"),
        (300, ["pki", "ca", "full/new"], "new/ca cannot be written: file too large"),
    ],
)
def test_full_disk_leaves_no_partial_file(
    fork_server: ForkServer, size: int, arguments: list[str], reason: str
) -> None:
    """On a full disk convert, plot and pki exit with 1, name the file, and leave no partial file or key."""
    convert_replay("sim:?duration=2", Path("flight.mcap"))
    Path("full").mkdir()
    exit_code, output = run_limited(fork_server, COMMAND, size, *arguments)
    assert exit_code == 1, output
    assert reason in output
    assert not [path for path in Path("full").rglob("*") if path.is_file()]


@pytest.mark.slow
def test_ctrl_c_finishes_the_recording(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, tmp_path: Path
) -> None:
    """Ctrl-C finishes the file, prints the counts, and exits with 0."""
    path = tmp_path / "a.mcap"
    recorder = run_nedbus("record", VLP, "-c", endpoint, "-o", str(path), coverage=False)
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


@pytest.mark.slow
def test_deleting_the_recording_exits_with_an_error(
    run_nedbus: Start, endpoint: str, tmp_path: Path
) -> None:
    """If the file is deleted, recording stops at the next flush with exit code 1."""
    path = tmp_path / "a.mcap"
    recorder = run_nedbus("record", "-c", endpoint, "-o", str(path))
    run_nedbus("serve", "--connect", endpoint, "-s", "sim:")
    wait_for(lambda: path.exists() and path.stat().st_size > 5000, what="messages")
    path.unlink()
    assert recorder.wait() == 1
    reason = "the file was deleted while it was being written): the written data is lost; write to a folder that is not"
    assert f"{path} cannot be written ({reason}" in recorder.err
    assert " messages" not in recorder.err


def test_moved_recording_is_continued(tmp_path: Path) -> None:
    """A file that is renamed during the recording is complete."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        path.rename(tmp_path / "b.mcap")
        write(writer, message(1))
    assert len(read_independently(tmp_path / "b.mcap")) == 1


@pytest.mark.parametrize("ended", ["by its duration", "by Ctrl-C"])
def test_recording_without_messages_warns_and_removes_the_file(
    endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, timings: Timings, ended: str
) -> None:
    """Without messages a notice is printed after 2 s; at the end the empty file is removed, with exit code 1.

    The recorder receives after the notice, because its duration might otherwise end before the notice.
    """
    path, noticed, receive = tmp_path / "a.mcap", threading.Event(), Subscription.receive_batch

    def receive_after_notice(subscription: Subscription, timeout: float) -> Batch:
        assert noticed.wait(DEADLINE)
        return receive(subscription, timeout)

    def end_after_notice(subscription: Subscription) -> None:
        write_notice(subscription)
        wait_for(path.exists, what="the file")
        noticed.set()
        if ended == "by Ctrl-C":
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Subscription, "receive_batch", receive_after_notice)
    monkeypatch.setattr("nedbus.cli.commands.recordings.write_notice", end_after_notice)
    timings.first_sample = 0.1
    duration = ["-d", "0.1"] if ended == "by its duration" else []
    recorder = run_command("record", "-v", "9", "-c", endpoint, "-o", str(path), *duration)
    assert recorder.exit_code == 1
    assert "no message on nedbus/9/** yet, still waiting; 'nedbus list' shows" in recorder.err
    assert f"{path}: 0 messages, removed the empty file" in recorder.err
    assert "nothing arrived on nedbus/9/** within" in recorder.err
    assert not path.exists()


def test_file_is_created_once_recording_has_started(bus: nedbus.Bus, tmp_path: Path) -> None:
    """A recorder that is interrupted before it runs leaves no file, and neither does one that stops at once."""
    path, stop = tmp_path / "a.mcap", threading.Event()
    stop.set()
    recorder = Recorder(bus.subscribe(ANY, mode="every"), path)
    assert (path.exists(), recorder.status) == (False, "0 messages")
    with pytest.raises(NoDataError):
        recorder.run(stop)
    assert not path.exists()


WRONG_SUFFIX = "its name must end with .mcap; for CSV, see nedbus.read in docs/recordings.md"


@pytest.mark.parametrize(
    ("arguments", "exit_code", "reason"),
    [
        ("convert a.ulg x.csv", 2, f"x.csv: {WRONG_SUFFIX}\n"),
        ("convert a.ulg b.png", 2, f"b.png: {WRONG_SUFFIX}\n"),
        ("convert a.ulg b", 2, f"b: {WRONG_SUFFIX}\n"),
        ("record -o a.txt", 2, f"a.txt: {WRONG_SUFFIX}\n"),
        ("record -o a.csv", 2, f"a.csv: {WRONG_SUFFIX}\n"),
        ("convert flight.txt a.mcap", 2, "its name must end with .ulg or .mcap"),
        ("convert flight.ulg a.mcap", 1, "/flight.ulg: no such file or directory\n"),
    ],
)
def test_invalid_argument_is_a_one_line_error(
    endpoint: str, arguments: str, exit_code: int, reason: str
) -> None:
    """An invalid argument exits with 2, an unreadable file with 1; one line is printed, and no file is written.

    Names of recordings must end with .mcap.
    """
    write_log(Path("a.ulg"), [1, 2])
    ended = run_command(*arguments.split(), NEDBUS_CONNECT=endpoint)
    assert ended.exit_code == exit_code, ended.err
    assert reason in ended.err
    assert len(ended.err.splitlines()) == 1
    assert [path.name for path in Path().iterdir()] == ["a.ulg"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_converted_log_is_complete(tmp_path: Path, layout: str) -> None:
    """A converted log contains the same messages, with the same missing fields."""
    log, path, writer = tmp_path / "a.ulg", tmp_path / "flight.mcap", UlogWriter(layout=layout)
    writer.define([VLP, "estimator_local_position"], without=["tilt_var", "eph"])
    for number in range(10):
        for instance in (0, 1):
            writer.add(
                "estimator_local_position", message(number, x=float(instance)), instance=instance
            )
        writer.add(VLP, message(number, x=float(number)))
    writer.write(log)
    converter = run_command("convert", str(log), str(path))
    assert converter.exit_code == 0, converter.err
    assert "30 messages" in converter.err

    def replay(source: str) -> list[tuple[Address, VehicleLocalPosition, set[str]]]:
        upgraded = [(each.address, upgrade(each.fields)) for each in open_replay(source).messages]
        return [(address, each, each.model_fields_set) for address, each in upgraded]

    assert replay(f"mcap:{path}") == replay(f"ulog:{log}")
    assert len(read_independently(path)) == 30


def test_unusual_messages_are_converted_or_counted(tmp_path: Path) -> None:
    """An impossible timestamp is kept in the message; the log time is limited to 64 bits of nanoseconds.

    An invalid message is left out and counted. A long conversion reports its progress.
    """
    path = tmp_path / "a.mcap"
    done: list[int] = []
    strange = [{"timestamp": 2**64 - 1}, {"timestamp": 2, "xy_valid": True}]
    messages = [SourceMessage(0.0, ADDRESS, each) for each in [{"timestamp": 1}] * 2998 + strange]
    run = ReplayRun(iter(messages), {}, None, "")
    assert (
        convert(run.messages, path, source="ulog", on_progress=done.append)
        == "2999 messages, 1 rejected"
    )
    assert [each.timestamp for *_, each in read_independently(path)] == [1] * 2998 + [2**64 - 1]
    assert done == [1024, 2048]


def test_conversion_without_an_output_names_it() -> None:
    """The error of `nedbus convert flight.ulg` names the missing recording, not the flight."""
    ended = run_command("convert", "flight.ulg")
    assert ended.exit_code == 2
    assert "name the recording to write, as in 'nedbus convert flight.ulg" in ended.err


def test_conversion_without_a_valid_message_fails(tmp_path: Path) -> None:
    """If all messages are rejected, `convert` exits with an error that quotes the first reason, and writes no file."""
    writer, path = UlogWriter(), tmp_path / "a.mcap"
    writer.define([VLP])
    for timestamp in range(0, 20_000, 1000):
        writer.add(VLP, message(timestamp), xy_valid=True)
    ended = run_command("convert", str(writer.write(tmp_path / "a.ulg")), str(path))
    assert ended.exit_code == 1
    assert (
        "a.mcap: not written, because all 20 messages are rejected: x: must be finite" in ended.err
    )
    assert [each.name for each in tmp_path.iterdir()] == ["a.ulg"]


@pytest.mark.parametrize("suffix", [".mcap", ".ulg"])
def test_pipe_or_folder_raises(tmp_path: Path, suffix: str) -> None:
    """A folder raises, and so does a FIFO, which would otherwise block forever."""
    pipe = tmp_path / f"pipe{suffix}"
    os.mkfifo(pipe)
    plot = run_command("plot", str(pipe))
    assert plot.exit_code == 1, plot.err
    assert "not a regular file" in plot.err
    folder = tmp_path / f"folder{suffix}"
    folder.mkdir()
    with pytest.raises(
        SourceError, match="not a regular file" if suffix == ".ulg" else "no .mcap file"
    ):
        nedbus.read(folder)


@pytest.mark.slow
def test_private_and_unknown_records_are_skipped(tmp_path: Path) -> None:
    """Application-specific records and records of later MCAP versions are not reported as damage."""
    path, extended = tmp_path / "a.mcap", tmp_path / "b.mcap"
    convert_replay(f"ulog:{write_log(tmp_path / 'a.ulg', range(0, 10_000_000, 1000))}", path)
    content, at, parts = path.read_bytes(), 8, list[bytes]()
    while content[at] != 15:  # the end of the data section
        end = at + 9 + int.from_bytes(content[at + 1 : at + 9], "little")
        parts.append(content[at:end])
        if content[end] not in (7, 8):  # after a chunk and its index
            parts.append(b"\x90\x05" + bytes(7) + b"hello\x30\x03" + bytes(7) + b"new")
        at = end
    extended.write_bytes(content[:8] + b"".join(parts) + content[at:])
    with open_recording(extended) as reader:
        list(reader.records())
        assert (reader.damaged, sum(reader.counts.values())) == (False, 10_000)
        assert not [warning for warning in reader.warnings if "skipped" in warning]


def test_px4_texts_are_also_recorded_as_ros2_log(tmp_path: Path) -> None:
    """`log_message` is recorded a second time as ROS 2's Log, which nedbus ignores when it reads the file."""
    path, texts = tmp_path / "a.mcap", ["Takeoff detected", "12 \u00b5s", ""]
    written = [
        LogMessage(timestamp=number, severity=2 * number, text=text)
        for number, text in enumerate(texts)
    ]
    with RecordingWriter(path) as writer:
        writer.write_messages(
            (each, Address("7", "log_message"), Provenance("mavlink", frozenset()), 10**18 + number)
            for number, each in enumerate(written)
        )
        assert writer.messages == 3
    assert nedbus.read(path, "log_message").tobytes() == to_array(written).tobytes()
    assert nedbus.addresses_of(path) == [Address("7", "log_message")]
    store, found = get_typestore(Stores.ROS2_JAZZY), []
    with path.open("rb") as file:
        for schema, channel, each in make_reader(file).iter_messages(topics=["/7/log"]):
            assert schema is not None
            assert (schema.name, schema.encoding) == ("rcl_interfaces/msg/Log", "ros2msg")
            assert channel.message_encoding == "cdr"
            log: Any = store.deserialize_cdr(each.data, schema.name)
            assert bytes(store.serialize_cdr(log, schema.name)) == each.data
            found.append((log.stamp.sec, log.stamp.nanosec, log.level, log.name, log.msg))
    assert found == [
        (10**9, 0, 50, "7", texts[0]),
        (10**9, 1, 50, "7", texts[1]),
        (10**9, 2, 30, "7", ""),
    ]
