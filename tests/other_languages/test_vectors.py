"""The vectors of the wire format: nedbus conforms to them, and so do independent programs in other languages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import pytest

from docs.generator.vectors import VECTORS, definition_of, from_json, to_json
from nedbus_msgs import (
    BASES,
    MESSAGES,
    DecodeError,
    codec_of,
    field_type,
    provenance_of,
    upgrade_with,
)
from tests.nedbus_msgs.strategies import DATA

from .programs import run_program

FILE: Final[dict[str, Any]] = json.loads(VECTORS.read_text())
PROGRAMS: Final = {
    "node": ("vectors.mjs", ["@msgpack/msgpack"]),
    "g++": ("vectors.cpp", []),
    "cargo": (
        "vectors.rs",
        ['rmpv = "1"', 'serde_json = { version = "1", features = ["float_roundtrip"] }'],
    ),
}


def cases(kind: str) -> list[Any]:
    return [pytest.param(each, id=each["name"]) for each in FILE[kind]]


@pytest.mark.parametrize("vector", cases("exact"))
def test_vector_is_encoded_and_decoded(vector: dict[str, Any]) -> None:
    definition = definition_of(vector["message"], FILE["definitions"])
    codec, fields = codec_of(definition), from_json(vector["values"], definition.types)
    payload = bytes.fromhex(vector["payload"])
    assert codec.encode_fields(fields) == payload
    decoded = to_json(codec.decode(payload).__dict__, definition.types)
    assert json.dumps(decoded) == json.dumps(vector["values"])  # -0.0 differs from 0.0
    assert provenance_of(definition, vector["encoding"]).missing == {*vector["missing"]}


@pytest.mark.parametrize("vector", cases("decode"))
def test_payload_not_written_by_nedbus_is_decoded(vector: dict[str, Any]) -> None:
    """Payloads in layouts or msgpack types that nedbus never writes are decoded to the same values."""
    definition = definition_of(vector["message"], FILE["definitions"])
    types = {
        name: field_type(kind)
        for name, kind in FILE["definitions"][f"{vector['message']}/{vector['layout']}"]
    }
    expected = upgrade_with(definition, from_json(vector["values"], types))
    assert repr(codec_of(definition).decode(bytes.fromhex(vector["payload"]))) == repr(expected)


@pytest.mark.parametrize("vector", cases("reject"))
def test_invalid_vector_is_rejected(vector: dict[str, Any]) -> None:
    with pytest.raises(DecodeError):
        codec_of(definition_of(vector["message"], FILE["definitions"])).decode(
            bytes.fromhex(vector["payload"])
        )


def test_vectors_cover_each_message_and_type() -> None:
    types = {field_type(kind) for fields in FILE["definitions"].values() for _, kind in fields}
    assert {kind.base for kind in types} == {*BASES}
    assert {kind.base for kind in types if kind.is_array} >= {"bool", "float32", "uint8", "uint64"}
    assert {each["message"] for each in FILE["exact"]} == {*MESSAGES, "WireTypes"}


def test_golden_payloads_remain_among_the_vectors() -> None:
    """The golden payloads of the first version are still among the test vectors."""
    payloads = {each["payload"] for each in FILE["exact"]}
    for name in ("golden.json", "golden_messages.json"):
        assert {
            each["payload"] for each in json.loads((DATA / name).read_text()).values()
        } <= payloads


@pytest.mark.long
@pytest.mark.process
@pytest.mark.timeout(420)  # packages may be downloaded and compiled
@pytest.mark.parametrize("tool", PROGRAMS)
def test_program_in_another_language_conforms(tool: str, tmp_path: Path) -> None:
    """The program decodes and encodes all vectors; skipped without its tools, or if packages cannot be installed."""
    counts = [len(FILE[kind]) for kind in ("exact", "decode", "reject")]
    output = run_program(*PROGRAMS[tool], [str(VECTORS)], tmp_path)
    assert output.strip() == "{} exact, {} decoded, {} rejected".format(*counts)
