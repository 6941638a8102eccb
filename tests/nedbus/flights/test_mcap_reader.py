"""Files from `ros2 bag record` and other MCAP writers, and files in unsupported formats."""

from __future__ import annotations

import itertools
import sqlite3
from collections.abc import Callable
from contextlib import closing
from io import DEFAULT_BUFFER_SIZE, BytesIO
from pathlib import Path

import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer

import nedbus
from nedbus import limits
from nedbus.errors import SourceError
from nedbus.flights import RecordingWriter
from nedbus.flights.readers import ReadOptions
from nedbus.flights.readers.mcap import McapReader
from nedbus_msgs import DEFAULT, Address, Provenance
from nedbus_msgs.arrays import to_array
from tests.flights.local_position import ROS2_TYPE, downgrade, encode_cdr, message_definition
from tests.flights.messages import VLP, message
from tests.flights.replays import open_recording, open_replay
from tests.nedbus.sources.test_damage import payloads_of
from tests.peers.command_line import run_command

TOPIC = "/fmu/out/vehicle_local_position"
CASES = Path(__file__).parents[4] / "shared/cases"
WIND = b"\x00\x00\x60\x40"  # 3.5 as a float32


def write_bag(
    path: Path,
    numbers: range = range(10),
    *,
    definition: str = message_definition("1.16"),
    encoding: str = "ros2msg",
    change: Callable[[bytes], bytes] = bytes,
) -> Path:
    """Write positions with x = 0, 1, ..., as `ros2 bag record` does; `change`: modifies each payload."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(ROS2_TYPE, encoding, definition.encode())
        channel = writer.register_channel(TOPIC, "cdr", schema, {"offered_qos_profiles": ""})
        for number in numbers:
            payload = encode_cdr(
                downgrade(message(number + 1, x=float(number)), "1.16"), layout="1.16"
            )
            writer.add_message(channel, number * 10**9, change(payload), number)
        writer.finish()
    return path


def assert_complete(path: Path, *, warnings: tuple[str, ...] = ()) -> None:
    """Assert that all ten positions are read as an array, and replayed."""
    assert nedbus.read(path)["x"].tolist() == list(range(10))
    run = open_replay(f"mcap:{path}")
    assert [each.fields["x"] for each in run.messages if not each.error] == list(range(10))
    assert run.warnings == warnings
    assert run.damage is None


def add_in_middle(payload: bytes) -> bytes:
    """Add two floats after `timestamp_sample`, which keeps the later fields aligned."""
    return payload[:20] + WIND + WIND + payload[20:]


@pytest.mark.parametrize("where", ["end", "middle"])
def test_fields_unknown_to_px4_are_skipped_and_listed(tmp_path: Path, where: str) -> None:
    """Additional fields in the file's definition, wherever they are, are skipped and listed; no message is lost."""
    text, own = message_definition("1.16"), "float32 wind_north\nfloat32 wind_east\n"
    if where == "end":
        path = write_bag(
            tmp_path / "a.mcap",
            definition=text + own,
            change=lambda each: each + -len(each) % 4 * b"\0" + 2 * WIND,
        )
    else:
        first, second = text.split("uint64 timestamp_sample", 1)
        rest, text = second.split("\n", 1)
        text = f"{first}uint64 timestamp_sample{rest}\n{own}{text}"
        path = write_bag(tmp_path / "a.mcap", definition=text, change=add_in_middle)
    left_out = (
        f"left out wind_east, wind_north of {TOPIC}, unknown to nedbus in VehicleLocalPosition"
    )
    assert_complete(path, warnings=(left_out,))


@pytest.mark.parametrize("value", [2, 3, 128, 255])
@pytest.mark.parametrize("name", ["xy_valid", "gust"])
@pytest.mark.parametrize("count", [10, 1000])
def test_message_with_a_bool_of_another_value_is_invalid(
    tmp_path: Path, value: int, name: str, count: int
) -> None:
    """A byte of a bool is 0 or 1, also in a field that is left out; samples and arrays leave out the same message."""
    xy_valid = 20  # its place in the payload

    def change(payload: bytes) -> bytes:
        """Add the field `gust` to a payload, and change one of its bools."""
        is_changed = payload == changed
        if is_changed and name == "gust":
            return payload + bytes([value])
        if is_changed:
            payload = payload[:xy_valid] + bytes([value]) + payload[xy_valid + 1 :]
        return payload + bytes([1])

    changed = encode_cdr(downgrade(message(5, x=4.0), "1.16"), layout="1.16")
    definition = message_definition("1.16") + "bool gust\n"
    path = write_bag(tmp_path / "a.mcap", range(count), definition=definition, change=change)
    valid = [number for number in range(count) if number != 4]
    assert nedbus.read(path)["x"].tolist() == valid
    messages = open_replay(f"mcap:{path}").messages
    assert [each.fields["x"] for each in messages if not each.error] == valid


