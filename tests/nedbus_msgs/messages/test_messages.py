"""All messages: against vectors and hashes of rosbags, in all forms, and one more that is only a file."""

from __future__ import annotations

import gzip
import json
import math
import re
import shutil
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

import nedbus_msgs.messages
from docs.generator import committed
from docs.generator.messages import module_of
from nedbus_msgs import (
    ALL,
    MESSAGES,
    RELEASES,
    DecodeError,
    Definition,
    EncodeError,
    FieldType,
    InvalidMessageError,
    Message,
    codec_of,
    decode_with,
    encode_with,
    field_type,
    hash_of,
    hash_of_msg,
    message_of_type_hash,
    messages,
    upgrade_fields,
)
from nedbus_msgs.arrays import arrays_of
from nedbus_msgs.ros2.types import described, type_hash
from tests.flights.first_message import decode_cdr, encode_cdr
from tests.flights.ulogs import UlogWriter
from tests.nedbus_msgs.strategies import DATA
from tests.peers.processes import Start

VECTORS = DATA / "cdr_vectors_messages.jsonl.gz"
GOLDEN = DATA / "golden_messages.json"
PAGES = Path(__file__).parents[3] / "docs" / "messages"
SCHEMAS = Path(__file__).parents[3] / "schemas"
NAMES = list(MESSAGES)
LOG_MESSAGE = "uint64 timestamp\nuint8 severity\nchar[127] text\nuint8 ORB_QUEUE_LENGTH = 4\n"
float32s = st.one_of(st.floats(width=32), st.sampled_from([0.0, 1.0, -1.0, 0.5]))


def vectors() -> Iterator[Mapping[str, Any]]:
    """Yield the random messages of each layout that rosbags encoded; infinities and NaN are text."""
    with gzip.open(VECTORS, "rt") as file:
        yield from map(json.loads, file)


def to_python(value: Any) -> Any:
    """Return a value of a vector as `decode_cdr` returns it."""
    if isinstance(value, list):
        return tuple(map(to_python, value))
    return float(value) if isinstance(value, str) else value


def bits(value: object) -> object:
    """Return what tells any two values apart, and no NaN from another."""
    return tuple(map(bits, value)) if isinstance(value, tuple) else (type(value), repr(value))


def test_vectors_of_rosbags_are_decoded_and_encoded_to_the_bit() -> None:
    """Of each message and layout, found by its hash: fields in order, and the same bytes again."""
    found = set()
    for vector in vectors():
        payload, fields = (
            bytes.fromhex(vector["cdr"]),
            {name: to_python(each) for name, each in vector["fields"].items()},
        )
        known = message_of_type_hash(vector["type_hash"])
        assert known is not None
        definition, layout = known
        assert definition.name == vector["message"]
        assert definition.layout_of_release(vector["releases"][-1]) is layout
        decoded = decode_cdr(payload, layout=vector["type_hash"])
        assert list(decoded) == list(layout.fields) == list(fields)
        assert {name: bits(value) for name, value in decoded.items()} == {
            name: bits(each) for name, each in fields.items()
        }
        assert encode_cdr(fields, layout=vector["type_hash"]) == payload
        found.add((definition.name, layout.name))
    layouts = {(name, layout) for name, each in MESSAGES.items() for layout in each.layouts}
    assert {each for each in layouts - found if each[1] != ALL} == {
        ("VehicleLocalPosition", "V0"),  # of a node of PX4's
        ("LogMessage", "1.13"),  # whose char[127] is a uint8[127] in ROS 2, but not in rosbags
    }


