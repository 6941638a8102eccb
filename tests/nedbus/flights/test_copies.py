"""Recordings that other tools copied, split or extended, and logs with repeated subscriptions."""

from __future__ import annotations

import logging
import struct
from io import BytesIO
from pathlib import Path

import pytest
from mcap.reader import NonSeekingReader
from mcap.writer import Writer

import nedbus
from nedbus.errors import SourceError
from nedbus.flights import RecordingWriter
from nedbus_msgs import DEFAULT, Address, DecodeError, Provenance, decode_with, encode_with
from tests.flights.messages import message
from tests.flights.replays import convert_replay, open_replay
from tests.flights.ulogs import UlogWriter
from tests.peers.command_line import run_command

from .formats import VLP


def copy_without_metadata(
    source: Path, target: Path, *, rename: dict[str, str] | None = None
) -> None:
    """Copy a recording as rosbags and mcap-ros2-support do: topics, schemas and messages, without channel metadata."""
    with target.open("wb") as file:
        writer, schemas, channels = Writer(file), dict[int, int](), dict[int, int]()
        writer.start(profile="ros2", library="copy")
        for schema, channel, each in NonSeekingReader(BytesIO(source.read_bytes())).iter_messages():
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                topic = (rename or {}).get(channel.topic, channel.topic)
                channels[channel.id] = writer.register_channel(topic, "cdr", schemas[schema.id], {})
            writer.add_message(channels[channel.id], each.log_time, each.data, each.publish_time)
        writer.finish()


def start_recording(folder: Path, out: BytesIO) -> tuple[Writer, int]:
    """Start a recording with the channel of one message of nedbus's recordings, without metadata."""
    with RecordingWriter(path := folder / "a.mcap") as recorder:
        recorder.write_messages([(message(1), Address("1", VLP), Provenance(), 1)])
    schema, channel, _ = next(NonSeekingReader(BytesIO(path.read_bytes())).iter_messages())
    assert schema is not None
    writer = Writer(out, chunk_size=2**20)
    writer.start(profile="ros2", library="extended")
    number = writer.register_schema(schema.name, schema.encoding, schema.data)
    return writer, writer.register_channel(channel.topic, "cdr", number, {})


@pytest.mark.slow
def test_copy_without_metadata_has_all_streams(tmp_path: Path) -> None:
    """The names of nedbus's own channels, with an instance at the end, are parsed as such."""
    original, copy = tmp_path / "a.mcap", tmp_path / "b.mcap"
    convert_replay("sim:?duration=5", original)
    copy_without_metadata(original, copy)
    assert nedbus.addresses_of(copy) == nedbus.addresses_of(original)
    before, after = nedbus.read(original, ["*"]), nedbus.read(copy, ["*"])
    assert {name: each.tobytes() for name, each in after.items()} == {
        name: each.tobytes() for name, each in before.items()
    }
    assert run_command("events", str(copy)).exit_code == 0


@pytest.mark.slow
def test_skipped_stream_counts_as_damage(tmp_path: Path) -> None:
    """A stream that is skipped whole is reported in one short line, and fails a conversion."""
    original, copy = tmp_path / "a.mcap", tmp_path / "b.mcap"
    convert_replay("sim:?duration=5", original)
    copy_without_metadata(original, copy, rename={f"/1/{VLP}": "/1/9"})
    ended = run_command("convert", str(copy), str(tmp_path / "c.mcap"))
    assert ended.exit_code == 1
    assert "skipped /1/9 (its name does not end with a topic of PX4)" in ended.err
    assert max(map(len, ended.err.splitlines())) < 400


def test_newer_version_of_a_topic_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Of a topic that PX4's translation node publishes in two versions, only the newer one is read, with a warning."""
    original, bag = tmp_path / "a.mcap", tmp_path / "bag.mcap"
    with RecordingWriter(original) as writer:
        rows = [(message(1_000_000 + index, x=float(index)), index) for index in range(100)]
        for name in "12":
            writer.write_messages(
                (each, Address(name, VLP), Provenance(), 1000 * index + int(name))
                for each, index in rows
            )
    topics = {f"/1/{VLP}": f"/fmu/out/{VLP}", f"/2/{VLP}": f"/fmu/out/{VLP}_v1"}
    copy_without_metadata(original, bag, rename=topics)
    with caplog.at_level(logging.WARNING):
        assert nedbus.read(bag)["x"].tolist() == [float(index) for index in range(100)]
    warning = f"skipped /fmu/out/{VLP}: /fmu/out/{VLP}_v1 has the same messages in a newer version"
    assert caplog.text.count(warning) == 1
    assert len(list(open_replay(f"mcap:{bag}?speed=max").messages)) == 100


def test_messages_behind_the_indexed_chunks_are_read(tmp_path: Path) -> None:
    """Messages that the index of an MCAP file does not list are read by arrays, flights and replays."""
    out = BytesIO()
    writer, channel = start_recording(tmp_path, out)
    for index in range(13):
        payload = encode_with(
            DEFAULT, message(1 + index, x=float(index)).model_dump(), DEFAULT.current
        )
        if index == 10:
            getattr(writer, "_Writer__finalize_chunk")()  # noqa: B009 - a private name of the class
            setattr(writer, "_Writer__chunk_builder", None)  # noqa: B010 - further messages are not in chunks
        writer.add_message(channel, index, payload, index)
    writer.finish()
    (path := tmp_path / "b.mcap").write_bytes(out.getvalue())
    assert nedbus.read(path)["x"].tolist() == [float(index) for index in range(13)]
    with nedbus.open(path) as flight:
        assert len(list(flight())) == 13
    assert len(list(open_replay(f"mcap:{path}?speed=max").messages)) == 13