def test_definition_that_matches_no_release_raises(tmp_path: Path) -> None:
    """A definition that lacks required fields, or has them with other types, raises; the error names the fields."""
    text = (
        message_definition("1.16")
        .replace("float32 x ", "float64 x ")
        .replace("float32 y ", "float32 y2 ")
    )
    with pytest.raises(SourceError, match=r"its definition of x, y matches no PX4 release"):
        nedbus.read(write_bag(tmp_path / "a.mcap", definition=text))


def test_message_whose_timestamp_is_not_first_is_read(tmp_path: Path) -> None:
    """A message that only the file defines is decoded in the order of its definition."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(
            "px4_msgs/msg/Wind", "ros2msg", b"float32 north\nuint64 timestamp\n"
        )
        channel = writer.register_channel("/fmu/out/wind", "cdr", schema)
        writer.add_message(
            channel, 1, b"\x00\x01\x00\x00" + WIND + bytes(4) + (7).to_bytes(8, "little"), 1
        )
        writer.finish()
    assert nedbus.read(path, "wind").tolist() == [(7, 3.5)]


@pytest.mark.parametrize("size", [1, 5000])  # in one run, and in several
def test_reason_of_skipped_messages_is_that_of_the_first(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, size: int
) -> None:
    """The warning about unusable messages names what is wrong with the first of them."""
    path = tmp_path / "a.mcap"
    valid = b"\x00\x01\x00\x00" + (7).to_bytes(8, "little") + WIND
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(
            "px4_msgs/msg/Wind", "ros2msg", b"uint64 timestamp\nfloat32 north\n"
        )
        channel = writer.register_channel("/fmu/out/wind", "cdr", schema)
        for time, payload in enumerate(
            [valid, b"\x00\x09\x00\x00" + valid[4:], *([valid] * size), valid[:9]]
        ):
            writer.add_message(channel, time, payload, time)
        writer.finish()
    assert len(nedbus.read(path, "wind")) == size + 1
    [warning] = caplog.messages
    assert f"skipped 2 of {size + 3} messages" in warning
    assert "starts with 00 09" in warning


@pytest.mark.parametrize("annotation", ["@range 5, 0", "@range 0; 9"])
def test_definition_with_invalid_range_is_read_without_it(tmp_path: Path, annotation: str) -> None:
    """An annotation that would be an error in a .msg file costs only its rule, with a warning, not the topic."""
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = f"uint64 timestamp\nfloat32 north # {annotation}\n"
        schema = writer.register_schema("px4_msgs/msg/Wind", "ros2msg", text.encode())
        channel = writer.register_channel("/fmu/out/wind", "cdr", schema)
        writer.add_message(channel, 1, b"\x00\x01\x00\x00" + (7).to_bytes(8, "little") + WIND, 1)
        writer.finish()
    run = open_replay(f"mcap:{path}?topics=*")
    assert [each.fields["north"] for each in run.messages] == [3.5]
    assert (
        "ignored the ranges in the definition of /fmu/out/wind (line 2, column 1" in run.warnings[0]
    )


FLAGS = {
    "repeat_schemas": (True, False), "repeat_channels": (True, False), "use_statistics": (True, False),
    "use_summary_offsets": (True, False), "enable_crcs": (True, False), "has_extras": (True, False),
    "has_padding": (True, False),
    "index_types": tuple(
        IndexType.NONE | chunk | each | extra
        for chunk in (IndexType.CHUNK, IndexType.NONE)
        for each in (IndexType.MESSAGE, IndexType.NONE)
        for extra in (IndexType.ATTACHMENT | IndexType.METADATA, IndexType.NONE)
    ),
}  # fmt: skip


def write_variant(*, has_extras: bool, **options: object) -> bytes:
    file = BytesIO()
    writer = Writer(file, chunk_size=200, **options)  # type: ignore[arg-type] # any options
    writer.start()
    channels = []
    for topic in ("first_topic", "second_topic"):
        name = topic.title().replace("_", "")
        schema = writer.register_schema(f"px4_msgs/msg/{name}", "ros2msg", b"uint64 timestamp\n")
        channels.append(writer.register_channel(f"/fmu/out/{topic}", "cdr", schema))
    channels.append(writer.register_channel("/without_schema", "cdr", 0))
    for number in range(10):
        payload = b"\x00\x01\x00\x00" + number.to_bytes(8, "little")
        writer.add_message(channels[number % 3], number, payload, number)
        if has_extras and number == 5:
            writer.add_attachment(1, 1, "a", "text/plain", b"1234")
            writer.add_metadata("a", {"b": "c"})
    writer.finish()
    return file.getvalue()


SLOW_FORMS = [
    pytest.param(form, marks=pytest.mark.slow)
    for form in (CompressionType.NONE, CompressionType.LZ4)
]


@pytest.mark.slow
@pytest.mark.parametrize("form", [None, CompressionType.ZSTD, *SLOW_FORMS])
def test_all_variants_of_mcap_are_read_completely(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: CompressionType | None
) -> None:
    """For all combinations of optional features, the reader finds as many messages as the mcap package.

    This includes records with bytes after their known fields, as later versions of the format may have.
    """
    path = tmp_path / "a.mcap"
    has_padding = False
    # The mcap package skips bytes after known fields only outside of chunks, and finds a footer by its length.
    exact = {Opcode.MESSAGE, Opcode.FOOTER} | ({Opcode.SCHEMA, Opcode.CHANNEL} if form else set())
    finish: Callable[[RecordBuilder], None] = RecordBuilder.finish_record

    def finish_padded(self: RecordBuilder) -> None:
        opcode = self._buffer.getvalue()[self._record_start_offset]
        if has_padding and opcode not in exact:
            self.write(b"\x01\xff\xff")
        finish(self)

    monkeypatch.setattr(RecordBuilder, "finish_record", finish_padded)
    for values in itertools.product(*FLAGS.values()):
        options = dict(zip(FLAGS, values, strict=True))
        has_padding = bool(options.pop("has_padding"))
        data = write_variant(
            use_chunking=form is not None, compression=form or CompressionType.NONE, **options  # type: ignore[arg-type]
        )  # fmt: skip
        path.write_bytes(data)
        expected = [
            each.log_time
            for schema, _, each in NonSeekingReader(BytesIO(data)).iter_messages()
            if schema
        ]
        assert len(expected) == 7, options
        with open_recording(path) as reader:
            assert sum(reader.counts.values()) == len(expected), options
            assert [each.time for each in reader.records()] == [
                each // 1000 for each in expected
            ], options
        with McapReader(path, ReadOptions(topics={"second_topic"})) as reader:
            assert len(list(reader.records())) == 3, options
            assert not reader.warnings, options


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_bit_flip_outside_chunks_does_not_create_messages(tmp_path: Path, every: int) -> None:
    """Record headers and message indexes have no CRC; a bit flip there is reported or harmless."""
    path = tmp_path / "a.mcap"
    with RecordingWriter(path) as writer:
        for number in range(2):
            positions = [message(2 * number + 1), message(2 * number + 2)]
            streams = [
                (Address(vehicle, VLP), Provenance("sim", frozenset({"dist_bottom"})))
                for vehicle in "12"
            ]
            writer.write(
                to_array(positions), DEFAULT, streams, logged=[number] * 2, published=[number] * 2
            )
            writer.flush()
        data = path.read_bytes()
    path.write_bytes(data)
    original = payloads_of(path)[0]
    assert original.total() == 4
    offset, places = 8, list[int]()
    while offset < len(data) - 8:
        length = int.from_bytes(data[offset + 1 : offset + 9], "little")
        places += range(offset, offset + 9 + min(length, 30))
        offset += 9 + length
    for place in places:
        for bit in range(place % every, 8, every):
            changed = bytearray(data)
            changed[place] ^= 1 << bit
            path.write_bytes(changed)
            try:
                read, reader = payloads_of(path)
            except SourceError:
                continue
            assert not read - original, (place, bit)
            assert reader.damaged or read == original, (place, bit)


def test_damaged_summary_is_not_used(tmp_path: Path) -> None:
    """The summary has a CRC: after a bit flip in a vehicle's name there, the name comes from the chunks."""
    path, address = tmp_path / "a.mcap", Address("alpha", VLP)
    with RecordingWriter(path) as writer:
        writer.write(
            to_array([message(1)]), DEFAULT, [(address, Provenance())], logged=[1], published=[1]
        )
    data = bytearray(path.read_bytes())
    data[data.rindex(b"alpha")] ^= 1
    path.write_bytes(data)
    with open_recording(path) as reader:
        assert [each.stream.address for each in reader.records()] == [address]
        assert reader.warnings == ["the index is damaged; reading without it"]
        assert not reader.damaged