def test_text_has_the_bytes_and_the_hash_of_ros_2() -> None:
    """A char of a .msg file is a uint8: the hash is that of std_msgs/msg/Char as ROS 2 Jazzy generates it."""
    char = ("std_msgs/msg/Char", [described("data", field_type("char"))])
    assert type_hash(char) == "RIHS01_3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9"
    layout = MESSAGES["LogMessage"].current
    assert hash_of(layout, "px4_msgs/msg/LogMessage") == hash_of_msg("LogMessage", LOG_MESSAGE)
    assert hash_of_msg("LogMessage", LOG_MESSAGE) == hash_of_msg("LogMessage", LOG_MESSAGE.replace("char", "uint8"))
    fields: dict[str, object] = {"timestamp": 7, "severity": 4, "text": "12 µs"}
    payload = encode_with(MESSAGES["LogMessage"], fields, layout)
    assert payload == struct.pack("<4sQB127s", b"\0\1\0\0", 7, 4, "12 µs".encode())
    assert decode_with(MESSAGES["LogMessage"], payload, layout) == fields


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", ""),
        (b"a\0b", "a"),
        ("µ".encode() * 63 + b"\xc2", "µ" * 63 + "?"),
        (b"\xff" * 127, "?" * 127),
        (b"ok\xff", "ok?"),
    ],
)
def test_bytes_of_a_text_are_never_an_error(data: bytes, text: str) -> None:
    """A text ends at the first NUL, and bytes that are not UTF-8 are replaced, in all forms alike."""
    definition = MESSAGES["LogMessage"]
    codec, arrays, padded = codec_of(definition), arrays_of(definition), data.ljust(127, b"\0")
    cdr = struct.pack("<4sQB127s", b"\0\1\0\0", 7, 4, data)
    assert decode_with(definition, cdr, definition.current)["text"] == text
    payload = codec.encode(definition.model(timestamp=7, severity=4))[:-127] + padded
    message = codec.decode(payload)
    assert message == definition.model(timestamp=7, severity=4, text=text)
    assert codec.decode(codec.encode(message)) == message
    decoded, valid = arrays.decode(payload)
    assert valid.all()
    assert arrays.to_message(decoded[0]) == message
    assert arrays.to_message(arrays.of([message])[0]) == message


def test_text_of_any_msgpack_is_read_and_one_that_does_not_fit_is_rejected() -> None:
    """Other implementations need not fill it up; what has more than 127 bytes is rejected, and so is another type."""
    definition = MESSAGES["LogMessage"]
    codec = codec_of(definition)
    assert codec.decode(msgpack.packb([0, 7, 4, "short"])).text == "short"
    assert codec.decode(msgpack.packb([0, 7, 4, b"\xff"], use_bin_type=False)).text == "?"
    for wrong in ("x" * 128, "µ" * 64, 5, None, ["x"]):
        with pytest.raises(DecodeError, match="text"):
            codec.decode(msgpack.packb([0, 7, 4, wrong]))
        with pytest.raises(ValidationError):
            definition.model(timestamp=7, text=wrong)
        with pytest.raises(InvalidMessageError):
            codec.encode_row((7, 4, wrong))
    assert definition.model(timestamp=7, text=np.bytes_(b"numpy")).text == "numpy"
    assert definition.model(timestamp=7, text="cut\0here").text == "cut"
    with pytest.raises(ValidationError):
        definition.model(timestamp=7, text="\ud800")
    bypassed = definition.model.model_construct(timestamp=7, severity=4, text=5)
    with pytest.raises(EncodeError):
        codec.encode(bypassed)


@pytest.mark.parametrize("name", NAMES)
def test_fields_of_older_layouts_survive_the_model(name: str) -> None:
    """Values of an older layout are in the model, under their present names, and are the same when downgraded."""
    dropped = {"q_offset", "pose_covariance", "velocity_covariance", "local_frame"}  # of odometry in 1.13
    for vector in (each for each in vectors() if each["message"] == name):
        known = message_of_type_hash(vector["type_hash"])
        assert known is not None
        definition, layout = known
        fields = {field: to_python(each) for field, each in vector["fields"].items()}
        absent = {field: kind.absent for field, kind in definition.types.items()}
        back = definition.downgrade(absent | upgrade_fields(definition, fields), layout)
        kept = fields.keys() - dropped
        assert {field: bits(back[field]) for field in kept} == {field: bits(fields[field]) for field in kept}


@pytest.mark.parametrize(
    ("name", "field", "value", "layout", "older"),
    [
        ("VehicleStatus", "failure_detector_status", 300, "1.13", "failure_detector_status"),
        ("SensorGps", "altitude_msl_m", 3e6, "1.14", "alt"),
        ("SensorGps", "altitude_msl_m", 1e308, "1.14", "alt"),
    ],
)
def test_value_beyond_an_older_type_is_not_provided_there(
    name: str, field: str, value: float, layout: str, older: str
) -> None:
    """A valid message can be sent to any workspace: what its type there does not hold is 0."""
    definition = MESSAGES[name]
    message = definition.model(timestamp=1, **{field: value})
    fields = definition.downgrade(message.__dict__, definition.layouts[layout])
    assert fields[older] == 0
    assert encode_with(definition, fields, definition.layouts[layout])


