"""PX4's .msg files: definitions, hashes as sent by a real PX4, and errors for invalid files."""

from __future__ import annotations

import math
import time
from contextlib import suppress

import pytest
from pydantic import ValidationError

from nedbus_msgs import (
    MESSAGES,
    MsgError,
    define_msg,
    definition_text,
    hash_of,
    hash_of_msg,
    read_msg,
    ros2_type,
)
from tests.flights.local_position import decode, encode
from tests.nedbus_msgs.strategies import DATA

TRIPLET_HASH = "RIHS01_e05aa5eb29374ce845899062b5810cc8487743bb95a976094821c1d0312e45aa"
"""Type hash in the key on which PX4 (main of 2026-05) published a PositionSetpointTriplet."""
NESTED = "\n" + "=" * 80 + "\nMSG: px4_msgs/"
MANY = "".join(f"uint8 f{number}\n" for number in range(300))
TRIPLET = (
    (DATA / "msg" / "PositionSetpointTriplet.msg").read_text()
    + f"{NESTED}PositionSetpoint\n"
    + (DATA / "msg" / "PositionSetpoint.msg").read_text()
)


@pytest.mark.parametrize("name", list(MESSAGES))
def test_definition_text_round_trip(name: str) -> None:
    """The .msg text of each layout is parsed to the same fields and the same hash."""
    definition = MESSAGES[name]
    for layout in definition.layouts.values():
        text = definition_text(definition, layout)
        assert {field.name: field.type for field in read_msg(text)} == layout.types
        assert hash_of_msg(name, text) == hash_of(layout, ros2_type(definition))


def test_nested_messages_are_flattened_and_hashed() -> None:
    """PositionSetpointTriplet contains PositionSetpoint's 20 fields three times; its hash equals a real PX4's."""
    assert hash_of_msg("PositionSetpointTriplet", TRIPLET) == TRIPLET_HASH
    definition = define_msg("PositionSetpointTriplet", TRIPLET)
    assert len(definition.types) == 61
    assert list(definition.types)[:4] == [
        "timestamp",
        "previous_timestamp",
        "previous_valid",
        "previous_type",
    ]
    many = define_msg(
        "Many", f"uint64 timestamp\nPart[2] parts{NESTED}Part\nuint8[3] of\nbool is\n"
    )
    assert list(many.types) == ["timestamp", "parts_0_of", "parts_0_is", "parts_1_of", "parts_1_is"]


def test_byte_and_char_are_hashed_as_in_ros_2() -> None:
    """A byte has a type id of its own in ROS 2, but its values are those of a uint8, like those of a char."""
    text = "uint64 timestamp\n{0} flags\n{0}[2] more\n"
    hashes = {kind: hash_of_msg("Probe", text.format(kind)) for kind in ("uint8", "byte")}
    assert hashes["uint8"] != hashes["byte"]
    single = "uint64 timestamp\n{} flags\n"
    assert hash_of_msg("Probe", single.format("char")) == hash_of_msg(
        "Probe", single.format("uint8")
    )
    assert (
        define_msg("Probe", text.format("byte")).types
        == define_msg("Probe", text.format("uint8")).types
    )