def git_lfs_pointer(path: Path) -> None:
    path.write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:12\n")


def bag_in_sqlite(path: Path) -> None:
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE topics (name)")


@pytest.mark.parametrize("suffix", [".ulg", ".mcap", ".zip", ".db3"])
@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (
            lambda path: path.write_bytes(b"ULogKey\x01" + bytes(100)),
            "an encrypted log; decrypt it",
        ),
        (lambda path: path.write_bytes(b"PK\x03\x04" + bytes(100)), "a zip archive; unpack it"),
        (lambda path: path.write_bytes(b"\x1f\x8b" + bytes(100)), "a gzip file; unpack it"),
        (lambda path: path.write_bytes(b""), "an empty file"),
        (git_lfs_pointer, "a Git LFS pointer .* 'git lfs pull'"),
        (bag_in_sqlite, "an SQLite bag; convert it to MCAP with 'ros2 bag convert'"),
    ],
)
def test_unsupported_file_format_raises_with_remedy(
    tmp_path: Path, make: Callable[[Path], object], reason: str, suffix: str
) -> None:
    """Every command recognizes an unsupported format by its content, and the error names the remedy."""
    path = tmp_path / f"a{suffix}"
    make(path)
    with pytest.raises(SourceError, match=reason):
        nedbus.read(path)
    for arguments in (["events"], ["why"], ["convert"], ["plot"]):
        output = ["b.mcap"] if arguments == ["convert"] else []
        ended = run_command(*arguments, str(path), *output)
        assert ended.exit_code in {1, 2}, ended.err
        assert reason.partition(" .*")[0] in " ".join(ended.err.split()), ended.err
    with pytest.raises(SourceError, match=reason):
        open_replay(f"ulog:{path}")


