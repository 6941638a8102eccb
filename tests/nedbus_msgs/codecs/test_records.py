"""Records of fixed size: encoded in one step exactly as their fields are, or left to the model."""

from __future__ import annotations

import inspect
import math
import re
import struct
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from hypothesis import given, strategies as st

from nedbus_msgs import (
    DEFAULT,
    MESSAGES,
    Definition,
    Encoded,
    FieldReader,
    FieldType,
    InvalidMessageError,
    codec_of,
    decode_text,
    define,
    encode_upgraded,
    field_type,
    record_encoder,
)
from nedbus_msgs.codecs import records
from tests.nedbus_msgs.docstrings import printed_line

LAYOUTS = [
    (definition, layout.types)
    for definition in MESSAGES.values()
    for layout in definition.layouts.values()
]
BOOLS = st.sampled_from(
    [0, 1, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 1, 0, 2, 255]
)
FLOATS = (
    st.floats(-100, 100, width=32)
    | st.floats(width=32)
    | st.sampled_from([math.nan, math.inf, -0.0, 0.0, 1.0])
)


class Records:
    """Records with these fields one after the other, as in a log."""

    def __init__(self, definition: Definition[Any], types: Mapping[str, FieldType]) -> None:
        self.definition, self.types = definition, types
        self._struct = struct.Struct("<" + "".join(kind.form for kind in types.values()))
        self.size = self._struct.size
        self.encode = record_encoder(definition, types, self._struct.unpack)

    def fields(self, record: bytes) -> dict[str, object]:
        """Return the fields of a record by name."""
        fields, offset = dict[str, object](), 0
        for name, kind in self.types.items():
            form = f"<{kind.form}"
            values: tuple[Any, ...] = struct.unpack_from(form, record, offset)
            offset += struct.calcsize(form)
            fields[name] = (
                values if kind.is_array else decode_text(values[0]) if kind.is_text else values[0]
            )
        return fields


def values_of(kind: FieldType) -> st.SearchStrategy[bytes]:
    """Return a strategy for the bytes of a field, mostly valid ones."""
    if kind.base == "bool":
        one: st.SearchStrategy[bytes] = BOOLS.map(lambda value: bytes([value]))
    elif kind.is_float:
        code = "<f" if kind.base == "float32" else "<d"
        one = FLOATS.map(lambda value: struct.pack(code, value))
    elif kind.is_text:
        return st.binary(min_size=kind.size, max_size=kind.size)
    else:
        one = st.sampled_from([b"\0", b"\x01", b"\x02"]).map(
            lambda byte: byte.ljust(kind.size, b"\0")
        )
        one |= st.binary(min_size=kind.size, max_size=kind.size)
    return st.lists(one, min_size=kind.values, max_size=kind.values).map(b"".join)


def expected(encode: Callable[[], Encoded]) -> Encoded | None:
    """Return the message; None if it is invalid."""
    try:
        return encode()
    except InvalidMessageError:
        return None


@pytest.mark.slow
@given(st.data())
def test_record_is_encoded_as_its_fields(data: st.DataObject) -> None:
    """A record of any layout of any built-in message yields the payload of its fields, or is left to the model."""
    records = Records(*data.draw(st.sampled_from(LAYOUTS)))
    record = b"".join(data.draw(values_of(kind)) for kind in records.types.values())
    found, by_name = (
        records.encode(record),
        expected(lambda: encode_upgraded(records.definition, records.fields(record))),
    )
    assert (found and (found.payload, found.provided, found.missing)) == (by_name and by_name[1:])
    if found is not None and by_name is not None:
        read = FieldReader(records.definition.names)
        assert repr(read(found.row)) == repr(read(by_name.row))


@pytest.mark.parametrize(
    ("definition", "types"), LAYOUTS, ids=lambda each: getattr(each, "name", "")
)
def test_valid_record_of_each_layout_is_encoded(
    definition: Definition[Any], types: Mapping[str, FieldType]
) -> None:
    """A valid record of each layout is encoded in one step, and its payload decodes to its values."""
    records, halves = (
        Records(definition, types),
        {"float32": struct.pack("<f", 0.5), "float64": struct.pack("<d", 0.5)},
    )
    found = records.encode(
        b"".join(halves.get(kind.base, bytes(kind.size)) * kind.values for kind in types.values())
    )
    assert found is not None
    assert repr(FieldReader(definition.names)(found.row)) == repr(
        tuple(codec_of(definition).decode_row(found.payload))
    )
    assert found.missing == definition.all_fields - found.provided


def test_record_without_a_timestamp_is_left_to_the_model() -> None:
    """A record without a timestamp is not published with the timestamp 0."""
    records = Records(DEFAULT, {"x": field_type("float32")})
    assert records.encode(bytes(4)) is None


@pytest.mark.parametrize("kind", ["float32[3]", "float32", "char[8]"])
def test_record_with_an_array_of_another_length_is_left_to_the_model(kind: str) -> None:
    """A field with another number of values than the model's never shifts the values of the fields after it."""
    types = {**DEFAULT.types, "delta_xy": field_type(kind)}
    records = Records(DEFAULT, types)
    assert records.encode(bytes(records.size)) is None