def test_annotations_become_rules() -> None:
    """@range bounds a value or each array element, @invalid names the value for "unknown", and units are kept."""
    text = """
        # A comment
        uint64 timestamp        # [us] time since system start
        uint8 KIND_A = 1
        float32 share           # [-] @range 0, 1 @invalid -1 how much
        float32[2] pair         # @range 0.1,
        float32 steer           # [@range -1 (Left), 1 (Right)] [@enum KIND] [@range_hint] [@other 1; 2
        float32 heading         # [@range -pi, INF] as in PX4
        char[3] letters
    """
    definition = define_msg("Ranged", text)
    assert {name: str(kind) for name, kind in definition.types.items()} == {
        "timestamp": "uint64", "share": "float32", "pair": "float32[2]", "steer": "float32", "heading": "float32",
        "letters": "char[3]",
    }  # fmt: skip
    assert definition.meaning("timestamp") == "[us] time since system start"
    definition.model.model_validate({"timestamp": 1, "steer": -1.0, "heading": -4.0})
    for share in (0.0, 1.0, -1.0, float("nan")):
        definition.model.model_validate({"timestamp": 1, "share": share})
    definition.model.model_validate({"timestamp": 1, "pair": (0.1, 5.0)})
    for wrong in (
        {"share": 1.5},
        {"share": -0.5},
        {"pair": (0.2, 0.05)},
        {"steer": 2.0},
        {"letters": "long"},
    ):
        with pytest.raises(ValidationError):
            definition.model.model_validate({"timestamp": 1, **wrong})


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", r"line 1, column 1: missing field 'uint64 timestamp'"),
        ("uint64 timestamp\nfloat32 x y\n", r"line 2, column 1: expected a field"),
        ("uint64 timestamp\n  float16 x\n", r"line 2, column 3: 'float16' is not a type"),
        ("uint64 timestamp\nfloat32[] x\n", r"line 2, column 1: 'float32\[\]' is not a type"),
        ("uint64 timestamp\nfloat32[<=4] x\n", r"line 2, column 1: expected a field, such as"),
        ("uint64 timestamp\nstring name\n", r"line 2, column 1: 'string' is not a type"),
        (
            "uint64 timestamp\nfloat32[100000] x\n",
            r"line 2, column 1: array of 100000 elements; expected 1 to 1024",
        ),
        ("uint64 timestamp\nbool x\nuint8  x\n", r"line 3, column 8: duplicate field 'x'"),
        ("uint64 timestamp\nOther other\n", r"line 2, column 1: 'Other' is not a type"),
        (
            f"uint64 timestamp\nSelf a{NESTED}Self\nSelf a\n",
            r"line 5, column 1: 'Self' is not a type",
        ),
        ("uint64 timestamp\nOther A=1\n", r"line 2, column 1: unsupported constant type 'Other'"),
        ("uint64 timestamp\nuint8 Upper\n", r"line 2, column 1: invalid field name 'Upper'"),
        (
            "uint64 timestamp\n  float32 range; # [m]\n",
            r"line 2, column 3: invalid field name 'range;'",
        ),
        (
            f"uint64 timestamp\nPart a{NESTED}Part\nbool B\n",
            r"line 5, column 1: invalid field name 'a_B'",
        ),
        (
            "uint64 timestamp\nfloat32 copy\n",
            r"line 2, column 1: invalid field name 'copy', which is a member of",
        ),
        (f"uint64 timestamp\nfloat32 a_b\nBar a{NESTED}Bar\nfloat32 b\n", r"duplicate field 'a_b'"),
        (
            f"uint64 timestamp\nA[20] a{NESTED}A\nB[20] b{NESTED}B\nC[20] c{NESTED}C\n",
            r"line 8, .* 'C' is not a type",
        ),
        (f"uint64 timestamp\n{MANY}", r"301 fields, more than the limit of 256"),
        ("uint64 timestamp\nfloat64[1000] x\n", r"bytes, more than the limit of 4096"),
        ("uint8 timestamp\n", r"missing field 'uint64 timestamp'"),
        ("#" * 300_000, r"300000 characters, more than the limit of 262144"),
        ("PNG\x00\xff\n", r"line 1, column 1: expected a field"),
    ],
)
def test_invalid_msg_file_raises(text: str, reason: str) -> None:
    """The error states the line, the column and the reason."""
    with pytest.raises(MsgError, match=reason):
        define_msg("Wrong", text)


def test_invalid_sentinel_survives_float32_rounding() -> None:
    """The `@invalid` value passes the rules before and after rounding to float32; it may be infinite."""
    text = "uint64 timestamp\nfloat32 a # @range 1, 5 @invalid 0.1\nfloat32 b # @range 1, 5 @invalid inf\n"
    definition = define_msg("Gauge", text)
    message = definition.model.model_validate({"timestamp": 1, "a": 0.1, "b": math.inf})
    assert decode(encode(message), definition.model) == message


@pytest.mark.parametrize(
    "rest",
    [
        " x [m] [@range 0, 100]",
        " x [m",
        " x 5 m",
        " x true5",
        "[2] x [1 2]",
        " A=foo",
        " A =",
        " A=1 [m]",
        ' x "a',
    ],
)
def test_text_that_is_no_comment_raises(rest: str) -> None:
    """A missing # is reported; without the error, the annotations after it would be ignored."""
    with pytest.raises(
        MsgError, match=r"line 2, column 2: expected a field, such as 'float32\[4\] q  # comment'"
    ):
        read_msg(f"uint64 timestamp\n float32{rest}\n")


@pytest.mark.parametrize(
    "annotation", ["[@range 0; 9]", "[@range 0, 9", "[@range]", "@range 0-9", "[@range 0, 9 m]"]
)
def test_malformed_range_raises(annotation: str) -> None:
    with pytest.raises(
        MsgError,
        match=r"line 2, column 1: malformed @range of x; expected limits, such as \[@range",
    ):
        define_msg("Wrong", f"uint64 timestamp\nfloat32 x  # [m] {annotation}\n")