@pytest.mark.parametrize(
    ("encoding", "definition", "reason"),
    [
        (
            "ros2idl",
            "module px4_msgs {};",
            "its encoding is cdr with ros2idl, not cdr with ros2msg",
        ),
        ("", "", "the file has no definition of px4_msgs/msg/VehicleLocalPosition"),
        ("ros2msg", "uint64 timestamp\nstring name\n", "line 2, column 1"),
    ],
)
def test_recording_without_readable_messages_raises(
    tmp_path: Path, encoding: str, definition: str, reason: str
) -> None:
    """A recording without a readable message raises with the reason, in `read` and in a replay."""
    path = write_bag(tmp_path / "a.mcap", encoding=encoding, definition=definition)
    for read in (nedbus.read, lambda path: open_replay(f"mcap:{path}")):
        with pytest.raises(SourceError, match=rf"{TOPIC} \({reason}"):
            read(path)


def test_bag_with_compressed_messages_is_read(tmp_path: Path) -> None:
    """A bag from `ros2 bag record --compression-mode message`, which compresses each payload, is read."""
    assert_complete(write_bag(tmp_path / "a.mcap", change=zstandard.compress))


def test_message_that_expands_above_the_limit_is_rejected(tmp_path: Path) -> None:
    """A message that expands to more than 64 KiB is rejected without decompressing it."""
    path = write_bag(tmp_path / "a.mcap", change=lambda _: zstandard.compress(bytes(2**16 + 1)))
    assert [bool(each.error) for each in open_replay(f"mcap:{path}").messages] == [True] * 10