def test_malformed_payload_is_skipped_alone(tmp_path: Path) -> None:
    """A bool other than 0 or 1, a wrong length or another encapsulation makes only that message invalid."""
    payload = encode_with(
        DEFAULT, message(1, x=1.0, y=2.0, xy_valid=True).model_dump(), DEFAULT.current
    )
    first_bool = 4 + 16
    assert payload[first_bool] == 1
    others = [
        payload[:first_bool] + bytes([byte]) + payload[first_bool + 1 :] for byte in (2, 3, 255)
    ]
    others += [payload[:-1], payload + bytes(4), b"\x00\x00" + payload[2:]]
    out = BytesIO()
    writer, channel = start_recording(tmp_path, out)
    for index, each in enumerate([payload, *others, payload]):
        writer.add_message(channel, index, each, index)
    writer.finish()
    (path := tmp_path / "b.mcap").write_bytes(out.getvalue())
    assert nedbus.read(path)[["x", "y", "xy_valid"]].tolist() == 2 * [(1.0, 2.0, True)]
    with nedbus.open(path) as flight, flight() as samples:
        assert [each.message.x for each in samples] == [1.0, 1.0]
        assert samples.skipped.total() == len(others)


@pytest.mark.parametrize("new_id", [0, 1])
@pytest.mark.parametrize("unsubscribed", [True, False])
def test_repeated_subscription_is_one_stream(
    tmp_path: Path, new_id: int, *, unsubscribed: bool
) -> None:
    """A topic that is subscribed to again, with the same or another id, is one stream without losses."""
    writer = UlogWriter()
    writer.define([VLP])
    for index in range(100):
        if index == 50:
            if unsubscribed:
                writer.put("R", struct.pack("<H", 0))
            writer.put("A", struct.pack("<BH", 0, new_id) + VLP.encode())
            writer._ids[VLP, 0] = new_id
        writer.add(VLP, message(1_000_000 + 20_000 * index, x=float(index)))
    path = writer.write(tmp_path / "a.ulg")
    assert nedbus.read(path)["x"].tolist() == [float(index) for index in range(100)]
    with nedbus.open(path) as flight:
        assert len(list(flight())) == 100
        assert not flight.warnings
    assert len(list(open_replay(f"ulog:{path}?speed=max").messages)) == 100


def test_equal_messages_of_two_subscriptions_are_one(tmp_path: Path) -> None:
    """PX4 may log a topic twice: a message that both subscriptions have is read once."""
    writer = UlogWriter()
    writer.define([VLP])
    for number in (0, 1):
        writer.put("A", struct.pack("<BH", 0, number) + VLP.encode())
    for index in range(20):
        for writer._ids[VLP, 0] in (0, 1):
            writer.add(VLP, message(1_000_000 + index, x=float(index)))
    path = writer.write(tmp_path / "a.ulg")
    assert nedbus.read(path)["x"].tolist() == [float(index) for index in range(20)]


@pytest.mark.slow
@pytest.mark.parametrize("begin", [1, 1000, 1999])
def test_second_subscription_in_a_log_repeats_no_message(tmp_path: Path, begin: int) -> None:
    """A second subscription may begin anywhere in a log: all messages are read once, in order."""
    writer = UlogWriter()
    writer.define([VLP])
    for index in range(2000):
        if index == begin:
            writer.put("A", struct.pack("<BH", 0, 1) + VLP.encode())
        for number in range(1 + (index >= begin)):
            writer.add(VLP, message(1_000_000 + index, x=float(index)))
            writer._ids[VLP, 0] = 1 - number if index >= begin else 0
    path = writer.write(tmp_path / "a.ulg")
    assert len(writer.data) > 2 * 2**17, "the reader must need several parts"
    assert nedbus.read(path)["x"].tolist() == [float(index) for index in range(2000)]
    with nedbus.open(path) as flight:
        assert [each.message.x for each in flight()] == [float(index) for index in range(2000)]


def test_payload_of_another_release_names_it() -> None:
    """The error for a payload of the wrong size names the release whose layout fits, and the remedy."""
    layouts = DEFAULT.layouts
    fields = DEFAULT.downgrade(message(1).model_dump(), layouts["1.15"])
    payload = encode_with(DEFAULT, fields, layouts["1.15"])
    reason = r"204 bytes, expected 220.* they fit the layout of PX4 1\.15: .*rebuild px4_msgs at release/1\.15"
    with pytest.raises(DecodeError, match=reason):
        decode_with(DEFAULT, payload, DEFAULT.current)
    with pytest.raises(DecodeError, match=r"203 bytes, expected 220 for layout 1\.16$"):
        decode_with(DEFAULT, payload[:-1], DEFAULT.current)


@pytest.mark.long
def test_growing_file_is_read_as_far_as_it_is(tmp_path: Path) -> None:
    """Messages that are appended while a log is read are no error; the reader has not reached its end."""
    writer = UlogWriter()
    writer.define([VLP])
    for index in range(20_000):
        writer.add(VLP, message(10_000 * (100 + index), x=float(index)))
    path = writer.write(tmp_path / "a.ulg")
    written = len(writer.data)
    writer.add(VLP, message(10_000 * 20_100))
    with nedbus.open(path) as flight:
        samples = flight()
        next(samples)
        with path.open("ab") as file:
            file.write(writer.data[written:])
        assert len(list(samples)) == 20_000


def test_missing_file_raises(tmp_path: Path) -> None:
    """Opening a file that does not exist raises at once."""
    for suffix in (".ulg", ".mcap", ".tlog"):
        with pytest.raises(SourceError, match="no such file"):
            nedbus.open(tmp_path / f"none{suffix}")