def test_number_beyond_float32_is_left_to_the_model() -> None:
    """A float64 of the record that does not fit the float32 of the model is rejected, not published as infinity."""
    records = Records(DEFAULT, {**DEFAULT.types, "x": field_type("float64")})
    record = bytearray(records.size)
    offset = sum(
        each.size * each.values for each in [*records.types.values()][: [*records.types].index("x")]
    )
    struct.pack_into("<d", record, offset, 1e300)
    assert records.encode(bytes(record)) is None
    struct.pack_into("<d", record, offset, 1.5)
    found = records.encode(bytes(record))
    assert found is not None
    assert codec_of(DEFAULT).decode(found.payload).x == 1.5


def test_signalling_nan_is_published_as_from_its_fields() -> None:
    """NaNs have the same bits in the payload, whichever way a message is encoded."""
    types = {"timestamp": field_type("uint64"), "value": field_type("float32")}
    records = Records(define("Debug", types.items()), types)
    for bits in (0x7F800001, 0xFFC00001, 0x7FC00000):
        record = struct.pack("<QI", 7, bits)
        found, by_name = (
            records.encode(record),
            encode_upgraded(records.definition, records.fields(record)),
        )
        assert found is not None
        assert found.payload == by_name.payload


def test_text_of_a_record_ends_at_its_first_nul() -> None:
    """Text is cleaned as in a decoded message: it ends at the first NUL, and invalid UTF-8 becomes "?"."""
    types = {"timestamp": field_type("uint64"), "text": field_type("char[8]")}
    records = Records(define("Note", types.items()), types)
    found = records.encode(struct.pack("<Q8s", 7, b"a\xffb\0rest!"))
    assert found is not None
    assert FieldReader(("text", "timestamp"))(found.row) == ("a?b", 7)
    assert codec_of(records.definition).decode_row(found.payload)[1] == "a?b"


def test_field_reader_reads_all_forms_of_a_message() -> None:
    """A reader returns the same values from a model, a row, flattened values and a dict, and NaN for unknown fields."""
    names, records = ("y", "delta_xy", "xy_valid", "wings"), Records(DEFAULT, DEFAULT.types)
    record = records.encode(bytes(records.size))
    assert record is not None
    model = codec_of(DEFAULT).decode(record.payload)
    forms = model, codec_of(DEFAULT).decode_row(record.payload), record.row, dict(model.__dict__)
    read = FieldReader(names, math.nan)
    assert {repr(read(each)) for each in forms} == {"(0.0, (0.0, 0.0), False, nan)"}
    assert {FieldReader(("y",))(each) for each in forms} == {(0.0,)}
    assert {FieldReader(names[:3])(each) for each in forms} == {(0.0, (0.0, 0.0), False)}


@pytest.mark.slow
def test_field_reader_forgets_types_of_messages() -> None:
    """A reader that meets ever new definitions does not keep all of them alive."""
    read = FieldReader(("timestamp", "value"))
    for number in range(200):
        types = {"timestamp": field_type("uint64"), "value": field_type("float32")}
        records = Records(define(f"Debug{number}", types.items()), types)
        found = records.encode(bytes(records.size))
        assert found is not None
        assert read(found.row) == (0, 0.0)
    assert len(read._readers) <= 64


def test_fields_of_another_type_name_the_broken_rule() -> None:
    """Fields that the quick validation does not accept are judged by the model, which gives the reason."""
    assert encode_upgraded(DEFAULT, {"timestamp": 1, "x": 1}).row[DEFAULT.names.index("x")] == 1.0
    for value, reason in (
        ("1", "x: Input should be a valid number"),
        (1e39, "x: is beyond the range of float32"),
    ):
        with pytest.raises(InvalidMessageError, match=reason):
            encode_upgraded(DEFAULT, {"timestamp": 1, "x": value})
    with pytest.raises(InvalidMessageError, match="timestamp: Field required"):
        encode_upgraded(DEFAULT, {"x": 1.0})


def test_printed_encoder_of_records_is_what_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """The docstrings show the function for a VehicleAttitude, and the conversion of a position of PX4 1.15."""
    sources: list[str] = []
    monkeypatch.setattr(records, "compile_lambda", lambda text, **_: sources.append(text))
    attitude = MESSAGES["VehicleAttitude"]
    records._compile(attitude, attitude.types)
    assert sources == [printed_line(records._compile)]
    conversion = records._Conversion(DEFAULT, DEFAULT.layouts["1.15"].types)
    assert conversion.text == printed_line(records._Conversion)
    types = {**attitude.types, "timestamp": field_type("uint32")}
    records._compile(attitude, types)
    converted = re.search(r"`(flatten[^`]*)`", inspect.getdoc(records._compile) or "")
    assert converted is not None
    assert f"(values := {converted[1]})" in sources[1]