@pytest.mark.parametrize(
    ("name", "older"),
    [("SensorGps", {"lat": None}), ("VehicleOdometry", {"local_frame": {}}), ("SensorGps", {"lat": []})],
)
def test_older_field_that_is_no_number_is_rejected(name: str, older: dict[str, object]) -> None:
    """A peer says which fields its layout has, and sends anything for them: the error is that of any wrong type."""
    definition = MESSAGES[name]
    payload = msgpack.packb([99, 1, *older.values()])
    with pytest.raises(DecodeError, match="Input should be a valid"):
        codec_of(definition).decode(payload, newer={99: ("timestamp", *older)})


def test_layouts_are_told_apart_by_their_names() -> None:
    """A log has no version: each layout is found by the names of its fields, in any order."""
    for definition in MESSAGES.values():
        for layout in definition.layouts.values():
            assert definition.find_layout(reversed(layout.fields)) is layout
            assert layout.name in (*RELEASES, ALL, "V0")


def values_of(kind: FieldType) -> st.SearchStrategy[object]:
    """Return a strategy for the values of a type."""
    if kind.is_text:
        return st.text(max_size=kind.size // 4)
    if kind.base == "bool":
        one: st.SearchStrategy[object] = st.booleans()
    elif kind.is_float:
        one = float32s if kind.base == "float32" else st.floats()
    else:
        one = st.one_of(st.integers(0, 9), st.integers(*kind.limits))
    return st.tuples(*[one] * kind.length) if kind.length else one


@st.composite
def any_fields(draw: st.DrawFn) -> tuple[Definition[Any], dict[str, object]]:
    """Return fields of any message, with values of their types that perhaps break its rules."""
    definition = MESSAGES[draw(st.sampled_from(NAMES))]
    fields = {name: draw(values_of(kind)) for name, kind in definition.types.items()}
    if draw(st.booleans()):  # else almost all break some rule
        times = [name for name in ("timestamp_sample", "timestamp") if name in fields]
        fields |= {name: number for number, name in enumerate(times)}
        for rule in definition.rules:
            fields |= {name: definition.types[name].absent for name in rule.fields if name not in times}
    return definition, fields


@given(any_fields())
def test_all_forms_of_all_messages_agree(case: tuple[Definition[Any], dict[str, object]]) -> None:
    """Model, fields, rows and arrays accept the same messages, write the same bytes, and read the same values."""
    definition, fields = case
    codec, arrays = codec_of(definition), arrays_of(definition)
    array = np.array([arrays.to_element(tuple(fields.values()))] * 21, arrays.dtype)  # enough to be checked by columns
    try:
        message = definition.model.model_validate(fields)
    except ValidationError:
        assert not arrays.valid_mask(array).any()
        assert not arrays.valid_mask(array[:1]).any()
        with pytest.raises(InvalidMessageError, match=definition.name):
            codec.encode_fields(fields)
        with pytest.raises(InvalidMessageError):
            codec.encode_row(tuple(fields.values()))
        return
    payload = codec.encode(message)
    assert len(payload) == codec.size
    assert payload == codec.encode_fields(fields) == codec.encode_row(tuple(fields.values()))
    assert codec.decode(payload) == message == definition.model(**fields)
    assert bits(tuple(codec.decode_row(payload))) == bits(tuple(message.__dict__.values()))
    assert definition.model.model_validate_json(message.model_dump_json()) == message
    decoded, valid = arrays.decode(payload * 21)
    assert valid.all()
    assert arrays.encode(decoded) == arrays.encode(array) == payload * 21
    cdr = arrays.encode_cdr(array, definition.current)
    again, valid = arrays.decode_cdr([each.tobytes() for each in cdr], definition.current)
    assert valid.all()
    assert arrays.encode(again) == payload * 21


@pytest.mark.parametrize("name", NAMES)
def test_golden_bytes(name: str) -> None:
    """A message of a real flight (twelve_messages.ulg) has these bytes for ever; one that is added has some too."""
    definition, golden = MESSAGES[name], json.loads(GOLDEN.read_text())[name]
    message = definition.model.model_validate_json(json.dumps(golden["fields"]))
    assert codec_of(definition).encode(message).hex() == golden["payload"]
    assert codec_of(definition).decode(bytes.fromhex(golden["payload"])) == message


@pytest.mark.parametrize("name", NAMES)
def test_message_is_described(name: str) -> None:
    """Each field has a meaning, each rule fields; the schema is JSON, and defaults are valid."""
    definition = MESSAGES[name]
    assert [field for field in definition.types if not definition.meaning(field)] == []
    assert {field for rule in definition.rules for field in rule.fields} <= definition.types.keys()
    assert json.loads(json.dumps(definition.schema()))["json_schema"]["title"] == name
    message = definition.model(timestamp=1)
    assert isinstance(message, Message)
    for field, kind in definition.types.items():
        if field != "timestamp":
            assert bits(getattr(message, field)) == bits(kind.absent), field
    assert math.isfinite(sum(topic.rate for topic in definition.topics.values()))


@pytest.mark.process
def test_what_is_made_from_the_files_is_up_to_date() -> None:
    """The page of each message, after a change by `make generated`, and its import for type checkers."""
    assert [path.name for path, text in committed().items() if not path.exists() or path.read_text() != text] == []
    imports = Path(messages.__file__ or "").read_text()
    assert [name for name in MESSAGES if f"import {name} as {name}\n" not in imports] == []
    assert {path.name for path in PAGES.glob("*.md")} == {path.name for path in committed() if path.suffix == ".md"}


THIRTEENTH = '''
"""WheelEncoders: how far the wheels of a rover turned."""

from nedbus_msgs.model import Layout, Message, Topic
from nedbus_msgs.model.px4_types import Float32x2, field


class WheelEncoders(Message):
    """Speed and angle of the wheels of a rover."""

    TOPICS = (Topic("wheel_encoders", 10.0, "a rover's driver"),)
    LAYOUTS = (Layout("1.14", "*"),)

    wheel_speed: Float32x2 = field("Speed of the right and left wheel [rad/s]")
    wheel_angle: Float32x2 = field("Angle of the right and left wheel [rad]")
'''
USE_IT = """
import sys
import nedbus
from nedbus.sources import parse_source
from nedbus_msgs import MESSAGES, codec_of, upgrade_fields
from nedbus_msgs.arrays import dtype_of

definition = MESSAGES["WheelEncoders"]
run = parse_source(f"ulog:{sys.argv[1]}").open_source(vehicle="7").open()
messages = list(run.messages)
assert list(run.addresses.values()) == [definition], "it is known"
sent = [codec_of(definition).encode_fields(upgrade_fields(definition, each.fields)) for each in messages]
assert nedbus.read(sys.argv[1], "wheel_encoders")["wheel_speed"].tolist() == [[n, -n] for n in range(len(messages))]
with nedbus.connect(sys.argv[2]) as bus:
    with bus.subscribe("wheel_encoders", mode="every") as subscription:
        publisher = bus.publisher("wheel_encoders", vehicle=7)
        for each in messages:
            publisher.publish(each.fields)
        received = []
        while len(received) < len(messages):
            batch = subscription.receive_batch(20.0)
            assert batch.messages.dtype == dtype_of("wheel_encoders")
            received += batch.messages["wheel_speed"].tolist()
        [last] = bus.latest("wheel_encoders")
assert received == [[n, -n] for n in range(len(messages))], received
assert last.message == definition.model(timestamp=len(messages), wheel_speed=received[-1], wheel_angle=(0.5, 0.5))
print("used", len(messages), nedbus.WheelEncoders.__name__)
"""


def write_wheels(path: Path, count: int) -> Path:
    """Write a log of a rover: each message has one more turn of the wheels."""
    log = UlogWriter()
    log.put("F", b"wheel_encoders:uint64_t timestamp;float[2] wheel_speed;float[2] wheel_angle;")
    log.put("A", struct.pack("<BH", 0, 0) + b"wheel_encoders")
    for number in range(count):
        log.put("D", struct.pack("<HQ4f", 0, number + 1, number, -number, 0.5, 0.5))
    return log.write(path)


def test_thirteenth_message_is_one_file(tmp_path: Path, start: Start, endpoint: str) -> None:
    """A file in the folder of messages, and nothing else: from a log over a router to an array."""
    shutil.copytree(SCHEMAS / "nedbus_msgs", tmp_path / "nedbus_msgs")
    (tmp_path / "nedbus_msgs" / "messages" / "wheel_encoders.py").write_text(THIRTEENTH)
    log = write_wheels(tmp_path / "rover.ulg", 20)
    program = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n{USE_IT}"
    process = start("-c", program, str(log), endpoint, coverage=False, fresh=True)
    assert process.wait() == 0, process.err
    assert process.out == "used 20 WheelEncoders\n"


def test_type_checkers_know_each_message() -> None:
    """`messages/__init__.py` has a line for each file: without one a type checker rejects its class."""
    lines = Path(str(nedbus_msgs.messages.__file__)).read_text()
    shown = set(re.findall(r"^    from \.(\w+) import (\w+) as \2$", lines, re.MULTILINE))
    assert shown == {(module_of(definition), name) for name, definition in MESSAGES.items()}