@pytest.mark.parametrize("suffix", ["", ".zstd"])
def test_split_bag_is_one_recording(tmp_path: Path, suffix: str) -> None:
    """The files of a bag folder are read in order; a missing file that the metadata lists is reported."""
    folder = tmp_path / "bag"
    folder.mkdir()
    for number, part in enumerate([range(4), range(4, 9), range(9, 10)]):
        path = write_bag(folder / f"bag_{number + 8}.mcap", part)
        if suffix:
            path.with_name(path.name + suffix).write_bytes(zstandard.compress(path.read_bytes()))
            path.unlink()
    listed = "".join(f"    - bag_{number}.mcap{suffix}\n" for number in (8, 9, 10))
    (folder / "metadata.yaml").write_text(f"bag:\n  relative_file_paths:\n{listed}")
    assert_complete(folder)
    assert run_command("events", str(folder)).exit_code == 0
    (folder / "metadata.yaml").write_text(
        f"bag:\n  relative_file_paths:\n{listed}    - bag_11.mcap\n"
    )
    assert open_replay(f"mcap:{folder}").damage == (
        f"{folder}: some messages are lost to damage; bag_11.mcap of this bag is missing"
    )


def test_folder_without_mcap_files_raises(tmp_path: Path) -> None:
    """A folder without MCAP files raises; for an SQLite bag the error names the remedy."""
    with pytest.raises(SourceError, match=r"no \.mcap file in this folder"):
        nedbus.read(tmp_path)
    bag_in_sqlite(tmp_path / "a_0.db3")
    with pytest.raises(SourceError, match="an SQLite bag; convert it"):
        nedbus.read(tmp_path)


def test_compressed_sqlite_bag_raises_with_remedy(tmp_path: Path) -> None:
    """An SQLite bag with compression of files, as a file or a folder, raises; the error names the remedy."""
    bag = tmp_path / "bag_0.db3"
    bag_in_sqlite(bag)
    compressed = tmp_path / "bag_0.db3.zstd"
    compressed.write_bytes(zstandard.compress(bag.read_bytes()))
    bag.unlink()
    for path in (tmp_path, compressed):
        with pytest.raises(SourceError, match="an SQLite bag; convert it"):
            nedbus.read(path)


def test_compressed_recording_that_fits_in_a_buffer_is_read(tmp_path: Path) -> None:
    """A compressed file is read to its end, also the bytes that do not fill the buffer of the temporary file.

    Found with a bag of five short messages from rosbags 0.11.9.
    """
    definition = "uint64 timestamp\n"
    path = tmp_path / "a.mcap.zstd"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("px4_msgs/msg/Probe", "ros2msg", definition.encode())
        channel = writer.register_channel("/fmu/out/probe", "cdr", schema)
        for stamp in range(1, 6):
            writer.add_message(channel, stamp, b"\0\1\0\0" + stamp.to_bytes(8, "little"), stamp)
        writer.finish()
    data = path.read_bytes()
    assert len(data) < DEFAULT_BUFFER_SIZE
    path.write_bytes(zstandard.compress(data))
    assert nedbus.read(path, "probe")["timestamp"].tolist() == [1, 2, 3, 4, 5]


def test_compressed_recording_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file from `ros2 bag record --compression-mode file` is read up to the first damage or a size limit."""
    path = tmp_path / "a.mcap.zstd"
    data = zstandard.compress(write_bag(tmp_path / "a.mcap").read_bytes())
    path.write_bytes(data)
    assert_complete(path)
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(SourceError, match=r"no message can be read|not a readable MCAP file"):
        nedbus.read(path)
    monkeypatch.setattr(limits, "BLOCK_BYTES", 2**20)
    path.write_bytes(zstandard.compress(bytes(2**21)))
    with pytest.raises(
        SourceError, match=r"not a readable MCAP file; the compressed file is damaged \(more than"
    ):
        nedbus.read(path)


@pytest.mark.skipif(not CASES.is_dir(), reason="no ../shared/cases")
@pytest.mark.parametrize(
    "name",
    [
        "23_no_repeat_schemas.mcap", "26_rosbag2_message_compression.mcap", "26_split_bag",
        "29_own_field_appended.mcap", "29b_own_field_middle.mcap",
    ],
)  # fmt: skip
def test_files_from_user_reports_are_read_completely(name: str) -> None:
    """Files written by the libraries rosbags and mcap have ten messages each, x = 0 to 9."""
    assert nedbus.read(CASES / name)["x"].tolist() == list(range(10))
    assert nedbus.read(CASES / name, VLP)["timestamp"].size == 10