@pytest.mark.parametrize(
    ("annotation", "limits"), [("5, 0", "5 to 0"), ("inf, 1.5 @invalid 3", "inf to 1.5")]
)
def test_empty_range_raises(annotation: str, limits: str) -> None:
    """Limits in the wrong order, which would reject every message, are an error of the file; equal ones are not."""
    with pytest.raises(
        MsgError, match=f"line 2, column 1: no number is in the @range of x, from {limits}"
    ):
        define_msg("Wrong", f"uint64 timestamp\nfloat32 x  # @range {annotation}\n")
    assert define_msg("Right", "uint64 timestamp\nfloat32 x  # @range 1, 1\n").rules


@pytest.mark.parametrize(
    "field",
    [
        "uint8 x  # @range 256,300",
        "uint8[2] x  # @range -5,-1",
        "int8 x  # @range 128,",
        "uint8 x  # @range 1.2,1.8",
        "int8[2] x  # @range -0.9,-0.1",
        "uint8 x  # @range 254.5,254.9",
    ],
)
def test_range_outside_the_type_raises(field: str) -> None:
    """A range without any number of the field's type would reject every message, too; one that overlaps does not."""
    with pytest.raises(MsgError, match="line 2, column 1: no number is in the @range of x, from"):
        define_msg("Wrong", f"uint64 timestamp\n{field}\n")
    for limits in ("255, 300", "1.2, 2.8", "-0.5, 0.5"):
        assert define_msg("Right", f"uint64 timestamp\nuint8 x  # @range {limits}\n").rules


@pytest.mark.parametrize("length", ["[x]", "[0]", "[-1]", "[1_0]", "[", "[2000]", "[<=3]"])
def test_invalid_length_of_an_array_of_messages_raises(length: str) -> None:
    text = f"uint64 timestamp\nPart{length} parts\n===\nMSG: px4_msgs/Part\nbool flag\n"
    for read in (read_msg, lambda each: hash_of_msg("Whole", each)):
        with pytest.raises(MsgError, match="line 2, column 1"):
            read(text)


def test_too_many_nested_fields_raise() -> None:
    """A short text that expands to more than 1000 fields is rejected."""
    text = f"uint64 timestamp\nA[20] a{NESTED}A\nB[20] b{NESTED}B\nC[20] c{NESTED}C\nuint8 d\n"
    with pytest.raises(MsgError, match="more than 1000 fields"):
        define_msg("Large", text)


@pytest.mark.parametrize(
    "line",
    [
        "float32 angle 1.5", "float32 angle -.5e3 # the default", "float32[2] angle [1, 2]", "bool angle true",
        "uint8 A = 0x1F # hexadecimal\nfloat32 angle", "string A = no quotes\nfloat32 angle", "char angle 'a'",
        'string FRAME="map"\nfloat32 angle', "string A = 'a # b'\nfloat32 angle", "float32 angle # \f form feed",
        "float32 angle # \u2028 line separator", "float32 angle # \x85 next line", "float32 angle\r\n",
    ],
)  # fmt: skip
def test_ros_2_syntax_is_accepted(line: str) -> None:
    """Defaults, string constants, a byte order mark, and Unicode line separators in comments are accepted."""
    fields = read_msg(f"\ufeffuint64 timestamp\n{line}\nuint8 mode\n")
    assert [field.name for field in fields] == ["timestamp", "angle", "mode"]


@pytest.mark.parametrize(
    "text",
    [
        "".join(f"uint8 f{number}\n" for number in range(1001)),
        "uint8 a # @range" + " " * 200_000,
        "uint8 a # @range " + "9" * 200_000,
        "uint8 a [" + "1, " * 80_000,
        "uint8 a" + " " * 200_000 + "b",
        f"A[20] a{NESTED}A\nuint8 b #" + "@range " * 30_000,
        f"A[20] a{NESTED}A\nB[20] b{NESTED}B\n"
        + "".join(f"C[0] c{i}\n" for i in range(20))
        + f"{NESTED}C\nbool d",
        "A[20] " + "a" * 20_000 + f"{NESTED}A\nuint8 b",
    ],
    ids=["fields", "spaces", "digits", "list", "default", "comment", "empty arrays", "long name"],
)
def test_parsing_takes_linear_time(text: str) -> None:
    """Hostile texts of 200,000 characters are parsed or rejected within the time limit."""
    begin = time.process_time()
    with suppress(MsgError):
        define_msg("Long", f"uint64 timestamp\n{text}")
    with suppress(MsgError):
        hash_of_msg("Long", f"uint64 timestamp\n{text}")
    assert time.process_time() - begin < 10
